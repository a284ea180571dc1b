"""``runs list|show|rescore|rm``, and runs as the rows of a table."""

from __future__ import annotations

import re
from collections.abc import Collection, Sequence
from dataclasses import asdict
from itertools import product
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Optional

import typer

from dynslam_bench.cli.options import AsJson, ProtocolId, Results, complete_statuses
from dynslam_bench.cli.output import (
    json_mode,
    present,
    progress,
    warn,
    write,
    write_columns,
    write_fields,
    write_table,
)
from dynslam_bench.core.toml import label_text

if TYPE_CHECKING:
    from dynslam_bench.runs import MetricRecord, RunRecord, RunSpec, RunStore
    from dynslam_bench.runs.store import Row

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
OPTIONAL = {
    "segmentation": "masks",
    "study": "study",
    "from_store": "from the store",
    "settings": "settings",
    "identity": "identity",
    "reason": "reason",
}
"""Columns that are shown only if a run has a value in them."""
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
"""Columns that are left out on a narrow terminal, in this order."""
LONG_PATH_M = 20.0
"""Path length from which drift may need loop closing (docs/backend.md, Loops)."""
HINT_FRAMES = 60
"""Frames of a recording that are checked when a run on it fails: a few seconds."""
_FOLDERS = re.compile(r"(?<==)(\w+:)?(?:~|\.{0,2})/(?:[^,/]*/)*")

app = typer.Typer(help="Stored runs.", no_args_is_help=True)


def _open(results: Path) -> RunStore:
    """The store of a results folder that exists."""
    from dynslam_bench.core.errors import RunError
    from dynslam_bench.runs import RunStore

    store = RunStore(results)
    if not store.runs.is_dir():
        raise RunError(f"there are no runs in {store.root}", "name the folder with --results")
    return store


@app.command("list")
def list_(
    results: Results = Path("results"),
    status: Annotated[
        Optional[str],  # noqa: UP045
        typer.Option(help="Only runs that ended so, e.g. ok or crashed.", autocompletion=complete_statuses),
    ] = None,
    protocol: ProtocolId = "tum-rgbd/v1",
    as_json: AsJson = False,
) -> None:
    """List the runs of a results folder, oldest first."""
    from typing import get_args

    from dynslam_bench.core.errors import RunError, did_you_mean
    from dynslam_bench.runs.record import Status
    from dynslam_bench.runs.store import list_runs

    if status is not None and status not in get_args(Status):
        raise RunError(f"unknown status '{status}'", did_you_mean(status, get_args(Status)))
    store = _open(results)
    with progress("reading runs") as advance:
        rows, unreadable = list_runs(store, protocol, on_progress=advance)
    show_rows([row for row in rows if status in (None, row["status"])], store, protocol)
    for file in unreadable:
        warn(f"unreadable: {file.path}: {file.reason}")


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
    facts = {"record": record, "metrics": metrics, "folder": store.folder(record.run_id)}
    present(facts, lambda: _show_run(store, record, metrics))


def _show_run(store: RunStore, record: RunRecord, metrics: MetricRecord) -> None:
    write_fields(run_facts(store, record))
    if record.timings:
        stages = record.timings.items()
        write()
        rows = [(name, 1000 * stage.median_s, 1000 * stage.p95_s, 1000 * stage.mean_s) for name, stage in stages]
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
    """Compute the errors of all runs again from their trajectories, and list those that have changed."""
    from dynslam_bench.runs.store import rescore as score_again

    with progress("scoring runs") as advance:
        outcomes = score_again(_open(results), protocol, on_progress=advance)

    def show() -> None:
        for outcome in outcomes:
            count = len(outcome.changed)
            names = f": {', '.join(outcome.changed)}" if count else ""
            write(f"{outcome.protocol}: {outcome.runs} runs scored, {count} with other errors than stored{names}")
        for reason in outcomes[0].unreadable if outcomes else ():
            warn(f"unreadable: {reason}")

    present([asdict(outcome) for outcome in outcomes], show)


@app.command()
def rm(
    runs: Annotated[Optional[list[str]], typer.Argument(help="Ids or their first digits.")] = None,  # noqa: UP045
    results: Results = Path("results"),
    failed: Annotated[bool, typer.Option("--failed", help="All runs that failed.")] = False,
) -> None:
    """Delete runs and their metrics."""
    from dynslam_bench.core.errors import RunError
    from dynslam_bench.runs import RunStore

    if not runs and not failed:
        raise RunError("no run was named", "name ids, or --failed")
    store = _open(results) if failed else RunStore(results)
    chosen = [store.find(run) for run in runs or ()]
    if failed:
        chosen += [record.run_id for record in store.all()[0] if record.failed]
    for run_id in dict.fromkeys(chosen):
        store.remove(run_id)
        write(run_id)


def run_facts(store: RunStore, record: RunRecord) -> dict[str, Any]:
    """The facts of a run by name; empty values are not shown."""
    from dynslam_bench.core.toml import assignments
    from dynslam_bench.runs.store import part_words

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
    """How many loops a run had closed at its end; None without that column, or if its table is damaged."""
    from dynslam_bench.core.errors import RunError
    from dynslam_bench.runs.frames import CSV_FILE, read_csv

    try:
        rows = read_csv(store.folder(run_id) / CSV_FILE)
    except RunError:
        return None
    counts = [row.stats["loops"] for row in rows if isfinite(row.stats.get("loops", float("nan")))]
    return int(counts[-1]) if counts else None


