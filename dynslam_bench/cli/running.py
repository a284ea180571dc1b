"""``run`` and ``bench``."""

from __future__ import annotations

import logging
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Annotated, Any, Optional, TypeVar

import typer

from dynslam_bench.cli import options as completion
from dynslam_bench.cli.options import (
    MEASURE,
    AsJson,
    Assignments,
    Cache,
    Camera,
    DataRoot,
    Degrade,
    Device,
    Drop,
    Frames,
    Jobs,
    Label,
    LocalisationOnly,
    MemoryLimit,
    Offsets,
    Preset,
    ProtocolId,
    Realtime,
    Recording,
    Results,
    Retry,
    SaveMap,
    Scheduler,
    Seeds,
    SettingsFile,
    Sheet,
    StartMap,
    Stride,
    Threads,
    TimeLimit,
    Trackers,
    Video,
    Yes,
    gather_settings,
)
from dynslam_bench.cli.output import SOME_RUNS_FAILED, announce, can_ask, complain, complain_of, note, progress
from dynslam_bench.cli.runs import drift_note, recording_note, seen_note, show_pictures, show_runs
from dynslam_bench.core.toml import label_text

if TYPE_CHECKING:
    from dynslam_bench.core.errors import DynslamError
    from dynslam_bench.core.records import Record
    from dynslam_bench.runs import RunEvent, RunRecord, RunSpec, RunStore
    from dynslam_bench.runs.identity import ResolvedRun
    from dynslam_bench.segmentation.networks.checkpoints import Checkpoint


R = TypeVar("R", bound="Record")


def add(app: typer.Typer) -> None:
    """Add the verbs."""
    app.command(rich_help_panel=MEASURE)(run)
    app.command(rich_help_panel=MEASURE)(bench)


def run(
    tracker: Annotated[
        str,
        typer.Argument(help="Id, replay:FILE, module:Attr or file.py:Attr.", autocompletion=completion.trackers),
    ],
    sequences: Annotated[
        list[str],
        typer.Argument(
            metavar="SEQUENCE...", help="Ids or folders in TUM layout.", autocompletion=completion.sequences
        ),
    ],
    seed: Seeds = None,
    offset: Offsets = None,
    assignments: Assignments = None,
    settings: SettingsFile = None,
    preset: Preset = None,
    results: Results = Path("results"),
    data_root: DataRoot = None,
    camera: Camera = None,
    frames: Frames = None,
    stride: Stride = 1,
    device: Device = "auto",
    threads: Threads = 1,
    jobs: Jobs = 1,
    realtime: Realtime = False,
    drop: Drop = 0.0,
    degrade: Degrade = None,
    cache: Cache = False,
    video: Video = False,
    sheet: Sheet = False,
    rrd: Recording = False,
    save_map: SaveMap = False,
    start_map: StartMap = None,
    localisation_only: LocalisationOnly = False,
    retry: Retry = None,
    label: Label = "",
    time_limit: TimeLimit = None,
    memory_limit: MemoryLimit = None,
    protocol: ProtocolId = "tum-rgbd/v1",
    yes: Yes = False,
    as_json: AsJson = False,
) -> None:
    """Run a tracker on sequences; runs that are stored already are not made again."""
    from dynslam_bench.runs import Limits, RunSpec

    given = gather_settings(assignments, settings, {} if preset is None else preset_of(tracker, preset))
    given |= map_settings(tracker, start_map, localisation_only, given)
    asked: dict[str, Any] = {"tracker": tracker, "settings": given}
    asked |= {"frames": frames, "stride": stride, "camera": camera}
    asked |= {"data_root": None if data_root is None else str(data_root), "device": device, "threads": threads}
    asked |= {"realtime": realtime, "drop_share": drop, "degrade": parse_strengths(degrade or ()), "cache": cache}
    asked |= {"video": video, "sheet": sheet, "rrd": rrd, "save_map": save_map, "label": label}
    asked |= {"limits": checked(Limits, time_s=time_limit, memory_mb=memory_limit)}
    specs = [
        checked(RunSpec, sequence=sequence, seed=number, offset=skipped, **asked)
        for sequence in sequences
        for number in (seed or [0])
        for skipped in (offset or [0])
    ]
    finish(specs, results=results, jobs=jobs, retry=retry or (), protocol=protocol, yes=yes, as_json=as_json)


