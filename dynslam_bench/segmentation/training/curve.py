"""The learning curve of a training run: a CSV file and a picture."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from dynslam_bench.core.errors import DynslamError
from dynslam_bench.core.files import write_atomic

COLOURS = ((180, 119, 31), (14, 127, 255), (44, 160, 44), (40, 39, 214), (189, 103, 148), (75, 86, 140))
"""BGR."""


def write_csv(rows: Sequence[Mapping[str, float]], path: Path) -> None:
    """Write one row a step; columns are the union of the rows' keys in order of appearance."""
    columns = list(dict.fromkeys(key for row in rows for key in row))
    text = io.StringIO()
    writer = csv.DictWriter(text, columns, lineterminator="\n")
    writer.writeheader()
    for row in rows:
        writer.writerow({key: f"{value:.6g}" for key, value in row.items()})
    write_atomic(path, text.getvalue())


def draw(
    rows: Sequence[Mapping[str, float]], path: Path, *, title: str, losses: Sequence[str], scores: Sequence[str]
) -> None:
    """Draw losses (log scale, left) and scores (0 to 1, right) over the step as a PNG.

    Args:
        rows: Each with ``step`` and some of the curves.
        path: The picture.
        title: Above it.
        losses: Names of the curves of the left half.
        scores: Names of the curves of the right half.
    """
    canvas = np.full((420, 1120, 3), 255, np.uint8)
    cv2.putText(canvas, title, (20, 26), cv2.FONT_HERSHEY_SIMPLEX, 0.55, (0, 0, 0), 1, cv2.LINE_AA)
    _panel(canvas, 70, rows, losses, logarithmic=True)
    _panel(canvas, 630, rows, scores, logarithmic=False)
    done, data = cv2.imencode(".png", canvas)
    if not done:
        raise DynslamError(f"cannot encode the learning curve {path}")
    write_atomic(path, data.tobytes())


def _panel(
    canvas: NDArray[np.uint8],
    left: int,
    rows: Sequence[Mapping[str, float]],
    names: Sequence[str],
    *,
    logarithmic: bool,
) -> None:
    top, width, height = 50, 440, 320
    last = max((row["step"] for row in rows), default=1.0) or 1.0
    values = [row[name] for row in rows for name in names if name in row and row[name] > 0]
    low, high = (np.log10([min(values), max(values)]) if values else (-1.0, 0.0)) if logarithmic else (0.0, 1.0)
    low, high = (np.floor(low * 2) / 2, np.ceil(high * 2) / 2) if logarithmic else (low, high)
    high = max(high, low + 0.5)

    def place(step: float, value: float) -> tuple[int, int]:
        y = np.log10(max(value, 1e-9)) if logarithmic else value
        share = float(np.clip((y - low) / (high - low), 0, 1))
        return left + round(width * step / last), top + height - round(height * share)

    cv2.rectangle(canvas, (left, top), (left + width, top + height), (160, 160, 160), 1)
    for k in range(5):
        tick = low + (high - low) * k / 4
        y = top + height - height * k // 4
        cv2.line(canvas, (left, y), (left + width, y), (225, 225, 225), 1)
        label = f"{10**tick:.3g}" if logarithmic else f"{tick:.2f}"
        cv2.putText(canvas, label, (left - 58, y + 4), cv2.FONT_HERSHEY_SIMPLEX, 0.4, (60, 60, 60), 1, cv2.LINE_AA)
        step, at = f"{last * k / 4:.0f}", (left + width * k // 4 - 12, top + height + 18)
        cv2.putText(canvas, step, at, cv2.FONT_HERSHEY_SIMPLEX, 0.4, (60, 60, 60), 1, cv2.LINE_AA)
    for number, name in enumerate(names):
        points = [place(row["step"], row[name]) for row in rows if name in row]
        colour = COLOURS[number % len(COLOURS)]
        if points:
            cv2.polylines(canvas, [np.array(points, np.int32)], False, colour, 1, cv2.LINE_AA)
        at = (left + 8 + 85 * number, top + height + 38)
        cv2.putText(canvas, name, at, cv2.FONT_HERSHEY_SIMPLEX, 0.45, colour, 1, cv2.LINE_AA)
