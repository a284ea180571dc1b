"""Static pictures of charts, for paper and for readers without scripts: plotly's figures, drawn by matplotlib."""

import base64
import html
import io
import math
import warnings
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import matplotlib
import numpy as np
import plotly.graph_objects as go
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullLocator
from matplotlib.transforms import blended_transform_factory
from numpy.typing import NDArray
from plotly.colors import unlabel_rgb

from dynslam_bench.reports.figures import NEUTRAL

Array = NDArray[np.float64]

WIDTH_INCHES = 9.6
"""Width of a picture: that of a page of paper between its margins."""
LETTER_INCHES = 0.07
"""About the width of a letter of a label: room is left for labels, since to measure them takes a second drawing."""
LINE_INCHES = 0.17
"""Height of a line of the legend."""
PIXELS_PER_INCH = 96
"""Pixels of a figure's height in an inch of paper, as CSS has it."""
_MARKERS = {
    "circle": "o",
    "square": "s",
    "diamond": "D",
    "triangle-up": "^",
    "cross": "P",
    "x": "X",
    "star": "*",
    "pentagon": "p",
    "hexagon": "h",
    "bowtie": "d",
    "line-ns": "|",
}
"""Symbols of plotly's points to matplotlib's."""
_DASHES = {"solid": "-", "dash": "--", "dot": ":", "dashdot": "-."}
_POINTS_PER_PIXEL = 0.75
_NARROW = 6.0
"""A logarithmic axis that ends below so many times its beginning has evenly spaced labels: 1, 2 and 5 are too few."""
_STYLE: dict[Any, Any] = {
    # letters stay letters, and names with a dollar sign are no formulas
    "svg.fonttype": "none",
    "svg.hashsalt": "dynslam-bench",
    "text.parse_math": False,
    "font.size": 9,
    "axes.edgecolor": NEUTRAL,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#e3e7ec",
}


def still(figure: go.Figure) -> str:
    """A figure as the address of a picture (``data:image/svg+xml``).

    Lines, points and bars in one panel are drawn.

    Args:
        figure: A figure of plotly.

    Returns:
        The address; empty for other figures.
    """
    if not figure.data or not all(_is_drawn(trace) for trace in figure.data):
        return ""
    height = (figure.layout.height or 420) / PIXELS_PER_INCH
    with matplotlib.rc_context(_STYLE):
        picture = Figure()
        axes = picture.add_subplot()
        _draw(figure, axes)
        _leave_room(picture, axes, height)
        text = io.StringIO()
        with warnings.catch_warnings():
            # letters stay letters: the reader's browser has the font, whatever is installed here
            warnings.filterwarnings("ignore", message="Glyph .* missing from font")
            picture.savefig(text, format="svg", metadata={"Date": None})
    encoded = base64.b64encode(text.getvalue().encode()).decode()
    return f"data:image/svg+xml;base64,{encoded}"


def _leave_room(picture: Figure, axes: Axes, height: float) -> None:
    """Set the size of a picture, in inches, and the margins that its labels and its legend need."""
    legend = axes.get_legend()
    entries = [] if legend is None else [text.get_text() for text in legend.get_texts()]
    lines = sum(1 + entry.count("\n") for entry in entries)
    height = max(height, LINE_INCHES * (lines + 4))
    left = 0.55 + LETTER_INCHES * _longest(label.get_text() for label in axes.get_yticklabels())
    right = 0.6 + LETTER_INCHES * _longest(entries) if entries else 0.2

    # names along the axis below are turned where they would overlap
    names = [label.get_text() for label in axes.get_xticklabels()]
    bottom = 0.55
    if LETTER_INCHES * sum(len(name) + 2 for name in names) > WIDTH_INCHES - left - right:
        axes.tick_params("x", labelrotation=30)
        for label in axes.get_xticklabels():
            label.set_horizontalalignment("right")
        bottom += 0.5 * LETTER_INCHES * _longest(names)

    picture.set_size_inches(WIDTH_INCHES, height + bottom)
    picture.subplots_adjust(
        left=left / WIDTH_INCHES,
        right=1 - right / WIDTH_INCHES,
        bottom=bottom / (height + bottom),
        top=1 - 0.15 / (height + bottom),
    )


