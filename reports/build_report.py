"""A report: load the runs, order them, put the pages together, write; and the site that is published of it."""

import re
import shlex
import shutil
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime, timezone
from operator import itemgetter
from pathlib import Path
from typing import Any
from urllib.parse import quote

import dynslam_bench
from dynslam_bench.core import ReportError, read_json, sweep_temporary, write_atomic
from dynslam_bench.evaluation import Protocol, get_protocol
from dynslam_bench.reports import figures
from dynslam_bench.reports.html.board_page import MEANINGS, entries_of, ratios_content, side_content
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
    RunPage,
    error_by_share,
    write_run_pages,
)
from dynslam_bench.reports.model.board import (
    OVERALL,
    Board,
    On,
    category_boards,
    make_board,
    missing_commands,
    missing_note,
)
from dynslam_bench.reports.model.load import (
    Loaded,
    OnProgress,
    load_runs,
    no_progress,
    open_stores,
    trial_words,
    without_scale_words,
    worker_pool,
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
from dynslam_bench.reports.tables import leaderboard as tables
from dynslam_bench.reports.tables.published import published_table, span_table
from dynslam_bench.reports.tables.table import Table, csv_text, prose, to_latex, to_markdown
from dynslam_bench.runs.store import RunStore, part_words

COMPARE_PAGE = "compare.html"
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
    trials: int = 0


_NOT_IN_LATEX = ("machines", "failures")
Fact = tuple[str, str, list[str]]
"""A number, what it counts, and its details."""


def build_report(
    runs: Sequence[Path] | Sequence[str] | RunStore | Path | str,
    output: Path | str,
    *,
    protocol: Protocol | str = "tum-rgbd/v1",
    reference: str | None = None,
    on: On = "common",
    rank_seen: bool = False,
    trials: bool = False,
    most_pages: int | None = None,
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
    with worker_pool(sum(len(store.ids()) for store in stores)) as pool:
        loaded = load_runs(stores, protocol, on_progress, pool, trials=trials)
        board = make_board(loaded.rows, reference, on, rank_seen=rank_seen)
        typical = board.typical
        paged = _paged(board, typical, most_pages)
        pictured = {row.run_id for row in paged if row.failed or row.run_id in typical}
        pages = write_run_pages(
            paged,
            pictured,
            protocol,
            output,
            pool,
            lambda done, total: on_progress(done, total, "writing the pages of the runs"),
        )
    on_progress(0, None, "putting the tables and figures together")
    pageless = _pageless(len(paged), len(board.rows))
    again = command or _command(
        [store.source for store in stores], output, board, most_pages, trials=trials
    )
    none_failed = [Block(entries=[f"None of {len(board.rows)} runs failed."])]
    boards = category_boards(board)
    sections = {
        "errors.html": [errors_section(board, protocol), categories_section(boards, protocol)],
        "paper.html": [paper_section(board, protocol)],
        "diagnostics.html": [
            Section(
                "failures", "Failures", blocks=table_blocks(tables.failures(board)) or none_failed
            ),
            Section(
                "repeatability", "Repeatability", blocks=table_blocks(tables.repeatability(board))
            ),
            masks_section(board),
            share_section(board, pages),
        ],
        "reproduce.html": [provenance_section(board, loaded, again)],
    }
    on_progress(0, None, "writing")
    paged_ids = {row.run_id for row in paged}
    write_side(
        output, "board", side_content(board, boards, protocol, paged_ids, pictured, pageless)
    )
    write_side(output, "ratios", ratios_content(board))
    notes = _notes(board, protocol, loaded, pageless)
    return _write(sections, board, boards, protocol, output, title, notes, loaded.trials, paged_ids)


def pages_for(runs: int, typical: int) -> int:
    """How many pages a report has where nobody asks for another number: of very many runs most are never opened.

    Args:
        runs: Runs of the report.
        typical: Those of them with the median error of their cell.
    """
    return runs if runs <= MOST_PAGES else min(max(FEWER_PAGES, typical), MOST_PAGES)


def _paged(board: Board, typical: set[str], most: int | None) -> list[RunRow]:
    """The runs that have a page: the typical one of every cell, trackers in turn, failures first; then repeats."""
    most = pages_for(len(board.rows), len(typical)) if most is None else most
    if len(board.rows) <= most:
        return board.rows
    cells = [cell.rows for cells in board.cells.values() for cell in cells.values()]
    turn = {row.run_id: at for rows in cells for at, row in enumerate(rows)} | dict.fromkeys(
        typical, -1
    )
    rows = sorted(board.rows, key=lambda row: (turn[row.run_id], not row.failed))
    place = {
        row.run_id: at
        for some in grouped(rows, lambda row: row.variant_key).values()
        for at, row in enumerate(some)
    }
    return sorted(rows, key=lambda row: (turn[row.run_id], place[row.run_id]))[:most]


def _pageless(pages: int, runs: int) -> str:
    """Which runs have no page, in words; empty if all have one."""
    if pages == runs:
        return ""
    return (
        f"{runs - pages} of {runs} runs have no pictures and no course over time here: {pages} have, those with the "
        f"median error of their cell first. report --most-pages {runs} shows all. The tables count all runs."
    )


def _command(
    roots: Sequence[Path], output: Path, board: Board, most_pages: int | None, *, trials: bool
) -> str:
    """The command that makes the report again."""
    folder = Path.cwd()
    paths = [
        path.relative_to(folder) if path.is_relative_to(folder) else path
        for path in (*roots, output)
    ]
    words = ["dynslam-bench", "report", *map(str, paths[:-1]), "-o", str(paths[-1])]
    words += ["--on", board.on] if board.on != "common" else []
    words += ["--reference", board.asked_reference] if board.asked_reference else []
    words += ["--most-pages", str(most_pages)] if most_pages is not None else []
    return shlex.join(words + ["--rank-seen"] * board.rank_seen + ["--trials"] * trials)


def _write(
    pages: dict[str, list[Section]],
    board: Board,
    boards: dict[str, Board],
    protocol: Protocol,
    output: Path,
    title: str,
    notes: list[str],
    trials: int,
    paged: Collection[str],
) -> ReportPaths:
    """Write the pages, and the tables in all formats."""
    now = datetime.now(timezone.utc).strftime("%Y-%m-%d %H:%M UTC")
    footer = f"Made by dynslam-bench {dynslam_bench.__version__} on {now}. These pages work without a network."
    blocks = [
        block for sections in pages.values() for section in sections for block in section.blocks
    ]
    shown = {
        t.id: t
        for t in (tables.leaderboard(board, protocol), *(block.table for block in blocks))
        if t is not None
    }
    paths = ReportPaths(
        html=output / "index.html",
        run=output / RUN_PAGE,
        markdown=output / "report.md",
        latex=output / "report.tex",
        csv={name: output / "csv" / f"{name}.csv" for name in (*shown, "runs")},
        data=output / REPORT_FILE,
        leaderboard=shown["leaderboard"],
        headline=headline(board),
        trials=trials,
    )
    for name, table in shown.items():
        write_atomic(paths.csv[name], csv_text(table.frame()))
    write_atomic(paths.csv["runs"], csv_text(board.frame()))
    facts = facts_of(board, protocol)
    counted = ", ".join(f"{value} {name}" for value, name, _ in facts)
    all_notes = [
        *notes,
        *(note for sections in pages.values() for section in sections for note in section.notes),
    ]
    notes_text = "".join(f"> {prose(note)}\n\n" for note in [how_to_read(board), *all_notes])
    texts = "\n".join(map(to_markdown, shown.values()))
    head = f"# {prose(title)}\n\n{prose(headline(board))}\n\n{protocol.describe()}\n\n{counted}\n\n"
    write_atomic(paths.markdown, f"{head}{notes_text}{texts}\n{footer}\n")
    write_atomic(
        paths.latex,
        "% needs \\usepackage{booktabs}\n"
        + "\n".join(
            [
                to_latex(table, protocol.id)
                for name, table in shown.items()
                if name not in _NOT_IN_LATEX
            ]
        ),
    )
    ReportData(
        title=title,
        protocol=protocol.describe(),
        reference=board.reference_name,
        version=dynslam_bench.__version__,
        rows=board.rows,
    ).write(paths.data)
    write_assets(output)
    speed = figures.speed_figure(board)
    caption = (
        f"{'All categories. ' * (len(boards) > 1)}Lower right is better. The dotted line joins ranked trackers that no "
        "other beats in both; open ones are not ranked. Frame times hold for "
        f"{tables.computer_words(board.timing_computer)}."
        + f" {tables.COMPUTER_MARK} Timed on another computer, and not on the dotted line, or on several."
        * bool(tables.computer_note(board))
        + f" {tables.CACHED_NOTE}" * any(row.cached for row in board.rows)
    )
    first_page = render(
        "board.html.j2",
        title=title,
        links=LINKS,
        here="index.html",
        footer=footer,
        scripts=["board.js"],
        sentence=headline(board),
        sentences={name: headline(some) for name, some in boards.items()},
        facts=facts,
        categories={name: entries_of(some, board, boards, paged) for name, some in boards.items()},
        meanings=MEANINGS,
        reference=board.reference_name,
        explanation=how_to_read(board),
        notes=notes,
        caption=caption,
        figures={} if speed is None else {"speed": speed},
    )
    write_atomic(paths.html, first_page)
    for page, sections in pages.items():
        name = dict(LINKS)[page]
        text = sections_page(
            sections,
            title=f"{title}: {name}",
            links=LINKS,
            here=page,
            footer=footer,
            protocol=protocol.describe(),
            errors_table=page == "errors.html",
            scripts=["errors.js"] if page == "errors.html" else [],
        )
        write_atomic(output / page, text)
    write_atomic(
        paths.run,
        render("run.html.j2", title=title, links=LINKS, footer=footer, scripts=["run.js"]),
    )
    compare = {
        "title": "Two trackers side by side",
        "links": LINKS,
        "here": COMPARE_PAGE,
        "footer": footer,
    }
    write_atomic(
        output / COMPARE_PAGE,
        render("compare.html.j2", scripts=["run.js", "compare.js"], **compare),
    )
    return paths


def how_to_read(board: Board) -> str:
    """What the ranking says, for a reader without statistics."""
    return " ".join(filter(None, [explanation(board), mean_rank_note(board)]))


def sections_page(sections: Sequence[Section], **values: Any) -> str:
    """A page of sections; `values` are what `sections.html.j2` shows beside them."""
    shown = [section for section in sections if section.blocks or section.notes]
    charts = {
        f"{section.id}-{at}": block.figure
        for section in shown
        for at, block in enumerate(section.blocks, 1)
        if block.figure is not None
    }
    return render("sections.html.j2", sections=shown, figures=charts, **values)


def facts_of(board: Board, protocol: Protocol) -> list[Fact]:
    """What the board stands on."""
    names = [*board.sequences, *board.unscored]
    by_group = grouped(names, lambda name: board.groups[name])
    sequences = [
        f"{group}: {', '.join(some)}" if group else ", ".join(some)
        for group, some in by_group.items()
    ]
    repeats = sorted({len(cell.rows) for cells in board.cells.values() for cell in cells.values()})
    failed = [row for row in board.rows if row.failed]
    endings = [
        f"{board.labels[row.variant_key]} on {board.sequence(row)}: {row.ending}" for row in failed
    ]
    doubts = reservations(board.rows)
    quoting = [f"Name the protocol, {protocol.id}{', and say:' if doubts else '.'}", *doubts]
    several = f"{repeats[0]}–{repeats[-1]}" if len(repeats) > 1 else str(repeats[0])
    return [
        (str(len(names)), "sequence" + "s" * (len(names) != 1), sequences),
        (str(len(board.labels)), "tracker" + "s" * (len(board.labels) != 1), []),
        (several, "run a cell" if several == "1" else "runs a cell", []),
        (str(len(board.rows)), "run" + "s" * (len(board.rows) != 1), []),
        (
            str(len(failed)),
            "failed",
            first_of(endings, _MOST_NOTES, "and {} more, see Diagnostics"),
        ),
        (
            str(len(doubts)),
            "reservation" + "s" * (len(doubts) != 1) + " when quoting",
            quoting,
        ),
        (protocol.id, "protocol", [protocol.describe()]),
    ]


# -- the sections: what they show, in which order, below which words

_MOST_NOTES = 60
_MOST_COMMANDS = 200


def _notes(board: Board, protocol: Protocol, loaded: Loaded, pageless: str) -> list[str]:
    conflicts = "; ".join(first_of(loaded.conflicts, _MOST_NOTES, "and {} more"))
    final_only = ", ".join(board.labels[key] for key in board.final_only)
    others = sorted({board.labels[row.variant_key] for row in board.rows if not row.is_current})
    in_future = [
        f"{row.label} on {row.sequence.id}, {row.repeat} ({row.started[:10]}, run {row.run_id})"
        for row in loaded.in_future
    ]
    absent = [f"{board.labels[key]} ({changed})" for key, changed in loaded.not_installed.items()]
    left_out = {
        "further runs of the same tracker, settings, frames and repeat": loaded.superseded,
        "runs that were stopped on request": loaded.stopped,
        "folders without a valid record": len(loaded.unreadable),
    }
    counts = ", ".join(f"{count} {words}" for words, count in left_out.items() if count)
    notes = [
        f"Runs with one id must be equal, but these have different results: {conflicts}."
        if conflicts
        else "",
        missing_note(board),
        f"Only in the table of final trajectories, as nothing else is known of them: {final_only}."
        if final_only
        else "",
        f"Without ground truth, and so in no table of errors: {', '.join(board.unscored)}."
        if board.unscored
        else "",
        f"Left out: {counts}." if counts else "",
        "Not ranked, as another program of the same tracker and settings ranks, or as the runs' ids are "
        f"unverified: {', '.join(others)}."
        if others
        else "",
        "Ranked by the program of their newest run, as none of several is the one installed here: "
        f"{', '.join(first_of(absent, _MOST_NOTES, 'and {} more'))}."
        if absent
        else "",
        "Dated in the future, and so counted as the oldest: "
        f"{'; '.join(first_of(in_future, _MOST_NOTES, 'and {} more'))}."
        if in_future
        else "",
        tables.computer_note(board),
        f"Left out: {without_scale_words(loaded.without_scale, protocol)}."
        if loaded.without_scale
        else "",
        f"Left out: {trial_words(loaded.trials)}." if loaded.trials else "",
        pageless,
    ]
    return [note for note in notes if note]


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
    excerpts = {
        board.sequence(row)
        for row in board.rows
        if is_excerpt(row.sequence.id, row.sequence.duration_s)
    }
    shortened = {
        board.sequence(r)
        for r in board.rows
        if part_words(r) and not r.sequence.id.startswith("synthetic/")
    }
    parts = sorted(excerpts | shortened)
    whole = [name for name in board.sequences if name not in parts]
    lines = published_for(whole, protocol)
    published = reported_for(whole, protocol) + records_for(whole, protocol)
    beside = {cell.sequence for cell in published}
    unsure = sorted(
        {
            r.sequence.id
            for r in board.rows
            if board.sequence(r) in beside and not least_length_s(r.sequence.id)
        }
    )
    notes = {
        f"Parts of recordings, beside which no published number stands: {', '.join(parts)}.": parts,
        f"Published numbers stand beside {', '.join(unsure)}, whose full length is not known here: that the runs "
        "are of the whole recordings is not checked.": unsure,
    }
    lost = any(row.incomplete and not row.failed for row in board.rows)
    blocks = table_blocks(
        tables.per_sequence(board, protocol, published),
        tables.final_errors(board, protocol) if protocol.trajectory == "online" else None,
        tables.tracked_errors(board, protocol) if lost else None,
        tables.failure_rule_table(board),
        *tables.relative_errors(board, protocol),
        tables.rotation_errors(board, protocol),
        tables.false_motion(board, protocol),
        published_table(lines),
        span_table(spans(lines)),
        folded=True,
    )
    return Section("errors", "Tables", [note for note, holds in notes.items() if holds], blocks)


def masks_section(board: Board) -> Section:
    """Quality of the masks, and the pose error against it."""
    thinned = any(len(board.runs(key)) > figures.MOST_POINTS for key in board.trackers)
    fewer = f" Of trackers with more than {figures.MOST_POINTS} runs fewer are drawn, from the best to the worst."
    caption = "One point a run." + fewer * thinned
    blocks = figure_blocks(figures.mask_figure(board), caption) + table_blocks(
        tables.mask_quality(board)
    )
    return Section("masks", "Mask quality and pose error", blocks=blocks)


def share_section(board: Board, pages: Sequence[RunPage]) -> Section:
    """Frame-to-frame error against the share of people."""
    bins = {
        key: error_by_share(some)
        for key, some in grouped(pages, lambda page: page.variant_key).items()
    }
    which = (
        "all successful runs"
        if len(pages) == len(board.rows)
        else f"the {len(pages)} runs with pictures here"
    )
    caption = (
        f"Frame-to-frame error (translation, RMSE) over the frames of {which}, by the share of the image that shows "
        "people (exact masks)."
    )
    blocks = figure_blocks(figures.share_figure(board, bins, SHARE_EDGES), caption)
    return Section("share", "Error against the share of people", blocks=blocks)


def provenance_section(board: Board, loaded: Loaded, again: str) -> Section:
    """Machines, versions, the commands that reproduce it, and the diagnostics of the runs."""
    commands = list(dict.fromkeys(command_line(row.command) for row in board.rows if row.command))
    commands = first_of(commands, _MOST_COMMANDS, "# ... and {} more, which report.json names")
    codes = {
        "The commands that reproduce it": [*commands, again],
        "The commands that fill the gaps": missing_commands(board),
    }
    places = grouped(((text, row) for row in board.rows for text in row.notes), itemgetter(0))
    names = {
        text: [
            f"{board.labels[row.variant_key]} on {board.sequence(row)}, {row.repeat}"
            for _, row in runs
        ]
        for text, runs in places.items()
    }
    notes = [
        f"{text}: {'; '.join(first_of(runs, 2, 'and {} more'))}" for text, runs in names.items()
    ]
    lists = (
        (
            "Left out: no valid record",
            loaded.unreadable,
            "... and {} more, which `runs list` names",
        ),
        ("Diagnostics", notes, "... and {} more on the pages of the runs"),
    )
    blocks = table_blocks(tables.machines(board))
    blocks += [Block(title, text="\n".join(lines)) for title, lines in codes.items() if lines]
    blocks += [
        Block(title, entries=first_of(entries, _MOST_NOTES, others), folded=True)
        for title, entries, others in lists
        if entries
    ]
    return Section("provenance", "Machines, versions, commands", blocks=blocks)


def first_of(entries: list[str], most: int, others: str) -> list[str]:
    """The first entries; how many others there are stands behind them."""
    return (
        entries if len(entries) <= most else [*entries[:most], others.format(len(entries) - most)]
    )


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
        lost = figure is not None and any(tables.LOST_MARK in trace.text for trace in figure.data)
        caption = (
            f"As the paper's Figure {number}: {tables.STATISTICS[statistic]} of the absolute pose error, median over "
            "the runs that succeeded; pale bars are not ranked." + f" {tables.LOST_NOTE}" * lost
        )
        blocks += figure_blocks(figure, caption)
    return Section("paper", "Four statistics of the errors, and time", blocks=blocks)


# -- the site that is published

STUDY_PAGE = "index.html"
README = "README.md"
"""What hosts of repositories show of a folder: they show the source of HTML."""
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
    studies: Sequence[Path] = (),
    title: str = "Visual SLAM in dynamic scenes",
    note: str = "",
    protocol: Protocol | str = "tum-rgbd/v1",
    most_pages: int | None = None,
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
        most_pages: As in `build_report`; the pictures of a run take about 0.4 MB.
        on_progress: As in `build_report`.

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
    for part in ("leaderboard/data", "leaderboard/csv", "leaderboard/frames", "study"):
        shutil.rmtree(output / part, ignore_errors=True)
    report = build_report(
        list(runs),
        output / "leaderboard",
        protocol=protocol,
        title=title,
        command="dynslam-bench report RESULTS",
        most_pages=most_pages,
        on_progress=on_progress,
    )
    for path in (report.data, report.latex):  # for work with the results, not for looking at them
        path.unlink()
    report.markdown.replace(output / "leaderboard" / README)
    pages = [("leaderboard/index.html", "Leaderboard", report.headline)]
    pages += [_publish_study(study, output) for study in studies]
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
    write_atomic(output / ".nojekyll", "")
    sizes = [path.stat().st_size for path in output.rglob("*") if path.is_file()]
    return Site(output / "index.html", len(sizes), sum(sizes) / 1e6)


def _publish_study(study: Path, output: Path) -> tuple[str, str, str]:
    """Copy the pages of a study into a site; returns the address of the first one, its name, and its verdict."""
    folder = output / "study" / study.name
    inside = study.resolve()
    sources = {path for pattern in _PUBLISHED for path in study.glob(pattern) if path.is_file()}
    # no link to elsewhere
    for source in sorted(path for path in sources if path.resolve().is_relative_to(inside)):
        target = folder / source.relative_to(study)
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(source, target)
    for page in folder.glob("*.html"):
        shared = f'="../../leaderboard/{ASSETS}/'
        page.write_text(
            page.read_text(encoding="utf-8").replace(f'="{ASSETS}/', shared), encoding="utf-8"
        )
    lists = r'"(pictures|files)":\[(?:[^\[\]]|\[[^\[\]]*\])*\]'
    for path in folder.glob("data/run-*.js"):  # pictures and files of runs are not published
        path.write_text(
            re.sub(lists, r'"\1":[]', path.read_text(encoding="utf-8")), encoding="utf-8"
        )
    summary = study / "summary.json"
    words = read_json(summary)["conclusion"] if summary.is_file() else ""
    return f"study/{study.name}/{STUDY_PAGE}", f"Study {study.name}", words
