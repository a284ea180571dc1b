"""How often the leaderboard's rank groups hold the true order of all trackers, and how much they separate.

Errors are simulated: a hardness for every sequence, a quality for every tracker, and a scatter of several shapes. A
board counts as right if the true rank of every tracker lies in its group. Of trackers that are exactly equal, any
separation counts as wrong. In the shape "failures" every tracker fails as often as every other. "Unlike failures" is
outside of what a test on few sequences can hold: the more a tracker fails there, the better it is where it does not,
so that all have the same mean; on few sequences most failures are not seen, and what is seen is a difference.

Run: python tests/benchmarks/rank_groups.py [boards]
"""

import sys

import numpy as np

from dynslam_bench.reports.model.statistics import rank_groups

SEQUENCES = (3, 4, 5, 6, 8, 12, 20)
TRACKERS = (2, 5, 10, 20)


def failures(rng, size, least=0.1, most=0.1):
    """A scatter of 15 %, and failures of ten times the error, with chances from `least` to `most`, mean removed."""
    chance = np.linspace(least, most, size[0])[:, None]
    return rng.normal(0, 0.15, size) + 2.3 * ((rng.random(size) < chance) - chance)


SHAPES = {
    "normal": lambda rng, size: rng.normal(0, 0.4, size),
    "heavy tails": lambda rng, size: 0.3 * rng.standard_t(3, size),
    "unequal spread": lambda rng, size: rng.normal(0, 1, size) * np.geomspace(0.05, 1, size[0])[:, None],
    "skewed": lambda rng, size: 0.4 * (rng.exponential(1, size) - 1),
    "failures": failures,
    "unlike failures": lambda rng, size: failures(rng, size, least=0.02, most=0.2),
}


def simulate(shape, quality, sequences, boards, seed=0):
    """Share of boards that are right, and mean share of the pairs that were separated."""
    rng = np.random.default_rng(seed)
    trackers = len(quality)
    true = [(1 + int((quality < q).sum()), trackers - int((quality > q).sum())) for q in quality]
    right, apart = 0, 0.0
    for _ in range(boards):
        log = quality[:, None] + rng.normal(-3, 1, sequences) + SHAPES[shape](rng, (trackers, sequences))
        groups = list(rank_groups({str(k): log[k] for k in range(trackers)}).values())
        right += all(g[0] <= t[0] and t[1] <= g[1] for g, t in zip(groups, true, strict=True))
        apart += sum(trackers - (g[1] - g[0] + 1) for g in groups) / (trackers * (trackers - 1))
    return right / boards, apart / boards


def main():
    """Print one line a shape and spread of the qualities, over all numbers of trackers."""
    boards = int(sys.argv[1]) if len(sys.argv) > 1 else 500
    print(f"share of boards whose groups hold the true order / share of the pairs separated; {boards} boards each of")
    print(f"{', '.join(map(str, TRACKERS))} trackers, by number of sequences")
    print(f"{'shape':20s}{'qualities':>12s}" + "".join(f"{n:>14d}" for n in SEQUENCES), flush=True)
    for shape in SHAPES:
        for name, spread in (("equal", 0.0), ("sd 25 %", 0.25), ("sd 70 %", 0.7)):
            cells = ""
            for n in SEQUENCES:
                found = []
                for trackers in TRACKERS:
                    quality = np.sort(np.random.default_rng(1).normal(0, 1, trackers)) * spread
                    found.append(simulate(shape, quality, n, boards, seed=trackers))
                right, apart = np.mean(found, axis=0)
                cells += f"{right:>8.3f}/{apart:.3f}"
            print(f"{shape:20s}{name:>12s}{cells}", flush=True)


if __name__ == "__main__":
    main()
