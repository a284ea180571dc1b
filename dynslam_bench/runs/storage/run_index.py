"""What a list says of each run, a line each in a file of the store, so that a list need not read the records.

A line joins the file when its run is scored for the first time; `run_list` adds those that are missing. Lines hold for
one version of the code that makes them, and for one state (time and size) of the run's record, its stored errors, its
trajectories and the ground truth. Errors are always replaced by a rename, so that none of them need be looked at while
their folder has the time that is noted. The file may be deleted at any time, and whatever of it is damaged or out of
date counts as not there.
"""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter

from dynslam_bench.core.fingerprint import package_digest
from dynslam_bench.core.records import digest
from dynslam_bench.core.toml import assignments
from dynslam_bench.evaluation.protocol import Protocol

from .line_file import add_lines, read_line_file, write_line_file
from .record import MetricRecord, RunRecord
from .states import stamp_if_there

ONLINE, FINAL = "trajectory_online.txt", "trajectory_final.txt"
Row = dict[str, Any]
Stamps = tuple[int, ...]
"""Time and size of a run's record, of its errors under the protocol, of its online and its final trajectory, and of the
ground truth; (0, 0) for each that is not there."""
Line = list[Any]

FIELDS = (
    *("run_id", "tracker", "sequence", "frames", "seed", "offset", "noise", "repeat", "settings", "status"),
    *("ate_rmse_m", "static_camera_ate_rmse_m", "coverage", "frame_ms", "segmentation"),
    *("seen_in_training", "study", "identity", "reason", "started"),
)
"""Names of a row's values, in order, as in `runs_frame`; the values of a line, before which it has its stamps."""
_LINES: TypeAdapter[list[Line]] = TypeAdapter(list[Line])
FIRST = 11
"""Where the values begin in a line; before them stand the stamps and the run's part of its sequence."""
PART = FIRST - 1
RUN, STARTED = FIRST + FIELDS.index("run_id"), FIRST + FIELDS.index("started")
_LENGTH = FIRST + len(FIELDS)
_SETTLED_NS = 1_000_000_000
"""A folder as young as this, when the file was written, may change again without another time."""
_MOST_VERIFIED = 100
"""Such notes that a file may have."""


def run_row(record: RunRecord, metrics: MetricRecord | None) -> Row:
    """What a list says of a run: JSON values under the names `FIELDS`.

    Args:
        record: The run.
        metrics: Its errors under some protocol; None without.
    """
    from dynslam_bench.segmentation.training_set import seen_in_training  # and all sequences: as long as a list takes

    errors = {} if metrics is None else metrics.metrics
    return {
        "run_id": record.run_id,
        "tracker": record.tracker.id,
        "sequence": record.sequence.id,
        "frames": part_words(record),
        "seed": record.seed,
        "offset": record.offset,
        "noise": record.sequence.noise,
        "repeat": record.repeat,
        "settings": "; ".join(assignments(record.asked)),
        "status": record.status,
        "ate_rmse_m": errors.get("ate_rmse_m"),
        "static_camera_ate_rmse_m": errors.get("static_camera_ate_rmse_m"),
        "coverage": record.coverage,
        "frame_ms": None if record.frame_time_s is None else 1000 * record.frame_time_s,
        "segmentation": record.segmentation,
        "seen_in_training": seen_in_training(record.segmentation, record.sequence.id),
        "study": record.trial_of,
        "identity": "" if record.verified else "unverified",
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
    code = digest([package_digest(("evaluation", "geometry", "runs/storage")), FIRST, *FIELDS])
    return root / "index" / f"{protocol.digest()}-{code}.jsonl"


def input_stamps(runs: str, parts: str, run_id: str, part: str) -> Stamps:
    """Time and size of the files that a run's errors are computed from.

    Args:
        runs: Folder of the store's runs.
        parts: Folder of the store's parts of sequences.
        run_id: The run.
        part: Its part of a sequence.
    """
    files = (f"{runs}/{run_id}/{ONLINE}", f"{runs}/{run_id}/{FINAL}", f"{parts}/{part}/groundtruth.txt")
    return tuple(number for file in files for number in stamp_if_there(file))


def make_line(stamps: Stamps, record: RunRecord, metrics: MetricRecord | None) -> Line:
    """The line of a run whose files had those stamps before they were read, or when they were written."""
    return [*stamps, record.sequence.part, *run_row(record, metrics).values()]


@dataclass(frozen=True)
class Index:
    """What the file of a store's lines holds.

    Attributes:
        lines: The last line of each run, by its id.
        is_whole: Whether it holds nothing but these.
        verified_ns: Time of the folder of errors when those of all lines were last found unchanged; 0 if it is so young
            that it may have changed since without another time.
    """

    lines: dict[str, Line]
    is_whole: bool
    verified_ns: int


def read_index(path: Path) -> Index:
    """What the file holds; nothing if there is none."""
    written_ns, _ = stamp_if_there(path)
    lines, damaged = read_line_file(path, _LINES)
    found = {line[RUN]: line for line in lines if _is_line(line)}
    verified = [line[0] for line in lines if len(line) == 1 and type(line[0]) is int]
    is_whole = len(found) + len(verified) == len(lines) + damaged and len(verified) < _MOST_VERIFIED
    is_settled = bool(verified) and 0 <= verified[-1] < written_ns - _SETTLED_NS
    return Index(found, is_whole, verified[-1] if is_settled else 0)


def add_to_index(path: Path, line: Line) -> None:
    """Add a run's line to the file; one that cannot be written is left out: the next list reads that record."""
    add_lines(path, [_text(line)])


def add_verified(path: Path, folder_ns: int) -> None:
    """Note that the errors of all lines were unchanged when their folder had that time."""
    add_lines(path, [_text([folder_ns])])


def write_index(path: Path, lines: Iterable[Line], folder_ns: int) -> None:
    """Write the file anew; those of other versions go. A store that can only be read keeps what it has.

    Args:
        path: The file.
        lines: The lines.
        folder_ns: Time of the folder of errors before theirs were looked at.
    """
    write_line_file(path, map(_text, chain([[folder_ns]], lines)), f"{path.name.partition('-')[0]}*")


def _text(line: Line) -> str:
    return json.dumps(line, separators=(",", ":"))


def _is_line(line: Line) -> bool:
    """Whether a line of an index that somebody may have made by hand can be sorted and shown."""
    return len(line) == _LENGTH and all(isinstance(line[at], str) for at in (PART, RUN, STARTED))
