"""``run`` and ``bench``."""

from __future__ import annotations

from collections.abc import Sequence
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
    Offsets,
    ProtocolId,
    Results,
    Retry,
    Seeds,
    SettingsFile,
    Stride,
    Threads,
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
    time_limit: Annotated[Optional[float], typer.Option(help="Seconds that a run may take.")] = None,  # noqa: UP045
    memory_limit: Annotated[Optional[float], typer.Option(help="MB that a run may take.")] = None,  # noqa: UP045
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
            cache=cache, drop_share=drop, degrade=strengths,
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
    records = make_runs(specs, store, jobs=jobs, retry=retry, protocol=protocol, scheduler=scheduler)
    show_runs(records, store, protocol, as_json=as_json)
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
) -> list[RunRecord]:
    """`run_many` with a progress bar."""
    from dynslam_bench.runs import RunEvent, run_many

    with progress(f"{len(specs)} runs") as advance:
        shares: dict[str, float] = {}

        def told(event: RunEvent) -> None:
            if event.kind == "progress" and event.partial is not None:
                shares[event.run_id] = event.partial["frames_done"] / max(event.partial["frames"], 1)
            elif event.kind in ("finished", "reused"):
                shares[event.run_id] = 1.0
                if event.record is not None:
                    note(event.record.describe() + (" (stored)" if event.kind == "reused" else ""))
            advance(sum(shares.values()), event.total)

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


def show_runs(records: Sequence[RunRecord], store: Any, protocol: str, *, as_json: bool) -> None:
    """A table, or JSON, of runs with their errors under a protocol."""
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
        "run": "run", "tracker": "tracker", "sequence": "sequence", "seed": "seed", "status": "status",
        "ate_rmse_m": "ATE (m)", "never_move_m": "not moving (m)", "coverage": "coverage", "frame_ms": "ms/frame",
    }  # fmt: skip
    names |= {name: name for name in ("masks", "reason") if any(row[name] for row in rows)}
    write_table(list(names.values()), [[row[name] for name in names] for row in rows])
