"""``runs list|show|rescore|rm``."""

from __future__ import annotations

import re
from collections.abc import Collection, Sequence
from dataclasses import asdict
from itertools import product
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Optional

import typer

from dynslam_bench.cli import options as completion
from dynslam_bench.cli.options import AsJson, ProtocolId, Results
from dynslam_bench.cli.output import complain, progress, write, write_columns, write_fields, write_json, write_table
from dynslam_bench.core.toml import label_text

if TYPE_CHECKING:
    from dynslam_bench.runs import RunRecord, RunSpec, RunStore
    from dynslam_bench.runs.run_index import Row


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

    from dynslam_bench.core.errors import RunError, did_you_mean
    from dynslam_bench.runs import RunStore
    from dynslam_bench.runs.record import Status
    from dynslam_bench.runs.store import list_runs

    if status is not None and status not in get_args(Status):
        raise RunError(f"unknown status '{status}'", did_you_mean(status, get_args(Status)))
    store = RunStore(results)
    if not store.runs.is_dir():
        raise RunError(f"there are no runs in {store.root}", "name the folder with --results")
    with progress("reading runs") as advance:
        rows, unreadable = list_runs(store, protocol, on_progress=advance)
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
    from dynslam_bench.runs.store import rescore as score_again

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
    from dynslam_bench.runs.run_index import part_words

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
    from dynslam_bench.runs.frames import CSV_FILE, read_csv

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


# Runs as the rows of a table, or as JSON.

TITLES = {
    "run_id": "run",
    "tracker": "tracker",
    "sequence": "sequence",
    "frames": "frames",
    "repeat": "repeat",
    "status": "status",
    "ate_rmse_m": "ATE (m)",
    "static_camera_ate_rmse_m": "static camera (m)",
    "coverage": "coverage",
    "frame_ms": "ms/frame",
}
"""Columns of the table."""
WHERE_SAID = {
    "segmentation": "masks",
    "study": "study",
    "from_store": "from the store",
    "settings": "settings",
    "identity": "identity",
    "reason": "reason",
}
"""Columns that are there only if a run has something to say in them."""
SPARE = (
    "static camera (m)",
    "masks",
    "repeat",
    "coverage",
    "settings",
    "ms/frame",
    "frames",
    "study",
    "from the store",
)
"""Columns that give way on a narrow terminal, the first one first."""
LONG_WAY_M = 20.0
"""A way along which drift may have come in that only a closed loop gives back (docs/backend.md, Loops)."""


def show_runs(
    records: Sequence[RunRecord], store: RunStore, protocol: str, *, as_json: bool, reused: Collection[str] = ()
) -> None:
    """A table, or JSON, of runs with their errors under a protocol; runs in `reused` are said to be from the store."""
    from dynslam_bench.runs.run_index import run_row

    scored = [(record, None if record.status == "stopped" else store.score(record, protocol)) for record in records]
    rows = [run_row(*pair) | {"from_store": pair[0].run_id in reused} for pair in scored]
    show_rows(rows, store, protocol, as_json=as_json)


def show_rows(rows: Sequence[Row], store: RunStore, protocol: str, *, as_json: bool) -> None:
    """The same of rows that `list_runs` gave."""
    if as_json:
        places = ({"protocol": protocol, "folder": str(store.folder(row["run_id"]))} for row in rows)
        write_json([row | place for row, place in zip(rows, places, strict=True)])
        return
    names = {name: title for name, title in TITLES.items() if name != "frames" or any(row["frames"] for row in rows)}
    names |= {name: title for name, title in WHERE_SAID.items() if any(row.get(name) for row in rows)}
    columns = [(title, [shown_cell(name, row[name]) for row in rows]) for name, title in names.items()]
    write_columns(columns, shrink=("settings", "reason", "sequence", "run"), spare=SPARE)
    pairs = [(row["ate_rmse_m"], row["static_camera_ate_rmse_m"]) for row in rows]
    worse = sum(static is not None and error is not None and error > (1 + 1e-9) * static for error, static in pairs)
    if worse:
        write(f"{worse} of {len(rows)} runs are worse than a static camera.")
    if any(row["ate_rmse_m"] is not None and row["coverage"] < 1 for row in rows):
        write("ATE: of the tracked frames alone; static camera: of all. A report holds lost frames at the last pose.")


