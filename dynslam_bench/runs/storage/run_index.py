"""What a list says of each run, a line each in a file of the store, so that a list need not read the records.

A line joins the file when its run is scored for the first time; `run_list` adds those that are missing. Lines hold for
one state of the run's record (its time and size). The file may be deleted at any time, and whatever of it is damaged
or out of date counts as not there.
"""

from __future__ import annotations

import contextlib
import json
import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter, ValidationError

import dynslam_bench
from dynslam_bench.core.errors import DynslamError
from dynslam_bench.core.reading import TABLE_BYTES, read_bytes
from dynslam_bench.core.records import digest, write_atomic
from dynslam_bench.evaluation.protocol import Protocol

from .record import MetricRecord, RunRecord

Row = dict[str, Any]
Stamp = tuple[int, int]
Line = list[Any]

FIELDS = (
    *("run", "tracker", "sequence", "part", "seed", "offset", "noise", "repeat", "settings", "status"),
    *("ate_rmse_m", "never_move_m", "coverage", "frame_ms", "masks", "seen_in_training", "reason", "started"),
)
"""Names of a row's values, in order; the values of a line, before which it has its stamp."""
_LINES: TypeAdapter[list[Line]] = TypeAdapter(list[Line])
_LENGTH = len(FIELDS) + 2
_RUN, _STARTED = 2 + FIELDS.index("run"), 2 + FIELDS.index("started")


def run_row(record: RunRecord, metrics: MetricRecord | None) -> Row:
    """What a list says of a run: JSON values under the names `FIELDS`.

    Args:
        record: The run.
        metrics: Its errors under some protocol; None without.
    """
    from dynslam_bench.segmentation.training_set import seen_in_training  # and all sequences: as long as a list takes

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
        "reason": record.reason or _not_scored(record, metrics),
        "started": record.started,
    }


def _not_scored(record: RunRecord, metrics: MetricRecord | None) -> str:
    """Why a run with ground truth has no errors; empty where it has some, or was not scored."""
    if metrics is None or metrics.metrics or not record.sequence.ground_truth:
        return ""
    return metrics.reasons.get(metrics.trajectory, "")


def part_words(record: RunRecord) -> str:
    """Which frames of its sequence a run was asked for, e.g. ``0:60, every 2nd``; empty for all of them."""
    words = []
    if record.frames is not None:
        start, stop = record.frames
        words.append(f"{start}:{'' if stop is None else stop}")
    if record.stride > 1:
        words.append(f"every {record.stride}{ {2: 'nd', 3: 'rd'}.get(record.stride, 'th') }")
    return ", ".join(words)


def index_file(root: Path, protocol: Protocol) -> Path:
    """Where the lines of a store under a protocol lie, as this version writes them."""
    return root / "index" / f"{protocol.digest()}-{digest([dynslam_bench.__version__, *FIELDS])}.jsonl"


def stamp_of(record_file: str | Path) -> Stamp:
    """Time and size of a run's record.

    Raises:
        OSError: It is not there.
    """
    found = os.stat(record_file)  # noqa: PTH116 - a hundred thousand of them: pathlib takes twice as long
    return found.st_mtime_ns, found.st_size


def make_line(stamp: Stamp, record: RunRecord, metrics: MetricRecord | None) -> Line:
    """The line of a run whose record had that stamp before it was read, or when it was written."""
    return [*stamp, *run_row(record, metrics).values()]


def read_index(path: Path) -> tuple[dict[str, Line], bool]:
    """The last line of each run, and whether the file holds nothing but these."""
    try:
        data = read_bytes(path, limit=TABLE_BYTES).rstrip(b"\n")
    except DynslamError:
        return {}, False
    try:
        lines = _LINES.validate_json(b"[" + data.replace(b"\n", b",") + b"]")
    except ValidationError:  # one is damaged: a kill tore it
        lines = [line for text in data.split(b"\n") for line in _parsed(text)]
    found = {line[_RUN]: line for line in lines if _is_line(line)}
    return found, len(found) == data.count(b"\n") + bool(data)


def add_line(path: Path, line: Line) -> None:
    """Add a run's line to the file; one that cannot be written is left out: the next list reads that record."""
    with contextlib.suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        handle = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_NOFOLLOW, 0o666)
        try:
            os.write(handle, _text([line]))  # at once: lines of other processes come before or after it
        finally:
            os.close(handle)


def write_index(path: Path, lines: Iterable[Line]) -> None:
    """Write the file anew; those of other versions go. A store that can only be read keeps what it has."""
    with contextlib.suppress(DynslamError, OSError):
        write_atomic(path, _text(lines))
        for other in path.parent.glob(f"{path.name.partition('-')[0]}*"):
            if other != path:
                other.unlink()


def _text(lines: Iterable[Line]) -> bytes:
    return "".join(json.dumps(line, separators=(",", ":")) + "\n" for line in lines).encode()


def _parsed(text: bytes) -> list[Line]:
    try:
        return _LINES.validate_json(b"[" + text + b"]")
    except ValidationError:
        return []


def _is_line(line: Line) -> bool:
    """Whether a line of an index that somebody may have made by hand can be sorted and shown."""
    return len(line) == _LENGTH and isinstance(line[_RUN], str) and isinstance(line[_STARTED], str)
