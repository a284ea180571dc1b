"""Runs as the rows of a table, or as JSON."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from itertools import product
from typing import TYPE_CHECKING, Any

from .output import complain, write, write_json, write_table

if TYPE_CHECKING:
    from dynslam_bench.runs import RunRecord, RunStore

TITLES = {
    "run": "run",
    "tracker": "tracker",
    "sequence": "sequence",
    "part": "part",
    "repeat": "repeat",
    "status": "status",
    "ate_rmse_m": "ATE (m)",
    "never_move_m": "not moving (m)",
    "coverage": "coverage",
    "frame_ms": "ms/frame",
}
"""Columns of the table."""
WHERE_SAID = {
    "masks": "masks",
    "from_store": "from the store",
    "settings": "settings",
    "reason": "reason",
}
"""Columns that are there only if a run has something to say in them."""
SPARE = ("not moving (m)", "masks", "repeat", "coverage", "settings", "ms/frame", "part", "from the store")
"""Columns that give way on a narrow terminal, the first one first."""


def show_runs(
    records: Sequence[RunRecord], store: RunStore, protocol: str, *, as_json: bool, reused: Collection[str] = ()
) -> None:
    """A table, or JSON, of runs with their errors under a protocol; runs in `reused` are said to be from the store."""
    rows = [_row(record, store, protocol) | {"from_store": record.run_id in reused} for record in records]
    if as_json:
        write_json(rows)
        return
    names = {name: title for name, title in TITLES.items() if name != "part" or any(row["part"] for row in rows)}
    names |= {name: title for name, title in WHERE_SAID.items() if any(row[name] for row in rows)}
    cells = [[row[name] for name in names] for row in rows]
    write_table(list(names.values()), cells, shrink=("settings", "reason", "sequence", "run"), spare=SPARE)


def show_pictures(records: Sequence[RunRecord], store: RunStore, names: Sequence[str], *, as_json: bool) -> None:
    """Where the pictures of runs lie; on standard error for which runs there are none, and why."""
    by_id = {record.run_id: record for record in records}
    for (run_id, record), name in product(by_id.items(), names):
        path = store.folder(run_id) / name
        if not path.is_file():
            ended = f"no {name}: the run ended early, {record.status}"
            complain(f"{next((text for text in record.notes if text.startswith(f'no {name}')), ended)} ({run_id})")
        elif not as_json:
            write(str(path))


def seen_note(records: Sequence[RunRecord]) -> str:
    """One line on the runs whose network was trained on what it judged; empty without any."""
    from dynslam_bench.segmentation.training_set import seen_in_training

    seen = [r.sequence.id for r in records if seen_in_training(r.segmentation, r.sequence.id)]
    if not seen:
        return ""
    return (
        f"{len(seen)} of {len(records)} runs have masks of a network that was trained on their scene, the first on "
        f"{seen[0]}: a best case, which reports mark and do not rank; instances 100-199 are held out, e.g. "
        f"{seen[0].partition('?')[0].partition('@')[0]}@100"
    )


def _row(record: RunRecord, store: RunStore, protocol: str) -> dict[str, Any]:
    from dynslam_bench.segmentation.training_set import seen_in_training

    metrics = {} if record.status == "stopped" else store.score(record, protocol).metrics
    return {
        "run": record.run_id,
        "tracker": record.tracker.id,
        "sequence": record.sequence.id,
        "part": part_words(record),
        "seed": record.seed,
        "offset": record.offset,
        "noise": record.sequence.noise,
        "repeat": record.repeat,
        "settings": ", ".join(f"{name}={value}" for name, value in record.overrides.items()),
        "status": record.status,
        "ate_rmse_m": metrics.get("ate_rmse_m"),
        "never_move_m": metrics.get("never_move_ate_rmse_m"),
        "coverage": record.coverage,
        "frame_ms": None if record.frame_time_s is None else 1000 * record.frame_time_s,
        "masks": record.segmentation,
        "seen_in_training": seen_in_training(record.segmentation, record.sequence.id),
        "reason": record.reason,
        "protocol": protocol,
        "folder": str(store.folder(record.run_id)),
    }


def part_words(record: RunRecord) -> str:
    """Which frames of its sequence a run was asked for, e.g. ``0:60, every 2nd``; empty for all of them."""
    words = []
    if record.frames is not None:
        start, stop = record.frames
        words.append(f"{start}:{'' if stop is None else stop}")
    if record.stride > 1:
        words.append(f"every {record.stride}{ {2: 'nd', 3: 'rd'}.get(record.stride, 'th') }")
    return ", ".join(words)
