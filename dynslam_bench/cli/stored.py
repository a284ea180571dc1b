"""``runs list|show|rescore|rm``."""

from __future__ import annotations

from dataclasses import asdict
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Optional

import typer

from . import completion
from .options import AsJson, ProtocolId, Results
from .output import complain, progress, write, write_fields, write_json, write_table
from .run_rows import show_rows

if TYPE_CHECKING:
    from dynslam_bench.runs import RunRecord, RunStore

app = typer.Typer(help="Stored runs.", no_args_is_help=True)


@app.command("list")
def list_(
    results: Results = Path("results"),
    status: Annotated[
        Optional[str],  # noqa: UP045
        typer.Option(help="Only runs that ended so, e.g. ok or crashed.", autocompletion=completion.statuses),
    ] = None,
    protocol: ProtocolId = "tum-rgbd/v1",
    as_json: AsJson = False,
) -> None:
    """List the runs of a results folder, oldest first."""
    from typing import get_args

    from dynslam_bench.core.collector import collector_paused
    from dynslam_bench.core.errors import RunError, did_you_mean
    from dynslam_bench.runs import RunStore
    from dynslam_bench.runs.storage.record import Status
    from dynslam_bench.runs.storage.run_list import list_runs

    if status is not None and status not in get_args(Status):
        raise RunError(f"unknown status '{status}'", did_you_mean(status, get_args(Status)))
    store = RunStore(results)
    if not store.runs.is_dir():
        raise RunError(f"there are no runs in {store.root}", "name the folder with --results")
    with progress("reading runs") as advance:
        rows, unreadable = list_runs(store, protocol, on_progress=advance)
    with collector_paused():
        show_rows([row for row in rows if status in (None, row["status"])], store, protocol, as_json=as_json)
    for bad in unreadable:
        complain(f"unreadable: {bad.path}: {bad.reason}")


@app.command()
def show(
    run: Annotated[str, typer.Argument(help="The run's id, its first digits, or latest.")] = "latest",
    results: Results = Path("results"),
    protocol: ProtocolId = "tum-rgbd/v1",
    as_json: AsJson = False,
) -> None:
    """Show everything about a run."""
    from dynslam_bench.runs import RunStore, score

    store = RunStore(results)
    record = store.read(run)
    metrics = score(store, record, protocol)
    if as_json:
        write_json({"record": record, "metrics": metrics, "folder": store.folder(record.run_id)})
        return
    write_fields(run_facts(store, record))
    if record.timings:
        write()
        rows = [
            (name, 1000 * stage.median_s, 1000 * stage.p95_s, 1000 * stage.mean_s)
            for name, stage in record.timings.items()
        ]
        write_table(("stage", "median ms", "p95 ms", "mean ms"), rows)
    for which, evaluation in (("online", metrics.online), ("final", metrics.final)):
        write()
        if evaluation is None:
            write(f"{which}: {metrics.reasons.get(which, 'not evaluated')}")
            continue
        write(f"{which}: {evaluation.summary()}")
        write_table(("metric", "value"), sorted(evaluation.metrics.items()))
        for line in evaluation.diagnostics:
            write(f"  {line}")
    for line in metrics.hints:
        write(f"hint: {line}")


@app.command()
def rescore(
    results: Results = Path("results"),
    protocol: Annotated[Optional[str], typer.Option(help="Only under this one.")] = None,  # noqa: UP045
    as_json: AsJson = False,
) -> None:
    """Compute the errors of all runs again from their trajectories, and say which have changed."""
    from dynslam_bench.core.errors import RunError
    from dynslam_bench.runs import RunStore
    from dynslam_bench.runs.storage.scoring import rescore as score_again

    store = RunStore(results)
    if not store.runs.is_dir():
        raise RunError(f"there are no runs in {store.root}", "name the folder with --results")
    with progress("scoring runs") as advance:
        outcomes = score_again(store, protocol, on_progress=advance)
    if as_json:
        write_json([asdict(each) for each in outcomes])
        return
    for each in outcomes:
        names = f": {', '.join(each.changed)}" if each.changed else ""
        write(f"{each.protocol}: {each.runs} runs scored, {len(each.changed)} with other errors than stored{names}")
    for reason in outcomes[0].unreadable if outcomes else ():
        complain(f"unreadable: {reason}")


def run_facts(store: RunStore, record: RunRecord) -> dict[str, Any]:
    """What is known of a run, by name; empty values are not shown."""
    from dynslam_bench.core.toml import assignments
    from dynslam_bench.runs.storage.run_index import part_words

    return {
        "run": record.run_id,
        "folder": store.folder(record.run_id),
        "identity": "" if record.verified else "unverified: its id does not tell the contents of data and code",
        "status": record.status,
        "reason": record.reason,
        "tracker": f"{record.tracker.label} [{record.tracker.id}, {record.tracker.provenance}]",
        "sequence": record.sequence.id,
        "frames": part_words(record),
        "n_frames": record.n_frames,
        "tracked": record.n_tracked,
        "lost": record.n_lost,
        "initialising": record.n_initialising or None,
        "coverage": record.coverage,
        "repeat": record.repeat,
        "masks": record.segmentation,
        "device": record.device,
        "threads": record.threads,
        "study": record.study,
        "started": record.started,
        "wall_s": record.wall_s,
        "peak_memory_mb": record.peak_memory_mb,
        "keyframes": record.keyframes,
        "map_points": record.map_points,
        "maps": record.maps,
        "loops closed": closed_loops(store, record.run_id),
        "overrides": assignments(record.overrides),
        "notes": record.notes,
        "command": " ".join(record.command),
    }


def closed_loops(store: RunStore, run_id: str) -> int | None:
    """How many loops a run had closed at its end; None where its table of frames does not tell, or is damaged."""
    from contextlib import suppress

    from dynslam_bench.core.errors import RunError
    from dynslam_bench.runs.frame_row import CSV_FILE, read_csv

    told: list[float] = []
    with suppress(RunError):
        told = [row.stats["loops"] for row in read_csv(store.folder(run_id) / CSV_FILE) if "loops" in row.stats]
    return int(told[-1]) if told and isfinite(told[-1]) else None


@app.command()
def rm(
    runs: Annotated[Optional[list[str]], typer.Argument(help="Ids or their first digits.")] = None,  # noqa: UP045
    results: Results = Path("results"),
    failed: Annotated[bool, typer.Option("--failed", help="All runs that failed.")] = False,
) -> None:
    """Delete runs and their metrics."""
    from dynslam_bench.core.errors import RunError
    from dynslam_bench.runs import RunStore

    store = RunStore(results)
    chosen = [store.find(run) for run in runs or ()]
    if failed and not store.runs.is_dir():
        raise RunError(f"there are no runs in {store.root}", "name the folder with --results")
    if failed:
        chosen += [record.run_id for record in store.all()[0] if record.failed]
    if not chosen and not failed:
        raise RunError("no run was named", "name ids, or --failed")
    for run_id in dict.fromkeys(chosen):
        store.remove(run_id)
        write(run_id)
