"""How often verdicts are wrong, and how often they show what is there: studies, extended studies and boards.

    python tests/benchmarks/verdict_errors.py [--simulations 10000] [--table null margin power extend board]

Scenes are simulated: natural logarithms of a candidate's error over the baseline's. Worlds:

- normal, t with three degrees of freedom, heteroscedastic (each scene has a scatter of its own);
- symmetric losses: either side loses 5 % of the scenes;
- rare losses: the candidate has ten times the error in 6 % of the scenes, the typical ratio is 1;
- families: scenes of eight families whose own effects scatter. The truth is the mean of the families
  that were drawn, since a study and a board's first sentence speak of "these families";
- duplicates: every second scene is a copy of another one, which counts once.

A verdict is wrong where it says *proven* and the truth is no gain, or *no difference that matters* and
the truth is at the margin. A board is wrong where any of its claims is. Percentages stand beside the
number of simulations; their standard error is at most 0.16 points at 2.5 % of 10,000.
"""

import math

import numpy as np
from command_line import parser_of
from numpy.typing import NDArray

from dynslam_bench.evaluation.verdicts import (
    LOOKS,
    MARGIN,
    ONE_SIDED,
    Verdict,
    family_test,
    paired_ratio,
    verdict_of,
)
from dynslam_bench.reports.model.statistics import FAMILY_ERROR, holm

Array = NDArray[np.float64]
SCENES = (3, 8, 14, 24, 48)
SPREAD = 0.35
"""Scatter over scenes of the log ratio, as measured with one start (0.34 to 0.5)."""
LOSS_SHARE = 0.05
RARE_LOSSES = 0.06
TEN_TIMES = math.log(10.0)
FAMILIES = 8
FAMILY_SPREAD = 0.2


def none_lost(values: Array) -> tuple[Array, Array, Array]:
    """The values, with no scene lost."""
    nothing = np.zeros(len(values), dtype=bool)
    return values, nothing, nothing


def normal(rng: np.random.Generator, count: int) -> tuple[Array, Array, Array]:
    """Equal normal scatter."""
    return none_lost(rng.normal(0.0, SPREAD, count))


def heavy_tails(rng: np.random.Generator, count: int) -> tuple[Array, Array, Array]:
    """Student's t with three degrees of freedom, scaled to the same standard deviation."""
    return none_lost(SPREAD / math.sqrt(3.0) * rng.standard_t(3, count))


def heteroscedastic(rng: np.random.Generator, count: int) -> tuple[Array, Array, Array]:
    """Scenes scatter by 0.05 to 1, evenly in the logarithm."""
    spreads = np.exp(rng.uniform(math.log(0.05), 0.0, count))
    return none_lost(rng.normal(0.0, 1.0, count) * spreads)


def symmetric_losses(rng: np.random.Generator, count: int) -> tuple[Array, Array, Array]:
    """Either side loses some scenes, as often as the other."""
    values = rng.normal(0.0, SPREAD, count)
    return values, rng.random(count) < LOSS_SHARE, rng.random(count) < LOSS_SHARE


def rare_losses(rng: np.random.Generator, count: int) -> tuple[Array, Array, Array]:
    """The candidate has ten times the error in a few scenes; in the others the typical ratio is 1."""
    values = rng.normal(0.0, SPREAD, count)
    return none_lost(values + TEN_TIMES * (rng.random(count) < RARE_LOSSES))


def families(rng: np.random.Generator, count: int) -> tuple[Array, Array, Array]:
    """Scenes of families whose effects differ; the mean of those effects is 0."""
    effects = rng.normal(0.0, FAMILY_SPREAD, FAMILIES)
    members = np.arange(count) % FAMILIES
    drawn = np.unique(members)
    effects -= effects[drawn].mean()
    return none_lost(effects[members] + rng.normal(0.0, SPREAD, count))


def duplicates(rng: np.random.Generator, count: int) -> tuple[Array, Array, Array]:
    """Every second scene is a copy, and counts once with its original."""
    return none_lost(rng.normal(0.0, SPREAD, math.ceil(count / 2)))


WORLDS = {
    "normal": normal,
    "t3": heavy_tails,
    "heteroscedastic": heteroscedastic,
    "symmetric losses": symmetric_losses,
    "rare losses": rare_losses,
    "families": families,
    "duplicates": duplicates,
}


def judge(
    values: Array, lost: Array, lost_baseline: Array, one_sided: float = ONE_SIDED
) -> Verdict:
    """The verdict on simulated scenes."""
    names = np.array([str(number) for number in range(len(values))])
    log_ratios = dict(zip(names.tolist(), values.tolist(), strict=True))
    comparison = paired_ratio(log_ratios, names[lost], names[lost_baseline], one_sided=one_sided)
    return verdict_of(comparison)


def share_of(verdict: Verdict, world: str, scenes: int, shift: float, simulations: int) -> float:
    """How often a world whose typical log ratio is `shift` gets a verdict."""
    rng = np.random.default_rng([scenes, simulations, list(WORLDS).index(world)])
    hits = 0
    for _ in range(simulations):
        values, lost, lost_baseline = WORLDS[world](rng, scenes)
        hits += judge(values + shift, lost, lost_baseline) is verdict
    return hits / simulations


