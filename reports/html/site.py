"""The first page of a published site."""

from __future__ import annotations

from collections.abc import Sequence
from importlib.resources import files

from jinja2 import Environment

import dynslam_bench


def render_site(title: str, pages: Sequence[tuple[str, str, str]], note: str = "") -> str:
    """A page that leads to others.

    Args:
        title: Heading.
        pages: Relative address, name and what it shows, of each.
        note: What a reader should know; empty for nothing.
    """
    source = files("dynslam_bench.reports.html") / "templates" / "site.html.j2"
    template = Environment(autoescape=True, trim_blocks=True).from_string(source.read_text(encoding="utf-8"))
    return template.render(title=title, pages=pages, note=note, version=dynslam_bench.__version__)
