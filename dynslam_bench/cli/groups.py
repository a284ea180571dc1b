"""A command group with a default verb."""

from __future__ import annotations

from typing import Any

from typer.core import TyperGroup


class DefaultGroup(TyperGroup):
    """Arguments that begin with no known verb go to the verb ``make``: ``report results`` makes a report."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Insert the default verb where none is named."""
        if not args or (args[0] not in self.commands and args[0] not in ("-h", "--help")):
            args = ["make", *args]
        return super().parse_args(ctx, args)
