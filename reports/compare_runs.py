"""Two sets of results against each other: before and after a change of the code, or of the settings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from statistics import median

import numpy as np

from dynslam_bench.core.errors import ReportError
from dynslam_bench.core.toml import setting_text
from dynslam_bench.evaluation.protocol import Protocol, get_protocol
from dynslam_bench.reports.model.board import make_cell
from dynslam_bench.reports.model.load import check_one_protocol, load_runs, open_stores
from dynslam_bench.reports.model.names import make_labels, name_columns
from dynslam_bench.reports.model.row import REPORT_FILE, SEEN, ReportData, RunRow
from dynslam_bench.reports.model.statistics import FEWEST, FLOOR_M, Interval, ratio_interval
from dynslam_bench.reports.tables.leaderboard import interval_cell
from dynslam_bench.reports.tables.table import Column, Table, TableCell, mm, number, numbers, texts, to_csv, to_markdown
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
    found = []
    changed: dict[str, list[str]] = {}
    for (one, other), name in label_pairs(pairs, side_a, side_b).items():
        paired = pair_errors(side_a[one], side_b[other], columns)
        if paired:
            found.append((name, paired, ratio_interval(np.log([each.ratio for each in paired]))))
            changed[name] = differences(side_a, side_b, one, other)
    if not found:
        raise ReportError("none of the runs in common has ground truth", "nothing can be compared")
    caption = _caption(rows_a[0].protocol_id if _is_report(a) else protocol.describe(), changed)
    return Comparison(
        overall={name: ratio for name, _, ratio in found},
        table=paired_table(f"{_name(a)} (A) against {_name(b)} (B)", caption, found),
        only_a=unpaired(rows_a, side_a, side_b, pairs),
        only_b=unpaired(rows_b, side_b, side_a, [(other, one) for one, other in pairs]),
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
    if not isinstance(source, RunStore) and _is_report(source):
        path = Path(source).expanduser()
        return ReportData.read(path if path.is_file() else path / REPORT_FILE).rows
    stores = open_stores(source if isinstance(source, RunStore) else [Path(source)])
    return [run.row for run in load_runs(stores, protocol, trials=True).runs]


def _is_report(source: Path | str | RunStore) -> bool:
    if isinstance(source, RunStore):
        return False
    path = Path(source).expanduser()
    return path.is_file() or (path / REPORT_FILE).is_file()


def _name(source: Path | str | RunStore) -> str:
    return str(source.root if isinstance(source, RunStore) else source)


# Which runs of two sets of results are compared with each other, and what sets them apart.

Side = dict[str, dict[str, list[RunRow]]]
"""Variant key to column id to the runs."""


@dataclass(frozen=True)
class Paired:
    """One tracker on one sequence, on both sides.

    Attributes:
        sequence: Name of the sequence, with `SEEN` behind it if a side's network was trained on it.
        scores_a: Errors of A in metres, a run each.
        scores_b: Likewise of B.
        coverage_a: Mean coverage of A.
        coverage_b: Likewise of B.
    """

    sequence: str
    scores_a: tuple[float, ...]
    scores_b: tuple[float, ...]
    coverage_a: float
    coverage_b: float

    @property
    def ratio(self) -> float:
        """B's median error over A's."""
        return float(max(median(self.scores_b), FLOOR_M) / max(median(self.scores_a), FLOOR_M))


def make_side(rows: Sequence[RunRow]) -> Side:
    """Rows by variant and column."""
    found: Side = {}
    for row in rows:
        found.setdefault(row.variant_key, {}).setdefault(row.column_id, []).append(row)
    return found


def pair_variants(a: Side, b: Side) -> list[tuple[str, str]]:
    """Variants of A and B that share a column: equal ones, then those that differ least, each at most once."""
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
    return [(one, other) for one, other in pairs if set(a[one]) & set(b[other])]


def differences(a: Side, b: Side, one: str, other: str) -> list[str]:
    """The settings that set a variant of A apart from one of B, in words."""
    first, second = _first(a, one), _first(b, other)
    words = []
    for name in _differing(first, second):
        before, after = first.variant.get(name, "default"), second.variant.get(name, "default")
        words.append(f"{name}: {setting_text(before)} in A, {setting_text(after)} in B")
    return words


def label_pairs(pairs: Sequence[tuple[str, str]], a: Side, b: Side) -> dict[tuple[str, str], str]:
    """The label of A's variant, with that of B's where they differ."""
    sides = [side[key] for one, other in pairs for side, key in ((a, one), (b, other))]
    names = make_labels([row for columns in sides for rows in columns.values() for row in rows])
    return {(one, other): names[one] if one == other else f"{names[one]} → {names[other]}" for one, other in pairs}


def pair_errors(
    a: Mapping[str, list[RunRow]], b: Mapping[str, list[RunRow]], columns: Mapping[str, str]
) -> list[Paired]:
    """Both sides on every sequence that both have and have scores on: of the repeats that both have, if any."""
    found = []
    for column in set(a) & set(b):
        repeats = {row.repeat_key for row in a[column]} & {row.repeat_key for row in b[column]}
        sides = [[row for row in side if row.repeat_key in repeats] or side for side in (a[column], b[column])]
        scores = [make_cell(side).scores for side in sides]
        coverage = [sum(row.coverage for row in side) / len(side) for side in sides]
        if scores[0] and scores[1]:
            name = columns[column] + f" {SEEN}" * any(row.seen_in_training for side in sides for row in side)
            found.append(Paired(name, scores[0], scores[1], coverage[0], coverage[1]))
    return sorted(found, key=lambda paired: paired.sequence)


def unpaired(rows: Sequence[RunRow], side: Side, other: Side, pairs: Sequence[tuple[str, str]]) -> int:
    """How many rows of one side take part in no pair; pairs name the variant of this side first."""
    used = {(one, column) for one, another in pairs for column in set(side[one]) & set(other[another])}
    return sum((row.variant_key, row.column_id) not in used for row in rows)


def _first(side: Side, key: str) -> RunRow:
    return next(iter(side[key].values()))[0]


def _differing(a: RunRow, b: RunRow) -> list[str]:
    names = sorted({*a.variant, *b.variant})
    return [name for name in names if a.variant.get(name) != b.variant.get(name)]


# The table of two sets of results against each other.


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
