"""Side files of a page: scripts that hand over data, so that a page opened from a folder loads them on demand."""

from __future__ import annotations

import base64
import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from dynslam_bench.core.records import write_atomic

FOLDER = "data"
_MISSING = 65535


def to_script(value: Any) -> str:
    """A value as JSON that may stand inside a script element."""
    return json.dumps(value, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")


def write_side(output: Path, name: str, value: Any) -> Path:
    """Write ``data/<name>.js``, which hands a value to the page that loads it; one that is there already stays.

    Args:
        output: Folder of the page.
        name: What the page asks for.
        value: Anything that JSON can hold; no NaN.

    Raises:
        DynslamError: It cannot be written.
    """
    path = output / FOLDER / f"{name}.js"
    content = f"keep({json.dumps(name)},{to_script(value)});\n".encode()
    if not _holds(path, content):  # to replace a file takes the disk far longer than to read it
        write_atomic(path, content)
    return path


def _holds(path: Path, content: bytes) -> bool:
    """Whether a file is there and has this content."""
    try:
        return path.stat().st_size == len(content) and path.read_bytes() == content
    except OSError:
        return False


def packed_rows(rows: ArrayLike) -> list[list[float | str]]:
    """Series of numbers in 16 bits each between their smallest and their largest; what is no number stays missing.

    Args:
        rows: Numbers ``[K, N]``.

    Returns:
        Of each series its smallest value, the step, and the counts of steps in base64; a page shows them to a 65 000th
        of their range.
    """
    array = np.atleast_2d(np.asarray(rows, dtype=np.float64))
    known = np.isfinite(array)
    low = np.min(array, axis=1, where=known, initial=np.inf)
    high = np.max(array, axis=1, where=known, initial=-np.inf)
    low, high = np.where(np.isfinite(low), low, 0.0), np.where(np.isfinite(high), high, 0.0)
    step = np.where(high > low, (high - low) / (_MISSING - 1), 1.0)
    counts = np.where(known, (array - low[:, None]) / step[:, None], _MISSING).round().astype("<u2")
    return [
        [float(f"{first:.9g}"), float(f"{width:.9g}"), base64.b64encode(row.tobytes()).decode()]
        for first, width, row in zip(low, step, counts, strict=True)
    ]