def show_runs(records: Sequence[RunRecord], store: RunStore, protocol: str, reused: Collection[str] = ()) -> None:
    """A table, or JSON, of runs with their errors under a protocol; runs in `reused` are marked as from the store."""
    from dynslam_bench.runs.store import run_row

    scored = [(record, None if record.status == "stopped" else store.score(record, protocol)) for record in records]
    show_rows([run_row(*pair) | {"from_store": pair[0].run_id in reused} for pair in scored], store, protocol)


def show_rows(rows: Sequence[Row], store: RunStore, protocol: str) -> None:
    """The same for rows that `list_runs` gave."""

    def show() -> None:
        parts = any(row["frames"] for row in rows)
        names = {name: title for name, title in TITLES.items() if parts or name != "frames"}
        names |= {name: title for name, title in OPTIONAL.items() if any(row.get(name) for row in rows)}
        columns = [(title, [shown_cell(name, row[name]) for row in rows]) for name, title in names.items()]
        write_columns(columns, shrink=("settings", "reason", "sequence", "run"), spare=SPARE)
        pairs = [(row["ate_rmse_m"], row["static_camera_ate_rmse_m"]) for row in rows]
        worse = sum(bound is not None and error is not None and error > (1 + 1e-9) * bound for error, bound in pairs)
        if worse:
            write(f"{worse} of {len(rows)} runs are worse than a static camera.")
        if any(row["ate_rmse_m"] is not None and row["coverage"] < 1 for row in rows):
            write("ATE: of the tracked frames alone; static camera: of all. A report uses hold-last-pose.")

    place = {"protocol": protocol}
    present([row | place | {"folder": str(store.folder(row["run_id"]))} for row in rows] if json_mode() else [], show)


def shown_cell(name: str, value: Any) -> Any:
    """A cell of the table: paths without their folders; ``--json`` and ``runs show`` have them whole."""
    if name in ("tracker", "segmentation"):
        return label_text(value)
    return _FOLDERS.sub(r"\1", value) if name == "settings" else value


def show_files(records: Sequence[RunRecord], store: RunStore, names: Sequence[str]) -> set[str]:
    """Write the paths of the requested pictures and maps, and to standard error why a run has none.

    Returns:
        The names of which a run has none.
    """
    missing = set[str]()
    by_id = {record.run_id: record for record in records}
    for (run_id, record), name in product(by_id.items(), names):
        path = store.folder(run_id) / name
        if not path.is_file():
            missing.add(name)
            reasons = [text for text in record.notes if text.startswith(f"no {name}")]
            warn(f"{[*reasons, f'no {name}: the run ended early, {record.status}'][0]} ({run_id})")
        elif not json_mode():
            write(str(path))
    return missing


def training_scene_note(records: Sequence[RunRecord]) -> str:
    """One line on the runs on scenes that the segmentation network was trained on; empty without any."""
    from dynslam_bench.segmentation.networks.checkpoints import seen_in_training

    ids = [r.sequence.id for r in records if seen_in_training(r.segmentation, r.sequence.id)]
    if not ids:
        return ""
    return (
        f"{len(ids)} of {len(records)} runs have masks of a network that was trained on their scene, the first on "
        f"{ids[0]}: a best case, which reports mark and do not rank; scenes 100-199 are held out, e.g. "
        f"{ids[0].partition('?')[0].partition('@')[0]}?scene=100"
    )


def drift_note(records: Sequence[RunRecord], store: RunStore) -> str:
    """One line on runs with a long path and without loop closing; empty without any."""
    open_loop = [r for r in records if r.settings.get("backend.loop_closing.enabled") is False]
    tracks = [(r, store.trajectory(r.run_id)) for r in open_loop if r.tracker.sensors == "rgbd"]
    lengths = [(r.sequence.id, track.path_length_m) for r, track in tracks if track is not None]
    long = [(name, length) for name, length in lengths if length > LONG_PATH_M]
    if not long:
        return ""
    return (
        f"{len(long)} of {len(records)} runs went more than {LONG_PATH_M:.0f} m, the first {long[0][1]:.0f} m on "
        f"{long[0][0]}, without loop closing: their drift stays, with every frame ok; loops are closed "
        "with --set backend.loop_closing.enabled=true"
    )


def recording_note(specs: Sequence[RunSpec], records: Sequence[RunRecord], store: RunStore, protocol: str) -> str:
    """One line on a fault of the first recording whose run failed, was lost or was no better than a static camera.

    Empty without such a run, or where a short check of the recording finds no fault.
    """
    from dynslam_bench.runs.spec import place_of
    from dynslam_bench.sequences.doctor import diagnose

    specs_by_place = {place_of(spec.sequence) or spec.sequence: spec for spec in specs}
    for record in records:
        spec = specs_by_place.get(record.place or record.sequence.id)
        failed = record.failed or record.status == "lost" or _no_better_than_static(record, store, protocol)
        if spec is None or spec.sequence.startswith("synthetic/") or not failed:
            continue
        diagnosis = diagnose(spec.sequence, data_root=spec.data_root, camera=spec.camera, most_frames=HINT_FRAMES)
        if diagnosis.ok:
            return ""
        how = f"dynslam-bench sequences doctor {spec.sequence}{f' --camera {spec.camera}' if spec.camera else ''}"
        return f"{record.sequence.id} has a fault: {diagnosis.findings[0].text}; more by: {how}"
    return ""


def _no_better_than_static(record: RunRecord, store: RunStore, protocol: str) -> bool:
    """Whether the error of a run is at least that of a static camera."""
    if record.status == "stopped" or record.tracker.id == "never-move":
        return False
    metrics = store.score(record, protocol).metrics
    error, bound = metrics.get("ate_rmse_m"), metrics.get("static_camera_ate_rmse_m")
    return error is not None and bound is not None and error >= bound
