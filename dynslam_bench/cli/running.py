"""``run`` and ``bench``."""

from __future__ import annotations

import logging
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Annotated, Any, Optional

import typer

from dynslam_bench.cli import options as opts
from dynslam_bench.cli.output import (
    SOME_RUNS_FAILED,
    announce,
    is_interactive,
    json_mode,
    note,
    progress,
    warn,
    write_error,
)
from dynslam_bench.cli.runs import drift_note, recording_note, show_files, show_runs, training_scene_note
from dynslam_bench.core.toml import label_text

if TYPE_CHECKING:
    from dynslam_bench.core.errors import DynslamError
    from dynslam_bench.runs import RunEvent, RunRecord, RunSpec, RunStore
    from dynslam_bench.runs.identity import ResolvedRun
    from dynslam_bench.segmentation.networks.checkpoints import Checkpoint

MAX_STORED, MAX_SIMILAR = 100, 5
"""Stored runs, the newest first, among which those of a tracker are looked for, and how many of them are used."""


def add(app: typer.Typer) -> None:
    """Add the verbs."""
    for verb in (run, bench):
        app.command(rich_help_panel=opts.MEASURE, cls=opts.ShortHelp)(verb)


def run(
    tracker: Annotated[
        str,
        typer.Argument(help="Id, replay:FILE, module:Attr or file.py:Attr.", autocompletion=opts.complete_trackers),
    ],
    sequences: Annotated[
        list[str],
        typer.Argument(
            metavar="SEQUENCE...", help="Ids or folders in TUM layout.", autocompletion=opts.complete_sequences
        ),
    ],
    seed: opts.Seeds = None,
    offset: opts.Offsets = None,
    assignments: opts.Assignments = None,
    settings: opts.SettingsFile = None,
    preset: opts.Preset = None,
    results: opts.Results = Path("results"),
    data_root: opts.DataRoot = None,
    camera: opts.Camera = None,
    frames: opts.Frames = None,
    stride: opts.Stride = 1,
    device: opts.Device = "auto",
    threads: opts.Threads = 1,
    jobs: opts.Jobs = 1,
    realtime: opts.Realtime = False,
    drop: opts.Drop = 0.0,
    degrade: opts.Degrade = None,
    cache: opts.Cache = False,
    video: opts.Video = False,
    sheet: opts.Sheet = False,
    rrd: opts.Recording = False,
    save_map: opts.SaveMap = False,
    start_map: opts.StartMap = None,
    localisation_only: opts.LocalisationOnly = False,
    retry: opts.Retry = None,
    label: opts.Label = "",
    time_limit: opts.TimeLimit = None,
    memory_limit: opts.MemoryLimit = None,
    protocol: opts.ProtocolId = "tum-rgbd/v1",
    yes: opts.Yes = False,
    help_all: opts.HelpAll = False,
    as_json: opts.AsJson = False,
) -> None:
    """Run a tracker on sequences; runs that are stored already are not made again."""
    from dynslam_bench.api import checked, make_specs
    from dynslam_bench.runs import Limits

    overrides = opts.gather_settings(assignments, settings)
    overrides |= map_settings(tracker, start_map, localisation_only, overrides)
    specs = make_specs(
        tracker, sequences, settings=overrides, preset=preset, seeds=seed or [0], offsets=offset or [0],
        frames=frames, stride=stride, camera=camera, data_root=None if data_root is None else str(data_root),
        device=device, threads=threads, realtime=realtime, drop_share=drop, degrade=parse_strengths(degrade or ()),
        cache=cache, video=video, sheet=sheet, rrd=rrd, save_map=save_map, label=label,
        limits=checked(Limits, time_s=time_limit, memory_mb=memory_limit),
    )  # fmt: skip
    finish(specs, results=results, jobs=jobs, retry=retry or (), protocol=protocol, yes=yes)


def map_settings(
    tracker: str, start_map: Path | None, localisation_only: bool, overrides: Mapping[str, Any]
) -> dict[str, Any]:
    """The settings of ``--map`` and ``--localisation-only``.

    Raises:
        RunError: The tracker cannot start from a map, or such a setting is given by ``--set``, too.
        PluginError: There is no such tracker.
    """
    from dynslam_bench.core.errors import RunError
    from dynslam_bench.core.settings import field_names
    from dynslam_bench.trackers import TRACKERS

    settings: dict[str, Any] = {} if start_map is None else {"backend.map.file": str(start_map)}
    settings |= {"backend.map.localisation_only": True} if localisation_only else {}
    if settings and "backend.map.file" not in field_names(TRACKERS.get(tracker).settings):
        raise RunError(f"tracker '{tracker}' cannot begin in a map", "the systems on our back end can, e.g. orb-slam2")
    for name in sorted(settings.keys() & overrides.keys()):
        raise RunError(f"'{name}' is given twice", "leave out either the option or the setting")
    return settings


