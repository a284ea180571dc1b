"""``run`` and ``bench``."""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from datetime import timedelta
from functools import partial
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Annotated, Any, Optional

import typer

from dynslam_bench import runs
from dynslam_bench.cli import options as opts
from dynslam_bench.cli.output import (
    SOME_RUNS_FAILED,
    announce,
    is_interactive,
    json_mode,
    note,
    present,
    progress,
    table,
    warn,
    write_error,
)
from dynslam_bench.cli.runs import recording_note, show_files, show_runs, training_scene_note
from dynslam_bench.core import (
    DynslamError,
    RunError,
    call_periodically,
    label_text,
    weights_folder,
)
from dynslam_bench.core.folders import kernel_files

if TYPE_CHECKING:
    from dynslam_bench.api import RunResult
    from dynslam_bench.segmentation.networks.checkpoints import Checkpoint


def run(
    tracker: Annotated[
        str,
        typer.Argument(
            help="Id, replay:FILE, module:Attr or file.py:Attr.",
            autocompletion=opts.complete_trackers,
        ),
    ],
    sequences: Annotated[
        list[str],
        typer.Argument(
            metavar="SEQUENCE...",
            help="Ids or folders in TUM layout.",
            autocompletion=opts.complete_sequences,
        ),
    ],
    seed: opts.Seeds = None,
    offset: opts.Offsets = None,
    set_options: opts.Assignments = None,
    settings_file: opts.SettingsFile = None,
    preset: Annotated[
        Optional[str],
        typer.Option(
            "--preset",
            help="A preset of the tracker.",
            rich_help_panel=opts.SETTINGS,
            autocompletion=opts.complete_presets,
        ),
    ] = None,
    results: opts.Results = Path("results"),
    data_root: opts.DataRoot = None,
    camera: opts.Camera = None,
    frames: opts.Frames = None,
    stride: opts.Stride = 1,
    device: opts.Device = "auto",
    threads: opts.Threads = 1,
    jobs: opts.Jobs = 1,
    realtime: Annotated[
        bool,
        typer.Option(
            "--realtime", help="Drop frames while the tracker is busy.", rich_help_panel=opts.FRAMES
        ),
    ] = False,
    drop: Annotated[
        float,
        typer.Option(
            "--drop",
            min=0.0,
            max=0.99,
            help="Drop this share of the frames at random.",
            rich_help_panel=opts.FRAMES,
        ),
    ] = 0.0,
    degrade: Annotated[
        Optional[list[str]],
        typer.Option(
            "--degrade",
            metavar="KIND=STRENGTH",
            help="Spoil the frames: lighting, glare, shadow, blur, noise, depth_noise; repeatable.",
            rich_help_panel=opts.FRAMES,
        ),
    ] = None,
    cache: Annotated[
        bool,
        typer.Option(
            "--cache",
            help="Take features and masks from the stage cache.",
            rich_help_panel=opts.MACHINE,
        ),
    ] = False,
    snapshots: opts.Snapshots = False,
    video: Annotated[
        bool,
        typer.Option(
            "--video", help="Write video.webm beside the run.", rich_help_panel=opts.OUTPUT
        ),
    ] = False,
    sheet: Annotated[
        bool,
        typer.Option(
            "--sheet",
            help="Write sheet.png beside the run: input, frames, keyframes, map, track.",
            rich_help_panel=opts.OUTPUT,
        ),
    ] = False,
    rrd: Annotated[
        bool,
        typer.Option(
            "--rrd",
            help="Write recording.rrd beside the run, for rerun's viewer.",
            rich_help_panel=opts.OUTPUT,
        ),
    ] = False,
    save_map: Annotated[
        bool,
        typer.Option(
            "--save-map",
            help="Write map.npz beside the run, for --map of a later one.",
            rich_help_panel=opts.OUTPUT,
        ),
    ] = False,
    start_map: Annotated[
        Optional[Path],
        typer.Option(
            "--map",
            metavar="FILE",
            help="Begin in the map of an earlier run (--save-map).",
            rich_help_panel=opts.SETTINGS,
        ),
    ] = None,
    localisation_only: Annotated[
        bool,
        typer.Option(
            "--localisation-only",
            help="Leave that map as it is: poses alone.",
            rich_help_panel=opts.SETTINGS,
        ),
    ] = False,
    retry: opts.Retry = None,
    label: Annotated[
        str,
        typer.Option(
            "--label",
            help="Name in tables, in place of the tracker's.",
            rich_help_panel=opts.SETTINGS,
        ),
    ] = "",
    time_limit: opts.TimeLimit = None,
    memory_limit: opts.MemoryLimit = None,
    protocol: Annotated[
        Optional[str],
        typer.Option(
            "--protocol",
            help="How to evaluate; default tum-rgbd/v1, of a monocular tracker its Sim(3) variant.",
            rich_help_panel=opts.OUTPUT,
            autocompletion=opts.names_of("evaluation.protocol:PROTOCOLS"),
        ),
    ] = None,
    yes: opts.Yes = False,
    help_all: opts.HelpAll = False,
    as_json: opts.AsJson = False,
) -> None:
    """Run a tracker on sequences; runs that are stored already are not made again."""
    from dynslam_bench.api import make_specs, run_specs, validated_record

    # settings: --settings below --set, and the two options that stand for settings above both
    overrides = opts.gather_settings(set_options, settings_file)
    if start_map is not None:
        overrides["backend.map.file"] = str(start_map)
    if localisation_only:
        overrides["backend.map.localisation_only"] = True
    # one specification for each sequence, seed and offset
    specs = make_specs(
        tracker,
        sequences,
        settings=overrides,
        preset=preset,
        seeds=seed or [0],
        offsets=offset or [0],
        frames=frames,
        stride=stride,
        camera=camera,
        data_root=None if data_root is None else str(data_root),
        device=device,
        threads=threads,
        realtime=realtime,
        drop_share=drop,
        cache=cache,
        video=video,
        sheet=sheet,
        snapshots=snapshots,
        rrd=rrd,
        save_map=save_map,
        label=label,
        degrade=opts.gather_settings(degrade),
        limits=validated_record(runs.Limits, time_s=time_limit, memory_mb=memory_limit),
    )
    # made, then shown with their errors
    scored_under = protocol or default_protocol(tracker)
    make_runs = partial(
        run_specs, specs, results=results, jobs=jobs, retry=retry or (), protocol=scored_under
    )
    pictures = runs.requested_files(specs[0])
    make_and_show(make_runs, results, jobs, scored_under, yes, pictures, folders=sequences)


