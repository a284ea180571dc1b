"""A report: load the runs, order them, put the pages together, write; and the site that is published of it."""

import re
import shlex
import shutil
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import datetime, timezone
from pathlib import Path
from typing import Any
from urllib.parse import quote

import dynslam_bench
from dynslam_bench.core import ReportError, read_json, sweep_temporary, write_atomic
from dynslam_bench.evaluation import Protocol, get_protocol
from dynslam_bench.reports import figures
from dynslam_bench.reports.html.board_page import (
    board_data,
    ranking_entries,
    ratios_data,
)
from dynslam_bench.reports.html.page import (
    ASSETS,
    Block,
    Section,
    figure_blocks,
    render,
    table_blocks,
    write_assets,
    write_side,
)
from dynslam_bench.reports.html.run_pages import (
    RUN_PAGE,
    SHARE_EDGES,
    LeastError,
    RunPage,
    error_by_share,
    write_run_pages,
)
from dynslam_bench.reports.model.answers import (
    MEANINGS,
    answers,
    cell_error_m,
    error_columns,
    limits,
)
from dynslam_bench.reports.model.board import (
    OVERALL,
    Board,
    RankingBasis,
    category_boards,
    copies_note,
    make_board,
    missing_commands,
    missing_note,
)
from dynslam_bench.reports.model.load import (
    LoadedRuns,
    OnProgress,
    load_for_report,
    no_progress,
    open_stores,
    trial_words,
    without_scale_words,
)
from dynslam_bench.reports.model.published import (
    is_excerpt,
    least_length_s,
    published_for,
    records_for,
    reported_for,
    spans,
)
from dynslam_bench.reports.model.row import REPORT_FILE, ReportData, RunRow, command_line, grouped
from dynslam_bench.reports.model.summary import explanation, headline, mean_rank_note, reservations
from dynslam_bench.reports.model.workers import worker_pool
from dynslam_bench.reports.tables import leaderboard as tables
from dynslam_bench.reports.tables.published import published_table, span_table
from dynslam_bench.reports.tables.quotes import quotes
from dynslam_bench.reports.tables.table import Table, csv_text, prose, to_latex, to_markdown
from dynslam_bench.runs.rows import part_words
from dynslam_bench.runs.store import RunStore

COMPARE_PAGE = "compare.html"
"""The page that shows two trackers side by side."""
LINKS = (
    ("index.html", "Board"),
    ("errors.html", "Errors by sequence"),
    (COMPARE_PAGE, "Compare"),
    ("paper.html", "As in the paper"),
    ("diagnostics.html", "Diagnostics"),
    ("reproduce.html", "Reproduce"),
)
"""The pages of a report, and their names."""
MOST_PAGES = 5000
"""Runs of which all have a page of their own unless something else is asked for."""
FEWER_PAGES = 2000
"""Pages of a report of more runs than that: those of the median run of every cell, and others up to this number."""


@dataclass(frozen=True)
class ReportPaths:
    """The files of a report.

    Attributes:
        html: The first page; the others, and what they show on demand, lie beside it.
        run: The page that shows one run.
        markdown: The tables as Markdown.
        latex: The main tables as LaTeX.
        csv: The tables as CSV, by name.
        data: All rows, for `compare`.
        leaderboard: The table that the page begins with.
        headline: Its message in one sentence.
        answers: Who has which error in millimetres, a sentence a category.
        trials: How many runs were left out since they are trials of studies.
    """

    html: Path
    run: Path
    markdown: Path
    latex: Path
    csv: dict[str, Path]
    data: Path
    leaderboard: Table
    headline: str
    answers: list[str] = field(default_factory=list)
    trials: int = 0


Fact = tuple[str, str, list[str]]
"""A number, what it counts, and its details."""


@dataclass(frozen=True)
class _Content:
    """Content of a report before it is written.

    Attributes:
        title: Heading.
        protocol: How errors were computed.
        board: The board of all sequences.
        boards: Category to its board, see `category_boards`.
        monocular: Category to the board of the trackers whose scale comes from the truth.
        notes: Category to what a reader has to know about its ranking, in sentences.
        common_notes: Notes that apply to all categories.
        sections: File name of a page to its sections.
        trials: How many runs were left out since they are trials of studies.
        paged: Ids of the runs that have a page of their own.
    """

    title: str
    protocol: Protocol
    board: Board
    boards: Mapping[str, Board]
    monocular: Mapping[str, Board]
    notes: Mapping[str, list[str]]
    common_notes: list[str]
    sections: Mapping[str, list[Section]]
    trials: int
    paged: Collection[str]

    @property
    def all_sections(self) -> list[Section]:
        """The sections of all pages, in their order."""
        return [section for sections in self.sections.values() for section in sections]

    @property
    def all_tables(self) -> dict[str, Table]:
        """Id of every table to the table, the leaderboard first."""
        tables_by_id = {"leaderboard": tables.leaderboard(self.board, self.protocol)}
        for section in self.all_sections:
            for block in section.blocks:
                if block.table is not None:
                    tables_by_id[block.table.id] = block.table
        return tables_by_id


