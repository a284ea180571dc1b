"""The HTML page: sections of tables and figures, everything in one file."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from importlib.resources import files
from typing import Literal

from jinja2 import Environment, select_autoescape
from markupsafe import Markup, escape

from ..figures.style import Figure
from ..tables.table import Table


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
        summary: For ``details``: what is seen when it is closed.
        small: Behind the summary.
        open: Whether it is open at first.
        figures: Ids and captions, for ``details``.
    """

    kind: Literal["table", "figure", "code", "list", "details"]
    title: str = ""
    table: Table | None = None
    figure: str = ""
    caption: str = ""
    text: str = ""
    entries: list[str] = field(default_factory=list)
    summary: str = ""
    small: str = ""
    open: bool = False
    figures: list[tuple[str, str]] = field(default_factory=list)


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
    """The page as one HTML text that fetches nothing.

    Args:
        sections: What to show, in order.
        figures: Plotly specifications by the ids that the sections name.
        title: Heading.
        protocol: One line below it.
        facts: Numbers and what they count.
        footer: Last line.
    """
    environment = Environment(autoescape=select_autoescape(default=True), trim_blocks=True, lstrip_blocks=True)
    environment.filters["breakable"] = _breakable
    template = environment.from_string(_resource("report.html.j2"))
    drawn = json.dumps(dict(figures), separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")
    return template.render(
        title=title,
        protocol=protocol,
        facts=facts,
        sections=sections,
        footer=footer,
        css=Markup(_resource("report.css")),
        plotly=Markup(_plotly() if figures else ""),
        figures=Markup(drawn),
        javascript=Markup(_resource("report.js")),
    )


def _breakable(name: str) -> Markup:
    """A heading that may be broken behind its underlines and slashes."""
    return Markup(str(escape(name)).replace("_", "_<wbr>").replace("/", "/<wbr>"))


@cache
def _resource(name: str) -> str:
    return (files("dynslam_bench.reports.html") / "templates" / name).read_text(encoding="utf-8")


@cache
def _plotly() -> str:
    from plotly.offline import get_plotlyjs

    return str(get_plotlyjs())
