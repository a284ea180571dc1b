"""The map's tables: who observes what, in a pool that gives each point room for as many as it has."""

from dataclasses import replace

import numpy as np
import pytest

from dynslam_bench.geometry import se3
from dynslam_bench.slam.backend import RgbdBackend
from dynslam_bench.slam.local_mapping import triangulate
from dynslam_bench.slam.map import Map
from dynslam_bench.slam.map_kernels import distinct
from dynslam_bench.slam.observation import observe
from dynslam_bench.slam.settings import MappingSettings, TrackingSettings


def keyframe_of(room, world, pose, index, octave=0):
    frame = room.see(pose, index, noise_px=0.0)
    frame = replace(frame, z=np.zeros_like(frame.z))
    keep, weight = np.ones(len(frame), bool), np.ones(len(frame), np.float32)
    seen = observe(frame, keep, weight, room.camera, world.scales, TrackingSettings())
    return world.add_keyframe(replace(seen, octave=seen.octave + octave), se3.inverse(pose), index, index / 30)


def observers(world, point):
    rows = world.observations(np.array([point]))
    return list(zip(world.obs_kf[rows].tolist(), world.obs_ft[rows].tolist(), strict=True))


def test_points_and_keyframes_say_the_same_after_a_walk(room, tracked):
    """Places of features that a keyframe does not have, since another one has more, observe nothing either."""
    backend = RgbdBackend()
    backend.reset(room.camera, 0)
    tracked(backend, [room.see(pose, i, limit=300 + 2 * i) for i, pose in enumerate(room.path(120))])
    world = backend.world
    points, (keyframe, feature) = world.points, np.nonzero((world.kf_point >= 0) & world.kf_alive[:, None])
    said = {(int(k), int(f)): int(world.kf_point[k, f]) for k, f in zip(keyframe, feature, strict=True)}
    rows = world.observations(points)
    pairs = zip(world.obs_kf[rows].tolist(), world.obs_ft[rows].tolist(), strict=True)
    assert dict(zip(pairs, np.repeat(points, world.n_obs[points]).tolist(), strict=True)) == said and len(said) > 1000
    begin, end = world.obs_at[points], world.obs_at[points] + world.obs_room[points]
    order = np.argsort(begin)
    assert (end[order][:-1] <= begin[order][1:]).all() and (world.n_obs[points] <= world.obs_room[points]).all()


@pytest.mark.parametrize("named", [0, 1, 50, 400])
def test_points_that_a_table_names_are_found_once(named):
    rng = np.random.default_rng(named)
    table = np.where(rng.random((7, 90)) < 0.5, rng.integers(0, max(named, 1), (7, 90)), -1).astype(np.int32)
    table[:, : 90 if named == 0 else 0] = -1
    np.testing.assert_array_equal(distinct(table, 500), np.unique(table[table >= 0]))


def test_one_point_that_many_keyframes_see_costs_the_others_nothing(room):
    world = Map(room.camera, np.ones(1))
    first = keyframe_of(room, world, np.eye(4), 0)
    points = world.add_points(np.ones((300, 3)), np.zeros((300, 3), np.uint8), first, np.arange(300))
    for index in range(1, 100):
        world.observe(keyframe_of(room, world, np.eye(4), index), np.array([7]), points[:1])
    assert len(observers(world, points[0])) == 100 and observers(world, points[0])[1] == (1, 7)
    assert observers(world, points[1]) == [(0, 1)]
    assert world.obs_kf.size < 2500, "300 points of one observation each, and one of a hundred"


def test_what_points_become_together_finds_room(room):
    world = Map(room.camera, np.ones(1))
    slots = [keyframe_of(room, world, np.eye(4), index) for index in range(40)]
    one, other, last = world.add_points(np.ones((3, 3)), np.zeros((3, 3), np.uint8), slots[0], np.arange(3))
    for slot in slots[1:]:
        world.observe(slot, np.array([0, 1]) if slot % 2 else np.array([1, 0]), np.array([one, other]))
    for slot in slots[20:]:
        world.unobserve(np.array([slot]), np.array([1 if slot % 2 else 0]))
    world.observe(slots[1], np.array([2]), np.array([last]))
    known = observers(world, last), observers(world, one), observers(world, other)
    assert [len(each) for each in known] == [2, 40, 20]
    world.merge(int(one), int(last))
    found = observers(world, last)
    assert set(found) >= set(known[0]) and len({slot for slot, _ in found}) == len(found) == 40
    assert observers(world, other) == known[2], "beside it nothing has changed"


def test_room_that_points_leave_is_used_again(room):
    world = Map(room.camera, np.ones(1))
    slots = [keyframe_of(room, world, np.eye(4), index) for index in range(9)]
    sizes = []
    for _ in range(6):
        points = world.add_points(np.ones((200, 3)), np.zeros((200, 3), np.uint8), slots[0], np.arange(200))
        for slot in slots[1:]:
            world.observe(slot, np.arange(200), points)
        world.merge(int(points[0]), int(points[1]))
        world.remove_points(points)
        world.release()
        assert not world.n_obs.any() and (world.kf_point[slots] < 0).all()
        sizes.append(world.obs_kf.size)
    assert sizes[1:] == sizes[1:2] * 5


def flat(room, degrees):
    """Two poses before 400 points on a wall 3 m away, the second one so much to the side."""
    room.points = room.points[:400] * [1.0, 1.0, 0.0] + [0.0, 0.0, 3.0]
    room.descriptors = room.descriptors[:400]
    step = np.eye(4)
    step[0, 3] = 3.0 * np.tan(np.deg2rad(degrees))
    return np.eye(4), step


@pytest.mark.parametrize(
    ("octaves", "sigmas", "made"),
    [
        *(((0, 0), 0.0, True), ((0, 0), 6.0, True), ((0, 3), 6.0, True), ((7, 7), 0.0, True), ((7, 5), 0.0, True)),
        *(((7, 7), 6.0, False), ((5, 7), 6.0, False), ((7, 5), 6.0, False)),
    ],
)
def test_a_coarse_feature_makes_a_point_only_of_a_wide_parallax(room, octaves, sigmas, made):
    """1.5 degrees are 14 standard deviations of a feature of the finest octave, and 4 of one of the coarsest."""
    world = Map(room.camera, 1.2 ** np.arange(8))
    poses = enumerate(flat(room, 1.5))
    one, other = (keyframe_of(room, world, pose, i, octave) for (i, pose), octave in zip(poses, octaves, strict=True))
    ours, _, position = triangulate(world, one, other, MappingSettings(min_parallax_sigmas=sigmas))
    assert (len(ours) > 30) is made and (made or not len(ours))
    assert np.allclose(position[:, 2], 3.0, rtol=0.01)