def build_report(
    runs: Sequence[Path] | Sequence[str] | RunStore | Path | str,
    output: Path | str,
    *,
    protocol: Protocol | str = "tum-rgbd/v1",
    reference: str | None = None,
    on: RankingBasis = "common",
    rank_seen: bool = False,
    trials: bool = False,
    most_pages: int | None = None,
    most_pictures: int | None = None,
    title: str = "Visual SLAM in dynamic scenes",
    command: str = "",
    on_progress: OnProgress = no_progress,
) -> ReportPaths:
    """Make offline HTML pages of stored runs, with Markdown, CSV and LaTeX beside them.

    SLAM is not run; metrics that are missing under the protocol are computed from the stored
    trajectories.

    Args:
        runs: Results folders, or a store.
        output: Folder of the report; files in it that the report does not make are left alone.
        protocol: How to evaluate.
        reference: Tracker id that errors are divided by; `DEFAULT_REFERENCE` where none is named.
            Where it was not run on every ranked sequence, a static camera takes its place.
        on: ``common`` ranks on the sequences that all ranked trackers have, ``all`` only the
            trackers that have all.
        rank_seen: Whether trackers are also ranked on scenes that the network behind their masks
            was trained on.
        trials: Whether the trials of studies count like other runs; without, they are left out and
            counted.
        most_pages: Runs that have a page of their own, typical ones of their cells first; None for
            `pages_for`.
        most_pictures: Runs whose page has pictures, typical ones first; None for all failures and
            typical runs. Without pictures a page has the track and the curves.
        title: Heading.
        command: Command that makes this report again, shown in it; empty for a derived one.
        on_progress: Told of what is done, of how much, and what is going on, see `OnProgress`.

    Raises:
        ReportError: There are no runs, or their numbers stem from different protocols.
        DynslamError: The output folder cannot be written.
    """
    protocol = get_protocol(protocol)
    output = Path(output).expanduser().absolute()
    sweep_temporary(output, "**/.*")
    stores = open_stores(runs)

    def on_page(done: int, total: int) -> None:
        on_progress(done, total, "writing the pages of the runs")

    with worker_pool(sum(len(store.ids()) for store in stores)) as pool:
        # score the runs and rank the trackers
        loaded, protocol = load_for_report(stores, protocol, on_progress, pool, trials=trials)
        board = make_board(loaded.rows, reference, on, rank_seen=rank_seen)

        # write the pages of runs; only failures and typical runs have pictures
        typical = board.typical
        paged = _choose_paged(board, typical, most_pages)
        paged_ids = {row.run_id for row in paged}
        shown = [row for row in paged if row.failed or row.run_id in typical]
        if most_pictures is not None:
            # typical runs first
            shown.sort(key=lambda row: row.run_id not in typical)
            shown = shown[:most_pictures]
        pictured = {row.run_id for row in shown}
        least = _least_errors(board)
        run_pages = write_run_pages(paged, pictured, protocol, output, least, pool, on_page)

    # put the tables and figures together
    on_progress(0, None, "putting the tables and figures together")
    pageless = _pageless_note(len(paged), len(board.rows))
    if not command:
        sources = [store.source for store in stores]
        command = _derived_command(sources, output, board, most_pages, trials=trials)
    boards = category_boards(board)
    content = _Content(
        title=title,
        protocol=protocol,
        board=board,
        boards=boards,
        monocular=_monocular_boards(loaded, boards),
        notes={category: _board_notes(part, loaded) for category, part in boards.items()},
        common_notes=_common_notes(protocol, loaded, pageless),
        sections={
            "errors.html": [errors_section(board, protocol), categories_section(boards, protocol)],
            "paper.html": [paper_section(board, protocol)],
            "diagnostics.html": [
                failures_section(board),
                Section(
                    "repeatability",
                    "Repeatability",
                    blocks=table_blocks(tables.repeatability(board)),
                ),
                masks_section(board),
                share_section(board, run_pages),
            ],
            "reproduce.html": [provenance_section(board, loaded, command)],
        },
        trials=loaded.trials,
        paged=paged_ids,
    )

    on_progress(0, None, "writing")
    write_side(output, "board", board_data(board, boards, protocol, paged_ids, pictured, pageless))
    write_side(output, "ratios", ratios_data(board))
    return _write(content, output)