def checked(kind: type[R], **values: Any) -> R:
    """A record of values that come from the command line.

    Raises:
        RunError: One does not fit; names it.
    """
    from pydantic import ValidationError

    from dynslam_bench.core.errors import RunError

    try:
        return kind(**values)
    except ValidationError as error:
        first = error.errors()[0]
        name = ".".join(map(str, first["loc"]))
        raise RunError(f"{name} is {first['input']!r}", first["msg"].lower()) from None


def map_settings(
    tracker: str, start_map: Path | None, localisation_only: bool, given: Mapping[str, Any]
) -> dict[str, Any]:
    """The settings that ``--map`` and ``--localisation-only`` stand for, beside those that are given otherwise.

    Raises:
        RunError: The tracker begins in no map of ours, or such a setting is given otherwise, too.
        PluginError: There is no such tracker.
    """
    from dynslam_bench.core.errors import RunError
    from dynslam_bench.core.settings import field_names
    from dynslam_bench.trackers import TRACKERS

    settings: dict[str, Any] = {} if start_map is None else {"backend.map.file": str(start_map)}
    settings |= {"backend.map.localisation_only": True} if localisation_only else {}
    if settings and "backend.map.file" not in field_names(TRACKERS.get(tracker).settings):
        raise RunError(f"tracker '{tracker}' cannot begin in a map", "the systems on our back end can, e.g. orb-slam2")
    for name in sorted(settings.keys() & given.keys()):
        raise RunError(f"'{name}' is given twice", "leave out either the option or the setting")
    return settings


def preset_of(tracker: str, preset: str) -> dict[str, Any]:
    """The settings of a tracker's preset.

    Raises:
        SettingsError: There is no such preset.
        PluginError: There is no such tracker.
    """
    from dynslam_bench.core.errors import SettingsError, did_you_mean
    from dynslam_bench.trackers import TRACKERS

    presets = TRACKERS.get(tracker).presets
    if preset not in presets:
        raise SettingsError(f"tracker '{tracker}' has no preset '{preset}'", did_you_mean(preset, presets))
    return dict(presets[preset])


def parse_strengths(assignments: Sequence[str]) -> dict[str, float]:
    """Strengths of `DegradeFrames` by kind.

    Raises:
        SettingsError: An assignment is none, or its value no number.
    """
    from dynslam_bench.core.errors import SettingsError
    from dynslam_bench.core.settings import parse_assignments

    strengths = {}
    for kind, text in parse_assignments(assignments).items():
        try:
            strengths[kind] = float(text)
        except ValueError:
            raise SettingsError(
                f"strength '{text}' of '{kind}' is no number", "for example --degrade blur=0.5"
            ) from None
    return strengths


def bench(
    suite: Annotated[
        str,
        typer.Argument(
            help="demo, dynamic, dynamic-full, objects, real, robustness, smoke, or a TOML file.",
            autocompletion=completion.suites,
        ),
    ],
    results: Results = Path("results"),
    data_root: DataRoot = None,
    tracker: Trackers = None,
    seed: Seeds = None,
    offset: Offsets = None,
    frames: Frames = None,
    device: Device = "auto",
    threads: Annotated[Optional[int], typer.Option(min=1, help="Threads of a run.")] = None,  # noqa: UP045
    jobs: Jobs = 1,
    scheduler: Scheduler = None,
    retry: Retry = None,
    time_limit: TimeLimit = None,
    memory_limit: MemoryLimit = None,
    protocol: ProtocolId = "tum-rgbd/v1",
    yes: Yes = False,
    as_json: AsJson = False,
) -> None:
    """Run a suite: every tracker on every sequence with every seed; calling it again goes on where it stopped."""
    from dynslam_bench.runs import Limits
    from dynslam_bench.sequences.catalogue import parse_frames
    from dynslam_bench.suites import load_suite

    specs = load_suite(suite).specs(
        data_root=data_root,
        device=device,
        threads=threads,
        trackers=tuple(tracker or ()),
        seeds=tuple(seed or ()),
        offsets=tuple(offset or ()),
        frames=None if frames is None else parse_frames(frames),
    )
    own = {"time_s": time_limit, "memory_mb": memory_limit}
    changes = {name: value for name, value in own.items() if value is not None}
    limits = {spec.limits: checked(Limits, **(spec.limits.model_dump() | changes)) for spec in specs}
    specs = [spec.model_copy(update={"limits": limits[spec.limits]}) for spec in specs]
    finish(
        specs, results=results, jobs=jobs, retry=retry or (), protocol=protocol, yes=yes, as_json=as_json,
        scheduler=scheduler,
    )  # fmt: skip


