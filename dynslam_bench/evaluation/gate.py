"""Whether a change of a system made its errors smaller or larger: a sequential test over rounds of paired runs.

Candidate and baseline run in turns on the same sequences. A round gives every sequence one natural
logarithm of the candidate's error over the baseline's, below 0 is better. After 2, 3, 4, 6, 8 and 10
rounds the mean over sequences is compared with 0 and with a margin, at levels that spend 4 % of false alarms in all
(Kim and DeMets 1987, power function of degree 2). The scatter is that of the rounds within the
sequences, so a claim is about these sequences, not about others like them (Jennison and Turnbull 1989,
repeated confidence intervals).
"""

import math
from enum import Enum
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import stats

from dynslam_bench.evaluation.verdicts import FLOOR_M

Array = NDArray[np.float64]

LOOKS = {2: 0.0016, 3: 0.0027, 4: 0.0042, 6: 0.0105, 8: 0.0176, 10: 0.0269}
"""Rounds after which the data are looked at, to the two-sided level of that look.

By round k false alarms of 4 % * (k / 10)^2 are spent in all (Kim and DeMets 1987). Looks share their
data, so these levels are larger than the shares that they spend.
"""
ONE_LOOK = 0.04
"""Two-sided level where the data are looked at once, as with recorded runs."""
CLIP = math.log(3.0)
"""Log ratios are cut off here, and a run that one side alone lost counts as much: one run decides no gate.

Three times the scatter of a log ratio of ORB-SLAM3 on the noisiest sequence of its stored runs (0.25 a
run): ordinary scatter is not cut.
"""
MARGIN = 0.10
"""Differences below this share do not matter."""


class GateVerdict(str, Enum):
    """A gate's verdict on the candidate's errors."""

    IDENTICAL = "identical"
    IMPROVED = "improved"
    NO_DIFFERENCE = "no difference"
    REGRESSED = "regressed"
    UNDECIDED = "undecided"


class GateEstimate(NamedTuple):
    """A mean log ratio with its interval at the level of a look; infinite bounds where there is no scatter to tell."""

    centre: float
    low: float
    high: float


def log_ratios(candidate: ArrayLike, baseline: ArrayLike) -> Array:
    """Clipped log ratios ``[S, K]`` of errors in metres ``[S, K]`` of sequences and rounds; nan is a lost run.

    A run that the candidate alone lost counts as three times the error, one that the baseline alone
    lost as a third of it, and one that both lost as equal. Errors below `FLOOR_M` count as that.
    """
    errors = np.asarray(candidate, dtype=np.float64)
    errors_baseline = np.asarray(baseline, dtype=np.float64)
    ratios = np.log(np.maximum(errors, FLOOR_M)) - np.log(np.maximum(errors_baseline, FLOOR_M))
    lost = np.isnan(errors)
    lost_baseline = np.isnan(errors_baseline)
    ratios = np.where(lost & ~lost_baseline, CLIP, ratios)
    ratios = np.where(lost_baseline & ~lost, -CLIP, ratios)
    ratios = np.where(lost & lost_baseline, 0.0, ratios)
    return np.asarray(np.clip(ratios, -CLIP, CLIP))


def mean_ratio(ratios: ArrayLike, level: float | None = None) -> GateEstimate:
    """The mean over sequences of log ratios ``[S, K]``, with its interval.

    Args:
        ratios: Log ratios of sequences and rounds; one of each at least.
        level: Two-sided level of the interval; None for that of the look after so many rounds.

    Raises:
        ValueError: There is no look after so many rounds.
    """
    values = np.asarray(ratios, dtype=np.float64)
    sequences, rounds = values.shape
    if level is None:
        if rounds not in LOOKS:
            raise ValueError(
                f"no look after {rounds} rounds, only after {', '.join(map(str, LOOKS))}"
            )
        level = LOOKS[rounds]
    centre = float(values.mean())
    if rounds == 1:
        return GateEstimate(centre, -math.inf, math.inf)

    # the error of the mean, from the scatter of the rounds within each sequence
    variances = values.var(axis=1, ddof=1)
    error = math.sqrt(float(variances.sum()) / rounds) / sequences

    # a few noisy sequences may make up nearly all of it: then it is known as badly as they are few
    free = _degrees_of_freedom(variances, rounds)
    half = float(stats.t.isf(level / 2.0, free)) * error
    return GateEstimate(centre, centre - half, centre + half)


def _degrees_of_freedom(variances: Array, rounds: int) -> float:
    """Degrees of freedom of a mean over sequences whose variances ``[S]`` differ (Satterthwaite 1946).

    One pooled variance claims falsely in 11.7 % of gates where one of eight sequences scatters, this in
    4.7 %, for one run a sequence more.
    """
    # equal variances have them all, one that outweighs the others only its own
    most = len(variances) * (rounds - 1)
    squares = float(np.square(variances).sum())
    if squares == 0.0:
        return float(most)
    effective = (rounds - 1) * float(variances.sum()) ** 2 / squares
    return float(np.clip(effective, rounds - 1, most))


def decide(
    estimate: GateEstimate, lost: tuple[int, int] = (0, 0), margin: float = MARGIN
) -> GateVerdict:
    """The verdict at a look.

    Args:
        estimate: The mean log ratio of the errors.
        lost: Runs that the candidate lost, and the baseline.
        margin: Differences below this share do not matter.
    """
    if estimate.low > 0.0:
        return GateVerdict.REGRESSED
    # nothing good is said while the candidate is lost more often
    if lost[0] > lost[1]:
        return GateVerdict.UNDECIDED
    if estimate.high < 0.0:
        return GateVerdict.IMPROVED
    # both ends within the margin: two one-sided tests (Schuirmann 1987)
    edge = math.log1p(margin)
    if -edge < estimate.low and estimate.high < edge:
        return GateVerdict.NO_DIFFERENCE
    return GateVerdict.UNDECIDED


def is_lost_more(lost_alone: int, lost_alone_baseline: int, level: float) -> bool:
    """Whether the candidate is lost more often than chance explains (McNemar 1947, exact).

    Args:
        lost_alone: Pairs of runs in which the candidate alone was lost.
        lost_alone_baseline: Pairs of runs in which the baseline alone was.
        level: Two-sided level of the look.
    """
    if lost_alone <= lost_alone_baseline:
        return False
    both = lost_alone + lost_alone_baseline
    p_value = stats.binomtest(lost_alone, both, alternative="greater").pvalue
    return bool(p_value <= level / 2.0)
