"""Studies: run one from Python with custom objectives, samplers and callbacks, open a stored one, run its stages."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import optuna
from optuna.trial import FrozenTrial

from dynslam_bench.core.errors import SequenceError, SettingsError, StudyError
from dynslam_bench.core.reading import read_json
from dynslam_bench.core.records import write_atomic
from dynslam_bench.core.settings import Scalar
from dynslam_bench.core.toml import read_toml
from dynslam_bench.tuning.final_runs import finish
from dynslam_bench.tuning.instances import ProblemInstance, scenes
from dynslam_bench.tuning.objectives import ACCURACY, Cost, Objective, Outcomes, find_objective, own_objective, together
from dynslam_bench.tuning.page import write_page
from dynslam_bench.tuning.pilot import FEWEST, Pilot, refuse_hopeless, run_pilot
from dynslam_bench.tuning.screening import Screening, plan, screen
from dynslam_bench.tuning.space import starting_point
from dynslam_bench.tuning.storage import open_storage, study_folder
from dynslam_bench.tuning.study_file import StudySpec, make_spec, read_study
from dynslam_bench.tuning.summary import StudySummary
from dynslam_bench.tuning.trials import trials_frame
from dynslam_bench.tuning.tuner import OnEvent, OnRun, StudyEvent, Tuner

if TYPE_CHECKING:
    import pandas as pd


_SPEC_FILE = "study.json"
Callback = Callable[[optuna.Study, FrozenTrial], object]
"""Called after each trial, as Optuna's own."""


class Study:
    """A study, to be run or to be looked at.

    Example:
        ``Study(tracker="orb-slam2", tune=["synthetic/walking_xyz?scene=0-3&frames=80"], name="few").run().finish()``

    Args:
        spec: The study, or its TOML file; None if the fields say it all.
        results: The results folder.
        objective: In place of the spec's: names of objectives, or functions from
            `evaluate.Outcome` to a cost above 0, one or several.
        sampler: Any of Optuna's, in place of the spec's.
        callbacks: Called with Optuna's study and the trial after each trial.
        start: Presets (TOML files, or settings by dotted name) that are tried right after the default.
        **fields: Fields of `StudySpec`, in place of the spec's; `tune`, `confirm` and `held_out` take instances, too.

    Attributes:
        spec: What it asks for.
        study: Optuna's study.

    Raises:
        DynslamError: See `Tuner`; or a preset holds settings that the study neither tunes nor has.
    """

    spec: StudySpec
    study: optuna.Study
    _tuner: Tuner | None

    def __init__(
        self,
        spec: StudySpec | Path | str | None = None,
        *,
        results: Path | str = "results",
        objective: str | Cost | Sequence[str | Cost] | None = None,
        sampler: optuna.samplers.BaseSampler | None = None,
        callbacks: Iterable[Callback] = (),
        start: Iterable[Path | str | Mapping[str, Scalar]] = (),
        **fields: Any,
    ) -> None:
        base = read_study(spec) if isinstance(spec, Path | str) else spec
        objectives = _objectives(objective)
        changes = {key: _texts(value) for key, value in fields.items()}
        if objectives is not None:
            changes["objectives"] = tuple(objective.name for objective in objectives)
        values = {} if base is None else base.model_dump()
        self.spec = make_spec({"name": "study", **values, **changes}, "the study")
        self._tuner = tuner = Tuner(self.spec, results, objectives=objectives, sampler=sampler)
        self.study = tuner.study
        self._callbacks = tuple(callbacks)
        self._summary: StudySummary | None = None
        for preset in start:
            settings = preset if isinstance(preset, Mapping) else read_preset(Path(preset))
            tuner.study.enqueue_trial(starting_point(settings, tuner.space, tuner.base), skip_if_exists=True)

    @classmethod
    def open(cls, study: StudySpec | Path | str, results: Path | str = "results") -> Study:
        """Open a stored study to look at; nothing is run, and neither tracker nor sequences need to be there.

        Args:
            study: A study, its TOML file, or its folder in the results (``results/studies/NAME``).
            results: The results folder; a study's own folder says where it lies.

        Raises:
            StudyError: There is no such study.
        """
        spec, root = _spec_of(study, Path(results))
        if not spec.storage and not study_folder(root, spec).is_dir():
            raise StudyError(f"there is no study '{spec.name}' in {root}", "dynslam-bench tune run STUDY.toml")
        opened = cls.__new__(cls)
        try:
            opened.study = optuna.load_study(study_name=spec.name, storage=open_storage(root, spec))
        except KeyError as error:
            raise StudyError(
                f"the storage holds no study '{spec.name}'", "dynslam-bench tune run STUDY.toml"
            ) from error
        opened.spec, opened._tuner = spec, None
        return opened

    def run(self, *, jobs: int = 1) -> Study:
        """Run the trials that are missing; a pilot first, if the study is new and asks for one.

        Raises:
            StudyError: The default settings fail, the pilot shows that the study could find nothing, or it was opened
                to be looked at.
        """
        tuner = self._running()
        begin(tuner, jobs=jobs)
        tuner.run(jobs=jobs, on_event=self._call_back)
        return self

    def finish(self, *, jobs: int = 1) -> StudySummary:
        """Judge the best trials, write presets, summary and page; see `final_runs.finish`."""
        tuner = self._running()
        summary = finish(tuner, jobs=jobs)
        write_page(tuner, summary)
        return summary

    def pilot(self, *, jobs: int = 1) -> Pilot:
        """What the study's instances could show; see `pilot_of`."""
        return pilot_of(self._running(), jobs=jobs)

    def screen(self, *, points: int = 2, instances: int = 4, jobs: int = 1) -> Screening:
        """Which settings matter; see `screen_study`."""
        return screen_study(self._running(), points=points, instances=instances, jobs=jobs)

    def frame(self) -> pd.DataFrame:
        """All trials; see `trials.trials_frame`.

        Raises:
            StudyError: The storage holds something else than this package stores of a trial.
        """
        try:
            return trials_frame(self.spec, self.study)
        except (AttributeError, TypeError, ValueError, LookupError, ArithmeticError) as error:
            raise StudyError(f"the storage of study '{self.spec.name}' holds what is no trial: {error}") from error

    def _running(self) -> Tuner:
        if self._tuner is None:
            raise StudyError(f"study '{self.spec.name}' was opened to be looked at", "Study(...) makes one to run")
        return self._tuner

    def _call_back(self, event: StudyEvent) -> None:
        if event.kind == "finished" and self._callbacks:
            trial = self.study.get_trials(deepcopy=False)[event.number]
            for callback in self._callbacks:
                callback(self.study, trial)


