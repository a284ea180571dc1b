"""After the camera was lost: what is recognised, what only looks like it, and what the relocalisation gate admits."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from helpers.point_world import PointWorld, make_backend, observed, states, track_all
from helpers.ring_world import RingWorld, drive, position_errors, rotated
from scipy.spatial.transform import Rotation

from dynslam_bench.geometry import Camera, se3
from dynslam_bench.slam.atlas import Atlas
from dynslam_bench.slam.map import Map
from dynslam_bench.slam.relocalisation import (
    CHANGED,
    STRIDE,
    RelocalisationGate,
    RotationEstimate,
    are_different_places,
    is_aliased,
    match_keyframe,
    pose_uncertainty,
    ransac_pose,
    recognition_scores,
    top_candidates,
    verify_place,
)
from dynslam_bench.slam.settings import TrackingSettings
from dynslam_bench.slam.tracking import InitialPose, TrackedFrame, solve

STEP = 0.15
QUARTER = round((4.0 + np.pi / 2) / STEP)
"""Frames from a place to the one that looks the same, a corridor further on."""
FAST = {"relocalisation__max_speed": 100.0}
ROOM = PointWorld()


def run(world, path, **settings):
    backend, results, truth = drive(world, path, STEP, **settings)
    return backend, np.array(states(results)), position_errors(results, path, truth)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("alike", "path", "lost_from", "settings", "believing"),
    [
        (0.0, [*range(30), None, None, *range(6)], 30, {}, FAST),  # 4 m in less than a second
        (0.2, [*range(15), None, None, *range(QUARTER, QUARTER + 5)], 15, FAST,
         FAST | {"relocalisation__min_share": 0.0}),
    ],
)  # fmt: skip
def test_a_place_out_of_reach_or_only_similar_is_not_recognised(
    alike, path, lost_from, settings, believing
):
    _, recognised, _ = run(RingWorld(alike=alike), path, **settings)
    assert (recognised[:lost_from] == "ok").all()
    assert (recognised[lost_from:] == "lost").all()
    _, recognised, _ = run(RingWorld(alike=alike), path, **believing)
    assert (recognised[lost_from + 2 :] == "ok").any(), "without the rule it would be recognised"


def test_a_kidnapped_camera_is_relocalised_at_once_in_a_known_place():
    _, recognised, errors = run(RingWorld(), [*range(50), *range(10, 18)])
    assert (recognised[52:] == "ok").all()
    assert errors[52:].max() < 0.1


@pytest.mark.slow
@pytest.mark.parametrize(
    ("alike", "blind", "more", "recognised"),
    [(0.0, 30, 10, True), (0.5, 30, 0, False), (0.5, 0, 0, False)],
)
def test_a_frame_of_two_places_tells_nothing(alike, blind, more, recognised):
    """Blind for three seconds, in which both can be reached, or kidnapped from one frame to the next."""
    _, tracking, errors = run(
        RingWorld(alike=alike), [*range(2 * QUARTER + more), *[None] * blind, *range(10, 18)]
    )
    assert (tracking[-7:] == ("ok" if recognised else "lost")).all()
    assert not recognised or errors[-7:].max() < 0.1
    assert blind or tracking[2 * QUARTER] == "lost", "too far for a tenth of a second"


@pytest.mark.slow
@pytest.mark.parametrize(("alike", "aliased"), [(0.2, False), (0.6, True)])
def test_perceptual_aliasing(alike, aliased):
    world = RingWorld(alike=alike)
    settings = TrackingSettings()
    backend, tracking, _ = run(world, [*range(2 * QUARTER)])
    lap = world.lap(2 * QUARTER, STEP)
    observations = observed(world.see(lap[10], 999), world.camera)
    here = InitialPose(se3.inverse(lap[10]) @ lap[0], None, 0, seen_share=1.0, depth=3.0)
    everywhere = backend.map.keyframes
    assert (tracking == "ok").all()
    assert is_aliased(backend.map, observations, {0: here}, everywhere, settings, 0) is aliased
    assert not is_aliased(backend.map, observations, {0: here}, everywhere[:4], settings, 0)

    def near(submap, pose):
        return not are_different_places(here, InitialPose(pose, None, 0, depth=3.0))

    assert not is_aliased(backend.map, observations, {0: here}, everywhere, settings, 0, near)


def test_a_lost_camera_predicts_nothing_and_its_rotation_is_followed_in_every_frame(monkeypatch):
    calls = []
    while_lost = RelocalisationGate.while_lost
    monkeypatch.setattr(
        RelocalisationGate,
        "while_lost",
        lambda self, *args: (calls.append(args), while_lost(self, *args))[1],
    )
    backend, recognised, _ = run(RingWorld(), [*range(15), *range(60, 70)])
    assert (recognised[15:] == "lost").all(), "the first of the ten is compared by tracking"
    assert len(calls) == 9, "the first of the ten is compared by tracking"
    assert backend.predict_T_world_cam(2.6) == (None, None)


# ---------------------------------------------------------------------- the gate


def seen_from(pose, index):
    return observed(ROOM.see(pose, index), ROOM.camera, levels=1)


def pose_at(degrees, at=(0.0, 0.0, 0.0)):
    """Camera-to-world pose, rotated about the vertical."""
    T_world_cam = np.eye(4)
    T_world_cam[:3, :3] = rotated(degrees / 90)
    T_world_cam[:3, 3] = at
    return T_world_cam


@pytest.mark.parametrize(
    ("step", "sideways", "off"), [(3.0, 0.0, 1.0), (-3.0, 0.0, 1.0), (2.0, 0.03, 15.0)]
)
def test_the_rotation_is_followed_over_many_images(step, sideways, off):
    poses = [pose_at(step * k, (sideways * k, 0.0, 0.0)) for k in range(16)]
    estimate = RotationEstimate(seen_from(poses[0], 0), np.eye(3))
    for index, pose in enumerate(poses[1:], 1):
        estimate = estimate.advanced(seen_from(pose, index), ROOM.camera)
    last = se3.inverse(poses[0])
    now = se3.inverse(poses[-1])
    assert np.degrees(se3.rotation_angle(now @ se3.inverse(estimate.applied(last)))) < off
    assert np.degrees(estimate.slack) == pytest.approx(20 + 0.75 * np.degrees(estimate.apparent))
    assert np.degrees(estimate.apparent) >= 15 * abs(step) - 1
    assert estimate.allows(last, now)
    for quarters in (1, 2, 3):  # the next corners, which look the same
        beside = now @ se3.inverse(pose_at(90 * quarters))
        assert not estimate.allows(last, beside)
        assert estimate.allows(last, beside, more=np.pi)
    np.testing.assert_allclose(
        se3.inverse(estimate.applied(last))[:3, 3], poses[0][:3, 3], atol=1e-12
    )


@pytest.mark.parametrize("features", [0, 15, 400])
def test_images_that_show_nothing_common_are_not_connected(features):
    other = observed(ROOM.see(pose_at(180.0), 1, limit=features), ROOM.camera, levels=1)
    assert (
        RotationEstimate(seen_from(pose_at(0.0), 0), np.eye(3)).advanced(other, ROOM.camera) is None
    )


@pytest.mark.parametrize(("degrees", "kidnapped"), [(5.0, False), (180.0, True)])
def test_a_camera_that_still_sees_what_it_saw_is_not_kidnapped(degrees, kidnapped):
    """It showed a hundred map points and shows none now: kidnapped, or only rotated to an unmapped view."""
    first = seen_from(pose_at(0.0), 0)
    last = TrackedFrame(first, np.arange(len(first)), np.eye(4), 0.0)
    gate = RelocalisationGate(Atlas(Map(ROOM.camera, np.ones(1))), 2.0)
    gate.lose(last, seen_from(pose_at(degrees), 1), textured=True)
    assert np.isinf(gate.distance_m(last, 0.1)) == kidnapped
    assert (gate.rotation is None) is kidnapped
    bound = gate.while_lost(last, seen_from(pose_at(2 * degrees), 2), 0.2)
    assert bound.admits(0, se3.inverse(pose_at(2 * degrees)))
    assert bound.admits(0, se3.inverse(pose_at(2 * degrees + 90.0))) is kidnapped


# Place recognition: the RANSAC pose, whether the place is verified, and how well matches determine
# the pose.


FIRST = np.eye(4)


def mapped():
    """A room, and the map of its first view."""
    room = PointWorld()
    backend = make_backend(room)
    track_all(backend, [room.see(FIRST, 0, depthless=0.0)])
    return room, backend


def verified(backend, observations, patch, T_cam_world):
    """The verified place, from matches in a part of the image and from a pose."""
    every = match_keyframe(backend.map, 0, observations)
    few = every.select(patch(observations.xy[every.feature]))
    assert 8 <= len(few) < len(every) / 4
    return verify_place(
        backend.map, InitialPose(T_cam_world, few, 0), observations, TrackingSettings()
    )


def test_a_pose_grows_from_a_patch():
    room, backend = mapped()
    pose = se3.exp(np.array([0.1, 0.05, 0.0, 0.0, 0.02, 0.01]))
    observations = observed(room.see(pose, 1, noise_px=1.5), room.camera)
    place = verified(
        backend, observations, lambda xy: np.abs(xy - 120).max(axis=1) < 70, se3.inverse(pose)
    )
    assert place.seen_share > 0.7
    assert len(place.matches) > 150
    assert np.linalg.norm(se3.inverse(place.T_cam_world)[:3, 3] - pose[:3, 3]) < 0.03


def test_what_people_hide_is_not_expected_to_be_seen():
    room, backend = mapped()
    frame = room.see(FIRST, 1)
    mask = np.zeros((480, 640), bool)
    mask[:, 220:] = True
    outside = frame.xy[:, 0] < 219
    patch = lambda xy: (xy[:, 0] < 120) & (xy[:, 1] < 160)  # noqa: E731
    without = verified(backend, observed(frame, room.camera, keep=outside), patch, FIRST)
    behind = verified(
        backend, observed(replace(frame, mask=mask), room.camera, keep=outside), patch, FIRST
    )
    assert without.seen_share < 0.4 < 0.8 < behind.seen_share
    assert len(behind.matches) == len(without.matches)


@pytest.mark.parametrize(
    ("half", "beside", "precise"),
    [(60, 0, False), (60, 4, False), (60, 24, True), (90, 0, False), (250, 0, True)],
)
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_one_patch_does_not_determine_the_pose_nor_do_a_few_matches_beside_it(
    half, beside, precise, seed
):
    """Eighty matches each, from a square of twice `half` in an image of 640 x 480, and `beside` of them around it."""
    room = PointWorld(count=30_000)
    backend = make_backend(room)
    track_all(backend, [room.see(FIRST, 0, depthless=0.0, limit=4000)])
    pose = se3.exp(np.array([0.1, 0.05, 0.0, 0.0, 0.02, 0.01]))
    observations = observed(room.see(pose, 1, noise_px=1.0, limit=4000), room.camera)
    every = match_keyframe(backend.map, 0, observations)
    rng = np.random.default_rng(seed)
    off = np.abs(observations.xy[every.feature] - [260, 200]).max(axis=1)
    patch = rng.permutation(np.flatnonzero(off < half))
    beside_it = rng.permutation(np.flatnonzero(off > 150))
    few = every.select(np.sort(np.concatenate([patch[: 80 - beside], beside_it[:beside]])))
    fitted = solve(room.camera, observations, few, se3.inverse(pose))
    few = few.select(fitted.inliers)
    depth = np.median(se3.transform(fitted.T_cam_world, few.position)[:, 2])
    place = InitialPose(fitted.T_cam_world, few, 0, depth=float(depth))
    assert len(place.matches) > 60
    assert np.array_equal(fitted.information, fitted.information.T)
    assert (
        pose_uncertainty(backend.map, observations, place, np.random.default_rng(0)) <= 1
    ) == precise


@pytest.mark.parametrize("count", [0, 4, 6, 11])
def test_a_few_matches_determine_no_pose(count):
    room, backend = mapped()
    observations = observed(room.see(FIRST, 1), room.camera)
    place = InitialPose(
        FIRST, match_keyframe(backend.map, 0, observations).select(np.arange(count)), 0
    )
    assert pose_uncertainty(backend.map, observations, place, np.random.default_rng(0)) == np.inf


CAMERA = Camera(640, 480, 535.0, 539.0, 320.0, 247.0)


def true_and_false_matches(seed, count, right):
    """World points, noisy pixels of which the first `right` are right, and the world-to-camera pose."""
    rng = np.random.default_rng(seed)
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_rotvec(rng.normal(0, 0.5, 3)).as_matrix()
    pose[:3, 3] = rng.normal(0, 1, 3)
    xy = rng.uniform([0, 0], [640, 480], (count, 2))
    world = (CAMERA.unproject(xy, rng.uniform(1, 5, count)) - pose[:3, 3]) @ pose[:3, :3]
    world[right:] = world[right:][rng.permutation(count - right)]
    return world, xy + rng.normal(0, 0.5, xy.shape), pose


@pytest.mark.parametrize("seed", range(10))
def test_half_of_the_matches_may_be_wrong(seed):
    world, xy, pose = true_and_false_matches(seed, 80, 40)
    estimate, inliers = ransac_pose(world, xy, np.ones(80), CAMERA, np.random.default_rng(seed))
    _, rotation, translation, theirs = cv2.solvePnPRansac(
        world,
        xy,
        CAMERA.matrix,
        None,
        iterationsCount=150,
        reprojectionError=np.sqrt(2 * 5.991),
        confidence=0.999,
    )
    assert inliers[:40].sum() >= 30
    assert inliers[40:].sum() <= 3
    assert inliers.sum() >= len(theirs) - 8, "before any refinement, which theirs has"
    assert np.linalg.norm(estimate[:3, 3] - [pose[:3, 3], translation.ravel()], axis=1).max() < 0.15
    assert (
        np.linalg.norm(
            Rotation.from_matrix(estimate[:3, :3] @ cv2.Rodrigues(rotation)[0].T).as_rotvec()
        )
        < 0.05
    )


def test_coarse_features_may_be_farther_off():
    world, xy, _ = true_and_false_matches(4, 60, 60)
    xy = xy + np.random.default_rng(0).normal(0, 3.0, xy.shape)
    strict, coarse = (
        ransac_pose(world, xy, np.full(60, info), CAMERA, np.random.default_rng(0))[1]
        for info in (1.0, 0.1)
    )
    assert coarse.sum() > 50 > strict.sum()


def test_too_few_or_degenerate_points_give_no_pose():
    world, xy, _ = true_and_false_matches(0, 3, 3)
    assert ransac_pose(world, xy, np.ones(3), CAMERA, np.random.default_rng(0)) is None
    for world in (
        np.tile([[0.3, -0.2, 2.0]], (30, 1)),
        np.linspace([-1.0, 0.0, 3.0], [1.0, 0.0, 3.0], 30),
    ):
        xy = np.random.default_rng(0).uniform([0, 0], [640, 480], (30, 2))
        estimate = ransac_pose(world, xy, np.ones(30), CAMERA, np.random.default_rng(0))
        assert estimate is None or estimate[1].sum() < 15


# The ranking of keyframes by the descriptors' own substrings.


ANGLES = np.deg2rad(np.arange(0, 360, 30))


def observations(room, angle, index):
    """The features of a camera that looks in a direction, radians about the vertical."""
    return observed(
        room.see(se3.exp(np.array([0, 0, 0, 0, angle, 0])), index), room.camera, levels=1
    )


@pytest.fixture
def slam_map(room):
    """A map of twelve keyframes around a room, every feature a point of its own."""
    slam_map = Map(room.camera, np.ones(1))
    for index, angle in enumerate(ANGLES):
        features = observations(room, angle, index)
        slot = slam_map.add_keyframe(features, np.eye(4), index, index / 30)
        slam_map.add_points(
            np.ones((len(features), 3)), features.rgb, slot, np.arange(len(features))
        )
    return slam_map


@pytest.mark.parametrize("place", [0, 5, 11])
def test_the_keyframe_of_the_same_place_is_ranked_first(room, slam_map, place):
    best = top_candidates(
        slam_map, slam_map.keyframes, observations(room, ANGLES[place] + 0.02, 100), 3
    )
    assert len(best) == 3
    assert slam_map.kf_frame[best[0]] == place
    ranked = slam_map.kf_frame[
        top_candidates(slam_map, slam_map.keyframes, observations(room, ANGLES[4], 100), 11)
    ].tolist()
    assert ranked[0] == 4
    assert set(ranked[1:3]) == {3, 5}


def test_only_the_keyframes_given_are_chosen(room, slam_map):
    given = slam_map.keyframes[[1, 2, 8, 9]]
    best = top_candidates(slam_map, given, observations(room, ANGLES[5], 100), 2)
    assert len(best) == 2
    assert set(best) <= set(given.tolist())
    assert top_candidates(slam_map, given, observations(room, 0.0, 100), 4) == given.tolist()
    assert top_candidates(
        slam_map, slam_map.keyframes, observed(room.blind(0), room.camera), 2
    ) == [0, 1]


def test_of_equal_scores_the_newer_keyframe_is_first(room, slam_map):
    """A frame whose substrings no keyframe has scores zero everywhere."""
    stranger = observations(PointWorld(seed=9), 0.0, 100)
    stored = slam_map.kf_descriptor[slam_map.keyframes].view(np.uint16)[:, :, ::STRIDE]
    used = np.concatenate(
        [stored[row, : slam_map.kf_count[slot]] for row, slot in enumerate(slam_map.keyframes)]
    )
    stranger.descriptors.view(np.uint16)[:] = np.setdiff1d(np.arange(1 << 16), used)[0]
    newest = slam_map.keyframes[np.argsort(-slam_map.kf_id[slam_map.keyframes])]
    assert top_candidates(slam_map, slam_map.keyframes, stranger, 4) == newest[:4].tolist()


def reference_scores(slam_map, keyframes, features):
    """Scores of keyframes, counted substring by substring without an index."""
    query = np.ascontiguousarray(features.descriptors).view(np.uint16)[:, ::STRIDE]
    shared = []
    for slot in keyframes.tolist():
        own = slam_map.kf_descriptor[slot, slam_map.kf_point[slot] >= 0].view(np.uint16)[
            :, ::STRIDE
        ]
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
        scores.append(
            sum(weights) / np.sqrt(max(np.count_nonzero(slam_map.kf_point[slot] >= 0), 1))
        )
    return np.array(scores)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_the_index_follows_keyframes_that_come_and_go(room, seed):
    """Keyframes of many sizes, some features without a point, slots used again, and only some asked for."""
    slam_map = Map(room.camera, np.ones(1))
    rng = np.random.default_rng(seed)
    compared = 0
    for number in range(40):
        if slam_map.keyframe_count < 4 or rng.random() < 0.6:
            features = observations(room, rng.uniform(0, 6), number)
            slot = slam_map.add_keyframe(features, np.eye(4), number, number / 30)
            some = np.flatnonzero(rng.random(len(features)) < 0.6)
            slam_map.add_points(np.ones((len(some), 3)), features.rgb[some], slot, some)
        else:
            slam_map.remove_keyframe(int(rng.choice(slam_map.keyframes)))
        asked = slam_map.keyframes[rng.random(slam_map.keyframe_count) < 0.8]
        if number % 3 == 0 and len(asked):  # not each time: several come and go in between
            features = observations(room, rng.uniform(0, 6), 1000 + number)
            compared = compared + 1
            expected = reference_scores(slam_map, asked, features)
            np.testing.assert_allclose(
                recognition_scores(slam_map, asked, features), expected, rtol=1e-9
            )
    assert compared > 8


def test_a_keyframe_is_indexed_again_when_many_of_its_points_changed(room, slam_map):
    (slot,) = slam_map.keyframes[:1]
    count = int(np.count_nonzero(slam_map.kf_point[slot] >= 0))
    for removed, indexed in (
        (0, count),
        (int(count * CHANGED), count),
        (int(count * CHANGED) + 1, None),
    ):
        slam_map.kf_point[slot, :removed] = -1
        recognition_scores(slam_map, slam_map.keyframes, observations(room, 0.0, 100))
        assert slam_map.substrings[slot][1].shape[1] == (
            count - removed if indexed is None else indexed
        )
