"""Answers of a board in millimetres: the typical error of each tracker, a sentence per category, and its limits."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from statistics import median

from dynslam_bench.core.number_text import mm
from dynslam_bench.reports.model.board import OVERALL, Board, TrackerOnSequence, mean_of
from dynslam_bench.reports.model.row import SEEN, RunRow
from dynslam_bench.runs.rows import part_words

MEANINGS = {
    "static": "nothing moves",
    "low dynamic": "people sit",
    "high dynamic": "people walk",
    "unknown objects": "objects of no class move",
    "fixed camera": "the camera stands still",
    "loops": "the camera returns",
    "fast": "the camera moves fast",
    "recorded": "recordings",
    "rendered": "rendered scenes",
}
"""Categories in everyday words."""
NEARLY_ALL = 0.95
"""Share of the ground truth's time from which nothing is said of it: it often goes on behind the last image."""
_MOST_NAMED = 4
"""Trackers that a sentence on failures names, those with the most first."""
_BEST_NAMED = 2
"""Ranked trackers that an answer names, from the best on, beside the reference."""


@dataclass(frozen=True)
class TypicalError:
    """The typical error of a tracker on sequences.

    Attributes:
        median_m: Median over its sequences of the median error of each, in metres; None without
            any. A lost run counts as a static camera, or worse.
        sequences: Sequences with an error.
        lost: Sequences with an error that it lost.
        asked: Sequences that there are.
    """

    median_m: float | None
    sequences: int
    lost: int
    asked: int


def cell_error_m(cell: TrackerOnSequence) -> float | None:
    """Median error of a cell in metres; that of its final trajectories where nothing else is known."""
    if cell.median is not None:
        return cell.median
    final_m = [row.final_ate_m for row in cell.kept if row.final_ate_m is not None]
    return median(final_m) if final_m else None


def typical_error(board: Board, key: str, names: Sequence[str]) -> TypicalError:
    """The typical error of a tracker with its settings (`RunRow.variant_key`) on some sequences of a board."""
    errors_m = []
    lost = 0
    for name in names:
        cell = board.cells[key].get(name)
        error_m = None if cell is None else cell_error_m(cell)
        if cell is not None and error_m is not None:
            errors_m.append(error_m)
            lost += cell.lost
    typical_m = median(errors_m) if errors_m else None
    return TypicalError(typical_m, len(errors_m), lost, len(names))


def error_columns(board: Board) -> dict[str, list[str]]:
    """Sequences that typical errors are over, by what moves in them, in everyday words.

    They are those that all ranked trackers have.

    The board of all sequences has an entry for each group of sequences, others have one. A group of
    which the ranked trackers have none in common is there with all its sequences.
    """
    groups = dict.fromkeys(board.groups[name] for name in board.sequences)
    if board.category != OVERALL or len(groups) < 2:
        category = board.category
        if category == OVERALL:
            category = next(iter(groups), "")
        return {MEANINGS.get(category, category) or "all": board.common or board.sequences}
    columns = {}
    for group in groups:
        members = [name for name in board.sequences if board.groups[name] == group]
        common = [name for name in board.common if board.groups[name] == group]
        columns[MEANINGS.get(group, group)] = common or members
    return columns


def answers(board: Board) -> list[str]:
    """Sentences on a board's errors in millimetres, one a column of errors; none without ground truth.

    Named are the ranked trackers with the smallest typical errors, the reference, and a camera that
    does not move. Where nothing is ranked, all trackers are compared.
    """
    return [
        _answer(board, meaning, names) for meaning, names in error_columns(board).items() if names
    ]


def _answer(board: Board, meaning: str, names: Sequence[str]) -> str:
    """One sentence on some sequences of a board."""
    parts = [_words(board, key, names) for key in _named(board, names)]
    parts.append(f"not moving {mm(median(board.static_camera[name] for name in names))} mm")
    where = f"{len(names)} {'sequence' if len(names) == 1 else 'sequences'}"
    if meaning != "all":
        where = f"{meaning[0].upper()}{meaning[1:]} ({where})"
    return f"{where}: {', '.join(parts)}."


def _named(board: Board, names: Sequence[str]) -> list[str]:
    """Variant keys of the trackers that an answer names, those with the smallest errors first."""
    errors_m = {}
    for key in board.ranked or [*board.trackers, *board.final_only]:
        error_m = typical_error(board, key, names).median_m
        if error_m is not None:
            errors_m[key] = error_m
    smallest_first = sorted(errors_m, key=errors_m.__getitem__)
    named = smallest_first[:_BEST_NAMED]
    is_left_out = board.reference not in named
    if board.reference is not None and is_left_out and board.reference in board.cells:
        named.append(board.reference)
    return named


def _words(board: Board, key: str, names: Sequence[str]) -> str:
    """A tracker with its typical error, and how many sequences it lacks or lost."""
    error = typical_error(board, key, names)
    if error.median_m is None:
        return f"{board.names[key]} none"
    remarks = []
    if key in board.final_only:
        remarks.append("final trajectory")
    if error.sequences < error.asked:
        remarks.append(f"on {error.sequences}")
    shares = [row.truth_share for name in names for row in _rows(board, key, name)]
    share = mean_of(shares)
    if share is not None and share < NEARLY_ALL:
        remarks.append(f"{100 * share:.0f} % of the time")
    if error.lost:
        remarks.append(f"lost {error.lost}")
    behind = f" ({', '.join(remarks)})" if remarks else ""
    return f"{board.names[key]} {mm(error.median_m)} mm{behind}"


def _rows(board: Board, key: str, name: str) -> list[RunRow]:
    """The runs of a tracker on a sequence."""
    cell = board.cells[key].get(name)
    return [] if cell is None else list(cell.rows)


def limits(board: Board) -> str:
    """Limits of the numbers of a board, in a few short sentences."""
    rows = board.rows
    sentences = ["Medians over sequences of the absolute trajectory error."]
    sentences.append(_kind_of_data(rows))
    repeats = {len(cell.rows) for cells in board.cells.values() for cell in cells.values()}
    if repeats == {1}:
        sentences.append("One run each: how far repeats lie apart is not known.")
    if any(row.seen_in_training for row in rows):
        sentences.append(f"{SEEN} Masks of a network that was trained on the very scene.")
    sentences.append(_failures_words(board))
    return " ".join(filter(None, sentences))


def _failures_words(board: Board) -> str:
    """How many runs failed, and of which trackers; empty for none."""
    failed = Counter(board.names[row.variant_key] for row in board.rows if row.failed)
    if not failed:
        return ""
    named = [f"{name} {count}" for name, count in failed.most_common(_MOST_NAMED)]
    if len(failed) > _MOST_NAMED:
        named.append(f"{len(failed) - _MOST_NAMED} more trackers")
    verb = "counts" if failed.total() == 1 else "count"
    words = f"{failed.total()} of {len(board.rows)} runs failed ({', '.join(named)})"
    return f"{words} and {verb} as not moving, or worse."


def _kind_of_data(rows: Iterable[RunRow]) -> str:
    """Whether the sequences are rendered or recorded, whole or in part."""
    rows = list(rows)
    rendered = {row.sequence.id.startswith("synthetic/") for row in rows}
    kind = "Rendered scenes and recordings"
    if len(rendered) == 1:
        kind = "Rendered scenes" if rendered.pop() else "Recordings"
    parts = ", in part" if any(part_words(row) for row in rows) else ""
    return f"{kind}{parts}."