def _least_errors(board: Board) -> dict[str, LeastError]:
    """The least median error of a ranked tracker on every sequence, by `RunRow.sequence_key`."""
    least: dict[str, LeastError] = {}
    for row in board.rows:
        name = board.sequence(row)
        if row.sequence_key in least:
            continue
        errors = []
        for key in board.ranked:
            cell = board.cells[key].get(name)
            error_m = None if cell is None else cell_error_m(cell)
            if error_m is not None:
                errors.append((error_m, board.labels[key]))
        if errors:
            least[row.sequence_key] = LeastError(*min(errors))
    return least


def _monocular_boards(loaded: LoadedRuns, boards: Mapping[str, Board]) -> dict[str, Board]:
    """Category to the board of the monocular trackers that were run on its sequences."""
    apart = {}
    for category, part in boards.items():
        columns = {row.sequence_key for row in part.rows}
        rows = [row for row in loaded.monocular if row.sequence_key in columns]
        if category == OVERALL:
            rows = loaded.monocular
        if rows:
            apart[category] = make_board(rows)
    return apart


# -- which runs have a page


def pages_for(runs: int, typical: int) -> int:
    """Pages of a report where nobody asks for another number: of very many runs most are never opened.

    Args:
        runs: Runs of the report.
        typical: Runs among them that have the median error of their cell.
    """
    return runs if runs <= MOST_PAGES else min(max(FEWER_PAGES, typical), MOST_PAGES)


def _choose_paged(board: Board, typical: set[str], most: int | None) -> list[RunRow]:
    """The runs that have a page.

    First come the typical runs of all cells, then the first run of every cell, then the second, and
    so on. Among those all trackers have equally many, and failures come before other runs.
    """
    if most is None:
        most = pages_for(len(board.rows), len(typical))
    if len(board.rows) <= most:
        return board.rows

    # a run's position among the repeats of its cell, before all others for the typical one
    repeat_of = {}
    for cells in board.cells.values():
        for cell in cells.values():
            for repeat, row in enumerate(cell.rows):
                repeat_of[row.run_id] = repeat
    repeat_of |= dict.fromkeys(typical, -1)
    rows = sorted(board.rows, key=lambda row: (repeat_of[row.run_id], not row.failed))

    # a run's position among those of its tracker, so that trackers take turns
    position_of = {}
    for of_tracker in grouped(rows, lambda row: row.variant_key).values():
        for position, row in enumerate(of_tracker):
            position_of[row.run_id] = position
    return sorted(rows, key=lambda row: (repeat_of[row.run_id], position_of[row.run_id]))[:most]


def _pageless_note(pages: int, runs: int) -> str:
    """Sentence on the runs that have no page; empty if all have one."""
    if pages == runs:
        return ""
    return (
        f"{runs - pages} of {runs} runs have no track and no curves here: {pages} have, those with the "
        f"median error of their cell first. report --most-pages {runs} shows all. The tables count all runs."
    )


def _derived_command(
    sources: Sequence[Path], output: Path, board: Board, most_pages: int | None, *, trials: bool
) -> str:
    """The command that makes the report again; paths below the working directory are relative to it."""
    folder = Path.cwd()
    *results, target = (
        str(path.relative_to(folder) if path.is_relative_to(folder) else path)
        for path in (*sources, output)
    )
    words = ["dynslam-bench", "report", *results, "-o", target]
    if board.on != "common":
        words += ["--on", board.on]
    if board.asked_reference:
        words += ["--reference", board.asked_reference]
    if most_pages is not None:
        words += ["--most-pages", str(most_pages)]
    if board.rank_seen:
        words.append("--rank-seen")
    if trials:
        words.append("--trials")
    return shlex.join(words)


# -- the files of a report


def _write(content: _Content, output: Path) -> ReportPaths:
    """Write the pages, and the tables in all formats."""
    tables_by_id = content.all_tables
    paths = ReportPaths(
        html=output / "index.html",
        run=output / RUN_PAGE,
        markdown=output / "report.md",
        latex=output / "report.tex",
        csv={name: output / "csv" / f"{name}.csv" for name in (*tables_by_id, "runs")},
        data=output / REPORT_FILE,
        leaderboard=tables_by_id["leaderboard"],
        headline=headline(content.board),
        answers=answers(content.board),
        trials=content.trials,
    )
    now = datetime.now(timezone.utc).strftime("%Y-%m-%d %H:%M UTC")
    footer = f"Made by dynslam-bench {dynslam_bench.__version__} on {now}. These pages work without a network."
    facts = facts_of(content.board, content.protocol)

    # the tables as CSV, Markdown and LaTeX, and the rows for `compare`
    for name, table in tables_by_id.items():
        write_atomic(paths.csv[name], csv_text(table.frame()))
    write_atomic(paths.csv["runs"], csv_text(content.board.frame()))
    write_atomic(paths.markdown, _markdown(content, tables_by_id, facts, footer))
    few = _paper_tables(tables_by_id, content.protocol)
    latex_tables = [to_latex(table, content.protocol.id) for table in few]
    head = "% needs \\usepackage{booktabs}; all other tables: csv/\n"
    write_atomic(paths.latex, head + "\n".join(latex_tables))
    ReportData(
        title=content.title,
        protocol=content.protocol.describe(),
        reference=content.board.reference_name,
        version=dynslam_bench.__version__,
        rows=content.board.rows,
    ).write(paths.data)

    # write the pages of the report
    write_assets(output)
    write_atomic(paths.html, _first_page(content, facts, footer))
    for page in content.sections:
        write_atomic(output / page, _page_of_sections(content, page, footer))
    run_page = render(
        "run.html.j2", title=content.title, links=LINKS, footer=footer, scripts=["run.js"]
    )
    write_atomic(paths.run, run_page)
    compare_page = render(
        "compare.html.j2",
        scripts=["run.js", "compare.js"],
        title="Two trackers side by side",
        links=LINKS,
        here=COMPARE_PAGE,
        footer=footer,
    )
    write_atomic(output / COMPARE_PAGE, compare_page)
    return paths


