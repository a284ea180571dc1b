"""Statistics of paired errors: the typical ratio of a candidate to a baseline, its losses, and a verdict.

All statistics are over scenes. A scene has one value: the natural logarithm of the candidate's error over
the baseline's, below 0 is better. Errors of a few scenes may be huge, so nothing here is a mean of errors:
the typical ratio is the pseudo-median (Hodges and Lehmann 1963) with the exact interval of Wilcoxon's
signed-rank test, over the scenes where both succeed. Scenes that one side lost are counted apart, since no
test bounds a mean that rare catastrophes may dominate (Bahadur and Savage 1956).
"""

import math
from bisect import bisect_left
from collections.abc import Collection, Mapping, Sequence
from enum import Enum
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import special, stats

from dynslam_bench.core.records import Record

Array = NDArray[np.float64]

FLOOR_M = 1e-4
"""Errors in metres below this count as this, everywhere: true poses of recordings are written to a tenth of a
millimetre, and the ratio of two runs with less error than that tells nothing."""
ONE_SIDED = 0.025
"""Level of a claim, one-sided: so often is something *proven* where nothing is better."""
FEWEST = 6
"""Scenes below which nothing is claimed: all of five signs agree by chance in 2^-5 > 2.5 %, of six in 2^-6."""
CATASTROPHE = 3.0
"""An error so many times the other's counts as a loss."""
MARGIN = 0.10
"""Differences below this share do not matter. To exclude 5 % at the usual scatter would take 330 scenes."""
POWER = 0.8
"""Chance with which the stated number of scenes shows what it is stated for."""
LOOKS = {12: 0.0062, 24: 0.0082, 36: 0.0103, 48: 0.0125}
"""Judging scenes of an extendable study to the one-sided level of the look at them: 2.5 % in all looks together
(Lan and DeMets 1983; looking again at the full level claims falsely in 5.6 to 6.1 % of studies)."""
USUAL_SPREAD = 0.39
"""Scatter over scenes of the log ratio of two configurations, one start each: measured 0.34 to 0.5 with settings that
have effects."""
ENOUGH_FOR_SPREAD = 12
"""Scenes from which on their own scatter is believed."""
_TIE = 1e-12
"""Log ratios below this are rounding: both errors are equal."""
_MANY_TIES = math.sqrt(0.5)
"""Share of ties above which the pseudo-median is one: its square is the share of pairs of ties."""
_WILCOXON_EFFICIENCY = 3.0 / math.pi
"""Pitman's efficiency of the signed-rank test on normal values: it needs 1 / 0.955 times the scenes of the t test."""
_MOST_SCENES = 100_000


class ComparisonVerdict(str, Enum):
    """A comparison's verdict on the candidate."""

    PROVEN = "proven"
    BUT_LOST = "smaller typical error, but lost"
    PROMISING = "promising"
    NO_DIFFERENCE = "no difference that matters"
    CANNOT_TELL = "cannot tell"
    WORSE = "worse"


# -- the typical ratio ------------------------------------------------------------------------------


class PseudoMedian(NamedTuple):
    """A typical log ratio with its interval; the bounds are infinite where there are too few scenes for any."""

    centre: float
    low: float
    high: float


def hodges_lehmann(log_ratios: ArrayLike, confidence: float = 0.95) -> PseudoMedian:
    """The pseudo-median of log ratios ``[S]``, and the exact interval that the signed-rank test leaves it.

    The interval holds all shifts that Wilcoxon's signed-rank test does not reject (Hodges and Lehmann 1963,
    Tukey 1949). It assumes scenes that are independent and scatter symmetrically, and no other shape.

    Args:
        log_ratios: One a scene, one at least.
        confidence: Probability, both sides together, with which the interval covers the true value.
    """
    values = np.asarray(log_ratios, dtype=np.float64)

    # Walsh averages: the means of all pairs of scenes, each scene with itself among them
    first, second = np.triu_indices(len(values))
    averages = np.sort((values[first] + values[second]) / 2.0)

    # as many averages are cut off at either end as the test's critical rank sum says
    cut = _critical_rank_sum(len(values), round((1.0 - confidence) / 2.0, 12))
    centre = float(np.median(averages))
    if cut == 0:
        return PseudoMedian(centre, -math.inf, math.inf)
    return PseudoMedian(centre, float(averages[cut - 1]), float(averages[-cut]))


