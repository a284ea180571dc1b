"""How often a leaderboard is right, and how many true differences it finds, on boards whose truth is known.

Errors are simulated: a hardness for every sequence, a quality for every tracker, and a scatter of
several shapes. Two questions are asked of every board: is a tracker better than the reference (Holm
over the trackers), and what is the order of all pairs (Holm over the pairs). A board counts as
right if none of its claims is wrong; of trackers that are exactly equal, any claim counts as wrong.
In the shape "failures" every tracker fails as often as every other. "Unlike failures" is outside of
what a test on few sequences can hold: the more a tracker fails there, the better it is where it
does not, so that all have the same mean.

Run: python tests/benchmarks/rank_groups.py [boards]
"""

import sys

import numpy as np

from dynslam_bench.reports.model.statistics import separable, verdicts_against

SEQUENCES = (5, 8, 12, 24)
TRACKERS = (2, 5, 10, 20)


def failures(rng, size, least=0.1, most=0.1):
    """A scatter of 15 %, and failures of ten times the error, with chances from `least` to `most`, mean removed."""
    chance = np.linspace(least, most, size[0])[:, None]
    return rng.normal(0, 0.15, size) + 2.3 * ((rng.random(size) < chance) - chance)


SHAPES = {
    "normal": lambda rng, size: rng.normal(0, 0.4, size),
    "heavy tails": lambda rng, size: 0.3 * rng.standard_t(3, size),
    "unequal spread": lambda rng, size: (
        rng.normal(0, 1, size) * np.geomspace(0.05, 1, size[0])[:, None]
    ),
    "skewed": lambda rng, size: 0.4 * (rng.exponential(1, size) - 1),
    "failures": failures,
    "unlike failures": lambda rng, size: failures(rng, size, least=0.02, most=0.2),
}


def simulate(shape, quality, sequences, boards, seed=0, weights=None):
    """What boards claim where the truth is known.

    Args:
        shape: Of the scatter, see `SHAPES`.
        quality: Mean log error of each tracker ``[K]``.
        sequences: How many sequences a board has.
        boards: How many boards.
        seed: Of the draws.
        weights: Of the sequences; all the same where there are none.

    Returns:
        For the pairs and for the comparisons with the reference, the middle tracker: share of
        boards without a wrong claim, and mean share of the true differences that are claimed.
    """
    rng = np.random.default_rng(seed)
    trackers = len(quality)
    middle = len(quality) // 2
    weights = np.ones(sequences) if weights is None else weights
    right = np.zeros(2)
    claimed = np.zeros(2)
    for _ in range(boards):
        log = (
            quality[:, None]
            + rng.normal(-3, 1, sequences)
            + SHAPES[shape](rng, (trackers, sequences))
        )
        logs = {str(k): log[k] for k in range(trackers)}
        means = log @ weights
        pairs = [
            (quality[int(a)] - quality[int(b)]) * (means[int(a)] - means[int(b)]) > 0
            for (a, b), (apart, _) in separable(logs, weights).items()
            if apart
        ]
        others = {key: log for key, log in logs.items() if key != str(middle)}
        against = [
            (quality[int(key)] - quality[middle]) * (1 if verdict == "worse" else -1) > 0
            for key, (verdict, _) in verdicts_against(others, log[middle], weights).items()
            if verdict in ("better", "worse")
        ]
        right += [all(pairs), all(against)]
        claimed += [sum(pairs) / (trackers * (trackers - 1) / 2), sum(against) / (trackers - 1)]
    return right / boards, claimed / boards


def main():
    """Print two Markdown tables: all shapes over all numbers of trackers, and what more sequences find."""
    boards = int(sys.argv[1]) if len(sys.argv) > 1 else 300
    print(f"| scatter | qualities | question | {' | '.join(f'{n} sequences' for n in SEQUENCES)} |")
    print("| --- | --- | --- |" + " ---: |" * len(SEQUENCES))
    for shape in SHAPES:
        for name, spread in (("all equal", 0.0), ("sd 25 %", 0.25), ("sd 70 %", 0.7)):
            cells = []
            for sequences in SEQUENCES:
                outcomes = []
                for trackers in TRACKERS:
                    quality = np.sort(np.random.default_rng(1).normal(0, 1, trackers)) * spread
                    outcomes.append(simulate(shape, quality, sequences, boards, seed=trackers))
                cells.append(np.mean(outcomes, axis=0))
            for at, question in enumerate(("all pairs", "reference")):
                words = " | ".join(
                    f"{right[at]:.3f}, {claimed[at]:.3f}" for right, claimed in cells
                )
                print(f"| {shape} | {name} | {question} | {words} |", flush=True)
    print("\n| scatter | sequences | all pairs | reference |\n| --- | ---: | ---: | ---: |")
    quality = np.sort(np.random.default_rng(1).normal(0, 1, 20)) * SPREAD
    for shape in ("normal", "heavy tails", "failures"):
        for sequences in (8, 24):
            _, (pairs, against) = simulate(shape, quality, sequences, boards)
            print(f"| {shape} | {sequences} | {pairs:.3f} | {against:.3f} |")


SPREAD = 0.4
"""Of the qualities of 20 trackers, as a standard deviation of log errors."""


if __name__ == "__main__":
    main()
