"""How often verdicts are wrong, and how often they show what is there: studies, extended studies and boards.

    python tests/benchmarks/verdict_errors.py [--simulations 10000] [--table null margin power extend board]

Scenes are simulated: natural logarithms of a candidate's error over the baseline's. Worlds:

- normal, t with three degrees of freedom, heteroscedastic (each scene has a scatter of its own);
- symmetric losses: either side loses 5 % of the scenes;
- rare losses: the candidate has ten times the error in 6 % of the scenes, the typical ratio is 1;
- families: scenes of eight families whose own effects scatter. The truth is the mean of the families
  that were drawn, since a study and a board's first sentence speak of "these families";
- duplicates: every second scene is a copy of another one, which counts once;
- ties: in 60 % of the scenes the setting does not act, and both errors are equal to the last bit.

A verdict is wrong where it says *proven* and the truth is no gain, or *no difference that matters* and
the truth is at the margin. A board is wrong where any of its claims is; under rare losses *worse* is none of
them, since the mean over sequences is larger. Studies and
boards are judged by a form of the rules that takes all simulations at once; the first of each cell are compared
with the package's own.
Percentages stand beside the number of simulations; their standard error is at most 0.16 points at 2.5 % of
10,000.
"""

import math
from collections.abc import Mapping
from functools import cache
from typing import NamedTuple

import numpy as np
from command_line import parser_of
from numpy.typing import NDArray
from scipy import optimize, special, stats

from dynslam_bench.evaluation.verdicts import (
    CATASTROPHE,
    FEWEST_FAMILIES,
    FEWEST_FREE,
    LOOKS,
    MARGIN,
    ONE_SIDED,
    ComparisonVerdict,
    hodges_lehmann,
    interval_with_ties,
    paired_ratio,
    verdict_of,
)
from dynslam_bench.evaluation.verdicts import (
    FEWEST as FEWEST_SCENES,
)
from dynslam_bench.reports.model.statistics import (
    FAMILY_ERROR,
    FEWEST,
    LOSS_ERROR,
    Scope,
    claims_against,
    sequences_of,
)

Array = NDArray[np.float64]
SCENES = (3, 8, 14, 24, 48)
SPREAD = 0.35
"""Scatter over scenes of the log ratio, as measured with one start (0.34 to 0.5)."""
LOSS_SHARE = 0.05
RARE_LOSSES = 0.06
TEN_TIMES = math.log(10.0)
FAMILIES = 8
FAMILY_SPREAD = 0.2


COMPARED = 40
"""Boards or studies of a cell whose claims are compared with those of the package."""
TIES = 0.6
"""Share of scenes in which a setting does not act; with more than 0.71 the typical ratio is 1 whatever it does."""

Scenes = tuple[Array, NDArray[np.bool_], NDArray[np.bool_]]
"""Log ratios by scene, and which scenes the candidate and the baseline lost."""


def none_lost(values: Array) -> Scenes:
    """The values, with no scene lost."""
    nothing = np.zeros(len(values), dtype=bool)
    return values, nothing, nothing


def normal(rng: np.random.Generator, count: int, typical: float) -> Scenes:
    """Equal normal scatter."""
    return none_lost(rng.normal(typical, SPREAD, count))


def heavy_tails(rng: np.random.Generator, count: int, typical: float) -> Scenes:
    """Student's t with three degrees of freedom, scaled to the same standard deviation."""
    return none_lost(typical + SPREAD / math.sqrt(3.0) * rng.standard_t(3, count))


def heteroscedastic(rng: np.random.Generator, count: int, typical: float) -> Scenes:
    """Scenes scatter by 0.05 to 1, evenly in the logarithm."""
    spreads = np.exp(rng.uniform(math.log(0.05), 0.0, count))
    return none_lost(typical + rng.normal(0.0, 1.0, count) * spreads)


def symmetric_losses(rng: np.random.Generator, count: int, typical: float) -> Scenes:
    """Either side loses some scenes, as often as the other."""
    values = rng.normal(typical, SPREAD, count)
    return values, rng.random(count) < LOSS_SHARE, rng.random(count) < LOSS_SHARE


