"""Static pictures of the board's two charts of errors, for readers without scripts: their points and lines as SVG."""

import html
import math
from typing import Any

import numpy as np
import plotly.graph_objects as go
from markupsafe import Markup

from dynslam_bench.reports.figures import NEUTRAL

WIDTH = 860
"""Width of a picture in pixels; the page shows it as wide as its place."""
NAMES = 230
"""Pixels for names: of trackers at the left, or in the legend at the right."""
MARGIN = 46
"""Pixels for numbers and titles beside the axes, and for nothing elsewhere."""


def static_chart(figure: go.Figure) -> Markup:
    """A chart of errors as SVG: a logarithmic axis of millimetres; names or percents at the other.

    Args:
        figure: As `error_figure` and `cumulative_figure` make it.

    Returns:
        The element; empty for other figures.
    """
    layout = figure.layout
    if layout.xaxis.type != "log" or layout.xaxis.tickvals is None:
        return Markup("")
    names = list(layout.yaxis.categoryarray or ())
    height = int(layout.height)

    # the panel between the axes, and the logarithms of the errors at its ends
    left, right = (NAMES, WIDTH - 20) if names else (MARGIN, WIDTH - NAMES)
    bottom = height - MARGIN
    errors = np.log10([x for trace in figure.data for x in trace.x if x])
    low = float(errors.min()) - 0.05
    high = float(errors.max()) + 0.05

    def x_of(error_mm: float) -> float:
        share = (math.log10(max(error_mm, 10**low)) - low) / (high - low)
        return float(left + (right - left) * share)

    def y_of(value: Any) -> float:
        lowest, highest = layout.yaxis.range
        place = names.index(value) if names else value
        return float(bottom - (bottom - 10) * (place - lowest) / (highest - lowest))

    # the grid with its labels
    parts = []
    for tick, text in zip(layout.xaxis.tickvals, layout.xaxis.ticktext, strict=True):
        if low <= np.log10(tick) <= high:
            x = x_of(tick)
            parts.append(f'<line x1="{x:.1f}" x2="{x:.1f}" y1="10" y2="{bottom}"/>')
            parts.append(_text(x, bottom + 16, text, "middle"))
    for row in names or range(0, 101, 20):
        y = y_of(row)
        parts.append(f'<line x1="{left}" x2="{right}" y1="{y:.1f}" y2="{y:.1f}"/>')
        parts += _label(left - 6, y + 4, str(row), "end")
    parts.append(_text((left + right) / 2, height - 8, layout.xaxis.title.text, "middle"))
    for shape in layout.shapes:
        x = x_of(shape.x0)
        parts.append(f'<line class="guide" x1="{x:.1f}" x2="{x:.1f}" y1="10" y2="{bottom}"/>')
        parts.append(_text(x - 4, bottom - 4, "not moving", "end"))

    # the traces: lines in steps, points, and bars at medians; lines are named in a legend
    legend_y = 20
    for trace in figure.data:
        if trace.opacity == 0:
            continue
        if trace.mode == "lines":
            colour = trace.line.color
            dash = {"dash": "8 5", "dot": "2 4", "dashdot": "8 4 2 4"}.get(trace.line.dash, "none")
            parts.append(
                _steps(
                    [(x_of(x), y_of(y)) for x, y in zip(trace.x, trace.y, strict=True)],
                    colour,
                    dash,
                )
            )
            sample = [(right + 14.0, legend_y - 4.0), (right + 42.0, legend_y - 4.0)]
            parts.append(_steps(sample, colour, dash))
            label = _label(right + 48, legend_y, trace.name, "start")
            parts += label
            legend_y += 20 * len(label)
            continue
        symbols = trace.marker.symbol
        if isinstance(symbols, str):
            symbols = [symbols] * len(trace.x)
        for x, y, symbol in zip(trace.x, trace.y, symbols, strict=True):
            parts.append(_mark(x_of(x), y_of(y), symbol, trace.marker.color))
    return Markup(
        f'<svg class="still" viewBox="0 0 {WIDTH} {height}" role="img">{"".join(parts)}</svg>'
    )


def _mark(x: float, y: float, symbol: str, colour: str) -> str:
    """A bar at a median, a cross for a lost sequence, else a dot; an open one does not rank."""
    if symbol == "line-ns":
        ends = f'x1="{x:.1f}" x2="{x:.1f}" y1="{y - 10:.1f}" y2="{y + 10:.1f}"'
        return f'<line {ends} style="stroke:{colour};stroke-width:3"/>'
    if symbol == "x":
        return f'<path d="M{x - 4:.1f} {y - 4:.1f}l8 8m0-8l-8 8" style="stroke:{colour};stroke-width:2.5"/>'
    fill = "none" if symbol.endswith("-open") else colour
    return f'<circle cx="{x:.1f}" cy="{y:.1f}" r="4" style="fill:{fill};stroke:{colour};stroke-width:1.5"/>'


def _steps(points: list[tuple[float, float]], colour: str, dash: str) -> str:
    """A line that keeps its height until the next point."""
    path = f"M{points[0][0]:.1f} {points[0][1]:.1f}"
    path += "".join(f"H{x:.1f}V{y:.1f}" for x, y in points[1:])
    return f'<path d="{path}" style="fill:none;stroke:{colour or NEUTRAL};stroke-width:2;stroke-dasharray:{dash}"/>'


def _label(x: float, y: float, text: str, anchor: str) -> list[str]:
    """The lines of a label of a figure, whose markup is a break of a line and escaped letters."""
    lines = text.split("<br>")
    first_y = y - 8 * (len(lines) - 1) if anchor == "end" else y
    return [
        _text(x, first_y + 16 * at, html.unescape(line), anchor) for at, line in enumerate(lines)
    ]


def _text(x: float, y: float, text: str, anchor: str) -> str:
    """One line of letters."""
    return f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}">{html.escape(text)}</text>'
