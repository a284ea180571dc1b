"""A report: load the runs, order them, put the sections together, write; and the site that is published of it."""

from __future__ import annotations

import shlex
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime, timezone
from pathlib import Path

from jinja2 import Environment

import dynslam_bench
from dynslam_bench.core.errors import ReportError
from dynslam_bench.core.files import write_atomic
from dynslam_bench.evaluation.protocol import Protocol, get_protocol
from dynslam_bench.reports.html import sections
from dynslam_bench.reports.html.explore import PICTURE_SECONDS, RUN_PAGE, write_explore
from dynslam_bench.reports.html.page import Block, Section, render, resource
from dynslam_bench.reports.html.run_page import MOST_FRAMES
from dynslam_bench.reports.model.board import Board, On, make_board
from dynslam_bench.reports.model.load import OnProgress, load_runs, no_progress, open_stores, worker_pool
from dynslam_bench.reports.model.row import REPORT_FILE, ReportData
from dynslam_bench.reports.tables.table import Table, csv_text, prose, to_latex, to_markdown
from dynslam_bench.runs.store import RunStore


@dataclass(frozen=True)
class ReportPaths:
    """The files of a report.

    Attributes:
        html: The page; what it shows on demand lies in ``data/`` and ``frames/`` beside it.
        run: The page that shows one run.
        markdown: The tables as Markdown.
        latex: The main tables as LaTeX.
        csv: The tables as CSV, by name.
        data: All rows, for `compare`.
        leaderboard: The table that the page begins with.
        trials: How many runs were left out since they are trials of studies.
    """

    html: Path
    run: Path
    markdown: Path
    latex: Path
    csv: dict[str, Path]
    data: Path
    leaderboard: Table
    trials: int = 0


_NOT_IN_LATEX = ("machines", "failures")


def build_report(
    runs: Sequence[Path] | Sequence[str] | RunStore | Path | str,
    output: Path | str,
    *,
    protocol: Protocol | str = "tum-rgbd/v1",
    reference: str | None = None,
    on: On = "common",
    rank_seen: bool = False,
    trials: bool = False,
    picture_seconds: float = PICTURE_SECONDS,
    most_frames: int = MOST_FRAMES,
    most_pages: int | None = None,
    title: str = "Visual SLAM in dynamic scenes",
    command: str = "",
    on_progress: OnProgress = no_progress,
) -> ReportPaths:
    """Make one offline HTML page of stored runs, with Markdown, CSV and LaTeX beside it.

    SLAM is not run; metrics that are missing under the protocol are computed from the stored trajectories.

    Args:
        runs: Results folders, or a store.
        output: Folder of the report; files in it that the report does not make are left alone.
        protocol: How to evaluate.
        reference: Tracker id that errors are divided by; `DEFAULT_REFERENCE` where none is named. Where it was not
            run on every ranked sequence, a static camera takes its place.
        on: ``common`` ranks on the sequences that all ranked trackers have, ``all`` only the trackers that have all.
        rank_seen: Whether trackers are also ranked on scenes that the network behind their masks was trained on.
        trials: Whether the trials of studies count like other runs; without, they are left out and counted.
        picture_seconds: Time that drawing pictures of frames may take; the next report into the folder goes on there.
        most_frames: Frames of a run that its page shows; of longer ones every second, third, ...
        most_pages: Runs that have a page of their own, typical ones of their cells first; None for `pages_for`.
        title: Heading.
        command: Command that makes this report again, shown in it; empty for a derived one.
        on_progress: Told of what is done, of how much, and what is going on, see `OnProgress`.

    Raises:
        ReportError: There are no runs, or their numbers stem from different protocols.
        DynslamError: The output folder cannot be written.
    """
    protocol = get_protocol(protocol)
    output = Path(output).expanduser().absolute()
    stores = open_stores(runs)
    with worker_pool(sum(len(store.ids()) for store in stores)) as pool:
        loaded = load_runs(stores, protocol, on_progress, pool, trials=trials)
        board = make_board(loaded.rows, reference, on, rank_seen=rank_seen)
        explored = write_explore(
            board, protocol, output, title=title, pool=pool,
            picture_seconds=picture_seconds, most_frames=most_frames, most_pages=most_pages,
            progress=lambda done, total: on_progress(done, total, "writing the pages of the runs"),
        )  # fmt: skip
        on_progress(0, None, "putting the tables and figures together")
        again = command or _command([store.root for store in stores], output, board, most_pages, trials=trials)
        page_sections = [
            sections.leaderboard_section(board, protocol, loaded),
            Section("explore", "Explore", "Explore", explored.notes, [Block("explore")]),
            sections.speed_section(board),
            sections.errors_section(board, protocol, pool),
            sections.paper_section(board, protocol),
            sections.trajectories_section(board, protocol),
            sections.repeatability_section(board),
            sections.masks_section(board),
            sections.failures_section(board),
            sections.provenance_section(board, loaded, again),
        ]
    on_progress(0, None, "writing")
    data = ReportData(
        title=title,
        protocol=protocol.describe(),
        reference=board.reference_name,
        version=dynslam_bench.__version__,
        rows=board.rows,
    )
    shown = [section for section in page_sections if section.blocks or section.notes]
    return _write(shown, board, output, data, loaded.trials)


def _command(roots: Sequence[Path], output: Path, board: Board, most_pages: int | None, *, trials: bool) -> str:
    """The command that makes the report again."""
    words = ["dynslam-bench", "report", *map(str, roots), "-o", str(output)]
    words += ["--on", board.on] if board.on != "common" else []
    words += ["--reference", board.asked_reference] if board.asked_reference else []
    words += ["--most-pages", str(most_pages)] if most_pages is not None else []
    return shlex.join(words + ["--rank-seen"] * board.rank_seen + ["--trials"] * trials)


