"""The HTML pages: sections of tables and figures; style and scripts in the page, large data in side files."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from importlib.resources import files
from typing import Any, Literal

from jinja2 import Environment, FunctionLoader, select_autoescape
from markupsafe import Markup, escape

from ..figures.style import Figure
from ..tables.table import Table
from .side_files import to_script

_STYLES = ("report.css", "figures.css")
_CHARTS = ("scales.js", "marks.js", "chart.js", "hover.js", "store.js", "page.js")
_EXPLORE = ("explore.js", "explore_figures.js", "tracks.js")
_RUN = ("run.js", "run_figures.js", "space.js", "looks.js")


@dataclass
class Block:
    """Something in a section.

    Attributes:
        kind: Which of the other attributes count.
        title: Heading above it.
        table: For ``table``.
        figure: Id of the figure, for ``figure``.
        caption: Below the figure.
        text: For ``code``.
        entries: For ``list``.
        summary: For ``tracks``: what is seen when it is closed.
        small: Behind the summary.
        open: Whether it is open at first.
        tracks: For ``tracks``: the runs to draw, each with its name and colour and whether it is shown at first.
        folded: Whether a table or list is closed at first, behind its title.
    """

    kind: Literal["table", "figure", "code", "list", "caption", "tracks", "explore"]
    title: str = ""
    table: Table | None = None
    figure: str = ""
    caption: str = ""
    text: str = ""
    entries: list[str] = field(default_factory=list)
    summary: str = ""
    small: str = ""
    open: bool = False
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


def render(
    sections: Sequence[Section],
    figures: Mapping[str, Figure],
    *,
    title: str,
    protocol: str,
    facts: Sequence[tuple[str, str]],
    footer: str,
) -> str:
    """The page as one HTML text that fetches nothing but the side files beside it.

    Args:
        sections: What to show, in order.
        figures: Specifications of figures by the ids that the sections name.
        title: Heading.
        protocol: One line below it.
        facts: Numbers and what they count.
        footer: Last line.
    """
    explores = any(block.kind == "explore" for section in sections for block in section.blocks)
    return (
        _environment()
        .from_string(_resource("report.html.j2"))
        .render(
            title=title,
            protocol=protocol,
            facts=facts,
            sections=sections,
            footer=footer,
            css=_joined(_STYLES),
            figures=Markup(to_script(dict(figures))),
            javascript=_joined(_CHARTS + (_EXPLORE if explores else ())),
            explores=explores,
        )
    )


def render_run_page(title: str) -> str:
    """The page that shows whichever run its address names, from the side files beside it.

    Args:
        title: Title of the report that it belongs to.
    """
    template = _environment().from_string(_resource("run.html.j2"))
    return template.render(title=title, css=_joined(_STYLES), javascript=_joined(_CHARTS + _RUN))


def _environment() -> Environment:
    environment = Environment(autoescape=select_autoescape(default=True), trim_blocks=True, lstrip_blocks=True)
    environment.filters["breakable"] = _breakable
    environment.loader = FunctionLoader(_resource)
    return environment


def _joined(names: Sequence[str]) -> Markup:
    return Markup("\n".join(_resource(name) for name in names))


def _breakable(name: str) -> Markup:
    """A name that may be broken behind its dots, underlines and slashes."""
    return Markup(re.sub(r"(?<=[/_.])(?=.)", "<wbr>", str(escape(name))))


@cache
def _resource(name: str) -> str:
    return (files("dynslam_bench.reports.html") / "templates" / name).read_text(encoding="utf-8")