def parse_strengths(assignments: Sequence[str]) -> dict[str, float]:
    """Strengths of `DegradeFrames` by kind.

    Raises:
        SettingsError: An assignment is not of the form NAME=VALUE, or its value no number.
    """
    from dynslam_bench.core.errors import SettingsError
    from dynslam_bench.core.settings import parse_assignments

    strengths = {}
    for kind, text in parse_assignments(assignments).items():
        try:
            strengths[kind] = float(text)
        except ValueError:
            hint = "for example --degrade blur=0.5"
            raise SettingsError(f"strength '{text}' of '{kind}' is no number", hint) from None
    return strengths


def bench(
    suite: Annotated[
        str,
        typer.Argument(
            help="demo, dynamic, dynamic-full, objects, real, robustness, smoke, or a TOML file.",
            autocompletion=opts.complete_suites,
        ),
    ],
    results: opts.Results = Path("results"),
    data_root: opts.DataRoot = None,
    tracker: opts.Trackers = None,
    seed: opts.Seeds = None,
    offset: opts.Offsets = None,
    frames: opts.Frames = None,
    device: opts.Device = "auto",
    threads: Annotated[Optional[int], typer.Option(min=1, help="Threads of a run.")] = None,  # noqa: UP045
    jobs: opts.Jobs = 1,
    scheduler: opts.Scheduler = None,
    retry: opts.Retry = None,
    time_limit: opts.TimeLimit = None,
    memory_limit: opts.MemoryLimit = None,
    protocol: opts.ProtocolId = "tum-rgbd/v1",
    yes: opts.Yes = False,
    help_all: opts.HelpAll = False,
    as_json: opts.AsJson = False,
) -> None:
    """Run a suite: every tracker on every sequence with every seed; a second call continues an interrupted one."""
    from dynslam_bench.api import checked
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
    given = {"time_s": time_limit, "memory_mb": memory_limit}
    changes = {name: value for name, value in given.items() if value is not None}
    specs = [
        spec.model_copy(update={"limits": checked(Limits, **(spec.limits.model_dump() | changes))}) for spec in specs
    ]
    finish(specs, results=results, jobs=jobs, retry=retry or (), protocol=protocol, yes=yes, scheduler=scheduler)


def finish(
    specs: Sequence[RunSpec],
    *,
    results: Path,
    jobs: int,
    retry: Sequence[str],
    protocol: str,
    yes: bool,
    scheduler: str | None = None,
) -> None:
    """Make runs, show them, and exit with 3 if some failed, were lost or cannot be made, or lack a requested map."""
    from dynslam_bench.runs import RunStore
    from dynslam_bench.runs.running import pictures_asked
    from dynslam_bench.segmentation.build_segmenter import NetworkNotFetched
    from dynslam_bench.segmentation.networks.checkpoints import fetch_checkpoint
    from dynslam_bench.slam.map_files import MAP_FILE

    store = RunStore(results)
    reused: set[str] = set()
    faults: list[str] = []
    how: dict[str, Any] = {"jobs": jobs, "retry": retry, "protocol": protocol, "scheduler": scheduler}
    how |= {"reused": reused, "faults": faults}
    try:
        records = make_runs(specs, store, **how)
    except NetworkNotFetched as error:  # raised before the first run
        if not (yes or confirm_fetch(error.checkpoint)):
            raise
        fetch_checkpoint(error.checkpoint)
        records = make_runs(specs, store, **how)
    if not records:
        raise typer.Exit(1)
    show_runs(records, store, protocol, reused)
    missing = show_files(records, store, pictures_asked(specs[0]))
    new = [record for record in records if record.run_id not in reused]
    for caution in filter(None, (training_scene_note(records), drift_note(new, store))):
        note(caution)
    unscored = [record for record in records if not record.sequence.ground_truth and not record.failed]
    for record in unscored[:1]:
        path = store.folder(record.run_id) / "trajectory_online.txt"
        announce(f"{record.sequence.id} has no ground truth, so nothing is scored; the estimated trajectory: {path}")
    if not json_mode() and (fault := recording_note(specs, records, store, protocol)):
        announce(fault)
    note(f"{len(records)} runs in {store.root}; report them with: dynslam-bench report {results}")
    if faults or MAP_FILE in missing or any(record.failed or record.status == "lost" for record in records):
        raise typer.Exit(SOME_RUNS_FAILED)


def confirm_fetch(checkpoint: Checkpoint) -> bool:
    """Ask on a terminal whether a network may be downloaded; elsewhere the answer is no."""
    from dynslam_bench.core.folders import weights_folder

    if not is_interactive():
        return False
    warn(
        f"Masks of people need the network '{checkpoint.id}': {checkpoint.megabytes} MB from {checkpoint.url} "
        f"({checkpoint.license}, {checkpoint.trained_on}), kept in {weights_folder()}."
    )
    return typer.confirm("Download it?", default=True, err=True)


