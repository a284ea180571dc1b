"""What a board says in words: one sentence, and one paragraph for readers without statistics."""

import math
from collections import Counter
from collections.abc import Sequence
from statistics import median_high

from dynslam_bench.reports.model.board import OVERALL, STATIC_CAMERA, Board, common_logs
from dynslam_bench.reports.model.row import HINTED, SEEN, RunRow
from dynslam_bench.reports.model.statistics import FEWEST, Standing, mean_rank_test
from dynslam_bench.runs.store import part_words

_MOST_NAMED = 3
"""Trackers that a sentence names; of more the first, and how many others."""


def headline(board: Board) -> str:
    """The message of a board in one sentence."""
    ranked = [standing for standing in board.standings if standing.rank is not None]
    if not board.sequences:
        return "No sequence has ground truth, so nothing can be compared."
    if not ranked:
        return "No tracker can be ranked."

    # too little for a comparison: the best tracker and its ratio
    where = f"On {_sequences(board)} "
    best = ranked[0]
    ratio = ""
    if best.key != board.reference:
        is_static = board.reference_name == STATIC_CAMERA
        reference = "a static camera" if is_static else board.reference_name
        ratio = f", with {best.ratio.value:.2f} times the error of {reference}"
    if len(ranked) == 1:
        return f"{where}{board.names[best.key]} alone is ranked{ratio}."
    if len(board.common) < FEWEST:
        return (
            f"{where}{board.names[best.key]} has the smallest error{ratio}; below {FEWEST} sequences "
            "no tracker is called better than another."
        )

    # those that may be first and are better than the reference
    better = [
        standing
        for standing in ranked
        if standing.group is not None and standing.group[0] == 1 and standing.verdict == "better"
    ]
    if not better:
        n_worse = sum(standing.verdict == "worse" for standing in ranked)
        return f"{where}no tracker is shown to be better than {board.reference_name}; {_are(n_worse)} worse."
    cuts_percent = sorted(round(100 * (1 - standing.ratio.value)) for standing in better)
    smallest = cuts_percent[0]
    largest = cuts_percent[-1]
    by = f"{smallest} %" if smallest == largest else f"{smallest} to {largest} %"
    cut = "cuts" if len(better) == 1 else "cut"
    message = f"{where}{_names(board, better)} {cut} {board.reference_name}'s error by {by}"
    return f"{message}; these cannot be told apart." if len(better) > 1 else f"{message}."


def explanation(board: Board) -> str:
    """How to read the board, for a reader without statistics."""
    if not board.common:
        return ""
    if len(board.common) < FEWEST:
        return (
            f"Read the order as a description of {_sequences(board)}, not as evidence about others: with fewer than "
            f"{FEWEST}, chance alone could produce it."
        )
    count = Counter(standing.verdict for standing in board.standings)
    sentences = [
        f"Every tracker is compared with {board.reference_name} on the same sequences.",
        "'Better' and 'worse' mean that the difference is so steady over the sequences that fewer than one such board "
        "in twenty would hold any wrong claim.",
        f"Here {_are(count['better'])} better, {_are(count['worse'])} worse, and of {count['cannot tell']} the data "
        "cannot tell.",
        "'Cannot tell' does not mean equal: the brackets hold the ratios that the data allow.",
    ]
    needed = _sequences_needed(board)
    if needed > len(board.common):
        sentences.append(
            f"About {needed} sequences would be needed to show a difference of 10 % between typical trackers."
        )
    return " ".join(sentences)


def _sequences_needed(board: Board) -> int:
    """On how many sequences a typical tracker's interval would reach 10 % from its middle.

    The logarithm of an interval's width falls with the square root of the number of sequences.
    """
    widths = []
    for standing in board.standings:
        ratio = standing.ratio
        if standing.rank is not None and ratio.high > ratio.value > 0:
            widths.append(ratio.high / ratio.value)
    # the factor between an interval's end and its middle, of a typical tracker
    width = median_high(widths or [1.0])
    n_common = len(board.common)
    return math.ceil(n_common * (math.log(max(width, 1.0 + 1e-9)) / math.log(1.1)) ** 2)


def reservations(rows: Sequence[RunRow]) -> list[str]:
    """What speaks against quoting numbers of these runs, or has to be said with them; in sentences."""
    sentences = []
    cells = {(row.variant_key, row.column_id) for row in rows}
    if len(cells) == len(rows):
        sentences.append(
            "One run of a tracker on a sequence: how far repeats lie apart is not known."
        )

    # what the runs are of
    if any(part_words(row) for row in rows):
        sentences.append("Parts of sequences: errors on the whole ones differ.")
    if any(row.sequence.id.startswith("synthetic/") for row in rows):
        sentences.append("Rendered scenes: not comparable with recordings.")

    # times
    if any(row.cached for row in rows):
        sentences.append("Frame times come from the stage cache, not from the runs.")
    computers = {row.computer for row in rows if row.frame_ms is not None}
    if len(computers) > 1:
        sentences.append(f"Frame times of {len(computers)} computers are not comparable.")

    # code, masks, trajectories and failures
    if any(row.git and row.git.dirty for row in rows):
        sentences.append("Made by code with changes that no revision holds.")
    if any(row.seen_in_training for row in rows):
        sentences.append(f"{SEEN} Masks of a network that was trained on the very scene.")
    if any(row.hints for row in rows):
        sentences.append(f"{HINTED} Trajectories that are probably faulty, see Reproduce.")
    if any(row.failed for row in rows):
        sentences.append("Failures, which count as a static camera or worse.")
    return sentences


def mean_rank_note(board: Board) -> str:
    """Friedman's test and Nemenyi's critical difference in a sentence; empty where there are too few trackers."""
    test = mean_rank_test(common_logs(board, board.ranked)[0])
    if test is None:
        return ""
    p_value, difference = test
    return (
        f"Mean ranks: Friedman's test gives p = {p_value:.2g}; two mean ranks that differ by more than "
        f"{difference:.2f} are different at 5 % (Nemenyi)."
    )


def _sequences(board: Board) -> str:
    """How many sequences the ranking is over, and of which category."""
    number = len(board.common)
    plural = "sequence" if number == 1 else "sequences"
    if board.category == "loops":
        return f"{number} {plural} with loops"
    if board.category != OVERALL:
        return f"{number} {board.category} {plural}"
    groups = {board.groups[name] for name in board.common}
    if len(groups) > 1:
        return f"{number} {plural} of {len(groups)} categories"
    if groups and groups != {""}:
        return f"{number} {groups.pop()} {plural}"
    return f"{number} {plural}"


def _are(number: int) -> str:
    """A number with its verb."""
    return f"{number} {'is' if number == 1 else 'are'}"


def _names(board: Board, standings: list[Standing]) -> str:
    """Names of trackers, as a sentence lists them."""
    names = [board.names[standing.key] for standing in standings]
    if len(names) > _MOST_NAMED:
        return f"{names[0]} and {len(names) - 1} others"
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"
