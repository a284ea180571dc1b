"""Building the report: load, order, put the sections together, write."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from datetime import datetime, timezone
from importlib import import_module
from pathlib import Path
from threading import Thread
from typing import Any

import dynslam_bench
from dynslam_bench.core.records import write_atomic
from dynslam_bench.evaluation.protocol import Protocol, get_protocol
from dynslam_bench.runs.storage.store import RunStore

from .html import sections
from .html.draft import Draft
from .html.explore import PICTURE_SECONDS, RUN_PAGE, Explored, write_explore
from .html.page import render
from .html.paper_section import add_paper
from .html.run_data import MOST_FRAMES
from .model.board import Board, On, make_board
from .model.crew import Crew, helpers_for
from .model.report_data import REPORT_FILE, ReportData
from .model.rows import Loaded, OnProgress, load_runs, open_stores, unheard
from .tables.latex import to_latex
from .tables.table import Table, csv_text, prose, to_csv, to_markdown


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
    on_progress: OnProgress = unheard,
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
    setup: dict[str, Any] = {"protocol": protocol.model_dump_json(), "output": str(output)}
    setup |= {"picture_seconds": picture_seconds, "most_frames": most_frames}
    with _helpers(stores, setup) as crew:
        if crew is not None:  # what only this process needs is loaded while it waits for them
            Thread(target=import_module, args=("scipy.stats",), daemon=True).start()
        loaded = load_runs(stores, protocol, on_progress, crew, reference, trials=trials)
        board = make_board([run.row for run in loaded.runs], reference, on, rank_seen=rank_seen)
        again = command or _command([store.root for store in stores], output, board, most_pages, trials=trials)
        explored = write_explore(
            board, loaded, protocol, output, title=title, crew=crew,
            picture_seconds=picture_seconds, most_frames=most_frames, most_pages=most_pages,
            progress=lambda done, total: on_progress(done, total, "writing the pages of the runs"),
        )  # fmt: skip
        on_progress(0, None, "putting the tables and figures together")
        draft = _drafted(board, protocol, loaded, explored, again, crew)
    on_progress(0, None, "writing")
    return _write(draft, board, output, _data(board, protocol, title), loaded.trials)


def _helpers(stores: Sequence[RunStore], setup: dict[str, Any]) -> AbstractContextManager[Crew | None]:
    """As many helpers as the runs are worth; None for none."""
    count = helpers_for(sum(len(store.ids()) for store in stores))
    return Crew(count, setup) if count else nullcontext()


def _data(board: Board, protocol: Protocol, title: str) -> ReportData:
    return ReportData(
        title=title,
        protocol=protocol.describe(),
        reference=board.reference_name,
        version=dynslam_bench.__version__,
        rows=board.rows,
    )


def _drafted(
    board: Board, protocol: Protocol, loaded: Loaded, explored: Explored, again: str, crew: Crew | None
) -> Draft:
    """The sections of the page in their order."""
    draft = Draft()
    sections.add_leaderboard(draft, board, protocol, loaded)
    sections.add_explore(draft, explored)
    sections.add_speed(draft, board)
    sections.add_errors(draft, board, protocol, loaded, crew)
    add_paper(draft, board, protocol)
    sections.add_trajectories(draft, board, loaded, protocol)
    sections.add_repeatability(draft, board)
    sections.add_masks(draft, board)
    sections.add_failures(draft, board)
    sections.add_provenance(draft, board, loaded, again)
    return draft


def _command(roots: Sequence[Path], output: Path, board: Board, most_pages: int | None, *, trials: bool) -> str:
    """The command that makes the report again."""
    words = ["dynslam-bench", "report", *map(str, roots), "-o", str(output)]
    words += ["--on", board.on] if board.on != "common" else []
    words += ["--reference", board.asked_reference] if board.asked_reference else []
    words += ["--most-pages", str(most_pages)] if most_pages is not None else []
    return shlex.join(words + ["--rank-seen"] * board.rank_seen + ["--trials"] * trials)


def _write(draft: Draft, board: Board, output: Path, data: ReportData, trials: int) -> ReportPaths:
    facts = _facts(board)
    now = datetime.now(timezone.utc).strftime("%Y-%m-%d %H:%M UTC")
    footer = f"Made by dynslam-bench {data.version} on {now}. This page works without a network."
    names = [*(table.id for table in draft.tables), "runs"]
    paths = ReportPaths(
        html=output / "index.html",
        run=output / RUN_PAGE,
        markdown=output / "report.md",
        latex=output / "report.tex",
        csv={name: output / "csv" / f"{name}.csv" for name in names},
        data=output / REPORT_FILE,
        leaderboard=next(table for table in draft.tables if table.id == "leaderboard"),
        trials=trials,
    )
    page = render(draft.sections, draft.figures, title=data.title, protocol=data.protocol, facts=facts, footer=footer)
    for table in draft.tables:
        write_atomic(paths.csv[table.id], to_csv(table))
    write_atomic(paths.csv["runs"], csv_text(board.frame()))
    write_atomic(paths.markdown, _markdown(draft, data, facts) + f"\n{footer}\n")
    latex = [
        to_latex(table, board.rows[0].protocol_id) for table in draft.tables if table.id not in ("machines", "failures")
    ]
    write_atomic(paths.latex, "% needs \\usepackage{booktabs}\n" + "\n".join(latex))
    data.write(paths.data)
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


def _markdown(draft: Draft, data: ReportData, facts: Sequence[tuple[str, str]]) -> str:
    """The whole report as Markdown."""
    counted = ", ".join(f"{value} {name}" for value, name in facts)
    notes = "".join(f"> {prose(note)}\n\n" for section in draft.sections for note in section.notes)
    tables = "\n".join(to_markdown(table) for table in draft.tables)
    return f"# {prose(data.title)}\n\n{data.protocol}\n\n{counted}\n\n{notes}{tables}"