@lru_cache(maxsize=1024)
def _critical_rank_sum(count: int, tail: float) -> int:
    """Number of values of the signed-rank sum of `count` scenes that have at most `tail` of probability at one end."""
    # Exact null distribution: rank r is added or not, each with probability one half.
    probabilities = np.ones(1)
    for rank in range(1, count + 1):
        padding = np.zeros(rank)
        without_rank = np.concatenate([probabilities, padding])
        with_rank = np.concatenate([padding, probabilities])
        probabilities = (without_rank + with_rank) / 2.0
    return int(np.searchsorted(np.cumsum(probabilities), tail, side="right"))


def interval_with_ties(log_ratios: ArrayLike, confidence: float = 0.90) -> PseudoMedian:
    """Confidence interval of the typical log ratio that stays valid with ties.

    It is used to exclude differences; infinite bounds exclude none. Without ties it is that of `hodges_lehmann`.
    A setting that rarely acts leaves both errors exactly equal in many scenes. Such ratios do not scatter
    symmetrically about a typical one that is not 1, which the signed-rank test assumes: with them it excludes
    falsely in up to 11 %. With ties each of two arguments may narrow the interval:

    - The other scenes alone (Wilcoxon 1945). Their interval, which holds given the number of ties, is widened to
      contain 0: the typical ratio of all scenes lies between theirs and 1.
    - So many ties that more than `_MANY_TIES` of all scenes are ties (Clopper and Pearson 1934). Then more than half
      of the Walsh averages are exactly 0, and so is the pseudo-median. The interval still contains the estimate
      of the other scenes.

    Args:
        log_ratios: One a scene ``[S]``, one at least.
        confidence: Probability, both sides together, with which the interval covers the true value.
    """
    values = np.asarray(log_ratios, dtype=np.float64)
    untied = values[np.abs(values) > _TIE]
    ties = len(values) - len(untied)
    if not ties:
        return hodges_lehmann(values, confidence)

    # the scenes without a tie
    low = -math.inf
    high = math.inf
    centre = 0.0
    if len(untied):
        centre, low, high = hodges_lehmann(untied, confidence)

    # so many ties that the typical ratio is 1
    least_share = stats.beta.ppf((1.0 - confidence) / 2.0, ties, len(untied) + 1)
    if least_share > _MANY_TIES:
        low = max(low, min(centre, 0.0))
        high = min(high, max(centre, 0.0))
    return PseudoMedian(centre, min(low, 0.0), max(high, 0.0))


# -- a comparison over scenes -------------------------------------------------------------------------


