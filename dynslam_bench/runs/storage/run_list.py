"""All runs of a store as plain rows, fast: what was read once is kept in an index until the record changes."""

from __future__ import annotations

import contextlib
import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import dynslam_bench
from dynslam_bench.core.errors import DynslamError
from dynslam_bench.core.records import write_atomic
from dynslam_bench.evaluation.protocol import Protocol, get_protocol
from dynslam_bench.segmentation.training_set import seen_in_training

from .evaluating import DEFAULT_PROTOCOL
from .record import MetricRecord, RunRecord
from .store import RUN_FILE, RunStore, Unreadable

Row = dict[str, Any]
OnProgress = Callable[[int, int], None]


def list_runs(
    store: RunStore,
    protocol: Protocol | str = DEFAULT_PROTOCOL,
    *,
    on_progress: OnProgress = lambda done, total: None,
) -> tuple[list[Row], list[Unreadable]]:
    """Every run as `run_row` gives it, from the oldest to the newest, and the folders that hold no valid record.

    Rows lie in ``index/<protocol digest>.json`` of the store and are taken from there while size and time of the run's
    record are the same; the file may be deleted at any time, and a store that cannot be written is read without it.

    Args:
        store: The store.
        protocol: What the errors hold under; runs that were not scored under it are scored now.
        on_progress: Told of how many runs are done, of how many.
    """
    protocol = get_protocol(protocol)
    path = store.root / "index" / f"{protocol.digest()}.json"
    known = _read(path)
    kept: dict[str, list[Any]] = {}
    unreadable: list[Unreadable] = []
    ids, runs = store.ids(), str(store.runs)
    for position, run_id in enumerate(ids):
        if position % 100 == 0:
            on_progress(position, len(ids))
        try:
            stamp = _stamp(f"{runs}/{run_id}/{RUN_FILE}")
            found = known.get(run_id)
            if found is None or found[0] != stamp:
                record = store.read_whole(run_id)
                metrics = None if record.status == "stopped" else store.score(record, protocol)
                found = [stamp, *run_row(record, metrics).values()]
            kept[run_id] = found
        except (DynslamError, OSError) as error:
            unreadable.append(Unreadable(store.folder(run_id), str(error)))
    if kept != known:
        with contextlib.suppress(DynslamError):  # a store that can only be read can be listed all the same
            write_atomic(path, json.dumps({"head": _HEAD, "rows": kept}, separators=(",", ":")))
    rows = [dict(zip(FIELDS, values[1:], strict=True)) for values in kept.values()]
    return sorted(rows, key=lambda row: (row["started"], row["run"])), unreadable


def run_row(record: RunRecord, metrics: MetricRecord | None) -> Row:
    """What a list says of a run: JSON values under the names `FIELDS`.

    Args:
        record: The run.
        metrics: Its errors under some protocol; None without.
    """
    errors = {} if metrics is None else metrics.metrics
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
        "ate_rmse_m": errors.get("ate_rmse_m"),
        "never_move_m": errors.get("never_move_ate_rmse_m"),
        "coverage": record.coverage,
        "frame_ms": None if record.frame_time_s is None else 1000 * record.frame_time_s,
        "masks": record.segmentation,
        "seen_in_training": seen_in_training(record.segmentation, record.sequence.id),
        "reason": record.reason,
        "started": record.started,
    }


FIELDS = (
    *("run", "tracker", "sequence", "part", "seed", "offset", "noise", "repeat", "settings", "status"),
    *("ate_rmse_m", "never_move_m", "coverage", "frame_ms", "masks", "seen_in_training", "reason", "started"),
)
"""Names of a row's values, in order."""
_HEAD = [dynslam_bench.__version__, *FIELDS]


def part_words(record: RunRecord) -> str:
    """Which frames of its sequence a run was asked for, e.g. ``0:60, every 2nd``; empty for all of them."""
    words = []
    if record.frames is not None:
        start, stop = record.frames
        words.append(f"{start}:{'' if stop is None else stop}")
    if record.stride > 1:
        words.append(f"every {record.stride}{ {2: 'nd', 3: 'rd'}.get(record.stride, 'th') }")
    return ", ".join(words)


def _stamp(path: str) -> list[int]:
    found = os.stat(path)  # noqa: PTH116 - a hundred thousand of them: pathlib takes twice as long
    return [found.st_mtime_ns, found.st_size]


def _is_row(run_id: str, values: list[Any]) -> bool:
    """Whether a row of an index that somebody may have made by hand can be sorted and shown."""
    return len(values) == len(FIELDS) + 1 and values[1] == run_id and isinstance(values[-1], str)


def _read(path: Path) -> dict[str, list[Any]]:
    """The rows of an index by run id; none if there is none, or it is damaged or of another version."""
    try:
        found = json.loads(path.read_bytes())
        rows: dict[str, list[Any]] = found["rows"] if found["head"] == _HEAD else {}
        return rows if all(_is_row(run_id, values) for run_id, values in rows.items()) else {}
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError):
        return {}
