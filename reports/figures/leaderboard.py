"""The report's figures as plotly-like specifications (plain data and layout), drawn by the page itself."""

from __future__ import annotations

from collections.abc import Sequence
from statistics import median
from typing import Any

import numpy as np

from dynslam_bench.core.toml import label_text

from ..model.board import Board
from ..model.statistics import Interval
from ..tables.leaderboard import CACHED_MARK, timed
from .style import COLOURS, GRID, Figure, axis, colours, guide, layout_of, log_axis, rounded, safe, significant, wrapped

MOST_POINTS = 400
"""Points of one tracker in figures that have one for every run; of more runs as many, from the best to the worst."""
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
    layout = layout_of(
        height=110 + 34 * len(standings),
        xaxis=log_axis(f"ATE ratio to {safe(board.reference_name)} (left is better)", [*reach, 1.0]),
        yaxis={"autorange": "reversed", "automargin": True, "gridcolor": GRID, "ticks": ""},
        shapes=[guide(x=1.0)],
        margin={"l": 20, "r": 30, "t": 40, "b": 60},
        showlegend=False,
    )
    return {"data": [trace], "layout": layout}


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
    front = _pareto([(speed, ratio.value) for key, speed, ratio, _ in points if key in board.ranked])
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
        ranked = key in board.ranked
        symbol = _SYMBOLS[index // len(COLOURS) % len(_SYMBOLS)]
        traces.append(
            {
                "type": "scatter",
                "mode": "markers",
                "x": [significant(speed)],
                "y": [significant(ratio.value)],
                "name": wrapped(board.labels[key] + mark),
                "marker": {"size": 13, "color": palette[key], "symbol": symbol if ranked else f"{symbol}-open"},
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
    return {"data": traces, "layout": _speed_layout([(speed, ratio) for _, speed, ratio, _ in points])}


def _speed_layout(points: Sequence[tuple[float, Interval]]) -> dict[str, Any]:
    ends = [end for _, ratio in points for end in (ratio.value, ratio.low, ratio.high)]
    note = {"x": 0, "xref": "x", "y": 1, "yref": "paper", "text": "real time", "showarrow": False}
    note |= {"xanchor": "left", "yanchor": "top", "xshift": 5, "font": {"size": 11, "color": "#6b7280"}}
    speeds = "× real time: frame interval over mean frame time (right is better)"
    return layout_of(
        height=max(460, 120 + 21 * len(points)),
        xaxis=log_axis(speeds, [1.0, *(speed for speed, _ in points)]),
        yaxis=log_axis("ATE ratio (down is better)", [1.0, *ends]),
        shapes=[guide(x=1.0), guide(y=1.0)],
        annotations=[note],
    )


def repeat_figure(board: Board) -> Figure | None:
    """The ATE of every run that succeeded over their median in its cell; None where no cell has several."""
    palette = colours(board)
    traces: list[dict[str, Any]] = []
    everything = [0.9, 1.1]
    for key in board.trackers:
        values: list[float] = []
        notes: list[str] = []
        for sequence in board.sequences:
            cell = board.cells[key].get(sequence)
            if cell is None or len(cell.succeeded) < 2:
                continue
            scores = [row.score_m or 0.0 for row in cell.succeeded]
            base = max(median(scores), 1e-6)
            values += [max(score, 1e-6) / base for score in scores]
            notes += [f"{safe(sequence)}, {row.repeat}" for row in cell.succeeded]
        if values:
            everything += values
            shown = _spread(values)
            values, notes = [values[at] for at in shown], [notes[at] for at in shown]
            traces.append(
                {
                    "type": "box",
                    "x": rounded(values),
                    "name": wrapped(board.labels[key]),
                    "text": notes,
                    "orientation": "h",
                    "boxpoints": "all",
                    "jitter": 0.5,
                    "pointpos": 0,
                    "fillcolor": "rgba(0,0,0,0)",
                    "line": {"width": 0},
                    "marker": {"size": 7, "opacity": 0.75, "color": palette[key]},
                    "hovertemplate": "%{text}<br>%{x:.3f} × median<extra></extra>",
                }
            )
    if not traces:
        return None
    layout = layout_of(
        height=110 + 34 * len(traces),
        xaxis=log_axis("ATE over the median of the same tracker on the same sequence", everything),
        yaxis={"autorange": "reversed", "automargin": True, "gridcolor": GRID},
        shapes=[guide(x=1.0)],
        margin={"l": 20, "r": 30, "t": 40, "b": 60},
        showlegend=False,
    )
    return {"data": traces, "layout": layout}


def mask_figure(board: Board) -> Figure | None:
    """Quality of the masks against the pose error, one point a run; None where no run has it."""
    palette = colours(board)
    traces: list[dict[str, Any]] = []
    everything: list[float] = []
    for key in board.trackers:
        rows = [
            row for row in board.runs(key) if row.mask_iou is not None and row.score_m is not None and not row.failed
        ]
        if rows:
            rows = [rows[at] for at in _spread([row.score_m or 0.0 for row in rows])]
            everything += [1000 * max(float(row.score_m or 0.0), 1e-6) for row in rows]
            traces.append(
                {
                    "type": "scatter",
                    "mode": "markers",
                    "name": wrapped(board.labels[key]),
                    "x": rounded([float(row.mask_iou or 0.0) for row in rows]),
                    "y": rounded([1000 * max(float(row.score_m or 0.0), 1e-6) for row in rows]),
                    "text": [
                        f"{safe(board.sequence(row))}, {row.repeat}, masks: {safe(label_text(row.segmentation))}"
                        for row in rows
                    ],
                    "marker": {"size": 9, "opacity": 0.85, "color": palette[key]},
                    "hovertemplate": "%{text}<br>IoU %{x:.3f}<br>ATE %{y:.3g} mm<extra>%{fullData.name}</extra>",
                }
            )
    if not traces:
        return None
    layout = layout_of(
        height=max(420, 120 + 21 * len(traces)),
        xaxis=axis("overlap (IoU) of the dynamic mask with the exact one") | {"range": [-0.02, 1.02]},
        yaxis=log_axis("ATE (mm)", everything),
    )
    return {"data": traces, "layout": layout}


def _spread(values: Sequence[float]) -> list[int]:
    """Which of some values are drawn: all of up to `MOST_POINTS`; of more, from the smallest to the largest."""
    if len(values) <= MOST_POINTS:
        return list(range(len(values)))
    order = np.argsort(values, kind="stable")
    shown = order[np.linspace(0, len(values) - 1, MOST_POINTS).round().astype(int)]
    return sorted(int(at) for at in shown)


def _pareto(points: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    """Points (speed, error) that no other beats in both, from slow to fast."""
    front = [p for p in points if not any(q != p and q[0] >= p[0] and q[1] <= p[1] for q in points)]
    return sorted(set(front))
