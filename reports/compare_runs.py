"""Two sets of results against each other: before and after a change of the code, or of the settings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from statistics import median

import numpy as np

from dynslam_bench.core.errors import ReportError
from dynslam_bench.evaluation.protocol import Protocol, get_protocol
from dynslam_bench.runs.storage.store import RunStore

from .model.cell import make_cell
from .model.columns import name_columns
from .model.labels import make_labels
from .model.report_data import REPORT_FILE, ReportData
from .model.row import RunRow
from .model.rows import check_one_protocol, load_runs, open_stores
from .model.statistics import FEWEST, Interval, ratio_interval
from .tables.formats import mm
from .tables.table import Column, Table, TableCell, to_csv, to_markdown

Side = dict[str, dict[str, list[RunRow]]]
"""Variant key to column id to the runs."""


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
    side_a, side_b = _side(rows_a), _side(rows_b)
    pairs = [pair for pair in _pairs(side_a, side_b) if set(side_a[pair[0]]) & set(side_b[pair[1]])]
    if not pairs:
        raise ReportError(
            f"{_name(a)} ({len(rows_a)} runs) and {_name(b)} ({len(rows_b)} runs) have no tracker and sequence in "
            "common",
            "compare results of the same suite",
        )
    columns = name_columns([*rows_a, *rows_b])
    labels = _labels(pairs, side_a, side_b)
    overall: dict[str, Interval] = {}
    differences: dict[str, list[str]] = {}
    rows: list[list[TableCell]] = []
    separators = set()
    for pair in pairs:
        scored = _scored(side_a[pair[0]], side_b[pair[1]], columns)
        if not scored:
            continue
        name = labels[pair]
        overall[name] = ratio_interval(np.log([_ratio(*found[:2]) for found in scored.values()]))
        differences[name] = _differences(side_a, side_b, *pair)
        if rows:
            separators.add(len(rows))
        rows += [_row(name, sequence, *found) for sequence, found in sorted(scored.items())]
        wins = sum(_ratio(*found[:2]) < 1 for found in scored.values())
        rows.append(_overall_row(name, overall[name], wins, len(scored)))
    if not overall:
        raise ReportError("none of the runs in common has ground truth", "nothing can be compared")
    table = _table(a, b, rows_a[0].protocol_id if _is_report(a) else protocol.describe(), differences, rows, separators)
    used_a = {(va, column) for va, vb in pairs for column in set(side_a[va]) & set(side_b[vb])}
    used_b = {(vb, column) for va, vb in pairs for column in set(side_a[va]) & set(side_b[vb])}
    only_a = sum((row.variant_key, row.column_id) not in used_a for row in rows_a)
    only_b = sum((row.variant_key, row.column_id) not in used_b for row in rows_b)
    return Comparison(overall, table, only_a, only_b, differences)


def _table(
    a: Path | str | RunStore,
    b: Path | str | RunStore,
    protocol: str,
    differences: Mapping[str, list[str]],
    rows: list[list[TableCell]],
    separators: set[int],
) -> Table:
    columns = [
        Column("tracker", numeric=False), Column("sequence", numeric=False), Column("ATE A"), Column("ATE B"),
        Column("B / A"), Column("verdict", numeric=False), Column("coverage A"), Column("coverage B"), Column("runs"),
    ]  # fmt: skip
    caption = (
        f"{protocol}. Median ATE (millimetres), lost frames held, over the repeats that both have, or all where they "
        "share none; failures count as a camera that never moves, or worse. B / A below 1: B is better. Brackets: "
        f"Student's 95 % interval over sequences, from {FEWEST} of them on."
    )
    changed = [f"{name}: {', '.join(words)}" for name, words in differences.items() if words]
    caption += f" What differs: {'; '.join(changed)}." if changed else " The settings are the same."
    return Table("paired", f"{_name(a)} (A) against {_name(b)} (B)", caption, columns, rows, separators=separators)


def _rows(source: Path | str | RunStore, protocol: Protocol) -> list[RunRow]:
    if not isinstance(source, RunStore) and _is_report(source):
        path = Path(source).expanduser()
        return ReportData.read(path if path.is_file() else path / REPORT_FILE).rows
    return [
        run.row
        for run in load_runs(open_stores(source if isinstance(source, RunStore) else [Path(source)]), protocol).runs
    ]


def _is_report(source: Path | str | RunStore) -> bool:
    if isinstance(source, RunStore):
        return False
    path = Path(source).expanduser()
    return path.is_file() or (path / REPORT_FILE).is_file()


def _side(rows: Sequence[RunRow]) -> Side:
    found: Side = {}
    for row in rows:
        found.setdefault(row.variant_key, {}).setdefault(row.column_id, []).append(row)
    return found


def _pairs(a: Side, b: Side) -> list[tuple[str, str]]:
    """Variants of A and B that are compared: equal ones, then those that differ least, each at most once."""
    pairs = [(key, key) for key in a if key in b]
    left = [key for key in a if key not in b], [key for key in b if key not in a]
    candidates = []
    for one, other in product(*left):
        first, second = _first(a, one), _first(b, other)
        if first.tracker == second.tracker and first.kind == second.kind and set(a[one]) & set(b[other]):
            candidates.append((len(_differing(first, second)), one, other))
    for _, one, other in sorted(candidates):
        if all(one != pair[0] and other != pair[1] for pair in pairs):
            pairs.append((one, other))
    return pairs


def _first(side: Side, key: str) -> RunRow:
    return next(iter(side[key].values()))[0]


def _differing(a: RunRow, b: RunRow) -> list[str]:
    names = sorted({*a.variant, *b.variant})
    return [name for name in names if a.variant.get(name) != b.variant.get(name)]


def _differences(a: Side, b: Side, one: str, other: str) -> list[str]:
    first, second = _first(a, one), _first(b, other)
    words = []
    for name in _differing(first, second):
        before, after = first.variant.get(name, "default"), second.variant.get(name, "default")
        words.append(f"{name}: {before} in A, {after} in B")
    return words


def _labels(pairs: Sequence[tuple[str, str]], a: Side, b: Side) -> dict[tuple[str, str], str]:
    """The label of A's variant, with that of B's where they differ."""
    names = make_labels([row for one, other in pairs for row in (_first(a, one), _first(b, other))])
    return {(one, other): names[one] if one == other else f"{names[one]} → {names[other]}" for one, other in pairs}


def _scored(
    a: Mapping[str, list[RunRow]], b: Mapping[str, list[RunRow]], columns: Mapping[str, str]
) -> dict[str, tuple[list[float], list[float], float, float]]:
    """Errors and coverage of both sides on every sequence that both have: of the repeats that both have, if any."""
    found = {}
    for column in set(a) & set(b):
        repeats = {row.repeat_key for row in a[column]} & {row.repeat_key for row in b[column]}
        sides = [[row for row in side if row.repeat_key in repeats] or side for side in (a[column], b[column])]
        scores = [list(make_cell(side).scores) for side in sides]
        coverage = [sum(row.coverage for row in side) / len(side) for side in sides]
        if scores[0] and scores[1]:
            found[columns[column]] = (scores[0], scores[1], coverage[0], coverage[1])
    return found


def _ratio(before: Sequence[float], after: Sequence[float]) -> float:
    return float(max(median(after), 1e-6) / max(median(before), 1e-6))


def _row(
    name: str, sequence: str, before: list[float], after: list[float], coverage_a: float, coverage_b: float
) -> list[TableCell]:
    ratio = _ratio(before, after)
    return [
        TableCell(name),
        TableCell(sequence),
        TableCell(mm(median(before)), value=median(before)),
        TableCell(mm(median(after)), value=median(after)),
        TableCell(f"{ratio:.3f}", value=ratio),
        TableCell(),
        TableCell(f"{100 * coverage_a:.1f} %", value=coverage_a),
        TableCell(f"{100 * coverage_b:.1f} %", value=coverage_b),
        TableCell(f"{len(before)} + {len(after)}"),
    ]


def _overall_row(name: str, ratio: Interval, wins: int, sequences: int) -> list[TableCell]:
    small = f"[{ratio.low:.3f}, {ratio.high:.3f}]" if sequences >= FEWEST else ""
    return [
        TableCell(name),
        TableCell(f"all {sequences} sequences"),
        TableCell(),
        TableCell(),
        TableCell(f"{ratio.value:.3f}", small, ratio.value, emphasis="best"),
        TableCell(_verdict(ratio, wins, sequences)),
        *[TableCell()] * 3,
    ]


def _verdict(ratio: Interval, wins: int, sequences: int) -> str:
    if sequences < FEWEST:
        return "equal" if ratio.value == 1 else f"B better on {wins} of {sequences}, too few to tell"
    if ratio.high < 1:
        return "better"
    if ratio.low > 1:
        return "worse"
    return "no difference shown"


def _name(source: Path | str | RunStore) -> str:
    return str(source.root if isinstance(source, RunStore) else source)