def rare_losses(rng: np.random.Generator, count: int, typical: float) -> Scenes:
    """The candidate has ten times the error in a few scenes; in the others the typical ratio is as given."""
    values = rng.normal(typical, SPREAD, count)
    return none_lost(values + TEN_TIMES * (rng.random(count) < RARE_LOSSES))


def families(rng: np.random.Generator, count: int, typical: float) -> Scenes:
    """Scenes of families whose effects differ; the mean of those effects is as given."""
    effects = rng.normal(0.0, FAMILY_SPREAD, FAMILIES)
    members = np.arange(count) % FAMILIES
    drawn = np.unique(members)
    effects -= effects[drawn].mean()
    return none_lost(typical + effects[members] + rng.normal(0.0, SPREAD, count))


def duplicates(rng: np.random.Generator, count: int, typical: float) -> Scenes:
    """Every second scene is a copy, and counts once with its original."""
    return none_lost(rng.normal(typical, SPREAD, math.ceil(count / 2)))


def ties(rng: np.random.Generator, count: int, typical: float) -> Scenes:
    """In some scenes both sides are equal; in the others the effect is such that the pseudo-median is as given."""
    acts = rng.random(count) >= TIES
    return none_lost(acts * rng.normal(_effect_beside_ties(typical), SPREAD / 2.0, count))


@cache
def _effect_beside_ties(typical: float) -> float:
    """Effect in the scenes without a tie with which half of the Walsh averages of all scenes are below the given."""
    if typical == 0.0:
        return 0.0
    spread = SPREAD / 2.0

    def share_below(effect: float) -> float:
        of_ties = TIES**2 * (typical > 0.0)
        mixed = 2.0 * TIES * (1.0 - TIES) * stats.norm.cdf(2.0 * typical, effect, spread)
        of_others = (1.0 - TIES) ** 2 * stats.norm.cdf(typical, effect, spread / math.sqrt(2.0))
        return float(of_ties + mixed + of_others)

    return float(optimize.brentq(lambda effect: share_below(effect) - 0.5, -5.0, 5.0))


WORLDS = {
    "normal": normal,
    "t3": heavy_tails,
    "heteroscedastic": heteroscedastic,
    "symmetric losses": symmetric_losses,
    "rare losses": rare_losses,
    "families": families,
    "duplicates": duplicates,
    "ties": ties,
}


def judge(
    values: Array, lost: Array, lost_baseline: Array, one_sided: float = ONE_SIDED
) -> ComparisonVerdict:
    """The verdict on simulated scenes."""
    names = np.array([str(number) for number in range(len(values))])
    log_ratios = dict(zip(names.tolist(), values.tolist(), strict=True))
    comparison = paired_ratio(log_ratios, names[lost], names[lost_baseline], one_sided=one_sided)
    return verdict_of(comparison)


def share_of(
    verdict: ComparisonVerdict, world: str, scenes: int, shift: float, simulations: int
) -> float:
    """How often a world whose typical log ratio is `shift` gets a verdict."""
    rng = np.random.default_rng([scenes, simulations, list(WORLDS).index(world)])
    studies = drawn_studies(rng, world, scenes, shift, simulations)
    return float(is_said_of(studies, verdict, ONE_SIDED).mean())


def drawn_studies(
    rng: np.random.Generator, world: str, scenes: int, shift: float, simulations: int
) -> tuple[Array, Array, Array]:
    """Log ratios of so many studies, and what either side lost, each ``[N, S]``."""
    drawn = [WORLDS[world](rng, scenes, shift) for _ in range(simulations)]
    values, lost, lost_baseline = zip(*drawn, strict=True)
    return np.array(values), np.array(lost), np.array(lost_baseline)


def is_said_of(
    studies: tuple[Array, Array, Array], verdict: ComparisonVerdict, level: float
) -> Array:
    """Which studies get a verdict ``[N]``.

    Raises:
        RuntimeError: The first ones do not get that of the package.
    """
    is_said = verdicts_of_many(*studies, level)[verdict]
    for number in range(COMPARED):
        own = judge(*(part[number] for part in studies), one_sided=level)
        if (own is verdict) != is_said[number]:
            raise RuntimeError(f"study {number} is {own.value}, not as simulated")
    return is_said


