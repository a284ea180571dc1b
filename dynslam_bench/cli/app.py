"""The program: its verbs, those on the installation (``doctor``, ``envs``, ``cache``), and how it ends."""

import errno
import os
import sys
import warnings
from typing import Annotated, Optional

import typer

from dynslam_bench.cli import (
    demo,
    gates,
    interrupted,
    leave_interrupted,
    reports,
    rounds,
    running,
    runs,
    segmenters,
    sequences,
    studies,
    trackers,
    trajectories,
)
from dynslam_bench.cli.options import CARE, MEASURE, REPORT, START, AsJson, ShortHelp
from dynslam_bench.cli.output import (
    download_bar,
    present,
    set_json_mode,
    set_wide,
    table,
    warn,
    write,
    write_error,
)
from dynslam_bench.core import DynslamError

INTERRUPT_CODE = 130
"""Typer's exit code of a command that Ctrl-C has ended."""
LISTS = ("--seed", "--offset")
"""Options that take several whole numbers."""
app = typer.Typer(
    name="dynslam-bench",
    help="Benchmark and tune visual SLAM in dynamic scenes.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    add_completion=True,
    context_settings={"help_option_names": ["-h", "--help"]},
)

# The verbs below the four headings of the help, in their order there.
app.command(rich_help_panel=START)(demo.demo)
app.add_typer(sequences.app, name="sequences", rich_help_panel=START)
app.add_typer(trackers.app, name="trackers", rich_help_panel=START)
for verb in (running.run, running.bench):
    app.command(rich_help_panel=MEASURE, cls=ShortHelp)(verb)
app.add_typer(runs.app, name="runs", rich_help_panel=MEASURE)
app.add_typer(runs.banks, name="bank", rich_help_panel=MEASURE)
app.command("eval", rich_help_panel=MEASURE)(trajectories.evaluate)
app.add_typer(trajectories.protocols, name="protocols", rich_help_panel=MEASURE)
app.command("import", rich_help_panel=MEASURE)(trajectories.import_)
app.command(rich_help_panel=MEASURE)(trajectories.export)
app.command(rich_help_panel=MEASURE)(runs.describe)
app.add_typer(studies.app, name="tune", rich_help_panel=REPORT)
app.add_typer(reports.app, name="report", rich_help_panel=REPORT)
app.command(rich_help_panel=REPORT)(reports.published)
app.add_typer(gates.app, name="gate", rich_help_panel=REPORT)
app.add_typer(rounds.app, name="round", rich_help_panel=REPORT)
app.add_typer(segmenters.app, name="segmenter", rich_help_panel=CARE)
cache = typer.Typer(
    help="What is computed once and kept: stages, compiled kernels, rendered frames.",
    no_args_is_help=True,
)
app.add_typer(cache, name="cache", rich_help_panel=CARE)


def _version(asked: bool) -> None:
    if asked:
        from dynslam_bench.core.version import version

        sys.stdout.write(f"dynslam-bench {version()}\n")
        raise typer.Exit


@app.callback()
def _root(
    version: Annotated[
        Optional[bool],
        typer.Option("--version", callback=_version, is_eager=True, help="Show the version."),
    ] = None,
    wide: Annotated[
        bool, typer.Option("--wide", help="Show all columns of tables, wider than the terminal.")
    ] = False,
) -> None:
    """Benchmark and tune visual SLAM in dynamic scenes."""
    from dynslam_bench.core.download import show_downloads

    set_wide(wide)
    show_downloads(download_bar)


@app.command(rich_help_panel=START)
def envs(as_json: AsJson = False) -> None:
    """List the Gymnasium environments, one for each listed sequence and a generic one."""
    from dynslam_bench.envs import register_envs

    ids = register_envs()
    present(ids, *ids)


@app.command(rich_help_panel=START)
def doctor(as_json: AsJson = False) -> None:
    """Show what is installed here, which weights, sequences and extras there are, and how to get what is missing."""
    from dynslam_bench.testing.installation import examine

    findings = examine()
    rows = [(finding.part, finding.name, finding.state) for finding in findings]
    lines = [table(("part", "name", "found"), rows)]
    missing = [finding for finding in findings if finding.missing]
    if missing:
        heading = (
            "Missing, and how to get it (of this, rendered sequences need the packages alone):"
        )
        lines.append(f"\n{heading}")
        lines += [
            f"- {finding.part} {finding.name}: {finding.hint or finding.state}"
            for finding in missing
        ]
    present(findings, *lines)


