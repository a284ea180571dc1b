"""``round new|enter|reveal|run|verify|report``."""

import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Optional

import typer

from dynslam_bench.cli.options import (
    AsJson,
    Assignments,
    Jobs,
    ProtocolId,
    SettingsFile,
    gather_settings,
    names_of,
)
from dynslam_bench.cli.output import SOME_RUNS_FAILED, announce, present, progress, table

if TYPE_CHECKING:
    from collections.abc import Callable

    from dynslam_bench.rounds.running import OnEvent
    from dynslam_bench.runs import RunEvent

app = typer.Typer(
    help="Sealed rounds: trackers are frozen first, their scenes are rendered afterwards.",
    no_args_is_help=True,
)
Folder = Annotated[Path, typer.Argument(metavar="ROUND", help="The round's folder.")]
Runner = Annotated[str, typer.Option("--by", help="Your name, as the board shows it.")]
RoundResults = Annotated[
    Path, typer.Option("--results", help="Results folder for the runs themselves.")
]
_UNSHARE = ("unshare", "--net", "--map-root-user")
"""Starts a command without a network, by a user namespace of its own (unshare(1))."""
_STARTED_AGAIN = "DYNSLAM_BENCH_WITHOUT_NETWORK"
"""Environment variable that is set in a command that was started so: it is started once."""