class PairedRatio(Record):
    """A candidate beside a baseline over scenes: the typical ratio where both succeed, and the losses.

    Attributes:
        ratio: Typical ratio, below 1 is better; None where both succeed in no scene.
        low: Lower end of the interval at the level of the comparison; None where there are too few
            scenes for one.
        high: Upper end.
        low_90: Lower end of the interval by which differences are excluded, 90 % at the usual level of
            a claim; None likewise.
        high_90: Upper end.
        high_80: Upper end of the 80 % interval; None likewise.
        spread: Standard deviation of the log ratio over these scenes; None for fewer than two.
        scenes: Scenes where both succeed.
        ties: How many of them have exactly the same error on both sides.
        floored: In how many of them an error is below `FLOOR_M`, and counts as that.
        lost: Scenes that the candidate alone lost.
        much_worse: Scenes where both succeed and the candidate has more than `CATASTROPHE` times the error.
        lost_baseline: Scenes that the baseline alone lost.
        much_better: Scenes where the baseline has more than `CATASTROPHE` times the error.
        lost_both: Scenes that both lost.
        worst: The scene with the largest ratio; empty where `ratio` is None.
        worst_ratio: Ratio of that scene; None where `ratio` is None.
        one_sided: Level of a claim.
        runs: Paired runs behind the scenes.
        lost_runs: How many of them the candidate lost, and the baseline, whether or not that lost a
            scene.
        what: What the ratio is one of.
    """

    ratio: float | None = None
    low: float | None = None
    high: float | None = None
    low_90: float | None = None
    high_90: float | None = None
    high_80: float | None = None
    spread: float | None = None
    scenes: int = 0
    ties: int = 0
    floored: int = 0
    lost: tuple[str, ...] = ()
    much_worse: tuple[str, ...] = ()
    lost_baseline: tuple[str, ...] = ()
    much_better: tuple[str, ...] = ()
    lost_both: tuple[str, ...] = ()
    worst: str = ""
    worst_ratio: float | None = None
    one_sided: float = ONE_SIDED
    runs: int = 0
    lost_runs: tuple[int, int] = (0, 0)
    what: str = "ATE"

    @property
    def all_scenes(self) -> int:
        """Scenes that were run, lost ones among them."""
        return self.scenes + len(self.lost) + len(self.lost_baseline) + len(self.lost_both)

    @property
    def losses(self) -> tuple[str, ...]:
        """Scenes that the candidate alone lost or is much worse in."""
        return (*self.lost, *self.much_worse)

    @property
    def losses_baseline(self) -> tuple[str, ...]:
        """Scenes that the baseline alone lost or is much worse in."""
        return (*self.lost_baseline, *self.much_better)

    @property
    def loss_share(self) -> float:
        """Upper 95 % bound of the share of scenes in `losses` (Clopper and Pearson 1934)."""
        losses = len(self.losses)
        if losses >= self.all_scenes:
            return 1.0
        return float(stats.beta.ppf(0.95, losses + 1, self.all_scenes - losses))

    @property
    def loses_more(self) -> bool:
        """Whether the candidate loses more scenes than the baseline by McNemar's exact test."""
        return loses_more_p(len(self.losses), len(self.losses_baseline)) <= ONE_SIDED

    @property
    def loses_no_more(self) -> bool:
        """Whether the candidate lost no more scenes and no more runs than the baseline."""
        by_runs = self.lost_runs[0] <= self.lost_runs[1]
        return len(self.losses) <= len(self.losses_baseline) and by_runs

    @property
    def excluded(self) -> float | None:
        """Share above which a difference to either side is excluded; None without an interval."""
        if self.low_90 is None or self.high_90 is None:
            return None
        return max(1.0 / self.low_90, self.high_90) - 1.0

    @property
    def interval(self) -> str:
        """The interval in brackets; empty without one."""
        return "" if self.low is None or self.high is None else f"[{self.low:.3f}, {self.high:.3f}]"

    def __str__(self) -> str:
        if self.ratio is None:
            return f"{self.what}: no scene where both succeed"
        return f"{self.what} x {self.ratio:.3f} {self.interval or 'without an interval'}"


def loses_more_p(lost: int, lost_other: int) -> float:
    """One-sided p value of losing no more than the other, by McNemar's exact test (1947).

    Args:
        lost: Scenes that one side alone lost.
        lost_other: Scenes that the other alone lost.
    """
    # what both or neither lost tells nothing; of the rest each side loses half, as coins fall
    return float(special.bdtrc(lost - 1, lost + lost_other, 0.5)) if lost else 1.0


