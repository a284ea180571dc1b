"""The paper's Figures 9 to 12, drawn of our own runs: bars of the absolute error, one figure a statistic."""

from __future__ import annotations

from ..model.board import Board
from ..tables.paper import LOST_MARK, STATISTICS, averages, has_lost
from .style import Figure, axis, colours, layout_of, rounded, safe, wrapped

FIGURES = {"mean": 9, "median": 10, "rmse": 11, "std": 12}
"""Statistic to the number of the paper's figure."""


def bar_figure(board: Board, statistic: str) -> Figure | None:
    """One statistic of the absolute error in millimetres, a group of bars a sequence; None where no run has it.

    Args:
        board: The board.
        statistic: ``mean``, ``median``, ``rmse`` or ``std``.
    """
    palette = colours(board)
    found = averages(board, f"ate_{statistic}_m", board.trackers)
    traces = [
        {
            "type": "bar",
            "name": wrapped(board.labels[key]),
            "x": [safe(board.short[name]) for name in values],
            "y": rounded([1000 * value for value in values.values()]),
            "text": [LOST_MARK * has_lost(board.cells[key].get(name)) for name in values],
            "textposition": "outside",
            "cliponaxis": False,
            "marker": {"color": palette[key], "opacity": 1.0 if key in board.ranked else 0.45},
            "hovertemplate": "%{x}<br>%{y:.3g} mm<extra>%{fullData.name}</extra>",
        }
        for key, values in found.items()
        if values
    ]
    if not traces:
        return None
    layout = layout_of(
        height=max(380, 110 + 19 * len(traces)),
        barmode="group",
        xaxis=axis("sequence", type="category"),
        yaxis=axis(f"absolute pose error, {STATISTICS[statistic]} (mm)") | {"rangemode": "tozero"},
    )
    return {"data": traces, "layout": layout}
