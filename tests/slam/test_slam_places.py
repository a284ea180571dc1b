"""Which keyframes look like a frame: the ranking by the descriptors' own pieces."""

import numpy as np
import pytest

from dynslam_bench.geometry import se3
from dynslam_bench.slam.descriptor_index import CHANGED, EVERY, DescriptorIndex
from dynslam_bench.slam.map import Map
from dynslam_bench.slam.observation import observe
from dynslam_bench.slam.place_recognition import recognition_scores, top_candidates
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
    found = top_candidates(world, world.keyframes, seen(room, TURNS[place] + 0.02, 100), 3)
    assert len(found) == 3 and world.kf_frame[found[0]] == place


def test_neighbours_that_share_the_view_come_before_the_wall_behind(room, world):
    order = [
        int(world.kf_frame[slot]) for slot in top_candidates(world, world.keyframes, seen(room, TURNS[4], 100), 11)
    ]
    assert order[0] == 4 and set(order[1:3]) == {3, 5}


def test_only_the_keyframes_given_are_chosen(room, world):
    given = world.keyframes[[1, 2, 8, 9]]
    found = top_candidates(world, given, seen(room, TURNS[5], 100), 2)
    assert len(found) == 2 and set(found) <= set(given.tolist())


def test_few_keyframes_are_taken_as_they_come(room, world):
    given = world.keyframes[[7, 0, 3]]
    assert top_candidates(world, given, seen(room, 0.0, 100), 3) == given.tolist()
    assert top_candidates(world, given, seen(room, 0.0, 100), 10) == given.tolist()


def test_equal_scores_go_to_the_newer_keyframe(room, world):
    """A frame whose descriptors no keyframe has scores zero everywhere."""
    stranger = seen(type(room)(seed=9), 0.0, 100)
    stranger.words[:] = 0
    known = world.kf_words[world.keyframes].view(np.uint16)[:, :, ::4]
    used = np.concatenate([known[row, : world.kf_count[slot]] for row, slot in enumerate(world.keyframes)])
    absent = np.setdiff1d(np.arange(1 << 16), used)[0]
    stranger.words.view(np.uint16)[:] = absent
    newest = world.keyframes[np.argsort(-world.kf_id[world.keyframes])]
    assert top_candidates(world, world.keyframes, stranger, 4) == newest[:4].tolist()


def test_a_frame_without_features_names_the_first_given(room, world):
    blind = observe(room.blind(0), np.zeros(0, bool), np.zeros(0, np.float32), room.camera, SCALES, TrackingSettings())
    assert top_candidates(world, world.keyframes, blind, 2) == world.keyframes[:2].tolist()


def counted(world, keyframes, features):
    """The same score, counted piece by piece without an index."""
    own = np.ascontiguousarray(features.words).view(np.uint16)[:, ::EVERY]
    shared = []
    for slot in keyframes.tolist():
        pieces = world.kf_words[slot, world.kf_point[slot] >= 0].view(np.uint16)[:, ::EVERY]
        shared.append([pieces[np.isin(pieces[:, place], own[:, place]), place] for place in range(own.shape[1])])
    everything = [np.concatenate([each[place] for each in shared]) for place in range(own.shape[1])]
    total = sum(map(len, everything))
    scores = []
    for slot, each in zip(keyframes.tolist(), shared, strict=True):
        weights = [
            np.log(total / np.count_nonzero(everything[p] == value)) for p, found in enumerate(each) for value in found
        ]
        scores.append(sum(weights) / np.sqrt(max(np.count_nonzero(world.kf_point[slot] >= 0), 1)))
    return np.array(scores)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_the_index_counts_what_is_there_after_keyframes_came_and_went(room, seed):
    """Keyframes of many sizes, some features without a point, slots used again, and only some asked for."""
    world, rng, looked = Map(room.camera, SCALES), np.random.default_rng(seed), 0
    for number in range(40):
        if world.keyframe_count < 4 or rng.random() < 0.6:
            features = seen(room, rng.uniform(0, 6), number)
            slot = world.add_keyframe(features, np.eye(4), number, number / 30)
            some = np.flatnonzero(rng.random(len(features)) < 0.6)
            world.add_points(np.ones((len(some), 3)), features.rgb[some], slot, some)
        else:
            world.remove_keyframe(int(rng.choice(world.keyframes)))
        asked = world.keyframes[rng.random(world.keyframe_count) < 0.8]
        if number % 3 == 0 and len(asked):  # not each time: several come and go in between
            features, looked = seen(room, rng.uniform(0, 6), 1000 + number), looked + 1
            np.testing.assert_allclose(
                recognition_scores(world, asked, features), counted(world, asked, features), rtol=1e-9
            )
    assert looked > 8


@pytest.mark.parametrize("values", [1 << 16, 300])
def test_the_index_has_room_for_any_number_of_pieces(values):
    """More than there was room for at first; of all values, or crowded on few."""
    rng, slots, features = np.random.default_rng(0), 640, 2400
    pieces = rng.integers(0, values, (slots, features, 1)).astype(np.uint16)
    kf_point = np.where(rng.random((slots, features)) < 0.9, 7, -1).astype(np.int32)
    index, ids, own = DescriptorIndex(), np.arange(slots), rng.integers(0, values, (500, 1)).astype(np.uint16)
    index.renew(np.ones(slots, bool), ids, kf_point, pieces)
    score, points = index.score(ids, own)
    np.testing.assert_array_equal(points, (kf_point >= 0).sum(axis=1))
    held = np.array([np.bincount(pieces[k, kf_point[k] >= 0, 0], minlength=values) for k in ids])[:, np.unique(own)]
    every = held.sum(axis=0)
    weight = np.log(every.sum() / np.maximum(every, 1))
    np.testing.assert_allclose(score, held @ weight, rtol=1e-9)
    index.renew(np.zeros(slots, bool), ids, kf_point, pieces)
    assert not index.score(ids, own)[0].any(), "all went"


def test_a_keyframe_is_taken_up_anew_when_many_of_its_points_are_others():
    pieces, ids, alive = np.arange(100, dtype=np.uint16).reshape(1, 100, 1), np.zeros(1, np.int64), np.ones(1, bool)
    index, kf_point = DescriptorIndex(), np.full((1, 100), 3, np.int32)
    most = round(100 * CHANGED)
    for gone, counted in ((0, 100), (most, 100), (most + 1, 99 - most), (60, 40)):
        kf_point[0, :gone] = -1
        index.renew(alive, ids, kf_point, pieces)
        assert index.score(ids, pieces[0])[1] == counted
