"""``run`` and ``bench``."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Optional

import typer

from .options import (
    AsJson,
    Assignments,
    Camera,
    DataRoot,
    Device,
    Frames,
    Jobs,
    MemoryLimit,
    Offsets,
    ProtocolId,
    Results,
    Retry,
    Seeds,
    SettingsFile,
    Stride,
    Threads,
    TimeLimit,
    gather_settings,
)
from .output import SOME_RUNS_FAILED, note, progress, write_json, write_table

if TYPE_CHECKING:
    from dynslam_bench.runs import RunRecord, RunSpec


def add(app: typer.Typer) -> None:
    """Add the verbs."""
    app.command()(run)
    app.command()(bench)


def run(
    tracker: Annotated[str, typer.Argument(help="Id, replay:FILE, module:Attr or file.py:Attr.")],
    sequences: Annotated[list[str], typer.Argument(metavar="SEQUENCE...", help="Ids or folders in TUM layout.")],
    seed: Seeds = None,
    offset: Offsets = None,
    assignments: Assignments = None,
    settings: SettingsFile = None,
    preset: Annotated[Optional[str], typer.Option(help="A preset of the tracker.")] = None,  # noqa: UP045
    results: Results = Path("results"),
    data_root: DataRoot = None,
    camera: Camera = None,
    frames: Frames = None,
    stride: Stride = 1,
    device: Device = "auto",
    threads: Threads = 1,
    jobs: Jobs = 1,
    realtime: Annotated[bool, typer.Option("--realtime", help="Drop frames while the tracker is busy.")] = False,
    drop: Annotated[float, typer.Option(min=0.0, max=0.99, help="Drop this share of the frames at random.")] = 0.0,
    degrade: Annotated[
        Optional[list[str]],  # noqa: UP045
        typer.Option(
            metavar="KIND=STRENGTH", help="Spoil the images: lighting, glare, shadow, blur, noise; repeatable."
        ),
    ] = None,
    cache: Annotated[bool, typer.Option("--cache", help="Take features and masks from the stage cache.")] = False,
    video: Annotated[bool, typer.Option("--video", help="Write video.mp4 beside the run.")] = False,
    sheet: Annotated[
        bool, typer.Option("--sheet", help="Write sheet.png beside the run: input, frames, keyframes, map, track.")
    ] = False,
    retry: Retry = None,
    label: Annotated[str, typer.Option(help="Name in tables, in place of the tracker's.")] = "",
    time_limit: TimeLimit = None,
    memory_limit: MemoryLimit = None,
    protocol: ProtocolId = "tum-rgbd/v1",
    as_json: AsJson = False,
) -> None:
    """Run a tracker on sequences; runs that are stored already are not made again."""
    from dynslam_bench.core.errors import SettingsError, did_you_mean
    from dynslam_bench.runs import Limits, RunSpec
    from dynslam_bench.sequences.catalogue import parse_frames
    from dynslam_bench.trackers import TRACKERS

    chosen: dict[str, Any] = {}
    if preset is not None:
        presets = TRACKERS.get(tracker).presets
        if preset not in presets:
            raise SettingsError(f"tracker '{tracker}' has no preset '{preset}'", did_you_mean(preset, presets))
        chosen = dict(presets[preset])
    overrides = gather_settings(assignments, settings, chosen)
    part = None if frames is None else parse_frames(frames)
    strengths = parse_strengths(degrade or ())
    specs = [
        RunSpec(
            tracker=tracker, sequence=sequence, settings=overrides, frames=part, offset=skipped, stride=stride,
            seed=number, device=device, threads=threads, realtime=realtime, video=video, sheet=sheet, camera=camera,
            cache=cache, label=label, drop_share=drop, degrade=strengths,
            data_root=None if data_root is None else str(data_root),
            limits=Limits(time_s=time_limit, memory_mb=memory_limit),
        )
        for sequence in sequences
        for number in (seed or [0])
        for skipped in (offset or [0])
    ]  # fmt: skip
    finish(specs, results=results, jobs=jobs, retry=retry or (), protocol=protocol, as_json=as_json)


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
    suite: Annotated[str, typer.Argument(help="dynamic, dynamic-full, real, robustness, or a TOML file.")],
    results: Results = Path("results"),
    data_root: DataRoot = None,
    tracker: Annotated[
        Optional[list[str]],  # noqa: UP045
        typer.Option("--tracker", help="Only this tracker, or another one; repeatable."),
    ] = None,
    seed: Seeds = None,
    offset: Offsets = None,
    frames: Frames = None,
    device: Device = "auto",
    threads: Annotated[Optional[int], typer.Option(min=1, help="Threads of a run.")] = None,  # noqa: UP045
    jobs: Jobs = 1,
    scheduler: Annotated[
        Optional[str],  # noqa: UP045
        typer.Option(metavar="ADDRESS", help="A Dask scheduler, e.g. tcp://host:8786; its workers make the runs."),
    ] = None,
    retry: Retry = None,
    time_limit: TimeLimit = None,
    memory_limit: MemoryLimit = None,
    protocol: ProtocolId = "tum-rgbd/v1",
    as_json: AsJson = False,
) -> None:
    """Run a suite: every tracker on every sequence with every seed; calling it again goes on where it stopped."""
    from dynslam_bench.sequences.catalogue import parse_frames
    from dynslam_bench.suites import load_suite

    specs = load_suite(suite).specs(
        data_root=data_root, device=device, threads=threads, trackers=tuple(tracker or ()), seeds=tuple(seed or ()),
        offsets=tuple(offset or ()), frames=None if frames is None else parse_frames(frames),
    )  # fmt: skip
    own = {"time_s": time_limit, "memory_mb": memory_limit}
    changes = {name: value for name, value in own.items() if value is not None}
    specs = [spec.model_copy(update={"limits": spec.limits.model_copy(update=changes)}) for spec in specs]
    finish(
        specs, results=results, jobs=jobs, retry=retry or (), protocol=protocol, as_json=as_json, scheduler=scheduler
    )


def finish(
    specs: Sequence[RunSpec],
    *,
    results: Path,
    jobs: int,
    retry: Sequence[str],
    protocol: str,
    as_json: bool,
    scheduler: str | None = None,
) -> None:
    """Make runs, show them, and exit with 3 if some failed."""
    from dynslam_bench.runs import RunStore

    store = RunStore(results)
    reused: set[str] = set()
    records = make_runs(specs, store, jobs=jobs, retry=retry, protocol=protocol, scheduler=scheduler, reused=reused)
    show_runs(records, store, protocol, as_json=as_json, reused=reused)
    note(f"{len(records)} runs in {store.root}; report them with: dynslam-bench report {results}")
    if any(record.failed for record in records):
        raise typer.Exit(SOME_RUNS_FAILED)


def make_runs(
    specs: Sequence[RunSpec],
    store: Any,
    *,
    jobs: int,
    retry: Sequence[str] = (),
    protocol: str = "tum-rgbd/v1",
    scheduler: str | None = None,
    reused: set[str] | None = None,
) -> list[RunRecord]:
    """`run_many` with a progress bar; the ids of runs that were stored already are added to `reused`."""
    from dynslam_bench.runs import RunEvent, run_many

    with progress(f"{len(specs)} runs") as advance:
        shares: dict[str, float] = {}

        def told(event: RunEvent) -> None:
            what = f"{event.spec.tracker} on {event.spec.sequence}"
            if event.kind == "progress" and event.partial is not None:
                done, frames = event.partial["frames_done"], event.partial["frames"]
                shares[event.run_id] = done / max(frames, 1)
                what = f"{event.spec.tracker} on {event.spec.sequence}, frame {done} of {frames}"
            elif event.kind in ("finished", "reused"):
                shares[event.run_id] = 1.0
                if event.kind == "reused" and reused is not None:
                    reused.add(event.run_id)
                if event.record is not None:
                    note(event.record.describe() + (" (stored)" if event.kind == "reused" else ""))
            advance(sum(shares.values()), event.total, what)

        with_executor: dict[str, Any] = {}
        if scheduler is not None:
            with_executor["executor"] = dask_executor(scheduler)
        return run_many(
            specs, results=store, jobs=jobs, retry=tuple(retry), on_event=told, protocol=protocol, **with_executor
        )


def dask_executor(address: str) -> Any:
    """The executor of a Dask cluster.

    Raises:
        RunError: ``distributed`` is not installed, or the scheduler does not answer.
    """
    from dynslam_bench.core.errors import RunError

    try:
        from distributed import Client
    except ImportError as error:
        raise RunError("--scheduler needs the package distributed", "pip install 'dynslam-bench[cluster]'") from error
    try:
        return Client(address, timeout="10s").get_executor()
    except (OSError, ValueError) as error:
        raise RunError(f"no Dask scheduler answers at {address}: {error}", "for example tcp://host:8786") from error


def show_runs(
    records: Sequence[RunRecord], store: Any, protocol: str, *, as_json: bool, reused: Collection[str] = ()
) -> None:  # fmt: skip
    """A table, or JSON, of runs with their errors under a protocol; runs in `reused` are said to be from the store."""
    from dynslam_bench.runs import score

    rows = []
    for record in records:
        metrics = {} if record.status == "stopped" else score(store, record, protocol).metrics
        rows.append(
            {
                "run": record.run_id,
                "tracker": record.tracker.id,
                "sequence": record.sequence.id,
                "seed": record.seed,
                "part": part_words(record),
                "settings": ", ".join(f"{name}={value}" for name, value in record.overrides.items()),
                "from_store": record.run_id in reused,
                "status": record.status,
                "ate_rmse_m": metrics.get("ate_rmse_m"),
                "never_move_m": metrics.get("never_move_ate_rmse_m"),
                "coverage": record.coverage,
                "frame_ms": None if record.frame_time_s is None else 1000 * record.frame_time_s,
                "masks": record.segmentation,
                "reason": record.reason,
                "protocol": protocol,
                "folder": str(store.folder(record.run_id)),
            }
        )
    if as_json:
        write_json(rows)
        return
    names = {
        "run": "run", "tracker": "tracker", "sequence": "sequence", "part": "part", "seed": "seed", "status": "status",
        "ate_rmse_m": "ATE (m)", "never_move_m": "not moving (m)", "coverage": "coverage", "frame_ms": "ms/frame",
    }  # fmt: skip
    if not any(row["part"] for row in rows):
        del names["part"]
    more = {"masks": "masks", "from_store": "from the store", "settings": "settings", "reason": "reason"}
    names |= {name: title for name, title in more.items() if any(row[name] for row in rows)}
    cells = [[row[name] for name in names] for row in rows]
    write_table(list(names.values()), cells, shrink=("settings", "reason", "sequence"))


def part_words(record: RunRecord) -> str:
    """Which frames of its sequence a run saw, e.g. ``0:60, every 2nd, offset 1``; empty for all of them."""
    offset = getattr(record, "offset", 0)
    words = []
    if record.frames is not None:
        start, stop = record.frames
        words.append(f"{start}:{'' if stop is None else stop}")
    if record.stride > 1:
        words.append(f"every {record.stride}{ {2: 'nd', 3: 'rd'}.get(record.stride, 'th') }")
    if offset:
        words.append(f"offset {offset}")
    return ", ".join(words)
