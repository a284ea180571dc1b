"""``doctor``, ``envs`` and ``cache info|clear``: what is installed, registered and stored on this machine."""

from __future__ import annotations

from typing import Annotated

import typer

from dynslam_bench.cli.options import START, AsJson
from dynslam_bench.cli.output import present, write, write_table

cache = typer.Typer(
    help="The stage cache: results that do not depend on the settings under study.", no_args_is_help=True
)


def add(app: typer.Typer) -> None:
    """Add the verbs without a group."""
    app.command(rich_help_panel=START)(envs)
    app.command(rich_help_panel=START)(doctor)


def doctor(as_json: AsJson = False) -> None:
    """Show what is installed here, which weights, sequences and extras there are, and how to get what is missing."""
    from dynslam_bench.testing.installation import examine, torch_device

    findings = [*examine(), torch_device()]

    def show() -> None:
        write_table(("part", "name", "found"), [(finding.part, finding.name, finding.state) for finding in findings])
        missing = [finding for finding in findings if finding.missing]
        needless = "nothing of it is needed for rendered sequences unless it is a package"
        write(f"\nMissing, and how to get it ({needless}):" if missing else "\nNothing is missing.")
        for finding in missing:
            write(f"- {finding.part} {finding.name}: {finding.hint or finding.state}")

    present([vars(finding) for finding in findings], show)


def envs(as_json: AsJson = False) -> None:
    """List the Gymnasium environments, one for each listed sequence and a generic one."""
    from dynslam_bench.envs import register_envs

    ids = register_envs()
    present(ids, lambda: write("\n".join(ids)))


@cache.command()
def info(as_json: AsJson = False) -> None:
    """Show how full the cache is."""
    from dynslam_bench.core.stage_cache import StageCache

    usage = StageCache().info()
    sizes, entries = usage.bytes_by_stage, usage.entries_by_stage
    facts = {"folder": usage.folder, "max_bytes": usage.max_bytes, "bytes": sum(sizes.values())}

    def show() -> None:
        write(f"{usage.folder}: {sum(sizes.values()) / 1e6:.1f} of {usage.max_bytes / 1e6:.0f} MB")
        if sizes:
            write_table(("stage", "entries", "MB"), [(name, entries[name], size / 1e6) for name, size in sizes.items()])

    present(facts | {"bytes_by_stage": sizes, "entries_by_stage": entries}, show)


@cache.command()
def clear(yes: Annotated[bool, typer.Option("--yes", "-y", help="Do not ask.")] = False) -> None:
    """Delete all entries."""
    from dynslam_bench.core.stage_cache import StageCache

    stored = StageCache()
    if not yes:
        typer.confirm(f"delete all entries below {stored.folder}?", abort=True)
    write(f"freed {stored.clear() / 1e6:.1f} MB")