def announce_recording(sequence: str, camera: str | None) -> None:
    """Say what a folder is taken for; nothing of a sequence that is named by an id."""
    from dynslam_bench.sequences import open_sequence

    if not Path(sequence).expanduser().is_dir():
        return
    with suppress(DynslamError):
        for line in getattr(open_sequence(sequence, camera=camera), "taken_for", ()):
            announce(line)


def default_protocol(tracker: str) -> str:
    """The protocol of a tracker's runs where none is named; says so where it is not TUM's."""
    from dynslam_bench.evaluation.protocol import MONOCULAR
    from dynslam_bench.trackers import TRACKERS

    if TRACKERS.get(tracker).sensors != "rgb":
        return "tum-rgbd/v1"
    announce(
        f"'{tracker}' is monocular, its scale is unknown: scored under {MONOCULAR}, which finds the scale"
    )
    return MONOCULAR


def bench(
    suite: Annotated[
        str,
        typer.Argument(
            help="demo, dynamic, dynamic-full, objects, real, robustness, smoke, or a TOML file.",
            autocompletion=opts.names_of("suites:suite_names"),
        ),
    ],
    results: opts.Results = Path("results"),
    data_root: opts.DataRoot = None,
    tracker: Annotated[
        Optional[list[str]],
        typer.Option(
            "--tracker",
            help="Only this tracker, or another one; repeatable.",
            autocompletion=opts.complete_trackers,
        ),
    ] = None,
    seed: opts.Seeds = None,
    offset: opts.Offsets = None,
    frames: opts.Frames = None,
    device: opts.Device = "auto",
    threads: Annotated[Optional[int], typer.Option(min=1, help="Threads of a run.")] = None,
    jobs: opts.Jobs = 1,
    scheduler: Annotated[
        Optional[str],
        typer.Option(
            "--scheduler",
            metavar="ADDRESS",
            help="A Dask scheduler, e.g. tcp://host:8786; its workers make the runs.",
            rich_help_panel=opts.MACHINE,
        ),
    ] = None,
    shard: Annotated[
        str,
        typer.Option(
            metavar="K/N",
            help="Only the K-th of N parts of the runs; see `runs merge`.",
            rich_help_panel=opts.MACHINE,
        ),
    ] = "1/1",
    snapshots: opts.Snapshots = False,
    retry: opts.Retry = None,
    time_limit: opts.TimeLimit = None,
    memory_limit: opts.MemoryLimit = None,
    protocol: opts.ProtocolId = "tum-rgbd/v1",
    yes: opts.Yes = False,
    help_all: opts.HelpAll = False,
    as_json: opts.AsJson = False,
) -> None:
    """Run a suite: every tracker on every sequence with every seed; called again it goes on."""
    from dynslam_bench.api import bench as run_suite
    from dynslam_bench.sequences.catalogue import parse_frames

    make_runs = partial(
        run_suite,
        suite,
        results=results,
        jobs=jobs,
        protocol=protocol,
        scheduler=scheduler,
        retry=retry or (),
        time_limit_s=time_limit,
        memory_limit_mb=memory_limit,
        data_root=data_root,
        device=device,
        threads=threads,
        trackers=tuple(tracker or ()),
        seeds=tuple(seed or ()),
        offsets=tuple(offset or ()),
        frames=None if frames is None else parse_frames(frames),
        snapshots=snapshots,
        shard=parse_shard(shard),
        on_workers=show_workers,
    )
    make_and_show(make_runs, results, jobs, protocol, yes)


