"""What a list says of each run, a line each in a file of the store, so that a list need not read the records.

A line joins the file when its run is scored for the first time; `run_list` adds those that are missing. Lines hold for
one version of the code that makes them, and for one state (time and size) of the run's record, its stored errors, its
trajectories and the ground truth. Errors are always replaced by a rename, so that none of them need be looked at while
their folder has the time that is noted. The file may be deleted at any time, and whatever of it is damaged or out of
date counts as not there.
"""

from __future__ import annotations

import contextlib
import json
import os
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from hashlib import blake2b
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from pydantic import TypeAdapter, ValidationError

from dynslam_bench.core.errors import DynslamError, RunError
from dynslam_bench.core.files import write_lines
from dynslam_bench.core.fingerprint import package_digest
from dynslam_bench.core.reading import MEGABYTE, TABLE_BYTES
from dynslam_bench.core.records import digest
from dynslam_bench.core.toml import assignments
from dynslam_bench.evaluation.protocol import Protocol
from dynslam_bench.runs.record import MetricRecord, RunRecord

if TYPE_CHECKING:
    import pandas as pd


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
    from dynslam_bench.segmentation.networks.checkpoints import (
        seen_in_training,  # and all sequences: as long as a list takes
    )

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
    code = digest([package_digest(("evaluation", "geometry", "runs")), FIRST, *FIELDS])
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


# A file of JSON lines that any process may add to or delete; of what is damaged nothing counts as there.

T = TypeVar("T")

_ADDING = os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK
"""No link is followed, and nobody is waited for who reads a pipe."""
_PIECE = 16 * MEGABYTE
"""Bytes of lines that are read at once: a file of 100,000 long lines needs no memory of its own size beside theirs."""


def read_line_file(path: Path, lines: TypeAdapter[list[T]]) -> tuple[list[T], int]:
    """The valid lines of a file, and how many others it has; nothing of one that cannot be read.

    Args:
        path: The file; no more than `TABLE_BYTES` of it are read.
        lines: What lines are, as a list.
    """
    found: list[T] = []
    count = 0
    for piece in _pieces(path):
        found += _valid(piece, lines)
        count += piece.count(b"\n")
    return found, count - len(found)


def add_lines(path: Path, lines: Iterable[str]) -> None:
    """Add lines at once, so that those of other processes come before or after; what cannot be written is left out."""
    with contextlib.suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        handle = os.open(path, _ADDING, 0o666)
        try:
            os.write(handle, "".join(f"{line}\n" for line in lines).encode())
        finally:
            os.close(handle)


def write_line_file(path: Path, lines: Iterable[str], older: str) -> None:
    """Write a file anew; a folder that can only be read keeps what it has.

    Args:
        path: The file.
        lines: Its lines.
        older: Pattern of the names of its older versions, which go.
    """
    with contextlib.suppress(DynslamError):
        write_lines(path, lines)
        remove_older(path, older)


def remove_older(path: Path, older: str) -> None:
    """Remove the older versions of a file, as far as the folder can be written."""
    with contextlib.suppress(OSError):
        for other in path.parent.glob(older):
            if other != path:
                other.unlink()


def _pieces(path: Path) -> Iterator[bytes]:
    """The file in pieces of whole lines; its last line ends in a newline, whether the file does or not."""
    if not path.is_file():  # nor is it waited for what comes out of a pipe
        return
    with contextlib.suppress(OSError), path.open("rb") as file:
        if os.fstat(file.fileno()).st_size > TABLE_BYTES:
            return
        while piece := file.read(_PIECE):
            piece += file.readline()
            yield piece if piece.endswith(b"\n") else piece + b"\n"


def _valid(piece: bytes, lines: TypeAdapter[list[T]]) -> list[T]:
    """The lines of a piece but for the damaged ones."""
    whole = piece[:-1]
    try:
        return lines.validate_json(b"[" + whole.replace(b"\n", b",") + b"]")
    except ValidationError:  # one is damaged: a kill tore it
        return [line for text in whole.split(b"\n") for line in _encoded_line(text, lines)]


def _encoded_line(text: bytes, lines: TypeAdapter[list[T]]) -> list[T]:
    try:
        return lines.validate_json(b"[" + text + b"]")
    except ValidationError:
        return []


# What lies on the disk of a run, as far as names, times and sizes tell: what was taken from a state holds with it.

Stamp = tuple[int, int]
"""Time (nanoseconds) and size (bytes) of a file."""
NO_FILE: Stamp = (0, 0)


def stamp_of(file: str | Path) -> Stamp:
    """Time and size of a file.

    Raises:
        OSError: It is not there.
    """
    found = os.stat(file)  # noqa: PTH116 - a hundred thousand of them: pathlib takes twice as long
    return found.st_mtime_ns, found.st_size


def stamp_if_there(file: str | Path) -> Stamp:
    """The same; `NO_FILE` where there is none."""
    try:
        return stamp_of(file)
    except OSError:
        return NO_FILE


def check_plain(folder: str | Path, root: Path) -> None:
    """A folder holds plain files of its store: no link to a file elsewhere, no pipe that is never written.

    Raises:
        RunError: It names what is none of it. A folder that is not there has nothing: who reads it, says so.
    """
    folder_state(folder, root)


