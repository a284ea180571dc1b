"""Summary of a board in words: one sentence, and one paragraph for readers without statistics."""

from collections import Counter
from collections.abc import Sequence

from dynslam_bench.evaluation.verdicts import FEWEST_FAMILIES, FEWEST_FREE
from dynslam_bench.reports.model.board import (
    OVERALL,
    STATIC_CAMERA,
    Board,
    board_resolution,
    common_logs,
)
from dynslam_bench.reports.model.row import HINTED, SEEN, RunRow
from dynslam_bench.reports.model.statistics import FEWEST, Standing, mean_rank_test
from dynslam_bench.runs.rows import part_words

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

    # what is claimed: the trackers that are better, and which may be the best
    claimed = _better_words(board, ranked)
    if not claimed and _reference_lost_all(board):
        return f"{where}{board.reference_name} lost all, so no tracker can be compared with it."
    if not claimed:
        n_worse = sum(standing.verdict == "worse" for standing in ranked)
        worse = f"; {_are(n_worse)} worse" if n_worse else ""
        return f"{where}no tracker is shown to be better than {board.reference_name}{worse}."
    return f"{where}{claimed}."


def _reference_lost_all(board: Board) -> bool:
    return board.reference is not None and set(board.common) <= board.lost(board.reference)


def _better_words(board: Board, ranked: list[Standing]) -> str:
    """Words on the trackers that are better than the reference, and how far that goes; empty for none."""
    better = [standing for standing in ranked if standing.verdict == "better"]
    if not better:
        return _but_lost_words(board, ranked)

    # of several those that may be the best, of these the claims that go farthest
    best = [standing for standing in ranked if standing.may_be_best]
    named = [standing for standing in better if standing.may_be_best] or better
    beyond = [standing for standing in named if standing.scope == "beyond these families"]
    named = beyond or named

    # by how much
    cuts_percent = sorted(round(100 * (1 - standing.ratio.value)) for standing in named)
    smallest = cuts_percent[0]
    largest = cuts_percent[-1]
    by = f"{smallest} %" if smallest == largest else f"{smallest} to {largest} %"
    if smallest > 0:
        verb = f"{'cuts' if len(named) == 1 else 'cut'} {board.reference_name}'s error by {by}"
    else:
        verb = f"{'is' if len(named) == 1 else 'are'} better than {board.reference_name}"
    message = f"{_names(board, named)} {verb}, {named[0].scope}"

    # what may be the best, and who would be better but for its losses
    endings = []
    if board.ranked_sequences.can_go_beyond:
        if best != named:
            # a claim on these families says nothing of others, where the reference may be as good
            where = "" if beyond else "beyond them "
            endings.append(f"{where}{_names(board, best)} may be the best")
        elif len(best) > 1:
            endings.append("each of them may be the best")
        else:
            endings.append("no other may be the best")
    endings.append(_but_lost_words(board, ranked))
    return "; ".join(filter(None, [message, *endings]))


def _but_lost_words(board: Board, ranked: list[Standing]) -> str:
    """The first tracker that is better where both succeed and loses more; empty for none."""
    for standing in ranked:
        if standing.verdict == "better, but lost":
            by_tracker, by_reference = standing.lost
            return (
                f"{board.names[standing.key]} is better than {board.reference_name} where both succeed, "
                f"{standing.scope}, but lost {by_tracker} of {standing.sequences}, the reference {by_reference}"
            )
    return ""