def _paper_tables(tables_by_id: Mapping[str, Table], protocol: Protocol) -> list[Table]:
    """The few tables that a paper shows: the board, errors by sequence and category, the first relative error."""
    names = ["leaderboard", "per_sequence", "categories"]
    names += [f"rpe_{spec.key}_trans" for spec in protocol.rpe[:1]]
    return [table for name, table in tables_by_id.items() if name in names]


def _markdown(
    content: _Content, tables_by_id: Mapping[str, Table], facts: Sequence[Fact], footer: str
) -> str:
    """Headline, facts, notes and the few tables of a paper as Markdown, with the failures."""
    shown = _paper_tables(tables_by_id, content.protocol)
    shown += [table for name, table in tables_by_id.items() if name == "failures"]
    board = content.board
    counts = ", ".join(f"{value} {name}" for value, name, _ in facts)
    notes = [how_to_read(board), *content.notes[OVERALL], *content.common_notes]
    for section in content.all_sections:
        notes += section.notes
    said = [*answers(board), f"{headline(board)} {limits(board)}"]
    opening = "\n\n".join(prose(sentence) for sentence in said)
    head = f"# {prose(content.title)}\n\n{opening}\n\n{content.protocol.describe()}\n\n{counts}\n\n"
    quoted = "".join(f"> {prose(note)}\n\n" for note in notes)
    return (
        head
        + quoted
        + "\n".join(map(to_markdown, shown))
        + f"\nAll other tables: csv/.\n\n{footer}\n"
    )


def _first_page(content: _Content, facts: Sequence[Fact], footer: str) -> str:
    """The page that a report begins with: the ranking by category, and accuracy against speed."""
    board = content.board
    boards = content.boards
    said = {category: answers(part) for category, part in boards.items()}
    sentences = {category: headline(part) for category, part in boards.items()}
    columns = {category: error_columns(part) for category, part in boards.items()}
    rankings = {
        category: ranking_entries(part, board, boards, content.paged, content.monocular)
        for category, part in boards.items()
    }
    quoted = {
        category: quotes(
            part, content.protocol, [*said[category], sentences[category]], columns[category]
        )
        for category, part in boards.items()
    }
    charts = {"speed": figures.speed_figure(board)}
    for number, part in enumerate(boards.values()):
        charts[f"errors-{number}"] = figures.error_figure(part)
        charts[f"below-{number}"] = figures.cumulative_figure(part)
    return render(
        "board.html.j2",
        title=content.title,
        links=LINKS,
        here="index.html",
        footer=footer,
        scripts=["board.js"],
        answers=said,
        sentences=sentences,
        limits={category: limits(part) for category, part in boards.items()},
        facts=facts,
        categories=rankings,
        columns=columns,
        meanings=MEANINGS,
        reference=board.reference_name,
        explanation=how_to_read(board),
        notes=content.notes,
        common_notes=content.common_notes,
        quotes=quoted,
        caption=_speed_caption(content),
        figures={name: chart for name, chart in charts.items() if chart is not None},
    )


def _speed_caption(content: _Content) -> str:
    """Sentences on reading the figure of accuracy against speed."""
    board = content.board
    sentences = []
    if len(content.boards) > 1:
        sentences.append("All categories.")
    sentences.append(
        "Lower right is better. The dotted line joins ranked trackers that no other beats in both; open ones are not "
        f"ranked. Frame times hold for {tables.computer_words(board.timing_computer)}."
    )
    if tables.computer_note(board):
        sentences.append(
            f"{tables.COMPUTER_MARK} Timed on another computer, and not on the dotted line, or on several."
        )
    if any(row.cached for row in board.rows):
        sentences.append(tables.CACHED_NOTE)
    return " ".join(sentences)