def event_text(event: RunEvent) -> str:
    """Tracker, sequence and progress of a run, for a progress bar."""
    text = f"{label_text(event.spec.tracker)} on {label_text(event.spec.sequence)}"
    if event.kind != "progress" or event.partial is None:
        return text
    return f"{text}, frame {event.partial['frames_done']} of {event.partial['frames']}"


def make_runs(
    specs: Sequence[RunSpec],
    store: RunStore,
    *,
    jobs: int,
    retry: Sequence[str] = (),
    protocol: str = "tum-rgbd/v1",
    scheduler: str | None = None,
    reused: set[str] | None = None,
    faults: list[str] | None = None,
) -> list[RunRecord]:
    """`run_many` with a progress bar.

    The ids of runs that were stored already are added to `reused`. An error of a run that cannot be made is written
    once and added to `faults`; without `faults` the first one is raised when all other runs are stored.
    """
    from dynslam_bench.runs import run_many

    stored_ids = set[str]() if reused is None else reused
    with progress(f"{len(specs)} run{'s' * (len(specs) != 1)}") as advance:
        shares: dict[str, float] = {}

        def on_event(event: RunEvent) -> None:
            if event.kind == "progress" and event.partial is not None:
                shares[event.run_id] = event.partial["frames_done"] / max(event.partial["frames"], 1)
            elif event.record is not None:
                shares[event.run_id] = 1.0
                stored_ids.update({event.run_id} if event.kind == "reused" else ())
                note(event.record.describe() + (" (stored)" if event.kind == "reused" else ""))
            advance(sum(shares.values()), event.total, event_text(event))

        def on_fault(_: RunSpec, error: DynslamError) -> None:
            if faults is not None and str(error) not in faults:
                faults.append(str(error))
                write_error(error)

        return run_many(
            specs,
            results=store,
            jobs=jobs,
            executor=None if scheduler is None else dask_executor(scheduler),
            retry=tuple(retry),
            on_plan=lambda runs: announce(describe_plan(runs, store, jobs)),
            on_event=on_event,
            protocol=protocol,
            on_fault=None if faults is None else on_fault,
        )


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
        logging.getLogger("distributed").setLevel(logging.CRITICAL + 1)  # it logs a lost scheduler with a traceback
        return Client(address, timeout="10s").get_executor()
    except (OSError, ValueError) as error:
        raise RunError(f"no Dask scheduler answers at {address}: {error}", "for example tcp://host:8786") from error


def describe_plan(runs: Collection[ResolvedRun], store: RunStore, jobs: int) -> str:
    """How many frames will be tracked, and the expected time by stored runs of the same trackers."""
    from dynslam_bench.runs.running import PROGRESS_EVERY

    frames = sum(len(run.sequence) for run in runs)
    text = f"{len(runs)} run{'s' * (len(runs) != 1)}, {frames} frames"
    times = frame_times(runs, store)
    timed = [run for run in runs if _kind(run) in times]
    if not timed:
        later = f"; how long it takes is known after the first {PROGRESS_EVERY}" if frames > PROGRESS_EVERY else ""
        return text + later
    expected_s = sum(len(run.sequence) * times[_kind(run)] for run in timed) / min(jobs, len(runs))
    rate = " to ".join(dict.fromkeys(_duration(end(times.values())) for end in (min, max)))
    some = f" for {len(timed)} of them" if len(timed) < len(runs) else ""
    return f"{text}, about {_duration(expected_s)}{some} (stored runs on this machine took {rate} a frame)"


def frame_times(runs: Collection[ResolvedRun], store: RunStore) -> dict[tuple[str, str], float]:
    """Wall-clock seconds a frame of stored runs on a machine like this: the median by tracker and masks."""
    from dynslam_bench.core.fingerprint import this_machine

    kinds, times = {_kind(run) for run in runs}, dict[tuple[str, str], list[float]]()
    newest = sorted(store.ids(), key=lambda run_id: -store.folder(run_id).stat().st_mtime)
    machine = this_machine()
    for record in filter(None, map(store.get, newest[:MAX_STORED])):
        kind = (record.tracker.id, record.segmentation)
        here = record.machine is not None and (record.machine.cpu, record.machine.cores) == (machine.cpu, machine.cores)
        if kind in kinds and here and record.status in ("ok", "lost") and record.n_processed and record.wall_s:
            times.setdefault(kind, []).append(record.wall_s / record.n_processed)
    return {kind: median(values[:MAX_SIMILAR]) for kind, values in times.items()}


def _kind(run: ResolvedRun) -> tuple[str, str]:
    return run.tracker.id, run.segmentation


def _duration(seconds: float) -> str:
    for unit, size in (("h", 3600.0), ("min", 60.0), ("s", 1.0)):
        if seconds >= 1.5 * size:
            return f"{seconds / size:.2g} {unit}" if seconds < 10 * size else f"{seconds / size:.0f} {unit}"
    return f"{1000 * seconds:.0f} ms"
