"""Which runs of two sets of results are compared with each other, and what sets them apart."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from statistics import median

from dynslam_bench.core.toml import setting_text

from .cell import make_cell
from .labels import make_labels
from .row import SEEN, RunRow
from .statistics import FLOOR_M

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