def line(*cells: object) -> str:
    """A row of a table; floats are shares."""
    texts = [f"{100 * cell:.1f}" if isinstance(cell, float) else str(cell) for cell in cells]
    return f"| {' | '.join(texts)} |"


def table_of_worlds(title: str, verdict: ComparisonVerdict, shift: float, simulations: int) -> None:
    """One verdict in every world, by the number of scenes."""
    print(f"\n{title}\n")
    print(line("world", *(f"{scenes} scenes" for scenes in SCENES)))
    print(line("---", *("---" for _ in SCENES)))
    for world in WORLDS:
        shares = (share_of(verdict, world, scenes, shift, simulations) for scenes in SCENES)
        print(line(world, *shares), flush=True)


def null(simulations: int) -> None:
    """*Proven* where nothing is better."""
    title = "*proven* where the typical ratio is 1, % (bar: 3.0; with three scenes none)"
    table_of_worlds(title, ComparisonVerdict.PROVEN, 0.0, simulations)


def margin(simulations: int) -> None:
    """*No difference that matters* where the difference is the margin."""
    title = "*no difference that matters* where the typical ratio is 1.1, % (bar: 5)"
    table_of_worlds(title, ComparisonVerdict.NO_DIFFERENCE, math.log1p(MARGIN), simulations)


def power(simulations: int) -> None:
    """*Proven* where the candidate has 20 % less error."""
    title = "*proven* where the typical ratio is 0.8, %"
    table_of_worlds(title, ComparisonVerdict.PROVEN, math.log(0.8), simulations)


def extend(simulations: int) -> None:
    """What an extendable study says at any of its looks: where nothing is better, and where there is a difference."""
    print("\nextendable studies: what is said at any look, %\n")
    margin_words = "*no difference that matters* at the margin (bar: 5)"
    print(
        line(
            "world",
            "*proven* where nothing is better (bar: 3.0)",
            "*proven* where the error is 20 % less",
            margin_words,
            "*proven* by naive looks at 2.5 %",
        )
    )
    print(line(*["---"] * 5))
    naive = dict.fromkeys(LOOKS, ONE_SIDED)
    cells = (
        (0.0, LOOKS, ComparisonVerdict.PROVEN),
        (math.log(0.8), LOOKS, ComparisonVerdict.PROVEN),
        (math.log1p(MARGIN), LOOKS, ComparisonVerdict.NO_DIFFERENCE),
        (0.0, naive, ComparisonVerdict.PROVEN),
    )
    for world in WORLDS:
        shares = (share_at_any_look(world, *cell, simulations) for cell in cells)
        print(line(world, *shares), flush=True)


def share_at_any_look(
    world: str,
    shift: float,
    levels: Mapping[int, float],
    verdict: ComparisonVerdict,
    simulations: int,
) -> float:
    """How often a world gets a verdict at one of the looks at least."""
    rng = np.random.default_rng(simulations)
    values, lost, lost_baseline = drawn_studies(rng, world, max(LOOKS), shift, simulations)
    is_said = np.zeros(simulations, dtype=bool)
    for scenes, level in levels.items():
        # scenes are added from one look to the next
        looked_at = (values[:, :scenes], lost[:, :scenes], lost_baseline[:, :scenes])
        is_said |= is_said_of(looked_at, verdict, level)
    return float(is_said.mean())


