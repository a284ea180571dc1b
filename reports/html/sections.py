"""The sections of a report, one function each: what they show, in which order, below which words."""

from __future__ import annotations

from concurrent.futures import Executor

from dynslam_bench.evaluation.protocol import Protocol
from dynslam_bench.reports import figures
from dynslam_bench.reports.figures import colours, safe
from dynslam_bench.reports.html.page import Block, Section, figure_blocks, folded
from dynslam_bench.reports.model.board import Board, common_errors
from dynslam_bench.reports.model.load import Loaded, trial_words, without_scale_words
from dynslam_bench.reports.model.missing import missing_commands, missing_note
from dynslam_bench.reports.model.published import is_excerpt, least_length_s, records_for, reported_for
from dynslam_bench.reports.model.row import command_line
from dynslam_bench.reports.model.statistics import FEWEST, power_note
from dynslam_bench.reports.tables import errors as error_tables
from dynslam_bench.reports.tables import leaderboard as tables
from dynslam_bench.reports.tables.errors import (
    LOST_MARK,
    LOST_NOTE,
    STATISTICS,
    absolute_table,
    relative_table,
    time_table,
)
from dynslam_bench.reports.tables.table import significant_text
from dynslam_bench.runs.run_index import part_words

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


def _leaderboard_notes(board: Board, protocol: Protocol, loaded: Loaded) -> list[str]:
    cells = [cell for key in board.ranked for name, cell in board.cells[key].items() if name in board.common]
    fewest_repeats = min((len(cell.scores) for cell in cells if cell.scores), default=0)
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
        f"Runs with one id must be equal, but these have different results: {conflicts}." if conflicts else "",
        missing_note(board),
        power_note(board.standings, len(board.common), fewest_repeats),
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
    )
    if any(row.cached for row in board.rows):
        caption += f" {tables.CACHED_NOTE}"
    blocks = figure_blocks("speed", figures.speed_figure(board), caption)
    return Section("speed", "Accuracy against speed", "Speed", blocks=blocks)


def errors_section(board: Board, protocol: Protocol, pool: Executor | None) -> Section:
    """Errors by sequence, absolute and relative, with what they owe to lost frames and failures."""
    section = Section("errors", "Errors by sequence", "Errors")
    if not board.sequences:
        return section
    excerpts = {board.sequence(row) for row in board.rows if is_excerpt(row.sequence.id, row.sequence.duration_s)}
    recorded = [row for row in board.rows if not row.sequence.id.startswith("synthetic/")]
    parts = sorted(excerpts | {board.sequence(row) for row in recorded if part_words(row)})
    if parts:
        section.notes.append("Parts of recordings, beside which no published number stands: " + ", ".join(parts) + ".")
    whole = [name for name in board.sequences if name not in parts]
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
    table_of_errors = error_tables.per_sequence(board, protocol, published)
    section.blocks.append(Block("table", "Absolute trajectory error", table_of_errors))
    common, frames = common_errors(board, protocol, pool)
    section.blocks += folded(error_tables.common_frames_table(board, common, frames))
    if protocol.trajectory == "online":
        section.blocks += folded(error_tables.final_errors(board, protocol))
    if any(row.coverage < 1 and not row.failed for row in board.rows):
        section.blocks += folded(error_tables.tracked_errors(board, protocol))
    section.blocks += folded(tables.failure_rule_table(board))
    for table in error_tables.relative_errors(board, protocol):
        section.blocks += folded(table)
    section.blocks += folded(error_tables.rotation_errors(board, protocol))
    return section


def trajectories_section(board: Board, protocol: Protocol) -> Section:
    """Paths and errors over time of one run a tracker, by sequence; drawn of the runs' side files when it opens."""
    section = Section("trajectories", "Trajectories and error over time", "Trajectories")
    palette = colours(board)
    shown = (board.ranked or board.trackers)[:6] + ([board.reference] if board.reference else [])
    for sequence in board.sequences:
        chosen = board.typical_runs(sequence)
        tracks = [
            {"run": row.run_id, "name": safe(board.labels[key]), "colour": palette[key], "shown": key in shown}
            for key, row in chosen.items()
        ]
        if tracks:
            small = ", ".join(filter(None, (board.groups[sequence], f"{len(tracks)} tracker{'s' * (len(tracks) > 1)}")))
            section.blocks.append(
                Block("tracks", summary=sequence, small=small, tracks=tracks, open=not section.blocks)
            )
    if section.blocks:
        caption = (
            f"The run with the median error of each tracker, aligned ({protocol.alignment}). Lines are broken where a "
            "gap exceeds twice the median interval. Click a name to show or hide it."
        )
        section.blocks.insert(0, Block("caption", text=caption))
    return section


