"""The report's figures as plotly-like specifications."""

from __future__ import annotations

import html
import textwrap
from collections.abc import Sequence
from typing import Any

import numpy as np

from dynslam_bench.core.toml import label_text
from dynslam_bench.reports.model.board import Board
from dynslam_bench.reports.model.statistics import FLOOR_M
from dynslam_bench.reports.tables.leaderboard import CACHED_MARK, LOST_MARK, STATISTICS, has_lost, medians, timed

# How the report's figures look: colours, axes, layout, and numbers and names made fit for the page.

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
    return {
        "height": height,
        "font": {"family": "Inter, system-ui, -apple-system, 'Segoe UI', Roboto, sans-serif", "size": 13},
        "paper_bgcolor": "rgba(0,0,0,0)",
        "plot_bgcolor": "rgba(0,0,0,0)",
        "margin": {"l": 70, "r": 20, "t": 40, "b": 60},
        "modebar": {"bgcolor": "rgba(0,0,0,0)", "color": "#c4c9d1", "activecolor": "#1f6fb4"},
        "legend": {"x": 1.02, "y": 1, "xanchor": "left", "yanchor": "top", "font": {"size": 12}, "tracegroupgap": 0},
        "hoverlabel": {"bgcolor": "white"},
        "showlegend": True,
        **more,
    }


def axis(title: str, type: str = "linear") -> dict[str, Any]:
    """A linear (or other) axis with a title."""
    return {
        "title": {"text": title, "standoff": 12, "font": {"size": 13}},
        "gridcolor": GRID,
        "zeroline": False,
        "linecolor": "#9ca3af",
        "ticks": "outside",
        "tickcolor": "#9ca3af",
        "automargin": True,
        "type": type,
    }


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
    place: dict[str, Any] = {"x0": x, "x1": x, "xref": "x", "y0": 0, "y1": 1, "yref": "paper"}
    if x is None:
        place = {"y0": y, "y1": y, "yref": "y", "x0": 0, "x1": 1, "xref": "paper"}
    return {"type": "line", "layer": "below", "line": {"color": "#9ca3af", "width": 1, "dash": "dash"}} | place


def significant(value: float | None, digits: int = 5) -> float | None:
    """A number shortened for the page; None for what is no number (JSON knows no NaN)."""
    return None if value is None or not np.isfinite(value) else float(f"{value:.{digits}g}")


def rounded(values: Sequence[float]) -> list[float | None]:
    """Numbers shortened for the page, None for what is no number."""
    return [significant(value) for value in values]


def safe(text: str) -> str:
    """Names come from plug-ins; figures read labels as markup."""
    return html.escape(text, quote=False)


def wrapped(text: str) -> str:
    """A label broken into lines of 34 characters at blanks."""
    return "<br>".join(map(safe, textwrap.wrap(text, 34, break_long_words=False, break_on_hyphens=False)))


# The report's figures as plotly-like specifications (plain data and layout), drawn by the page itself.

MOST_POINTS = 400
"""Points of one tracker in the figure of masks; of more runs as many, from the best to the worst."""
_SYMBOLS = ("circle", "square", "diamond", "triangle-up", "triangle-down", "cross", "x", "pentagon", "hexagon", "star")


def ratio_figure(board: Board) -> Figure | None:
    """Geometric-mean ATE ratios with their intervals, best on top; None where nothing is scored."""
    standings = [s for s in board.standings if np.isfinite(s.ratio.value) and s.key not in board.hopeless]
    if not standings:
        return None
    palette = colours(board)
    names = [wrapped(board.labels[s.key]) for s in standings]
    point = [s.ratio.value for s in standings]
    trace = {
        "type": "scatter",
        "mode": "markers",
        "x": rounded(point),
        "y": names,
        "marker": {
            "size": 11,
            "color": [palette[s.key] for s in standings],
            "symbol": ["circle" if s.key in board.ranked else "circle-open" for s in standings],
            "line": {"width": 1.5, "color": [palette[s.key] for s in standings]},
        },
        "error_x": {
            "type": "data",
            "symmetric": False,
            "array": rounded([s.ratio.high - s.ratio.value for s in standings]),
            "arrayminus": rounded([s.ratio.value - s.ratio.low for s in standings]),
            "color": "#6b7280",
            "thickness": 1.4,
            "width": 5,
        },
        "hovertemplate": "%{y}<br>ratio %{x:.3f}<extra></extra>",
    }
    reach = [value for s in standings for value in (s.ratio.value, s.ratio.low, s.ratio.high)]
    return {
        "data": [trace],
        "layout": layout_of(
            height=110 + 34 * len(standings),
            xaxis=log_axis(f"ATE ratio to {safe(board.reference_name)} (left is better)", [*reach, 1.0]),
            yaxis={"autorange": "reversed", "automargin": True, "gridcolor": GRID, "ticks": ""},
            shapes=[guide(x=1.0)],
            margin={"l": 20, "r": 30, "t": 40, "b": 60},
            showlegend=False,
        ),
    }


