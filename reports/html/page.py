"""The HTML pages: templates, the files that all pages share, and the data that they load on demand."""

import json
import re
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any

import plotly.graph_objects as go
from jinja2 import Environment, FunctionLoader
from markupsafe import Markup, escape
from plotly.offline import get_plotlyjs

from dynslam_bench.core import write_atomic
from dynslam_bench.reports.figures import THEMES
from dynslam_bench.reports.html.static_chart import static_chart
from dynslam_bench.reports.tables.table import Table

ASSETS = "assets"
"""Folder of what all pages share."""
FOLDER = "data"
"""Folder of what pages load on demand."""
_SCRIPTS = ("page.js", "board.js", "errors.js", "run.js", "compare.js")


@dataclass
class Block:
    """Something in a section: a table, a figure, code or a list.

    Attributes:
        title: Heading above it, or what is seen of it when it is closed.
        table: The table.
        figure: The figure.
        caption: Below the figure, or above the code.
        text: The code, which a button copies.
        entries: Entries of the list.
        folded: Whether it is closed at first, behind its title.
    """

    title: str = ""
    table: Table | None = None
    figure: go.Figure | None = None
    caption: str = ""
    text: str = ""
    entries: list[str] = field(default_factory=list)
    folded: bool = False


@dataclass
class Section:
    """A section of a page.

    Attributes:
        id: For links.
        title: Heading.
        notes: Set off above everything else.
        blocks: Its content.
    """

    id: str
    title: str
    notes: list[str] = field(default_factory=list)
    blocks: list[Block] = field(default_factory=list)


def table_blocks(*tables: Table | None, folded: bool = False) -> list[Block]:
    """Blocks that show the tables that there are; folded ones are closed at first, behind their titles."""
    return [Block(t.title if folded else "", t, folded=folded) for t in tables if t is not None]


def figure_blocks(figure: go.Figure | None, caption: str = "", title: str = "") -> list[Block]:
    """A block that shows a figure; none for no figure."""
    return [] if figure is None else [Block(title, figure=figure, caption=caption)]


def render(template: str, **values: Any) -> str:
    """A page as one HTML text that fetches nothing but files beside it.

    Args:
        template: Name of the template.
        **values: What it shows; all pages need ``title``.
    """
    return _templates().get_template(template).render(**values)


@cache
def _templates() -> Environment:
    """The pages' templates; each is compiled when it is rendered first."""
    environment = Environment(
        autoescape=True, trim_blocks=True, lstrip_blocks=True, loader=FunctionLoader(resource)
    )
    environment.filters |= {
        "breakable": _breakable,
        "script": to_script,
        "figure": figure_json,
        "static_chart": static_chart,
    }
    return environment


def _breakable(name: str) -> Markup:
    """A name that may be broken behind its dots, underlines, slashes and question marks."""
    return Markup(re.sub(r"(?<=[/_.?])(?=.)", "<wbr>", str(escape(name))))


@cache
def resource(name: str) -> str:
    """The text of a template, style or script."""
    return (files("dynslam_bench.reports.html") / "templates" / name).read_text(encoding="utf-8")


@cache
def _assets() -> dict[str, str]:
    """The files that all pages share: plotly, DataTables, our style and scripts."""
    bundle = files("itables") / "html"
    # browsers load no ES modules from file:// pages: make the bundle a plain script
    tables, replaced = re.subn(
        r"export\s*\{[^}]*?([\w$]+) as default[^}]*\};?",
        r"globalThis.DataTable=\1;",
        (bundle / "dt_bundle.js").read_text(encoding="utf-8"),
    )
    assert replaced == 1, "the DataTables bundle of itables replaced its class"
    return {
        "plotly.min.js": get_plotlyjs(),
        "datatables.js": f"(()=>{{{tables}\n}})();",
        "datatables.css": (bundle / "dt_bundle.css").read_text(encoding="utf-8"),
        "page.css": resource("page.css"),
        **{name: resource(name) for name in _SCRIPTS},
        "themes.js": f"const THEMES = {to_script(THEMES)};\n",
    }


def write_assets(output: Path) -> None:
    """Write what all pages of a folder share into ``assets/``.

    Raises:
        DynslamError: The folder cannot be written.
    """
    for name, text in _assets().items():
        path = output / ASSETS / name
        if not path.is_file() or path.stat().st_size != len(text.encode()):
            write_atomic(path, text)


def to_script(value: Any) -> Markup:
    """A value as JSON that may stand inside a script element."""
    return Markup(json.dumps(value, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c"))


def figure_json(figure: go.Figure) -> Markup:
    """A figure as JSON that may stand inside a script element."""
    return Markup(str(figure.to_json()).replace("<", "\\u003c"))


def read_remark(output: Path, name: str) -> Any:
    """Read the first line of ``data/<name>.js``, see `write_side`; None without that file."""
    with (
        suppress(OSError, ValueError),
        (output / FOLDER / f"{name}.js").open(encoding="utf-8") as file,
    ):
        return json.loads(file.readline().removeprefix("//"))
    return None


def write_side(output: Path, name: str, value: Any, remark: Any = None) -> None:
    """Write ``data/<name>.js``, a script that hands a value to the page: a page opened from a folder loads no JSON.

    Args:
        output: Folder of the page.
        name: What the page asks for.
        value: Anything that JSON can hold; no NaN.
        remark: Anything that JSON can hold, too; stands before the value, for `read_remark`.

    Raises:
        DynslamError: It cannot be written.
    """
    path = output / FOLDER / f"{name}.js"
    write_changed(
        path, f"//{to_script(remark)}\nkeep({json.dumps(name)},{to_script(value)});\n".encode()
    )


def write_changed(path: Path, content: bytes) -> None:
    """Write a file that does not have this content yet: to replace a file takes longer than to read it.

    Raises:
        DynslamError: It cannot be written.
    """
    if not path.is_file() or path.read_bytes() != content:
        write_atomic(path, content)