def paired_ratio(
    log_ratios: Mapping[str, float],
    lost: Collection[str] = (),
    lost_baseline: Collection[str] = (),
    *,
    one_sided: float = ONE_SIDED,
    runs: int | None = None,
    lost_runs: tuple[int, int] = (0, 0),
    floored: Collection[str] = (),
    what: str = "ATE",
) -> PairedRatio:
    """Compare a candidate with a baseline over scenes.

    Args:
        log_ratios: Scene to the natural logarithm of the candidate's error over the baseline's; those of
            scenes that one side lost do not count. What is no finite number is lost by the candidate.
        lost: Scenes that the candidate lost, by the same names.
        lost_baseline: Scenes that the baseline lost.
        one_sided: Level of a claim.
        runs: Paired runs behind the scenes; None for one a scene.
        lost_runs: How many of them candidate and baseline lost.
        floored: Scenes with an error below `FLOOR_M`.
        what: What the ratio is one of.
    """
    by_candidate = set(lost) | {
        name for name, value in log_ratios.items() if not math.isfinite(value)
    }
    by_baseline = set(lost_baseline)
    paired = {
        name: value
        for name, value in log_ratios.items()
        if name not in by_candidate and name not in by_baseline
    }
    threshold = math.log(CATASTROPHE)
    counts: dict[str, Any] = {
        "scenes": len(paired),
        "lost": tuple(sorted(by_candidate - by_baseline)),
        "lost_baseline": tuple(sorted(by_baseline - by_candidate)),
        "lost_both": tuple(sorted(by_candidate & by_baseline)),
        "much_worse": tuple(name for name, value in paired.items() if value > threshold),
        "much_better": tuple(name for name, value in paired.items() if value < -threshold),
        "one_sided": one_sided,
        "runs": len(log_ratios) if runs is None else runs,
        "lost_runs": lost_runs,
        "floored": len(paired.keys() & set(floored)),
        "what": what,
    }
    if not paired:
        return PairedRatio(**counts)

    values = np.array(list(paired.values()))
    worst = max(paired, key=paired.__getitem__)
    claim = hodges_lehmann(values, 1.0 - 2.0 * one_sided)
    # two one-sided tests of 5 %, whose level a planned look has its share of, too
    within_90 = interval_with_ties(values, 1.0 - 4.0 * one_sided)
    within_80 = hodges_lehmann(values, 0.80)
    return PairedRatio(
        ratio=_ratio(claim.centre),
        low=_bound(claim.low),
        high=_bound(claim.high),
        low_90=_bound(within_90.low),
        high_90=_bound(within_90.high),
        high_80=_bound(within_80.high),
        spread=float(np.std(values, ddof=1)) if len(values) > 1 else None,
        ties=int((np.abs(values) <= _TIE).sum()),
        worst=worst,
        worst_ratio=_ratio(paired[worst]),
        **counts,
    )


_LARGEST_LOG = 700.0
"""Larger logarithms overflow."""


def _ratio(log_ratio: float) -> float:
    return math.exp(float(np.clip(log_ratio, -_LARGEST_LOG, _LARGEST_LOG)))


def _bound(log_ratio: float) -> float | None:
    return _ratio(log_ratio) if math.isfinite(log_ratio) else None


# -- the verdict -----------------------------------------------------------------------------------


def verdict_of(comparison: PairedRatio, margin: float = MARGIN) -> ComparisonVerdict:
    """The verdict on a candidate: the first of the rules that holds.

    Args:
        comparison: The candidate beside the baseline.
        margin: Differences below this share do not matter.
    """
    losses = len(comparison.losses)
    losses_baseline = len(comparison.losses_baseline)

    # more losses than the baseline's, beyond chance
    if comparison.loses_more:
        return ComparisonVerdict.WORSE

    # too few scenes for any claim
    low = comparison.low
    high = comparison.high
    if comparison.scenes < FEWEST:
        return ComparisonVerdict.CANNOT_TELL

    # the typical error differs
    if low is not None and low > 1.0:
        return ComparisonVerdict.WORSE
    if high is not None and high < 1.0:
        return ComparisonVerdict.PROVEN if comparison.loses_no_more else ComparisonVerdict.BUT_LOST

    # both ends of the interval within the margin: two one-sided tests (Schuirmann 1987)
    excluded = comparison.excluded
    if excluded is not None and excluded < margin and abs(losses - losses_baseline) <= 1:
        return ComparisonVerdict.NO_DIFFERENCE

    # said in one of ten comparisons where nothing is better
    if comparison.high_80 is not None and comparison.high_80 < 1.0:
        return ComparisonVerdict.PROMISING
    return ComparisonVerdict.CANNOT_TELL