def read_preset(path: Path) -> dict[str, Scalar]:
    """A preset's settings by dotted name.

    Raises:
        SettingsError: It cannot be read, or is no TOML.
    """
    try:
        return dict(_flat(read_toml(path.expanduser())))
    except SequenceError as error:
        raise SettingsError(str(error)) from None


def _flat(values: Mapping[str, Any], prefix: str = "") -> Iterable[tuple[str, Any]]:
    for key, value in values.items():
        if isinstance(value, Mapping):
            yield from _flat(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value


def _objectives(given: str | Cost | Sequence[str | Cost] | None) -> list[Objective] | None:
    if given is None:
        return None
    several = [given] if isinstance(given, str) or callable(given) else given
    return [find_objective(one) if isinstance(one, str) else own_objective(one) for one in several]


def _texts(value: Any) -> Any:
    """Instances as the texts that name them; any other value as it is."""
    values = value if isinstance(value, list | tuple) else [value]
    return tuple(map(str, values)) if any(isinstance(item, ProblemInstance) for item in values) else value


def _spec_of(study: StudySpec | Path | str, results: Path) -> tuple[StudySpec, Path]:
    """The study and the results folder that it lies in."""
    if isinstance(study, StudySpec):
        return study, results
    path = Path(study).expanduser()
    stored = path / _SPEC_FILE
    if stored.is_file():
        return make_spec(read_json(stored, kind=StudyError), str(stored)), path.absolute().parents[1]
    if path.is_dir():
        raise StudyError(f"{path} holds no study: it has no {_SPEC_FILE}", "name results/studies/NAME")
    return read_study(path), results


# Running studies: a pilot first, then the trials; and the screening that may come before both.

PILOT_FILE, SCREENING_FILE = "pilot.json", "screening.json"
SCREENED_INSTANCES = 4
"""Instances that a screening takes if nothing else is asked for."""


def run_study(
    spec: StudySpec,
    *,
    results: str | Path = "results",
    jobs: int = 1,
    on_event: OnEvent | None = None,
    on_run: OnRun | None = None,
) -> Tuner:
    """Run a study to its end, or go on with it; a pilot runs first where the study asks for one.

    Args:
        spec: The study.
        results: The results folder; the study's own files lie in ``studies/<name>``.
        jobs: Trials at a time.
        on_event: Called with every event.
        on_run: Called with every event of every run, those of `finish` included.

    Returns:
        The study, for `finish`.

    Raises:
        DynslamError: See `Tuner`; or the pilot shows that the study could find nothing.
    """
    tuner = Tuner(spec, results)
    tuner.on_run = on_run
    begin(tuner, jobs=jobs, on_event=on_event)
    tuner.run(jobs=jobs, on_event=on_event)
    return tuner


def begin(tuner: Tuner, *, jobs: int = 1, on_event: OnEvent | None = None) -> None:
    """Run a new study's pilot, if it asks for one, and report what it shows.

    Raises:
        StudyError: The study could find nothing.
    """
    if not tuner.spec.pilot or (tuner.folder / PILOT_FILE).is_file() or tuner.study.get_trials(deepcopy=False)[1:]:
        return
    if len(scenes(tuner.design.tune)) < FEWEST:
        texts = [f"no pilot: it takes {FEWEST} scenes to tune on"]
        pilot = None
    else:
        pilot = pilot_of(tuner, jobs=jobs)
        texts = [pilot.sentence, *filter(None, [pilot.warning])]
    for text in texts:
        if on_event is not None:
            on_event(StudyEvent("pilot", 0, 1, text))
    if pilot is not None and not tuner.spec.at_equal_accuracy:  # settings that leave the poses alone show their speed
        refuse_hopeless(pilot)


def pilot_of(tuner: Tuner, *, jobs: int = 1) -> Pilot:
    """Run a study's pilot; `pilot.json` in its folder holds it.

    It looks at the study's own objectives, or at accuracy where a gain counts only at equal accuracy.

    Raises:
        StudyError: The default settings fail, or there are too few scenes.
    """

    def run(values: Mapping[str, Any], instances: Sequence[ProblemInstance]) -> Outcomes:
        return tuner.evaluate({**tuner.spec.space.fixed, **values}, instances, jobs=jobs)

    objective = ACCURACY if tuner.spec.at_equal_accuracy else together(tuner.objectives)
    split = tuner.design.held_out if len(scenes(tuner.design.held_out)) >= FEWEST else None
    pilot = run_pilot(
        tuner.space, tuner.base, run, tuner.design.reference, objective,
        seed=tuner.spec.sampler_seed, jobs=jobs, split=split,
    )  # fmt: skip
    write_atomic(tuner.folder / PILOT_FILE, pilot.to_json())
    return pilot


def screen_study(
    tuner: Tuner, *, points: int = 2, instances: int = SCREENED_INSTANCES, jobs: int = 1,
    on_done: Callable[[int, int], None] | None = None,
) -> Screening:  # fmt: skip
    """Find the settings of a study's space that matter; `screening.json` in its folder holds them.

    Args:
        tuner: The study.
        points: From how many points settings are moved: the default and others near it.
        instances: On how many of its instances, of different scenes where there are so many.
        jobs: Runs at a time.
        on_done: Called with the number of finished configurations and of all.

    Raises:
        StudyError: See `screening.screen`.
    """
    chosen = tuner.design.tune[:instances]
    objectives = list(dict.fromkeys([*tuner.objectives, ACCURACY]))

    def run(values: Mapping[str, Scalar]) -> Outcomes:
        return tuner.evaluate({**tuner.spec.space.fixed, **values}, chosen)

    steps = plan(tuner.space, tuner.base, points, tuner.spec.sampler_seed)
    screening = screen(steps, run, objectives, jobs=jobs, on_done=on_done)
    write_atomic(tuner.folder / SCREENING_FILE, screening.to_json())
    return screening
