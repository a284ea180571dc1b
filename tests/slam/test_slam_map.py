"""The map's tables: who observes what, and triangulation of new points."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.point_world import make_backend, observed, track_all, without_depth
from scipy.optimize import least_squares
from scipy.stats import chi2

from dynslam_bench.geometry import Camera, se3
from dynslam_bench.slam import tracking
from dynslam_bench.slam.bundle_adjustment import BundleProblem, adjust_bundle
from dynslam_bench.slam.local_mapping import triangulate
from dynslam_bench.slam.map import Map
from dynslam_bench.slam.tracking import LocalMap, unconnected, weakly_connected


def keyframe_of(room, slam_map, pose, index, octave=0):
    observations = observed(
        without_depth(room.see(pose, index, noise_px=0.0)), room.camera, levels=len(slam_map.scales)
    )
    return slam_map.add_keyframe(
        replace(observations, octave=observations.octave + octave),
        se3.inverse(pose),
        index,
        index / 30,
    )


def observers(slam_map, point):
    keyframes, features = slam_map.observations(np.array([point]))
    return list(zip(keyframes.tolist(), features.tolist(), strict=True))


@pytest.mark.slow
def test_points_and_keyframes_agree_on_their_observations(room):
    """Table entries of features that a keyframe does not have, since another one has more, observe nothing either."""
    backend = make_backend(room)
    track_all(
        backend, [room.see(pose, i, limit=300 + 2 * i) for i, pose in enumerate(room.path(120))]
    )
    slam_map = backend.map
    points = slam_map.points
    (keyframe, feature) = np.nonzero((slam_map.kf_point >= 0) & slam_map.kf_alive[:, None])
    by_feature = dict(
        zip(zip(keyframe, feature, strict=True), slam_map.kf_point[keyframe, feature], strict=True)
    )
    pairs = zip(*slam_map.observations(points), strict=True)
    by_point = dict(zip(pairs, np.repeat(points, slam_map.n_obs[points]), strict=True))
    assert by_feature == by_point
    assert len(by_point) > 1000


def test_a_point_has_as_many_observations_as_keyframes_see_it(room):
    slam_map = Map(room.camera, np.ones(1))
    first = keyframe_of(room, slam_map, np.eye(4), 0)
    points = slam_map.add_points(
        np.ones((300, 3)), np.zeros((300, 3), np.uint8), first, np.arange(300)
    )
    for index in range(1, 100):
        slam_map.observe(keyframe_of(room, slam_map, np.eye(4), index), np.array([7]), points[:1])
    assert observers(slam_map, points[0]) == [(0, 0), *((index, 7) for index in range(1, 100))]


def test_merged_points_keep_every_observation_once(room):
    slam_map = Map(room.camera, np.ones(1))
    slots = [keyframe_of(room, slam_map, np.eye(4), index) for index in range(40)]
    one, other, last = slam_map.add_points(
        np.ones((3, 3)), np.zeros((3, 3), np.uint8), slots[0], np.arange(3)
    )
    for slot in slots[1:]:
        slam_map.observe(
            slot, np.array([0, 1]) if slot % 2 else np.array([1, 0]), np.array([one, other])
        )
    for slot in slots[20:]:
        slam_map.unobserve(np.array([slot]), np.array([1 if slot % 2 else 0]))
    slam_map.observe(slots[1], np.array([2]), np.array([last]))
    before = observers(slam_map, last), observers(slam_map, one), observers(slam_map, other)
    assert [len(pairs) for pairs in before] == [2, 40, 20]
    slam_map.replace_point(int(one), int(last))
    merged = observers(slam_map, last)
    assert set(merged) >= set(before[0])
    assert len({slot for slot, _ in merged}) == len(merged) == 40
    assert observers(slam_map, other) == before[2]


def test_the_room_of_removed_points_is_used_again(room):
    slam_map = Map(room.camera, np.ones(1))
    slots = [keyframe_of(room, slam_map, np.eye(4), index) for index in range(9)]
    sizes = []
    for _ in range(6):
        points = slam_map.add_points(
            np.ones((200, 3)), np.zeros((200, 3), np.uint8), slots[0], np.arange(200)
        )
        for slot in slots[1:]:
            slam_map.observe(slot, np.arange(200), points)
        slam_map.replace_point(int(points[0]), int(points[1]))
        slam_map.remove_points(points)
        slam_map.release()
        assert not slam_map.n_obs.any()
        assert (slam_map.kf_point[slots] < 0).all()
        sizes.append(slam_map.obs_kf.size)
    assert sizes[1:] == sizes[1:2] * 5


@pytest.mark.parametrize(
    ("octaves", "sigmas", "triangulated"),
    [
        *(
            ((0, 0), 0.0, True),
            ((0, 0), 6.0, True),
            ((0, 3), 6.0, True),
            ((7, 7), 0.0, True),
            ((7, 5), 0.0, True),
        ),
        *(((7, 7), 6.0, False), ((5, 7), 6.0, False), ((7, 5), 6.0, False)),
    ],
)
def test_a_coarse_feature_needs_a_larger_parallax(room, octaves, sigmas, triangulated):
    """1.5 degrees are 14 standard deviations of a feature of the finest octave, and 4 of one of the coarsest."""
    room.points = room.points[:400] * [1.0, 1.0, 0.0] + [0.0, 0.0, 3.0]
    room.descriptors = room.descriptors[:400]
    step = np.eye(4)
    slam_map = Map(room.camera, 1.2 ** np.arange(8))
    step[0, 3] = 3.0 * np.tan(np.deg2rad(1.5))
    one, other = (
        keyframe_of(room, slam_map, p, i, octaves[i]) for i, p in enumerate((np.eye(4), step))
    )
    features, _, position = triangulate(slam_map, one, other, sigmas)
    assert (len(features) > 30) is triangulated
    assert triangulated or not len(features)
    assert np.allclose(position[:, 2], 3.0, rtol=0.01)


# The local map: with loop closing it ends where the covisibility graph does.


SHARED = 10
"""Points that each keyframe of the chain shares with the next one."""


@pytest.fixture
def chain(room):
    """Six keyframes in a row; each shares ten points with the next, and with no other."""
    observations = observed(room.see(np.eye(4), 0), room.camera, levels=1)
    slam_map = Map(room.camera, np.ones(1))
    last = np.zeros(0, np.int64)
    for index in range(6):
        slot = slam_map.add_keyframe(observations, np.eye(4), index, float(index))
        slam_map.observe(slot, np.arange(len(last)), last)
        fresh = np.arange(SHARED, 2 * SHARED)
        last = slam_map.add_points(
            np.ones((SHARED, 3)), np.zeros((SHARED, 3), np.uint8), slot, fresh
        )
    return slam_map


@pytest.mark.parametrize(
    ("keyframe", "gap", "expected"),
    [(5, 2, [0, 1, 2]), (5, 4, [0, 1]), (0, 4, [4, 5]), (2, 3, [5])],
)
def test_unconnected_keyframes_are_old_and_share_no_covisible_keyframe(
    chain, keyframe, gap, expected
):
    assert unconnected(chain, keyframe, gap).tolist() == expected


def test_keyframes_that_share_few_points_may_be_recognised_anew(chain, monkeypatch):
    assert weakly_connected(chain, 5, 1).tolist() == [0, 1, 2, 3, 4]
    monkeypatch.setattr(tracking, "STRONG_COVISIBILITY", SHARED)
    assert weakly_connected(chain, 5, 1).tolist() == [0, 1, 2]
    assert weakly_connected(chain, 5, 4).tolist() == [0, 1]


def test_the_local_map_is_the_whole_map_or_the_connected_part(chain, monkeypatch):
    keyframes, points = LocalMap(chain, connected_only=False).around(5)
    assert keyframes.tolist() == [0, 1, 2, 3, 4, 5]
    assert (points == chain.points).all()
    monkeypatch.setattr(
        tracking, "unconnected", lambda slam_map, slot: unconnected(slam_map, slot, 2)
    )
    local_map = LocalMap(chain, connected_only=True)
    keyframes, points = local_map.around(5)
    assert keyframes.tolist() == [3, 4, 5]
    assert sorted(set(chain.born[points].tolist())) == [2, 3, 4, 5]
    assert len(points) == 4 * SHARED
    assert local_map.around(0)[0].tolist() == [0, 1, 2]
    chain.remove_keyframe(1)
    chain.next_keyframe += 1
    assert local_map.around(0)[0].tolist() == [0]


# Local bundle adjustment against a general least-squares solver.


CAMERA = Camera(640, 480, 525.0, 525.0, 319.5, 239.5)
POSES = 4
VARIABLE = 2
POINTS = 16


def measured(poses, points):
    """Pixels and right coordinates ``[N, 3]`` of all points in all views, point by point."""
    local = np.einsum("pij,qj->qpi", poses[:, :3, :3], points) + poses[:, :3, 3]
    uv = CAMERA.project(local)
    return np.concatenate(
        [uv, uv[..., :1] - CAMERA.fx * CAMERA.baseline_m / local[..., 2:]], axis=-1
    ).reshape(-1, 3)


@pytest.mark.parametrize("with_depth", [0.6, 1.0])
def test_bundle_adjustment_agrees_with_general_least_squares(with_depth):
    rng = np.random.default_rng(0)
    true = se3.exp(rng.normal(0, 0.06, (POSES, 6)))
    points = rng.uniform([-1, -1, 2], [1, 1, 4], (POINTS, 3))
    values = measured(true, points) + rng.normal(0, 0.3, (POSES * POINTS, 3))
    info = np.ones(len(values))
    has_depth = rng.random(len(values)) < with_depth
    start = np.concatenate(
        [se3.exp(rng.normal(0, 0.01, (VARIABLE, 6))) @ true[:VARIABLE], true[VARIABLE:]]
    )
    problem = BundleProblem(
        start, VARIABLE, points + rng.normal(0, 0.02, points.shape), np.tile(np.arange(POSES), POINTS),
        np.repeat(np.arange(POINTS), POSES), values[:, :2].copy(), values[:, 2].copy(), info, info * has_depth, CAMERA,
    )  # fmt: skip

    def moved(x):
        twists, offsets = np.split(x, [6 * VARIABLE])
        poses = np.concatenate(
            [se3.exp(twists.reshape(-1, 6)) @ start[:VARIABLE], start[VARIABLE:]]
        )
        return poses, problem.points + offsets.reshape(-1, 3)

    def errors(x):
        return np.where([True, True, False], True, has_depth[:, None]) * (
            measured(*moved(x)) - values
        )

    def residuals(x):
        squared = (errors(x) ** 2).sum(axis=1, keepdims=True)
        return (
            errors(x) * np.sqrt(width * np.log1p(squared / width) / squared)
        ).ravel()  # their squares are Cauchy's costs

    start_chi2 = (errors(np.zeros(6 * VARIABLE + 3 * POINTS)) ** 2).sum(axis=1)
    width = 5.0 * np.median(start_chi2 / chi2.median(np.where(has_depth, 3, 2)))
    solution = least_squares(residuals, np.zeros(6 * VARIABLE + 3 * POINTS), xtol=1e-12, ftol=1e-12)
    result = adjust_bundle(problem, 40)
    assert result.inliers.all()
    assert result.cost == pytest.approx(2 * solution.cost, rel=1e-4)
    np.testing.assert_allclose(result.poses, moved(solution.x)[0], atol=1e-4)
    behind = problem.points * np.where(np.arange(POINTS) % 5 < 3, -1, 1)[:, None]
    rest = adjust_bundle(replace(problem, points=behind), 40)
    assert np.isfinite(rest.cost), "points behind the camera stop no other's adjustment"
    assert rest.inliers.mean() > 0.35, "points behind the camera stop no other's adjustment"
