"""The starvation guard."""

from __future__ import annotations

import numpy as np

from dynslam_bench.culling.guard import GuardSettings, restore_starved


def test_guard_undoes_the_most_speculative_verdict_first() -> None:
    semantic, geometric = np.ones(100, bool), np.zeros(100, bool)
    semantic[:30] = False
    keep, undone = restore_starved([semantic, geometric], GuardSettings(min_features=40))
    assert undone == 1
    np.testing.assert_array_equal(keep, semantic)
    keep, undone = restore_starved([~np.ones(100, bool), geometric], GuardSettings(min_features=40))
    assert keep.all() and undone == 2
    keep, undone = restore_starved([semantic], GuardSettings(min_features=40))
    assert undone == 0
    np.testing.assert_array_equal(keep, semantic)
