"""A report: load the runs, order them, put the sections together, write; and the site that is published of it."""

from __future__ import annotations

import shlex
import shutil
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import datetime, timezone
from pathlib import Path

from jinja2 import Environment

import dynslam_bench
from dynslam_bench.core.errors import ReportError
from dynslam_bench.core.files import write_atomic
from dynslam_bench.evaluation.protocol import Protocol, get_protocol
from dynslam_bench.reports import figures
from dynslam_bench.reports.figures import colours, safe
from dynslam_bench.reports.html.explore import MOST_FRAMES, PICTURE_SECONDS, RUN_PAGE, write_explore
from dynslam_bench.reports.html.page import Block, Section, figure_blocks, render, resource, table_blocks
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
from dynslam_bench.reports.model.row import REPORT_FILE, ReportData, command_line
from dynslam_bench.reports.model.statistics import FEWEST
from dynslam_bench.reports.model.summary import explanation, headline, mean_rank_note
from dynslam_bench.reports.tables import leaderboard as tables
from dynslam_bench.reports.tables.published import published_table, span_table
from dynslam_bench.reports.tables.table import Table, csv_text, prose, to_latex, to_markdown
from dynslam_bench.runs.store import RunStore, part_words


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
        explore_notes = write_explore(
            board, protocol, output, title=title, pool=pool,
            picture_seconds=picture_seconds, most_frames=most_frames, most_pages=most_pages,
            progress=lambda done, total: on_progress(done, total, "writing the pages of the runs"),
        )  # fmt: skip
        on_progress(0, None, "putting the tables and figures together")
        again = command or _command([store.root for store in stores], output, board, most_pages, trials=trials)
        none_failed = [Block("list", entries=[f"None of {len(board.rows)} runs failed."])]
        sections = [
            leaderboard_section(board, protocol, loaded),
            categories_section(board, protocol),
            Section("explore", "Explore", "Explore", explore_notes, [Block("explore")]),
            speed_section(board),
            errors_section(board, protocol),
            paper_section(board, protocol),
            trajectories_section(board, protocol),
            Section(
                "repeatability", "Repeatability", "Repeatability", blocks=table_blocks(tables.repeatability(board))
            ),
            masks_section(board),
            Section("failures", "Failures", "Failures", blocks=table_blocks(tables.failures(board)) or none_failed),
            provenance_section(board, loaded, again),
        ]
    on_progress(0, None, "writing")
    shown = [section for section in sections if section.blocks or section.notes]
    return _write(shown, board, protocol, output, title, loaded.trials)


def _command(roots: Sequence[Path], output: Path, board: Board, most_pages: int | None, *, trials: bool) -> str:
    """The command that makes the report again."""
    words = ["dynslam-bench", "report", *map(str, roots), "-o", str(output)]
    words += ["--on", board.on] if board.on != "common" else []
    words += ["--reference", board.asked_reference] if board.asked_reference else []
    words += ["--most-pages", str(most_pages)] if most_pages is not None else []
    return shlex.join(words + ["--rank-seen"] * board.rank_seen + ["--trials"] * trials)


def _write(
    sections: Sequence[Section], board: Board, protocol: Protocol, output: Path, title: str, trials: int
) -> ReportPaths:
    n_sequences = len(board.sequences) + len(board.unscored)
    counts = {"tracker": len(board.labels), "sequence": n_sequences, "run": len(board.rows)}
    facts = [(str(count), name + "s" * (count != 1)) for name, count in counts.items()]
    facts.append((str(sum(row.failed for row in board.rows)), "failed"))
    now = datetime.now(timezone.utc).strftime("%Y-%m-%d %H:%M UTC")
    footer = f"Made by dynslam-bench {dynslam_bench.__version__} on {now}. This page works without a network."
    blocks = [block for section in sections for block in section.blocks]
    shown = {block.table.id: block.table for block in blocks if block.table is not None}
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
    counted = ", ".join(f"{value} {name}" for value, name in facts)
    notes = "".join(f"> {prose(note)}\n\n" for section in sections for note in section.notes)
    texts = "\n".join(map(to_markdown, shown.values()))
    head = f"# {prose(title)}\n\n{protocol.describe()}\n\n{counted}\n\n"
    write_atomic(paths.markdown, f"{head}{notes}{texts}\n{footer}\n")
    write_atomic(
        paths.latex,
        "% needs \\usepackage{booktabs}\n"
        + "\n".join([to_latex(table, protocol.id) for name, table in shown.items() if name not in _NOT_IN_LATEX]),
    )
    ReportData(
        title=title,
        protocol=protocol.describe(),
        reference=board.reference_name,
        version=dynslam_bench.__version__,
        rows=board.rows,
    ).write(paths.data)
    write_atomic(paths.html, render(sections, title=title, protocol=protocol.describe(), facts=facts, footer=footer))
    return paths


