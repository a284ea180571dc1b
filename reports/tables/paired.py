"""The table of two sets of results against each other."""

from __future__ import annotations

from collections.abc import Sequence
from statistics import median

from ..model.pairing import Paired
from ..model.statistics import FEWEST, Interval
from .formats import mm
from .leaderboard import interval_cell
from .table import Column, Table, TableCell, number, numbers, texts


def paired_table(title: str, caption: str, found: Sequence[tuple[str, Sequence[Paired], Interval]]) -> Table:
    """Every tracker and sequence with both medians, and one line a tracker over all sequences.

    Args:
        title: Heading.
        caption: Protocol and what differs; how to read the numbers is added.
        found: Trackers with their pairs and the geometric mean of the ratios.
    """
    rows: list[list[TableCell]] = []
    separators = set()
    for name, pairs, overall in found:
        if rows:
            separators.add(len(rows))
        rows += [_row(name, paired) for paired in pairs]
        rows.append(_overall_row(name, overall, sum(paired.ratio < 1 for paired in pairs), len(pairs)))
    columns = [*texts("tracker", "sequence"), *numbers("ATE A", "ATE B", "B / A"), Column("verdict", numeric=False)]
    columns += numbers("coverage A", "coverage B", "runs")
    return Table("paired", title, caption, columns, rows, separators=separators)


def _row(name: str, paired: Paired) -> list[TableCell]:
    before, after = median(paired.scores_a), median(paired.scores_b)
    return [
        TableCell(name),
        TableCell(paired.sequence),
        TableCell(mm(before), value=before),
        TableCell(mm(after), value=after),
        number(paired.ratio, ".3f"),
        TableCell(),
        TableCell(f"{100 * paired.coverage_a:.1f} %", value=paired.coverage_a),
        TableCell(f"{100 * paired.coverage_b:.1f} %", value=paired.coverage_b),
        TableCell(f"{len(paired.scores_a)} + {len(paired.scores_b)}"),
    ]


def _overall_row(name: str, ratio: Interval, wins: int, sequences: int) -> list[TableCell]:
    cells = [TableCell(name), TableCell(f"all {sequences} sequences"), TableCell(), TableCell()]
    cells += [interval_cell(ratio, ".3f", "best"), TableCell(_verdict(ratio, wins, sequences))]
    return [*cells, *[TableCell()] * 3]


def _verdict(ratio: Interval, wins: int, sequences: int) -> str:
    if sequences < FEWEST:
        return "equal" if ratio.value == 1 else f"B better on {wins} of {sequences}, too few to tell"
    if ratio.high < 1:
        return "better"
    if ratio.low > 1:
        return "worse"
    return "no difference shown"