def _page_of_sections(content: _Content, page: str, footer: str) -> str:
    """The text of one of the further pages; that of the errors has a script of its own."""
    is_errors = page == "errors.html"
    return sections_page(
        content.sections[page],
        title=f"{content.title}: {dict(LINKS)[page]}",
        links=LINKS,
        here=page,
        footer=footer,
        protocol=content.protocol.describe(),
        errors_table=is_errors,
        scripts=["errors.js"] if is_errors else [],
    )


def how_to_read(board: Board) -> str:
    """Explain the ranking to a reader without statistics."""
    return " ".join(filter(None, [explanation(board), mean_rank_note(board)]))


def sections_page(sections: Sequence[Section], **values: Any) -> str:
    """A page of sections; `values` are what `sections.html.j2` shows beside them."""
    shown = [section for section in sections if section.blocks or section.notes]
    charts = {}
    for section in shown:
        for number, block in enumerate(section.blocks, 1):
            if block.figure is not None:
                charts[f"{section.id}-{number}"] = block.figure
    return render("sections.html.j2", sections=shown, figures=charts, **values)


def facts_of(board: Board, protocol: Protocol) -> list[Fact]:
    """Facts of the board: sequences, trackers, runs, failures, reservations and the protocol."""
    # sequences by group
    names = [*board.sequences, *board.unscored]
    by_group = grouped(names, lambda name: board.groups[name])
    sequences = []
    for group, members in by_group.items():
        listed = ", ".join(members)
        sequences.append(f"{group}: {listed}" if group else listed)

    # how many runs a cell has, from the fewest to the most
    repeats = sorted({len(cell.rows) for cells in board.cells.values() for cell in cells.values()})
    repeats_text = f"{repeats[0]}–{repeats[-1]}" if len(repeats) > 1 else str(repeats[0])

    failed = [row for row in board.rows if row.failed]
    endings = [
        f"{board.labels[row.variant_key]} on {board.sequence(row)}: {row.ending}" for row in failed
    ]
    doubts = reservations(board.rows)
    quoting = [f"Name the protocol, {protocol.id}{', and say:' if doubts else '.'}", *doubts]
    return [
        (str(len(names)), _plural("sequence", len(names)), sequences),
        (str(len(board.labels)), _plural("tracker", len(board.labels)), []),
        (repeats_text, "run a cell" if repeats_text == "1" else "runs a cell", []),
        (str(len(board.rows)), _plural("run", len(board.rows)), []),
        (
            str(len(failed)),
            "failed",
            first_of(endings, _MOST_NOTES, "and {} more, see Diagnostics"),
        ),
        (str(len(doubts)), _plural("reservation", len(doubts)) + " when quoting", quoting),
        (protocol.id, "protocol", [protocol.describe()]),
    ]


def _plural(word: str, count: int) -> str:
    """A word as it stands behind a count."""
    return word if count == 1 else f"{word}s"


# -- the sections: what they show, in which order, below which words

_MOST_NOTES = 60
"""Entries of a list that are shown one by one."""
_MOST_COMMANDS = 200
"""Commands that are shown."""


def _board_notes(board: Board, loaded: LoadedRuns) -> list[str]:
    """Notes on the ranking of a category: gaps, and what is not ranked."""
    notes = [missing_note(board), copies_note(board)]
    if board.final_only:
        final_only = ", ".join(board.labels[key] for key in board.final_only)
        notes.append(
            f"Not ranked, since only final trajectories are known, which use later frames: {final_only}."
        )
    if board.unscored:
        notes.append(
            f"Without ground truth, and so in no table of errors: {', '.join(board.unscored)}."
        )
    notes += [*_program_notes(board, loaded), tables.computer_note(board)]
    return [note for note in notes if note]


def _common_notes(protocol: Protocol, loaded: LoadedRuns, pageless: str) -> list[str]:
    """Notes on all categories: contradictions, and what is left out."""
    notes = []
    if loaded.conflicts:
        conflicts = "; ".join(first_of(loaded.conflicts, _MOST_NOTES, "and {} more"))
        notes.append(
            f"Runs with one id must be equal, but these have different results: {conflicts}."
        )
    notes += [loaded.protocol_note, _left_out_note(loaded)]
    if loaded.monocular:
        notes.append(
            f"{len(loaded.monocular)} runs of monocular trackers are scored with the scale of the truth "
            f"({loaded.monocular[0].protocol_id}), and rank with nothing else."
        )
    if loaded.without_scale:
        notes.append(f"Left out: {without_scale_words(loaded.without_scale, protocol)}.")
    if loaded.trials:
        notes.append(f"Left out: {trial_words(loaded.trials)}.")
    notes.append(pageless)
    return [note for note in notes if note]


