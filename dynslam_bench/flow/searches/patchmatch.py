"""Searches without a population: PatchMatch's halving windows, uniform random draws, or no draws at all.

The windows lie around the best label (PatchMatch Filter, DAISY Filter Flow).
"""

from __future__ import annotations

import numpy as np

from dynslam_bench.core.compiled import Scalar, inlined, kernel

from ..daisy.cost import CostTables, Reference, Side, label_cost
from ..kernels.arrays import Floats
from .common import SearchState, advance, first_state, insert, scrambled, uniform, widen


@kernel
def shrinking_window_phase(
    start: int, stop: int, reference: Reference, target: Side, tables: CostTables, state: SearchState,
    candidates: Floats, end: int, phase: int, seed: Scalar, shrink: float,
) -> None:  # fmt: skip
    """Spend evaluations on points start..stop until each has used `end`.

    Args:
        start: First point.
        stop: One past the last.
        reference: `cost.Reference`.
        target: `cost.Side`.
        tables: `cost.CostTables`.
        state: `common.SearchState`, changed in place; only the best label is used.
        candidates: float32 ``[N, C, 4]``, labels to try first; not finite means none.
        end: Evaluations a point, counted from the very start, at which the phase ends.
        phase: Number of the phase.
        seed: Of the frame.
        shrink: Factor of the window per evaluation (PatchMatch: 0.5); 1 is a uniform random search of the whole box,
            0 draws nothing: the candidates are all that is tried, and the rest of the budget is left.
    """
    label = np.empty(4, dtype=np.float32)
    flames, costs = np.empty((1, 4), dtype=np.float32), np.empty(1, dtype=np.int64)
    lower, upper = np.empty(4, dtype=np.float32), np.empty(4, dtype=np.float32)
    for i in range(start, stop):
        random = first_state(seed, i, phase)
        for j in range(4):
            lower[j], upper[j], flames[0, j] = state.lower[i, j], state.upper[i, j], state.flames[i, 0, j]
        costs[0] = state.costs[i, 0]
        used, given, widened = state.used[i], 0, False
        window = np.float32(0.5)
        while used < end:
            if given < candidates.shape[1]:
                total = np.float32(0)
                for j in range(4):
                    label[j] = candidates[i, given, j]
                    total += label[j]
                given += 1
                if not np.isfinite(total):
                    continue
            elif shrink == 0:
                break
            else:
                if not widened:
                    widen(lower, upper, flames)
                    widened = True
                random = advance(random)
                bits = scrambled(random)
                draw(label, bits, lower, upper, flames, window, shrink)
                window *= np.float32(shrink)
                if window * (upper[0] - lower[0]) < np.float32(1):
                    window = np.float32(0.5)
            cost = label_cost(i, label[0], label[1], label[2], label[3], reference, target, tables, costs[0])
            insert(flames, costs, label, cost)
            used += 1
        if not widened:
            widen(lower, upper, flames)
        state.used[i], state.costs[i, 0] = used, costs[0]
        for j in range(4):
            state.lower[i, j], state.upper[i, j], state.flames[i, 0, j] = lower[j], upper[j], flames[0, j]


@inlined
def draw(
    label: Floats, bits: Scalar, lower: Floats, upper: Floats, flames: Floats, window: Scalar, shrink: float
) -> None:
    """Fill a label: anywhere in the box (`shrink` 1), or in a window of it around the best label."""
    for j in range(4):
        extent = upper[j] - lower[j]
        if shrink == 1:
            label[j] = lower[j] + extent * uniform(bits, j)
        else:
            step = (np.float32(2) * uniform(bits, j) - np.float32(1)) * window * extent
            label[j] = min(max(flames[0, j] + step, lower[j]), upper[j])