def folder_state(folder: str | Path, root: Path) -> str:
    """A digest of the names, times and sizes of all that lies in a folder; empty for one that cannot be read.

    Args:
        folder: Of a run, or of the ground truth of a sequence's part.
        root: The store that it belongs to.

    Raises:
        RunError: It holds a link that leads out of the store, or something that is no plain file.
    """
    try:
        with os.scandir(folder) as entries:
            found = sorted((entry.name, *_stamp(entry, root)) for entry in entries)
    except OSError:
        return ""
    return blake2b(repr(found).encode(errors="backslashreplace"), digest_size=8).hexdigest()


def _stamp(entry: os.DirEntry[str], root: Path) -> Stamp:
    if entry.is_symlink() and not Path(entry.path).resolve().is_relative_to(root.resolve()):
        raise RunError(f"{entry.path} is a link that leads out of {root}", "put the file in its place")
    if not entry.is_file():
        if not entry.is_dir():
            raise RunError(f"{entry.path} is no plain file")
        return NO_FILE  # its files are none of the store's
    return stamp_if_there(entry.path)


# Runs as a pandas frame, one row a run.

_TEXT = (
    *("run_id", "kind", "tracker", "label", "settings", "provenance"),
    *("sequence", "frames", "split", "repeat", "status", "reason", "study", "identity"),
    *("device", "segmentation", "protocol_id", "protocol_digest", "trajectory"),
)
_WHOLE = ("seed", "offset", "noise", "stride", "threads", "n_frames", "n_processed", "n_tracked", "n_lost")
_MAP = ("keyframes", "map_points", "maps")
_NUMBERS = (
    *("coverage", "frame_ms", "real_time_factor", "finalize_s", "wall_s", "peak_memory_mb"),
    *("mask_iou", "epipolar_skipped"),
)


def runs_frame(runs: Iterable[tuple[RunRecord, MetricRecord | None]]) -> pd.DataFrame:
    """Runs as a frame.

    Args:
        runs: Records with their metrics; None for a run that was not scored.

    Returns:
        One row a run, in their order. Whatever may be missing is ``pd.NA``, never nan or an empty string.

        - ``string``: run_id, kind (``run``, ``imported``), tracker, label (its name in tables), settings (those that
          were asked for, ``name=value; ...``), provenance, sequence, frames (``A:B, every 2nd``, missing for all),
          split, repeat (``seed 0, offset 2``), status, reason (missing for ``ok``), study (of which the run is a trial,
          missing for any other run), identity (``unverified`` for runs of an older scheme of ids, else missing),
          device, segmentation (source of the masks), protocol_id, protocol_digest and trajectory (``online``,
          ``final``): what the errors hold under and are of.
        - ``Int64``: seed, offset, noise (missing for the sequence's own), stride, threads, n_frames, n_processed,
          n_tracked, n_lost, keyframes, map_points, maps.
        - ``Float64``: coverage (0 to 1), frame_ms (median, milliseconds, segmentation included, decoding excluded),
          real_time_factor, finalize_s and wall_s (seconds), peak_memory_mb (MB), mask_iou and epipolar_skipped (0 to
          1), and every metric under its own name with its unit (``ate_rmse_m``, ``rpe_1s_rot_rmse_deg``, see
          `Evaluation`); ``ate_rmse_m`` is there even if no run has one.
        - ``datetime64[us, UTC]``: started.
    """
    import pandas as pd

    pairs = list(runs)
    metrics = sorted({name for _, scored in pairs if scored is not None for name in scored.metrics} | {"ate_rmse_m"})
    kinds: dict[str, str] = dict.fromkeys(_TEXT, "string") | dict.fromkeys((*_WHOLE, *_MAP), "Int64")
    kinds |= dict.fromkeys((*_NUMBERS, *metrics), "Float64")
    lines = [_line(record, scored) for record, scored in pairs]
    frame = pd.DataFrame(lines, columns=list(kinds), dtype=object).astype(kinds)
    stamps = pd.Series([record.started or None for record, _ in pairs], dtype=object)
    started = pd.to_datetime(stamps, utc=True, format="ISO8601")
    return frame.assign(started=started.astype("datetime64[us, UTC]"))


def _line(record: RunRecord, scored: MetricRecord | None) -> dict[str, Any]:
    same = {name: getattr(record, name) for name in (*_WHOLE, *_MAP, *_NUMBERS, *_TEXT) if hasattr(record, name)}
    line = same | {
        "tracker": record.tracker.id,
        "label": record.tracker.label or record.tracker.id,
        "provenance": record.tracker.provenance,
        "settings": "; ".join(assignments(record.asked)),
        "sequence": record.sequence.id,
        "split": record.sequence.split,
        "noise": record.sequence.noise,
        "frames": part_words(record),
        "study": record.trial_of,
        "identity": "" if record.verified else "unverified",
        "frame_ms": None if record.frame_time_s is None else 1000 * record.frame_time_s,
    }
    if scored is not None:
        line |= {name: getattr(scored, name) for name in ("protocol_id", "protocol_digest", "trajectory")}
        line |= scored.metrics
    return {name: None if value == "" else value for name, value in line.items()}
