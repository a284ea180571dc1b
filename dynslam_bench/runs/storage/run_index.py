"""What a list says of each run, a line each in a file of the store, so that a list need not read the records.

A line joins the file when its run is scored for the first time; `run_list` adds those that are missing. Lines hold for
one state of the run's record and of its stored errors (time and size of both files). The file may be deleted at any
time, and whatever of it is damaged or out of date counts as not there.
"""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter

import dynslam_bench
from dynslam_bench.core.records import digest
from dynslam_bench.evaluation.protocol import Protocol

from .line_file import add_lines, read_line_file, write_line_file
from .record import MetricRecord, RunRecord

Row = dict[str, Any]
Stamps = tuple[int, int, int, int]
"""Time and size of a run's record, and of its errors under the protocol: (0, 0) where they are not stored."""
Line = list[Any]

FIELDS = (
    *("run", "tracker", "sequence", "part", "seed", "offset", "noise", "repeat", "settings", "status"),
    *("ate_rmse_m", "never_move_m", "coverage", "frame_ms", "masks", "seen_in_training", "reason", "started"),
)
"""Names of a row's values, in order; the values of a line, before which it has its stamps."""
_LINES: TypeAdapter[list[Line]] = TypeAdapter(list[Line])
FIRST = 4
"""Where the values begin in a line; before them stand the stamps."""
RUN, STARTED = FIRST + FIELDS.index("run"), FIRST + FIELDS.index("started")
_LENGTH = FIRST + len(FIELDS)


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
        "reason": record.reason,
        "started": record.started,
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


def index_file(root: Path, protocol: Protocol) -> Path:
    """Where the lines of a store under a protocol lie, as this version writes them."""
    return root / "index" / f"{protocol.digest()}-{digest([dynslam_bench.__version__, FIRST, *FIELDS])}.jsonl"


def make_line(stamps: Stamps, record: RunRecord, metrics: MetricRecord | None) -> Line:
    """The line of a run whose files had those stamps before they were read, or when they were written."""
    return [*stamps, *run_row(record, metrics).values()]


def read_index(path: Path) -> tuple[dict[str, Line], bool]:
    """The last line of each run, and whether the file holds nothing but these."""
    lines, damaged = read_line_file(path, _LINES)
    found = {line[RUN]: line for line in lines if _is_line(line)}
    return found, len(found) == len(lines) + damaged


def add_to_index(path: Path, line: Line) -> None:
    """Add a run's line to the file; one that cannot be written is left out: the next list reads that record."""
    add_lines(path, [_text(line)])


def write_index(path: Path, lines: Iterable[Line]) -> None:
    """Write the file anew; those of other versions go. A store that can only be read keeps what it has."""
    write_line_file(path, map(_text, lines), f"{path.name.partition('-')[0]}*")


def _text(line: Line) -> str:
    return json.dumps(line, separators=(",", ":"))


def _is_line(line: Line) -> bool:
    """Whether a line of an index that somebody may have made by hand can be sorted and shown."""
    return len(line) == _LENGTH and isinstance(line[RUN], str) and isinstance(line[STARTED], str)