def speed_figure(board: Board) -> Figure | None:
    """Accuracy against speed, the Pareto front drawn through the ranked trackers; None without timed runs."""
    palette = colours(board)
    standings = {s.key: s for s in board.standings}
    points = []
    for key in board.trackers:
        rows = timed([row for row in board.runs(key) if row.real_time_factor and not row.failed])
        factors = [row.real_time_factor for row in rows if row.real_time_factor]
        if key in standings and factors and np.isfinite(standings[key].ratio.value):
            mark = f" {CACHED_MARK}" if any(row.cached for row in rows) else ""
            points.append((key, float(np.median(factors)), standings[key].ratio, mark))
    if not points:
        return None
    traces: list[dict[str, Any]] = []
    ranked = {(speed, ratio.value) for key, speed, ratio, _ in points if key in board.ranked}
    front = sorted(p for p in ranked if not any(q != p and q[0] >= p[0] and q[1] <= p[1] for q in ranked))
    if len(front) > 1:
        traces.append(
            {
                "type": "scatter",
                "mode": "lines",
                "x": rounded([x for x, _ in front]),
                "y": rounded([y for _, y in front]),
                "line": {"color": "#9ca3af", "width": 1.5, "dash": "dot", "shape": "linear"},
                "name": "Pareto front",
                "hoverinfo": "skip",
            }
        )
    for index, (key, speed, ratio, mark) in enumerate(points):
        symbol = _SYMBOLS[index // len(COLOURS) % len(_SYMBOLS)] + "-open" * (key not in board.ranked)
        traces.append(
            {
                "type": "scatter",
                "mode": "markers",
                "x": [significant(speed)],
                "y": [significant(ratio.value)],
                "name": wrapped(board.labels[key] + mark),
                "marker": {"size": 13, "color": palette[key], "symbol": symbol},
                "error_y": {
                    "type": "data",
                    "symmetric": False,
                    "array": [significant(ratio.high - ratio.value)],
                    "arrayminus": [significant(ratio.value - ratio.low)],
                    "thickness": 1,
                    "width": 3,
                    "color": palette[key],
                },
                "hovertemplate": "%{fullData.name}<br>%{x:.2f} × real time<br>ratio %{y:.3f}<extra></extra>",
            }
        )
    note = {"x": 0, "xref": "x", "y": 1, "yref": "paper", "text": "real time", "showarrow": False}
    note |= {"xanchor": "left", "yanchor": "top", "xshift": 5, "font": {"size": 11, "color": "#6b7280"}}
    speeds = "× real time: frame interval over mean frame time (right is better)"
    ends = [end for _, _, ratio, _ in points for end in (ratio.value, ratio.low, ratio.high)]
    return {
        "data": traces,
        "layout": layout_of(
            height=max(460, 120 + 21 * len(points)),
            xaxis=log_axis(speeds, [1.0, *(speed for _, speed, _, _ in points)]),
            yaxis=log_axis("ATE ratio (down is better)", [1.0, *ends]),
            shapes=[guide(x=1.0), guide(y=1.0)],
            annotations=[note],
        ),
    }


def mask_figure(board: Board) -> Figure | None:
    """Quality of the masks against the pose error, one point a run; None where no run has it."""
    palette = colours(board)
    traces: list[dict[str, Any]] = []
    everything: list[float] = []
    for key in board.trackers:
        points = []
        for row in board.runs(key):
            if row.mask_iou is not None and row.score_m is not None and not row.failed:
                words = f"{safe(board.sequence(row))}, {row.repeat}, masks: {safe(label_text(row.segmentation))}"
                points.append((1000 * max(row.score_m, FLOOR_M), row.mask_iou, words))
        if points:
            if len(points) > MOST_POINTS:
                points = sorted(points)[:: -(-len(points) // MOST_POINTS)]
            everything += [error_mm for error_mm, _, _ in points]
            traces.append(
                {
                    "type": "scatter",
                    "mode": "markers",
                    "name": wrapped(board.labels[key]),
                    "x": rounded([iou for _, iou, _ in points]),
                    "y": rounded([error_mm for error_mm, _, _ in points]),
                    "text": [words for _, _, words in points],
                    "marker": {"size": 9, "opacity": 0.85, "color": palette[key]},
                    "hovertemplate": "%{text}<br>IoU %{x:.3f}<br>ATE %{y:.3g} mm<extra>%{fullData.name}</extra>",
                }
            )
    if not traces:
        return None
    return {
        "data": traces,
        "layout": layout_of(
            height=max(420, 120 + 21 * len(traces)),
            xaxis=axis("overlap (IoU) of the dynamic mask with the exact one") | {"range": [-0.02, 1.02]},
            yaxis=log_axis("ATE (mm)", everything),
        ),
    }


# The paper's Figures 9 to 12, drawn of our own runs: bars of the absolute error, one figure a statistic.

FIGURES = {"mean": 9, "median": 10, "rmse": 11, "std": 12}
"""Statistic to the number of the paper's figure."""


def bar_figure(board: Board, statistic: str) -> Figure | None:
    """One statistic of the absolute error in millimetres, a group of bars a sequence; None where no run has it.

    Args:
        board: The board.
        statistic: ``mean``, ``median``, ``rmse`` or ``std``.
    """
    palette = colours(board)
    errors = medians(board, lambda row: row.metrics.get(f"ate_{statistic}_m"))
    traces = []
    for key in [key for key in board.trackers if any(key == measured for measured, _ in errors)]:
        names = [name for name in board.sequences if (key, name) in errors]
        traces.append(
            {
                "type": "bar",
                "name": wrapped(board.labels[key]),
                "x": [safe(board.short[name]) for name in names],
                "y": rounded([1000 * errors[key, name] for name in names]),
                "text": [LOST_MARK * has_lost(board.cells[key][name]) for name in names],
                "textposition": "outside",
                "cliponaxis": False,
                "marker": {"color": palette[key], "opacity": 1.0 if key in board.ranked else 0.45},
                "hovertemplate": "%{x}<br>%{y:.3g} mm<extra>%{fullData.name}</extra>",
            }
        )
    if not traces:
        return None
    return {
        "data": traces,
        "layout": layout_of(
            height=max(380, 110 + 19 * len(traces)),
            barmode="group",
            xaxis=axis("sequence", type="category"),
            yaxis=axis(f"absolute pose error, {STATISTICS[statistic]} (mm)") | {"rangemode": "tozero"},
        ),
    }
