"""``cache info|clear``."""

from __future__ import annotations

from typing import Annotated

import typer

from .options import AsJson
from .output import write, write_json, write_table

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
