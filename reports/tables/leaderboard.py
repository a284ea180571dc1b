"""The tables of a board: the leaderboard, errors by sequence, tables of the runs, and the paper's Tables 1 to 3."""

import math
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import zip_longest
from statistics import median

import numpy as np

from dynslam_bench.core import label_text
from dynslam_bench.core.number_text import mm, significant_text
from dynslam_bench.evaluation import Protocol, RPESpec
from dynslam_bench.evaluation.alignment import RELIABLE_DEG
from dynslam_bench.evaluation.verdicts import FEWEST_FAMILIES, FEWEST_FREE, FLOOR_M
from dynslam_bench.reports.model.answers import error_columns, typical_error
from dynslam_bench.reports.model.board import (
    OVERALL,
    STATIC_CAMERA,
    Board,
    TrackerOnSequence,
    TrackerPair,
    compare_pairs,
    mean_coverage,
    mean_of,
    rank,
    timed,
    timed_on_one,
)
from dynslam_bench.reports.model.published import ReportedCell
from dynslam_bench.reports.model.row import HINTED, SEEN, RunRow, grouped
from dynslam_bench.reports.model.statistics import FEWEST, Interval, Standing
from dynslam_bench.reports.tables.table import (
    Column,
    Emphasis,
    Table,
    TableCell,
    emphasise,
    number,
    numbers,
    percent,
    texts,
)
from dynslam_bench.runs.record import coverage_text

# -- the leaderboard, and cells that several tables share

_PROVENANCE = {
    "own": "put together in this project: no one paper or program describes the whole",
    "faithful-code": "follows the published code",
    "faithful-paper": "follows the paper",
    "inspired": "follows an abstract or a survey; constants are ours",
    "assumed": "identity or rule unknown, assumed",
    "external": "not part of this project",
    "control": "a control, not a system",
}
"""Meaning of each provenance of a tracker: the tip of its cell."""
_PROVENANCE_NAMES = {"own": "our composition"}
"""Provenances that tables call by another name than the tracker's spec does."""
CACHED_MARK = "†"
"""Behind times of which some come from the stage cache."""
COMPUTER_MARK = "‖"
"""Behind times of trackers with runs on other computers than most."""
CACHED_NOTE = (
    f"{CACHED_MARK} Times of features and masks come from the stage cache, not from the run itself."
)
"""Meaning of `CACHED_MARK`, for captions."""
SEEN_NOTE = (
    f"{SEEN} The masks come from a network that was trained on this very scene (the embedded one, on rendered "
    "scenes 0-99): its best case, no judgement."
)
"""Meaning of the mark `SEEN`, for captions and tips."""


def leaderboard(board: Board, protocol: Protocol) -> Table:
    """Ranking with what the data leave open, success, coverage, speed and provenance."""
    # only epipolar systems have an entry in the column "F skipped"
    has_epipolar = any(row.epipolar_skipped is not None for row in board.rows)
    columns = []
    for column in COLUMNS:
        if column.name == "F skipped" and not has_epipolar:
            continue
        meaning = column.meaning.replace("{reference}", board.reference_name)
        columns.append(replace(column, meaning=meaning))

    # errors in millimetres stand behind the name
    errors = error_columns(board)
    error_headings = [
        Column(f"{meaning}, mm", meaning=f"median over {len(names)} sequences of the median ATE")
        for meaning, names in errors.items()
    ]
    behind = 1 + [column.name for column in columns].index("tracker")
    keys = [*board.trackers, *board.final_only]
    rows = []
    for key in keys:
        cells = leaderboard_cells(board, key)
        row = [cells[column.name] for column in columns]
        row[behind:behind] = [error_cell(board, key, names) for names in errors.values()]
        rows.append(row)
    columns[behind:behind] = error_headings

    brief = f"Geometric mean of the ATE over that of {board.reference_name}"
    if any(math.isfinite(standing.ratio.low) for standing in board.standings):
        brief += ", with 95 % intervals"
    return Table(
        "leaderboard",
        "Leaderboard",
        _leaderboard_caption(board, protocol, has_epipolar=has_epipolar),
        columns,
        rows,
        board.unranked_rows(keys),
        board.separators(),
        brief,
    )


COLUMNS = (
    Column(
        "#", meaning="ranks that the data leave open; several: these trackers cannot be told apart"
    ),
    Column("success", meaning="runs that ended and could be evaluated, of all"),
    Column("tracker", numeric=False),
    Column(
        "ATE ratio",
        meaning="geometric mean over families of sequences of the median ATE over that of {reference}",
    ),
    Column(
        "better?",
        meaning="better than {reference}, worse, or cannot tell: t tests of the log errors where both succeed, "
        "Holm-corrected over the ranked trackers; behind it whether that holds on these families of sequences or "
        "beyond them, the corrected p, and how many sequences were lost",
    ),
    Column("wins", meaning="sequences with a smaller median ATE than {reference}"),
    Column("mean rank", meaning="mean over sequences of the rank there", latex=False),
    Column("coverage", meaning="tracked frames over associated input frames"),
    Column(
        "× real time",
        meaning="frame interval over mean frame time, above 1 it keeps up; behind it the median frame time, "
        "segmentation included, decoding excluded",
    ),
    Column("MB", meaning="peak resident memory", latex=False),
    Column(
        "F skipped",
        meaning="share of the tracked frames on which the epipolar test had no say, since F was not used",
        latex=False,
    ),
    Column("rows", numeric=False, latex=False),
    Column("provenance", numeric=False, latex=False),
)
"""The leaderboard's columns; `leaderboard_cells` fills them."""


def _leaderboard_caption(board: Board, protocol: Protocol, *, has_epipolar: bool) -> str:
    """Sentences on reading the leaderboard: what always holds, then remarks on what this board shows."""
    n_failed = sum(row.failed for row in board.rows)
    sentences = [
        f"{protocol.describe()}; for the ranking a lost frame counts as not having moved since the last tracked one.",
        _ratio_rule(board),
        f"A run that failed or was lost counts as a static camera, or worse ({n_failed} of "
        f"{_count(len(board.rows), 'run')}); trackers without any success stand below the last line.",
        "Grey rows are shown but not ranked: controls, inspired or assumed re-implementations, runs that begin "
        "in the map of an earlier one or by another program, real-time runs and exact masks beside others, "
        "trackers that lack sequences, never succeeded, or are no better than a static camera.",
        *_leaderboard_remarks(board, has_epipolar=has_epipolar),
    ]
    return " ".join(sentences)


