"""``report make|publish|compare|audit-paper`` and ``demo``."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Optional

import typer

from dynslam_bench.cli.options import AsJson, DataRoot, DefaultGroup, Jobs, ProtocolId, Results
from dynslam_bench.cli.output import (
    SOME_RUNS_FAILED,
    present,
    progress,
    wrapped,
    write,
    write_report_table,
    write_table,
)

if TYPE_CHECKING:
    from dynslam_bench.reports.tables.table import Table


app = typer.Typer(
    cls=DefaultGroup,
    help="Reports of stored runs: `report [RESULTS...] [-o DIR]` is short for `report make ...`.",
)


@app.command()
def make(
    results: Annotated[Optional[list[Path]], typer.Argument(help="Results folders; default ./results.")] = None,  # noqa: UP045
    output: Annotated[Optional[Path], typer.Option("-o", "--output", help="Folder of the report.")] = None,  # noqa: UP045
    protocol: ProtocolId = "tum-rgbd/v1",
    reference: Annotated[
        Optional[str],  # noqa: UP045
        typer.Option(help="Tracker that errors are divided by; default orb-slam2, else a static camera."),
    ] = None,
    on: Annotated[
        str,
        typer.Option(help="common: rank on the sequences that all have; all: only trackers that have all."),
    ] = "common",
    rank_seen: Annotated[
        bool, typer.Option("--rank-seen", help="Rank also where the network behind the masks was trained.")
    ] = False,
    trials: Annotated[
        bool, typer.Option("--trials", help="Show the trials of studies, too, which are left out otherwise.")
    ] = False,
    most_pages: Annotated[
        Optional[int],  # noqa: UP045
        typer.Option(min=0, help="Runs that have a page of their own; default all of up to 5000, of more some 2000."),
    ] = None,
    title: Annotated[str, typer.Option(help="Heading.")] = "Visual SLAM in dynamic scenes",
    as_json: AsJson = False,
) -> None:
    """Make an offline HTML page of stored runs, with Markdown, CSV and LaTeX beside it."""
    from dynslam_bench.api import report
    from dynslam_bench.core.errors import ReportError
    from dynslam_bench.reports.model.load import trial_words

    if on not in ("common", "all"):
        raise ReportError(f"--on is 'common' or 'all', got '{on}'")
    with progress("report") as advance:
        paths = report(
            results or "results",
            output,
            protocol=protocol,
            reference=reference,
            title=title,
            on=on,
            rank_seen=rank_seen,
            trials=trials,
            most_pages=most_pages,
            on_progress=advance,
        )

    def show() -> None:
        show_top(paths.leaderboard)
        if paths.trials:
            write(wrapped(f"Left out: {trial_words(paths.trials)}."))
        write(str(paths.html))

    present({name: getattr(paths, name) for name in ("html", "markdown", "latex", "csv", "data")}, show)


def show_top(leaderboard: Table, most: int = 5) -> None:
    """The first lines of a leaderboard, as far as the terminal is wide."""
    names = [column.name for column in leaderboard.columns]
    shown = ["#", "tracker", "ATE ratio", "success", "coverage", "× real time"]
    cells = [
        [" ".join(filter(None, (cell.text, cell.small))) for cell in (row[names.index(name)] for name in shown)]
        for row in leaderboard.rows[:most]
    ]
    write_table(shown, cells, shrink=("tracker",), spare=("× real time", "coverage", "success"))
    more = len(leaderboard.rows) - most
    write((f"... and {more} more; " if more > 0 else "") + leaderboard.brief)


@app.command()
def publish(
    results: Annotated[list[Path], typer.Argument(help="Results folders.")],
    output: Annotated[Path, typer.Option("-o", "--output", help="The site's folder, e.g. docs/example.")],
    study: Annotated[
        Optional[Path],  # noqa: UP045
        typer.Option(help="Folder of a study with its page, as `tune report` names it."),
    ] = None,
    title: Annotated[str, typer.Option(help="Heading.")] = "Visual SLAM in dynamic scenes",
    remark: Annotated[str, typer.Option(help="What a reader should know, for the first page.")] = "",
    picture_seconds: Annotated[float, typer.Option(min=0, help="Time for drawing pictures of frames.")] = 60,
    protocol: ProtocolId = "tum-rgbd/v1",
    as_json: AsJson = False,
) -> None:
    """Make a static site of stored runs and a study: one folder for any web server, or a repository."""
    from dynslam_bench.reports import publish as publish_site

    with progress("site") as advance:
        site = publish_site(
            results, output, study=study, title=title, note=remark, picture_seconds=picture_seconds,
            protocol=protocol, on_progress=advance,
        )  # fmt: skip
    facts = {"index": site.index, "files": site.files, "size_mb": site.size_mb}
    present(facts, lambda: write(f"{site.index} ({site.files} files, {site.size_mb:.1f} MB)"))


@app.command()
def compare(
    a: Annotated[Path, typer.Argument(help="Results folder, or folder of a report.")],
    b: Annotated[Path, typer.Argument(help="The other one.")],
    protocol: ProtocolId = "tum-rgbd/v1",
    as_json: AsJson = False,
) -> None:
    """Compare two results folders on the sequences that both have, with the same settings or with others."""
    from dynslam_bench.reports import compare as compare_results

    result = compare_results(a, b, protocol=protocol)
    overall = {
        name: {end: None if math.isnan(number) else number for end, number in vars(interval).items()}
        for name, interval in result.overall.items()
    }

    def show() -> None:
        write_report_table(result.table)
        if result.only_a or result.only_b:
            write(f"\nonly in {a}: {result.only_a} runs; only in {b}: {result.only_b} runs")

    facts = {"differences": result.differences, "only_a": result.only_a, "only_b": result.only_b}
    present({"overall": overall} | facts, show)


@app.command("audit-paper")
def audit_paper(
    data_root: DataRoot = None,
    output: Annotated[Optional[Path], typer.Option("-o", "--output", help="Markdown file.")] = None,  # noqa: UP045
    as_json: AsJson = False,
) -> None:
    """Hold the numbers that the paper prints against arithmetic, and against a static camera."""
    from dataclasses import asdict

    from dynslam_bench.core.folders import find_data_root
    from dynslam_bench.core.records import write_atomic
    from dynslam_bench.geometry.trajectory_files import read_tum
    from dynslam_bench.reports.audit import audit_paper as audit
    from dynslam_bench.reports.model.published import claimed
    from dynslam_bench.sequences.catalogue import entry_of

    truth = {}
    for name in sorted(set(claimed()["sequence"])):
        entry = entry_of(name)
        folder = None if entry is None else entry.find(find_data_root(data_root))
        if folder is not None and (folder / "groundtruth.txt").is_file():
            truth[name] = read_tum(folder / "groundtruth.txt")
    findings = audit(truth)
    if output is not None:
        write_atomic(output, findings.to_markdown())

    def show() -> None:
        if output is not None:
            write(str(output))
            return
        for table in (findings.summary(), findings.details()):
            write_report_table(table)
            write()

    present([asdict(finding) for finding in findings.findings], show)


def demo(
    results: Results = Path("results"),
    frames: Annotated[int, typer.Option(min=20, help="Frames of each sequence.")] = 60,
    jobs: Jobs = 2,
    trials: Annotated[int, typer.Option(min=2, help="Trials of the small study.")] = 6,
) -> None:
    """Run trackers on rendered sequences, report them, tune one: all steps, with no download."""
    from dynslam_bench.cli.demo import run_demo

    outcome = run_demo(results, frames=frames, jobs=jobs, trials=trials)
    write()
    write(outcome.leaderboard)
    write()
    for line in (*outcome.story, f"The study: {outcome.conclusion}"):
        write(wrapped(line))
    write()
    write(f"report: {outcome.report}")
    write(f"study:  {outcome.study}")
    if outcome.failed:
        raise typer.Exit(SOME_RUNS_FAILED)
