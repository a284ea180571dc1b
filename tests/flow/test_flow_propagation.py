"""Which points common motions are drawn from."""

from __future__ import annotations

import numpy as np
import pytest

from dynslam_bench.flow.propagation import better_half


@pytest.mark.parametrize("count", [4, 5, 9, 60])
@pytest.mark.parametrize("levels", [1, 3, 1000])
def test_the_better_half_is_that_of_a_stable_sort(count: int, levels: int) -> None:
    costs = np.random.default_rng(count).integers(0, levels, count)
    expected = np.sort(np.argsort(costs, kind="stable")[: max(count // 2, 4)])
    chosen = better_half(costs)
    assert chosen.dtype == np.int64 and chosen.tolist() == expected.tolist()