def _ratio_rule(board: Board) -> str:
    """Sentences on what the ATE ratio is a mean over, and whether it has intervals."""
    groups = dict.fromkeys(board.groups[name] for name in board.common)
    over_categories = ""
    if board.category == OVERALL and len(groups) > 1:
        names = ", ".join(groups)
        over_categories = (
            f"It is a mean over {len(groups)} categories ({names}), which all weigh the same. "
        )
    if len(board.common) < FEWEST:
        intervals = f"No intervals: they would need {FEWEST} sequences."
    elif board.ranked_sequences.can_go_beyond:
        intervals = "Brackets: Student's 95 % intervals over families of sequences."
    elif board.ranked_sequences.can_stay:
        intervals = "Brackets: Student's 95 % intervals over sequences of these families."
    else:
        free = f"{FEWEST_FREE} more sequences than families"
        intervals = f"No intervals: they would need {FEWEST_FAMILIES} families, or {free}."
    n_families = len(set(board.ranked_sequences.families))
    of_families = f" of {n_families} families" if n_families < len(board.common) else ""
    return (
        f"ATE ratio: geometric mean over {_count(len(board.common), 'sequence')}{of_families} of the median ATE over "
        f"that of {board.reference_name}; below 1 is better. {over_categories}{intervals}"
    )


def _leaderboard_remarks(board: Board, *, has_epipolar: bool) -> list[str]:
    """Sentences of the caption that hold for some boards only."""
    remarks = []
    if static_like := _no_better_than_static_words(board):
        remarks.append(f"No better than a static camera, although their runs ended: {static_like}.")
    if board.asked_reference and board.reference is None:
        remarks.append(
            f"{board.asked_reference} was asked for as the reference, but has not every ranked sequence: a static "
            "camera takes its place."
        )
    if has_epipolar:
        remarks.append(
            "F skipped: frames on which an epipolar system did not use its fundamental matrix."
        )
    if any(row.cached for row in board.rows):
        remarks.append(CACHED_NOTE)
    if times_of_others := computer_note(board):
        remarks.append(times_of_others)
    if any(row.seen_in_training for row in board.rows):
        rule = "Such runs do not rank."
        if board.rank_seen:
            rule = "Such runs rank, since that was asked for."
        remarks.append(f"{SEEN_NOTE} {rule} Instances 100-199 are held out.")
    if hinted := _hint_counts(board.rows):
        n_hinted = sum(bool(row.hints) for row in board.rows)
        remarks.append(
            f"{HINTED} The trajectories of {_count(n_hinted, 'run')} are probably faulty "
            f"({hinted}), as the diagnostics say; no number is changed for that."
        )
    return remarks


def _no_better_than_static_words(board: Board) -> str:
    """Trackers that a static camera beats on some sequences, with the number of these; empty for none."""
    parts = []
    for key in board.trackers:
        count = sum(board.no_better_than_static(key, name) for name in board.sequences)
        if count:
            parts.append(
                f"{board.labels[key]} on {count} of {_count(len(board.cells[key]), 'sequence')}"
            )
    return "; ".join(parts)


def _hint_counts(rows: Iterable[RunRow]) -> str:
    """Probable faults of trajectories, each with its number of runs; empty if there are none."""
    # a hint is a line "<id>: <text>"
    counts = Counter(line.partition(":")[0] for row in rows for line in row.hints)
    return ", ".join(f"{hint} {count}" for hint, count in counts.most_common())


def leaderboard_cells(board: Board, key: str) -> dict[str, TableCell]:
    """The cells of a tracker by the names of their columns; what is not known is empty."""
    cells = {column.name: TableCell() for column in COLUMNS}
    cells |= _run_cells(board, key)
    standing = board.standing_by_key.get(key)
    if key in board.never_succeeded:
        cells["ATE ratio"] = TableCell("nothing succeeded", emphasis="failed")
    elif standing is not None:
        cells |= _standing_cells(board, standing)
    return cells


def error_cell(board: Board, key: str, names: Sequence[str]) -> TableCell:
    """The typical error in millimetres over some sequences; behind it how many are lost or missing."""
    present = [name for name in names if name in board.cells[key]]
    error = typical_error(board, key, names)
    if error.median_m is None:
        return TableCell("–", "" if present else "not run")
    remarks = []
    if error.lost:
        remarks.append(f"lost {error.lost}")
    if error.sequences < error.asked:
        remarks.append(f"{error.sequences} of {error.asked}")
    return TableCell(
        mm(error.median_m),
        ", ".join(remarks),
        error.median_m,
        emphasis="failed" if error.lost else "",
        tip=f"median over {error.sequences} sequences",
    )


def _run_cells(board: Board, key: str) -> dict[str, TableCell]:
    """Cells that follow from a tracker's runs alone, ranked or not."""
    runs = board.runs(key)
    ended = [row for row in runs if not row.failed]
    tracker = runs[0].tracker
    coverage, truth_share = mean_coverage(runs)

    # the name, marked where a trajectory is probably faulty
    hinted = _hint_counts(runs)
    label = f"{board.labels[key]} {HINTED}" if hinted else board.labels[key]

    # share of the tracked frames without a fundamental matrix, of epipolar systems
    skipped = mean_of(row.epipolar_skipped for row in runs)
    skipped_cell = TableCell() if skipped is None else TableCell(percent(skipped), value=skipped)

    # how many runs come from where
    origins = Counter(row.origin for row in runs)
    origin_words = " + ".join(f"{count} {origin}" for origin, count in origins.items())
    return {
        "#": TableCell("–"),
        "success": TableCell(f"{len(ended)}/{len(runs)}", value=len(ended) / len(runs)),
        "tracker": TableCell(label, hinted, tip=tracker.id),
        "coverage": TableCell(coverage_text(coverage, truth_share), value=coverage),
        "× real time": speed_cell(board, ended),
        "MB": number(median_of(row.peak_memory_mb for row in ended), ".0f"),
        "rows": TableCell(small=runs[0].program_remark, tag=origin_words),
        "F skipped": skipped_cell,
        "provenance": _provenance_cell(runs),
    }


def _provenance_cell(runs: Sequence[RunRow]) -> TableCell:
    """Cell that says how closely a tracker follows its source, and whose masks it used."""
    provenance = runs[0].tracker.provenance
    networks = {row.segmentation for row in runs} - {"", "none"}
    masks = " + ".join(sorted({label_text(network) for network in networks}))
    return TableCell(
        _PROVENANCE_NAMES.get(provenance, provenance),
        f"{masks} masks" if masks else "",
        tip=_PROVENANCE.get(provenance, ""),
    )


def _standing_cells(board: Board, standing: Standing) -> dict[str, TableCell]:
    """Cells that need scores on the common sequences: rank, ratio, verdict, wins and mean rank."""
    # rank, or why there is none
    why_unranked = board.unranked_why(standing.key)
    rank_or_reason = TableCell("–", why_unranked) if why_unranked else rank_cell(standing)

    # ratio, with the number of sequences where some are missing
    ratio = ratio_cell(board, standing)
    if standing.sequences < len(board.common):
        small = f"{ratio.small} on {standing.sequences} of {len(board.common)}".strip()
        ratio = TableCell(ratio.text, small, ratio.value)

    # the reference wins nothing against itself
    wins = TableCell()
    if standing.key != board.reference:
        wins = TableCell(f"{standing.wins} of {standing.sequences}", value=standing.wins)
    return {
        "#": rank_or_reason,
        "ATE ratio": ratio,
        "better?": verdict_cell(board, standing),
        "wins": wins,
        "mean rank": number(standing.mean_rank, ".2f"),
    }