# -- the sections: what they show, in which order, below which words

_MOST_NOTES = 60
_MOST_COMMANDS = 200


def leaderboard_section(board: Board, protocol: Protocol, loaded: Loaded) -> Section:
    """The ranking, what is missing for more of it, and the commands that fill the gaps."""
    section = Section("leaderboard", "Leaderboard", "Leaderboard", notes=_leaderboard_notes(board, protocol, loaded))
    section.blocks.append(Block("table", table=tables.leaderboard(board, protocol)))
    caption = (
        f"Points: geometric-mean ATE ratio; bars: 95 % interval over sequences, from {FEWEST} sequences on. Open "
        "points are not ranked."
    )
    section.blocks += figure_blocks("ratio", figures.ratio_figure(board), caption)
    commands = missing_commands(board)
    if commands:
        section.blocks.append(Block(kind="code", title="The commands that fill the gaps", text="\n".join(commands)))
    return section


def categories_section(board: Board, protocol: Protocol) -> Section:
    """The ratios by category, the leaderboard of every category, and all pairs of trackers."""
    boards = category_boards(board)
    blocks = table_blocks(tables.category_table(boards))
    for category, part in boards.items():
        if category != OVERALL:
            table = tables.leaderboard(part, protocol)
            name = f"leaderboard_{category.replace(' ', '_')}"
            blocks += table_blocks(replace(table, id=name, title=headline(part)), folded=True)
    blocks += table_blocks(tables.pair_table(board), folded=True)
    return Section("categories", "By category, and all pairs", "Categories", blocks=blocks)


def _leaderboard_notes(board: Board, protocol: Protocol, loaded: Loaded) -> list[str]:
    conflicts = "; ".join(first_of(loaded.conflicts, _MOST_NOTES, "and {} more"))
    final_only = ", ".join(board.labels[key] for key in board.final_only)
    older = sorted({board.labels[row.variant_key] for row in board.rows if not row.is_current})
    left_out = {
        "older runs of the same tracker, settings, frames and repeat": loaded.superseded,
        "runs that were stopped on request": loaded.stopped,
        "folders without a valid record": len(loaded.unreadable),
    }
    counts = ", ".join(f"{count} {words}" for words, count in left_out.items() if count)
    notes = [
        headline(board),
        f"Runs with one id must be equal, but these have different results: {conflicts}." if conflicts else "",
        missing_note(board),
        explanation(board),
        mean_rank_note(board),
        f"Only in the table of final trajectories, as nothing else is known of them: {final_only}."
        if final_only
        else "",
        f"Without ground truth, and so in no table of errors: {', '.join(board.unscored)}." if board.unscored else "",
        f"Left out: {counts}." if counts else "",
        "Not ranked, as a newer program has made runs of the same tracker and settings, or as the runs' ids are "
        f"unverified: {', '.join(older)}."
        if older
        else "",
        f"Left out: {without_scale_words(loaded.without_scale, protocol)}." if loaded.without_scale else "",
        f"Left out: {trial_words(loaded.trials)}." if loaded.trials else "",
    ]
    return [note for note in notes if note]


def speed_section(board: Board) -> Section:
    """Accuracy against speed."""
    caption = (
        "Lower right is better. The dotted line joins ranked trackers that no other beats in both. Frame times "
        "include segmentation and exclude decoding; they hold for the machine named below."
    ) + f" {tables.CACHED_NOTE}" * any(row.cached for row in board.rows)
    blocks = figure_blocks("speed", figures.speed_figure(board), caption)
    return Section("speed", "Accuracy against speed", "Speed", blocks=blocks)


def errors_section(board: Board, protocol: Protocol) -> Section:
    """Errors by sequence, absolute and relative, with what they owe to lost frames and failures."""
    section = Section("errors", "Errors by sequence", "Errors")
    if not board.sequences:
        return section
    excerpts = {board.sequence(row) for row in board.rows if is_excerpt(row.sequence.id, row.sequence.duration_s)}
    shortened = {board.sequence(r) for r in board.rows if part_words(r) and not r.sequence.id.startswith("synthetic/")}
    parts = sorted(excerpts | shortened)
    if parts:
        section.notes.append("Parts of recordings, beside which no published number stands: " + ", ".join(parts) + ".")
    whole = [name for name in board.sequences if name not in parts]
    lines = published_for(whole, protocol)
    published = reported_for(whole, protocol) + records_for(whole, protocol)
    beside = {cell.sequence for cell in published}
    unsure = sorted(
        {r.sequence.id for r in board.rows if board.sequence(r) in beside and not least_length_s(r.sequence.id)}
    )
    if unsure:
        section.notes.append(
            f"Published numbers stand beside {', '.join(unsure)}, whose full length is not known here: that the runs "
            "are of the whole recordings is not checked."
        )
    section.blocks.append(Block("table", "Absolute trajectory error", tables.per_sequence(board, protocol, published)))
    lost = any(row.coverage < 1 and not row.failed for row in board.rows)
    section.blocks += table_blocks(
        tables.final_errors(board, protocol) if protocol.trajectory == "online" else None,
        tables.tracked_errors(board, protocol) if lost else None,
        tables.failure_rule_table(board),
        *tables.relative_errors(board, protocol),
        tables.rotation_errors(board, protocol),
        published_table(lines),
        span_table(spans(lines)),
        folded=True,
    )
    return section