def _left_out_note(loaded: LoadedRuns) -> str:
    """Sentence on runs that are in no table, by reason; empty for none."""
    left_out = {
        "further runs of the same tracker, settings, frames and repeat": loaded.superseded,
        "runs that were stopped on request": loaded.stopped,
        "folders without a valid record": len(loaded.unreadable),
    }
    counts = ", ".join(f"{count} {words}" for words, count in left_out.items() if count)
    return f"Left out: {counts}." if counts else ""


def _program_notes(board: Board, loaded: LoadedRuns) -> list[str]:
    """Notes where several programs made runs of one tracker."""
    notes = []
    others = sorted({board.labels[row.variant_key] for row in board.rows if not row.is_current})
    if others:
        notes.append(
            "Not ranked, as another program of the same tracker and settings ranks, or as the runs' ids are "
            f"unverified: {', '.join(others)}."
        )
    # a category lacks the trackers that were not run on its sequences
    absent = [
        f"{board.labels[key]} ({changed})"
        for key, changed in loaded.not_installed.items()
        if key in board.labels
    ]
    if absent:
        notes.append(
            "Ranked by the program of their newest run, as none of several is the one installed here: "
            f"{', '.join(first_of(absent, _MOST_NOTES, 'and {} more'))}."
        )
    sequences = {row.sequence.id for row in board.rows}
    in_future = [
        f"{row.label} on {row.sequence.id}, {row.repeat} ({row.started[:10]}, run {row.run_id})"
        for row in loaded.in_future
        if row.sequence.id in sequences
    ]
    if in_future:
        notes.append(
            "Dated in the future, and so counted as the oldest: "
            f"{'; '.join(first_of(in_future, _MOST_NOTES, 'and {} more'))}."
        )
    return notes


def categories_section(boards: Mapping[str, Board], protocol: Protocol) -> Section:
    """The ratios by category, the leaderboard of every category, and all pairs of trackers."""
    blocks = table_blocks(tables.category_table(boards))
    for category, part in boards.items():
        if category != OVERALL:
            table = tables.leaderboard(part, protocol)
            name = f"leaderboard_{category.replace(' ', '_')}"
            blocks += table_blocks(replace(table, id=name, title=headline(part)), folded=True)
    blocks += table_blocks(tables.pair_table(boards[OVERALL]), folded=True)
    return Section("categories", "By category, and all pairs", blocks=blocks)


def errors_section(board: Board, protocol: Protocol) -> Section:
    """Errors by sequence, absolute and relative, with what they owe to lost frames and failures."""
    if not board.sequences:
        return Section("errors", "Tables")

    # published numbers hold for whole recordings only
    partial = _partial_sequences(board)
    whole = [name for name in board.sequences if name not in partial]
    lines = published_for(whole, protocol)
    published = reported_for(whole, protocol) + records_for(whole, protocol)

    notes = []
    if partial:
        notes.append(
            f"Parts of recordings, beside which no published number stands: {', '.join(partial)}."
        )
    sequences_with_published = {cell.sequence for cell in published}
    unsure = set()
    for row in board.rows:
        is_beside = board.sequence(row) in sequences_with_published
        if is_beside and not least_length_s(row.sequence.id):
            unsure.add(row.sequence.id)
    if unsure:
        notes.append(
            f"Published numbers stand beside {', '.join(sorted(unsure))}, whose full length is not known here: that "
            "the runs are of the whole recordings is not checked."
        )

    has_lost_frames = any(row.incomplete and not row.failed for row in board.rows)
    blocks = table_blocks(
        tables.per_sequence(board, protocol, published),
        tables.final_errors(board, protocol) if protocol.trajectory == "online" else None,
        tables.tracked_errors(board, protocol) if has_lost_frames else None,
        tables.failure_rule_table(board),
        *tables.relative_errors(board, protocol),
        tables.rotation_errors(board, protocol),
        tables.false_motion(board, protocol),
        published_table(lines),
        span_table(spans(lines)),
        folded=True,
    )
    return Section("errors", "Tables", notes, blocks)


def _partial_sequences(board: Board) -> list[str]:
    """Sequences with runs on a part of a recording: on an excerpt, or on some of its frames."""
    names = set()
    for row in board.rows:
        is_recorded = not row.sequence.id.startswith("synthetic/")
        if is_excerpt(row.sequence.id, row.sequence.duration_s) or (
            is_recorded and part_words(row)
        ):
            names.add(board.sequence(row))
    return sorted(names)


def failures_section(board: Board) -> Section:
    """The runs that failed, and how they ended."""
    blocks = table_blocks(tables.failures(board))
    if not blocks:
        blocks = [Block(entries=[f"None of {len(board.rows)} runs failed."])]
    return Section("failures", "Failures", blocks=blocks)