def verdict_cell(board: Board, standing: Standing) -> TableCell:
    """Better than the reference, worse, or cannot tell, with how far that goes; coloured where it is shown.

    Behind it stand the scope, the corrected p value, and the sequences that one of the two alone lost.
    """
    verdict = standing.verdict
    if not verdict:
        return TableCell()
    if len(board.common) < FEWEST and verdict != "reference":
        return TableCell()

    small: list[str] = [standing.scope]
    if standing.p_value is not None:
        small.append("p < 0.001" if standing.p_value < 0.001 else f"p {standing.p_value:.3f}")
    small.append(lost_words(standing))
    return TableCell(verdict, ", ".join(filter(None, small)), shade=_VERDICT_SHADES.get(verdict))


def lost_words(standing: Standing) -> str:
    """Words on how many sequences a tracker alone lost, and the reference alone; empty where there are none."""
    if not any(standing.lost):
        return ""
    by_tracker, by_reference = standing.lost
    return f"lost {by_tracker} of {standing.sequences}, reference {by_reference}"


def category_table(boards: Mapping[str, Board]) -> Table | None:
    """The ratios of all trackers by category; None where there is one category only.

    Args:
        boards: Category to its board, see `category_boards`.
    """
    if len(boards) < 2:
        return None
    overall = boards[OVERALL]
    columns = texts("tracker")
    for name, board in boards.items():
        meaning = f"{_count(len(board.common), 'sequence')}, against {board.reference_name}"
        columns.append(Column(name, meaning=meaning))

    rows = []
    for key in overall.trackers:
        cells = [TableCell(overall.labels[key])]
        for board in boards.values():
            standing = board.standing_by_key.get(key)
            cells.append(TableCell() if standing is None else _category_cell(board, standing))
        rows.append(cells)
    caption = (
        "Geometric mean of the median ATE over that of the reference, by category; brackets are 95 % intervals from "
        f"{FEWEST} sequences on. Blue: better than the reference; orange: worse; no colour: cannot tell or not ranked. "
        "A sequence may be in several categories: what moves there, how the camera moves, recorded or rendered."
    )
    return Table(
        "categories",
        "By category",
        caption,
        columns,
        rows,
        overall.unranked_rows(overall.trackers),
        overall.separators(),
    )


def _category_cell(board: Board, standing: Standing) -> TableCell:
    """The ratio of a tracker in one category, coloured by its verdict there."""
    colour = verdict_cell(board, standing).shade
    return replace(ratio_cell(board, standing), shade=colour, tip=standing.verdict)


def pair_table(board: Board) -> Table | None:
    """Every ranked tracker against every other; None below `FEWEST` sequences or for fewer than three trackers."""
    if len(board.common) < FEWEST or len(board.ranked) < 3:
        return None
    pairs = {frozenset((pair.one, pair.other)): pair for pair in compare_pairs(board, board.ranked)}

    goes_beyond = board.ranked_sequences.can_go_beyond
    scope = (
        "beyond these families of sequences" if goes_beyond else "on these families of sequences"
    )
    rows = []
    for key in board.ranked:
        cells = [TableCell(board.labels[key])]
        for other in board.ranked:
            if other == key:
                cells.append(TableCell("–", emphasis="muted"))
            else:
                cells.append(_pair_cell(pairs[frozenset((key, other))], key))
        rows.append(cells)
    caption = (
        "Geometric mean of the errors of the row over those of the column where both succeed; behind it the sequences "
        f"that one of them alone lost. Coloured: the two can be told apart {scope} (t tests of the log errors, "
        "Holm-corrected over all pairs), or by what they lost (McNemar's exact test); '?': they cannot."
    )
    columns = [*texts("tracker"), *numbers(*(board.labels[key] for key in board.ranked))]
    return Table("pairs", "All pairs", caption, columns, rows)


def _pair_cell(pair: TrackerPair, key: str) -> TableCell:
    """The ratio of one tracker of a pair to the other; coloured where the two can be told apart."""
    is_first = pair.one == key
    ratio = pair.ratio.value if is_first else 1.0 / pair.ratio.value
    lost, lost_by_other = pair.lost if is_first else pair.lost[::-1]
    losses = f"lost {lost} : {lost_by_other}" if lost + lost_by_other else ""
    tip = f"p {pair.p_value:.3f}"
    if pair.verdict == "cannot tell":
        return TableCell(f"{ratio:.2f}", f"? {losses}".strip(), ratio, tip=tip)
    is_better = (pair.verdict == "better") == is_first
    colour = _VERDICT_SHADES["better" if is_better else "worse"]
    return TableCell(f"{ratio:.2f}", losses, ratio, shade=colour, tip=tip)


def speed_cell(board: Board, ended: Sequence[RunRow]) -> TableCell:
    """Real-time factor and frame time on one computer, with their marks (`time_marks`)."""
    rows = timed_on_one(ended, board.timing_computer)
    factor = median_of(row.real_time_factor for row in rows)
    frame_ms = median_of(row.frame_ms for row in rows)
    if factor is None:
        return TableCell()
    mark, tip = time_marks(board, ended)
    factor_text = f"{factor:.2f}" if factor < 100 else f"{factor:.0f}"
    small = "" if frame_ms is None else f"{frame_ms:.1f} ms{mark}"
    return TableCell(factor_text + mark, small, factor, tip=tip)


def frame_time_cell(board: Board, ended: Sequence[RunRow]) -> TableCell:
    """Median frame time in milliseconds on one computer, with its marks (`time_marks`)."""
    frame_ms = median_of(row.frame_ms for row in timed_on_one(ended, board.timing_computer))
    if frame_ms is None:
        return TableCell()
    mark, tip = time_marks(board, ended)
    return TableCell(f"{frame_ms:.1f}{mark}", value=frame_ms, tip=tip)


def time_marks(board: Board, ended: Sequence[RunRow]) -> tuple[str, str]:
    """Marks behind the times of some runs, and why: the stage cache, and other computers than most runs had."""
    marks = []
    tips = []
    if any(row.cached for row in timed_on_one(ended, board.timing_computer)):
        marks.append(CACHED_MARK)
        tips.append(CACHED_NOTE)

    by_computer = grouped(timed(ended), lambda row: row.computer)
    if by_computer and by_computer.keys() != {board.timing_computer}:
        marks.append(COMPUTER_MARK)
        # the computer with most runs first
        most_runs_first = sorted(by_computer.items(), key=lambda entry: (-len(entry[1]), entry[0]))
        for computer, rows in most_runs_first:
            frame_ms = median_of(row.frame_ms for row in rows) or 0.0
            tips.append(
                f"{frame_ms:.1f} ms on {computer_words(computer)} ({_count(len(rows), 'run')})"
            )
    return "".join(marks), "; ".join(tips)


