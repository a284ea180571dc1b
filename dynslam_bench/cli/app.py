"""The program: its verbs, and how it ends."""

from __future__ import annotations

import os
import sys
from typing import Annotated, Optional

import typer

from dynslam_bench.cli import maintenance as caches
from dynslam_bench.cli import maintenance as doctor
from dynslam_bench.cli import maintenance as environments
from dynslam_bench.cli import reports as presentation
from dynslam_bench.cli import running, segmenters, sequences, studies, trackers
from dynslam_bench.cli import runs as stored
from dynslam_bench.cli import trajectories as evaluating
from dynslam_bench.cli import trajectories as imports
from dynslam_bench.cli.ending import interrupted, leave_interrupted
from dynslam_bench.cli.options import CARE, MEASURE, REPORT, START
from dynslam_bench.cli.output import complain_of, drawn_download, for_scripts
from dynslam_bench.core.download import show_downloads
from dynslam_bench.core.errors import DynslamError

INTERRUPT_CODE = 130
app = typer.Typer(
    name="dynslam-bench",
    help="Benchmark and tune visual SLAM in dynamic scenes.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    add_completion=True,
    context_settings={"help_option_names": ["-h", "--help"]},
)
presentation.add_demo(app)
app.add_typer(sequences.app, name="sequences", rich_help_panel=START)
app.add_typer(trackers.app, name="trackers", rich_help_panel=START)
running.add(app)
app.add_typer(stored.app, name="runs", rich_help_panel=MEASURE)
evaluating.add(app)
app.add_typer(studies.app, name="tune", rich_help_panel=REPORT)
presentation.add_report(app)
imports.add_exchange(app)
app.add_typer(segmenters.app, name="segmenter", rich_help_panel=CARE)
app.add_typer(caches.app, name="cache", rich_help_panel=CARE)
environments.add_envs(app)
doctor.add(app)


def _version(asked: bool) -> None:
    if asked:
        from dynslam_bench.core.version import version

        sys.stdout.write(f"dynslam-bench {version()}\n")
        raise typer.Exit


@app.callback()
def _root(
    version: Annotated[
        Optional[bool],  # noqa: UP045
        typer.Option("--version", callback=_version, is_eager=True, help="Show the version."),
    ] = None,
) -> None:
    """Benchmark and tune visual SLAM in dynamic scenes."""
    show_downloads(drawn_download)


def start(arguments: list[str] | None = None) -> None:
    """Run the program and exit.

    Args:
        arguments: What follows the program's name; by default the command line's.
    """
    arguments = expand_lists(sys.argv[1:] if arguments is None else arguments)
    try:
        app(args=arguments, prog_name="dynslam-bench")
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # the reader went away, e.g. `| head`
        sys.exit(0)
    except Exception as error:
        if interrupted():  # libraries make errors of their own of an interrupt that meets them
            leave_interrupted()
        if not isinstance(error, DynslamError):
            raise
        complain_of(error)
        sys.exit(1)
    except SystemExit as ended:  # typer turns an interrupt within a command into this
        if ended.code == INTERRUPT_CODE:
            leave_interrupted()
        raise
    finally:
        for_scripts(False)


LISTS = ("--seed", "--offset")
"""Options that take several whole numbers."""


def expand_lists(arguments: list[str]) -> list[str]:
    """Let ``--seed 0 1 2`` stand for ``--seed 0 --seed 1 --seed 2``; likewise every option of `LISTS`."""
    expanded: list[str] = []
    following = ""
    for argument in arguments:
        if argument in LISTS:
            following = argument
        elif not argument.isdigit():
            following = ""
        elif following and expanded[-1] not in LISTS:
            expanded.append(following)
        expanded.append(argument)
    return expanded