def finish(
    specs: Sequence[RunSpec],
    *,
    results: Path,
    jobs: int,
    retry: Sequence[str],
    protocol: str,
    yes: bool,
    as_json: bool,
    scheduler: str | None = None,
) -> None:
    """Make runs, show them, and exit with 3 if some failed, were lost or cannot be made, or lack a map asked for."""
    from dynslam_bench.runs import RunStore
    from dynslam_bench.runs.many import pictures_asked
    from dynslam_bench.segmentation.build_segmenter import NetworkNotFetched
    from dynslam_bench.segmentation.networks.checkpoints import fetch_checkpoint
    from dynslam_bench.slam.map_files import MAP_FILE

    store = RunStore(results)
    reused: set[str] = set()
    faults: list[str] = []
    asked: dict[str, Any] = {"jobs": jobs, "retry": retry, "protocol": protocol, "scheduler": scheduler}
    asked |= {"reused": reused, "faults": faults}
    try:
        records = make_runs(specs, store, **asked)
    except NetworkNotFetched as error:  # raised before the first run
        if not (yes or agreed_to_fetch(error.checkpoint)):
            raise
        fetch_checkpoint(error.checkpoint)
        records = make_runs(specs, store, **asked)
    if not records:
        raise typer.Exit(1)
    show_runs(records, store, protocol, as_json=as_json, reused=reused)
    missing = show_pictures(records, store, pictures_asked(specs[0]), as_json=as_json)
    made = [record for record in records if record.run_id not in reused]  # what is stored already was said then
    for caution in (seen_note(records), drift_note(made, store)):
        if caution:
            note(caution)
    announce_unscored(records, store)
    if not as_json and (fault := recording_note(specs, records, store, protocol)):
        announce(fault)
    note(f"{len(records)} runs in {store.root}; report them with: dynslam-bench report {results}")
    if faults or MAP_FILE in missing or any(record.failed or record.status == "lost" for record in records):
        raise typer.Exit(SOME_RUNS_FAILED)


def announce_unscored(records: Sequence[RunRecord], store: RunStore) -> None:
    """Say of runs on recordings without ground truth why they have no error, and where the first trajectory lies."""
    without = [record for record in records if not record.sequence.ground_truth and not record.failed]
    if without:
        path = store.folder(without[0].run_id) / "trajectory_online.txt"
        announce(
            f"{without[0].sequence.id} has no ground truth, so nothing is scored; the estimated trajectory: {path}"
        )


def agreed_to_fetch(checkpoint: Checkpoint) -> bool:
    """Ask on a terminal whether a network may be downloaded; nobody is asked elsewhere, and nothing is downloaded."""
    from dynslam_bench.core.folders import weights_folder

    if not can_ask():
        return False
    complain(
        f"Masks of people need the network '{checkpoint.id}': {checkpoint.megabytes} MB from {checkpoint.url} "
        f"({checkpoint.license}, {checkpoint.trained_on}), kept in {weights_folder()}."
    )
    return typer.confirm("Download it?", default=True, err=True)


def run_words(event: RunEvent) -> str:
    """What is going on in a run, in words."""
    words = f"{label_text(event.spec.tracker)} on {label_text(event.spec.sequence)}"
    if event.kind != "progress" or event.partial is None:
        return words
    return f"{words}, frame {event.partial['frames_done']} of {event.partial['frames']}"


def make_runs(
    specs: Sequence[RunSpec],
    store: Any,
    *,
    jobs: int,
    retry: Sequence[str] = (),
    protocol: str = "tum-rgbd/v1",
    scheduler: str | None = None,
    reused: set[str] | None = None,
    faults: list[str] | None = None,
) -> list[RunRecord]:
    """`run_many` with a progress bar.

    The ids of runs that were stored already are added to `reused`. What is wrong with runs that cannot be made is said
    once and added to `faults`; without `faults` the first of them is raised when all others are stored.
    """
    from dynslam_bench.runs import run_many

    with progress(f"{len(specs)} run{'s' * (len(specs) != 1)}") as advance:
        shares: dict[str, float] = {}

        def told(event: RunEvent) -> None:
            if event.kind == "progress" and event.partial is not None:
                shares[event.run_id] = event.partial["frames_done"] / max(event.partial["frames"], 1)
            elif event.kind in ("finished", "reused"):
                shares[event.run_id] = 1.0
                if event.kind == "reused" and reused is not None:
                    reused.add(event.run_id)
                if event.record is not None:
                    note(event.record.describe() + (" (stored)" if event.kind == "reused" else ""))
            advance(sum(shares.values()), event.total, run_words(event))

        def fault(_: RunSpec, error: DynslamError) -> None:
            if faults is not None and str(error) not in faults:
                faults.append(str(error))
                complain_of(error)

        def planned(runs: Collection[ResolvedRun]) -> None:
            announce(plan_words(runs, store, jobs))

        with_executor: dict[str, Any] = {} if faults is None else {"on_fault": fault}
        if scheduler is not None:
            with_executor["executor"] = dask_executor(scheduler)
        return run_many(
            specs, results=store, jobs=jobs, retry=tuple(retry), on_plan=planned, on_event=told, protocol=protocol,
            **with_executor,
        )  # fmt: skip


