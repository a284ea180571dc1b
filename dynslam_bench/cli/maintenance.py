"""``doctor``, ``envs`` and ``cache info|clear``: what is installed, registered and stored on this machine."""

from typing import Annotated

import typer

from dynslam_bench.cli.options import AsJson
from dynslam_bench.cli.output import present, table, write

cache = typer.Typer(
    help="The stage cache: results that do not depend on the settings under study.", no_args_is_help=True
)


def doctor(as_json: AsJson = False) -> None:
    """Show what is installed here, which weights, sequences and extras there are, and how to get what is missing."""
    from dynslam_bench.testing.installation import examine

    findings = examine()
    rows = [(finding.part, finding.name, finding.state) for finding in findings]
    missing = [f"- {f.part} {f.name}: {f.hint or f.state}" for f in findings if f.missing]
    present(
        findings,
        table(("part", "name", "found"), rows),
        *(
            ["\nMissing, and how to get it (of this, rendered sequences need the packages alone):", *missing]
            if missing
            else []
        ),
    )


def envs(as_json: AsJson = False) -> None:
    """List the Gymnasium environments, one for each listed sequence and a generic one."""
    from dynslam_bench.envs import register_envs

    ids = register_envs()
    present(ids, *ids)


@cache.command()
def info(as_json: AsJson = False) -> None:
    """Show how full the cache is."""
    from dynslam_bench.core.stage_cache import StageCache

    usage = StageCache().info()
    sizes, entries = usage["bytes_by_stage"], usage["entries_by_stage"]
    rows = [(stage, entries[stage], size / 1e6) for stage, size in sizes.items()]
    total = sum(sizes.values())
    present(
        {"bytes": total, **usage},
        f"{usage['folder']}: {total / 1e6:.1f} of {usage['max_bytes'] / 1e6:.0f} MB",
        table(("stage", "entries", "MB"), rows),
    )


@cache.command()
def clear(yes: Annotated[bool, typer.Option("--yes", "-y", help="Do not ask.")] = False) -> None:
    """Delete all entries."""
    from dynslam_bench.core.stage_cache import StageCache

    stage_cache = StageCache()
    if not yes:
        typer.confirm(f"delete all entries below {stage_cache.folder}?", abort=True)
    write(f"freed {stage_cache.clear() / 1e6:.1f} MB")