def show_workers(rows: Sequence[dict[str, object]]) -> None:
    """Show on standard error what each worker of a scheduler has."""
    if not rows:
        announce("the scheduler has no worker yet")
        return
    columns = list(rows[0])
    announce(table(columns, [list(row.values()) for row in rows]))


def parse_shard(text: str) -> tuple[int, int]:
    """``3/64`` as ``(3, 64)``.

    Raises:
        RunError: It is not written so, or K is not 1 to N.
    """
    match = re.fullmatch(r"([0-9]{1,6})/([0-9]{1,6})", text)
    shard, shards = (int(match[1]), int(match[2])) if match else (0, 0)
    if not 1 <= shard <= shards:
        raise RunError(f"--shard is '{text}'", "write K/N with K from 1 to N, e.g. 3/64")
    return shard, shards


def make_and_show(
    make_runs: Callable[..., list[RunResult]],
    results: Path,
    jobs: int,
    protocol: str,
    yes: bool,
    pictures: Sequence[str] = (),
    folders: Iterable[str] = (),
) -> None:
    """Make runs, show them with their files and what is to be said of them, and end with the exit code.

    Args:
        make_runs: A function of `api` that makes the runs; it takes the callbacks of `WatchedRuns`.
        results: The results folder.
        jobs: Runs at a time.
        protocol: How their errors are evaluated.
        yes: Download the network for masks without asking.
        pictures: Names of the files, maps included, that were asked for beside each run.
        folders: Sequences of which it is said, when their first run begins, what they are taken for.

    Raises:
        Exit: With 1 if none of the runs can be made; with 3 if some failed, were lost, cannot be
            made, or lack a requested map.
    """
    from dynslam_bench.slam.map_files import MAP_FILE

    # make them, with a bar
    store = runs.RunStore(results)
    watched = WatchedRuns(store, jobs, protocol, folders)
    made = make_with_network(watched, make_runs, yes)
    if watched.faults and not made:
        raise typer.Exit(1)
    if not made:
        present([], "this part of the suite holds no runs")
        return

    # the table, the files that were asked for, and what is to be said of the runs
    rows = show_runs((run.record for run in made), store, protocol, watched.reused)
    missing_files = show_files(rows, store, pictures)
    show_cautions(rows, watched)
    counted = f"{len(rows)} run{'s' if len(rows) != 1 else ''}"
    note(f"{counted} in {store.root}; report them with: dynslam-bench report {results}")

    # what scripts see: the exit code
    not_ok = any(row["status"] != "ok" for row in rows)
    if watched.faults or MAP_FILE in missing_files or not_ok:
        raise typer.Exit(SOME_RUNS_FAILED)


