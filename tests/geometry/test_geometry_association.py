"""The greedy associator against a slow transcription of the published rule."""

import numpy as np
import pytest

from dynslam_bench.core.errors import TrajectoryError
from dynslam_bench.geometry.association import associate, nearest_gap


def slow_associate(first, second, max_dt, strict=True):
    """All pairs, sorted by (|dt|, first, second), greedy, each stamp once."""
    pairs = []
    for i, a in enumerate(first):
        for j, b in enumerate(second):
            dt = abs(a - b)
            if dt < max_dt or (not strict and dt == max_dt):
                pairs.append((dt, a, b, i, j))
    pairs.sort()
    used_a, used_b, matches = set(), set(), []
    for _, a, b, i, j in pairs:
        if a not in used_a and b not in used_b:
            used_a.add(a)
            used_b.add(b)
            matches.append((a, i, j))
    matches.sort()
    return [(i, j) for _, i, j in matches]


@pytest.mark.parametrize("seed", range(30))
@pytest.mark.parametrize("strict", [True, False])
def test_equals_the_slow_rule(seed, strict):
    rng = np.random.default_rng(seed)
    # stamps on a coarse grid give many exact ties, which is where orders differ
    grid = 0.005 if seed % 2 else 1e-6
    first = np.unique(np.round(1305031102.0 + rng.uniform(0, 2, 60) / 1.0, 6) // grid * grid)
    second = np.unique(np.round(1305031102.0 + rng.uniform(0, 2, 80), 6) // grid * grid)
    first, second = rng.permutation(first), rng.permutation(second)
    index_first, index_second = associate(first, second, 0.02, strict=strict)
    assert list(zip(index_first.tolist(), index_second.tolist(), strict=True)) == slow_associate(
        first, second, 0.02, strict
    )
    assert len(set(index_first.tolist())) == len(index_first)
    assert len(set(index_second.tolist())) == len(index_second)
    assert (np.diff(first[index_first]) > 0).all()


def test_empty_lists():
    for first, second in ([], []), ([1.0], []), ([], [1.0]):
        index_first, index_second = associate(first, second, 0.02)
        assert index_first.shape == index_second.shape == (0,)


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (([0.0, float("nan")], [0.0], 0.02), "stamp 1 of 2 is nan"),
        (([0.0], [float("inf")], 0.02), "stamp 0 of 1 is inf"),
        (([0.0], [0.0], -1.0), "-1.0"),
        (([0.0], [0.0], float("nan")), "nan"),
    ],
)
def test_bad_input_is_one_clear_line(arguments, text):
    with pytest.raises(TrajectoryError, match=text) as caught:
        associate(*arguments)
    assert "\n" not in str(caught.value)


def test_nearest_gap():
    assert nearest_gap([0.0, 1.0, 9.0], [0.5, 1.25]).tolist() == [0.5, 0.25, 7.75]
    assert np.isinf(nearest_gap([1.0], [])).all()
