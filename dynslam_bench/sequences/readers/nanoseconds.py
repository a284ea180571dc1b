"""Tables in CSV whose stamps are nanoseconds, as EuRoC and VSLAM-LAB write them."""

from __future__ import annotations

from decimal import Decimal
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.core.errors import SequenceError
from dynslam_bench.core.reading import read_lines
from dynslam_bench.geometry.stamps import parse_ns
from dynslam_bench.geometry.tum_file import is_number

from .lists import MOST_LINES


def read_rows(path: Path) -> tuple[list[str], list[list[str]]]:
    """The heading (without ``#``) and the rows of a table, split at commas; every row as long as the heading.

    Raises:
        SequenceError: The file cannot be read, has no row, or rows of other lengths.
    """
    heading: list[str] = []
    rows: list[list[str]] = []
    for number, line in enumerate(read_lines(path, kind=SequenceError), start=1):
        parts = [part.strip() for part in line.strip().lstrip("#").split(",")]
        if not any(parts):
            continue
        if not heading:
            heading = parts
        elif len(parts) != len(heading):
            raise SequenceError(f"{path} line {number} has {len(parts)} columns, the heading {len(heading)}")
        elif len(rows) == MOST_LINES:
            raise SequenceError(f"{path} has more than {MOST_LINES} rows")
        else:
            rows.append(parts)
    if not rows:
        raise SequenceError(f"{path} holds no rows")
    return heading, rows


def column(heading: list[str], name: str, path: Path) -> int:
    """Where a column stands.

    Raises:
        SequenceError: There is none.
    """
    if name not in heading:
        raise SequenceError(f"{path} has no column '{name}' (it has: {', '.join(heading)[:200]})")
    return heading.index(name)


def nanoseconds(texts: list[str], path: Path) -> NDArray[np.int64]:
    """Stamps of nanoseconds, written as whole numbers or with a point, int64 ``[N]``.

    Raises:
        SequenceError: One is no number, or beyond the range of 64 bits.
    """
    stamps = []
    for text in texts:
        try:
            stamps.append(int(text) if text.isdigit() and len(text) < 19 else parse_ns(f"{Decimal(text)}e-9"))
        except (ValueError, ArithmeticError):
            raise SequenceError(f"{path}: '{text[:40]}' is not a stamp in nanoseconds") from None
    return np.array(stamps, dtype=np.int64)


def floats(rows: list[list[str]], path: Path) -> NDArray[np.float64]:
    """Numbers ``[N, K]`` of a table.

    Raises:
        SequenceError: One is no finite number.
    """
    flat = _numbers([text for row in rows for text in row], path, "a number")
    return flat.reshape(len(rows), -1)


def _numbers(texts: list[str], path: Path, meaning: str) -> NDArray[np.float64]:
    try:
        found = np.array([float(text) for text in texts])
    except ValueError:
        bad = next(text for text in texts if not is_number(text))
        raise SequenceError(f"{path}: '{bad[:40]}' is not {meaning}") from None
    if not np.isfinite(found).all():
        raise SequenceError(f"{path} holds values that are not finite")
    return found