def findings(
    comparison: PairedRatio, subject: str = "the candidate", margin: float = MARGIN
) -> list[str]:
    """Findings of a comparison in short sentences without full stops: claim, exclusion, every loss.

    Args:
        comparison: The candidate beside the baseline.
        subject: What to call the candidate, e.g. ``trial 7``.
        margin: Differences below this share do not matter.
    """
    verdict = verdict_of(comparison, margin)
    sentences = [_claim(comparison, verdict, subject)]
    excluded = comparison.excluded
    states_exclusion = verdict in (ComparisonVerdict.NO_DIFFERENCE, ComparisonVerdict.CANNOT_TELL)
    if states_exclusion and excluded is not None and comparison.scenes >= FEWEST:
        sentences.append(f"Differences above {_percent_up(excluded)} % are excluded")
    if comparison.ties:
        sentences.append(f"Both have exactly the same error in {_scenes(comparison.ties)}")
    if comparison.floored:
        floor = f"{1000 * FLOOR_M:g} mm"
        in_scenes = _scenes(comparison.floored)
        sentences.append(f"In {in_scenes} an error below {floor} counts as {floor}")
    return sentences + _loss_sentences(comparison, subject)


def _claim(comparison: PairedRatio, verdict: ComparisonVerdict, subject: str) -> str:
    """The first sentence: what the candidate has, beside the numbers that show it."""
    if comparison.ratio is None:
        if not comparison.all_scenes:
            return f"{subject} was compared on no scene"
        more = " loses more scenes than the baseline:" if verdict is ComparisonVerdict.WORSE else ""
        of_all = f"both succeed on none of {_scenes(comparison.all_scenes)}"
        return f"{subject}{more} {of_all}" if more else f"{subject} and the baseline {of_all}"
    numbers = f"{comparison} on {_scenes(comparison.scenes)}"
    percent = abs(100.0 * (1.0 - comparison.ratio))
    if verdict is ComparisonVerdict.PROVEN:
        return f"{subject} has {percent:.1f} % less {comparison.what}: {numbers}"
    if verdict is ComparisonVerdict.BUT_LOST:
        lost_in = f"{len(comparison.losses)} of {_scenes(comparison.all_scenes)}"
        if len(comparison.losses) <= len(comparison.losses_baseline):
            lost_in = f"{comparison.lost_runs[0]} of {comparison.runs} runs"
        typical = f"a smaller typical {comparison.what}"
        return f"{subject} has {typical}, but lost in {lost_in}: {numbers}"
    if verdict is ComparisonVerdict.PROMISING:
        return f"{subject} has perhaps {percent:.1f} % less {comparison.what}: {numbers}"
    if verdict is ComparisonVerdict.WORSE and comparison.loses_more:
        return f"{subject} loses more scenes than the baseline, where both succeed {numbers}"
    if verdict is ComparisonVerdict.WORSE:
        return f"{subject} has {percent:.1f} % more {comparison.what}: {numbers}"
    if comparison.scenes < FEWEST:
        return f"{subject} has {numbers}, and {FEWEST} are the fewest for a claim"
    return f"{subject} has {numbers}"