def computer_words(computer: str) -> str:
    """A computer (`RunRow.computer`), in words where it is not recorded."""
    return computer or "a computer that is not recorded"


def computer_note(board: Board) -> str:
    """A note on the computer on which times were taken, and that some are of others; empty where all are of one."""
    ended = [row for row in board.rows if not row.failed]
    others = {row.computer for row in timed(ended)} - {board.timing_computer}
    if not others:
        return ""
    return (
        f"Times are those of {computer_words(board.timing_computer)}; {COMPUTER_MARK} of rows with runs on other "
        "computers, whose times are never averaged with these: the cell's tip has the time on each."
    )


def rank_cell(standing: Standing) -> TableCell:
    """The ranks that the data leave open, e.g. ``1–3``; a dash for an unranked tracker."""
    if standing.group is None:
        return TableCell("–")
    # first and last rank, once where they are equal
    ranks = dict.fromkeys(standing.group)
    return TableCell("–".join(map(str, ranks)))


def ratio_cell(board: Board, standing: Standing) -> TableCell:
    """The ratio to the reference with its interval, bold for those that may be the best."""
    return interval_cell(standing.ratio, ".2f", "best" if standing.key in board.emphasised else "")


def interval_cell(interval: Interval, digits: str, emphasis: Emphasis = "") -> TableCell:
    """A value with its interval, if it has one."""
    small = ""
    if math.isfinite(interval.low):
        small = f"[{interval.low:{digits}}, {interval.high:{digits}}]"
    return TableCell(f"{interval.value:{digits}}", small, interval.value, emphasis)


def median_of(values: Iterable[float | None]) -> float | None:
    """Median of what is present; None if nothing is."""
    present = [value for value in values if value is not None]
    return median(present) if present else None


def _count(count: int, noun: str) -> str:
    """A number with its noun, in the plural where it is not one."""
    return f"{count} {noun}{'s' if count != 1 else ''}"


# -- numbers by tracker and sequence

Value = Callable[[RunRow], float | None]
"""A number of a run; None where it has none."""
DOUBT = "‡"
"""Behind a number that says nothing of its tracker."""
FINAL_SHARE = 0.9
"""With poses of a smaller share of the tracked frames, a final trajectory's error is in doubt: keyframes err less."""


def metric_table(
    board: Board,
    value: Value,
    name: str,
    title: str,
    caption: str,
    *,
    unit: str = "RMSE, mm",
    text: Callable[[float], str] = mm,
    larger_is_better: bool = False,
    doubt: Callable[[TrackerOnSequence], str] = lambda cell: "",
) -> Table | None:
    """Median of any number of the runs that succeeded, by tracker and sequence; None if no run has it.

    Args:
        board: The board.
        value: The number of a run.
        name: Id of the table.
        title: Heading.
        caption: How to read it.
        unit: What the numbers are, in a word or two.
        text: How the number is written; metres become millimetres by default.
        larger_is_better: Which end is bold.
        doubt: Why the number of a cell says nothing, empty if it does; such a cell carries `DOUBT`
            and is never bold.
    """
    values = medians(board, value)
    if not values:
        return None

    # doubtful numbers are muted, and take no part in best and second best
    doubtful: dict[tuple[str, str], Emphasis] = {}
    compared: dict[tuple[str, str], float] = {}
    sign = -1.0 if larger_is_better else 1.0
    for (key, sequence), cell_median in values.items():
        if doubt(board.cells[key][sequence]):
            doubtful[key, sequence] = "muted"
        else:
            compared[key, sequence] = sign * cell_median
    marks = column_marks(board, compared) | doubtful

    def behind(cell: TrackerOnSequence) -> str:
        return DOUBT * bool(doubt(cell)) + SEEN * cell.in_training

    def tip(cell: TrackerOnSequence) -> str:
        return doubt(cell) or (SEEN_NOTE if cell.in_training else cell.ending)

    return _sequence_table(
        board,
        {"": values},
        name,
        title,
        caption,
        f"{title} ({unit})",
        text=text,
        behind=behind,
        tip=tip,
        marks={"": marks},
    )


Values = Mapping[tuple[str, str], float]
"""``(variant key, sequence)`` to a number."""


def _sequence_table(
    board: Board,
    measures: Mapping[str, Values],
    name: str,
    title: str,
    caption: str,
    brief: str,
    *,
    text: Callable[[float], str] = mm,
    behind: Callable[[TrackerOnSequence], str] = lambda cell: "",
    tip: Callable[[TrackerOnSequence], str] = lambda cell: "",
    marks: Mapping[str, Mapping[tuple[str, str], Emphasis]] | None = None,
) -> Table:
    """A table with a row a tracker that has any of the numbers, and a column a sequence and kind of number.

    Args:
        board: The board.
        measures: The numbers of each kind; ``""`` for the only one.
        name: Id of the table.
        title: Heading.
        caption: How to read it.
        brief: Caption where there is little room.
        text: How a number is written.
        behind: What stands behind the numbers of a cell.
        tip: The tip of a cell.
        marks: Emphasis of the numbers of each kind; None for the best and second best of every
            column.
    """
    if marks is None:
        marks = {kind: column_marks(board, values) for kind, values in measures.items()}
    measured = {key for values in measures.values() for key, _ in values}
    keys = [key for key in (*board.trackers, *board.final_only) if key in measured]

    rows = []
    for key in keys:
        cells = [TableCell(board.labels[key])]
        for sequence in board.sequences:
            cell = board.cells[key].get(sequence)
            for kind, values in measures.items():
                value = values.get((key, sequence))
                if cell is not None and not cell.success:
                    cells.append(TableCell(emphasis="failed", tip=cell.ending))
                elif cell is None or value is None:
                    cells.append(TableCell())
                else:
                    mark = marks.get(kind, {}).get((key, sequence), "")
                    words = text(value) + behind(cell)
                    cells.append(TableCell(words, value=value, emphasis=mark, tip=tip(cell)))
        rows.append(cells)

    # a line between the ranked trackers and the others
    muted = board.unranked_rows(keys)
    n_ranked = len(keys) - len(muted)
    separators = {n_ranked} if 0 < n_ranked < len(rows) else set()
    columns = [*texts("tracker"), *sequence_columns(board, list(measures))]
    return Table(name, title, caption, columns, rows, muted, separators, brief)


def medians(board: Board, value: Value) -> dict[tuple[str, str], float]:
    """Median of a number over the runs that count and succeeded, by tracker and sequence."""
    by_cell = {}
    for key, cells in board.cells.items():
        for sequence, cell in cells.items():
            if sequence not in board.sequences:
                continue
            cell_median = median_of(value(row) for row in cell.kept if not row.failed)
            if cell_median is not None:
                by_cell[key, sequence] = cell_median
    return by_cell