_FOLDERS = re.compile(r"(?<==)(\w+:)?(?:~|\.{0,2})/(?:[^,/]*/)*")


def shown_cell(name: str, value: Any) -> Any:
    """A cell of the table: paths without their folders, which ``--json`` and ``runs show`` have."""
    if name in ("tracker", "segmentation"):
        return label_text(value)
    return _FOLDERS.sub(r"\1", value) if name == "settings" else value


def show_pictures(records: Sequence[RunRecord], store: RunStore, names: Sequence[str], *, as_json: bool) -> set[str]:
    """Where the pictures and maps of runs lie; on standard error for which runs there are none, and why.

    Returns:
        The names of which a run has none.
    """
    missing = set[str]()
    by_id = {record.run_id: record for record in records}
    for (run_id, record), name in product(by_id.items(), names):
        path = store.folder(run_id) / name
        if not path.is_file():
            missing.add(name)
            ended = f"no {name}: the run ended early, {record.status}"
            complain(f"{next((text for text in record.notes if text.startswith(f'no {name}')), ended)} ({run_id})")
        elif not as_json:
            write(str(path))
    return missing


def seen_note(records: Sequence[RunRecord]) -> str:
    """One line on the runs whose network was trained on what it judged; empty without any."""
    from dynslam_bench.segmentation.networks.checkpoints import seen_in_training

    seen = [r.sequence.id for r in records if seen_in_training(r.segmentation, r.sequence.id)]
    if not seen:
        return ""
    return (
        f"{len(seen)} of {len(records)} runs have masks of a network that was trained on their scene, the first on "
        f"{seen[0]}: a best case, which reports mark and do not rank; scenes 100-199 are held out, e.g. "
        f"{seen[0].partition('?')[0].partition('@')[0]}?scene=100"
    )


def drift_note(records: Sequence[RunRecord], store: RunStore) -> str:
    """One line on runs that went a long way and were to close no loops; empty without any."""
    asked = [r for r in records if r.settings.get("backend.loop_closing.enabled") is False]
    tracks = [(r, store.trajectory(r.run_id)) for r in asked if r.tracker.sensors == "rgbd"]
    ways = [(r.sequence.id, track.path_length_m) for r, track in tracks if track is not None]
    long = [(name, way) for name, way in ways if way > LONG_WAY_M]
    if not long:
        return ""
    return (
        f"{len(long)} of {len(records)} runs went more than {LONG_WAY_M:.0f} m, the first {long[0][1]:.0f} m on "
        f"{long[0][0]}, without loop closing: what drifts on such a way stays, with every frame ok; loops are closed "
        "with --set backend.loop_closing.enabled=true"
    )


FRAMES_OF_A_HINT = 60
"""Frames that are compared when a run fails: a few seconds."""


def recording_note(specs: Sequence[RunSpec], records: Sequence[RunRecord], store: RunStore, protocol: str) -> str:
    """One line on a fault of the first recording on which a run failed, was lost or was no better than not moving.

    Empty if no run of a recording did, or where a short check of the recording finds no fault.
    """
    from dynslam_bench.runs.spec import place_of
    from dynslam_bench.sequences.doctor import diagnose

    asked = {place_of(spec.sequence) or spec.sequence: spec for spec in specs}
    for record in records:
        spec = asked.get(record.place or record.sequence.id)
        failed = record.failed or record.status == "lost" or _no_better(record, store, protocol)
        if spec is None or spec.sequence.startswith("synthetic/") or not failed:
            continue
        found = diagnose(spec.sequence, data_root=spec.data_root, camera=spec.camera, most_frames=FRAMES_OF_A_HINT)
        if found.ok:
            return ""
        how = f"dynslam-bench sequences doctor {spec.sequence}{f' --camera {spec.camera}' if spec.camera else ''}"
        return f"{record.sequence.id} has a fault: {found.findings[0].text}; more by: {how}"
    return ""


def _no_better(record: RunRecord, store: RunStore, protocol: str) -> bool:
    """Whether the error of a run is that of a camera that never moves, or more."""
    scored = None if record.status == "stopped" or record.tracker.id == "never-move" else store.score(record, protocol)
    errors = {} if scored is None else scored.metrics
    error, bound = errors.get("ate_rmse_m"), errors.get("static_camera_ate_rmse_m")
    return error is not None and bound is not None and error >= bound