def masks_section(board: Board) -> Section:
    """Quality of the masks, and the pose error against it."""
    caption = "One point a run."
    if any(len(board.runs(key)) > figures.MOST_POINTS for key in board.trackers):
        most = figures.MOST_POINTS
        caption += (
            f" Of trackers with more than {most} runs fewer are drawn, from the best to the worst."
        )
    blocks = figure_blocks(figures.mask_figure(board), caption)
    blocks += table_blocks(tables.mask_quality(board))
    return Section("masks", "Mask quality and pose error", blocks=blocks)


def share_section(board: Board, pages: Sequence[RunPage]) -> Section:
    """Frame-to-frame error against the share of people."""
    pages_by_tracker = grouped(pages, lambda page: page.variant_key)
    bins = {key: error_by_share(of_tracker) for key, of_tracker in pages_by_tracker.items()}
    which = f"the {len(pages)} runs with pictures here"
    if len(pages) == len(board.rows):
        which = "all successful runs"
    caption = (
        f"Frame-to-frame error (translation, RMSE) over the frames of {which}, by the share of the image that shows "
        "people (exact masks)."
    )
    blocks = figure_blocks(figures.share_figure(board, bins, SHARE_EDGES), caption)
    return Section("share", "Error against the share of people", blocks=blocks)


def provenance_section(board: Board, loaded: LoadedRuns, again: str) -> Section:
    """Machines, versions, the commands that reproduce it, and the diagnostics of the runs.

    Args:
        board: The board.
        loaded: What was read from the stores.
        again: The command that makes this report again.
    """
    # commands that made the runs, each once
    commands = list(dict.fromkeys(command_line(row.command) for row in board.rows if row.command))
    commands = first_of(commands, _MOST_COMMANDS, "# ... and {} more, which report.json names")
    codes = {
        "The commands that reproduce it": [*commands, again],
        "The commands that fill the gaps": missing_commands(board),
    }

    # lists, folded: a title, the entries, and what stands for those that are not shown
    lists = (
        (
            "Left out: no valid record",
            loaded.unreadable,
            "... and {} more, which `runs list` names",
        ),
        ("Diagnostics", _diagnostics(board), "... and {} more on the pages of the runs"),
    )
    blocks = table_blocks(tables.machines(board))
    for title, lines in codes.items():
        if lines:
            blocks.append(Block(title, text="\n".join(lines)))
    for title, entries, others in lists:
        if entries:
            shown = first_of(entries, _MOST_NOTES, others)
            blocks.append(Block(title, entries=shown, folded=True))
    return Section("provenance", "Machines, versions, commands", blocks=blocks)


def _diagnostics(board: Board) -> list[str]:
    """Every note of a run once, with the first two runs that have it."""
    runs_by_note: dict[str, list[str]] = {}
    for row in board.rows:
        run = f"{board.labels[row.variant_key]} on {board.sequence(row)}, {row.repeat}"
        for note in row.notes:
            runs_by_note.setdefault(note, []).append(run)
    return [
        f"{note}: {'; '.join(first_of(runs, 2, 'and {} more'))}"
        for note, runs in runs_by_note.items()
    ]


def first_of(entries: list[str], most: int, others: str) -> list[str]:
    """The first entries; behind them `others`, with the number of those that are left out in place of ``{}``."""
    if len(entries) <= most:
        return entries
    return [*entries[:most], others.format(len(entries) - most)]


def paper_section(board: Board, protocol: Protocol) -> Section:
    """Tables 1 to 3 and Figures 9 to 12, as the paper lays them out."""
    blocks = table_blocks(
        tables.absolute_table(board, protocol),
        tables.relative_table(board, protocol),
        tables.time_table(board),
        folded=True,
    )
    for statistic, number in figures.FIGURES.items():
        figure = figures.bar_figure(board, statistic)
        caption = (
            f"As the paper's Figure {number}: {tables.STATISTICS[statistic]} of the absolute pose error, median over "
            "the runs that succeeded; pale bars are not ranked."
        )
        if figure is not None and any(tables.LOST_MARK in trace.text for trace in figure.data):
            caption += f" {tables.LOST_NOTE}"
        blocks += figure_blocks(figure, caption)
    return Section("paper", "Four statistics of the errors, and time", blocks=blocks)


# -- the site that is published

STUDY_PAGE = "index.html"
"""The page of a study's folder."""
README = "README.md"
"""File that hosts of repositories show of a folder: of HTML they show the source."""
_PUBLISHED = ("*.html", "*.csv", "*.toml", "csv/*.csv", "data/*")
"""Files of a study's folder that are published; its runs and its journal are not."""
_LISTS_OF_FILES = r'"(pictures|files)":\[(?:[^\[\]]|\[[^\[\]]*\])*\]'
"""The lists of pictures and files in what the page of a run shows; entries may be lists themselves."""