def make_with_network(
    watched: WatchedRuns, make_runs: Callable[..., list[RunResult]], yes: bool
) -> list[RunResult]:
    """Make runs; if the network for their masks is not here, download it on consent, and make them then.

    Raises:
        NetworkNotFetched: The user did not agree to the download, or cannot be asked.
    """
    from dynslam_bench.segmentation.build_segmenter import NetworkNotFetched
    from dynslam_bench.segmentation.networks.checkpoints import fetch_checkpoint

    try:
        return watched.make(make_runs)
    except NetworkNotFetched as error:  # raised before the first run
        if not (yes or confirm_fetch(error.checkpoint)):
            raise
        fetch_checkpoint(error.checkpoint)
        return watched.make(make_runs)


def show_cautions(rows: Sequence[dict[str, Any]], watched: WatchedRuns) -> None:
    """Say below the table: scenes of the network's training, a missing ground truth, faults of a recording."""
    if caution := training_scene_note(rows):
        note(caution)
    if missing_truth := no_truth_note(rows, watched.store):
        announce(missing_truth)
    # the check of a recording takes seconds, and `announce` writes nothing with --json
    if not json_mode() and (fault := recording_note(watched.opened, rows)):
        announce(fault)


def no_truth_note(rows: Sequence[dict[str, Any]], store: runs.RunStore) -> str:
    """One line on the first run that tracked but has no error, if its sequence has no ground truth; else empty."""
    # the first that could have an error and has none
    tracked = (row for row in rows if row["status"] in ("ok", "lost"))
    first = next((row for row in tracked if row["ate_rmse_m"] is None), None)
    if first is None or store.read_whole(first["run_id"]).sequence.ground_truth:
        return ""
    path = store.folder(first["run_id"]) / "trajectory_online.txt"
    return f"{first['sequence']} has no ground truth, so nothing is scored; the estimated trajectory: {path}"


def confirm_fetch(checkpoint: Checkpoint) -> bool:
    """Ask on a terminal whether a network may be downloaded; elsewhere the answer is no."""
    if not is_interactive():
        return False
    warn(
        f"Masks of people need the network '{checkpoint.id}': {checkpoint.megabytes} MB from {checkpoint.url} "
        f"({checkpoint.license}, {checkpoint.trained_on}), kept in {weights_folder()}."
    )
    return typer.confirm("Download it?", default=True, err=True)


COMPILED_S = 1.0
"""Interval between two looks for compiled kernels, seconds."""


