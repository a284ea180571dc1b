"""``envs``: the registered Gymnasium environments."""

from __future__ import annotations

import typer

from .options import AsJson
from .output import write, write_json
from .panels import START


def add(app: typer.Typer) -> None:
    """Add the verb."""
    app.command(rich_help_panel=START)(envs)


def envs(as_json: AsJson = False) -> None:
    """List the Gymnasium environments, one for each listed sequence and a generic one."""
    from dynslam_bench.envs import register_envs

    ids = register_envs()
    if as_json:
        write_json(ids)
        return
    for name in ids:
        write(name)