@dataclass(frozen=True)
class Site:
    """A published site.

    Attributes:
        index: Its first page.
        files: How many files it has.
        size_mb: Size of all files in MB.
    """

    index: Path
    files: int
    size_mb: float


def publish(
    runs: Sequence[Path],
    output: Path,
    *,
    studies: Sequence[Path] = (),
    title: str = "Visual SLAM in dynamic scenes",
    note: str = "",
    protocol: Protocol | str = "tum-rgbd/v1",
    most_pages: int | None = None,
    most_pictures: int | None = None,
    on_progress: OnProgress = no_progress,
) -> Site:
    """Make the report of some results folders, take the pages of studies beside it, and write a first page for all.

    The site needs nothing outside of its folder, and the command that it shows for itself names no
    path of this machine.

    Args:
        runs: Results folders.
        output: The site's folder; what it holds of an earlier site is replaced, other files are
            left alone.
        studies: Folders of studies with their pages.
        title: Heading.
        note: What a reader should know, shown on the first page.
        protocol: How to evaluate.
        most_pages: Runs that have a page of their own, see `build_report`; a page takes about 30 kB.
        most_pictures: Runs whose pictures are shown, see `build_report`; the pictures of a run take
            about 0.4 MB.
        on_progress: Told of what is done, of how much, and what is going on, see `OnProgress`.

    Raises:
        ReportError: There are no runs, or the folder of a study holds no page.
        DynslamError: The folder cannot be written.
    """
    output = output.expanduser().absolute()
    for study in studies:
        if not (study / STUDY_PAGE).is_file():
            raise ReportError(
                f"{study} holds no {STUDY_PAGE}", "make it with: dynslam-bench tune run STUDY.toml"
            )

    # the report in place of an earlier one
    for part in ("leaderboard/data", "leaderboard/csv", "leaderboard/frames", "study"):
        shutil.rmtree(output / part, ignore_errors=True)
    report = build_report(
        list(runs),
        output / "leaderboard",
        protocol=protocol,
        title=title,
        command="dynslam-bench report RESULTS",
        most_pages=most_pages,
        most_pictures=most_pictures,
        on_progress=on_progress,
    )
    # the rows are for work with the results, not for looking at them
    report.data.unlink()
    report.markdown.replace(output / "leaderboard" / README)

    # the studies: address of the page, its name, and what it says
    pages = [("leaderboard/index.html", "Leaderboard", report.headline)]
    pages += [_publish_study(study, output) for study in studies]

    # the first page, as HTML and as Markdown
    made = f"Made by dynslam-bench report publish, version {dynslam_bench.__version__}."
    site = sections_page([], title=title, pages=pages, protocol=note, footer=made)
    write_atomic(output / "index.html", site.replace(f'="{ASSETS}/', f'="leaderboard/{ASSETS}/'))
    lines = [
        f"- [{prose(name)}]({quote(str(Path(href).parent))}): {prose(words)}"
        for href, name, words in pages
    ]
    how = "The pages are HTML: get the repository, and open `index.html` in a browser."
    text = [f"# {prose(title)}", prose(note), *lines, how, made]
    write_atomic(output / README, "\n\n".join(filter(None, text)) + "\n")
    # GitHub Pages then shows the files as they are
    write_atomic(output / ".nojekyll", "")
    sizes = [path.stat().st_size for path in output.rglob("*") if path.is_file()]
    return Site(output / "index.html", len(sizes), sum(sizes) / 1e6)


def _publish_study(study: Path, output: Path) -> tuple[str, str, str]:
    """Copy the pages of a study into a site; returns the address of the first one, its name, and its verdict."""
    folder = output / "study" / study.name

    # copy what is published; nothing that a link leads to elsewhere
    inside = study.resolve()
    sources = {path for pattern in _PUBLISHED for path in study.glob(pattern) if path.is_file()}
    for source in sorted(path for path in sources if path.resolve().is_relative_to(inside)):
        target = folder / source.relative_to(study)
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(source, target)

    # pages take styles and scripts from the leaderboard's folder
    shared = f'="../../leaderboard/{ASSETS}/'
    for page in folder.glob("*.html"):
        html = page.read_text(encoding="utf-8")
        page.write_text(html.replace(f'="{ASSETS}/', shared), encoding="utf-8")

    # pictures and files of runs are not published
    for path in folder.glob("data/run-*.js"):
        script = path.read_text(encoding="utf-8")
        path.write_text(re.sub(_LISTS_OF_FILES, r'"\1":[]', script), encoding="utf-8")

    summary = study / "summary.json"
    words = read_json(summary)["conclusion"] if summary.is_file() else ""
    return f"study/{study.name}/{STUDY_PAGE}", f"Study {study.name}", words