def line(*cells: object) -> str:
    """A row of a table; floats are shares."""
    texts = [f"{100 * cell:.1f}" if isinstance(cell, float) else str(cell) for cell in cells]
    return f"| {' | '.join(texts)} |"


def table_of_worlds(title: str, verdict: Verdict, shift: float, simulations: int) -> None:
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
    table_of_worlds(title, Verdict.PROVEN, 0.0, simulations)


def margin(simulations: int) -> None:
    """*No difference that matters* where the difference is the margin."""
    title = "*no difference that matters* where the typical ratio is 1.1, % (bar: 5)"
    table_of_worlds(title, Verdict.NO_DIFFERENCE, math.log1p(MARGIN), simulations)


def power(simulations: int) -> None:
    """*Proven* where the candidate has 20 % less error."""
    title = "*proven* where the typical ratio is 0.8, %"
    table_of_worlds(title, Verdict.PROVEN, math.log(0.8), simulations)


def extend(simulations: int) -> None:
    """*Proven* at any of the looks of an extendable study where nothing is better, and where 20 % are gained."""
    print("\nextendable studies: *proven* at any look, % (bar where nothing is better: 3.0)\n")
    print(line("world", "nothing better", "20 % less error", "naive looks at 2.5 %"))
    print(line("---", "---", "---", "---"))
    for world, draw in WORLDS.items():
        shares = []
        for shift, levels in (
            (0.0, LOOKS),
            (math.log(0.8), LOOKS),
            (0.0, dict.fromkeys(LOOKS, ONE_SIDED)),
        ):
            rng = np.random.default_rng(simulations)
            hits = 0
            for _ in range(simulations):
                values, lost, lost_baseline = draw(rng, max(LOOKS))
                hits += any(
                    judge(values[:scenes] + shift, lost[:scenes], lost_baseline[:scenes], level)
                    is Verdict.PROVEN
                    for scenes, level in levels.items()
                )
            shares.append(hits / simulations)
        print(line(world, *shares), flush=True)


BOARDS = ((8, 3), (4, 6), (14, 1), (8, 6))
TRACKERS = 8


def board_errors(
    rng: np.random.Generator, world: str, n_families: int, of_each: int, effect: float
) -> tuple[Array, Array]:
    """Log ratios ``[T, S]`` of trackers, whose mean is `effect` on these families, and whose is `effect` beyond them.

    Within a family the sequences are correlated by the family's effect on each tracker.
    """
    size = (TRACKERS, n_families, of_each)
    effects = rng.normal(0.0, FAMILY_SPREAD, (TRACKERS, n_families, 1))
    scatter = rng.normal(0.0, SPREAD, size)
    if world == "t3":
        scatter = SPREAD / math.sqrt(3.0) * rng.standard_t(3, size)
    elif world == "heteroscedastic":
        scatter = rng.normal(0.0, 1.0, size) * np.geomspace(0.05, 1.0, TRACKERS)[:, None, None]
    if world == "symmetric losses":
        scatter = np.where(rng.random(size) < LOSS_SHARE, np.nan, scatter)
    if world == "duplicates":
        scatter = scatter[:, :, : math.ceil(of_each / 2)]
    centred = effects - effects.mean(axis=1, keepdims=True)
    these = effect + centred + scatter
    beyond = effect + effects + scatter
    return these.reshape(TRACKERS, -1), beyond.reshape(TRACKERS, -1)


def board(simulations: int) -> None:
    """Any false claim of a board: of trackers that are no different, any; of others, the wrong direction."""
    print(
        f"\nboards of {TRACKERS} trackers: any false claim, and power for 30 % less error, % (bar: 5)\n"
    )
    print(
        line(
            "families x sequences", "world", "on these", "beyond", "power on these", "power beyond"
        )
    )
    print(line(*["---"] * 6))
    worlds = ("normal", "t3", "heteroscedastic", "symmetric losses", "duplicates")
    for n_families, of_each in BOARDS:
        names = np.repeat(np.arange(n_families), of_each).astype(str)
        for world in worlds:
            members = names
            if world == "duplicates":
                members = np.repeat(np.arange(n_families), math.ceil(of_each / 2)).astype(str)
            rng = np.random.default_rng([n_families, of_each, worlds.index(world)])
            wrong = np.zeros(2)
            shown = np.zeros(2)
            for effect in (0.0, math.log(0.7)):
                for _ in range(simulations):
                    these, beyond = board_errors(rng, world, n_families, of_each, effect)
                    tests = [family_test(row, members.tolist()) for row in these]
                    p_these = holm([test.these_p for test in tests])
                    tests = [family_test(row, members.tolist()) for row in beyond]
                    p_beyond = holm([test.beyond_p for test in tests])
                    for at, p_values in enumerate((p_these, p_beyond)):
                        claims = p_values <= FAMILY_ERROR
                        if effect == 0.0:
                            wrong[at] += bool(claims.any())
                        else:
                            shown[at] += float(claims.mean())
            cells = [*(wrong / simulations).tolist(), *(shown / simulations).tolist()]
            print(line(f"{n_families} x {of_each}", world, *cells), flush=True)


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
