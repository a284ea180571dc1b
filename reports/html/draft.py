"""A report that is being put together."""

from __future__ import annotations

from dataclasses import dataclass, field

from ..figures.style import Figure
from ..tables.table import Table
from .page import Block, Section


@dataclass
class Draft:
    """What the page, the Markdown, the CSV and the LaTeX of a report are rendered from.

    Attributes:
        sections: In order.
        tables: Every table of the sections.
        figures: Every figure of them, by its id.
    """

    sections: list[Section] = field(default_factory=list)
    tables: list[Table] = field(default_factory=list)
    figures: dict[str, Figure] = field(default_factory=dict)

    def add(self, section: Section) -> None:
        """Append a section, unless it is empty."""
        if section.blocks or section.notes:
            self.sections.append(section)

    def table(self, table: Table, title: str = "", *, folded: bool = False) -> Block:
        """A block that shows a table."""
        self.tables.append(table)
        return Block(kind="table", title=title, table=table, folded=folded)

    def figure(self, name: str, figure: Figure, caption: str = "", title: str = "") -> Block:
        """A block that shows a figure."""
        self.figures[name] = figure
        return Block(kind="figure", title=title, figure=name, caption=caption)

    def titled(self, table: Table | None) -> list[Block]:
        """A block that shows a table behind its own title, closed at first; none for no table."""
        return [] if table is None else [self.table(table, table.title, folded=True)]
