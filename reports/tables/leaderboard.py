"""The tables of a board: the leaderboard, errors by sequence, tables of the runs, and the paper's Tables 1 to 3."""

import math
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from itertools import zip_longest
from statistics import median

import numpy as np

from dynslam_bench.core import label_text
from dynslam_bench.evaluation import Protocol, RPESpec
from dynslam_bench.evaluation.alignment import RELIABLE_DEG
from dynslam_bench.reports.model.board import (
    OVERALL,
    STATIC_CAMERA,
    Board,
    Cell,
    compare_pairs,
    mean_of,
    rank,
    timed,
    timed_on_one,
)
from dynslam_bench.reports.model.published import ReportedCell
from dynslam_bench.reports.model.row import HINTED, SEEN, RunRow, grouped
from dynslam_bench.reports.model.statistics import FEWEST, FLOOR_M, Interval, Standing
from dynslam_bench.reports.tables.table import (
    Column,
    Emphasis,
    Table,
    TableCell,
    emphasise,
    mm,
    number,
    numbers,
    percent,
    significant_text,
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
_NAMES = {"own": "our composition"}
CACHED_MARK = "†"
COMPUTER_MARK = "‖"
"""Behind times of trackers with runs on other computers than most."""
CACHED_NOTE = (
    f"{CACHED_MARK} Times of features and masks come from the stage cache, not from the run itself."
)
SEEN_NOTE = (
    f"{SEEN} The masks come from a network that was trained on this very scene (the embedded one, on rendered "
    "scenes 0-99): its best case, no judgement."
)


def leaderboard(board: Board, protocol: Protocol) -> Table:
    """Ranking with what the data leave open, success, coverage, speed and provenance."""
    epipolar = any(row.epipolar_skipped is not None for row in board.rows)
    columns = [
        replace(column, meaning=column.meaning.replace("{reference}", board.reference_name))
        for column in COLUMNS
        if epipolar or column.name != "F skipped"
    ]
    lines = [leaderboard_cells(board, key) for key in board.trackers]
    rows = [[cells[column.name] for column in columns] for cells in lines]
    brief = f"Geometric mean of the ATE over that of {board.reference_name}"
    brief += ", with 95 % intervals" * any(
        math.isfinite(standing.ratio.low) for standing in board.standings
    )
    return Table(
        "leaderboard",
        "Leaderboard",
        _caption(board, protocol, epipolar),
        columns,
        rows,
        board.unranked_rows(board.trackers),
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
        meaning="geometric mean over sequences of the median ATE over that of {reference}",
    ),
    Column(
        "better?",
        meaning="better than {reference}, worse, or cannot tell: paired t test of the log errors over sequences, "
        "Holm-corrected over the ranked trackers; behind it the corrected p",
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


def _caption(board: Board, protocol: Protocol, epipolar: bool) -> str:
    failed = sum(row.failed for row in board.rows)
    groups = dict.fromkeys(board.groups[name] for name in board.common)
    several = len(groups) > 1 and board.category == OVERALL
    mean = f"It is a mean over {len(groups)} categories ({', '.join(groups)}), which all weigh the same. "
    intervals = (
        "Brackets: Student's 95 % intervals over sequences."
        if len(board.common) >= FEWEST
        else f"No intervals: they would need {FEWEST} sequences."
    )
    parts = [
        f"{protocol.describe()}; for the ranking a lost frame counts as not having moved since the last tracked one.",
        f"ATE ratio: geometric mean over {_count(len(board.common), 'sequence')} of the median ATE over that of "
        f"{board.reference_name}; below 1 is better. {mean if several else ''}{intervals}",
        f"A run that failed or was lost counts as a static camera, or worse ({failed} of "
        f"{_count(len(board.rows), 'run')}); trackers without any success stand below the last line.",
        "Grey rows are shown but not ranked: controls, inspired or assumed re-implementations, runs that begin "
        "in the map of an earlier one or by another program, real-time runs and exact masks beside others, "
        "trackers that lack sequences, never succeeded, or are no better than a static camera.",
    ]
    counts = {
        key: sum(board.no_better_than_static(key, name) for name in board.sequences)
        for key in board.trackers
    }
    worse = "; ".join(
        f"{board.labels[key]} on {count} of {_count(len(board.cells[key]), 'sequence')}"
        for key, count in counts.items()
        if count
    )
    hinted = _hinted(board.rows)
    rule = (
        "Such runs rank, since that was asked for." if board.rank_seen else "Such runs do not rank."
    )
    remarks = {
        f"No better than a static camera, although their runs ended: {worse}.": worse,
        f"{board.asked_reference} was asked for as the reference, but has not every ranked sequence: a static "
        "camera takes its place.": board.asked_reference and board.reference is None,
        "F skipped: frames on which an epipolar system did not use its fundamental matrix.": epipolar,
        CACHED_NOTE: any(row.cached for row in board.rows),
        computer_note(board): True,
        f"{SEEN_NOTE} {rule} Instances 100-199 are held out.": any(
            row.seen_in_training for row in board.rows
        ),
        f"{HINTED} The trajectories of {_count(sum(bool(row.hints) for row in board.rows), 'run')} are probably faulty "
        f"({hinted}), as the diagnostics say; no number is changed for that.": hinted,
    }
    return " ".join(parts + [remark for remark, holds in remarks.items() if remark and holds])


def _hinted(rows: Iterable[RunRow]) -> str:
    """What is probably wrong with trajectories, with the number of runs; empty if nothing is."""
    counts = Counter(line.partition(":")[0] for row in rows for line in row.hints)
    return ", ".join(f"{name} {count}" for name, count in counts.most_common())


def leaderboard_cells(board: Board, key: str) -> dict[str, TableCell]:
    """The cells of a tracker by the names of their columns; what is not known is empty."""
    runs = board.runs(key)
    standing = board.placed.get(key)
    ended = [row for row in runs if not row.failed]
    coverage = mean_of(row.coverage for row in runs)
    hinted = _hinted(runs)
    masks = " + ".join(
        sorted(
            {label_text(row.segmentation) for row in runs if row.segmentation not in ("", "none")}
        )
    )
    tracker = runs[0].tracker
    skipped = mean_of(row.epipolar_skipped for row in runs)
    cells = dict.fromkeys((column.name for column in COLUMNS), TableCell()) | {
        "#": TableCell("–"),
        "success": TableCell(f"{len(ended)}/{len(runs)}", value=len(ended) / len(runs)),
        "tracker": TableCell(
            board.labels[key] + f" {HINTED}" * bool(hinted), hinted, tip=tracker.id
        ),
        "coverage": TableCell(coverage_text(coverage), value=coverage),
        "× real time": speed_cell(board, ended),
        "MB": number(middle(row.peak_memory_mb for row in ended), ".0f"),
        "rows": TableCell(
            small=runs[0].program_remark,
            tag=" + ".join(
                f"{n} {origin}" for origin, n in Counter(row.origin for row in runs).items()
            ),
        ),
        "F skipped": TableCell() if skipped is None else TableCell(percent(skipped), value=skipped),
        "provenance": TableCell(
            _NAMES.get(tracker.provenance, tracker.provenance),
            f"{masks} masks" if masks else "",
            tip=_PROVENANCE.get(tracker.provenance, ""),
        ),
    }
    if key in board.hopeless:
        return cells | {"ATE ratio": TableCell("nothing succeeded", emphasis="failed")}
    if standing is None:
        return cells
    ratio = ratio_cell(board, standing)
    if standing.sequences < len(board.common):
        small = f"{ratio.small} on {standing.sequences} of {len(board.common)}".strip()
        ratio = TableCell(ratio.text, small, ratio.value)
    wins = TableCell(f"{standing.wins} of {standing.sequences}", value=standing.wins)
    return cells | {
        "#": TableCell("–", why) if (why := board.unranked_why(key)) else rank_cell(standing),
        "ATE ratio": ratio,
        "better?": verdict_cell(board, standing),
        "wins": TableCell() if key == board.reference else wins,
        "mean rank": number(standing.mean_rank, ".2f"),
    }


def verdict_cell(board: Board, standing: Standing) -> TableCell:
    """Better than the reference, worse, or cannot tell, with the corrected p value; coloured where it is shown."""
    if not standing.verdict or (len(board.common) < FEWEST and standing.verdict != "reference"):
        return TableCell()
    p = (
        ""
        if standing.p_value is None
        else "p < 0.001"
        if standing.p_value < 0.001
        else f"p {standing.p_value:.3f}"
    )
    return TableCell(
        standing.verdict, p, shade={"better": shade(0.5), "worse": shade(2.0)}.get(standing.verdict)
    )


def category_table(boards: Mapping[str, Board]) -> Table | None:
    """The ratios of all trackers by category; None where there is one category only.

    Args:
        boards: Category to its board, see `category_boards`.
    """
    if len(boards) < 2:
        return None
    overall = boards[OVERALL]

    cells = [
        {
            key: replace(ratio_cell(board, s), shade=verdict_cell(board, s).shade, tip=s.verdict)
            for key, s in board.placed.items()
        }
        for board in boards.values()
    ]
    rows = [
        [TableCell(overall.labels[key]), *(placed.get(key, TableCell()) for placed in cells)]
        for key in overall.trackers
    ]
    columns = [
        Column(
            name, meaning=f"{_count(len(board.common), 'sequence')}, against {board.reference_name}"
        )
        for name, board in boards.items()
    ]
    caption = (
        "Geometric mean of the median ATE over that of the reference, by category; brackets are 95 % intervals from "
        f"{FEWEST} sequences on. Blue: better than the reference; orange: worse; no colour: cannot tell or not ranked. "
        "A sequence may be in several categories: what moves there, how the camera moves, recorded or rendered."
    )
    muted = overall.unranked_rows(overall.trackers)
    separators = overall.separators()
    return Table(
        "categories", "By category", caption, [*texts("tracker"), *columns], rows, muted, separators
    )


def pair_table(board: Board) -> Table | None:
    """Every ranked tracker against every other; None below `FEWEST` sequences or for fewer than three trackers."""
    if len(board.common) < FEWEST or len(board.ranked) < 3:
        return None
    pairs = {frozenset((pair.one, pair.other)): pair for pair in compare_pairs(board, board.ranked)}

    def shown(key: str, other: str) -> TableCell:
        if other == key:
            return TableCell("–", emphasis="muted")
        pair = pairs[frozenset((key, other))]
        ratio = pair.ratio.value if pair.one == key else 1.0 / pair.ratio.value
        apart = pair.verdict != "cannot tell"
        colour = shade(0.5 if ratio < 1 else 2.0) if apart else None
        return TableCell(
            f"{ratio:.2f}", "" if apart else "?", ratio, shade=colour, tip=f"p {pair.p_value:.3f}"
        )

    rows = [
        [TableCell(board.labels[key]), *(shown(key, other) for other in board.ranked)]
        for key in board.ranked
    ]
    caption = (
        "Geometric mean of the errors of the row over those of the column. Coloured: the two can be told apart (paired "
        "t tests of the log errors over sequences, Holm-corrected over all pairs); '?': they cannot."
    )
    columns = [*texts("tracker"), *numbers(*(board.labels[key] for key in board.ranked))]
    return Table("pairs", "All pairs", caption, columns, rows)


def speed_cell(board: Board, ended: Sequence[RunRow]) -> TableCell:
    """Real-time factor and frame time on one computer, with their marks (`time_marks`)."""
    rows = timed_on_one(ended, board.timing_computer)
    factor = middle(row.real_time_factor for row in rows)
    frame_ms = middle(row.frame_ms for row in rows)
    if factor is None:
        return TableCell()
    mark, tip = time_marks(board, ended)
    small = "" if frame_ms is None else f"{frame_ms:.1f} ms{mark}"
    return TableCell(
        (f"{factor:.2f}" if factor < 100 else f"{factor:.0f}") + mark, small, factor, tip=tip
    )


def frame_time_cell(board: Board, ended: Sequence[RunRow]) -> TableCell:
    """Median frame time in milliseconds on one computer, with its marks (`time_marks`)."""
    frame_ms = middle(row.frame_ms for row in timed_on_one(ended, board.timing_computer))
    if frame_ms is None:
        return TableCell()
    mark, tip = time_marks(board, ended)
    return TableCell(f"{frame_ms:.1f}{mark}", value=frame_ms, tip=tip)


def time_marks(board: Board, ended: Sequence[RunRow]) -> tuple[str, str]:
    """What stands behind the times of some runs, and why: the stage cache, and other computers than most runs had."""
    marks = []
    tips = []
    if any(row.cached for row in timed_on_one(ended, board.timing_computer)):
        marks.append(CACHED_MARK)
        tips.append(CACHED_NOTE)
    by_computer = grouped(timed(ended), lambda row: row.computer)
    if by_computer and by_computer.keys() != {board.timing_computer}:
        marks.append(COMPUTER_MARK)
        by_number = sorted(by_computer.items(), key=lambda entry: (-len(entry[1]), entry[0]))
        for computer, rows in by_number:
            frame_ms = middle(row.frame_ms for row in rows) or 0.0
            tips.append(
                f"{frame_ms:.1f} ms on {computer_words(computer)} ({_count(len(rows), 'run')})"
            )
    return "".join(marks), "; ".join(tips)


def computer_words(computer: str) -> str:
    """A computer (`RunRow.computer`), in words where it is not recorded."""
    return computer or "a computer that is not recorded"


def computer_note(board: Board) -> str:
    """On which computer times were taken, and that some are of others; empty where all are of one."""
    others = {row.computer for row in timed([row for row in board.rows if not row.failed])} - {
        board.timing_computer
    }
    if not others:
        return ""
    return (
        f"Times are those of {computer_words(board.timing_computer)}; {COMPUTER_MARK} of rows with runs on other "
        "computers, whose times are never averaged with these: the cell's tip has the time on each."
    )


def rank_cell(standing: Standing) -> TableCell:
    """The ranks that the data leave open."""
    return TableCell("–".join(map(str, dict.fromkeys(standing.group))) if standing.group else "–")


def ratio_cell(board: Board, standing: Standing) -> TableCell:
    """The ratio to the reference with its interval, bold for those that may be first."""
    return interval_cell(standing.ratio, ".2f", "best" if standing.key in board.emphasised else "")


def interval_cell(interval: Interval, digits: str, emphasis: Emphasis = "") -> TableCell:
    """A value with its interval, if it has one."""
    small = (
        f"[{interval.low:{digits}}, {interval.high:{digits}}]"
        if math.isfinite(interval.low)
        else ""
    )
    return TableCell(f"{interval.value:{digits}}", small, interval.value, emphasis)


def middle(values: Iterable[float | None]) -> float | None:
    """Median of what is present; None if nothing is."""
    present = [value for value in values if value is not None]
    return median(present) if present else None


def _count(count: int, noun: str) -> str:
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
    doubt: Callable[[Cell], str] = lambda cell: "",
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
    doubtful: dict[tuple[str, str], Emphasis] = {
        (k, s): "muted" for k, s in values if doubt(board.cells[k][s])
    }
    sign = -1.0 if larger_is_better else 1.0
    compared = {place: sign * number for place, number in values.items() if place not in doubtful}
    return _sequence_table(
        board,
        {"": values},
        name,
        title,
        caption,
        f"{title} ({unit})",
        text=text,
        behind=lambda cell: DOUBT * bool(doubt(cell)) + SEEN * cell.in_training,
        tip=lambda cell: doubt(cell) or (SEEN_NOTE if cell.in_training else cell.ending),
        marks={"": column_marks(board, compared) | doubtful},
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
    behind: Callable[[Cell], str] = lambda cell: "",
    tip: Callable[[Cell], str] = lambda cell: "",
    marks: Mapping[str, Mapping[tuple[str, str], Emphasis]] | None = None,
) -> Table:
    """A row a tracker that has any of the numbers, a column a sequence and kind of number.

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
    marks = (
        {kind: column_marks(board, values) for kind, values in measures.items()}
        if marks is None
        else marks
    )
    measured = {key for values in measures.values() for key, _ in values}
    keys = [key for key in (*board.trackers, *board.final_only) if key in measured]

    def shown(place: tuple[str, str], kind: str) -> TableCell:
        cell, value = board.cells[place[0]].get(place[1]), measures[kind].get(place)
        if cell is not None and not cell.success:
            return TableCell(emphasis="failed", tip=cell.ending)
        if cell is None or value is None:
            return TableCell()
        mark = marks.get(kind, {}).get(place, "")
        return TableCell(text(value) + behind(cell), value=value, emphasis=mark, tip=tip(cell))

    rows = [
        [
            TableCell(board.labels[key]),
            *(shown((key, name), kind) for name in board.sequences for kind in measures),
        ]
        for key in keys
    ]
    muted = board.unranked_rows(keys)
    ranked = len(keys) - len(muted)
    separators = {ranked} if 0 < ranked < len(rows) else set()
    columns = [*texts("tracker"), *sequence_columns(board, list(measures))]
    return Table(name, title, caption, columns, rows, muted, separators, brief)


def medians(board: Board, value: Value) -> dict[tuple[str, str], float]:
    """Median of a number over the runs that count and succeeded, by tracker and sequence."""
    of_cell = {
        (key, name): middle(value(row) for row in cell.kept if not row.failed)
        for key, cells in board.cells.items()
        for name, cell in cells.items()
        if name in board.sequences
    }
    return {place: number for place, number in of_cell.items() if number is not None}


def column_marks(board: Board, values: Values) -> dict[tuple[str, str], Emphasis]:
    """Best and second best of every column among the ranked trackers whose runs there compete and all succeeded.

    A tracker that is no better there than a static camera takes no part.

    Args:
        board: The board.
        values: A number a cell, less is better; a cell that has none takes no part.
    """
    marks: dict[tuple[str, str], Emphasis] = {}
    for name in board.sequences:
        keys = [
            key
            for key in board.ranked
            if name in board.cells[key] and not board.cells[key][name].failed
        ]
        places = [
            (k, name)
            for k in keys
            if board.competes(k, name) and not board.no_better_than_static(k, name)
        ]
        marks |= zip(places, emphasise([values.get(place) for place in places]), strict=True)
    return marks


def per_sequence(board: Board, protocol: Protocol, reported: Sequence[ReportedCell] = ()) -> Table:
    """Median ATE of every tracker on every sequence, with spread, number of runs and failures."""
    sizes = Counter(len(cell.rows) for key in board.trackers for cell in board.cells[key].values())
    usual = sizes.most_common(1)[0][0] if sizes else 1
    marks = column_marks(
        board,
        {
            (key, name): board.cells[key][name].median or 0.0
            for key in board.ranked
            for name in board.scored(key)
        },
    )
    rows = []
    for key in board.trackers:
        name_cell = TableCell(board.labels[key], tag="imported" * board.first(key).imported)
        errors = (
            _error_cell(board, key, name, marks.get((key, name), ""), usual)
            for name in board.sequences
        )
        rows.append([name_cell, *errors])
    rows.append(
        [TableCell(STATIC_CAMERA), *(_static_camera_cell(board, name) for name in board.sequences)]
    )
    separators = board.separators() | {len(board.trackers)} | ({len(rows)} if reported else set())
    for (name, tag), published in grouped(reported, lambda cell: (cell.system, cell.tag)).items():
        line = {cell.sequence: cell for cell in reversed(published)}
        printed = [line.get(sequence) for sequence in board.sequences]
        cells = [
            TableCell(mm(p.value), value=p.value, tip=p.source) if p else TableCell()
            for p in printed
        ]
        rows.append([TableCell(name, tag=tag), *cells])
    muted = board.unranked_rows(board.trackers) | set(range(len(board.trackers), len(rows)))
    first = board.sequences[0]
    names = (
        ""
        if board.short[first] == first
        else f"'{board.short[first]}' stands for {first}, and so on. "
    )
    caption = (
        f"Median ATE (RMSE, millimetres; metres in the CSV) over the runs of a cell ({usual} unless n says otherwise), "
        "lost frames held at the last tracked pose. Behind it half the interquartile range of the runs that differ, or "
        "'deterministic' where several seeds gave one result to the last digit. A run that failed counts as a static "
        "camera, or worse; a cell with a failure is neither bold nor blue, and is marked where "
        f"nothing succeeded. Colour: ratio to {board.reference_name}, from blue (a quarter or less) to orange (four "
        f"times or more). Bold best, italic second among ranked trackers. {names}{protocol.describe()}."
    )
    if reported:
        caption += (
            " Rows marked 'reported' are published numbers, not runs: their protocol is stated by their source only, "
            "and lost frames are left out of most. Rows marked 'claimed by the paper' are the implemented paper's own, "
            "which contradict themselves (see the audit). Rows marked 'record' are the lowest errors found in print "
            "under such a protocol, by sequence: whose each is, and how it was read, is told by its cell."
        )
    columns = [*texts("tracker"), *sequence_columns(board)]
    if any(row.seen_in_training for row in board.rows):
        columns.append(Column(f"{SEEN} trained on", numeric=False, meaning=SEEN_NOTE))
        for key, row in zip_longest(board.trackers, rows):
            cells_of = board.cells.get(key, {})
            trained = [
                name for name in board.sequences if name in cells_of and cells_of[name].in_training
            ]
            row.append(TableCell(", ".join(board.short[name] for name in trained)))
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


def _final_doubt(cell: Cell) -> str:
    """Why the error of a final trajectory says little: it lacks poses of frames that were tracked."""
    shares = [
        row.final_coverage / row.coverage
        for row in cell.rows
        if row.final_coverage and row.coverage
    ]
    least = min(shares, default=1.0)
    return (
        f"it has poses of only {100 * least:.0f} % of the tracked frames"
        if least < FINAL_SHARE
        else ""
    )


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
    """One table for each relative error of the protocol and each of its parts."""

    def table(spec: RPESpec, part: str, unit: str, name: str) -> Table | None:
        per = (
            {"s": "/s", "f": " per frame"}.get(spec.unit, "")
            if spec.delta == 1 or spec.rate
            else ""
        )
        return metric_table(
            board,
            lambda row: row.metrics.get(spec.metric(part)),
            f"rpe_{spec.key}_{part}",
            f"Relative pose error over {spec.describe()}: {name}",
            f"RMSE in {unit}{per}, median over the runs that succeeded, on the frames that they tracked. "
            f"{protocol.describe()}.",
            unit=f"RMSE, {unit}{per}",
            text=mm if unit == "mm" else significant_text,
        )

    parts = (("trans", "mm", "translation"), ("rot", "°", "rotation"))
    return [
        shown
        for spec in protocol.rpe
        for part in parts
        if (shown := table(spec, *part)) is not None
    ]


def rotation_errors(board: Board, protocol: Protocol) -> Table | None:
    """Absolute rotational error, marked where it is an error of the alignment rather than of the tracker."""
    caption = (
        "Absolute rotational error (RMSE in °), median over the runs that succeeded, after the alignment of the "
        f"positions, on the frames that they tracked. {protocol.describe()}."
    )
    if any(_rotation_doubt(cell) for cells in board.cells.values() for cell in cells.values()):
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
    """How far each tracker says that a fixed camera moved; None without a recording of one."""
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


def _rotation_doubt(cell: Cell) -> str:
    """Why the absolute rotational error of a cell says nothing, with the largest uncertainty; empty if it does."""
    uncertain = [row for row in cell.kept if not row.failed and not row.rotation_reliable]
    largest = max((row.rotation_uncertainty_deg or 0.0 for row in uncertain), default=0.0)
    return (
        f"unreliable: the alignment's rotation is known to ±{largest:.0f}° only"
        if uncertain
        else ""
    )


def _error_cell(board: Board, key: str, sequence: str, mark: Emphasis, usual: int) -> TableCell:
    cell = board.cells[key].get(sequence)
    if cell is None:
        return TableCell("–", emphasis="muted", tip="not run")
    coverage = f"coverage {coverage_text(mean_of(row.coverage for row in cell.rows))}"
    link = run_link(cell.typical)
    count = "" if len(cell.rows) == usual else f"n={len(cell.rows)}"
    if not cell.success:
        tip = f"counts as {mm(cell.median)} mm, {coverage}" if cell.median is not None else coverage
        return TableCell(cell.ending, count, emphasis="failed", tip=tip, link=link)
    if cell.median is None:
        return TableCell("", emphasis="muted")
    skipped = mean_of(row.epipolar_skipped for row in cell.rows)
    base = board.reference_median(sequence)
    no_better = board.no_better_than_static(key, sequence)
    ratio = None if base is None else cell.median / max(base, FLOOR_M)
    notes = [
        _spread(cell),
        count,
        "" if skipped is None else f"F skipped {percent(skipped)}",
        "no better than a static camera" * no_better,
        f"{cell.success}/{len(cell.rows)} succeeded" if cell.failed else "",
    ]
    shown = TableCell(
        mm(cell.median) + SEEN * cell.in_training,
        ", ".join(filter(None, notes)),
        cell.median,
        mark,
        link=link,
    )
    if ratio is None or cell.in_training:
        return replace(shown, tip=coverage if ratio is None else SEEN_NOTE)
    best = 0.0 if cell.failed or no_better else -1.0
    tip = f"{ratio:.2f} × the reference, {coverage}" + (f"; {cell.ending}" if cell.failed else "")
    return replace(shown, shade=max(shade(ratio), best), tip=tip)


def _spread(cell: Cell) -> str:
    """Half the interquartile range in mm, or that there is none."""
    if len(cell.scores) > 1:
        low, high = np.percentile(cell.scores, [25, 75])
        return f"±{significant_text(500.0 * float(high - low), 2)}"
    return "deterministic" if cell.deterministic else ""


def _static_camera_cell(board: Board, sequence: str) -> TableCell:
    base = board.reference_median(sequence)
    value = board.static_camera[sequence]
    if base is None:
        return TableCell(mm(value), value=value)
    ratio = value / max(base, FLOOR_M)
    return TableCell(mm(value), value=value, shade=shade(ratio), tip=f"{ratio:.2f} × the reference")


def shade(ratio: float) -> float:
    """-1 at a quarter of the reference's error or less, 0 at the same, 1 at four times or more."""
    return float(np.clip(np.log(max(ratio, 1e-9)) / np.log(4), -1, 1))


# -- the rules, and the runs


def failure_rule_table(board: Board) -> Table | None:
    """How much the ranking depends on how failures and lost frames are counted; None if nothing was lost."""
    if not board.ranked or not any(row.incomplete or row.failed for row in board.rows):
        return None
    rules: dict[str, Callable[[RunRow], float | None]] = {
        "lost frames held": lambda row: row.score_m,
        "lost frames left out": _tracked_error,
        "failures left out too": lambda row: None if row.failed else _tracked_error(row),
    }
    columns = [
        *texts("tracker"),
        *(column for name in rules for column in numbers("#", "ATE ratio", group=name)),
    ]
    cells = [
        {
            s.key: [rank_cell(s), interval_cell(s.ratio, ".2f")]
            for s in rank(board, board.ranked, board.ranked, rule)
        }
        for rule in rules.values()
    ]
    empty = [TableCell(), TableCell()]
    rows = [
        [TableCell(board.labels[key]), *(cell for pairs in cells for cell in pairs.get(key, empty))]
        for key in board.ranked
    ]
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
    """Where the page of a run lies, seen from the report's."""
    return f"run.html#{row.run_id}"


def failures(board: Board) -> Table | None:
    """Every run that failed, with its reason and its page; None if there is none."""
    failed = [row for row in board.rows if row.failed]
    if not failed:
        return None
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
            TableCell(coverage_text(row.coverage), value=row.coverage),
            TableCell(row.reason),
            TableCell(row.run_id, link=run_link(row)),
        ]
        for row in sorted(
            failed, key=lambda r: (board.labels[r.variant_key], board.sequence(r), r.repeat_key)
        )
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
    """How far the runs of a tracker lie apart; empty if it has no cell with several."""
    cells = {name: board.cells[key][name] for name in board.sequences if name in board.cells[key]}
    copies = sum(cell.deterministic and cell.success > 1 for cell in cells.values())
    several = {name: cell for name, cell in cells.items() if len(cell.succeeded) > 1}
    counts = [TableCell(board.labels[key]), number(len(several)), number(copies)]
    if not several:
        return [*counts, *[TableCell()] * 4] if copies else []
    errors = {
        name: [row.score_m or 0.0 for row in cell.succeeded] for name, cell in several.items()
    }
    spreads = {name: max(values) / max(min(values), FLOOR_M) for name, values in errors.items()}
    widest = max(spreads, key=lambda name: (spreads[name], name))
    size = f"{median(len(cell.succeeded) for cell in several.values()):g}"
    ratios = [number(median(spreads.values()), ".2f"), number(spreads[widest], ".2f")]
    return [*counts, TableCell(size), *ratios, TableCell(widest)]


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
LOST_MARK = "¶"
LOST_NOTE = (
    f"{LOST_MARK} Frames were lost in a run of the cell: the error is of the tracked ones only."
)


def subject_of(board: Board) -> str | None:
    """The tracker that is compared with the others: `SUBJECT` as it is by default, else the best ranked one."""
    own = [
        key
        for key in board.trackers
        if board.first(key).tracker.id == SUBJECT and key not in board.hopeless
    ]
    best = board.ranked[0] if board.ranked else None
    return min(own, key=lambda key: len(board.first(key).variant), default=best)


def absolute_table(board: Board, protocol: Protocol) -> Table | None:
    """Table 1: RMSE, mean, median and standard deviation of the absolute error; None if no run has it."""
    return _statistics_table(
        board, {name: f"ate_{name}_m" for name in STATISTICS}, "paper_ape", "Absolute pose error, four statistics",
        f"As the paper's Table 1. {protocol.describe()}.", "Absolute pose error (mm)",
    )  # fmt: skip


def relative_table(board: Board, protocol: Protocol) -> Table | None:
    """Table 2: the same of the protocol's first relative error; None if it has none."""
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
    measures = {
        "accuracy (%)": medians(
            board, lambda row: None if (share := _share(row)) is None else 100 - share
        ),
        "error (%)": medians(board, _share),
        "time (ms)": _frame_times(board),
    }
    if not measures["error (%)"]:
        return None
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
    times = {}
    for key, cells in board.cells.items():
        for name, cell in cells.items():
            rows = [row for row in cell.succeeded if row.computer == board.timing_computer]
            frame_ms = middle(row.frame_ms for row in timed(rows))
            if frame_ms is not None:
                times[key, name] = frame_ms
    return times


def _share(row: RunRow) -> float | None:
    """A run's error in percent of that of a static camera."""
    static_m = row.static_camera_ate_rmse_m
    return (
        None
        if not static_m or row.hold_last_pose_ate_m is None
        else 100 * row.hold_last_pose_ate_m / static_m
    )


def _statistics_table(
    board: Board, metrics: Mapping[str, str], name: str, title: str, source: str, brief: str
) -> Table | None:
    errors = {
        kind: medians(board, lambda row, metric=metric: row.metrics.get(metric))  # type: ignore[misc]
        for kind, metric in metrics.items()
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
    table.caption += f" {LOST_NOTE}" * any(
        cell.text.endswith(LOST_MARK) for row in table.rows for cell in row
    )
    keys = {key for key, _ in errors["rmse"]}
    subject = subject_of(board)
    others = [key for key in board.ranked if key in keys and key != subject]
    if subject not in keys or not others:
        return table
    table.caption += (
        f" Below the line: by how many percent the error of {board.labels[subject]} is smaller than that of "
        "the other tracker."
    )
    table.separators |= {len(table.rows)}

    def gain(other: str, sequence: str, values: Values) -> float | None:
        ours, theirs = values.get((subject, sequence)), values.get((other, sequence))
        return None if ours is None or not theirs else 100 * (theirs - ours) / theirs

    for other in others:
        gains = (
            gain(other, sequence, values)
            for sequence in board.sequences
            for values in errors.values()
        )
        name_cell = TableCell(f"improvement on {board.labels[other]}")
        table.rows.append([name_cell, *(number(percents, ".1f", " %") for percents in gains)])
    return table


def sequence_columns(board: Board, kinds: Sequence[str] = ("",)) -> list[Column]:
    """One column for every sequence, grouped; of several kinds of numbers one for each of them."""
    if len(kinds) == 1:
        return [
            Column(board.short[name], group=board.groups[name], meaning=name, full=name)
            for name in board.sequences
        ]
    return [
        Column(
            STATISTICS.get(kind, kind),
            board.short[name],
            full=f"{name}: {STATISTICS.get(kind, kind)}",
        )
        for name in board.sequences
        for kind in kinds
    ]


def has_lost(cell: Cell) -> bool:
    """Whether frames were lost in a run that succeeded: the errors of the cell are of the tracked ones only."""
    return any(row.incomplete for row in cell.kept if not row.failed)
