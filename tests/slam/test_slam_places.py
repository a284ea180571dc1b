"""The ranking of keyframes by the descriptors' own substrings."""

import numpy as np
import pytest
from point_world import PointWorld, observed

from dynslam_bench.geometry import se3
from dynslam_bench.slam.map import Map
from dynslam_bench.slam.place_recognition import CHANGED, STRIDE, recognition_scores, top_candidates

ANGLES = np.deg2rad(np.arange(0, 360, 30))


def observations(room, angle, index):
    """The features of a camera that looks in a direction, radians about the vertical."""
    return observed(room.see(se3.exp(np.array([0, 0, 0, 0, angle, 0])), index), room.camera, levels=1)


@pytest.fixture
def world(room):
    """A map of twelve keyframes around a room, every feature a point of its own."""
    world = Map(room.camera, np.ones(1))
    for index, angle in enumerate(ANGLES):
        features = observations(room, angle, index)
        slot = world.add_keyframe(features, np.eye(4), index, index / 30)
        world.add_points(np.ones((len(features), 3)), features.rgb, slot, np.arange(len(features)))
    return world


@pytest.mark.parametrize("place", [0, 5, 11])
def test_the_keyframe_of_the_same_place_is_ranked_first(room, world, place):
    best = top_candidates(world, world.keyframes, observations(room, ANGLES[place] + 0.02, 100), 3)
    assert len(best) == 3 and world.kf_frame[best[0]] == place
    neighbours = top_candidates(world, world.keyframes, observations(room, ANGLES[4], 100), 11)
    assert [int(world.kf_frame[slot]) for slot in neighbours[:1]] == [4]
    assert {int(world.kf_frame[slot]) for slot in neighbours[1:3]} == {3, 5}


def test_only_the_keyframes_given_are_chosen(room, world):
    given = world.keyframes[[1, 2, 8, 9]]
    best = top_candidates(world, given, observations(room, ANGLES[5], 100), 2)
    assert len(best) == 2 and set(best) <= set(given.tolist())
    assert top_candidates(world, given, observations(room, 0.0, 100), 4) == given.tolist()
    assert top_candidates(world, world.keyframes, observed(room.blind(0), room.camera), 2) == [0, 1]


def test_of_equal_scores_the_newer_keyframe_is_first(room, world):
    """A frame whose substrings no keyframe has scores zero everywhere."""
    stranger = observations(PointWorld(seed=9), 0.0, 100)
    stored = world.kf_words[world.keyframes].view(np.uint16)[:, :, ::STRIDE]
    used = np.concatenate([stored[row, : world.kf_count[slot]] for row, slot in enumerate(world.keyframes)])
    stranger.words.view(np.uint16)[:] = np.setdiff1d(np.arange(1 << 16), used)[0]
    newest = world.keyframes[np.argsort(-world.kf_id[world.keyframes])]
    assert top_candidates(world, world.keyframes, stranger, 4) == newest[:4].tolist()


def reference_scores(world, keyframes, features):
    """The same score, counted substring by substring without an index."""
    query = np.ascontiguousarray(features.words).view(np.uint16)[:, ::STRIDE]
    shared = []
    for slot in keyframes.tolist():
        own = world.kf_words[slot, world.kf_point[slot] >= 0].view(np.uint16)[:, ::STRIDE]
        shared.append([own[np.isin(own[:, p], query[:, p]), p] for p in range(query.shape[1])])
    everything = [np.concatenate([columns[p] for columns in shared]) for p in range(query.shape[1])]
    total = sum(map(len, everything))
    scores = []
    for slot, columns in zip(keyframes.tolist(), shared, strict=True):
        weights = [
            np.log(total / np.count_nonzero(everything[p] == value))
            for p, column in enumerate(columns)
            for value in column
        ]
        scores.append(sum(weights) / np.sqrt(max(np.count_nonzero(world.kf_point[slot] >= 0), 1)))
    return np.array(scores)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_the_index_follows_keyframes_that_come_and_go(room, seed):
    """Keyframes of many sizes, some features without a point, slots used again, and only some asked for."""
    world, rng, compared = Map(room.camera, np.ones(1)), np.random.default_rng(seed), 0
    for number in range(40):
        if world.keyframe_count < 4 or rng.random() < 0.6:
            features = observations(room, rng.uniform(0, 6), number)
            slot = world.add_keyframe(features, np.eye(4), number, number / 30)
            some = np.flatnonzero(rng.random(len(features)) < 0.6)
            world.add_points(np.ones((len(some), 3)), features.rgb[some], slot, some)
        else:
            world.remove_keyframe(int(rng.choice(world.keyframes)))
        asked = world.keyframes[rng.random(world.keyframe_count) < 0.8]
        if number % 3 == 0 and len(asked):  # not each time: several come and go in between
            features, compared = observations(room, rng.uniform(0, 6), 1000 + number), compared + 1
            expected = reference_scores(world, asked, features)
            np.testing.assert_allclose(recognition_scores(world, asked, features), expected, rtol=1e-9)
    assert compared > 8


def test_a_keyframe_is_indexed_again_when_many_of_its_points_changed(room, world):
    (slot,) = world.keyframes[:1]
    count = int(np.count_nonzero(world.kf_point[slot] >= 0))
    for removed, indexed in ((0, count), (int(count * CHANGED), count), (int(count * CHANGED) + 1, None)):
        world.kf_point[slot, :removed] = -1
        recognition_scores(world, world.keyframes, observations(room, 0.0, 100))
        assert world.substrings[slot][1].shape[1] == (count - removed if indexed is None else indexed)