def verdicts_of_many(
    values: Array, lost: Array, lost_baseline: Array, level: float
) -> dict[ComparisonVerdict, Array]:
    """Which of many studies are *proven*, and say *no difference that matters*: the rules of `verdict_of`.

    Args:
        values: Log ratios ``[N, S]``.
        lost: What the candidate lost ``[N, S]``.
        lost_baseline: What the baseline lost ``[N, S]``.
        level: One-sided level of a claim.
    """
    # losses of either side
    is_paired = ~(lost | lost_baseline)
    times = math.log(CATASTROPHE)
    losses = ((lost & ~lost_baseline) | (is_paired & (values > times))).sum(axis=1)
    losses_baseline = ((lost_baseline & ~lost) | (is_paired & (values < -times))).sum(axis=1)
    losses_p = stats.binom.sf(losses - 1, losses + losses_baseline, 0.5)
    is_worse = (losses > losses_baseline) & (losses_p <= ONE_SIDED)

    # intervals of the typical ratio, of studies with equal numbers of scenes and ties at a time
    is_tie = is_paired & (values == 0.0)
    low, high = intervals_of_many(values, is_paired, 1.0 - 2.0 * level)
    low_90, high_90 = intervals_of_many(values, is_paired & ~is_tie, 1.0 - 4.0 * level)
    for number in np.flatnonzero(is_tie.any(axis=1)):
        known = values[number, is_paired[number]]
        _, low_90[number], high_90[number] = interval_with_ties(known, 1.0 - 4.0 * level)

    # the rules
    is_claim = ~is_worse & (is_paired.sum(axis=1) >= FEWEST_SCENES)
    is_smaller = is_claim & (high < 0.0)
    edge = math.log1p(MARGIN)
    is_within = (np.maximum(-low_90, high_90) < edge) & (np.abs(losses - losses_baseline) <= 1)
    return {
        ComparisonVerdict.PROVEN: is_smaller & (losses <= losses_baseline),
        ComparisonVerdict.NO_DIFFERENCE: is_claim & ~is_smaller & (low <= 0.0) & is_within,
    }


def intervals_of_many(values: Array, counts: Array, confidence: float) -> tuple[Array, Array]:
    """Ends of the interval of `hodges_lehmann` for every row ``[N]``, over the values that count ``[N, S]``."""
    low = np.full(len(values), -math.inf)
    high = np.full(len(values), math.inf)
    numbers = counts.sum(axis=1)
    for number in np.unique(numbers[numbers > 0]):
        rows = numbers == number
        part = values[rows][counts[rows]].reshape(-1, number)

        # how many Walsh averages the interval leaves out at either end: as of any values so many
        first, second = np.triu_indices(number)
        example = 2.0 ** np.arange(number)
        averages = np.sort((example[first] + example[second]) / 2.0)
        end = hodges_lehmann(example, confidence).low
        if math.isinf(end):
            continue
        cut = int(np.flatnonzero(averages == end)[-1]) + 1
        averages = (part[:, first] + part[:, second]) / 2.0
        ends = np.partition(averages, (cut - 1, len(first) - cut), axis=1)
        low[rows] = ends[:, cut - 1]
        high[rows] = ends[:, len(first) - cut]
    return low, high


BOARDS = ((3, 1), (8, 1), (14, 1), (8, 3), (4, 6), (8, 6))
"""Families, and sequences of each."""
TRACKERS = 8
BOARD_WORLDS = (
    "normal",
    "t3",
    "heteroscedastic",
    "symmetric losses",
    "rare losses",
    "families",
    "duplicates",
)
WIDE_FAMILIES = 0.6


def board_errors(
    rng: np.random.Generator, boards: int, world: str, shape: tuple[int, int], effect: float
) -> tuple[Array, Array, Array]:
    """Log ratios ``[B, T, S]`` of trackers whose mean is `effect` on these families, and of ones whose is beyond.

    Within a family the sequences are correlated by the family's effect on each tracker. What a tracker or the
    reference lost is nan.

    Returns:
        Both, and which sequences the reference lost ``[B, S]``.
    """
    n_families, of_each = shape
    if world == "duplicates":
        of_each = math.ceil(of_each / 2)
    size = (boards, TRACKERS, n_families, of_each)
    spread = WIDE_FAMILIES if world == "families" else FAMILY_SPREAD
    effects = rng.normal(0.0, spread, (boards, TRACKERS, n_families, 1))
    scatter = rng.normal(0.0, SPREAD, size)
    base_lost = np.zeros((boards, 1, n_families, of_each), dtype=bool)
    if world == "t3":
        scatter = SPREAD / math.sqrt(3.0) * rng.standard_t(3, size)
    elif world == "heteroscedastic":
        by_tracker = np.geomspace(0.05, 1.0, TRACKERS)[:, None, None]
        scatter = rng.normal(0.0, 1.0, size) * by_tracker
    elif world == "symmetric losses":
        scatter = np.where(rng.random(size) < LOSS_SHARE, np.nan, scatter)
        base_lost = rng.random(base_lost.shape) < LOSS_SHARE
    elif world == "rare losses":
        scatter += TEN_TIMES * (rng.random(size) < RARE_LOSSES)
    centred = effects - effects.mean(axis=2, keepdims=True)
    flat = (boards, TRACKERS, n_families * of_each)
    these = np.reshape(effect + centred + scatter, flat)
    beyond = np.reshape(effect + effects + scatter, flat)
    return these, beyond, base_lost.reshape(boards, -1)


