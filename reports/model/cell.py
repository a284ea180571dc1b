"""All runs of one tracker on one sequence, and what they say together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from statistics import median

from .row import RunRow


@dataclass(frozen=True)
class Cell:
    """All runs of one tracker on one sequence.

    Attributes:
        rows: The runs, ordered by repeat.
        kept: Those that count: of runs that differ in their seed only and have equal results, one.
    """

    rows: tuple[RunRow, ...]
    kept: tuple[RunRow, ...]

    @cached_property
    def scores(self) -> tuple[float, ...]:
        """Errors in metres of the runs that count, failures imputed."""
        return tuple(score for row in self.kept if (score := row.score_m) is not None)

    @cached_property
    def succeeded(self) -> tuple[RunRow, ...]:
        """The runs that count, ended and have an error."""
        return tuple(row for row in self.kept if not row.failed and row.score_m is not None)

    @cached_property
    def median(self) -> float | None:
        """Median error in metres; None without ground truth."""
        return median(self.scores) if self.scores else None

    @cached_property
    def failed(self) -> int:
        """Runs that failed."""
        return sum(row.failed for row in self.rows)

    @property
    def success(self) -> int:
        """Runs that ended and could be evaluated."""
        return len(self.rows) - self.failed

    @property
    def deterministic(self) -> bool:
        """Whether several seeds gave one result to the last digit."""
        return len(self.kept) == 1 < len(self.rows)

    @cached_property
    def typical(self) -> RunRow:
        """The run that stands for the cell: the successful one with the (lower) median error, else its first."""
        ordered = sorted(self.succeeded, key=lambda row: row.score_m or 0.0)
        return ordered[(len(ordered) - 1) // 2] if ordered else self.rows[0]

    @cached_property
    def seen(self) -> bool:
        """Whether masks of it come from a network that was trained on the scene."""
        return any(row.seen_in_training for row in self.rows)

    @cached_property
    def ending(self) -> str:
        """How the runs failed, e.g. ``crashed at 20/60``; several that ended differently are counted."""
        endings = list(dict.fromkeys(row.ending for row in self.rows if row.failed))
        return endings[0] if len(endings) == 1 else f"{self.failed} failed: {'; '.join(endings)}" if endings else ""

    @property
    def epipolar_skipped(self) -> float | None:
        """Mean share of the tracked frames on which the fundamental matrix was not used; None without such a test."""
        return mean_skipped(self.rows)


def make_cell(rows: Sequence[RunRow]) -> Cell:
    """Order the runs of a cell and find the copies among them."""
    ordered = sorted(rows, key=lambda row: row.repeat_key)
    groups: dict[object, list[RunRow]] = {}
    for row in ordered:
        groups.setdefault((row.offset, row.noise, row.imported), []).append(row)
    kept: list[RunRow] = []
    for group in groups.values():
        results = {_result(row) for row in group}
        kept += group[:1] if len(results) == 1 else group
    return Cell(tuple(ordered), tuple(kept))


def mean_skipped(rows: Sequence[RunRow]) -> float | None:
    """Mean over runs of the share of frames on which the fundamental matrix was not used; None if none has it."""
    shares = [row.epipolar_skipped for row in rows if row.epipolar_skipped is not None]
    return sum(shares) / len(shares) if shares else None


def _result(row: RunRow) -> object:
    """Everything that two copies have in common."""
    return row.status, row.n_processed, row.coverage, row.score_m, row.final_ate_m, tuple(sorted(row.metrics.items()))
