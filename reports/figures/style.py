"""How the report's figures look: colours, axes, layout, and numbers and names made fit for the page."""

from __future__ import annotations

import html
from collections.abc import Sequence
from typing import Any

import numpy as np

from ..model.board import Board

Figure = dict[str, Any]
"""``data`` and ``layout`` in the words of plotly; `reports/html/templates/chart.js` draws what is used of them."""

COLOURS = (
    "#1f6fb4", "#d9542b", "#2a9d6f", "#8a5cc2", "#c9970c", "#3aa6c9", "#c2427f", "#6b7a1f", "#8c564b", "#4b5fd6",
    "#e08a3c", "#178f8f", "#a83232", "#7f7f7f", "#5aa02c", "#b07cc6", "#b8860b", "#2f4b7c", "#d45087", "#665191",
)  # fmt: skip
GRID = "#e5e7eb"


def colours(board: Board) -> dict[str, str]:
    """One colour for every tracker, the same in all figures."""
    return {key: COLOURS[i % len(COLOURS)] for i, key in enumerate(board.trackers)}


def layout_of(height: int, **more: Any) -> dict[str, Any]:
    """A layout with the report's fonts and margins; keywords override its parts."""
    base: dict[str, Any] = {
        "height": height,
        "font": {"family": "Inter, system-ui, -apple-system, 'Segoe UI', Roboto, sans-serif", "size": 13},
        "paper_bgcolor": "rgba(0,0,0,0)",
        "plot_bgcolor": "rgba(0,0,0,0)",
        "margin": {"l": 70, "r": 20, "t": 40, "b": 60},
        "modebar": {"bgcolor": "rgba(0,0,0,0)", "color": "#c4c9d1", "activecolor": "#1f6fb4"},
        "legend": {"x": 1.02, "y": 1, "xanchor": "left", "yanchor": "top", "font": {"size": 12}, "tracegroupgap": 0},
        "hoverlabel": {"bgcolor": "white"},
        "showlegend": True,
    }
    return base | more


def axis(title: str, type: str = "linear") -> dict[str, Any]:
    """A linear (or other) axis with a title."""
    described: dict[str, Any] = {
        "title": {"text": title, "standoff": 12, "font": {"size": 13}},
        "gridcolor": GRID,
        "zeroline": False,
        "linecolor": "#9ca3af",
        "ticks": "outside",
        "tickcolor": "#9ca3af",
        "automargin": True,
        "type": type,
    }
    return described


def log_axis(title: str, values: Sequence[float]) -> dict[str, Any]:
    """A logarithmic axis around positive values, labelled 0.1, 0.2, 0.5, 1, ... as the span allows."""
    finite = [value for value in values if np.isfinite(value) and value > 0]
    low, high = float(np.log10(min(finite))), float(np.log10(max(finite)))
    margin = max(0.06 * (high - low), 0.06)
    low, high = low - margin, high + margin
    span = high - low
    steps = range(1, 10) if span < 0.9 else (1, 2, 5) if span < 3 else (1,)
    ticks = [m * 10.0**e for e in range(int(np.floor(low)), int(np.ceil(high)) + 1) for m in steps]
    shown = [tick for tick in ticks if low <= np.log10(tick) <= high]
    if len(shown) < 3:  # less than an octave: round numbers at equal distances
        width = 10**high - 10**low
        step = 10.0 ** np.floor(np.log10(width)) / 2
        step = next(factor * step for factor in (4, 2, 1, 0.4) if width >= 3 * factor * step)
        shown = [float(step * k) for k in range(int(np.ceil(10**low / step)), int(10**high // step) + 1)]
    return axis(title, type="log") | {
        "range": [round(low, 4), round(high, 4)],
        "tickvals": [significant(tick) for tick in shown],
        "ticktext": [f"{tick:g}" for tick in shown],
    }


def guide(x: float | None = None, y: float | None = None) -> dict[str, Any]:
    """A dashed line across the figure at one value."""
    style = {"type": "line", "layer": "below", "line": {"color": "#9ca3af", "width": 1, "dash": "dash"}}
    if x is not None:
        return style | {"x0": x, "x1": x, "xref": "x", "y0": 0, "y1": 1, "yref": "paper"}
    return style | {"y0": y, "y1": y, "yref": "y", "x0": 0, "x1": 1, "xref": "paper"}


def significant(value: float | None, digits: int = 5) -> float | None:
    """A number shortened for the page; None for what is no number (JSON knows no NaN)."""
    if value is None or not np.isfinite(value):
        return None
    return float(f"{value:.{digits}g}")


def rounded(values: Sequence[float]) -> list[float | None]:
    """Numbers shortened for the page, None for what is no number."""
    return [significant(value) for value in values]


def safe(text: str) -> str:
    """Names come from plug-ins; figures read labels as markup."""
    return html.escape(text, quote=False)


def wrapped(text: str, width: int = 34) -> str:
    """A label broken into lines at blanks."""
    lines = [""]
    for word in text.split():
        if lines[-1] and len(lines[-1]) + 1 + len(word) > width:
            lines.append(word)
        else:
            lines[-1] = f"{lines[-1]} {word}".strip()
    return "<br>".join(safe(line) for line in lines)
