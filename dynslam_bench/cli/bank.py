"""``bank add|verify|pull|push``: trajectories as an archive of text files with checksums."""

from pathlib import Path
from typing import Annotated

import typer

from dynslam_bench.cli.options import AsJson
from dynslam_bench.cli.output import VERIFICATION_FAILED, present
from dynslam_bench.cli.runs import show_merged

app = typer.Typer(
    help="Banks: archives of trajectories with checksums, which are results folders.", no_args_is_help=True
)
Folder = Annotated[Path, typer.Argument(metavar="BANK", help="Folder of the bank.")]


@app.command()
def add(
    sources: Annotated[
        list[Path], typer.Argument(metavar="SOURCE...", help="Results folders, and manifests of trajectories (.toml).")
    ],
    bank: Folder,
    as_json: AsJson = False,
) -> None:
    """Add runs without trials of studies; exit with 3 if one is left out, e.g. for another result that is there."""
    from dynslam_bench.runs.bank import add

    show_merged(add(sources, bank), str(bank))


@app.command()
def verify(bank: Folder, as_json: AsJson = False) -> None:
    """Name each file that is missing, changed or not listed, and each record that does not fit; exit with 4 then."""
    from dynslam_bench.runs.bank import verify

    faults = verify(bank)
    present({"faults": faults}, *faults, f"{bank}: {len(faults)} fault{'s' * (len(faults) != 1)}")
    if faults:
        raise typer.Exit(VERIFICATION_FAILED)


@app.command()
def pull(
    source: Annotated[str, typer.Argument(help="A bank: a folder, a git repository, or an archive's https address.")],
    bank: Folder,
    as_json: AsJson = False,
) -> None:
    """Add the runs of another bank; refuse it if it has faults."""
    from dynslam_bench.runs.bank import pull

    show_merged(pull(source, bank), str(bank))


@app.command()
def push(
    bank: Folder,
    target: Annotated[str, typer.Argument(help="A folder, or a git repository, which gets a commit.")],
    as_json: AsJson = False,
) -> None:
    """Add the runs of a bank to another one; refuse if either has faults."""
    from dynslam_bench.runs.bank import push

    show_merged(push(bank, target), target)