class Claims(NamedTuple):
    """Which trackers get a claim ``[B, T]``, by its scope, and whether their mean ratio is below 1."""

    by_scope: dict[Scope, Array]
    is_below: Array


def claims_of_boards(logs: Array, base_lost: Array, members: Array) -> Claims:
    """The rules of `claims_against` on many boards.

    Args:
        logs: Log ratios to the reference ``[B, T, S]``, nan where the tracker lost.
        base_lost: Which the reference lost ``[B, S]``.
        members: Number of each sequence's family ``[S]``.
    """
    values = np.where(base_lost[:, None], np.nan, logs)
    is_known = np.isfinite(values)
    of_family = np.equal.outer(members, np.unique(members)).astype(float)
    known_values = np.where(is_known, values, 0.0)

    # number of sequences and mean of each family [B, T, F], of those that have a value
    sizes = is_known @ of_family
    means = (known_values @ of_family) / np.maximum(sizes, 1)
    has_value = sizes > 0
    count = has_value.sum(axis=2)
    centre = (means * has_value).sum(axis=2) / np.maximum(count, 1)

    # on these families: the pooled variance within them
    free = is_known.sum(axis=2) - count
    within = np.where(is_known, values - means @ of_family.T, 0.0)
    pooled = np.square(within).sum(axis=2) / np.maximum(free, 1)
    inverse = (has_value / np.maximum(sizes, 1)).sum(axis=2)
    these_error = np.sqrt(pooled * inverse) / np.maximum(count, 1)
    these_p = two_sided(centre, these_error, free)

    # beyond them: the family is the sample
    between = np.square((means - centre[..., None]) * has_value).sum(axis=2)
    beyond_error = np.sqrt(between / np.maximum(count - 1, 1) / np.maximum(count, 1))
    beyond_p = two_sided(centre, beyond_error, count - 1)

    # too little for a claim
    is_short = is_known.sum(axis=2) < FEWEST
    these_p[is_short | (free < FEWEST_FREE)] = 1.0
    beyond_p[is_short | (count < FEWEST_FAMILIES)] = 1.0

    # McNemar's test of the losses
    is_lost = np.isnan(logs)
    lost = (is_lost & ~base_lost[:, None]).sum(axis=2)
    lost_by_reference = (~is_lost & base_lost[:, None]).sum(axis=2)
    losses_p = stats.binom.sf(lost - 1, lost + lost_by_reference, 0.5)
    losses_p[lost == 0] = 1.0
    nothing = len(members) < FEWEST
    by_scope: dict[Scope, Array] = {
        "on these families": (holm_of(these_p) <= FAMILY_ERROR) & (not nothing),
        "beyond these families": (holm_of(beyond_p) <= FAMILY_ERROR) & (not nothing),
        "by lost sequences": (holm_of(losses_p) <= LOSS_ERROR) & (not nothing),
    }
    return Claims(by_scope, centre < 0.0)


def two_sided(centre: Array, error: Array, free: Array) -> Array:
    """Two-sided p values of Student's t."""
    statistic = np.abs(centre) / np.maximum(error, 1e-12)
    return np.asarray(2.0 * special.stdtr(np.maximum(free, 1), -statistic))


def holm_of(p_values: Array) -> Array:
    """Holm's correction along the last axis."""
    order = np.argsort(p_values, axis=-1, kind="stable")
    steps = np.take_along_axis(p_values, order, -1) * np.arange(p_values.shape[-1], 0, -1)
    corrected = np.maximum.accumulate(np.minimum(1.0, steps), axis=-1)
    return np.take_along_axis(corrected, np.argsort(order, axis=-1), -1)


