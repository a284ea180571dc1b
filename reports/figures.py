"""The report's figures, as plotly figures; pages set fonts and colours of the theme (`THEMES`)."""

import base64
import html
import textwrap
from collections.abc import Collection, Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
import plotly.graph_objects as go
from numpy.typing import ArrayLike

from dynslam_bench.core import label_text
from dynslam_bench.evaluation.verdicts import FLOOR_M
from dynslam_bench.reports.model.answers import cell_error_m
from dynslam_bench.reports.model.board import Board, timed_on_one
from dynslam_bench.reports.tables.leaderboard import (
    LOST_MARK,
    STATISTICS,
    has_lost,
    medians,
    run_link,
    time_marks,
)

COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#8a8a8a")
"""Okabe and Ito's, without black and yellow, which vanish on one of the two grounds."""
SYMBOLS = (
    "circle",
    "square",
    "diamond",
    "triangle-up",
    "cross",
    "x",
    "star",
    "pentagon",
    "hexagon",
    "bowtie",
)
"""Symbols of trackers in figures of points."""
DASHES = ("solid", "dash", "dot", "dashdot")
"""Styles of trackers' lines."""
NEUTRAL = "#8a8a8a"
"""Colour of axes, guides and true paths."""
_FEWEST_IN_CURVE = 4
"""Sequences below which a curve over them says no more than the points do."""
MOST_POINTS = 400
"""Points of one tracker in the figure of masks; of more runs as many, from the best to the worst."""


def _theme(ink: str, grid: str, paper: str) -> dict[str, Any]:
    """A template of plotly with these colours of text, grid and labels."""
    line = {"gridcolor": grid, "linecolor": NEUTRAL, "zerolinecolor": grid, "automargin": True}
    walls = line | {"showbackground": False}
    return {
        "layout": {
            "font": {
                "family": "Inter, system-ui, 'Segoe UI', Roboto, sans-serif",
                "size": 13,
                "color": ink,
            },
            "paper_bgcolor": "rgba(0,0,0,0)",
            "plot_bgcolor": "rgba(0,0,0,0)",
            "colorway": COLOURS,
            "margin": {"l": 60, "r": 16, "t": 30, "b": 48},
            "hoverlabel": {"bgcolor": paper, "font": {"color": ink}},
            "modebar": {"bgcolor": "rgba(0,0,0,0)", "color": NEUTRAL, "activecolor": COLOURS[0]},
            "xaxis": line,
            "yaxis": line,
            "scene": {"xaxis": walls, "yaxis": walls, "zaxis": walls},
        }
    }


THEMES = {
    "light": _theme("#1b2430", "#e3e7ec", "#ffffff"),
    "dark": _theme("#e7eaf0", "#2b323d", "#1f252e"),
}
"""Plotly templates by the colour scheme of the page."""


