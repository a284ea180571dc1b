"""``gate init|record|check|compare``."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Optional

import typer

from dynslam_bench.cli.options import AsJson, DataRoot
from dynslam_bench.cli.output import present, progress
from dynslam_bench.core import RunError

if TYPE_CHECKING:
    from dynslam_bench.gate import GateResult
    from dynslam_bench.gate.checking import OnRun

app = typer.Typer(
    help="Did a change help? Record a baseline, and judge changes against it.",
    no_args_is_help=True,
)
GateFile = Annotated[Path, typer.Option("--gate", help="The question, a TOML file.")]
BaselineFile = Annotated[
    Optional[Path],
    typer.Option(
        "--baseline", help="Baseline file; default gate-baseline.json beside the question."
    ),
]
GateResults = Annotated[
    Path,
    typer.Option("--results", help="Folder of runs and results, a new one inside for each call."),
]
Trajectories = Annotated[
    Optional[Path],
    typer.Option(help="Judge the trajectory files of this folder: nothing is run."),
]
Confirm = Annotated[
    bool,
    typer.Option("--confirm", help="Judge on the confirmation set; the look is counted."),
]
Summary = Annotated[
    Optional[Path], typer.Option("--summary", help="Append the summary to this file.")
]


@app.command()
def init(
    gate: GateFile = Path("gate.toml"),
    tracker: Annotated[
        Optional[list[str]],
        typer.Option("--tracker", help="What is run, e.g. subprocess:./build/slam; repeatable."),
    ] = None,
    sequence: Annotated[
        Optional[list[str]],
        typer.Option("--sequence", help="On what; default eight rendered scenes; repeatable."),
    ] = None,
    frames: Annotated[str, typer.Option(metavar="A:B", help="Part of every sequence.")] = "0:60",
    build: Annotated[str, typer.Option(help="Command that builds a checkout.")] = "",
    as_json: AsJson = False,
) -> None:
    """Write the question: what is run, and what counts as a difference."""
    from dynslam_bench import gate as gates
    from dynslam_bench.sequences.catalogue import parse_frames

    start, stop = parse_frames(frames)
    if stop is None:
        raise RunError(f"--frames is '{frames}'", "name the end, too, e.g. 0:60")
    file = gates.init(
        gate,
        trackers=tracker or ("orb-slam2",),
        sequences=sequence or (),
        frames=(start, stop),
        build=build,
    )
    present({"file": file}, str(file))


@app.command()
def record(
    gate: GateFile = Path("gate.toml"),
    baseline: BaselineFile = None,
    rounds: Annotated[int, typer.Option(min=1, max=10, help="Runs of each sequence.")] = 2,
    uncommitted: Annotated[
        bool,
        typer.Option("--uncommitted", help="Record although files have uncommitted changes."),
    ] = False,
    trajectories: Trajectories = None,
    results: GateResults = Path("results/gate"),
    data_root: DataRoot = None,
    as_json: AsJson = False,
) -> None:
    """Run what the working tree holds, and write the baseline file; commit it."""
    from dynslam_bench import gate as gates

    with _progress() as on_run:
        made = gates.record(
            gate,
            output=baseline,
            rounds=rounds,
            uncommitted=uncommitted,
            trajectories=trajectories,
            results=results,
            data_root=data_root,
            on_run=on_run,
        )
    lost = sum(run.is_lost for run in made.runs)
    revision = made.origin.revision[:12] or "no revision"
    words = f"{len(made.runs)} runs recorded, of {revision}, {lost} lost; commit the file"
    present(made, words, *(f"note: {note}" for note in made.notes))


@app.command()
def check(
    gate: GateFile = Path("gate.toml"),
    baseline: BaselineFile = None,
    files_only: Annotated[
        bool,
        typer.Option(
            "--files-only", help="Judge the recorded runs; do not run the baseline again."
        ),
    ] = False,
    trajectories: Trajectories = None,
    confirm: Confirm = False,
    summary: Summary = None,
    results: GateResults = Path("results/gate"),
    data_root: DataRoot = None,
    as_json: AsJson = False,
) -> None:
    """Judge the working tree against the baseline file: exit code 0 passed, 3 runs failed, 4 regressed, 5 undecided."""
    from dynslam_bench import gate as gates

    with _progress() as on_run:
        result = gates.check(
            gate,
            baseline=baseline,
            files_only=files_only,
            trajectories=trajectories,
            confirm=confirm,
            results=results,
            data_root=data_root,
            on_run=on_run,
        )
    _show(result, summary)


@app.command()
def compare(
    revision_a: Annotated[str, typer.Argument(metavar="REV_A", help="The baseline.")],
    revision_b: Annotated[
        str, typer.Argument(metavar="[REV_B]", help="The candidate; default the working tree.")
    ] = "",
    gate: GateFile = Path("gate.toml"),
    build: Annotated[
        Optional[str],
        typer.Option(help="Command that builds a checkout, in place of the question's."),
    ] = None,
    baseline: BaselineFile = None,
    confirm: Confirm = False,
    summary: Summary = None,
    results: GateResults = Path("results/gate"),
    data_root: DataRoot = None,
    as_json: AsJson = False,
) -> None:
    """Build and run two revisions in turns, and judge the second against the first; exit codes as of check."""
    from dynslam_bench import gate as gates

    with _progress() as on_run:
        result = gates.compare(
            revision_a,
            revision_b,
            gate,
            build_command=build,
            baseline=baseline,
            confirm=confirm,
            results=results,
            data_root=data_root,
            on_run=on_run,
        )
    _show(result, summary)


@contextmanager
def _progress() -> Iterator["OnRun"]:
    """Show on standard error which run is made."""
    with progress("gate") as advance:
        made = 0

        def on_run(side: str, case: str, number: int) -> None:
            nonlocal made
            advance(made, None, f"run {made + 1}: round {number}, {side}, {case}")
            made += 1

        yield on_run


def _show(result: "GateResult", summary: Path | None) -> None:
    """Write a result, and end with its exit code."""
    text = result.markdown()
    if summary is not None:
        with summary.expanduser().open("a", encoding="utf-8") as file:
            file.write(text)
    present(result, text.rstrip(), result.page or result.folder)
    if not result.passed:
        raise typer.Exit(result.exit_code)