def _loss_sentences(comparison: PairedRatio, subject: str) -> list[str]:
    """Every loss of either side, with names and numbers; empty without any."""
    sentences = []
    if comparison.lost:
        sentences.append(f"{subject} alone lost {_named(comparison.lost)}")
    if comparison.much_worse:
        times = f"more than {CATASTROPHE:g} times the {comparison.what}"
        worst = f"at worst x {comparison.worst_ratio:.3g} in {comparison.worst}"
        sentences.append(f"{subject} has {times} in {_scenes(len(comparison.much_worse))}, {worst}")
    if comparison.losses:
        share = _percent_up(comparison.loss_share)
        sentences.append(f"Such losses are at most {share} % of scenes, with 95 % confidence")
    if comparison.lost_baseline:
        sentences.append(f"The baseline alone lost {_named(comparison.lost_baseline)}")
    if comparison.much_better:
        times = f"more than {CATASTROPHE:g} times the {comparison.what}"
        sentences.append(f"The baseline has {times} in {_named(comparison.much_better)}")
    if comparison.lost_both:
        sentences.append(f"Both lost {_named(comparison.lost_both)}")
    if max(comparison.lost_runs) > 0:
        by_candidate, by_baseline = comparison.lost_runs
        sentences.append(
            f"Of {comparison.runs} runs {subject} lost {by_candidate}, the baseline {by_baseline}"
        )
    return sentences


def _percent_up(share: float) -> int:
    """A bound in whole percent, never rounded down."""
    return math.ceil(round(100.0 * share, 6))


_MOST_NAMED = 3
"""Scenes that a sentence names; it counts the rest."""


def _named(names: Sequence[str]) -> str:
    shown = ", ".join(names[:_MOST_NAMED])
    rest = len(names) - _MOST_NAMED
    return f"{_scenes(len(names))} ({shown}{f' and {rest} more' if rest > 0 else ''})"


def _scenes(count: int) -> str:
    return f"{count} scene" if count == 1 else f"{count} scenes"


# -- how many scenes a claim takes --------------------------------------------------------------------


def power(gain: float, spread: float, scenes: int, one_sided: float = ONE_SIDED) -> float:
    """Chance that so many scenes show a gain; 0 below `FEWEST`.

    Args:
        gain: Share of the error that the candidate has less of, in (0, 1).
        spread: Standard deviation over scenes of the log ratio.
        scenes: Scenes that judge.
        one_sided: Level of the claim.
    """
    if scenes < FEWEST:
        return 0.0
    if spread <= 0.0:
        return 1.0
    effective = _WILCOXON_EFFICIENCY * scenes
    noncentrality = -math.log1p(-gain) / spread * math.sqrt(effective)
    critical = stats.t.isf(one_sided, scenes - 1)
    return float(stats.nct.sf(critical, scenes - 1, noncentrality))


def detectable(spread: float, scenes: int, one_sided: float = ONE_SIDED) -> float:
    """Smallest gain, as a share, that so many scenes show in four of five studies; 1 below `FEWEST`."""
    if scenes < FEWEST:
        return 1.0
    freedom = scenes - 1
    quantiles = stats.t.isf(one_sided, freedom) + stats.t.ppf(POWER, freedom)
    standard_error = spread / math.sqrt(_WILCOXON_EFFICIENCY * scenes)
    return float(-math.expm1(-quantiles * standard_error))


def scenes_needed(gain: float, spread: float, one_sided: float = ONE_SIDED) -> int:
    """The fewest scenes that show a gain in four of five studies, at most 100,000; see `detectable`."""
    counts = range(FEWEST, _MOST_SCENES)
    return FEWEST + bisect_left(
        counts, True, key=lambda count: detectable(spread, count, one_sided) <= gain
    )


def scenes_to_exclude(margin: float, spread: float) -> int:
    """The fewest scenes that exclude differences above a margin in four of five studies where there is none."""
    # two one-sided 5 % tests, of which each fails in half of the remaining 20 %
    quantiles = stats.norm.isf(0.05) + stats.norm.isf((1.0 - POWER) / 2.0)
    by_normal = (quantiles * spread / math.log1p(margin)) ** 2
    return max(FEWEST, math.ceil(by_normal / _WILCOXON_EFFICIENCY) + 2)