def check_with_the_board(claims: Claims, logs: Array, base_lost: Array, members: Array) -> None:
    """Compare what is claimed of some boards with the claims of the board's own code.

    Raises:
        RuntimeError: They differ.
    """
    names = [str(number) for number in range(logs.shape[2])]
    sequences = sequences_of(names, dict(zip(names, members.astype(str).tolist(), strict=True)))
    zeros = np.zeros(len(names))
    for number, (board_logs, lost) in enumerate(zip(logs, base_lost, strict=True)):
        by_tracker = {str(key): row for key, row in enumerate(board_logs)}
        is_lost = {key: np.isnan(row) for key, row in by_tracker.items()}
        found = claims_against(by_tracker, zeros, sequences, is_lost, lost)
        for key, claim in found.items():
            scope = claim.scope
            if not scope:
                is_equal = not any(
                    claimed[number, int(key)] for claimed in claims.by_scope.values()
                )
            else:
                is_equal = bool(claims.by_scope[scope][number, int(key)])
            if not is_equal:
                raise RuntimeError(f"board {number}, tracker {key}: {claim}, not as simulated")


def board(simulations: int) -> None:
    """Any false claim of a board: of trackers that are no different, any; of others, the wrong direction."""
    print(f"\nboards of {TRACKERS} trackers: any false claim, and power for 30 % less error, %\n")
    columns = ("families x sequences", "world", "on these (bar: 5)", "beyond (bar: 5)", "either")
    print(line(*columns, "power on these", "power beyond"))
    print(line(*["---"] * 7))
    for shape in BOARDS:
        for world in BOARD_WORLDS:
            cells = board_cells(shape, world, simulations)
            print(line(f"{shape[0]} x {shape[1]}", world, *cells), flush=True)


BATCH = 1000
"""Boards that are simulated at a time."""


def board_cells(shape: tuple[int, int], world: str, simulations: int) -> list[float]:
    """Shares of false claims on these families, beyond them and of either kind, then of true ones."""
    rng = np.random.default_rng([*shape, BOARD_WORLDS.index(world)])
    wrong = np.zeros(3)
    shown = np.zeros(2)
    done = 0
    while done < simulations:
        boards = min(BATCH, simulations - done)
        done += boards
        for effect in (0.0, math.log(0.7)):
            *both, base_lost = board_errors(rng, boards, world, shape, effect)
            members = np.repeat(np.arange(shape[0]), both[0].shape[2] // shape[0])
            claims = [claims_of_boards(logs, base_lost, members) for logs in both]
            if done == boards:
                for claimed, logs in zip(claims, both, strict=True):
                    check_with_the_board(claimed, logs[:COMPARED], base_lost[:COMPARED], members)
            these = claims[0].by_scope["on these families"]
            beyond = claims[1].by_scope["beyond these families"]
            if effect != 0.0:
                shown += [these.mean() * boards, beyond.mean() * boards]
                continue
            if world == "rare losses":
                # where the rest is equal, who has ten times the error somewhere is worse in the mean
                these = these & claims[0].is_below
                beyond = beyond & claims[1].is_below
            # what is lost counts on these families
            on_these = (these | claims[0].by_scope["by lost sequences"]).any(axis=1)
            beyond_them = beyond.any(axis=1)
            either = on_these | beyond_them
            wrong += [on_these.sum(), beyond_them.sum(), either.sum()]
    return [*(wrong / simulations).tolist(), *(shown / simulations).tolist()]


TABLES = {"null": null, "margin": margin, "power": power, "extend": extend, "board": board}


def main() -> None:
    """Print the tables."""
    parser = parser_of(__doc__)
    parser.add_argument("--simulations", type=int, default=10_000)
    parser.add_argument("--table", nargs="+", choices=TABLES, default=list(TABLES))
    options = parser.parse_args()
    for name in options.table:
        TABLES[name](options.simulations)


if __name__ == "__main__":
    main()