def dask_executor(address: str) -> Any:
    """The executor of a Dask cluster.

    Raises:
        RunError: ``distributed`` is not installed, or the scheduler does not answer.
    """
    from dynslam_bench.core.errors import RunError
    from dynslam_bench.core.version import install_hint

    try:
        from distributed import Client
    except ImportError as error:
        raise RunError("--scheduler needs the package distributed", install_hint("cluster")) from error
    try:
        logging.getLogger("distributed").setLevel(logging.CRITICAL + 1)  # it tells of a lost scheduler by a traceback
        return Client(address, timeout="10s").get_executor()
    except (OSError, ValueError) as error:
        raise RunError(f"no Dask scheduler answers at {address}: {error}", "for example tcp://host:8786") from error


# How many frames runs have, and how long they take by what stored runs of the same trackers took here.

MOST_LOOKED_AT, MOST_ALIKE = 100, 5
"""Stored runs, the newest first, that are looked through for those of a tracker, and how many of these count."""


def plan_words(runs: Collection[ResolvedRun], store: RunStore, jobs: int) -> str:
    """How many frames are to be tracked, and how long that takes by what stored runs of the same trackers took."""
    from dynslam_bench.runs.one import PROGRESS_EVERY

    frames = sum(len(run.sequence) for run in runs)
    words = f"{len(runs)} run{'s' * (len(runs) != 1)}, {frames} frames"
    times = frame_times(runs, store)
    known = [run for run in runs if _kind(run) in times]
    if not known:
        later = f"; how long it takes is known after the first {PROGRESS_EVERY}" if frames > PROGRESS_EVERY else ""
        return words + later
    expected_s = sum(len(run.sequence) * times[_kind(run)] for run in known) / min(jobs, len(runs))
    low, high = _seconds(min(times.values())), _seconds(max(times.values()))
    rate = low if low == high else f"{low} to {high}"
    some = f" for {len(known)} of them" if len(known) < len(runs) else ""
    return f"{words}, about {_seconds(expected_s)}{some} (stored runs on this machine took {rate} a frame)"


def frame_times(runs: Collection[ResolvedRun], store: RunStore) -> dict[tuple[str, str], float]:
    """Seconds of wall-clock time a frame of stored runs on a machine like this: the median by tracker and masks."""
    from dynslam_bench.core.fingerprint import this_machine

    wanted, times = {_kind(run) for run in runs}, dict[tuple[str, str], list[float]]()
    newest = sorted(store.ids(), key=lambda run_id: -store.folder(run_id).stat().st_mtime)
    machine = this_machine()
    for record in filter(None, map(store.get, newest[:MOST_LOOKED_AT])):
        kind = (record.tracker.id, record.segmentation)
        here = record.machine is not None and (record.machine.cpu, record.machine.cores) == (machine.cpu, machine.cores)
        if kind in wanted and here and record.status in ("ok", "lost") and record.n_processed and record.wall_s:
            times.setdefault(kind, []).append(record.wall_s / record.n_processed)
    return {kind: median(found[:MOST_ALIKE]) for kind, found in times.items()}


def _kind(run: ResolvedRun) -> tuple[str, str]:
    return run.tracker.id, run.segmentation


def _seconds(value: float) -> str:
    for unit, seconds in (("h", 3600.0), ("min", 60.0), ("s", 1.0)):
        if value >= 1.5 * seconds:
            return f"{value / seconds:.2g} {unit}" if value < 10 * seconds else f"{value / seconds:.0f} {unit}"
    return f"{1000 * value:.0f} ms"
