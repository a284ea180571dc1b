"""Which keyframes look like a frame: the ranking by the descriptors' own pieces."""

import numpy as np
import pytest

from dynslam_bench.geometry import se3
from dynslam_bench.slam.localisation.observation import observe
from dynslam_bench.slam.mapping.map import Map
from dynslam_bench.slam.places import most_alike
from dynslam_bench.slam.settings import TrackingSettings

SCALES = np.ones(1)
TURNS = np.deg2rad(np.arange(0, 360, 30))


def seen(room, turn, index):
    """The features of a camera that looks in a direction, radians about the vertical."""
    frame = room.see(se3.exp(np.array([0, 0, 0, 0, turn, 0])), index)
    count = len(frame)
    ones = np.ones(count, np.float32)
    return observe(frame, np.ones(count, bool), ones, room.camera, SCALES, TrackingSettings())


@pytest.fixture
def world(room):
    """A map of twelve keyframes around a room, every feature a point of its own."""
    world = Map(room.camera, SCALES)
    for index, turn in enumerate(TURNS):
        features = seen(room, turn, index)
        slot = world.add_keyframe(features, np.eye(4), index, index / 30)
        world.add_points(np.ones((len(features), 3)), features.rgb, slot, np.arange(len(features)))
    return world


@pytest.mark.parametrize("place", [0, 5, 11])
def test_the_keyframe_of_the_same_place_comes_first(room, world, place):
    found = most_alike(world, world.keyframes, seen(room, TURNS[place] + 0.02, 100), 3)
    assert len(found) == 3 and world.kf_frame[found[0]] == place


def test_neighbours_that_share_the_view_come_before_the_wall_behind(room, world):
    order = [int(world.kf_frame[slot]) for slot in most_alike(world, world.keyframes, seen(room, TURNS[4], 100), 11)]
    assert order[0] == 4 and set(order[1:3]) == {3, 5}


def test_only_the_keyframes_given_are_chosen(room, world):
    given = world.keyframes[[1, 2, 8, 9]]
    found = most_alike(world, given, seen(room, TURNS[5], 100), 2)
    assert len(found) == 2 and set(found) <= set(given.tolist())


def test_few_keyframes_are_taken_as_they_come(room, world):
    given = world.keyframes[[7, 0, 3]]
    assert most_alike(world, given, seen(room, 0.0, 100), 3) == given.tolist()
    assert most_alike(world, given, seen(room, 0.0, 100), 10) == given.tolist()


def test_equal_scores_go_to_the_newer_keyframe(room, world):
    """A frame whose descriptors no keyframe has scores zero everywhere."""
    stranger = seen(type(room)(seed=9), 0.0, 100)
    stranger.words[:] = 0
    known = world.kf_words[world.keyframes].view(np.uint16)[:, :, ::4]
    used = np.concatenate([known[row, : world.kf_count[slot]] for row, slot in enumerate(world.keyframes)])
    absent = np.setdiff1d(np.arange(1 << 16), used)[0]
    stranger.words.view(np.uint16)[:] = absent
    newest = world.keyframes[np.argsort(-world.kf_id[world.keyframes])]
    assert most_alike(world, world.keyframes, stranger, 4) == newest[:4].tolist()


def test_a_frame_without_features_names_the_first_given(room, world):
    blind = observe(room.blind(0), np.zeros(0, bool), np.zeros(0, np.float32), room.camera, SCALES, TrackingSettings())
    assert most_alike(world, world.keyframes, blind, 2) == world.keyframes[:2].tolist()