def _write(page_sections: Sequence[Section], board: Board, output: Path, data: ReportData, trials: int) -> ReportPaths:
    facts = _facts(board)
    now = datetime.now(timezone.utc).strftime("%Y-%m-%d %H:%M UTC")
    footer = f"Made by dynslam-bench {data.version} on {now}. This page works without a network."
    blocks = [block for section in page_sections for block in section.blocks]
    tables = {block.table.id: block.table for block in blocks if block.table is not None}
    figures = {block.figure: block.chart for block in blocks if block.figure}
    paths = ReportPaths(
        html=output / "index.html",
        run=output / RUN_PAGE,
        markdown=output / "report.md",
        latex=output / "report.tex",
        csv={name: output / "csv" / f"{name}.csv" for name in (*tables, "runs")},
        data=output / REPORT_FILE,
        leaderboard=tables["leaderboard"],
        trials=trials,
    )
    for name, table in tables.items():
        write_atomic(paths.csv[name], csv_text(table.frame()))
    write_atomic(paths.csv["runs"], csv_text(board.frame()))
    counted = ", ".join(f"{value} {name}" for value, name in facts)
    notes = "".join(f"> {prose(note)}\n\n" for section in page_sections for note in section.notes)
    texts = "\n".join(map(to_markdown, tables.values()))
    markdown = f"# {prose(data.title)}\n\n{data.protocol}\n\n{counted}\n\n{notes}{texts}\n{footer}\n"
    write_atomic(paths.markdown, markdown)
    latex = [to_latex(table, data.rows[0].protocol_id) for name, table in tables.items() if name not in _NOT_IN_LATEX]
    write_atomic(paths.latex, "% needs \\usepackage{booktabs}\n" + "\n".join(latex))
    data.write(paths.data)
    page = render(page_sections, figures, title=data.title, protocol=data.protocol, facts=facts, footer=footer)
    write_atomic(paths.html, page)
    return paths


def _facts(board: Board) -> list[tuple[str, str]]:
    """What a report is about, in numbers."""
    counts = [
        (len(board.labels), "tracker"),
        (len(board.sequences) + len(board.unscored), "sequence"),
        (len(board.rows), "run"),
    ]
    named = [(str(count), name + ("" if count == 1 else "s")) for count, name in counts]
    return [*named, (str(sum(row.failed for row in board.rows)), "failed")]


STUDY_PAGE = "index.html"
FRAMES = 100
"""Frames of a run that its published page shows: a site of hundreds of runs has to fit into a repository."""
_PUBLISHED = ("*.html", "*.csv", "*.toml", "csv/*.csv", "data/*")
"""What of a study's folder is published; its runs and its journal are not."""


@dataclass(frozen=True)
class Site:
    """A published site.

    Attributes:
        index: Its first page.
        files: How many files it has.
        size_mb: Their size in MB.
    """

    index: Path
    files: int
    size_mb: float


def publish(
    runs: Sequence[Path],
    output: Path,
    *,
    study: Path | None = None,
    title: str = "Visual SLAM in dynamic scenes",
    note: str = "",
    picture_seconds: float = PICTURE_SECONDS,
    protocol: Protocol | str = "tum-rgbd/v1",
    on_progress: OnProgress = no_progress,
) -> Site:
    """Make the report of some results folders, take a study's page beside it, and write a first page for both.

    The site needs nothing outside of its folder, and the command that it shows for itself names no path of this
    machine.

    Args:
        runs: Results folders.
        output: The site's folder; what it holds of an earlier site is replaced, other files are left alone.
        study: Folder of a study with its page; None for none.
        title: Heading.
        note: What a reader should know, shown on the first page.
        picture_seconds: Time that drawing pictures of frames may take; the frames of an earlier site stay.
        protocol: How to evaluate.
        on_progress: As in `build_report`.

    Raises:
        ReportError: There are no runs, or the study's folder holds no page.
        DynslamError: The folder cannot be written.
    """
    output = output.expanduser().absolute()
    if study is not None and not (study / STUDY_PAGE).is_file():
        raise ReportError(f"{study} holds no {STUDY_PAGE}", "make it with: dynslam-bench tune report STUDY.toml")
    for part in ("leaderboard/data", "leaderboard/csv", "study"):
        shutil.rmtree(output / part, ignore_errors=True)
    report = build_report(
        list(runs), output / "leaderboard", protocol=protocol, title=title, command="dynslam-bench report RESULTS",
        picture_seconds=picture_seconds, most_frames=FRAMES, on_progress=on_progress,
    )  # fmt: skip
    for path in (report.data, report.markdown, report.latex):  # for work with the results, not for looking at them
        path.unlink()
    pages = [("leaderboard/index.html", "Leaderboard", "Trackers, sequences, errors, speed and failures.")]
    if study is not None:
        inside = study.resolve()
        sources = {path for pattern in _PUBLISHED for path in study.glob(pattern) if path.is_file()}
        for source in sorted(path for path in sources if path.resolve().is_relative_to(inside)):  # no link to elsewhere
            target = output / "study" / source.relative_to(study)
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(source, target)
        pages.append((f"study/{STUDY_PAGE}", "Study", "What tuning the settings gained, and how sure that is."))
    template = Environment(autoescape=True, trim_blocks=True).from_string(resource("site.html.j2"))
    page = template.render(title=title, pages=pages, note=note, version=dynslam_bench.__version__)
    write_atomic(output / "index.html", page)
    write_atomic(output / ".nojekyll", "")
    sizes = [path.stat().st_size for path in output.rglob("*") if path.is_file()]
    return Site(output / "index.html", len(sizes), sum(sizes) / 1e6)