class WatchedRuns:
    """The events of runs as a progress bar, and what is known of the runs afterwards.

    Args:
        store: Where the runs are stored.
        jobs: Runs at a time.
        protocol: How their errors are evaluated.
        folders: Sequences of which it is said, when their first run begins, what they are taken for.

    Attributes:
        opened: Sequence, data root and camera that were asked for, by the runs' ids.
        reused: Ids of the runs that were stored already.
        faults: Messages of the runs that cannot be made, each of them written once.
    """

    def __init__(
        self, store: runs.RunStore, jobs: int, protocol: str, folders: Iterable[str] = ()
    ) -> None:
        from dynslam_bench.runs.spec import place_of

        self.store = store
        # as the runs name them
        self._to_announce = set(map(place_of, folders)) - {""}
        self.jobs = jobs
        self.protocol = protocol
        self.opened: dict[str, tuple[str, str | None, str | None]] = {}
        self.reused: set[str] = set()
        self.faults: set[str] = set()
        # frames of all runs that are made, of those that have ended, and of running ones
        self._planned = runs.PlannedRuns()
        self._done = 0
        self._running: dict[str, int] = {}
        self._ended_runs = 0
        # the newest event's text, for what is said between events
        self._step = "opening sequences"
        self._kernels_before = set(kernel_files())

    def make(self, make_runs: Callable[..., list[RunResult]]) -> list[RunResult]:
        """Call a function of `api` that makes runs, with a progress bar."""
        with (
            progress("frames") as self._advance,
            call_periodically(COMPILED_S, self._say_what_is_compiled),
        ):
            self._advance(0, None, self._step)
            return make_runs(on_plan=self._plan, on_event=self._event, on_fault=self._fault)

    def _say_what_is_compiled(self) -> None:
        """While no frame is done, how many kernels a system's first run on this machine has compiled."""
        compiled = len(set(kernel_files()) - self._kernels_before)
        if compiled and not self._done and not self._running:
            self._show(f"{self._step}, {compiled} kernels compiled, once")

    def _show(self, step: str) -> None:
        """Show how many frames are tracked, of all that the runs have."""
        done = self._done + sum(self._running.values())
        self._advance(done, self._planned.frames.total() or None, step)

    def _plan(self, plan: runs.PlannedRuns) -> None:
        self._planned = plan
        announce(describe_plan(plan, self.store, self.jobs, self.protocol))

    def _event(self, event: runs.RunEvent) -> None:
        """Count the frames that are tracked, of all that the runs have."""
        spec = event.spec
        if event.kind == "started" and spec.sequence in self._to_announce:
            self._to_announce.remove(spec.sequence)
            announce_recording(spec.sequence, spec.camera)

        if event.record is not None:
            self._running.pop(event.run_id, None)
            if event.kind == "finished":
                self._done += event.record.n_frames
                self._ended_runs += 1
            self._ended(event, event.record)
        elif event.partial is not None:
            self._running[event.run_id] = event.partial["frames_done"]

        self._step = event_text(event)
        if self._planned.runs > 1:
            number = min(self._ended_runs + 1, self._planned.runs)
            self._step = f"run {number} of {self._planned.runs}, {self._step}"
        self._show(self._step)

    def _ended(self, event: runs.RunEvent, record: runs.RunRecord) -> None:
        """Remember what a run was asked to open and whether it was stored, and write a line on it."""
        spec = event.spec
        self.opened[record.run_id] = (spec.sequence, spec.data_root, spec.camera)
        line = record.describe()
        if event.kind == "reused":
            self.reused.add(record.run_id)
            line += " (stored)"
        # a single run is shown in full when it has ended
        if event.total > 1:
            note(line)

    def _fault(self, _: runs.RunSpec, error: DynslamError) -> None:
        if str(error) not in self.faults:
            self.faults.add(str(error))
            write_error(error)


def event_text(event: runs.RunEvent) -> str:
    """Tracker and sequence of a run and what it does, for a progress bar."""
    text = f"{label_text(event.spec.tracker)} on {label_text(event.spec.sequence)}"
    if event.kind == "started":
        # nothing is heard of a run before its first frames
        return f"{text}, starting"
    if event.kind != "progress" or event.partial is None:
        return text
    done = event.partial["frames_done"]
    frames = event.partial["frames"]
    if done < frames:
        return f"{text}, frame {done} of {frames}"
    # all frames are tracked: the rest is writing
    files = ["trajectories", *runs.requested_files(event.spec)]
    return f"{text}, writing {', '.join(files)}"


def describe_plan(plan: runs.PlannedRuns, store: runs.RunStore, jobs: int, protocol: str) -> str:
    """Number of frames to be tracked, and the expected time by this machine's stored runs of the same trackers."""
    from dynslam_bench.core.fingerprint import this_machine  # loads numpy

    plural = "s" if plan.runs != 1 else ""
    text = f"{plan.runs} run{plural}, {plan.frames.total()} frames"

    # time of a frame, by tracker, in the runs that are stored and were made on such a machine
    cpu = this_machine().cpu
    times_ms = defaultdict[str, list[float]](list)
    for row in runs.list_runs(store, protocol)[0]:
        if row["frame_ms"] and row["cpu"] == cpu:
            times_ms[row["tracker"]].append(row["frame_ms"])
    if not plan.frames.keys() <= times_ms.keys():
        return f"{text}; a system's first run on a machine compiles its code for up to a minute"

    # median time of a frame x frames, over the runs that go on at a time
    expected_ms = sum(frames * median(times_ms[tracker]) for tracker, frames in plan.frames.items())
    seconds = round(expected_ms / min(jobs, plan.runs) / 1000)
    return f"{text}, about {timedelta(seconds=seconds)} by the frame times of stored runs"