@app.command()
def new(
    folder: Folder,
    name: Annotated[str, typer.Option(help="Name of the round, e.g. 2026a.")],
    family: Annotated[
        list[str],
        typer.Option(
            help="Rendered sequence, e.g. walking_xyz; repeatable.",
            autocompletion=names_of("sequences.synthetic.ids:VARIANTS"),
        ),
    ],
    scenes: Annotated[int, typer.Option(min=1, help="Sealed scenes of each family.")] = 10,
    frames: Annotated[int, typer.Option(min=2, help="Frames of each scene.")] = 300,
    protocol: ProtocolId = "tum-rgbd/v1",
    deadline: Annotated[
        str, typer.Option(help="Until when entries are received, e.g. 2026-12-24T12:00Z.")
    ] = "",
    rules: Annotated[str, typer.Option(help="What else holds, in words.")] = "",
    tolerance: Annotated[
        float,
        typer.Option(min=0, max=1, help="Share by which errors of reproduced rows may differ."),
    ] = 0.1,
    salt: Annotated[
        Optional[Path],
        typer.Option(help="Where the salt goes; default ROUND.salt. Keep it secret."),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Draw a salt, and write the round that commits to it."""
    from dynslam_bench import rounds
    from dynslam_bench.rounds.opening import salt_place, work_tree_of

    made = rounds.new_round(
        folder,
        name=name,
        families=family,
        scenes=scenes,
        frames=frames,
        protocol=protocol,
        deadline=deadline,
        rules=rules,
        tolerance=tolerance,
        salt_file=salt,
    )
    place = salt_place(folder, salt)
    if work_tree := work_tree_of(place):
        announce(f"the salt {place} lies in the git work tree {work_tree}: never commit it")
    present(
        made,
        f"{folder / 'round.json'}: publish it; the salt's SHA-256 is {made.salt_sha256}",
        f"{place}: the salt; keep it secret until the reveal",
    )


@app.command()
def enter(
    folder: Folder,
    tracker: Annotated[
        str, typer.Argument(help="As `run` takes it; paths count from the round's folder.")
    ],
    name: Annotated[str, typer.Option(help="Name of the entry.")],
    set_options: Assignments = None,
    settings_file: SettingsFile = None,
    as_json: AsJson = False,
) -> None:
    """Freeze a tracker: check its contract, try it on a public scene, write the entry."""
    from dynslam_bench import rounds
    from dynslam_bench.core import file_sha256

    _leave_network()
    with progress("entering") as advance:
        entry = rounds.enter(
            folder,
            tracker,
            name=name,
            settings=gather_settings(set_options, settings_file),
            on_step=lambda step: advance(0, None, step),
        )
    file = folder / "entries" / f"{name}.json"
    sha256 = file_sha256(file)
    error = "none" if entry.trial.ate_m is None else f"{1000 * entry.trial.ate_m:.2f} mm"
    present(
        {"file": file, "sha256": sha256, "entry": entry},
        f"{len(entry.checks)} checks passed; trial on {entry.trial.sequence}: {entry.trial.status}, ATE {error}",
        f"{file}: publish it, with the tracker's files; its SHA-256 is {sha256}",
    )


@app.command()
def reveal(
    folder: Folder,
    salt: Annotated[
        Optional[Path], typer.Option(help="The salt that `new` wrote; default ROUND.salt.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Publish the salt and the digests of the entries received; what comes later is late."""
    from dynslam_bench import rounds
    from dynslam_bench.rounds.opening import salt_place

    made = rounds.reveal(folder, salt_place(folder, salt))
    rows = [(name, sha256) for name, sha256 in made.entries.items()]
    present(made, table(("entry", "SHA-256"), rows), f"{folder / 'reveal.json'}: publish it")


@app.command()
def run(
    folder: Folder,
    by: Runner,
    entry: Annotated[
        Optional[list[str]], typer.Option(help="Only this entry; repeatable; default all.")
    ] = None,
    results: RoundResults = Path("results/rounds"),
    jobs: Jobs = 1,
    as_json: AsJson = False,
) -> None:
    """Render the sealed scenes, and run the entries on them without a network."""
    from dynslam_bench import rounds

    _leave_network()
    with _progress("round") as (on_step, on_event):
        made = rounds.run(
            folder,
            by=by,
            entries=entry or (),
            results=results,
            jobs=jobs,
            on_step=on_step,
            on_event=on_event,
        )
    words = "without a network" if made.results.network == "none" else "with the network open"
    present(
        made,
        *(f"refused: {reason}" for reason in made.refused.values()),
        *made.failed,
        f"{made.folder}: {len(made.made)} runs {words}; publish it",
    )
    if made.failed or made.refused:
        raise typer.Exit(SOME_RUNS_FAILED)


@app.command()
def verify(
    folder: Folder,
    by: Runner,
    of: Annotated[
        Optional[list[str]], typer.Option(help="Only results of this runner; repeatable.")
    ] = None,
    sample: Annotated[
        int,
        typer.Option(min=0, help="Rows of each entry and runner to run again, drawn at random."),
    ] = 1,
    results: RoundResults = Path("results/rounds"),
    jobs: Jobs = 1,
    as_json: AsJson = False,
) -> None:
    """Check all that was published, score all rows again, run a sample again; exit code 4 where something is wrong."""
    from dynslam_bench import rounds

    _leave_network()
    with _progress("verifying") as (on_step, on_event):
        verification = rounds.verify(
            folder,
            by=by,
            of=of or (),
            sample=sample,
            results=results,
            jobs=jobs,
            on_step=on_step,
            on_event=on_event,
        )
    opened = rounds.files.open_round(folder)
    rows = [
        (
            again.row.row.entry,
            opened.round.label_of(again.row.row.sequence, opened.salt),
            again.row.by,
            _millimetres(again.ate_m),
            _millimetres(again.ate_again_m),
            again.agreement,
        )
        for again in verification.rerun
    ]
    lines = [f"{len(verification.rows)} rows scored again, {len(verification.rerun)} run again"]
    if rows:
        columns = ("entry", "scene", "run by", "ATE (mm)", "again (mm)", "")
        lines.append(table(columns, rows))
    lines += [f"fault: {fault}" for fault in verification.faults]
    lines.append(f"{len(verification.faults)} faults" if verification.faults else "no fault")
    present(verification, *lines, verified=verification.ok)


@app.command()
def report(
    folder: Folder,
    output: Annotated[
        Optional[Path], typer.Option("-o", "--output", help="Default report in the round's folder.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Make the board: sealed, who ran what, who reproduced it."""
    from dynslam_bench import rounds
    from dynslam_bench.rounds.board import COLUMNS

    made = rounds.report(folder, output)
    present(
        made,
        *made.remarks,
        table(COLUMNS, [row.cells for row in made.rows]),
        *(f"fault: {fault}" for fault in made.faults),
        str(made.markdown),
        str(made.html),
    )


def _millimetres(error_m: float | None) -> str:
    return "" if error_m is None else f"{1000 * error_m:.2f}"


@contextmanager
def _progress(title: str) -> Iterator[tuple["Callable[[str], None]", "OnEvent"]]:
    """Show on standard error what is done."""
    with progress(title) as advance:
        finished = 0

        def on_step(step: str) -> None:
            advance(finished, None, step)

        def on_event(event: "RunEvent") -> None:
            nonlocal finished
            finished += event.kind == "finished"
            advance(finished, event.total, f"{event.spec.label} on {event.spec.sequence}")

        yield on_step, on_event


def _leave_network() -> None:
    """Start this command again without a network, where the system allows it; else say that it is open."""
    from dynslam_bench.rounds.running import network

    if network() == "none":
        return
    is_allowed = False
    if os.environ.get(_STARTED_AGAIN):
        announce("entries run with the network open: an interface is up after unshare")
        return
    if shutil.which(_UNSHARE[0]) is not None:
        tried = subprocess.run([*_UNSHARE, "true"], capture_output=True, check=False)
        is_allowed = tried.returncode == 0
    if not is_allowed:
        announce("entries run with the network open: this system does not let a user leave it")
        return
    command = [*_UNSHARE, sys.executable, "-m", "dynslam_bench", *sys.argv[1:]]
    os.execvpe(command[0], command, os.environ | {_STARTED_AGAIN: "1"})