def looks(board: Board) -> dict[str, dict[str, str]]:
    """Colour, symbol and dash of every tracker, the same in all figures; several may have one colour."""
    return {
        key: {
            "color": COLOURS[at % len(COLOURS)],
            "symbol": SYMBOLS[(at + at // len(COLOURS)) % len(SYMBOLS)],
            "dash": DASHES[at // len(COLOURS) % len(DASHES)],
        }
        for at, key in enumerate([*board.trackers, *board.final_only])
    }


def packed(values: ArrayLike, kind: str = "f4") -> dict[str, str]:
    """Numbers as plotly's JSON holds them in few characters; nan is a gap."""
    return {
        "dtype": kind,
        "bdata": base64.b64encode(np.asarray(values, dtype=f"<{kind}").tobytes()).decode(),
    }


def significant(value: float | None, digits: int = 5) -> float | None:
    """A number shortened for the page; None for what is no number (JSON knows no NaN)."""
    return None if value is None or not np.isfinite(value) else float(f"{value:.{digits}g}")


def rounded(values: Sequence[float]) -> list[float | None]:
    """Numbers shortened for the page, None for what is no number."""
    return [significant(value) for value in values]


def safe(text: str) -> str:
    """A text without markup: names come from plug-ins, and figures read labels as markup."""
    return html.escape(text, quote=False)


def wrapped(text: str) -> str:
    """A label broken into lines of 34 characters at blanks."""
    return "<br>".join(
        map(safe, textwrap.wrap(text, 34, break_long_words=False, break_on_hyphens=False))
    )


def figure_of(traces: Sequence[Any], height: int, **layout: Any) -> go.Figure | None:
    """A figure in the theme of its page; None without traces."""
    return (
        go.Figure(list(traces), go.Layout(height=height, template={}, **layout)) if traces else None
    )


def log_axis(title: str) -> dict[str, Any]:
    """A logarithmic axis; plotly chooses its labels."""
    return {"type": "log", "title": title, "minexponent": 5}


def mm_axis(title: str) -> dict[str, Any]:
    """A logarithmic axis of errors in millimetres, with labels at 1, 2, 5, 10 and so on, written in full."""
    labels = [f * 10.0**power for power in range(-3, 6) for f in (1, 2, 5)]
    texts = [f"{value:g}" for value in labels]
    return log_axis(title) | {"tickmode": "array", "tickvals": labels, "ticktext": texts}


GUIDE: dict[str, Any] = {"line": {"color": NEUTRAL, "width": 1, "dash": "dash"}, "layer": "below"}
"""A dashed line across a figure at one value."""


def speed_figure(board: Board) -> go.Figure | None:
    """Accuracy against speed, None without timed runs.

    The Pareto front is drawn through the ranked trackers that were timed on the board's
    `timing_computer`.
    """
    # tracker, median of the real-time factor, ATE ratio, and marks behind the name
    look = looks(board)
    placed = board.standing_by_key
    points = []
    ranked = set()
    for key in board.trackers:
        ended = [row for row in board.runs(key) if row.real_time_factor and not row.failed]
        rows = timed_on_one(ended, board.timing_computer)
        factors = [row.real_time_factor for row in rows if row.real_time_factor]
        if key not in placed or not factors or not np.isfinite(placed[key].ratio.value):
            continue
        marks, _ = time_marks(board, ended)
        speed = float(np.median(factors))
        ratio = placed[key].ratio
        points.append((key, speed, ratio, f" {marks}" if marks else ""))
        if key in board.ranked and rows[0].computer == board.timing_computer:
            ranked.add((speed, ratio.value))

    # the Pareto front
    traces: list[Any] = []
    front = _pareto_front(ranked)
    if len(front) > 1:
        traces.append(
            go.Scatter(
                x=rounded([speed for speed, _ in front]),
                y=rounded([ratio for _, ratio in front]),
                mode="lines",
                line={"color": NEUTRAL, "width": 1.5, "dash": "dot"},
                name="Pareto front",
                hoverinfo="skip",
            )
        )

    # a point for every tracker, with the interval of its ratio; open ones are not ranked
    for key, speed, ratio, mark in points:
        symbol = look[key]["symbol"] + "-open" * (key not in board.ranked)
        above = rounded([ratio.high - ratio.value])
        below = rounded([ratio.value - ratio.low])
        traces.append(
            go.Scatter(
                x=[significant(speed)],
                y=[significant(ratio.value)],
                mode="markers",
                name=wrapped(board.names[key] + mark),
                marker={"size": 12, "color": look[key]["color"], "symbol": symbol},
                error_y={"type": "data", "symmetric": False, "array": above, "arrayminus": below},
                hovertemplate="%{fullData.name}<br>%{x:.2f} × real time<br>ratio %{y:.3f}<extra></extra>",
            )
        )
    figure = figure_of(
        traces,
        min(max(420, 110 + 21 * len(points)), 1000),
        showlegend=True,
        xaxis=log_axis("× real time (right is better)"),
        yaxis=log_axis("ATE ratio (down is better)"),
    )
    if figure is not None:
        figure.add_vline(1.0, **GUIDE)
        figure.add_hline(1.0, **GUIDE)
    return figure


def error_figure(board: Board) -> go.Figure | None:
    """A line for each tracker, a point for its error on each sequence, and a bar at the median; None without errors.

    The axis is logarithmic, in millimetres. Crosses are sequences that the tracker lost. A click on
    a point opens its run (``customdata``).
    """
    names = board.common or board.sequences
    look = looks(board)
    lines: list[str] = []
    traces: list[Any] = []
    for key in [*board.trackers, *board.final_only]:
        present = [name for name in names if name in board.cells[key]]
        cells = {name: board.cells[key][name] for name in present}
        errors_mm = {
            name: 1000.0 * error for name in present if (error := cell_error_m(cells[name]))
        }
        if not errors_mm:
            continue
        line = wrapped(board.names[key])
        lines.append(line)
        traces.append(_error_points(board, key, line, errors_mm, look[key]))
        traces.append(_median_bar(line, float(np.median(list(errors_mm.values()))), look[key]))
    figure = figure_of(
        traces,
        110 + 30 * len(lines),
        showlegend=False,
        xaxis=mm_axis("absolute trajectory error (mm), left is better"),
        # below the last tracker there is room for the label of the static camera
        yaxis={
            "categoryorder": "array",
            "categoryarray": lines[::-1],
            "range": [-1.0, len(lines) - 0.5],
        },
    )

    # a guide where a camera that does not move stands
    static_m = [board.static_camera[name] for name in names if board.static_camera[name] > 0]
    if figure is not None and static_m:
        _add_static_camera(figure, 1000.0 * float(np.median(static_m)), lines[:1])
    return figure


def _error_points(
    board: Board, key: str, line: str, errors_mm: Mapping[str, float], look: Mapping[str, str]
) -> go.Scatter:
    """A point for each error of a tracker.

    Args:
        board: The board.
        key: Variant key of the tracker.
        line: Its line in the figure.
        errors_mm: Error in millimetres by sequence.
        look: Its colour and symbol.
    """
    cells = board.cells[key]
    symbol = look["symbol"] if key in board.ranked else f"{look['symbol']}-open"
    return go.Scatter(
        x=rounded([*errors_mm.values()]),
        y=[line] * len(errors_mm),
        mode="markers",
        marker={
            "size": 9,
            "color": look["color"],
            "symbol": ["x" if cells[name].lost else symbol for name in errors_mm],
        },
        customdata=[run_link(cells[name].typical) for name in errors_mm],
        text=[safe(board.short.get(name, name)) for name in errors_mm],
        hovertemplate="%{text}<br>%{x:.4g} mm<extra></extra>",
    )


def _median_bar(line: str, median_mm: float, look: Mapping[str, str]) -> go.Scatter:
    """A bar across a tracker's line at the median of its errors, millimetres."""
    return go.Scatter(
        x=rounded([median_mm]),
        y=[line],
        mode="markers",
        marker={
            "size": 20,
            "color": look["color"],
            "symbol": "line-ns",
            "line": {"width": 3, "color": look["color"]},
        },
        hovertemplate="median %{x:.4g} mm<extra></extra>",
    )


def _add_static_camera(figure: go.Figure, static_mm: float, first_line: list[str]) -> None:
    """Draw the median error of a camera that does not move, with a label at the bottom.

    Args:
        figure: The figure.
        static_mm: Error of a static camera, millimetres.
        first_line: The first line of the figure, in a list of one.
    """
    # an invisible point on the line: axes are fitted to points, not to lines
    blank = go.Scatter(x=[static_mm], y=first_line, mode="markers", opacity=0, hoverinfo="skip")
    figure.add_trace(blank)
    figure.add_vline(static_mm, **GUIDE)
    # annotations on a logarithmic axis take the logarithm of their place
    figure.add_annotation(
        x=float(np.log10(static_mm)),
        y=0.0,
        yref="paper",
        text="not moving",
        xanchor="right",
        yanchor="bottom",
        showarrow=False,
    )


def cumulative_figure(board: Board) -> go.Figure | None:
    """The share of sequences with an error below that of the axis, a line a tracker; None without two sequences.

    As the ETH3D benchmark draws it (Schops et al. 2019). A sequence without a number, since all runs failed or
    there were none, is below no error.
    """
    names = board.common or board.sequences
    if len(names) < _FEWEST_IN_CURVE:
        return None
    look = looks(board)
    errors_mm: dict[str, list[float]] = {}
    for key in [*board.trackers, *board.final_only]:
        of_sequence = board.cells[key]
        cells = [of_sequence[name] for name in names if name in of_sequence]
        measured = [1000.0 * error for cell in cells if (error := cell_error_m(cell))]
        if measured:
            errors_mm[key] = sorted(measured)
    if not errors_mm:
        return None

    # each curve begins at no sequence and goes on to the largest error of all
    largest_mm = max(values[-1] for values in errors_mm.values())
    traces = []
    for key, values in errors_mm.items():
        shares = [100.0 * (at + 1) / len(names) for at in range(len(values))]
        traces.append(
            go.Scatter(
                x=rounded([values[0], *values, largest_mm]),
                y=rounded([0.0, *shares, shares[-1]]),
                mode="lines",
                name=wrapped(board.names[key]),
                line={"color": look[key]["color"], "dash": look[key]["dash"], "shape": "hv"},
                hovertemplate="%{y:.0f} % below %{x:.4g} mm<extra>%{fullData.name}</extra>",
            )
        )
    return figure_of(
        traces,
        max(340, 110 + 30 * len(traces)),
        showlegend=True,
        xaxis=mm_axis("absolute trajectory error (mm)"),
        yaxis={"title": "sequences below it (%)", "range": [0, 103]},
    )


def _pareto_front(points: Collection[tuple[float, float]]) -> list[tuple[float, float]]:
    """Points (speed, ratio) that no other point beats in both, the slowest first."""
    front = []
    for speed, ratio in points:
        others = [point for point in points if point != (speed, ratio)]
        if not any(other >= speed and better <= ratio for other, better in others):
            front.append((speed, ratio))
    return sorted(front)


def mask_figure(board: Board) -> go.Figure | None:
    """Quality of the masks against the pose error, one point a run; None where no run has it."""
    look = looks(board)
    traces = []
    for key in board.trackers:
        points = [
            (
                1000 * max(row.score_m, FLOOR_M),
                row.mask_iou,
                f"{safe(board.sequence(row))}, {row.repeat}, masks: {safe(label_text(row.segmentation))}",
            )
            for row in board.runs(key)
            if row.mask_iou is not None and row.score_m is not None and not row.failed
        ]
        # of many every so many, from the best to the worst
        if len(points) > MOST_POINTS:
            points = sorted(points)[:: -(-len(points) // MOST_POINTS)]
        if points:
            traces.append(
                go.Scatter(
                    x=rounded([iou for _, iou, _ in points]),
                    y=rounded([error_mm for error_mm, _, _ in points]),
                    text=[words for _, _, words in points],
                    mode="markers",
                    name=wrapped(board.names[key]),
                    marker={
                        "size": 8,
                        "opacity": 0.85,
                        "color": look[key]["color"],
                        "symbol": look[key]["symbol"],
                    },
                    hovertemplate="%{text}<br>IoU %{x:.3f}<br>ATE %{y:.3g} mm<extra>%{fullData.name}</extra>",
                )
            )
    overlap = {
        "title": "overlap (IoU) of the mask, dilated, with the exact one",
        "range": [-0.02, 1.02],
    }
    return figure_of(
        traces,
        max(420, 110 + 21 * len(traces)),
        showlegend=True,
        xaxis=overlap,
        yaxis=mm_axis("ATE (mm)"),
    )


def share_figure(
    board: Board, bins: Mapping[str, Sequence[Sequence[float | None]]], edges: Sequence[float]
) -> Any:
    """Frame-to-frame error by the share of the image that shows people; None where nothing is known of it.

    Args:
        board: The board.
        bins: Tracker to the error in mm and the number of frames of each bin.
        edges: Edges of the bins, shares from 0 to 1.
    """
    look = looks(board)
    names = [f"{100 * low:g}–{100 * high:g}" for low, high in pairwise(edges)]
    traces = [
        go.Scatter(
            x=names,
            y=[error_mm for error_mm, _ in bins[key]],
            customdata=[count for _, count in bins[key]],
            mode="lines+markers",
            name=wrapped(board.names[key]),
            line={"color": look[key]["color"], "dash": look[key]["dash"]},
            marker={"symbol": look[key]["symbol"], "size": 8},
            hovertemplate="%{x} %: %{y:.3g} mm over %{customdata} frames<extra>%{fullData.name}</extra>",
        )
        for key in board.trackers
        if any(error_mm is not None for error_mm, _ in bins.get(key, []))
    ]
    shares = {"title": "share of the image that shows people (%)", "type": "category"}
    errors = mm_axis("frame-to-frame error, RMSE (mm)")
    return figure_of(
        traces, max(420, 110 + 21 * len(traces)), showlegend=True, xaxis=shares, yaxis=errors
    )


FIGURES = {"mean": 9, "median": 10, "rmse": 11, "std": 12}
"""Statistic of the absolute error to the number of the paper's figure that shows it."""


def bar_figure(board: Board, statistic: str) -> go.Figure | None:
    """One statistic of the absolute error in millimetres, a group of bars a sequence; None where no run has it.

    Args:
        board: The board.
        statistic: ``mean``, ``median``, ``rmse`` or ``std``.
    """
    look = looks(board)
    errors = medians(board, lambda row: row.metrics.get(f"ate_{statistic}_m"))
    measured = {
        key: [name for name in board.sequences if (key, name) in errors] for key in board.trackers
    }
    traces = [
        go.Bar(
            x=[safe(board.short[name]) for name in names],
            y=rounded([1000 * errors[key, name] for name in names]),
            text=[LOST_MARK * has_lost(board.cells[key][name]) for name in names],
            textposition="outside",
            cliponaxis=False,
            name=wrapped(board.names[key]),
            marker={"color": look[key]["color"], "opacity": 1.0 if key in board.ranked else 0.45},
            hovertemplate="%{x}<br>%{y:.3g} mm<extra>%{fullData.name}</extra>",
        )
        for key, names in measured.items()
        if names
    ]
    return figure_of(
        traces,
        max(380, 100 + 19 * len(traces)),
        barmode="group",
        showlegend=True,
        xaxis={"title": "sequence", "type": "category"},
        yaxis={"title": f"{STATISTICS[statistic]} (mm)", "rangemode": "tozero"},
    )
