"""The report's figures as plotly specifications (plain dictionaries: data and layout), drawn by the page itself."""

from __future__ import annotations

import html
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.evaluation.evaluate import pose_errors
from dynslam_bench.evaluation.protocol import Protocol
from dynslam_bench.geometry.trajectory import Trajectory

from .board import Board

Figure = dict[str, Any]
COLOURS = (
    "#1f6fb4", "#d9542b", "#2a9d6f", "#8a5cc2", "#c9970c", "#3aa6c9", "#c2427f", "#6b7a1f", "#8c564b", "#4b5fd6",
    "#e08a3c", "#178f8f", "#a83232", "#7f7f7f", "#5aa02c", "#b07cc6", "#b8860b", "#2f4b7c", "#d45087", "#665191",
)  # fmt: skip
_SYMBOLS = ("circle", "square", "diamond", "triangle-up", "triangle-down", "cross", "x", "pentagon", "hexagon", "star")
_TRUTH = "#111827"
_GRID = "#e5e7eb"
_MOST_POINTS = 500


def colours(board: Board) -> dict[str, str]:
    """One colour for every tracker, the same in all figures."""
    return {key: COLOURS[i % len(COLOURS)] for i, key in enumerate(board.trackers)}


def ratio_figure(board: Board) -> Figure | None:
    """Geometric-mean ATE ratios with their intervals, best on top; None where nothing is scored."""
    standings = [s for s in board.standings if np.isfinite(s.ratio.value)]
    if not standings:
        return None
    palette = colours(board)
    names = [_wrapped(board.labels[s.key]) for s in standings]
    point = [s.ratio.value for s in standings]
    trace = {
        "type": "scatter",
        "mode": "markers",
        "x": _round(point),
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
            "array": _round([s.ratio.high - s.ratio.value for s in standings]),
            "arrayminus": _round([s.ratio.value - s.ratio.low for s in standings]),
            "color": "#6b7280",
            "thickness": 1.4,
            "width": 5,
        },
        "hovertemplate": "%{y}<br>ratio %{x:.3f}<extra></extra>",
    }
    low, high = min(s.ratio.low for s in standings), max(s.ratio.high for s in standings)
    layout = _layout(
        height=110 + 34 * len(standings),
        xaxis=_log_axis(f"ATE ratio to {_text(board.reference_name)} (left is better)", [low, high, 1.0]),
        yaxis={"autorange": "reversed", "automargin": True, "gridcolor": _GRID, "ticks": ""},
        shapes=[_line(x=1.0)],
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
        factors = [row.real_time_factor for row in board.runs(key) if row.real_time_factor and not row.failed]
        if key in standings and factors and np.isfinite(standings[key].ratio.value):
            points.append((key, float(np.median(factors)), standings[key].ratio))
    if not points:
        return None
    traces: list[dict[str, Any]] = []
    front = _pareto([(speed, ratio.value) for key, speed, ratio in points if key in board.ranked])
    if len(front) > 1:
        traces.append(
            {
                "type": "scatter",
                "mode": "lines",
                "x": _round([x for x, _ in front]),
                "y": _round([y for _, y in front]),
                "line": {"color": "#9ca3af", "width": 1.5, "dash": "dot", "shape": "linear"},
                "name": "Pareto front",
                "hoverinfo": "skip",
            }
        )
    for index, (key, speed, ratio) in enumerate(points):
        ranked = key in board.ranked
        symbol = _SYMBOLS[index // len(COLOURS) % len(_SYMBOLS)]
        traces.append(
            {
                "type": "scatter",
                "mode": "markers",
                "x": [_significant(speed)],
                "y": [_significant(ratio.value)],
                "name": _wrapped(board.labels[key]),
                "marker": {"size": 13, "color": palette[key], "symbol": symbol if ranked else f"{symbol}-open"},
                "error_y": {
                    "type": "data",
                    "symmetric": False,
                    "array": [_significant(ratio.high - ratio.value)],
                    "arrayminus": [_significant(ratio.value - ratio.low)],
                    "thickness": 1,
                    "width": 3,
                    "color": palette[key],
                },
                "hovertemplate": "%{fullData.name}<br>%{x:.2f} × real time<br>ratio %{y:.3f}<extra></extra>",
            }
        )
    layout = _layout(
        height=max(460, 120 + 21 * len(points)),
        xaxis=_log_axis(
            "× real time: frame interval over mean frame time (right is better)",
            [1.0, *(speed for _, speed, _ in points)],
        ),
        yaxis=_log_axis(
            "ATE ratio (down is better)", [1.0, *(r for _, _, ratio in points for r in (ratio.low, ratio.high))]
        ),
        shapes=[_line(x=1.0), _line(y=1.0)],
        annotations=[
            {
                "x": 0, "xref": "x", "y": 1, "yref": "paper", "text": "real time", "showarrow": False,
                "xanchor": "left", "yanchor": "top", "xshift": 5, "font": {"size": 11, "color": "#6b7280"},
            }
        ],
    )  # fmt: skip
    return {"data": traces, "layout": layout}


def repeat_figure(board: Board) -> Figure | None:
    """Every run's ATE over its cell's median; None where no cell has several runs."""
    palette = colours(board)
    traces: list[dict[str, Any]] = []
    everything = [0.9, 1.1]
    for key in board.trackers:
        values: list[float] = []
        notes: list[str] = []
        for sequence in board.sequences:
            cell = board.cells[key].get(sequence)
            if cell is None or len(cell.scores) < 2 or cell.median is None:
                continue
            for row in cell.rows:
                if row.score_m is not None:
                    values.append(max(row.score_m, 1e-6) / max(cell.median, 1e-6))
                    notes.append(f"{_text(sequence)}, seed {row.seed}{' (failed)' if row.failed else ''}")
        if values:
            everything += values
            traces.append(
                {
                    "type": "box",
                    "x": _round(values),
                    "name": _wrapped(board.labels[key]),
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
    layout = _layout(
        height=110 + 34 * len(traces),
        xaxis=_log_axis("ATE over the median of the same tracker on the same sequence", everything),
        yaxis={"autorange": "reversed", "automargin": True, "gridcolor": _GRID},
        shapes=[_line(x=1.0)],
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
            row
            for row in board.runs(key)
            if row.mask_iou is not None and row.score_m is not None and row.sequence_key in board.never_move
        ]
        if rows:
            everything += [max(float(row.score_m or 0.0), 1e-6) for row in rows]
            traces.append(
                {
                    "type": "scatter",
                    "mode": "markers",
                    "name": _wrapped(board.labels[key]),
                    "x": _round([float(row.mask_iou or 0.0) for row in rows]),
                    "y": _round([max(float(row.score_m or 0.0), 1e-6) for row in rows]),
                    "text": [
                        f"{_text(row.sequence_key)}, seed {row.seed}, masks: {_text(row.segmentation)}" for row in rows
                    ],
                    "marker": {"size": 9, "opacity": 0.85, "color": palette[key]},
                    "hovertemplate": "%{text}<br>IoU %{x:.3f}<br>ATE %{y:.4f} m<extra>%{fullData.name}</extra>",
                }
            )
    if not traces:
        return None
    layout = _layout(
        height=max(420, 120 + 21 * len(traces)),
        xaxis=_axis("overlap (IoU) of the dynamic mask with the exact one") | {"range": [-0.02, 1.02]},
        yaxis=_log_axis("ATE (m)", everything),
    )
    return {"data": traces, "layout": layout}


def sequence_figures(
    board: Board, truth: Trajectory, estimates: Mapping[str, Trajectory], protocol: Protocol
) -> tuple[Figure, Figure]:
    """Trajectories seen along the three axes, and the error over time, of one sequence.

    Args:
        board: Gives labels and colours.
        truth: Ground truth.
        estimates: Variant key to the trajectory of one of its runs.
        protocol: How to align.

    Returns:
        The two figures; lines are broken where a gap is longer than twice the median interval.
    """
    palette = colours(board)
    places = (("x", "y", 0, 1), ("x", "z", 0, 2), ("y", "z", 1, 2))
    start = float(truth.timestamps[0])
    paths: list[dict[str, Any]] = []
    errors: list[dict[str, Any]] = []
    shown = set((board.ranked_order() or board.trackers)[:6]) | ({board.reference} if board.reference else set())
    drawn: list[tuple[str, str, NDArray[np.float64], NDArray[np.float64], str]] = []
    window = _overlap(truth, estimates)
    drawn.append(("", "ground truth", window.timestamps, window.positions, _TRUTH))
    for key, estimate in estimates.items():
        aligned, _, series = pose_errors(estimate, truth, protocol)
        drawn.append((key, _wrapped(board.labels[key]), aligned.timestamps, aligned.positions, palette[key]))
        stamps, values = broken(aligned.timestamps - start, series["trans_m"][:, None])
        errors.append(
            _line_trace(_wrapped(board.labels[key]), palette[key], stamps, values[:, 0], key in shown, width=1.6)
            | {"hovertemplate": "%{y:.4f} m at %{x:.2f} s<extra>%{fullData.name}</extra>"}
        )
    for key, name, stamps, positions, colour in drawn:
        _, xyz = broken(stamps, positions)
        for panel, (_, _, i, j) in enumerate(places, start=1):
            suffix = "" if panel == 1 else str(panel)
            trace = _line_trace(name, colour, xyz[:, i], xyz[:, j], not key or key in shown, width=1.4 if key else 2.4)
            paths.append(
                trace | {"xaxis": f"x{suffix}", "yaxis": f"y{suffix}", "legendgroup": key, "showlegend": panel == 1,
                         "hoverinfo": "name"}
            )  # fmt: skip
    layout = _layout(height=max(430, 110 + 19 * len(drawn)))
    centre, half = _view(window, [xyz for key, _, _, xyz, _ in drawn if key in shown])
    for panel, (a, b, i, j) in enumerate(places, start=1):
        suffix = "" if panel == 1 else str(panel)
        left = (panel - 1) * 0.36
        layout[f"xaxis{suffix}"] = _axis(f"{a} (m)") | {
            "domain": [left, left + 0.28], "constrain": "domain",
            "range": [_significant(centre[i] - half), _significant(centre[i] + half)],
        }  # fmt: skip
        layout[f"yaxis{suffix}"] = _axis(f"{b} (m)") | {
            "anchor": f"x{suffix}", "scaleanchor": f"x{suffix}", "constrain": "domain",
            "range": [_significant(centre[j] - half), _significant(centre[j] + half)],
        }  # fmt: skip
    over_time = _layout(
        height=max(340, 100 + 19 * len(errors)),
        xaxis=_axis("time since the first true pose (s)"),
        yaxis=_axis("absolute error (m)") | {"rangemode": "tozero"},
    )
    return {"data": paths, "layout": layout}, {"data": errors, "layout": over_time}


def broken(
    stamps: NDArray[np.float64], values: NDArray[np.float64], most: int = _MOST_POINTS
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Thin a series and put NaN where the time between two poses exceeds twice the median interval.

    Args:
        stamps: Seconds ``[N]``.
        values: ``[N, K]``.
        most: About how many points to keep.

    Returns:
        Stamps ``[M]`` and values ``[M, K]`` with NaN rows in the gaps.
    """
    if len(stamps) < 3:
        return stamps, values
    intervals = np.diff(stamps)
    piece = np.concatenate([[0], np.cumsum(intervals > 2 * np.median(intervals))])
    step = max(1, -(-len(stamps) // most))
    keep = np.arange(len(stamps)) % step == 0
    edge = np.diff(piece) > 0
    keep |= np.append(edge, True) | np.append(True, edge)  # the ends of every piece stay
    kept = np.flatnonzero(keep)
    breaks = np.flatnonzero(np.diff(piece[kept]) > 0) + 1
    middle = (stamps[kept][breaks - 1] + stamps[kept][breaks]) / 2
    return (
        np.insert(stamps[kept], breaks, middle),
        np.insert(values[kept], breaks, np.nan, axis=0),
    )


def _overlap(truth: Trajectory, estimates: Mapping[str, Trajectory]) -> Trajectory:
    """The part of the ground truth within the time of the estimates."""
    if not estimates:
        return truth
    start = min(float(e.timestamps[0]) for e in estimates.values()) - 0.02
    stop = max(float(e.timestamps[-1]) for e in estimates.values()) + 0.02
    inside = (truth.timestamps >= start) & (truth.timestamps <= stop)
    return truth.select(inside) if inside.sum() > 1 else truth


def _view(truth: Trajectory, shown: Sequence[NDArray[np.float64]]) -> tuple[NDArray[np.float64], float]:
    """Centre and half the width of a cube that holds the truth and the shown paths, but no more than thrice the truth.

    A path that runs away is cut off rather than shrinking all others to a dot.
    """
    low, high = truth.positions.min(axis=0), truth.positions.max(axis=0)
    most = 1.5 * max(float((high - low).max()), 0.1)
    centre = (low + high) / 2
    reach = [float(np.abs(xyz - centre).max()) for xyz in (truth.positions, *shown) if len(xyz)]
    return centre, 1.06 * max(min(max(reach), most), 0.01)


def _pareto(points: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    """Points (speed, error) that no other beats in both, from slow to fast."""
    front = [p for p in points if not any(q != p and q[0] >= p[0] and q[1] <= p[1] for q in points)]
    return sorted(set(front))


def _line_trace(
    name: str, colour: str, x: NDArray[np.float64], y: NDArray[np.float64], visible: bool, width: float
) -> dict[str, Any]:
    return {
        "type": "scatter",
        "mode": "lines",
        "name": name,
        "x": _round(x.tolist()),
        "y": _round(y.tolist()),
        "line": {"color": colour, "width": width},
        "connectgaps": False,
        "visible": True if visible else "legendonly",
    }


def _layout(height: int, **more: Any) -> dict[str, Any]:
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
    }  # fmt: skip
    return base | more


def _axis(title: str, type: str = "linear") -> dict[str, Any]:
    axis: dict[str, Any] = {
        "title": {"text": title, "standoff": 12, "font": {"size": 13}},
        "gridcolor": _GRID,
        "zeroline": False,
        "linecolor": "#9ca3af",
        "ticks": "outside",
        "tickcolor": "#9ca3af",
        "automargin": True,
        "type": type,
    }
    return axis


def _log_axis(title: str, values: Sequence[float]) -> dict[str, Any]:
    """A logarithmic axis around positive values, labelled 0.1, 0.2, 0.5, 1, ... as the span allows."""
    finite = [value for value in values if np.isfinite(value) and value > 0]
    low, high = float(np.log10(min(finite))), float(np.log10(max(finite)))
    margin = max(0.06 * (high - low), 0.06)
    low, high = low - margin, high + margin
    span = high - low
    steps = range(1, 10) if span < 0.9 else (1, 2, 5) if span < 3 else (1,)
    ticks = [m * 10.0**e for e in range(int(np.floor(low)), int(np.ceil(high)) + 1) for m in steps]
    shown = [tick for tick in ticks if low <= np.log10(tick) <= high]
    return _axis(title, type="log") | {
        "range": [round(low, 4), round(high, 4)],
        "tickvals": [_significant(tick) for tick in shown],
        "ticktext": [f"{tick:g}" for tick in shown],
    }


def _line(x: float | None = None, y: float | None = None) -> dict[str, Any]:
    style = {"type": "line", "layer": "below", "line": {"color": "#9ca3af", "width": 1, "dash": "dash"}}
    if x is not None:
        return style | {"x0": x, "x1": x, "xref": "x", "y0": 0, "y1": 1, "yref": "paper"}
    return style | {"y0": y, "y1": y, "yref": "y", "x0": 0, "x1": 1, "xref": "paper"}


def _significant(value: float | None, digits: int = 5) -> float | None:
    """A number shortened for the page; None for what is no number (JSON knows no NaN)."""
    if value is None or not np.isfinite(value):
        return None
    return float(f"{value:.{digits}g}")


def _round(values: Sequence[float]) -> list[float | None]:
    return [_significant(value) for value in values]


def _text(text: str) -> str:
    """Names come from plug-ins; plotly reads labels as markup."""
    return html.escape(text, quote=False)


def _wrapped(text: str, width: int = 34) -> str:
    """A label broken into lines at blanks."""
    lines = [""]
    for word in text.split():
        if lines[-1] and len(lines[-1]) + 1 + len(word) > width:
            lines.append(word)
        else:
            lines[-1] = f"{lines[-1]} {word}".strip()
    return "<br>".join(_text(line) for line in lines)