def scenes_to_settle(comparison: PairedRatio, margin: float = MARGIN) -> int | None:
    """Scenes in all that would settle what a comparison leaves open, if the truth is what it estimates.

    That is the gain or loss where it is above the margin, else that no difference matters.

    Returns:
        None where that cannot be told: no scatter is known.
    """
    if comparison.ratio is None or comparison.spread is None:
        return None
    # few scenes tell little of the scatter: then it is at least the usual one
    spread = comparison.spread
    if comparison.scenes < ENOUGH_FOR_SPREAD:
        spread = max(spread, USUAL_SPREAD)

    # a loss of x 1.25 is as far from 1 as a gain to x 0.8
    difference = 1.0 - min(comparison.ratio, 1.0 / comparison.ratio)
    if difference > 1.0 - 1.0 / (1.0 + margin):
        paired = scenes_needed(difference, spread, comparison.one_sided)
    else:
        paired = _scenes_to_exclude_with_ties(comparison, margin, spread)

    # where some scenes are lost, so many more are run; those here have not settled it
    run = math.ceil(paired * comparison.all_scenes / comparison.scenes)
    return max(run, comparison.all_scenes + 1)


def _scenes_to_exclude_with_ties(comparison: PairedRatio, margin: float, spread: float) -> int:
    """Scenes that exclude differences where some scenes are ties, see `interval_with_ties`."""
    paired = scenes_to_exclude(margin, spread)
    if not comparison.ties:
        return paired
    # so many scenes show by their ties alone that most are ties
    if comparison.ties == comparison.scenes:
        return math.ceil(math.log(2.0 * comparison.one_sided) / math.log(_MANY_TIES))
    # the scatter of all scenes is that of the others times the root of their share
    share = 1.0 - comparison.ties / comparison.scenes
    return math.ceil(paired / share**2)


# -- boards: several trackers beside one reference, sequences of several families ----------------------

FEWEST_FREE = 6
"""Degrees of freedom within families below which nothing is said of them."""
FEWEST_FAMILIES = 4
"""Families below which nothing is said beyond them."""
_SMALLEST_ERROR = 1e-12
"""Standard errors below this are rounding."""


class FamilyTest(NamedTuple):
    """Tests of one tracker against the reference.

    Attributes:
        centre: Mean over families of their mean log ratios.
        families: How many families have a sequence where both succeed.
        these_error: Standard error from the scatter within families, which says nothing of others.
        these_free: Its degrees of freedom.
        these_p: Two-sided p value of no difference on these families; 1 where nothing can be said.
        beyond_error: Standard error from the scatter of the family means.
        beyond_free: Its degrees of freedom; of Kish's effective number of families where weights differ.
        beyond_p: Two-sided p value of no difference over all such families; 1 likewise.
    """

    centre: float
    families: int
    these_error: float
    these_free: int
    these_p: float
    beyond_error: float
    beyond_free: float
    beyond_p: float