def column_marks(board: Board, values: Values) -> dict[tuple[str, str], Emphasis]:
    """Best and second best of every column among the ranked trackers whose runs there compete and all succeeded.

    A tracker that is no better there than a static camera takes no part.

    Args:
        board: The board.
        values: A number a cell, less is better; a cell that has none takes no part.
    """
    marks: dict[tuple[str, str], Emphasis] = {}
    for sequence in board.sequences:
        competing = [(key, sequence) for key in board.ranked if _may_be_best(board, key, sequence)]
        emphasis = emphasise([values.get(place) for place in competing])
        marks |= zip(competing, emphasis, strict=True)
    return marks


def _may_be_best(board: Board, key: str, sequence: str) -> bool:
    """Whether a tracker's number on a sequence may be bold: all its runs succeeded, compete, and beat not moving."""
    cell = board.cells[key].get(sequence)
    if cell is None or cell.failed:
        return False
    return board.competes(key, sequence) and not board.no_better_than_static(key, sequence)


def per_sequence(board: Board, protocol: Protocol, reported: Sequence[ReportedCell] = ()) -> Table:
    """Median ATE of every tracker on every sequence, with spread, number of runs and failures.

    Args:
        board: The board.
        protocol: How errors were computed.
        reported: Published numbers, which stand in rows of their own below the last line.
    """
    # the usual number of runs a cell: only other numbers are printed
    sizes = Counter(len(cell.rows) for key in board.trackers for cell in board.cells[key].values())
    usual_runs = sizes.most_common(1)[0][0] if sizes else 1

    rows = _ate_rows(board, usual_runs)
    rows.append(
        [TableCell(STATIC_CAMERA), *(_static_camera_cell(board, name) for name in board.sequences)]
    )
    separators = board.separators() | {len(board.trackers)}
    if reported:
        separators |= {len(rows)}
        rows += _reported_rows(board, reported)
    muted = board.unranked_rows(board.trackers) | set(range(len(board.trackers), len(rows)))

    caption = _per_sequence_caption(board, protocol, usual_runs)
    if reported:
        caption += f" {_REPORTED_NOTE}"
    columns = [*texts("tracker"), *sequence_columns(board)]
    if any(row.seen_in_training for row in board.rows):
        columns.append(Column(f"{SEEN} trained on", numeric=False, meaning=SEEN_NOTE))
        _append_trained_scenes(board, rows)
        caption += f" {SEEN_NOTE}"
    return Table(
        "per_sequence",
        "Absolute trajectory error by sequence (mm)",
        caption,
        columns,
        rows,
        muted,
        separators,
        "Absolute trajectory error (RMSE, mm), lost frames held",
    )


def _ate_rows(board: Board, usual_runs: int) -> list[list[TableCell]]:
    """The rows of the trackers: name, and the median ATE on each sequence."""
    medians_m = {}
    for key in board.ranked:
        for sequence in board.scored(key):
            medians_m[key, sequence] = board.cells[key][sequence].median or 0.0
    marks = column_marks(board, medians_m)

    rows = []
    for key in board.trackers:
        tag = "imported" if board.first(key).imported else ""
        cells = [TableCell(board.labels[key], tag=tag)]
        for sequence in board.sequences:
            mark = marks.get((key, sequence), "")
            cells.append(_ate_cell(board, key, sequence, mark, usual_runs))
        rows.append(cells)
    return rows


def _reported_rows(board: Board, reported: Sequence[ReportedCell]) -> list[list[TableCell]]:
    """The rows of published numbers: one a system and kind of source."""
    rows = []
    by_system = grouped(reported, lambda cell: (cell.system, cell.tag))
    for (system, tag), published in by_system.items():
        # of several numbers for a sequence the first one stands
        by_sequence = {cell.sequence: cell for cell in reversed(published)}
        cells = [TableCell(system, tag=tag)]
        for sequence in board.sequences:
            printed = by_sequence.get(sequence)
            if printed is None:
                cells.append(TableCell())
            else:
                cells.append(TableCell(mm(printed.value), value=printed.value, tip=printed.source))
        rows.append(cells)
    return rows


def _append_trained_scenes(board: Board, rows: Sequence[list[TableCell]]) -> None:
    """Append to every row the sequences that the tracker's network was trained on."""
    # rows behind those of the trackers have no key, and get an empty cell
    for key, row in zip_longest(board.trackers, rows):
        cells = board.cells.get(key, {})
        trained = [name for name in board.sequences if name in cells and cells[name].in_training]
        row.append(TableCell(", ".join(board.short[name] for name in trained)))


def _per_sequence_caption(board: Board, protocol: Protocol, usual_runs: int) -> str:
    """Sentences on reading the errors by sequence."""
    first = board.sequences[0]
    short_names = ""
    if board.short[first] != first:
        short_names = f"'{board.short[first]}' stands for {first}, and so on. "
    return (
        f"Median ATE (RMSE, millimetres; metres in the CSV) over the runs of a cell ({usual_runs} unless n says "
        "otherwise), lost frames held at the last tracked pose. Behind it half the interquartile range of the runs "
        "that differ, or 'deterministic' where several seeds gave one result to the last digit. A run that "
        "failed counts as a static camera, or worse; a cell with a failure is neither bold nor blue, and is marked "
        f"where nothing succeeded. Colour: ratio to {board.reference_name}, from blue (a quarter or less) to "
        f"orange (four times or more). Bold best, italic second among ranked trackers. {short_names}"
        f"{protocol.describe()}."
    )


_REPORTED_NOTE = (
    "Rows marked 'reported' are published numbers, not runs: their protocol is stated by their source only, "
    "and lost frames are left out of most. Rows marked 'claimed by the paper' are the implemented paper's own, "
    "which contradict themselves (see the audit). Rows marked 'record' are the lowest errors found in print "
    "under such a protocol, by sequence: whose each is, and how it was read, is told by its cell."
)
"""Sentences on reading the rows of published numbers."""


def final_errors(board: Board, protocol: Protocol) -> Table | None:
    """Errors of the final trajectories, of the trackers that have one."""
    return metric_table(
        board,
        lambda row: row.final_ate_m,
        "final_trajectory",
        "Error of the final trajectory",
        "Median ATE (RMSE, millimetres) of the trajectory as it was after the last frame, whatever was optimised until "
        f"then, of the trackers that have one; all other tables show the {protocol.trajectory} one. "
        f"{DOUBT}: it has poses of fewer than {100 * FINAL_SHARE:.0f} % of the tracked frames, and is not compared.",
        doubt=_final_doubt,
    )


def _final_doubt(cell: TrackerOnSequence) -> str:
    """Why the error of a final trajectory says little: it lacks poses of frames that were tracked."""
    # share of the tracked frames with a pose in the final trajectory, by run
    shares = []
    for row in cell.rows:
        if row.final_coverage and row.coverage:
            shares.append(row.final_coverage / row.coverage)
    least = min(shares, default=1.0)
    if least >= FINAL_SHARE:
        return ""
    return f"it has poses of only {100 * least:.0f} % of the tracked frames"


