"""``doctor``: what is installed here, and how to get what is missing."""

from __future__ import annotations

from typing import Annotated

import typer

from dynslam_bench.cli.options import START, AsJson
from dynslam_bench.cli.output import write, write_json, write_table


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


# ``envs``: the registered Gymnasium environments.


def add_envs(app: typer.Typer) -> None:
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


# ``cache info|clear``.

app = typer.Typer(help="The stage cache: results that do not depend on the settings under study.", no_args_is_help=True)


@app.command()
def info(as_json: AsJson = False) -> None:
    """Show how full the cache is."""
    from dynslam_bench.core.stage_cache import StageCache

    found = StageCache().info()
    total = sum(found.bytes_by_stage.values())
    if as_json:
        write_json(
            {
                "folder": found.folder,
                "max_bytes": found.max_bytes,
                "bytes": total,
                "bytes_by_stage": found.bytes_by_stage,
                "entries_by_stage": found.entries_by_stage,
            }
        )
        return
    write(f"{found.folder}: {total / 1e6:.1f} of {found.max_bytes / 1e6:.0f} MB")
    if found.bytes_by_stage:
        rows = [(name, found.entries_by_stage[name], size / 1e6) for name, size in found.bytes_by_stage.items()]
        write_table(("stage", "entries", "MB"), rows)


@app.command()
def clear(yes: Annotated[bool, typer.Option("--yes", "-y", help="Do not ask.")] = False) -> None:
    """Delete all entries."""
    from dynslam_bench.core.stage_cache import StageCache

    cache = StageCache()
    if not yes:
        typer.confirm(f"delete all entries below {cache.folder}?", abort=True)
    write(f"freed {cache.clear() / 1e6:.1f} MB")
