"""Where a frame is looked for: with loop closing, not among what was left long ago and is connected no more."""

import numpy as np
import pytest

from dynslam_bench.core.settings import apply_overrides
from dynslam_bench.slam import tracking as rules
from dynslam_bench.slam.map import Map
from dynslam_bench.slam.observation import observe
from dynslam_bench.slam.settings import BackendSettings
from dynslam_bench.slam.tracking import LocalMap, apart, weakly_connected

SHARED = 10
"""Points that each keyframe of the chain shares with the next one."""


@pytest.fixture
def chain(room):
    """Six keyframes in a row; each shares ten points with the next, and with no other."""
    settings = BackendSettings()
    world = Map(room.camera, np.ones(1))
    frame = room.see(np.eye(4), 0)
    seen = observe(frame, np.ones(len(frame), bool), np.ones(len(frame), np.float32), room.camera, world.scales,
                   settings.tracking)  # fmt: skip
    last = np.zeros(0, np.int64)
    for index in range(6):
        slot = world.add_keyframe(seen, np.eye(4), index, float(index))
        world.observe(slot, np.arange(len(last)), last)
        fresh = np.arange(SHARED, 2 * SHARED)
        last = world.add_points(np.ones((SHARED, 3)), np.zeros((SHARED, 3), np.uint8), slot, fresh)
    return world


def surroundings(chain, *, enabled):
    settings = {"loop_closing.enabled": enabled, "loop_closing.away": 2}
    return LocalMap(chain, apply_overrides(BackendSettings(), settings))


@pytest.mark.parametrize(
    ("keyframe", "away", "expected"), [(5, 2, [0, 1, 2]), (5, 4, [0, 1]), (0, 4, [4, 5]), (2, 3, [5])]
)
def test_what_is_apart_is_connected_over_no_third_and_was_made_long_before_or_after(chain, keyframe, away, expected):
    assert apart(chain, keyframe, away).tolist() == expected


def test_who_shares_few_points_may_be_recognised_anew(chain, monkeypatch):
    assert weakly_connected(chain, 5, 1).tolist() == [0, 1, 2, 3, 4], "ten points do not hold the fourth in place"
    monkeypatch.setattr(rules, "HELD", SHARED)
    assert weakly_connected(chain, 5, 1).tolist() == [0, 1, 2], "the fourth holds the third"
    assert weakly_connected(chain, 5, 4).tolist() == [0, 1], "nor who was made not long before"


def test_without_loop_closing_everything_is_near(chain):
    place = surroundings(chain, enabled=False)
    assert place.keyframes(5).tolist() == [0, 1, 2, 3, 4, 5]
    assert (place.points(5, np.zeros(0, np.int64)) == chain.points).all()


def test_with_it_points_that_keyframes_apart_alone_observe_are_not_looked_for(chain):
    place = surroundings(chain, enabled=True)
    assert place.keyframes(5).tolist() == [3, 4, 5]
    points = place.points(5, np.zeros(0, np.int64))
    assert sorted(set(chain.born[points].tolist())) == [2, 3, 4, 5], "keyframe 3 observes those of keyframe 2"
    assert len(points) == 4 * SHARED


def test_another_place_and_a_new_keyframe_are_seen_at_once(chain):
    place = surroundings(chain, enabled=True)
    assert place.keyframes(5).tolist() == [3, 4, 5]
    assert place.keyframes(0).tolist() == [0, 1, 2]
    chain.remove_keyframe(1)
    chain.next_keyframe += 1
    assert place.keyframes(0).tolist() == [0]
