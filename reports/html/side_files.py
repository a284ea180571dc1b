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
    """Write ``data/<name>.js``, which hands a value to the page that loads it.

    Args:
        output: Folder of the page.
        name: What the page asks for.
        value: Anything that JSON can hold; no NaN.

    Raises:
        DynslamError: It cannot be written.
    """
    path = output / FOLDER / f"{name}.js"
    write_atomic(path, f"keep({json.dumps(name)},{to_script(value)});\n")
    return path


def packed(values: ArrayLike) -> list[float | str]:
    """Numbers in 16 bits each between their smallest and their largest; what is no number stays missing.

    Args:
        values: Numbers ``[N]``.

    Returns:
        Smallest value, step, and the counts of steps in base64; a page shows them to a 65 000th of their range.
    """
    array = np.asarray(values, dtype=np.float64)
    known = np.isfinite(array)
    low, high = (float(array[known].min()), float(array[known].max())) if known.any() else (0.0, 0.0)
    step = (high - low) / (_MISSING - 1) or 1.0
    steps = np.full(len(array), _MISSING, dtype="<u2")
    steps[known] = ((array[known] - low) / step).round()
    return [low, step, base64.b64encode(steps.tobytes()).decode()]