def _longest(labels: Iterable[str]) -> int:
    """Letters of the longest line of some labels."""
    return max((len(line) for label in labels for line in label.split("\n")), default=0)


def _is_drawn(trace: Any) -> bool:
    """Whether a trace is one of those that are drawn here."""
    in_first_panel = trace.type in ("scatter", "bar") and trace.xaxis in (None, "x")
    return in_first_panel and trace.yaxis in (None, "y") and trace.x is not None


def _draw(figure: go.Figure, axes: Axes) -> None:
    """Draw traces, guides, notes and legend of a figure."""
    layout = figure.layout

    # names along an axis are places 0, 1, ...
    x_names = _names(layout.xaxis, [trace.x for trace in figure.data])
    y_names = _names(layout.yaxis, [trace.y for trace in figure.data])
    axes.set_xscale("log" if layout.xaxis.type == "log" else "linear")
    axes.set_yscale("log" if layout.yaxis.type == "log" else "linear")

    # the traces; bars of one place stand side by side
    bars = [trace for trace in figure.data if trace.type == "bar"]
    for trace in figure.data:
        x = _places(trace.x, x_names)
        y = _places(trace.y, y_names)
        if trace.type == "bar":
            width = 0.8 / len(bars)
            shift = (bars.index(trace) - (len(bars) - 1) / 2) * width
            _draw_bars(axes, trace, x + shift, y, width)
        else:
            _draw_scatter(axes, trace, x, y)

    # guides at one value, and words
    for shape in layout.shapes:
        style: dict[str, Any] = {"color": NEUTRAL, "linestyle": "--", "linewidth": 0.8}
        if shape.type == "line" and shape.x0 == shape.x1:
            axes.axvline(shape.x0, **style)
        elif shape.type == "line":
            axes.axhline(shape.y0, **style)
    for note in layout.annotations:
        _write_note(axes, note)

    # axes
    _set_labels(axes.xaxis, layout.xaxis, x_names)
    _set_labels(axes.yaxis, layout.yaxis, y_names)
    axes.set_xlabel(_plain(layout.xaxis.title.text or ""))
    axes.set_ylabel(_plain(layout.yaxis.title.text or ""))
    if layout.yaxis.range is not None and layout.yaxis.type != "log":
        axes.set_ylim(layout.yaxis.range)
    _, labels = axes.get_legend_handles_labels()
    if labels and layout.showlegend is not False:
        axes.legend(loc="upper left", bbox_to_anchor=(1.01, 1.0), frameon=False)


def _one_colour(colour: object) -> str | tuple[float, float, float]:
    """A trace's colour as matplotlib takes it; `NEUTRAL` for none, and for one a point.

    Args:
        colour: A name, ``#rrggbb``, ``rgb(r, g, b)`` with levels of 0 to 255, or numbers on a colour scale.
    """
    if not isinstance(colour, str):
        return NEUTRAL
    if not colour.startswith("rgb("):
        return colour
    red, green, blue = unlabel_rgb(colour)
    return (red / 255, green / 255, blue / 255)


def _draw_scatter(axes: Axes, trace: Any, x: Array, y: Array) -> None:
    """Draw a trace's line, its points and their error bars."""
    mode = trace.mode or "lines"
    label = _legend_label(trace)
    marker = trace.marker
    marker_colour = _one_colour(marker.color)
    line_colour = _one_colour(trace.line.color or marker.color)
    if "lines" in mode:
        dash = _DASHES.get(trace.line.dash or "solid", "-")
        width = _POINTS_PER_PIXEL * (trace.line.width or 2)
        steps = "steps-post" if trace.line.shape == "hv" else "default"
        axes.plot(x, y, dash, color=line_colour, linewidth=width, drawstyle=steps, label=label)
        label = None
    if trace.error_y.array is not None:
        ends = [np.asarray(trace.error_y.arrayminus, float), np.asarray(trace.error_y.array, float)]
        axes.errorbar(x, y, yerr=ends, fmt="none", ecolor=marker_colour)
    if "markers" not in mode:
        return

    # points of one symbol at a time
    given = marker.symbol or "circle"
    symbols = [given] * len(x) if isinstance(given, str) else list(given)
    colour = marker_colour if isinstance(marker.color, str) else line_colour
    size = _POINTS_PER_PIXEL * (marker.size if isinstance(marker.size, int | float) else 6)
    is_seen = trace.opacity != 0
    for symbol in dict.fromkeys(symbols):
        here = np.array([drawn == symbol for drawn in symbols])
        axes.plot(
            x[here],
            y[here],
            marker=_MARKERS.get(symbol.removesuffix("-open"), "o"),
            markerfacecolor="none" if symbol.endswith("-open") else colour,
            markeredgecolor=colour,
            markersize=size,
            linestyle="none",
            alpha=marker.opacity if is_seen else 0.0,
            label=label,
        )
        label = None


