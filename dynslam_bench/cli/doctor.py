"""``doctor``: what is installed here, and how to get what is missing."""

from __future__ import annotations

import typer

from .options import AsJson
from .output import write, write_json, write_table
from .panels import START


def add(app: typer.Typer) -> None:
    """Add the verb."""
    app.command(rich_help_panel=START)(doctor)


def doctor(as_json: AsJson = False) -> None:
    """Say what is installed here, which weights, sequences and extras there are, and how to get what is missing."""
    from dynslam_bench.testing.installation import examine, torch_device

    found = [*examine(), torch_device()]
    if as_json:
        write_json([each.__dict__ for each in found])
        return
    write_table(("part", "name", "found"), [(each.part, each.name, each.state) for each in found])
    missing = [each for each in found if each.missing]
    write()
    if not missing:
        write("Nothing is missing.")
        return
    write("Missing, and how to get it (nothing of it is needed for rendered sequences unless it is a package):")
    for each in missing:
        write(f"- {each.part} {each.name}: {each.hint or each.state}")