def repeatability_section(board: Board) -> Section:
    """How far the runs of a cell lie apart."""
    section = Section("repeatability", "Repeatability", "Repeatability")
    table = tables.repeatability(board)
    if table is not None:
        caption = "One point a run that succeeded: its error over the median of the same tracker on the same sequence."
        section.blocks += figure_blocks("repeat", figures.repeat_figure(board), caption + thinned_note(board))
        section.blocks.append(Block("table", table=table))
    return section


def thinned_note(board: Board) -> str:
    """What a figure with a point for every run says where there are too many."""
    most = figures.MOST_POINTS
    if all(len(board.runs(key)) <= most for key in board.trackers):
        return ""
    return f" Of trackers with more than {most} runs as many are drawn, from the best to the worst."


def masks_section(board: Board) -> Section:
    """Quality of the masks, and the pose error against it."""
    section = Section("masks", "Mask quality and pose error", "Masks")
    section.blocks += figure_blocks("masks", figures.mask_figure(board), "One point a run." + thinned_note(board))
    table = error_tables.metric_table(
        board,
        lambda row: row.mask_iou,
        "mask_iou",
        "Mask quality",
        "Mean overlap (IoU) of the tracker's dynamic mask with the exact masks of people, median over runs.",
        unit="IoU",
        text=significant_text,
        larger_is_better=True,
    )
    if table is not None:
        section.blocks.append(Block("table", table=table))
    return section


def failures_section(board: Board) -> Section:
    """Every run that failed, or that none did."""
    table = tables.failures(board)
    block = Block("table", table=table)
    if table is None:
        block = Block("list", entries=[f"None of {len(board.rows)} runs failed."])
    return Section("failures", "Failures", "Failures", blocks=[block])


def provenance_section(board: Board, loaded: Loaded, again: str) -> Section:
    """Machines, versions, the commands that reproduce it, and the diagnostics of the runs."""
    section = Section("provenance", "Machines, versions, commands", "Reproduce")
    section.blocks.append(Block("table", table=tables.machines(board)))
    commands = list(dict.fromkeys(command_line(row.command) for row in board.rows if row.command))
    commands = first_of(commands, _MOST_COMMANDS, "# ... and {} more, which report.json names")
    section.blocks.append(
        Block(kind="code", title="The commands that reproduce it", text="\n".join([*commands, again]))
    )
    if loaded.unreadable:
        entries = first_of(loaded.unreadable, _MOST_NOTES, "... and {} more, which `runs list` names")
        section.blocks.append(Block(kind="list", title="Left out: no valid record", entries=entries, folded=True))
    notes = [
        f"{board.labels[r.variant_key]} on {board.sequence(r)}, {r.repeat}: {n}" for r in board.rows for n in r.notes
    ]
    if notes:
        entries = first_of(notes, _MOST_NOTES, "... and {} more on the pages of the runs")
        section.blocks.append(Block(kind="list", title="Diagnostics", entries=entries, folded=True))
    return section


def first_of(entries: list[str], most: int, others: str) -> list[str]:
    """The first entries; how many others there are stands behind them."""
    return entries if len(entries) <= most else [*entries[:most], others.format(len(entries) - most)]


def paper_section(board: Board, protocol: Protocol) -> Section:
    """Tables 1 to 3 and Figures 9 to 12, as the paper lays them out."""
    section = Section("paper", "As in the paper: four statistics of the errors, and time", "As in the paper")
    for table in (absolute_table(board, protocol), relative_table(board, protocol), time_table(board)):
        section.blocks += folded(table)
    for statistic, number in figures.FIGURES.items():
        figure = figures.bar_figure(board, statistic)
        lost = figure is not None and any(LOST_MARK in trace["text"] for trace in figure["data"])
        caption = (
            f"As the paper's Figure {number}: {STATISTICS[statistic]} of the absolute pose error, median over the "
            "runs that succeeded; pale bars are not ranked." + f" {LOST_NOTE}" * lost
        )
        section.blocks += figure_blocks(f"paper-{statistic}", figure, caption)
    return section