def _draw_bars(axes: Axes, trace: Any, x: Array, y: Array, width: float) -> None:
    """Draw a trace's bars, with the words above them."""
    axes.bar(
        x,
        y,
        width,
        color=_one_colour(trace.marker.color),
        alpha=trace.marker.opacity,
        label=_legend_label(trace),
    )
    if trace.text is None:
        return
    for text, left, top in zip(trace.text, x, y, strict=True):
        if text and math.isfinite(top):
            axes.text(left, top, _plain(text), ha="center", va="bottom")


def _legend_label(trace: Any) -> str | None:
    """Name of a trace in the legend; None for one that is not in it."""
    return _plain(trace.name) if trace.name and trace.showlegend is not False else None


def _write_note(axes: Axes, note: Any) -> None:
    """Write an annotation at its place, which is a share of the panel or a value."""
    x = 10.0**note.x if axes.get_xscale() == "log" and note.xref != "paper" else note.x
    y = 10.0**note.y if axes.get_yscale() == "log" and note.yref != "paper" else note.y
    transform = blended_transform_factory(
        axes.transAxes if note.xref == "paper" else axes.transData,
        axes.transAxes if note.yref == "paper" else axes.transData,
    )
    horizontal = note.xanchor if note.xanchor in ("left", "right") else "center"
    vertical = note.yanchor if note.yanchor in ("top", "bottom") else "center"
    axes.text(x, y, f" {_plain(note.text)} ", transform=transform, ha=horizontal, va=vertical)


def _names(axis: Any, columns: Iterable[Any]) -> list[str]:
    """The names along an axis, in their order from 0 on; none along an axis of numbers."""
    if axis.categoryarray is not None:
        return list(axis.categoryarray)
    values = [value for column in columns for value in ([] if column is None else column)]
    names = [value for value in values if isinstance(value, str)]
    return list(dict.fromkeys(names))


def _places(values: Sequence[Any] | None, names: Sequence[str]) -> Array:
    """Values along an axis as numbers ``[N]``: a name's place, nan for None."""
    place_of: Mapping[Any, float] = {name: float(place) for place, name in enumerate(names)}
    numbers = []
    for value in [] if values is None else values:
        if value is None:
            numbers.append(math.nan)
        else:
            numbers.append(place_of[value] if isinstance(value, str) else float(value))
    return np.array(numbers)


def _set_labels(side: Axis, axis: Any, names: Sequence[str]) -> None:
    """Labels of an axis: its names, its own labels, or numbers; on a logarithmic one 1, 2, 5, 10 and so on."""
    if names:
        side.set_ticks(range(len(names)), [_plain(name) for name in names])
    elif axis.type == "log":
        low, high = side.get_view_interval()
        is_narrow = high < _NARROW * low
        side.set_major_locator(MaxNLocator(6) if is_narrow else LogLocator(subs=(1.0, 2.0, 5.0)))
        side.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        side.set_minor_locator(NullLocator())
    elif axis.tickvals is not None and axis.ticktext is not None:
        side.set_ticks(axis.tickvals, [_plain(text) for text in axis.ticktext])


def _plain(text: str) -> str:
    """A label without markup."""
    return html.unescape(str(text).replace("<br>", "\n"))
