"""The board: rows ordered into trackers and sequences, with one label each, and their standings."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from statistics import median

from dynslam_bench.core.errors import ReportError

from .rows import RunRow, check_one_protocol
from .statistics import Standing, standings

NEVER_MOVE = "never move (from the ground truth)"
_GROUPS = (("static", "static"), ("low-dynamic", "low dynamic"), ("high-dynamic", "high dynamic"))

_NAMES = (("walking", "high dynamic"), ("sitting", "low dynamic"))
_OTHER = "other"


@dataclass(frozen=True)
class Cell:
    """All runs of one tracker on one sequence.

    Attributes:
        rows: The runs.
        scores: Their errors in metres, failures imputed.
        imputed: How many of them were imputed.
    """

    rows: tuple[RunRow, ...]
    scores: tuple[float, ...]
    imputed: int

    @property
    def median(self) -> float | None:
        """Median error in metres; None without ground truth."""
        return median(self.scores) if self.scores else None


@dataclass
class Board:
    """Everything the tables and figures are made of.

    Attributes:
        rows: All rows.
        trackers: Variant keys in order of standing.
        labels: Variant key to the name in tables.
        sequences: Sequence keys with ground truth, grouped and sorted.
        short: Sequence key to what is left of it without the parts that all share.
        groups: Sequence key to the name of its group.
        unscored: Sequence keys without ground truth.
        cells: Variant key to sequence key to its runs.
        never_move: Sequence key to the error of a camera that does not move.
        reference: Variant key of the reference; None if ratios are to a camera that never moves.
        reference_name: How to call the reference in captions.
        standings: Standing of every variant with a score, in order.
        ranked: Variant keys that take part in the ranking.
        incomplete: Variant keys left out of the ranking since they lack sequences.
    """

    rows: list[RunRow]
    trackers: list[str] = field(default_factory=list)
    labels: dict[str, str] = field(default_factory=dict)
    sequences: list[str] = field(default_factory=list)
    short: dict[str, str] = field(default_factory=dict)
    groups: dict[str, str] = field(default_factory=dict)
    unscored: list[str] = field(default_factory=list)
    cells: dict[str, dict[str, Cell]] = field(default_factory=dict)
    never_move: dict[str, float] = field(default_factory=dict)
    reference: str | None = None
    reference_name: str = NEVER_MOVE
    standings: list[Standing] = field(default_factory=list)
    ranked: list[str] = field(default_factory=list)
    incomplete: list[str] = field(default_factory=list)

    def runs(self, key: str) -> list[RunRow]:
        """All rows of a tracker."""
        return [row for row in self.rows if row.variant_key == key]

    def first(self, key: str) -> RunRow:
        """Any row of a tracker, for what all its rows share."""
        return next(row for row in self.rows if row.variant_key == key)

    def ranked_order(self) -> list[str]:
        """Ranked trackers from the best to the worst."""
        return [key for key in self.trackers if key in self.ranked]

    def reference_scores(self) -> dict[str, list[float]]:
        """The reference's errors on every sequence."""
        if self.reference is None:
            return {name: [self.never_move[name]] for name in self.sequences}
        return {name: list(self.cells[self.reference][name].scores) for name in self.sequences}

    def reference_median(self, sequence: str) -> float:
        """The reference's median error on a sequence."""
        return median(self.reference_scores()[sequence])


def make_board(rows: Sequence[RunRow], reference: str = "orb-slam2") -> Board:
    """Order rows into a board.

    Args:
        rows: One a run.
        reference: Tracker id that errors are divided by; where it was not run on every sequence, a camera that never
            moves takes its place.

    Raises:
        ReportError: There are no rows, or they mix protocols.
    """
    if not rows:
        raise ReportError("there are no runs to report")
    check_one_protocol(rows)
    board = Board(list(rows))
    board.labels = make_labels(rows)
    for key in {row.sequence_key: None for row in rows}:
        found = [row.never_move_m for row in rows if row.sequence_key == key and row.never_move_m is not None]
        if found:
            board.never_move[key] = median(found)
        else:
            board.unscored.append(key)
        board.groups[key] = _group(next(row for row in rows if row.sequence_key == key))
    if set(board.groups.values()) == {_OTHER}:
        board.groups = dict.fromkeys(board.groups, "")
    order = {name: position for position, (_, name) in enumerate(_GROUPS)}
    board.sequences = sorted(board.never_move, key=lambda key: (order.get(board.groups[key], 9), key))
    board.short = shortened(board.sequences)
    for key in board.labels:
        board.cells[key] = {
            sequence: _cell([row for row in rows if row.variant_key == key and row.sequence_key == sequence])
            for sequence in {row.sequence_key: None for row in rows if row.variant_key == key}
        }
    scored = [key for key, cell in board.cells.items() if any(cell[s].scores for s in board.sequences if s in cell)]
    complete = [key for key in scored if all(s in board.cells[key] for s in board.sequences)]
    board.ranked = [k for k in complete if board.first(k).ranked and board.first(k).provenance != "control"]
    board.incomplete = [key for key in scored if key not in complete]
    candidates = [key for key in complete if board.first(key).tracker == reference]
    if candidates:
        board.reference = min(candidates, key=lambda key: len(board.first(key).variant))
        board.reference_name = board.labels[board.reference]
    if board.sequences and scored:
        board.standings = rank(board, scored, board.ranked)
    placed = [standing.key for standing in board.standings]
    board.trackers = placed + sorted((key for key in board.labels if key not in placed), key=board.labels.__getitem__)
    return board


