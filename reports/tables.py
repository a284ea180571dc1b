"""The report's tables, made of a board."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from statistics import median

import numpy as np

from dynslam_bench.evaluation.protocol import Protocol

from .board import NEVER_MOVE, Board, Cell
from .rows import RunRow
from .statistics import Interval, Standing
from .table import Column, Emphasis, Table, TableCell, emphasise


@dataclass(frozen=True)
class ReportedCell:
    """A published number.

    Attributes:
        system: Its name.
        sequence: Sequence key of the board.
        value: ATE in metres.
        source: Where it was read.
        tag: What kind of number it is.
    """

    system: str
    sequence: str
    value: float
    source: str
    tag: str = "reported"


_PROVENANCE = {
    "own": "this project's own method",
    "faithful-code": "follows the published code",
    "faithful-paper": "follows the paper",
    "inspired": "follows an abstract or a survey; constants are ours",
    "assumed": "identity or rule unknown, assumed",
    "external": "not part of this project",
    "control": "a control, not a system",
}


def leaderboard(board: Board, protocol: Protocol) -> Table:
    """Ranking with intervals, coverage, speed and provenance."""
    columns = [
        Column("#", meaning="rank by the geometric-mean ATE ratio; 95 % bootstrap interval"),
        Column("tracker", numeric=False),
        Column(
            "ATE ratio", meaning=f"geometric mean over sequences of the median ATE over that of {board.reference_name}"
        ),
        Column("mean rank", meaning="mean over sequences of the rank there"),
        Column("P(better)", meaning="probability that a run has a smaller error than one of the reference"),
        Column("p", meaning="paired Wilcoxon test against the reference over sequences, Holm-corrected"),
        Column("coverage", meaning="tracked frames over associated input frames"),
        Column("success", meaning="runs that ended and could be evaluated"),
        Column(
            "× real time",
            meaning="frame interval over mean frame time, above 1 it keeps up; behind it the median frame time, "
            "segmentation included, decoding excluded",
        ),
        Column("MB", meaning="peak resident memory"),
        Column("rows", numeric=False),
        Column("provenance", numeric=False),
    ]
    standings = {standing.key: standing for standing in board.standings}
    marks = emphasise([standings[k].ratio.value if k in board.ranked else None for k in board.trackers])
    rows, muted = [], set()
    for position, key in enumerate(board.trackers):
        runs = board.runs(key)
        standing = standings.get(key)
        if key not in board.ranked:
            muted.add(position)
        rows.append([*_standing_cells(board, key, standing, marks[position]), *_run_cells(runs)])
    imputed = sum(cell.imputed for cells in board.cells.values() for cell in cells.values())
    total = sum(len(cell.rows) for cells in board.cells.values() for cell in cells.values())
    caption = (
        f"{protocol.describe()}. ATE ratio: geometric mean over {_count(len(board.sequences), 'sequence')} of the "
        f"median ATE over that of {board.reference_name}; below 1 is better. Brackets: 95 % bootstrap intervals over "
        f"runs and sequences. A run that failed or was lost counts as a camera that never moves ({imputed} of {total} "
        "runs; their number stands in parentheses in the next table). Grey rows are shown but not ranked: controls, "
        "inspired or assumed re-implementations, and trackers that lack sequences."
    )
    table = Table("leaderboard", "Leaderboard", caption, columns, rows, muted)
    if board.ranked and len(board.ranked) < len(rows):
        table.separators.add(len(board.ranked))
    return table


def per_sequence(board: Board, protocol: Protocol, reported: Sequence[ReportedCell] = ()) -> Table:
    """Median ATE of every tracker on every sequence, with spread, number of runs and imputed ones."""
    columns = [Column("tracker", numeric=False), *sequence_columns(board)]
    sizes = Counter(len(cell.scores) for found in board.cells.values() for cell in found.values())
    usual = sizes.most_common(1)[0][0]
    medians = {
        key: [_competing(board.cells[key].get(sequence)) for sequence in board.sequences] for key in board.trackers
    }
    marks: dict[str, list[Emphasis]] = {key: [""] * len(board.sequences) for key in board.trackers}
    for at in range(len(board.sequences)):
        for key, mark in zip(board.ranked, emphasise([medians[key][at] for key in board.ranked]), strict=True):
            marks[key][at] = mark
    rows, muted, separators = [], set(), set()
    for position, key in enumerate(board.trackers):
        if key not in board.ranked:
            muted.add(position)
        cells = [TableCell(board.labels[key], tag=_kind_tag(board, key))]
        for at, sequence in enumerate(board.sequences):
            cells.append(_error_cell(board, board.cells[key].get(sequence), sequence, marks[key][at], usual))
        rows.append(cells)
    if 0 < len(board.ranked) < len(rows):
        separators.add(len(board.ranked))
    separators.add(len(rows))
    rows.append([TableCell(NEVER_MOVE), *(_never_cell(board, sequence) for sequence in board.sequences)])
    muted.add(len(rows) - 1)
    if reported:
        separators.add(len(rows))
        for name, tag in dict.fromkeys((cell.system, cell.tag) for cell in reported):
            muted.add(len(rows))
            found = [cell for cell in reported if (cell.system, cell.tag) == (name, tag)]
            rows.append([TableCell(name, tag=tag), *_reported_cells(board, found)])
    caption = (
        f"Median ATE (RMSE, metres) over the runs of a cell ({usual} unless n says otherwise), behind it half the "
        "interquartile range of several runs, and in parentheses how many failed and count as a camera that never "
        f"moves. Colour: ratio to {board.reference_name}, from green (a quarter or less) to red (four times or more). "
        f"Bold best, italic second among ranked trackers. {_names_note(board)}{protocol.describe()}."
    )
    if reported:
        caption += (
            " Rows marked 'reported' are published numbers, not runs: their protocol is stated by their source only. "
            "Rows marked 'claimed by the paper' are the implemented paper's own, which contradict themselves (see "
            "the audit)."
        )
    return Table("per_sequence", "Absolute trajectory error by sequence", caption, columns, rows, muted, separators)


def relative_errors(board: Board, protocol: Protocol) -> list[Table]:
    """One table for each relative error of the protocol and each of its parts."""
    tables = []
    for spec in protocol.rpe:
        for part, unit, name in (("trans", "m", "translation"), ("rot", "deg", "rotation")):
            metric = f"rpe_{spec.key}_{part}_rmse_{unit}"
            per = {"s": "/s", "f": " per frame"}.get(spec.unit, "") if spec.delta == 1 else ""
            unit_text = ("m" if unit == "m" else "°") + per
            table = metric_table(
                board,
                lambda row, metric=metric: row.metrics.get(metric),  # type: ignore[misc]
                f"rpe_{spec.key}_{part}",
                f"Relative pose error over {spec.describe()}: {name}",
                f"RMSE in {unit_text}, median over the runs that could be evaluated (failures have none). "
                f"{protocol.describe()}.",
                digits=4 if unit == "m" else 3,
            )
            if table is not None:
                tables.append(table)
    return tables


def metric_table(
    board: Board,
    value: Callable[[RunRow], float | None],
    name: str,
    title: str,
    caption: str,
    *,
    digits: int = 4,
    larger_is_better: bool = False,
) -> Table | None:
    """Median of any number of the rows by tracker and sequence; None if no row has it."""
    sign = -1.0 if larger_is_better else 1.0
    rows, muted = [], set()
    found: dict[str, list[float | None]] = {}
    for key in board.trackers:
        found[key] = []
        for sequence in board.sequences:
            cell = board.cells[key].get(sequence)
            values = [v for row in cell.rows if (v := value(row)) is not None] if cell else []
            found[key].append(median(values) if values else None)
    if not any(v is not None for values in found.values() for v in values):
        return None
    marks = [
        emphasise([None if (v := found[key][at]) is None else sign * v for key in board.ranked])
        for at in range(len(board.sequences))
    ]
    present = [key for key in board.trackers if any(number is not None for number in found[key])]
    for position, key in enumerate(present):
        ranked = key in board.ranked
        if not ranked:
            muted.add(position)
        cells = [TableCell(board.labels[key])]
        for at, number in enumerate(found[key]):
            mark: Emphasis = marks[at][board.ranked.index(key)] if ranked else ""
            cells.append(
                TableCell() if number is None else TableCell(f"{number:.{digits}f}", value=number, emphasis=mark)
            )
        rows.append(cells)
    columns = [Column("tracker", numeric=False), *sequence_columns(board)]
    competing = sum(key in board.ranked for key in present)
    separators = {competing} if 0 < competing < len(rows) else set()
    return Table(name, title, caption, columns, rows, muted, separators)


def _standing_cells(board: Board, key: str, standing: Standing | None, mark: Emphasis) -> list[TableCell]:
    name = TableCell(board.labels[key], tip=board.first(key).tracker)
    if standing is None:
        return [TableCell("–"), name, *[TableCell() for _ in range(4)]]
    ratio = interval_cell(standing.ratio, ".2f")
    partial = f" on {standing.sequences} of {len(board.sequences)}" if key in board.incomplete else ""
    ratio = TableCell(ratio.text, ratio.small + partial, ratio.value, mark)
    is_reference = key == board.reference
    return [
        rank_cell(standing),
        name,
        ratio,
        number_cell(standing.mean_rank, ".2f"),
        TableCell("reference") if is_reference else interval_cell(standing.improvement, ".2f"),
        TableCell() if is_reference else number_cell(standing.p_value, ".3f"),
    ]


def _run_cells(runs: Sequence[RunRow]) -> list[TableCell]:
    coverage = float(np.mean([row.coverage for row in runs]))
    success = float(np.mean([not row.failed for row in runs]))
    ended = [row for row in runs if not row.failed]
    kinds = " + ".join(f"{count} {kind}" for kind, count in Counter(row.kind for row in runs).items())
    provenance = runs[0].provenance
    masks = " + ".join(sorted({row.segmentation for row in runs if row.segmentation not in ("", "none")}))
    return [
        TableCell(f"{100 * coverage:.1f} %", value=coverage),
        TableCell(f"{100 * success:.0f} %", value=success),
        _speed_cell(_middle(row.real_time_factor for row in ended), _middle(row.frame_ms for row in ended)),
        number_cell(_middle(row.peak_memory_mb for row in ended), ".0f"),
        TableCell(tag=kinds),
        TableCell(provenance, f"{masks} masks" if masks else "", tip=_PROVENANCE.get(provenance, "")),
    ]


def _speed_cell(factor: float | None, frame_ms: float | None) -> TableCell:
    small = "" if frame_ms is None else f"{frame_ms:.1f} ms"
    if factor is None:
        return TableCell(small=small)
    return TableCell(f"{factor:.2f}" if factor < 100 else f"{factor:.0f}", small, factor)


def rank_cell(standing: Standing) -> TableCell:
    """A rank with its interval."""
    if standing.rank is None:
        return TableCell("–")
    low, high = standing.rank.low, standing.rank.high
    return TableCell(f"{standing.rank.value:.0f}", f"[{low:.0f}–{high:.0f}]", standing.rank.value)


def interval_cell(interval: Interval, digits: str) -> TableCell:
    """A value with its interval."""
    return TableCell(
        f"{interval.value:{digits}}", f"[{interval.low:{digits}}, {interval.high:{digits}}]", interval.value
    )


def _error_cell(board: Board, cell: Cell | None, sequence: str, mark: Emphasis, usual: int) -> TableCell:
    if cell is None or cell.median is None:
        return TableCell("–" if cell is None else "", emphasis="muted", tip="not run" if cell is None else "")
    scores = cell.scores
    small = "" if len(scores) == usual else f"n={len(scores)}"
    if len(scores) > 1:
        low, high = np.percentile(scores, [25, 75])
        small = f"±{(high - low) / 2:.4f} {small}".strip()
    if cell.imputed:
        small = f"{small} ({cell.imputed})".strip()
    coverage = float(np.mean([row.coverage for row in cell.rows]))
    ratio = cell.median / max(board.reference_median(sequence), 1e-6)
    return TableCell(
        f"{cell.median:.4f}", small, cell.median, mark, shade=shade(ratio),
        tip=f"{ratio:.2f} × the reference, coverage {100 * coverage:.1f} %",
    )  # fmt: skip


def _never_cell(board: Board, sequence: str) -> TableCell:
    value = board.never_move[sequence]
    ratio = value / max(board.reference_median(sequence), 1e-6)
    return TableCell(f"{value:.4f}", value=value, shade=shade(ratio), tip=f"{ratio:.2f} × the reference")


def _reported_cells(board: Board, reported: Sequence[ReportedCell]) -> list[TableCell]:
    cells = []
    for sequence in board.sequences:
        found = [cell for cell in reported if cell.sequence == sequence]
        cells.append(
            TableCell(f"{found[0].value:.4f}", value=found[0].value, tip=found[0].source) if found else TableCell()
        )
    return cells


def shade(ratio: float) -> float:
    """-1 at a quarter of the reference's error or less, 0 at the same, 1 at four times or more."""
    return float(np.clip(np.log(max(ratio, 1e-9)) / np.log(4), -1, 1))


def sequence_columns(board: Board) -> list[Column]:
    """One column for every sequence, grouped."""
    return [Column(board.short[name], group=board.groups[name], meaning=name, full=name) for name in board.sequences]


def _kind_tag(board: Board, key: str) -> str:
    return "imported" if board.first(key).kind == "imported" else ""


def _names_note(board: Board) -> str:
    """What the shortened headings stand for; empty where they are whole."""
    first = board.sequences[0]
    return "" if board.short[first] == first else f"'{board.short[first]}' stands for {first}, and so on. "


def _competing(cell: Cell | None) -> float | None:
    """The median of a cell that holds more than failures."""
    return None if cell is None or cell.imputed == len(cell.scores) else cell.median


def _middle(values: Iterable[float | None]) -> float | None:
    present = [value for value in values if value is not None]
    return median(present) if present else None


def number_cell(value: float | None, digits: str = "") -> TableCell:
    """A number, written with a format specification or with all its digits; an empty cell for None."""
    return TableCell() if value is None else TableCell(format(value, digits) if digits else repr(value), value=value)


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}{'s' if number != 1 else ''}"