def tracked_errors(board: Board, protocol: Protocol) -> Table | None:
    """Errors of the tracked frames only."""
    return metric_table(
        board,
        lambda row: row.metrics.get("ate_rmse_m"),
        "lost_frames_excluded",
        "Error without the lost frames",
        "Median ATE (RMSE, millimetres) of the tracked frames only, of the runs that succeeded: the sensitivity to "
        f"lost frames, not what ranks. {protocol.describe()}.",
    )


def relative_errors(board: Board, protocol: Protocol) -> list[Table]:
    """One table for each relative error of the protocol and each of its parts, translation and rotation."""
    tables = []
    for spec in protocol.rpe:
        for part, unit, name in (("trans", "mm", "translation"), ("rot", "°", "rotation")):
            table = _relative_error_table(board, protocol, spec, part, unit, name)
            if table is not None:
                tables.append(table)
    return tables


def _relative_error_table(
    board: Board, protocol: Protocol, spec: RPESpec, part: str, unit: str, name: str
) -> Table | None:
    """The table of one part of a relative error; None if no run has it.

    Args:
        board: The board.
        protocol: How errors were computed.
        spec: The relative error.
        part: ``trans`` or ``rot``, as metrics name it.
        unit: Its unit.
        name: Its name in words.
    """
    # an error over one second or frame is a drift in that time
    per = ""
    if spec.delta == 1 or spec.rate:
        per = {"s": "/s", "f": " per frame"}.get(spec.unit, "")
    metric = spec.metric(part)
    return metric_table(
        board,
        lambda row: row.metrics.get(metric),
        f"rpe_{spec.key}_{part}",
        f"Relative pose error over {spec.describe()}: {name}",
        f"RMSE in {unit}{per}, median over the runs that succeeded, on the frames that they tracked. "
        f"{protocol.describe()}.",
        unit=f"RMSE, {unit}{per}",
        text=mm if unit == "mm" else significant_text,
    )


def rotation_errors(board: Board, protocol: Protocol) -> Table | None:
    """Absolute rotational error, marked where it is an error of the alignment rather than of the tracker."""
    caption = (
        "Absolute rotational error (RMSE in °), median over the runs that succeeded, after the alignment of the "
        f"positions, on the frames that they tracked. {protocol.describe()}."
    )
    cells = [cell for by_sequence in board.cells.values() for cell in by_sequence.values()]
    if any(_rotation_doubt(cell) for cell in cells):
        caption += (
            f" {DOUBT} Unreliable: the path hardly determines the alignment's rotation (its standard error is above "
            f"{RELIABLE_DEG:.0f}° in a run of the cell), so the number says nothing of the tracker and takes no part "
            "in emphasis. Translational and relative errors are not affected."
        )
    return metric_table(
        board,
        lambda row: row.metrics.get("ape_rot_rmse_deg"),
        "ape_rotation",
        "Absolute rotational error",
        caption,
        unit="RMSE, °",
        text=significant_text,
        doubt=_rotation_doubt,
    )


def false_motion(board: Board, protocol: Protocol) -> Table | None:
    """Table of how far each tracker says that a fixed camera moved; None without a recording of one."""
    farthest = medians(board, lambda row: row.metrics.get("false_motion_max_m"))
    if not farthest:
        return None
    values = {
        "farthest": farthest,
        "path": medians(board, lambda row: row.metrics.get("false_motion_path_m")),
    }
    still = {name for _, name in farthest}
    return _sequence_table(
        replace(board, sequences=[name for name in board.sequences if name in still]),
        values,
        "false_motion",
        "False motion before a fixed camera",
        "Of the estimated poses of a camera that stands still: the largest distance from the first one, and the length "
        "of the path. Millimetres (metres in the CSV), median over the runs that succeeded, on the frames that they "
        f"tracked. {protocol.describe()}.",
        "False motion before a fixed camera (mm)",
    )


def mask_quality(board: Board) -> Table | None:
    """Overlap of the trackers' masks with the exact ones, of the trackers that have masks."""
    return metric_table(
        board,
        lambda row: row.mask_iou,
        "mask_iou",
        "Mask quality",
        "Mean overlap (IoU) of the tracker's dynamic mask with the exact masks of people, median over runs. "
        "Dilation counts against it: exact masks, dilated, have less than 1.",
        unit="IoU",
        text=significant_text,
        larger_is_better=True,
    )


def _rotation_doubt(cell: TrackerOnSequence) -> str:
    """Why the absolute rotational error of a cell says nothing, with the largest uncertainty; empty if it does."""
    uncertain = [row for row in cell.kept if not row.failed and not row.rotation_reliable]
    if not uncertain:
        return ""
    largest_deg = max(row.rotation_uncertainty_deg or 0.0 for row in uncertain)
    return f"unreliable: the alignment's rotation is known to ±{largest_deg:.0f}° only"


def _ate_cell(board: Board, key: str, sequence: str, mark: Emphasis, usual_runs: int) -> TableCell:
    """The median ATE of a tracker on a sequence, with its spread, remarks and colour.

    Args:
        board: The board.
        key: The tracker.
        sequence: Name of the sequence.
        mark: Emphasis of the number.
        usual_runs: Runs that most cells have: only another number is written.
    """
    cell = board.cells[key].get(sequence)
    if cell is None:
        return TableCell("–", emphasis="muted", tip="not run")
    coverage = f"coverage {coverage_text(*mean_coverage(cell.rows))}"
    link = run_link(cell.typical)
    count = "" if len(cell.rows) == usual_runs else f"n={len(cell.rows)}"

    # nothing succeeded, or there is no ground truth
    if not cell.success:
        tip = coverage
        if cell.median is not None:
            tip = f"counts as {mm(cell.median)} mm, {coverage}"
        return TableCell(cell.ending, count, emphasis="failed", tip=tip, link=link)
    if cell.median is None:
        return TableCell("", emphasis="muted")

    # the number, with remarks behind it
    is_no_better = board.no_better_than_static(key, sequence)
    skipped = mean_of(row.epipolar_skipped for row in cell.rows)
    remarks = [
        _spread_words(cell),
        count,
        "" if skipped is None else f"F skipped {percent(skipped)}",
        "no better than a static camera" if is_no_better else "",
        f"{cell.success}/{len(cell.rows)} succeeded" if cell.failed else "",
    ]
    words = mm(cell.median) + SEEN * cell.in_training
    shown = TableCell(words, ", ".join(filter(None, remarks)), cell.median, mark, link=link)

    # its colour: the ratio to the reference; never blue with a failure, or where not moving is as good
    reference_m = board.reference_median(sequence)
    if cell.in_training:
        return replace(shown, tip=coverage if reference_m is None else SEEN_NOTE)
    if reference_m is None:
        return replace(shown, tip=coverage)
    ratio = cell.median / max(reference_m, FLOOR_M)
    bluest = 0.0 if cell.failed or is_no_better else -1.0
    tip = f"{ratio:.2f} × the reference, {coverage}"
    if cell.failed:
        tip += f"; {cell.ending}"
    return replace(shown, shade=max(shade(ratio), bluest), tip=tip)


