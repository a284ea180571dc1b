"""How often the order of a board's trackers is right, and how much of it is shown, on boards whose truth is known.

    python tests/benchmarks/rank_groups.py [boards]

Errors are simulated: a hardness for every sequence, a quality for every tracker, and a scatter of
several shapes; every sequence is a family of its own. Two questions are asked of every board: what is the
order of all pairs (Holm over the pairs), and which trackers may be the best (Hsu). A board counts as
right if no pair is in the wrong order, and if the best tracker may be the best; of trackers that are
exactly equal, any claim counts as wrong. In the shape "failures" every tracker fails as often as every
other. "Unlike failures" is outside of what a test on few sequences can hold: the more a tracker fails
there, the better it is where it does not, so that all have the same mean. What is claimed against the
reference is in `verdict_errors.py`.
"""

import sys

import numpy as np

from dynslam_bench.reports.model.statistics import candidates_for_best, separable, sequences_of

SEQUENCES = (5, 8, 12, 24)
TRACKERS = (2, 5, 10)


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


def simulate(shape, quality, sequences, boards, seed=0):
    """What boards claim where the truth is known.

    Args:
        shape: Shape of the scatter, see `SHAPES`.
        quality: Mean log error of each tracker ``[K]``, the best one first.
        sequences: How many sequences a board has.
        boards: How many boards.
        seed: Seed of the draws.

    Returns:
        For the pairs and for the best tracker: share of boards without a wrong claim; then the mean share
        of the true differences that are claimed, and of the trackers that are shown not to be the best.
    """
    rng = np.random.default_rng(seed)
    trackers = len(quality)
    of_board = sequences_of([str(number) for number in range(sequences)])
    right = np.zeros(2)
    claimed = np.zeros(2)
    for _ in range(boards):
        hardness = rng.normal(-3, 1, sequences)
        log = quality[:, None] + hardness + SHAPES[shape](rng, (trackers, sequences))
        logs = {str(k): log[k] for k in range(trackers)}

        # the order of all pairs that are told apart
        pairs = [
            (quality[int(a)] - quality[int(b)]) * order.first_by > 0
            for (a, b), order in separable(logs, of_board).items()
            if order.first_by
        ]

        # the best one; of equal ones the first, which was chosen before
        candidates = candidates_for_best(logs, of_board)
        right += [all(pairs), "0" in candidates]
        n_pairs = trackers * (trackers - 1) / 2
        claimed += [sum(pairs) / n_pairs, (trackers - len(candidates)) / (trackers - 1)]
    return right / boards, claimed / boards


def main():
    """Print a Markdown table: all shapes over all numbers of trackers."""
    boards = int(sys.argv[1]) if len(sys.argv) > 1 else 100
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
            for at, question in enumerate(("all pairs", "the best")):
                words = " | ".join(
                    f"{right[at]:.3f}, {claimed[at]:.3f}" for right, claimed in cells
                )
                print(f"| {shape} | {name} | {question} | {words} |", flush=True)


if __name__ == "__main__":
    main()