def explanation(board: Board) -> str:
    """Sentences on reading the board, for a reader without statistics; empty where nothing is ranked."""
    if not board.common or not board.ranked:
        return ""
    if len(board.common) < FEWEST:
        return (
            f"Read the order as a description of {_sequences(board)}, not as evidence about others: with fewer than "
            f"{FEWEST}, chance alone could produce it."
        )
    if not _can_claim(board):
        return (
            f"Read the order as a description of {_sequences(board)}, not as evidence: the data cannot tell who is "
            f"better. {_missing_words(board)}"
        )
    count = Counter(standing.verdict for standing in board.standings)
    but_lost = count["better, but lost"]
    lost_words = (
        f" {_are(but_lost)} better where both succeed, but lost more sequences." if but_lost else ""
    )
    sentences = [
        f"Every tracker is compared with {board.reference_name} on the same sequences, where both succeed; sequences "
        "that a tracker lost are counted beside it.",
        "'Better' and 'worse' hold on these families of sequences or beyond them, as they say: the difference is so "
        "steady that fewer than one such board in twenty would hold any wrong claim of one kind, and fewer than one in "
        "ten of either. 'Worse' by lost sequences means more losses than chance explains.",
        f"Here {_are(count['better'])} better, {_are(count['worse'])} worse, and of {count['cannot tell']} the data "
        f"cannot tell.{lost_words}",
        "'Cannot tell' does not mean equal: the brackets hold the ratios that the data allow.",
        _best_words(board),
        _resolution_words(board),
    ]
    return " ".join(filter(None, sentences))


def _can_claim(board: Board) -> bool:
    """Whether anything can be claimed: beyond these families, or on them."""
    sequences = board.ranked_sequences
    return sequences.can_go_beyond or sequences.can_stay


def _missing_words(board: Board) -> str:
    """Words on what claims beyond these families would need, and claims on them where there are too few sequences."""
    n_families = len(set(board.ranked_sequences.families))
    families = "family" if n_families == 1 else "families"
    here = f"here {'is' if n_families == 1 else 'are'} {n_families}"
    words = f"Claims beyond these families need {FEWEST_FAMILIES} of them, and {here}."
    if not board.ranked_sequences.can_stay:
        words += (
            f" Claims on these families need {FEWEST_FREE} more sequences than families, and here are "
            f"{len(board.common)} of {n_families} {families}."
        )
    return words


def _best_words(board: Board) -> str:
    """Words on the trackers that may be the best; empty where that is not known."""
    best = [standing for standing in board.standings if standing.may_be_best]
    if not best or not board.ranked_sequences.can_go_beyond or len(board.ranked) < 2:
        return ""
    return f"{_names(board, best)} may be the best: no rival is shown to be better beyond these families."


def _resolution_words(board: Board) -> str:
    """Words on the differences that the board can show, and what it lacks for claims beyond its families."""
    these, beyond = board_resolution(board)
    scopes = []
    if these < 1.0:
        scopes.append(f"from {100 * these:.0f} % on these families")
    if beyond < 1.0:
        scopes.append(f"from {100 * beyond:.0f} % beyond {'them' if scopes else 'these families'}")
    sentences = []
    if scopes:
        sentences.append(
            f"This board shows differences {', '.join(scopes)}, in four of five such boards."
        )
    if not board.ranked_sequences.can_go_beyond:
        sentences.append(_missing_words(board))
    return " ".join(sentences)


def reservations(rows: Sequence[RunRow]) -> list[str]:
    """Reservations about quoting numbers of these runs, in sentences."""
    sentences = []
    cells = {(row.variant_key, row.sequence_key) for row in rows}
    if len(cells) == len(rows):
        sentences.append(
            "One run of a tracker on a sequence: how far repeats lie apart is not known."
        )

    # what the runs are of
    if any(part_words(row) for row in rows):
        sentences.append("Parts of sequences: errors on the whole ones differ.")
    if any(row.sequence.id.startswith("synthetic/") for row in rows):
        sentences.append("Rendered scenes: not comparable with recordings.")

    # reservations on times
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
    test = mean_rank_test(common_logs(board, board.ranked))
    if test is None:
        return ""
    p_value, difference = test
    return (
        f"Mean ranks: Friedman's test gives p = {p_value:.2g}; two mean ranks that differ by more than "
        f"{difference:.2f} are different at 5 % (Nemenyi)."
    )


def _sequences(board: Board) -> str:
    """Words on how many sequences the ranking is over, and of which category."""
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
