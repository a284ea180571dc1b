"""Two sets of results against each other: before and after a change of the code, or of the settings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from operator import itemgetter
from pathlib import Path

import numpy as np

from dynslam_bench.core.errors import ReportError
from dynslam_bench.core.toml import setting_text
from dynslam_bench.evaluation.protocol import Protocol, get_protocol
from dynslam_bench.reports.model.board import Cell, make_cell
from dynslam_bench.reports.model.load import check_one_protocol, load_runs, open_stores
from dynslam_bench.reports.model.names import make_labels, name_columns
from dynslam_bench.reports.model.row import REPORT_FILE, SEEN, ReportData, RunRow, grouped
from dynslam_bench.reports.model.statistics import FEWEST, FLOOR_M, Interval, ratio_interval
from dynslam_bench.reports.tables.leaderboard import interval_cell
from dynslam_bench.reports.tables.table import Table, TableCell, mm, number, numbers, texts, to_csv, to_markdown
from dynslam_bench.runs.store import RunStore


@dataclass(frozen=True)
class Comparison:
    """What changed from A to B.

    Attributes:
        overall: Tracker and what differs to the geometric mean over sequences of B's median ATE over A's; with an
            interval from `FEWEST` sequences on.
        table: Every tracker and sequence with both medians.
        only_a: Runs that only A has.
        only_b: Runs that only B has.
        differences: Tracker, as in `overall`, to the settings that differ, e.g. ``epipolar.threshold_px: default in A,
            2 in B``; empty where the settings are the same.
    """

    overall: dict[str, Interval]
    table: Table
    only_a: int
    only_b: int
    differences: dict[str, list[str]]

    def to_markdown(self) -> str:
        """The comparison as Markdown."""
        return to_markdown(self.table)

    def to_csv(self) -> str:
        """The comparison as CSV."""
        return to_csv(self.table)


def compare(
    a: Path | str | RunStore, b: Path | str | RunStore, *, protocol: Protocol | str = "tum-rgbd/v1"
) -> Comparison:
    """Compare two results folders, or two reports, on the sequences that both have.

    A tracker with the same settings on both sides is compared with itself. Settings that only one side has are compared
    with those of the same tracker that only the other has and that differ in the fewest values.

    Args:
        a: Results folder, store, or folder of a report (``report.json``).
        b: Likewise.
        protocol: How results folders are evaluated; a report brings its own.

    Raises:
        ReportError: One holds no runs, nothing is in both, or their numbers stem from different protocols.
    """
    protocol = get_protocol(protocol)
    rows_a, rows_b = _rows(a, protocol), _rows(b, protocol)
    check_one_protocol([*rows_a, *rows_b])
    side_a, side_b = make_side(rows_a), make_side(rows_b)
    pairs = pair_variants(side_a, side_b)
    if not pairs:
        raise ReportError(
            f"{_name(a)} ({len(rows_a)} runs) and {_name(b)} ({len(rows_b)} runs) have no tracker and sequence in "
            "common",
            "compare results of the same suite",
        )
    columns = name_columns([*rows_a, *rows_b])
    compared: dict[str, list[Paired]] = {}
    changed: dict[str, list[str]] = {}
    for (one, other), name in _labels(pairs, side_a, side_b).items():
        paired = pair_errors(side_a[one], side_b[other], columns)
        if paired:
            compared[name] = paired
            changed[name] = _differences(_first(side_a, one), _first(side_b, other))
    if not compared:
        raise ReportError("none of the runs in common has ground truth", "nothing can be compared")
    overall = {name: ratio_interval(np.log([ratio_of(*pair) for pair in paired])) for name, paired in compared.items()}
    caption = _caption(rows_a[0].protocol_id if _report_file(a) else protocol.describe(), changed)
    return Comparison(
        overall=overall,
        table=_table(f"{_name(a)} (A) against {_name(b)} (B)", caption, compared, overall),
        only_a=_unpaired(rows_a, side_a, side_b, pairs),
        only_b=_unpaired(rows_b, side_b, side_a, [(other, one) for one, other in pairs]),
        differences=changed,
    )


def _caption(protocol: str, differences: Mapping[str, list[str]]) -> str:
    changed = [f"{name}: {', '.join(words)}" for name, words in differences.items() if words]
    return (
        f"{protocol}. Median ATE (millimetres), lost frames held, over the repeats that both have, or all where they "
        "share none; failures count as a static camera, or worse. B / A below 1: B is better. Brackets: "
        f"Student's 95 % interval over sequences, from {FEWEST} of them on."
    ) + (f" What differs: {'; '.join(changed)}." if changed else " The settings are the same.")


def _rows(source: Path | str | RunStore, protocol: Protocol) -> list[RunRow]:
    report = _report_file(source)
    if report is not None:
        return ReportData.read(report).rows
    stores = open_stores(source if isinstance(source, RunStore) else [Path(source)])
    return load_runs(stores, protocol, trials=True).rows


def _report_file(source: Path | str | RunStore) -> Path | None:
    """The data of a report; None for a results folder."""
    if isinstance(source, RunStore):
        return None
    path = Path(source).expanduser()
    return next((file for file in (path, path / REPORT_FILE) if file.is_file()), None)


def _name(source: Path | str | RunStore) -> str:
    return str(source.root if isinstance(source, RunStore) else source)


Side = dict[str, dict[str, list[RunRow]]]
"""Variant key to column id to the runs."""
Paired = tuple[str, Cell, Cell]
"""A sequence, with `SEEN` behind it if a side's network was trained on it, and one tracker's runs on both sides."""


def make_side(rows: Sequence[RunRow]) -> Side:
    """Rows by variant and column."""
    variants = grouped(rows, lambda row: row.variant_key)
    return {key: grouped(of_key, lambda row: row.column_id) for key, of_key in variants.items()}


def pair_variants(a: Side, b: Side) -> list[tuple[str, str]]:
    """Variants of A and B that share a column: equal ones, then those that differ least, each at most once."""
    pairs = [(key, key) for key in a if key in b]
    candidates = []
    for one, other in product((key for key in a if key not in b), (key for key in b if key not in a)):
        first, second = _first(a, one), _first(b, other)
        if (first.tracker.id, first.kind) == (second.tracker.id, second.kind) and set(a[one]) & set(b[other]):
            candidates.append((len(_differences(first, second)), one, other))
    for _, one, other in sorted(candidates):
        if all(one != pair[0] and other != pair[1] for pair in pairs):
            pairs.append((one, other))
    return [(one, other) for one, other in pairs if set(a[one]) & set(b[other])]


def _first(side: Side, key: str) -> RunRow:
    return next(iter(side[key].values()))[0]


def _differences(first: RunRow, second: RunRow) -> list[str]:
    """The settings that set a variant of A apart from one of B, in words."""
    words = []
    for name in sorted({*first.variant, *second.variant}):
        if first.variant.get(name) != second.variant.get(name):
            before, after = (setting_text(row.variant.get(name, "default")) for row in (first, second))
            words.append(f"{name}: {before} in A, {after} in B")
    return words


def _labels(pairs: Sequence[tuple[str, str]], a: Side, b: Side) -> dict[tuple[str, str], str]:
    """The label of A's variant, with that of B's where they differ."""
    sides = [side[key] for one, other in pairs for side, key in ((a, one), (b, other))]
    names = make_labels([row for columns in sides for rows in columns.values() for row in rows])
    return {(one, other): names[one] if one == other else f"{names[one]} → {names[other]}" for one, other in pairs}


def pair_errors(
    a: Mapping[str, list[RunRow]], b: Mapping[str, list[RunRow]], columns: Mapping[str, str]
) -> list[Paired]:
    """Both sides on every sequence that both have and have scores on: of the repeats that both have, if any."""
    paired = []
    for column in set(a) & set(b):
        repeats = {row.repeat_key for row in a[column]} & {row.repeat_key for row in b[column]}
        cells = [
            make_cell([row for row in side if row.repeat_key in repeats] or side) for side in (a[column], b[column])
        ]
        if cells[0].scores and cells[1].scores:
            name = columns[column] + f" {SEEN}" * (cells[0].in_training or cells[1].in_training)
            paired.append((name, cells[0], cells[1]))
    return sorted(paired, key=itemgetter(0))


def ratio_of(_: str, a: Cell, b: Cell) -> float:
    """B's median error over A's."""
    return max(b.median or 0.0, FLOOR_M) / max(a.median or 0.0, FLOOR_M)


def _unpaired(rows: Sequence[RunRow], side: Side, other: Side, pairs: Sequence[tuple[str, str]]) -> int:
    """How many rows of one side take part in no pair; pairs name the variant of this side first."""
    used = {(one, column) for one, another in pairs for column in set(side[one]) & set(other[another])}
    return sum((row.variant_key, row.column_id) not in used for row in rows)


def _table(
    title: str, caption: str, compared: Mapping[str, Sequence[Paired]], overall: Mapping[str, Interval]
) -> Table:
    """Every tracker and sequence with both medians, and one line a tracker over all sequences."""
    rows: list[list[TableCell]] = []
    separators = set()
    for name, paired in compared.items():
        separators.add(len(rows))
        for sequence, *sides in paired:
            coverages = [sum(row.coverage for row in cell.rows) / len(cell.rows) for cell in sides]
            rows.append(
                [
                    TableCell(name),
                    TableCell(sequence),
                    *(TableCell(mm(cell.median or 0.0), value=cell.median) for cell in sides),
                    number(ratio_of(sequence, *sides), ".3f"),
                    TableCell(),
                    *(TableCell(f"{100 * coverage:.1f} %", value=coverage) for coverage in coverages),
                    TableCell(" + ".join(str(len(cell.scores)) for cell in sides)),
                ]
            )
        wins = sum(ratio_of(*pair) < 1 for pair in paired)
        ratio = interval_cell(overall[name], ".3f", "best")
        verdict = TableCell(_verdict(overall[name], wins, len(paired)))
        empty = TableCell()
        rows.append(
            [TableCell(name), TableCell(f"all {len(paired)} sequences"), empty, empty, ratio, verdict, *[empty] * 3]
        )
    columns = [*texts("tracker", "sequence"), *numbers("ATE A", "ATE B", "B / A"), *texts("verdict")]
    columns += numbers("coverage A", "coverage B", "runs")
    return Table("paired", title, caption, columns, rows, separators=separators - {0})


def _verdict(ratio: Interval, wins: int, sequences: int) -> str:
    if sequences < FEWEST:
        return "equal" if ratio.value == 1 else f"B better on {wins} of {sequences}, too few to tell"
    return "better" if ratio.high < 1 else "worse" if ratio.low > 1 else "no difference shown"
