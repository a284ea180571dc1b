"""The frames of runs, from their ``frames.csv``: many tables at once, since parsing one alone is mostly overhead."""

from __future__ import annotations

import io
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from dynslam_bench.core.errors import DynslamError, RunError
from dynslam_bench.core.reading import MEGABYTE, TABLE_BYTES, read_bytes
from dynslam_bench.runs.frame_row import CSV_FILE

from ..model.rows import LoadedRun

Array = NDArray[np.float64]
Columns = dict[str, NDArray[Any]]

COUNTS = ("keypoints", "culled", "matches", "inliers")
_STATS = {f"stat_{name}" for name in (*COUNTS, "mask_fraction")}
_NEEDED = {"index", "timestamp", "state", "frame_error_trans_m"}
_TOGETHER = 8 * MEGABYTE
"""About how many bytes of tables are parsed at once."""
_ASKED = 5
"""Runs of a column that are asked for the exact shares of its frames."""


@dataclass(frozen=True, eq=False)
class RunFrames:
    """The frames of a run.

    Attributes:
        columns: What the page shows of ``frames.csv``, a name to values ``[N]``; empty for an imported trajectory.
        share: Share of the pixels that show people ``[N]``, nan where it is not known.
        share_source: Where that comes from, in words; empty where nothing is known.
        fault: Why there are no frames though there is a table; empty otherwise.
    """

    columns: Columns
    share: Array
    share_source: str
    fault: str = ""

    def __len__(self) -> int:
        return len(self.share)

    @property
    def errors_m(self) -> Array:
        """Frame-to-frame translational errors ``[N]`` in metres, nan where there is none."""
        return np.asarray(self.columns["frame_error_trans_m"], dtype=np.float64)


def read_frames(runs: Sequence[LoadedRun], exact: Mapping[int, float]) -> Iterator[RunFrames]:
    """The frames of some runs with the share of dynamic pixels: the exact one if it is known, else by their own masks.

    Args:
        runs: Runs of one column.
        exact: Frame in the numbering of the runs' part without offset to the exact share.
    """
    paths = [run.store.folder(run.row.run_id) / CSV_FILE for run in runs]
    for run, columns in zip(runs, read_tables(paths, _is_shown), strict=True):
        if isinstance(columns, RunError):
            yield RunFrames({}, np.zeros(0), "", str(columns))
        elif columns is None:
            yield RunFrames({}, np.zeros(0), "")
        elif exact:
            share = [exact.get(index + run.row.offset, np.nan) for index in columns["index"].tolist()]
            yield RunFrames(columns, np.array(share), "exact masks")
        elif (own := columns.get("stat_mask_fraction")) is not None and own.any():  # else it may have no masks
            yield RunFrames(columns, own.astype(np.float64), "the tracker's own masks")
        else:
            yield RunFrames(columns, np.full(len(columns["index"]), np.nan), "")


def exact_shares(runs: Sequence[LoadedRun]) -> dict[int, float]:
    """Frame (before the offset) to its exact share of dynamic pixels, from those of the first runs that know it."""
    shares: dict[int, float] = {}
    asked = runs[:_ASKED]
    paths = [run.store.folder(run.row.run_id) / CSV_FILE for run in asked]
    for run, columns in zip(asked, read_tables(paths, {"index", "dynamic_share"}.__contains__), strict=True):
        if columns is None or isinstance(columns, RunError) or "dynamic_share" not in columns:
            continue  # what is damaged is said on the page of that run
        known = np.isfinite(columns["dynamic_share"])
        if known.any():
            indices = (columns["index"][known] + run.row.offset).tolist()
            shares |= dict(zip(indices, columns["dynamic_share"][known].tolist(), strict=True))
    return shares