def _spread_words(cell: TrackerOnSequence) -> str:
    """Half the interquartile range in mm, or that there is none."""
    if len(cell.scores) > 1:
        low_m, high_m = np.percentile(cell.scores, [25, 75])
        return f"±{significant_text(500.0 * float(high_m - low_m), 2)}"
    return "deterministic" if cell.deterministic else ""


def _static_camera_cell(board: Board, sequence: str) -> TableCell:
    """The error of a static camera on a sequence, coloured by its ratio to the reference's."""
    static_m = board.static_camera[sequence]
    reference_m = board.reference_median(sequence)
    if reference_m is None:
        return TableCell(mm(static_m), value=static_m)
    ratio = static_m / max(reference_m, FLOOR_M)
    tip = f"{ratio:.2f} × the reference"
    return TableCell(mm(static_m), value=static_m, shade=shade(ratio), tip=tip)


def shade(ratio: float) -> float:
    """Colour of a ratio to the reference: -1 at a quarter or less, 0 at the same, 1 at four times or more."""
    return float(np.clip(np.log(max(ratio, 1e-9)) / np.log(4), -1, 1))


_VERDICT_SHADES = {"better": shade(0.5), "better, but lost": shade(0.7), "worse": shade(2.0)}
"""Colours of verdicts: those of half, of 0.7 and of twice the reference's error."""


# -- the rules, and the runs


def failure_rule_table(board: Board) -> Table | None:
    """Table of how much the ranking depends on how failures and lost frames are counted; None if nothing was lost."""
    if not board.ranked or not any(row.incomplete or row.failed for row in board.rows):
        return None
    rules: dict[str, Callable[[RunRow], float | None]] = {
        "lost frames held": lambda row: row.score_m,
        "lost frames left out": _tracked_error,
        "failures left out too": lambda row: None if row.failed else _tracked_error(row),
    }
    columns = texts("tracker")
    standings_by_rule = []
    for name, rule in rules.items():
        columns += numbers("#", "ATE ratio", group=name)
        standings = rank(board, board.ranked, board.ranked, rule)
        standings_by_rule.append({standing.key: standing for standing in standings})

    rows = []
    for key in board.ranked:
        cells = [TableCell(board.labels[key])]
        for standings_of in standings_by_rule:
            standing = standings_of.get(key)
            if standing is None:
                cells += [TableCell(), TableCell()]
            else:
                cells += [rank_cell(standing), interval_cell(standing.ratio, ".2f")]
        rows.append(cells)
    return Table(
        "failure_rules",
        "Sensitivity to the rule for lost frames and failures",
        "The same runs under three rules. Lost frames held: the report's rule, a lost frame counts as not having moved "
        "since the last tracked one. Lost frames left out: the error of the tracked frames only, which is what most "
        "papers print; a tracker gains by losing the hard frames. Failures left out too: survivors only, which also "
        "flatters trackers that fail; in the first two they count as a static camera, or worse. A ranking "
        "that changes between the rules is decided by the rule.",
        columns,
        rows,
    )


def _tracked_error(row: RunRow) -> float | None:
    """The ATE of the tracked frames only; a failure counts as the report's rule says."""
    return row.score_m if row.failed else row.metrics.get("ate_rmse_m")


def run_link(row: RunRow) -> str:
    """Path of a run's page, seen from the report's."""
    return f"run.html#{row.run_id}"


def failures(board: Board) -> Table | None:
    """Every run that failed, with its reason and its page; None if there is none."""
    failed = [row for row in board.rows if row.failed]
    if not failed:
        return None
    failed.sort(key=lambda r: (board.labels[r.variant_key], board.sequence(r), r.repeat_key))
    columns = [
        *texts("tracker", "sequence", "repeat", "ended"),
        Column("coverage"),
        *texts("reason", "run"),
    ]
    rows = [
        [
            TableCell(board.labels[row.variant_key]),
            TableCell(board.sequence(row)),
            TableCell(row.repeat),
            TableCell(row.ending),
            TableCell(coverage_text(row.coverage, row.truth_share), value=row.coverage),
            TableCell(row.reason),
            TableCell(row.run_id, link=run_link(row)),
        ]
        for row in failed
    ]
    return Table(
        "failures",
        "Failures",
        "Runs that crashed, took too long or too much, broke their contract, were lost, or cannot be evaluated.",
        columns,
        rows,
    )


def repeatability(board: Board) -> Table | None:
    """Spread of the runs of a cell; None if no cell has several."""
    columns = [
        Column("tracker", numeric=False),
        Column("cells", meaning="sequences with several runs that differ"),
        Column(
            "deterministic",
            meaning="sequences on which several seeds gave one result to the last digit",
        ),
        Column("runs a cell"),
        Column("worst / best", meaning="median over cells of the largest over the smallest ATE"),
        Column("largest worst / best"),
        Column("where", numeric=False, latex=False),
    ]
    rows = [cells for key in board.trackers if (cells := _spread_cells(board, key))]
    if not rows:
        return None
    return Table(
        "repeatability",
        "Repeatability",
        "How far the runs of one tracker on one sequence lie apart when only seed, start offset or sensor noise "
        "differ. Differences between trackers that are smaller than this are noise. Copies (several seeds, one result "
        "to the last digit) are no repeats: they are counted as deterministic and take no part. Neither do failures.",
        columns,
        rows,
    )


def _spread_cells(board: Board, key: str) -> list[TableCell]:
    """Cells that say how far the runs of a tracker lie apart; empty if it has no cell with several."""
    cells = {name: board.cells[key][name] for name in board.sequences if name in board.cells[key]}
    # cells whose seeds all gave one result, and cells with several different ones
    n_copies = sum(cell.deterministic and cell.success > 1 for cell in cells.values())
    several = {name: cell for name, cell in cells.items() if len(cell.succeeded) > 1}
    counts = [TableCell(board.labels[key]), number(len(several)), number(n_copies)]
    if not several:
        return [*counts, *[TableCell()] * 4] if n_copies else []

    # the largest error over the smallest one, by sequence
    spreads = {}
    for name, cell in several.items():
        errors_m = [row.score_m or 0.0 for row in cell.succeeded]
        spreads[name] = max(errors_m) / max(min(errors_m), FLOOR_M)
    widest = max(spreads, key=lambda name: (spreads[name], name))
    runs_a_cell = median(len(cell.succeeded) for cell in several.values())
    return [
        *counts,
        TableCell(f"{runs_a_cell:g}"),
        number(median(spreads.values()), ".2f"),
        number(spreads[widest], ".2f"),
        TableCell(widest),
    ]


def machines(board: Board) -> Table:
    """Computers and versions behind the runs."""
    counts = Counter(row.machine_words or "not recorded" for row in board.rows)
    columns = [Column("runs"), Column("machine and versions", numeric=False)]
    rows = [[number(count), TableCell(name)] for name, count in counts.most_common()]
    return Table(
        "machines",
        "Machines and versions",
        "Times of different machines are not comparable.",
        columns,
        rows,
    )


# -- the implemented paper's Tables 1 to 3, made of our own runs

