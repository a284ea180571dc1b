"""PatchMatch's random search: windows around the best label that halve (PatchMatch Filter, DAISY Filter Flow)."""

from __future__ import annotations

import numpy as np

from .._jit import kernel
from ..matching import label_cost
from .common import advance, insert, stream, uniform, widen


@kernel
def shrinking_window_phase(start, stop, reference, target, tables, state, candidates, end, phase, seed, shrink):  # type: ignore[no-untyped-def]
    """Spend evaluations on points start..stop until each has used `end`.

    Args:
        start: First point.
        stop: One past the last.
        reference: `matching.Reference`.
        target: `matching.Side`.
        tables: `matching.CostTables`.
        state: `common.SearchState`, changed in place; only the best label is used.
        candidates: float32 ``[N, C, 4]``, labels to try first; not finite means none.
        end: Evaluations a point, counted from the very start, at which the phase ends.
        phase: Number of the phase.
        seed: Of the frame.
        shrink: Factor of the window per evaluation (PatchMatch: 0.5); 1 is a uniform random search of the whole box.
    """
    worst = state.costs.shape[1] - 1
    label = np.empty(4, dtype=np.float32)
    for i in range(start, stop):
        random = stream(seed, i, phase)
        lower, upper = state.lower[i], state.upper[i]
        best, costs = state.flames[i, 0], state.costs[i]
        used = state.used[i]
        for c in range(candidates.shape[1]):
            u, v, s, theta = candidates[i, c, 0], candidates[i, c, 1], candidates[i, c, 2], candidates[i, c, 3]
            if used < end and np.isfinite(u + v + s + theta):
                used += 1
                insert(state, i, u, v, s, theta, label_cost(i, u, v, s, theta, reference, target, tables, costs[worst]))
        widen(lower, upper, best)
        window = np.float32(0.5)
        while used < end:
            for j in range(4):
                random = advance(random)
                extent = upper[j] - lower[j]
                if shrink == 1:
                    label[j] = lower[j] + extent * uniform(random)
                else:
                    step = (np.float32(2) * uniform(random) - np.float32(1)) * window * extent
                    label[j] = min(max(best[j] + step, lower[j]), upper[j])
            used += 1
            cost = label_cost(i, label[0], label[1], label[2], label[3], reference, target, tables, costs[worst])
            insert(state, i, label[0], label[1], label[2], label[3], cost)
            window *= np.float32(shrink)
            if window * (upper[0] - lower[0]) < np.float32(1):
                window = np.float32(0.5)
        state.used[i] = used