def trajectories_section(board: Board, protocol: Protocol) -> Section:
    """Paths and errors over time of one run a tracker, by sequence; drawn of the runs' side files when it opens."""
    caption = (
        f"The run with the median error of each tracker, aligned ({protocol.alignment}). Lines are broken where a "
        "gap exceeds twice the median interval. Click a name to show or hide it."
    )
    palette = colours(board)
    shown = {*(board.ranked or board.trackers)[:6], board.reference}
    blocks: list[Block] = []
    for sequence in board.sequences:
        tracks = [
            {"run": row.run_id, "name": safe(board.labels[key]), "colour": palette[key], "shown": key in shown}
            for key, row in board.typical_runs(sequence).items()
        ]
        if tracks:
            words = ", ".join(filter(None, (board.groups[sequence], f"{len(tracks)} tracker{'s' * (len(tracks) > 1)}")))
            blocks.append(Block("tracks", sequence, caption=words, tracks=tracks, folded=bool(blocks)))
    return Section(
        "trajectories", "Trajectories and error over time", "Trajectories",
        blocks=[Block("caption", text=caption), *blocks] if blocks else [],
    )  # fmt: skip


def masks_section(board: Board) -> Section:
    """Quality of the masks, and the pose error against it."""
    caption = "One point a run."
    if any(len(board.runs(key)) > figures.MOST_POINTS for key in board.trackers):
        caption += (
            f" Of trackers with more than {figures.MOST_POINTS} runs fewer are drawn, from the best to the worst."
        )
    blocks = figure_blocks("masks", figures.mask_figure(board), caption) + table_blocks(tables.mask_quality(board))
    return Section("masks", "Mask quality and pose error", "Masks", blocks=blocks)


def provenance_section(board: Board, loaded: Loaded, again: str) -> Section:
    """Machines, versions, the commands that reproduce it, and the diagnostics of the runs."""
    section = Section("provenance", "Machines, versions, commands", "Reproduce")
    section.blocks.append(Block("table", table=tables.machines(board)))
    commands = list(dict.fromkeys(command_line(row.command) for row in board.rows if row.command))
    commands = first_of(commands, _MOST_COMMANDS, "# ... and {} more, which report.json names")
    section.blocks.append(
        Block(kind="code", title="The commands that reproduce it", text="\n".join([*commands, again]))
    )
    notes = [
        f"{board.labels[r.variant_key]} on {board.sequence(r)}, {r.repeat}: {n}" for r in board.rows for n in r.notes
    ]
    for title, entries, others in (
        ("Left out: no valid record", loaded.unreadable, "... and {} more, which `runs list` names"),
        ("Diagnostics", notes, "... and {} more on the pages of the runs"),
    ):
        if entries:
            section.blocks.append(Block("list", title, entries=first_of(entries, _MOST_NOTES, others), folded=True))
    return section


def first_of(entries: list[str], most: int, others: str) -> list[str]:
    """The first entries; how many others there are stands behind them."""
    return entries if len(entries) <= most else [*entries[:most], others.format(len(entries) - most)]


def paper_section(board: Board, protocol: Protocol) -> Section:
    """Tables 1 to 3 and Figures 9 to 12, as the paper lays them out."""
    section = Section("paper", "As in the paper: four statistics of the errors, and time", "As in the paper")
    section.blocks += table_blocks(
        tables.absolute_table(board, protocol),
        tables.relative_table(board, protocol),
        tables.time_table(board),
        folded=True,
    )
    for statistic, number in figures.FIGURES.items():
        figure = figures.bar_figure(board, statistic)
        lost = figure is not None and any(tables.LOST_MARK in trace["text"] for trace in figure["data"])
        caption = (
            f"As the paper's Figure {number}: {tables.STATISTICS[statistic]} of the absolute pose error, median over "
            "the runs that succeeded; pale bars are not ranked." + f" {tables.LOST_NOTE}" * lost
        )
        section.blocks += figure_blocks(f"paper-{statistic}", figure, caption)
    return section


# -- the site that is published

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
    write_atomic(
        output / "index.html", template.render(title=title, pages=pages, note=note, version=dynslam_bench.__version__)
    )
    write_atomic(output / ".nojekyll", "")
    sizes = [path.stat().st_size for path in output.rglob("*") if path.is_file()]
    return Site(output / "index.html", len(sizes), sum(sizes) / 1e6)