SUBJECT = "emfoa-oft"
"""Tracker whose improvement over the others is shown, where it was run."""
STATISTICS = {"rmse": "RMSE", "mean": "mean", "median": "median", "std": "SD"}
"""The statistics of the paper's Tables 1 and 2: their names in metrics, and in headings."""
LOST_MARK = "¶"
"""Behind errors of cells in which frames were lost."""
LOST_NOTE = (
    f"{LOST_MARK} Frames were lost in a run of the cell: the error is of the tracked ones only."
)
"""Meaning of `LOST_MARK`, for captions."""


def subject_of(board: Board) -> str | None:
    """The tracker that is compared with the others: `SUBJECT` as it is by default, else the best ranked one."""
    variants = []
    for key in board.trackers:
        if board.first(key).tracker.id == SUBJECT and key not in board.never_succeeded:
            variants.append(key)
    best = board.ranked[0] if board.ranked else None
    # the variant with the fewest changed settings
    return min(variants, key=lambda key: len(board.first(key).variant), default=best)


def absolute_table(board: Board, protocol: Protocol) -> Table | None:
    """Table 1: RMSE, mean, median and standard deviation of the absolute error; None if no run has it."""
    return _statistics_table(
        board,
        {name: f"ate_{name}_m" for name in STATISTICS},
        "paper_ape",
        "Absolute pose error, four statistics",
        f"As the paper's Table 1. {protocol.describe()}.",
        "Absolute pose error (mm)",
    )


def relative_table(board: Board, protocol: Protocol) -> Table | None:
    """Table 2: the four statistics of the protocol's first relative error; None if it has none."""
    if not protocol.rpe:
        return None
    spec = protocol.rpe[0]
    return _statistics_table(
        board,
        {name: f"rpe_{spec.key}_trans_{name}_m" for name in STATISTICS},
        "paper_rpe",
        "Relative pose error, four statistics",
        f"As the paper's Table 2, over {spec.describe()}. {protocol.describe()}.",
        f"Relative pose error over {spec.describe()} (mm)",
    )


def time_table(board: Board) -> Table | None:
    """Table 3: accuracy, error and time of a frame; None if nothing was scored."""
    errors = medians(board, _percent_of_static_camera)
    if not errors:
        return None
    measures = {
        "accuracy (%)": medians(board, _accuracy_percent),
        "error (%)": errors,
        "time (ms)": _frame_times(board),
    }
    caption = (
        "As the paper's Table 3. Error: the median ATE, lost frames held, in percent of that of a static camera"
        "; accuracy: what is left of 100 %, negative for a tracker that is worse than that. (The paper does "
        "not define its own; its numbers are 100 times one minus the standard deviation in metres.) Time: median of a "
        f"frame, segmentation included, decoding excluded, on {computer_words(board.timing_computer)} alone. Runs that "
        "succeeded."
    )
    return _sequence_table(
        board,
        measures,
        "paper_accuracy",
        "Accuracy, error and time",
        caption,
        "Error in percent of a static camera, accuracy, and time of a frame",
        text="{:.1f}".format,
        marks={},
    )


def _frame_times(board: Board) -> dict[tuple[str, str], float]:
    """Median frame time in milliseconds by tracker and sequence, of runs on the board's `timing_computer`."""
    times_ms = {}
    for key, cells in board.cells.items():
        for sequence, cell in cells.items():
            rows = [row for row in cell.succeeded if row.computer == board.timing_computer]
            frame_ms = median_of(row.frame_ms for row in timed(rows))
            if frame_ms is not None:
                times_ms[key, sequence] = frame_ms
    return times_ms


def _percent_of_static_camera(row: RunRow) -> float | None:
    """A run's error in percent of that of a static camera."""
    static_m = row.static_camera_ate_rmse_m
    if not static_m or row.hold_last_pose_ate_m is None:
        return None
    return 100 * row.hold_last_pose_ate_m / static_m


def _accuracy_percent(row: RunRow) -> float | None:
    """Accuracy of a run: 100 % less its error in percent of a static camera's."""
    error_percent = _percent_of_static_camera(row)
    return None if error_percent is None else 100 - error_percent


def _statistics_table(
    board: Board, metrics: Mapping[str, str], name: str, title: str, source: str, brief: str
) -> Table | None:
    """A table of several statistics of one error, with the subject's improvement over the others below a line.

    Args:
        board: The board.
        metrics: Statistic to the name of the metric.
        name: Id of the table.
        title: Heading.
        source: First sentences of the caption.
        brief: Caption where there is little room.
    """
    errors = {
        statistic: medians(board, partial(_metric_of, metric=metric))
        for statistic, metric in metrics.items()
    }
    if not errors["rmse"]:
        return None
    table = _sequence_table(
        board,
        errors,
        name,
        title,
        f"{source} Millimetres (metres in the CSV), median over the runs that succeeded.",
        brief,
        behind=lambda cell: SEEN * cell.in_training + LOST_MARK * has_lost(cell),
    )
    if any(cell.text.endswith(LOST_MARK) for row in table.rows for cell in row):
        table.caption += f" {LOST_NOTE}"
    _append_improvements(board, table, errors)
    return table


def _metric_of(row: RunRow, metric: str) -> float | None:
    """A metric of a run by its name; None if the run has none."""
    return row.metrics.get(metric)


def _append_improvements(board: Board, table: Table, errors: Mapping[str, Values]) -> None:
    """Append a row for each other ranked tracker: by how many percent the subject's errors are smaller."""
    measured = {key for key, _ in errors["rmse"]}
    subject = subject_of(board)
    others = [key for key in board.ranked if key in measured and key != subject]
    if subject not in measured or not others:
        return
    table.caption += (
        f" Below the line: by how many percent the error of {board.labels[subject]} is smaller than that of "
        "the other tracker."
    )
    table.separators |= {len(table.rows)}
    for other in others:
        cells = [TableCell(f"improvement on {board.labels[other]}")]
        for sequence in board.sequences:
            for values in errors.values():
                ours = values.get((subject, sequence))
                theirs = values.get((other, sequence))
                if ours is None or not theirs:
                    cells.append(TableCell())
                else:
                    cells.append(number(100 * (theirs - ours) / theirs, ".1f", " %"))
        table.rows.append(cells)


def sequence_columns(board: Board, kinds: Sequence[str] = ("",)) -> list[Column]:
    """One column for every sequence, in its group; for several kinds of numbers one column a sequence and kind."""
    columns = []
    for name in board.sequences:
        if len(kinds) == 1:
            column = Column(board.short[name], group=board.groups[name], meaning=name, full=name)
            columns.append(column)
            continue
        for kind in kinds:
            heading = STATISTICS.get(kind, kind)
            columns.append(Column(heading, board.short[name], full=f"{name}: {heading}"))
    return columns


def has_lost(cell: TrackerOnSequence) -> bool:
    """Whether frames were lost in a run that succeeded: the errors of the cell are of the tracked ones only."""
    return any(row.incomplete for row in cell.kept if not row.failed)
