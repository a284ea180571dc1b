"""The public interface: run a tracker, benchmark, tune, report, and load the results, one call each.

>>> import tempfile
>>> import dynslam_bench as db
>>> results = tempfile.mkdtemp()
>>> run = db.run("never-move", "synthetic/sitting_xyz?scene=100&frames=8", results=results)
>>> run.status, run.metrics["ate_rmse_m"] > 0
('ok', True)
>>> db.load(results)[["tracker", "sequence", "status"]].iloc[0].tolist()
['never-move', 'synthetic/sitting_xyz?scene=100&frames=8', 'ok']
>>> len(db.sequence("synthetic/sitting_xyz?frames=8"))
8
>>> db.trackers.TRACKERS.get("emfoa-oft").sensors
'rgbd'

The names are loaded on first use, so that ``import dynslam_bench`` stays fast. The command line
calls these functions.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from pydantic import ValidationError

from dynslam_bench.core import RunError, SettingsError, did_you_mean
from dynslam_bench.core.records import Record
from dynslam_bench.runs import (
    DEFAULT_PROTOCOL,
    Limits,
    RunRecord,
    RunSpec,
    RunStore,
    load_frames,
    run_many,
)
from dynslam_bench.trackers import TRACKERS

if TYPE_CHECKING:
    import pandas as pd

    from dynslam_bench.contracts import Sequence as FrameSequence
    from dynslam_bench.contracts import Trajectory
    from dynslam_bench.evaluation import Protocol
    from dynslam_bench.reports import ReportPaths
    from dynslam_bench.runs import PlannedRuns, RunEvent
    from dynslam_bench.runs.many import OnFault
    from dynslam_bench.tuning import Study, StudySpec, StudySummary

R = TypeVar("R", bound=Record)


@dataclass(frozen=True, eq=False)
class RunResult:
    """A stored run.

    Attributes:
        run_id: Its id.
        store: The results folder.
        protocol: How its metrics are evaluated.
    """

    run_id: str
    store: RunStore
    protocol: str

    @property
    def record(self) -> RunRecord:
        """Everything that is stored of it; read whenever it is asked for."""
        return self.store.read_whole(self.run_id)

    @property
    def status(self) -> str:
        """Status in which it ended: ``ok``, ``lost``, ``crashed``, ..."""
        return self.record.status

    @property
    def metrics(self) -> dict[str, float]:
        """The metrics under the protocol by name (``ate_rmse_m``, ...)."""
        return dict(self.store.score(self.record, self.protocol).metrics)

    @property
    def remarks(self) -> list[str]:
        """Warnings and hints on the metrics, one a line."""
        return self.store.score(self.record, self.protocol).remarks

    @property
    def trajectory(self) -> Trajectory | None:
        """Poses of the tracked frames, each as it was when the frame came; None if no frame was tracked."""
        return self.store.trajectory(self.run_id)

    @property
    def folder(self) -> Path:
        """Folder of its files."""
        return self.store.folder(self.run_id)

    def frames(self) -> pd.DataFrame:
        """State, errors, times and diagnostics, one row a frame."""
        return load_frames(self.run_id, self.store.root)


@dataclass(frozen=True, eq=False)
class StudyResult:
    """A finished study.

    Attributes:
        summary: Conclusion, candidates and their evidence.
        page: Its HTML page.
        tuner: The study itself, with Optuna's.
    """

    summary: StudySummary
    page: Path
    tuner: Study

    @property
    def preset(self) -> Path:
        """The best settings, for ``run(settings=...)`` and ``--settings``."""
        return self.tuner.folder / "best.toml"


def run(
    tracker: str,
    sequence: str | Path,
    *,
    settings: Mapping[str, Any] | None = None,
    preset: str | None = None,
    results: str | Path = "results",
    protocol: str = DEFAULT_PROTOCOL,
    **options: Any,
) -> RunResult:
    """Run a tracker on a sequence in a child process; a run that is stored already is not made again.

    Args:
        tracker: Id, ``id:value``, ``module:Attr`` or ``file.py:Attr``.
        sequence: Id, or path of a folder in TUM layout.
        settings: Overrides of the tracker's settings by dotted name.
        preset: A preset of the tracker, which `settings` override.
        results: The results folder.
        protocol: How to evaluate.
        **options: Further fields of `RunSpec`: ``frames``, ``stride``, ``seed``, ``offset``, ``device``, ...

    Raises:
        DynslamError: The tracker, the sequence or an option is unknown or does not fit.
    """
    repeat = {"seeds": [options.pop("seed", 0)], "offsets": [options.pop("offset", 0)]}
    specs = make_specs(
        tracker, [str(sequence)], settings=settings, preset=preset, **repeat, **options
    )
    return run_specs(specs, results=results, protocol=protocol)[0]


def make_specs(
    tracker: str,
    sequences: Iterable[str],
    *,
    settings: Mapping[str, Any] | None = None,
    preset: str | None = None,
    seeds: Sequence[int] = (0,),
    offsets: Sequence[int] = (0,),
    **options: Any,
) -> list[RunSpec]:
    """The runs of a tracker on sequences, with all seeds and offsets.

    Raises:
        SettingsError: The tracker has no such preset.
        RunError: An option is unknown or does not fit.
    """
    presets = TRACKERS.get(tracker).presets if preset is not None else {}
    if preset is not None and preset not in presets:
        raise SettingsError(
            f"tracker '{tracker}' has no preset '{preset}'", did_you_mean(preset, presets)
        )
    overrides = {**presets.get(preset or "", {}), **(settings or {})}
    return [
        validated_record(
            RunSpec,
            tracker=tracker,
            sequence=sequence,
            settings=overrides,
            seed=seed,
            offset=offset,
            **options,
        )
        for sequence in sequences
        for seed in seeds
        for offset in offsets
    ]


def validated_record(kind: type[R], **values: Any) -> R:
    """Build a pydantic record from a user's values.

    Raises:
        RunError: A value does not fit; the error names its field.
    """
    try:
        return kind(**values)
    except ValidationError as error:
        first = error.errors()[0]
        name = ".".join(map(str, first["loc"]))
        raise RunError(f"{name} is {first['input']!r}", first["msg"].lower()) from None


def bench(
    suite: str | Path,
    *,
    results: str | Path = "results",
    jobs: int = 1,
    protocol: str = DEFAULT_PROTOCOL,
    scheduler: str | None = None,
    retry: Collection[str] = (),
    time_limit_s: float | None = None,
    memory_limit_mb: float | None = None,
    shard: tuple[int, int] = (1, 1),
    on_workers: Callable[[list[dict[str, object]]], None] | None = None,
    on_plan: Callable[[PlannedRuns], None] | None = None,
    on_event: Callable[[RunEvent], None] | None = None,
    on_fault: OnFault | None = None,
    **choice: Any,
) -> list[RunResult]:
    """Run a suite: every tracker on every sequence; a second call continues an interrupted one.

    Args:
        suite: Name of a shipped suite, or a TOML file.
        results: The results folder.
        jobs: Runs at a time.
        protocol: How to evaluate.
        scheduler: Address of a Dask scheduler whose workers make the runs.
        retry: See `run_many`, as the callbacks `on_plan`, `on_event` and `on_fault`.
        time_limit_s: Seconds that a run may take, in place of the suite's limit.
        memory_limit_mb: Memory that a run may take, in place of the suite's limit.
        shard: ``(k, n)``: only the k-th of n parts of the suite's runs, the k-th, (k + n)-th, ...
            of them, if any.
        on_workers: Called before the first run, with what each of the scheduler's workers has.
        on_plan: Called once, with the runs that are to be made.
        on_event: Called with every `RunEvent`.
        on_fault: Called with every run that cannot be made.
        **choice: Arguments of `Suite.specs`: ``trackers``, ``seeds``, ``offsets``, ``frames``, ``data_root``, ...

    Raises:
        DynslamError: The suite names something unknown, or a run cannot be made.
    """
    from dynslam_bench.runs.cluster import DaskWorkers
    from dynslam_bench.suites import load_suite

    asked = {"time_s": time_limit_s, "memory_mb": memory_limit_mb}
    chosen = load_suite(suite)
    limits = chosen.limits.model_dump() | {
        name: value for name, value in asked.items() if value is not None
    }
    every = chosen.model_copy(update={"limits": validated_record(Limits, **limits)}).specs(**choice)
    specs = islice(every, shard[0] - 1, None, shard[1])
    run_many_options: dict[str, Any] = {
        "results": results,
        "protocol": protocol,
        "jobs": jobs,
        "retry": retry,
        "on_plan": on_plan,
        "on_event": on_event,
        "on_fault": on_fault,
    }
    if scheduler is None:
        return run_specs(specs, **run_many_options)
    with DaskWorkers(scheduler) as workers:
        if on_workers is not None:
            on_workers(workers.describe(chosen.sequences, choice.get("data_root")))
        return run_specs(specs, executor=workers, **run_many_options)


def run_specs(
    specs: Iterable[RunSpec],
    *,
    results: str | Path = "results",
    protocol: str = DEFAULT_PROTOCOL,
    **run_many_options: Any,
) -> list[RunResult]:
    """Make runs that are given one by one.

    Args:
        specs: The runs, e.g. of `make_specs`.
        results: The results folder.
        protocol: How to evaluate.
        **run_many_options: Further arguments of `run_many`.

    Raises:
        DynslamError: See `run_many`.
    """
    store = RunStore(results)
    records = run_many(specs, results=store, protocol=protocol, **run_many_options)
    return [
        RunResult(run_id, store, protocol)
        for run_id in records.run_ids
        if run_id not in records.not_stored
    ]


def tune(
    study: str | Path | StudySpec,
    *,
    results: str | Path = "results",
    jobs: int = 1,
    trials: int | None = None,
    choose: int | None = None,
    more_scenes: int = 0,
    more_trials: int = 0,
    on_event: Callable[..., None] | None = None,
    on_run: Callable[..., None] | None = None,
    on_note: Callable[[str], None] | None = None,
) -> StudyResult:
    """Run a study or continue it, check its best trials on held-out sequences, and write its page and preset.

    Args:
        study: The study, or its TOML file.
        results: The results folder.
        jobs: Trials at a time.
        trials: Finished trials, in place of the study's own number.
        choose: The number of a trial to be judged in place of the best, e.g. one of the front.
        more_scenes: Rendered scenes to add to those that judge.
        more_trials: Trials to add.
        on_event: Called with every `StudyEvent`.
        on_run: Called with every `RunEvent`.
        on_note: Called with a line at every step of the final check.

    Raises:
        DynslamError: The study is ill-defined, or does not fit what is stored under its name.
    """
    from dynslam_bench.tuning import finish, read_study, run_study, write_page

    spec = read_study(Path(study)) if isinstance(study, str | Path) else study
    spec = spec if trials is None else spec.model_copy(update={"trials": trials})
    tuner = run_study(
        spec,
        results=results,
        jobs=jobs,
        scenes=more_scenes,
        trials=more_trials,
        on_event=on_event,
        on_run=on_run,
    )
    summary = finish(tuner, on_note, jobs=jobs, trial=choose)
    return StudyResult(summary, write_page(tuner, summary), tuner)


def report(
    results: str | Path | Sequence[str | Path] = "results",
    output: str | Path | None = None,
    **options: Any,
) -> ReportPaths:
    """Write an offline HTML page of stored runs, with Markdown, CSV and LaTeX beside it.

    Args:
        results: Results folders.
        output: Folder of the report; ``report`` in the first results folder by default.
        **options: Further arguments of `reports.build_report`: ``protocol``, ``reference``, ``title``, ...

    Raises:
        ReportError: There are no runs.
        RunError: The results are an archive, and no output is named.
    """
    from dynslam_bench.reports import build_report

    folders = (
        [Path(results)] if isinstance(results, str | Path) else [Path(folder) for folder in results]
    )
    if output is None and folders[0].is_file():
        raise RunError(
            f"{folders[0]} is an archive, which cannot hold its report",
            "name the report's folder: -o FOLDER",
        )
    return build_report(folders, output or folders[0] / "report", **options)


def load(
    results: str | Path | Sequence[str | Path] = "results",
    protocol: Protocol | str = DEFAULT_PROTOCOL,
    *,
    trials: bool = False,
) -> pd.DataFrame:
    """The runs of results folders, one row a run; of equal runs the newest, as in a report.

    Args:
        results: Results folders.
        protocol: How to evaluate; SLAM is never run again for it.
        trials: Whether the trials of studies are listed, too.

    Returns:
        The frame that `reports.load_frame` describes.

    Raises:
        ReportError: There are no runs.
    """
    from dynslam_bench.reports import load_frame

    return load_frame(
        [Path(results)] if isinstance(results, str | Path) else list(map(Path, results)),
        protocol,
        trials=trials,
    )


def sequence(name: str | Path, **options: Any) -> FrameSequence:
    """Open a sequence by its id or folder.

    Args:
        name: E.g. ``tum/fr3/walking_xyz``, ``synthetic/walking_xyz?scene=100``, or the path of a
            recording.
        **options: Arguments of `sequences.open_sequence`: ``frames``, ``stride``, ``camera``, ``data_root``, ...

    Raises:
        SequenceError: The sequence is unknown, missing or damaged.
    """
    from dynslam_bench.sequences import open_sequence

    return open_sequence(name, **options)