def family_test(
    log_ratios: ArrayLike, families: Sequence[str], weights: Mapping[str, float] | None = None
) -> FamilyTest:
    """Test one tracker's log ratios to the reference, on these families and beyond them.

    Args:
        log_ratios: One a sequence ``[S]``; nan where either side is lost: it does not count.
        families: Family of each sequence.
        weights: Weight of each family; all the same where there are none.
    """
    values = np.asarray(log_ratios, dtype=np.float64)
    is_known = np.isfinite(values)
    if not is_known.any():
        return FamilyTest(math.nan, 0, math.nan, 0, 1.0, math.nan, 0.0, 1.0)

    # number of sequences and mean of every family with a value
    values = values[is_known]
    of_each = [family for family, is_in in zip(families, is_known.tolist(), strict=True) if is_in]
    number = {family: at for at, family in enumerate(dict.fromkeys(of_each))}
    numbers = np.array([number[family] for family in of_each])
    sizes = np.bincount(numbers)
    means = np.bincount(numbers, values) / sizes
    count = len(number)
    share = np.array([1.0 if weights is None else weights[family] for family in number])
    share = share / share.sum()
    centre = float(share @ means)

    # on these families: the pooled variance within them
    free = len(values) - count
    squares = float(np.square(values - means[numbers]).sum())
    pooled = squares / max(free, 1)
    these_error = math.sqrt(pooled * float((share**2 / sizes).sum()))
    these_p = _two_sided(centre, these_error, free) if free >= FEWEST_FREE else 1.0

    # beyond them: the family is the sample; with equal weights this is Student's t test
    effective = 1.0 / float((share**2).sum())
    beyond_free = effective - 1.0
    beyond_error = math.nan
    beyond_p = 1.0
    if count > 1:
        squares = float(np.square(share * (means - centre)).sum())
        beyond_error = math.sqrt(squares * effective / beyond_free)
    if count >= FEWEST_FAMILIES:
        beyond_p = _two_sided(centre, beyond_error, beyond_free)
    return FamilyTest(
        centre, count, these_error, free, these_p, beyond_error, beyond_free, beyond_p
    )


def _two_sided(centre: float, error: float, free: float) -> float:
    if abs(centre) < _SMALLEST_ERROR:
        return 1.0
    # Student's t as `scipy.stats` computes it, without what that checks before
    return float(2.0 * special.stdtr(free, -abs(centre) / max(error, _SMALLEST_ERROR)))


def resolution_floor(error: float, degrees_of_freedom: float, trackers: int, level: float) -> float:
    """Smallest gain, as a share, that a board of so many trackers shows in four of five; 1 where it shows none.

    Args:
        error: Standard error of the log ratio.
        degrees_of_freedom: Degrees of freedom of the standard error.
        trackers: How many are compared with the reference (Bonferroni, Holm's first step).
        level: Chance of any false claim.
    """
    if degrees_of_freedom < 1 or not math.isfinite(error):
        return 1.0
    # the smallest log gain is (t of the level + t of the power) standard errors; as a share of the error
    t_of_level = stats.t.isf(level / (2 * trackers), degrees_of_freedom)
    t_of_power = stats.t.ppf(POWER, degrees_of_freedom)
    return float(-math.expm1(-(t_of_level + t_of_power) * error))


def may_be_best(
    logs: ArrayLike,
    families: Sequence[str],
    level: float = 0.05,
    weights: Mapping[str, float] | None = None,
) -> list[int]:
    """Numbers of the trackers that no rival beats; the best one is among them in 95 % (Hsu 1984).

    Rivals of one candidate are Bonferroni-corrected; candidates need not be, since the claim is about the
    best one alone (Mogstad and others 2024). The family is the sample. Two trackers are compared where both
    succeed; who loses more sequences than the other is not said to beat it.

    Args:
        logs: Log errors ``[T, S]``; nan where a tracker lost.
        families: Family of each sequence.
        level: Chance that the best one is not among them.
        weights: Weight of each family; all the same where there are none.
    """
    errors = np.asarray(logs, dtype=np.float64)
    is_lost = ~np.isfinite(errors)
    if len(set(families)) < FEWEST_FAMILIES:
        return list(range(len(errors)))
    remaining = []
    for candidate, own in enumerate(errors):
        # the rival that beats it most clearly
        p_values = [1.0]
        for rival, other in enumerate(errors):
            if rival == candidate or is_lost[rival].sum() > is_lost[candidate].sum():
                continue
            tested = family_test(own - other, families, weights)
            if tested.families >= FEWEST_FAMILIES:
                statistic = tested.centre / max(tested.beyond_error, _SMALLEST_ERROR)
                p_values.append(float(stats.t.sf(statistic, tested.beyond_free)))
        if min(p_values) * (len(errors) - 1) > level or len(errors) == 1:
            remaining.append(candidate)
    return remaining
