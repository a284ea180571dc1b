"""The local map: with loop closing it ends where the covisibility graph does."""

import numpy as np
import pytest
from point_world import observed

from dynslam_bench.slam import tracking
from dynslam_bench.slam.map import Map
from dynslam_bench.slam.tracking import LocalMap, unconnected, weakly_connected

SHARED = 10
"""Points that each keyframe of the chain shares with the next one."""


@pytest.fixture
def chain(room):
    """Six keyframes in a row; each shares ten points with the next, and with no other."""
    world, observations = Map(room.camera, np.ones(1)), observed(room.see(np.eye(4), 0), room.camera, levels=1)
    last = np.zeros(0, np.int64)
    for index in range(6):
        slot = world.add_keyframe(observations, np.eye(4), index, float(index))
        world.observe(slot, np.arange(len(last)), last)
        fresh = np.arange(SHARED, 2 * SHARED)
        last = world.add_points(np.ones((SHARED, 3)), np.zeros((SHARED, 3), np.uint8), slot, fresh)
    return world


@pytest.mark.parametrize(
    ("keyframe", "gap", "expected"), [(5, 2, [0, 1, 2]), (5, 4, [0, 1]), (0, 4, [4, 5]), (2, 3, [5])]
)
def test_unconnected_keyframes_are_old_and_share_no_covisible_keyframe(chain, keyframe, gap, expected):
    assert unconnected(chain, keyframe, gap).tolist() == expected


def test_keyframes_that_share_few_points_may_be_recognised_anew(chain, monkeypatch):
    assert weakly_connected(chain, 5, 1).tolist() == [0, 1, 2, 3, 4]
    monkeypatch.setattr(tracking, "STRONG_COVISIBILITY", SHARED)
    assert weakly_connected(chain, 5, 1).tolist() == [0, 1, 2]
    assert weakly_connected(chain, 5, 4).tolist() == [0, 1]


def test_the_local_map_is_the_whole_map_or_the_connected_part(chain, monkeypatch):
    keyframes, points = LocalMap(chain, connected_only=False).around(5)
    assert keyframes.tolist() == [0, 1, 2, 3, 4, 5] and (points == chain.points).all()
    monkeypatch.setattr(tracking, "unconnected", lambda world, slot: unconnected(world, slot, 2))
    local_map = LocalMap(chain, connected_only=True)
    keyframes, points = local_map.around(5)
    assert keyframes.tolist() == [3, 4, 5]
    assert sorted(set(chain.born[points].tolist())) == [2, 3, 4, 5] and len(points) == 4 * SHARED
    assert local_map.around(0)[0].tolist() == [0, 1, 2]
    chain.remove_keyframe(1)
    chain.next_keyframe += 1
    assert local_map.around(0)[0].tolist() == [0]