def rank(
    board: Board, scored: Sequence[str], ranked: Sequence[str], score: Callable[[RunRow], float | None] | None = None
) -> list[Standing]:
    """Standings under one rule for failures.

    Args:
        board: Gives cells and reference.
        scored: Trackers to place.
        ranked: Those of them that are ranked.
        score: Error of a run in metres, or None to leave it out; None for the board's own rule.
    """
    rule = score or (lambda row: row.score_m)
    cells = {
        key: {
            sequence: [value for row in cell.rows if (value := rule(row)) is not None]
            for sequence, cell in board.cells[key].items()
            if sequence in board.never_move
        }
        for key in scored
    }
    reference = board.reference_scores() if score is None or board.reference is None else dict(cells[board.reference])
    shared = {name: values for name, values in reference.items() if values}
    placed = [key for key in scored if any(cells[key].get(name) for name in shared)]
    full = [key for key in ranked if key in placed and all(cells[key].get(name) for name in shared)]
    if not shared:
        return []
    return standings({key: cells[key] for key in placed}, shared, full)


def make_labels(rows: Sequence[RunRow]) -> dict[str, str]:
    """A name for every variant: the tracker's label and what sets it apart from the tracker's other variants."""
    variants: dict[str, RunRow] = {}
    for row in rows:
        variants.setdefault(row.variant_key, row)
    labels = {}
    for key, row in variants.items():
        others = [other for other in variants.values() if other.tracker == row.tracker]
        names = sorted({name for other in others for name in other.variant})
        differing = [name for name in names if len({str(other.variant.get(name)) for other in others}) > 1]
        parts = [f"{name}={row.variant[name]}" for name in differing if name in row.variant]
        imported = row.kind == "imported"
        if imported and any(other.kind != row.kind for other in others):
            parts.append("imported")
        same_label = [other for other in variants.values() if other.label == row.label and other.tracker != row.tracker]
        base = f"{row.label} <{row.tracker}>" if same_label else row.label
        labels[key] = base + (f" · {', '.join(parts)}" if parts else "")
    return labels


def shortened(names: Sequence[str]) -> dict[str, str]:
    """Names without the folders, and without the ``@...`` or ``?...`` behind them, that all of them share."""
    if len(names) < 2:
        return {name: name for name in names}
    folders = [name.split("@")[0].split("?")[0].split("/")[:-1] for name in names]
    shared = 0
    while all(len(parts) > shared and parts[shared] == folders[0][shared] for parts in folders):
        shared += 1
    tails = {name[len(_stem(name)) :] for name in names}
    short = {name: "/".join(_stem(name).split("/")[shared:]) + ("" if len(tails) == 1 else name[len(_stem(name)) :])
             for name in names}  # fmt: skip
    return short if len(set(short.values())) == len(names) else {name: name for name in names}


def _stem(name: str) -> str:
    """A sequence key up to its ``@``, ``?`` or `` [``."""
    return min((name.partition(mark)[0] for mark in ("@", "?", " [")), key=len)


def _cell(rows: list[RunRow]) -> Cell:
    rows = sorted(rows, key=lambda row: row.seed)
    scores = [row.score_m for row in rows]
    kept = tuple(score for score in scores if score is not None)
    imputed = sum(1 for row in rows if row.failed and row.score_m is not None)
    return Cell(tuple(rows), kept, imputed)


def _group(row: RunRow) -> str:
    for tag, name in _GROUPS:
        if tag in row.tags:
            return name
    for part, name in _NAMES:
        if part in row.sequence:
            return name
    return _OTHER
