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


def headline(board: Board) -> str:
    """The message of a board in one sentence."""
    ranked = [standing for standing in board.standings if standing.rank is not None]
    if not board.sequences:
        return "No sequence has ground truth, so nothing can be compared."
    if not ranked:
        return "No tracker can be ranked."
    where = f"On {_sequences(board)} "
    best = ranked[0]
    reference = "a static camera" if board.reference_name == STATIC_CAMERA else board.reference_name
    ratio = f", with {best.ratio.value:.2f} times the error of {reference}" * (
        best.key != board.reference
    )
    if len(ranked) == 1:
        return f"{where}{board.names[best.key]} alone is ranked{ratio}."
    if len(board.common) < FEWEST:
        return (
            f"{where}{board.names[best.key]} has the smallest error{ratio}; below {FEWEST} sequences "
            "no tracker is called better than another."
        )
    first = [
        standing for standing in ranked if standing.group is not None and standing.group[0] == 1
    ]
    better = [standing for standing in first if standing.verdict == "better"]
    if not better:
        count = Counter(standing.verdict for standing in ranked)
        return f"{where}no tracker is shown to be better than {board.reference_name}; {_are(count['worse'])} worse."
    cuts = sorted(round(100 * (1 - standing.ratio.value)) for standing in better)
    by = f"{cuts[0]} %" if cuts[0] == cuts[-1] else f"{cuts[0]} to {cuts[-1]} %"
    message = f"{where}{_names(board, better)} cut{'s' * (len(better) == 1)} {board.reference_name}'s error by {by}"
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
    ratios = [
        s.ratio for s in board.standings if s.rank is not None and s.ratio.high > s.ratio.value > 0
    ]
    # the factor between an interval's end and its middle, of a typical tracker
    width = median_high([ratio.high / ratio.value for ratio in ratios] or [1.0])
    more = math.ceil(len(board.common) * (math.log(max(width, 1.0 + 1e-9)) / math.log(1.1)) ** 2)
    sentences = [
        f"Every tracker is compared with {board.reference_name} on the same sequences.",
        "'Better' and 'worse' mean that the difference is so steady over the sequences that fewer than one such board "
        "in twenty would hold any wrong claim.",
        f"Here {_are(count['better'])} better, {_are(count['worse'])} worse, and of {count['cannot tell']} the data "
        "cannot tell.",
        "'Cannot tell' does not mean equal: the brackets hold the ratios that the data allow.",
        f"About {more} sequences would be needed to show a difference of 10 % between typical trackers."
        if more > len(board.common)
        else "",
    ]
    return " ".join(filter(None, sentences))


def reservations(rows: Sequence[RunRow]) -> list[str]:
    """What speaks against quoting numbers of these runs, or has to be said with them; in sentences."""
    cells = {(row.variant_key, row.column_id) for row in rows}
    rendered = any(row.sequence.id.startswith("synthetic/") for row in rows)
    computers = {row.computer for row in rows if row.frame_ms is not None}
    sentences = {
        "One run of a tracker on a sequence: how far repeats lie apart is not known.": len(cells)
        == len(rows),
        "Parts of sequences: errors on the whole ones differ.": any(
            part_words(row) for row in rows
        ),
        "Rendered scenes: not comparable with recordings.": rendered,
        "Frame times come from the stage cache, not from the runs.": any(
            row.cached for row in rows
        ),
        f"Frame times of {len(computers)} computers are not comparable.": len(computers) > 1,
        "Made by code with changes that no revision holds.": any(
            row.git and row.git.dirty for row in rows
        ),
        f"{SEEN} Masks of a network that was trained on the very scene.": any(
            row.seen_in_training for row in rows
        ),
        f"{HINTED} Trajectories that are probably faulty, see Reproduce.": any(
            row.hints for row in rows
        ),
        "Failures, which count as a static camera or worse.": any(row.failed for row in rows),
    }
    return [sentence for sentence, holds in sentences.items() if holds]


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
    number = len(board.common)
    plural = f"sequence{'s' * (number != 1)}"
    if board.category != OVERALL:
        return (
            f"{number} {board.category} {plural}"
            if board.category != "loops"
            else f"{number} {plural} with loops"
        )
    groups = {board.groups[name] for name in board.common}
    if len(groups) == 1 and groups != {""}:
        return f"{number} {groups.pop()} {plural}"
    return (
        f"{number} {plural} of {len(groups)} categories"
        if len(groups) > 1
        else f"{number} {plural}"
    )


def _are(number: int) -> str:
    return f"{number} {'is' if number == 1 else 'are'}"


def _names(board: Board, standings: list[Standing]) -> str:
    names = [board.names[standing.key] for standing in standings]
    if len(names) > _MOST_NAMED:
        return f"{names[0]} and {len(names) - 1} others"
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"