def read_tables(paths: Sequence[Path], wanted: Callable[[str], bool]) -> Iterator[Columns | RunError | None]:
    """Columns of some ``frames.csv``, in their order: numbers, and the state in words.

    Tables with one heading are parsed together, as far as nothing about them is unusual.

    Yields:
        A name to values ``[N]``; None where there is no table; a `RunError` for one that holds no frames, or something
        else than numbers.
    """
    contents: list[bytes | RunError | None] = []
    held = 0
    for at, path in enumerate(paths):
        contents.append(_content(path))
        held += len(contents[-1]) if isinstance(contents[-1], bytes) else 0
        if held > _TOGETHER or at == len(paths) - 1:
            yield from _parsed(contents, wanted)
            contents, held = [], 0


def _content(path: Path) -> bytes | RunError | None:
    try:
        if not path.is_file() or not path.stat().st_size:
            return None
        return read_bytes(path, limit=TABLE_BYTES)
    except (DynslamError, OSError) as error:
        return RunError(f"{CSV_FILE} is damaged: {error}")


def _parsed(
    contents: Sequence[bytes | RunError | None], wanted: Callable[[str], bool]
) -> list[Columns | RunError | None]:
    """The columns of every table; those with the heading of the first one together."""
    tables = [content for content in contents if isinstance(content, bytes)]
    heading = tables[0].partition(b"\n")[0] + b"\n" if tables else b""
    alike = [table for table in tables if table.startswith(heading)]
    together = iter(_apart(alike, len(heading), wanted))
    found: list[Columns | RunError | None] = []
    for content in contents:
        columns: Columns | RunError | None
        if not isinstance(content, bytes):
            found.append(content)
            continue
        columns = next(together, None) if content.startswith(heading) else None
        found.append(_faultless(_parse(content, wanted) if columns is None else columns, wanted))
    return found


def _apart(tables: Sequence[bytes], heading: int, wanted: Callable[[str], bool]) -> list[Columns]:
    """The columns of tables with one heading, parsed at once; nothing if a line of theirs cannot be told to be one row.

    Args:
        tables: Their content.
        heading: Bytes of the heading.
        wanted: Which columns.
    """
    whole = b"".join([tables[0][:heading], *(table[heading:] for table in tables)]) if tables else b""
    if len(tables) < 2 or b'"' in whole or not all(table.endswith(b"\n") for table in tables):
        return []
    found = _parse(whole, wanted)
    ends = np.cumsum([table.count(b"\n") - 1 for table in tables]).tolist()
    if isinstance(found, RunError) or {len(values) for values in found.values()} != {ends[-1]}:
        return []
    starts = [0, *ends]
    return [
        {name: values[start:end] for name, values in found.items()} for start, end in zip(starts, ends, strict=False)
    ]


def _parse(content: bytes, wanted: Callable[[str], bool]) -> Columns | RunError:
    """What a table holds, whatever it is; what is no table at all is a `RunError`."""
    kinds: dict[str, Any] = defaultdict(lambda: np.float64, index=np.int64, state=str)
    try:
        table = pd.read_csv(io.BytesIO(content), usecols=wanted, dtype=kinds, low_memory=False)
    except (ValueError, OverflowError, OSError) as error:
        return RunError(f"{CSV_FILE} is damaged: {error}")
    if not isinstance(table.index, pd.RangeIndex):
        return RunError(f"{CSV_FILE} is damaged: its lines have more cells than its heading")
    return {str(name): table[name].to_numpy() for name in table}


def _faultless(columns: Columns | RunError, wanted: Callable[[str], bool]) -> Columns | RunError:
    """The columns of one table, or what is wrong with them."""
    if isinstance(columns, RunError):
        return columns
    needed = [name for name in _NEEDED if wanted(name)]
    if not set(needed) <= set(columns) or not len(columns[needed[0]]):
        return RunError(f"{CSV_FILE} holds no frames")
    if not np.isfinite(columns.get("timestamp", 0.0)).all():
        return RunError(f"{CSV_FILE} is damaged: not every frame has a stamp")
    return columns


def _is_shown(name: str) -> bool:
    """Whether the page shows a column of ``frames.csv``."""
    return name in _NEEDED or name in _STATS or (name.endswith("_s") and not name.startswith("stat_"))
