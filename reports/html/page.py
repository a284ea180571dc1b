"""The HTML pages: sections of tables and figures; style and scripts in the page, large data in side files."""

from __future__ import annotations

import base64
import json
import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jinja2 import Environment, FunctionLoader
from markupsafe import Markup, escape
from numpy.typing import ArrayLike

from dynslam_bench.core.files import write_atomic
from dynslam_bench.reports.figures import Figure
from dynslam_bench.reports.tables.table import Table

_STYLES = ("report.css", "figures.css")
_CHARTS = ("scales.js", "traces.js", "chart.js", "hover.js", "store.js", "page.js")
_EXPLORE = ("explore.js", "explore_figures.js", "tracks.js")
_RUN = ("run.js", "run_figures.js", "view3d.js", "annotations.js")


@dataclass
class Block:
    """Something in a section.

    Attributes:
        kind: Which of the other attributes count.
        title: Heading above it, or what is seen of it when it is closed.
        table: For ``table``.
        figure: Id of the figure, for ``figure``.
        chart: Its specification.
        caption: Below the figure, or behind the title of ``tracks``.
        text: For ``code``.
        entries: For ``list``.
        tracks: For ``tracks``: the runs to draw, each with its name and colour and whether it is shown at first.
        folded: Whether a table, a list or tracks are closed at first, behind their title.
    """

    kind: Literal["table", "figure", "code", "list", "caption", "tracks", "explore"]
    title: str = ""
    table: Table | None = None
    figure: str = ""
    chart: Figure = field(default_factory=dict)
    caption: str = ""
    text: str = ""
    entries: list[str] = field(default_factory=list)
    tracks: list[dict[str, Any]] = field(default_factory=list)
    folded: bool = False


@dataclass
class Section:
    """A section of the page.

    Attributes:
        id: For links.
        title: Heading.
        short: In the list of contents.
        notes: Set off above everything else.
        blocks: Its content.
    """

    id: str
    title: str
    short: str
    notes: list[str] = field(default_factory=list)
    blocks: list[Block] = field(default_factory=list)


def table_blocks(*tables: Table | None, folded: bool = False) -> list[Block]:
    """Blocks that show the tables that there are; folded ones are closed at first, behind their titles."""
    return [Block("table", t.title if folded else "", t, folded=folded) for t in tables if t is not None]


def figure_blocks(name: str, chart: Figure | None, caption: str = "") -> list[Block]:
    """A block that shows a figure; none for no figure."""
    return [] if chart is None else [Block("figure", figure=name, chart=chart, caption=caption)]


def render(
    sections: Sequence[Section],
    *,
    title: str,
    protocol: str,
    facts: Sequence[tuple[str, str]],
    footer: str,
) -> str:
    """The page as one HTML text that fetches nothing but the side files beside it.

    Args:
        sections: What to show, in order.
        title: Heading.
        protocol: One line below it.
        facts: Numbers and what they count.
        footer: Last line.
    """
    blocks = [block for section in sections for block in section.blocks]
    explores = any(block.kind == "explore" for block in blocks)
    figures = {block.figure: block.chart for block in blocks if block.figure}
    return _render(
        "report.html.j2", _EXPLORE if explores else (), title=title, protocol=protocol, facts=facts, sections=sections,
        footer=footer, figures=Markup(to_script(figures)), explores=explores,
    )  # fmt: skip


def render_run_page(title: str) -> str:
    """The page that shows whichever run its address names, from the side files beside it.

    Args:
        title: Title of the report that it belongs to.
    """
    return _render("run.html.j2", _RUN, title=title)


def _render(template: str, scripts: tuple[str, ...], **values: Any) -> str:
    environment = Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True, loader=FunctionLoader(resource))
    environment.filters["breakable"] = _breakable
    css, javascript = (Markup("\n".join(map(resource, names))) for names in (_STYLES, _CHARTS + scripts))
    return environment.get_template(template).render(css=css, javascript=javascript, **values)


def _breakable(name: str) -> Markup:
    """A name that may be broken behind its dots, underlines and slashes."""
    return Markup(re.sub(r"(?<=[/_.])(?=.)", "<wbr>", str(escape(name))))


@cache
def resource(name: str) -> str:
    """The text of a template, style or script."""
    return (files("dynslam_bench.reports.html") / "templates" / name).read_text(encoding="utf-8")


FOLDER = "data"
_MISSING = 65535


def to_script(value: Any) -> str:
    """A value as JSON that may stand inside a script element."""
    return json.dumps(value, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")


def write_side(output: Path, name: str, value: Any) -> None:
    """Write ``data/<name>.js``, a script that hands a value to the page: a page opened from a folder loads no JSON.

    Args:
        output: Folder of the page.
        name: What the page asks for.
        value: Anything that JSON can hold; no NaN.

    Raises:
        DynslamError: It cannot be written.
    """
    path = output / FOLDER / f"{name}.js"
    content = f"keep({json.dumps(name)},{to_script(value)});\n".encode()
    if not path.is_file() or path.read_bytes() != content:  # to replace a file takes longer than to read it
        write_atomic(path, content)


def packed_rows(rows: ArrayLike) -> list[list[float | str]]:
    """Series of numbers in 16 bits each between their smallest and their largest; what is no number stays missing.

    Args:
        rows: Numbers ``[K, N]``.

    Returns:
        Of each series its smallest value, the step, and the counts of steps in base64; a page shows them to a 65 000th
        of their range.
    """
    array = np.atleast_2d(np.asarray(rows, dtype=np.float64))
    finite = np.isfinite(array)
    low = np.min(array, axis=1, where=finite, initial=np.inf)
    high = np.max(array, axis=1, where=finite, initial=-np.inf)
    low, high = np.where(np.isfinite(low), low, 0.0), np.where(np.isfinite(high), high, 0.0)
    step = np.where(high > low, (high - low) / (_MISSING - 1), 1.0)
    counts = np.where(finite, (array - low[:, None]) / step[:, None], _MISSING).round().astype("<u2")
    return [
        [float(f"{first:.9g}"), float(f"{width:.9g}"), base64.b64encode(row.tobytes()).decode()]
        for first, width, row in zip(low, step, counts, strict=True)
    ]