@cache.command()
def info(as_json: AsJson = False) -> None:
    """Show what the caches hold: stages, compiled kernels, rendered frames."""
    from dynslam_bench.core.folders import find_data_root, kernel_files
    from dynslam_bench.core.stage_cache import StageCache
    from dynslam_bench.sequences.synthetic.stored import renderings

    usage = StageCache().info()
    sizes = usage["bytes_by_stage"]
    entries = usage["entries_by_stage"]
    rows = [(stage, entries[stage], size / 1e6) for stage, size in sizes.items()]
    total = sum(sizes.values())

    kernels = [file.stat().st_size for file in kernel_files()]
    stored = renderings(find_data_root())
    current = [rendering.size for rendering in stored if rendering.is_current]
    others = [rendering.size for rendering in stored if not rendering.is_current]
    rows += [
        ("compiled kernels", len(kernels), sum(kernels) / 1e6),
        ("rendered sequences", len(current), sum(current) / 1e6),
        ("rendered by other code or settings", len(others), sum(others) / 1e6),
    ]
    present(
        {
            "bytes": total,
            **usage,
            "kernels_bytes": sum(kernels),
            "renderings_bytes": sum(current),
            "other_renderings_bytes": sum(others),
        },
        f"{usage['folder']}: {total / 1e6:.1f} of {usage['max_bytes'] / 1e6:.0f} MB of stages",
        table(("what", "entries", "MB"), rows),
    )


@cache.command()
def clear(yes: Annotated[bool, typer.Option("--yes", "-y", help="Do not ask.")] = False) -> None:
    """Delete all stages and compiled kernels, and what other code or settings have rendered."""
    import shutil

    from dynslam_bench.core.folders import find_data_root, kernel_files
    from dynslam_bench.core.stage_cache import StageCache
    from dynslam_bench.sequences.synthetic.stored import renderings

    stage_cache = StageCache()
    others = [rendering for rendering in renderings(find_data_root()) if not rendering.is_current]
    if not yes:
        what = f"all entries below {stage_cache.folder}, all compiled kernels"
        typer.confirm(f"delete {what}, and {len(others)} old renderings?", abort=True)
    freed = stage_cache.clear()
    for kernel in kernel_files():
        freed += kernel.stat().st_size
        kernel.unlink(missing_ok=True)
    for rendering in others:
        shutil.rmtree(rendering.folder, ignore_errors=True)
        freed += rendering.size
    write(f"freed {freed / 1e6:.1f} MB")


def start(arguments: list[str] | None = None) -> None:
    """Run the program and exit.

    Args:
        arguments: The command line without the program's name; by default that of the process.
    """
    arguments = expand_lists(sys.argv[1:] if arguments is None else arguments)
    try:
        # a library's warning is one line for the user
        with warnings.catch_warnings():
            warnings.showwarning = lambda message, *_, **__: warn(f"warning: {message}")
            app(args=arguments, prog_name="dynslam-bench")
    except BrokenPipeError:
        _discard_output()  # the reader has ended, e.g. `| head`
        sys.exit(0)
    except Exception as error:
        if interrupted():  # libraries turn an interrupt into errors of their own
            leave_interrupted()
        if isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT):
            # a full disk is the user's to clear; what is not written yet would fail once more
            _discard_output()
            file = f" {error.filename}" if error.filename else ""
            error = DynslamError(f"cannot write{file}: {error.strerror}")
        # only errors of the user get one line; a fault of the program keeps its traceback
        if not isinstance(error, DynslamError):
            raise
        write_error(error)
        sys.exit(1)
    except SystemExit as ended:  # typer turns an interrupt within a command into this
        if ended.code == INTERRUPT_CODE:
            leave_interrupted()
        raise
    finally:
        set_json_mode(False)


def _discard_output() -> None:
    """Drop what is not written yet: the interpreter would fail to write it at its end."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def expand_lists(arguments: list[str]) -> list[str]:
    """Repeat an option of `LISTS` before each of its values.

    Example:
        ``--seed 0 1 2`` becomes ``--seed 0 --seed 1 --seed 2``.
    """
    expanded: list[str] = []
    option = ""  # whose values are being read
    for argument in arguments:
        if argument in LISTS:
            option = argument
        elif not argument.isdigit():
            option = ""
        # a value that follows another value, not its option
        elif option and expanded[-1] not in LISTS:
            expanded.append(option)
        expanded.append(argument)
    return expanded
