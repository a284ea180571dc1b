"""Which settings matter, before any study: one at a time from several points (Morris 1991), with chaos taken off.

A run changes with every setting that changes anything at all, by chance. What a setting does *on average over blocks*
is no chance: the effects of one step on several blocks are compared with their own scatter.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from dynslam_bench.core.errors import StudyError
from dynslam_bench.core.records import Record
from dynslam_bench.core.settings import Scalar

from .evaluate import BlockFailedError
from .objectives import Objective, Outcomes
from .screening_plan import Point

KEPT = 8
"""So many settings at most are worth a study."""
FEWEST_BLOCKS = 2


class Effect(Record):
    """What one setting does.

    Attributes:
        name: The setting.
        objective: In what: see `Objective.what`.
        size: Root mean square over the points of the mean log ratio that a third of the range makes, free of chance.
        low: Lower end of its 90 % interval over blocks (jackknife); above 0 where the setting matters.
        high: Upper end.
        dead: It changed nothing, to the last bit, at any point on any block.
    """

    name: str
    objective: str
    size: float
    low: float
    high: float
    dead: bool = False


class Screening(Record):
    """What a screening found.

    Attributes:
        effects: Of each setting the largest over the objectives; the one most surely felt first.
        kept: At most `KEPT` settings worth a study; empty where none matters more than chance.
        dead: Settings that changed nothing, to the last bit, on any of the blocks.
        failed: Settings whose step broke a run, and how.
        points: From how many points.
        blocks: On how many blocks.
        runs: How many runs that took.
    """

    effects: list[Effect]
    kept: list[str]
    dead: list[str]
    failed: dict[str, str]
    points: int
    blocks: int
    runs: int


def screen(
    points: Sequence[Point],
    run: Callable[[Mapping[str, Scalar]], Outcomes],
    objectives: Sequence[Objective],
    *,
    jobs: int = 1,
    on_done: Callable[[int, int], None] | None = None,
) -> Screening:
    """Measure the effect of every setting.

    Args:
        points: From `plan`.
        run: Gives the outcomes of values on the blocks, always the same ones.
        objectives: In what effects are looked for.
        jobs: Configurations at a time.
        on_done: Told how many configurations of how many are done.

    Raises:
        StudyError: Fewer than two blocks, or the default itself fails.
    """
    try:
        bases = [run(point.base) for point in points[:1]]
    except BlockFailedError as error:
        raise StudyError(
            f"the default settings fail: {error.args[0]}", "screening needs a default that runs"
        ) from error
    if len(bases[0]) < FEWEST_BLOCKS:
        raise StudyError(f"screening on {len(bases[0])} block cannot tell an effect from chance", "name two or more")
    names = list(points[0].base)
    todo: list[tuple[int, str | None]] = [(number, None) for number in range(1, len(points))]
    todo += [(number, name) for number in range(len(points)) for name in names]
    failed: dict[str, str] = {}
    done = [1]

    def one(item: tuple[int, str | None]) -> Outcomes | None:
        number, name = item
        point = points[number]
        try:
            return run(point.base if name is None else {**point.base, name: point.steps[name]})
        except BlockFailedError as error:
            failed.setdefault(name or "a point near the default", error.args[0])
            return None
        finally:
            done[0] += 1
            if on_done is not None:
                on_done(done[0], len(todo) + 1)

    with ThreadPoolExecutor(jobs, thread_name_prefix="dynslam-screen") as pool:
        found = dict(zip(todo, pool.map(one, todo), strict=True))
    found[(0, None)] = bases[0]
    effects = [_effect_of(name, found, len(points), objectives) for name in names]
    measured = sorted((e for e in effects if e is not None), key=lambda e: (-e.low, -e.size))
    kept = [effect.name for effect in measured if effect.low > 0][:KEPT]
    dead = [effect.name for effect in measured if effect.dead]
    blocks = len(bases[0])
    return Screening(effects=measured, kept=kept, dead=dead, failed=failed, points=len(points), blocks=blocks,
                     runs=blocks * len(found))  # fmt: skip


def size_of(effects: NDArray[np.float64]) -> tuple[float, float, float]:
    """How large the mean effect over blocks is, and its 90 % interval.

    The square of a mean holds the variance of the mean besides; that is taken off, so that a setting that does nothing
    but stir the chaos has 0 on average.

    Args:
        effects: Log ratios ``[points, blocks]``.

    Returns:
        Size, lower and upper end; the ends are jackknife intervals over blocks, with Student's t.
    """
    blocks = effects.shape[1]

    def square(sample: NDArray[np.float64]) -> float:
        count = sample.shape[1]
        chance = sample.var(axis=1, ddof=1) / count if count > 1 else 0.0
        return float(np.mean(sample.mean(axis=1) ** 2 - chance))

    whole = square(effects)
    if blocks < 3:
        half = math.inf if effects.any() else 0.0
    else:
        left_out = np.array([square(np.delete(effects, index, axis=1)) for index in range(blocks)])
        scatter = (blocks - 1) / blocks * float(((left_out - left_out.mean()) ** 2).sum())
        half = float(stats.t.ppf(0.95, blocks - 1)) * math.sqrt(scatter)
    ends = [math.sqrt(max(0.0, value)) if math.isfinite(value) else math.inf for value in (whole - half, whole + half)]
    return math.sqrt(max(0.0, whole)), 0.0 if math.isinf(half) else ends[0], ends[1]


def _effect_of(
    name: str, found: Mapping[tuple[int, str | None], Outcomes | None], points: int, objectives: Sequence[Objective]
) -> Effect | None:
    """The effect on the objective that shows it most; None where all its steps broke a run."""
    pairs = [(found[(number, None)], found[(number, name)]) for number in range(points)]
    usable = [(base, moved) for base, moved in pairs if base is not None and moved is not None]
    if not usable:
        return None
    dead = all(
        (base[block].ate_m, base[block].coverage) == (outcome.ate_m, outcome.coverage)
        for base, moved in usable
        for block, outcome in moved.items()
    )
    best: Effect | None = None
    for objective in objectives:
        logs = np.array(
            [
                [math.log(objective.cost(outcome) / objective.cost(base[block])) for block, outcome in moved.items()]
                for base, moved in usable
            ]
        )
        size, low, high = size_of(logs)
        effect = Effect(name=name, objective=objective.what, size=size, low=low, high=high, dead=dead)
        best = effect if best is None or (effect.low, effect.size) > (best.low, best.size) else best
    return best
