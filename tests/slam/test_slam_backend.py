"""The back end on a simulated world: accuracy, repeatability, tracking state, bad input."""

import warnings
from dataclasses import replace

import numpy as np
import pytest
from helpers.point_world import (
    PointWorld,
    errors,
    make_backend,
    observed,
    states,
    track_all,
    without_depth,
)

from dynslam_bench.core.settings import apply_overrides
from dynslam_bench.geometry import se3
from dynslam_bench.slam import map as slam_map
from dynslam_bench.slam.motion_model import MAX_GAP_S, CameraVelocity, compensate_rolling_shutter

COUNTS = ("matches", "inliers", "residual_px", "relocalised", "keyframe", "map_points", "keyframes")


def test_follows_a_smooth_path_to_millimetres(room):
    truth = room.path(90)
    backend = make_backend(room)
    results = track_all(backend, [room.see(pose, i, wrong=40) for i, pose in enumerate(truth)])
    assert states(results) == ["ok"] * 90
    assert errors(results, truth).max() < 0.012
    final = backend.finalize()
    online = np.sqrt((errors(results, truth) ** 2).mean())
    start = final.T_world_cam[0] @ se3.inverse(truth[0])
    refined = np.linalg.norm((se3.inverse(start @ truth) @ final.T_world_cam)[:, :3, 3], axis=1)
    assert len(final) == 90
    assert np.sqrt((refined**2).mean()) < 1.5 * online + 0.001


def test_counts_and_times_are_there_on_every_frame(room):
    frames = [
        room.blind(0),
        *(room.see(pose, i + 1) for i, pose in enumerate(room.path(12))),
        room.blind(20),
    ]
    results = track_all(make_backend(room), frames)
    assert states(results) == ["initialising"] + ["ok"] * 12 + ["lost"]
    for r in results:
        assert np.isfinite([getattr(r, name) for name in COUNTS]).all()
        assert list(r.timings) == ["tracking", "mapping", "bundle_adjustment"]
    first = results[1]
    lost = results[-1]
    assert first.keyframe
    assert first.keyframes == 1
    assert first.inliers == first.map_points > 60
    assert not lost.keyframe
    assert lost.inliers == 0
    assert lost.keyframes == results[-2].keyframes


def test_same_seed_same_bits_and_reset_forgets(room):
    frames = [room.see(pose, i) for i, pose in enumerate(room.path(50))]
    frames[20:25] = [room.blind(i) for i in range(20, 25)]  # relocalisation draws random samples
    backend = make_backend(room, seed=5)
    first = track_all(backend, frames)
    final = backend.finalize().T_world_cam
    backend.reset(room.camera, 5)
    for a, b in zip(first, track_all(backend, frames), strict=True):
        assert a.state == b.state
        assert all(getattr(a, name) == getattr(b, name) for name in COUNTS)
        assert np.array_equal(a.T_world_cam, b.T_world_cam)
    assert np.array_equal(final, backend.finalize().T_world_cam)


@pytest.mark.slow
def test_full_bundle_adjustment_is_undone_when_the_run_goes_on(room):
    """`finalize` gives the same when asked twice, and a run that goes on is what it would have been."""
    asked, quiet = (make_backend(room, bundle_adjustment__full=True) for _ in range(2))
    for index, pose in enumerate(room.path(60)):
        (views, (_, points)) = asked.view()
        (others, (_, same)) = quiet.view()
        assert np.array_equal(points, same)
        for one, other in zip(views, others, strict=True):
            assert np.array_equal(one.T_world_cam, other.T_world_cam)
        frame = room.see(pose, index)
        (one,) = track_all(asked, [frame])
        (other,) = track_all(quiet, [frame])
        assert one.state == other.state
        assert np.array_equal(one.T_world_cam, other.T_world_cam)
        if index in (30, 45):
            before = asked.outputs().positions
            first = asked.finalize()
            second = asked.finalize()
            assert np.array_equal(first.T_world_cam, second.T_world_cam)
            assert not np.array_equal(before, asked.outputs().positions)
    assert np.array_equal(asked.finalize().T_world_cam, quiet.finalize().T_world_cam)


def test_dynamic_features_enter_neither_tracking_nor_map(room):
    truth = room.path(40)
    frames = []
    keeps = []
    for i, pose in enumerate(truth):
        frame = room.see(pose, i)
        moving = frame.keypoints.xy[:, 0] < 250
        frame.xy[moving] += (5.0 * i, 0.0)
        frame.keypoints.xy[moving] += (5.0 * i, 0.0)
        frames.append(frame)
        keeps.append(~moving)
    backend = make_backend(room)
    assert errors(track_all(backend, frames, keeps), truth).max() < 0.025
    for record, view in zip(backend.outputs().keyframes[::-1], backend.view()[0], strict=True):
        assert len(view.keypoints) == np.count_nonzero(keeps[record.frame])


def test_weights_scale_the_information_of_a_feature(room):
    truth = room.path(20)
    backend = make_backend(room)
    for i, pose in enumerate(truth):
        frame = room.see(pose, i)
        weight = np.ones(len(frame), np.float32)
        shifted = np.arange(len(frame)) % 2 == 0
        if i > 3:
            frame.xy[shifted] += (6.0, 0.0)
            weight[shifted] = 0.0
        result = backend.track(frame, np.ones(len(frame), bool), weight)
    step = se3.inverse(truth[0]) @ truth[-1]
    assert result.state == "ok"
    assert np.linalg.norm((se3.inverse(step) @ result.T_world_cam)[:3, 3]) < 0.015


def test_a_covered_lens_is_lost_exactly_as_long_as_it_is_covered(room):
    truth = room.path(80)
    frames = [room.see(pose, i) for i, pose in enumerate(truth)]
    frames[40:60] = [room.blind(i) for i in range(40, 60)]
    backend = make_backend(room)
    results = track_all(backend, frames)
    assert states(results) == ["ok"] * 40 + ["lost"] * 20 + ["ok"] * 20
    assert errors(results, truth).max() < 0.02
    assert results[60].relocalised or results[60].inliers > 50
    assert all(se3.is_pose(r.T_world_cam) for r in results[40:60])  # a prediction, marked as lost
    assert np.allclose(
        backend.finalize().timestamps, [i / 30 for i in range(80) if not 40 <= i < 60]
    )


def rotation_alone(room):
    t = np.arange(60) / 30.0
    return se3.exp(
        np.stack([0 * t, 0 * t, 0 * t, 0.2 * np.sin(2 * t), 0.9 * np.sin(1.5 * t), 0 * t], axis=1)
    )


@pytest.mark.slow
def test_a_camera_that_rotates_alone_is_tracked(room):
    truth = rotation_alone(room)
    results = track_all(make_backend(room), [room.see(pose, i) for i, pose in enumerate(truth)])
    limit_m = 0.02
    assert errors(results, truth).max() < limit_m
    assert states(results) == ["ok"] * len(truth)


@pytest.mark.slow
def test_frames_most_of_whose_features_fit_nothing_are_tracked(room):
    truth = room.path(40)
    # 500 of 700 fit nothing
    frames = [room.see(pose, i, wrong=500) for i, pose in enumerate(truth)]
    limit_m = 0.03
    assert errors(track_all(make_backend(room), frames), truth).max() < limit_m


def test_features_without_depth_become_points_by_triangulation(room):
    truth = room.path(60)
    frames = [room.see(pose, i, depthless=0.0 if i == 0 else 0.75) for i, pose in enumerate(truth)]
    with_it, without = (
        make_backend(room, mapping__triangulate_below=share) for share in (1.0, 0.0)
    )
    results = track_all(with_it, frames)
    track_all(without, frames)
    assert errors(results, truth).max() < 0.02
    (_, (_, local)) = with_it.view()
    (_, (ids, _)) = without.view()
    assert len(local) > len(ids)
    # every point lies on a wall of the room: z = 2.5, |x| = 3 or |y| = 2 in the world of the first
    # camera
    wall = np.minimum.reduce(
        [abs(local[:, 2] - 2.5), abs(abs(local[:, 0]) - 3), abs(abs(local[:, 1]) - 2)]
    )
    assert np.median(wall) < 0.02
    assert np.quantile(wall, 0.9) < 0.08


def test_hostile_numbers_in_the_frame(room):
    truth = room.path(20)
    frames = [room.see(pose, i) for i, pose in enumerate(truth)]
    for frame in frames[5:]:
        frame.z[::7] = np.nan
        frame.z[1::7] = -1.0
        frame.z[2::7] = np.inf
        frame.xy[3::11] = np.nan
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        results = track_all(make_backend(room), frames)
    assert states(results) == ["ok"] * 20
    assert errors(results, truth).max() < 0.02


def test_depth_is_needed_to_initialise_but_not_to_track(room):
    truth = room.path(30)
    frames = [room.see(p, i, depthless=1.1 if 10 <= i < 20 else 0.1) for i, p in enumerate(truth)]
    results = track_all(make_backend(room), frames)
    assert states(results) == ["ok"] * 30
    assert errors(results, truth).max() < 0.02
    never = track_all(
        make_backend(room), [room.see(p, i, depthless=1.1) for i, p in enumerate(room.path(5))]
    )
    assert [(r.state, r.T_world_cam) for r in never] == [("initialising", None)] * 5


def test_the_prediction_is_the_motion_models_at_the_time_of_the_frame(room):
    """Intervals of one, two and four thirtieths in turn, as when frames are dropped."""
    steps = np.cumsum([0, *([1, 2, 4] * 10)])
    path = room.path(int(steps[-1]) + 1)
    backend = make_backend(room)
    ahead = []
    stay = []
    assert backend.predict_T_world_cam(0.0) == (None, None)
    start = np.eye(4)
    for number, step in enumerate(steps):
        stamp = step / 30.0
        before = steps[number - 1] / 30.0
        if number > 6:
            truth = start @ path[step]
            previous = before - steps[number - 2] / 30.0
            ahead.append(
                np.linalg.norm((se3.inverse(truth) @ backend.predict_T_world_cam(stamp)[0])[:3, 3])
            )
            stay.append(
                np.linalg.norm(
                    (se3.inverse(truth) @ backend.predict_T_world_cam(before + previous)[0])[:3, 3]
                )
            )
            shorter = backend.predict_T_world_cam(stamp)[1]
            longer = backend.predict_T_world_cam(stamp + 1 / 30)[1]
            assert np.trace(shorter) < np.trace(longer)
        (result,) = track_all(backend, [room.see(path[step], number, stamp=stamp)])
        if number == 0:
            start = result.T_world_cam @ se3.inverse(path[0])
    assert np.mean(ahead) < 0.5 * np.mean(stay)
    pose, covariance = backend.predict_T_world_cam(steps[-1] / 30.0 + MAX_GAP_S + 1e-6)
    assert covariance is None
    np.testing.assert_allclose(pose, result.T_world_cam, atol=1e-12)


@pytest.mark.slow
def test_the_number_of_keyframes_is_bounded_and_those_around_the_camera_stay(room):
    """They overlap most: when they were culled first, the local error grew tenfold on long paths."""
    most = 16
    truth = room.path(240)
    backend = make_backend(
        room, keyframes__maximum=most, keyframes__tracked_share=1.0, keyframes__redundant_share=1.0
    )
    made = []
    results = []
    for index, pose in enumerate(truth):
        results += track_all(backend, [room.see(pose, index)])
        made += [index] if results[-1].keyframe else []
        kept = backend.map.kf_frame[backend.map.keyframes].tolist()
        assert len(kept) == min(len(made), most)
        assert kept[-4:] == made[-4:]
        assert kept[0] == 0
    assert len(made) > 2 * most
    assert len(backend.finalize()) == 240
    assert errors(results, truth).max() < 0.03


def test_of_frames_with_one_stamp_the_first_is_in_the_final_trajectory(room):
    frames = [room.see(pose, i, stamp=min(i, 5) / 30.0) for i, pose in enumerate(room.path(10))]
    backend = make_backend(room, motion__smooth=False)
    results = track_all(backend, frames)
    final = backend.finalize()
    assert states(results) == ["ok"] * 10
    assert len(final) == 6
    assert (
        np.argmin([np.linalg.norm(final.positions[-1] - r.T_world_cam[:3, 3]) for r in results])
        == 5
    )


def resting(room):
    """A camera at rest before many new features in every frame: only the gap asks for a keyframe."""
    return [room.see(np.eye(4), index, limit=900, wrong=110) for index in range(14)]


def fading(room):
    """A camera at rest that tracks fewer of the same points in every frame."""
    return [room.see(np.eye(4), index, limit=300 - 10 * index) for index in range(14)]


def strolling(room):
    return [room.see(pose, index, limit=300) for index, pose in enumerate(room.path(40))]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "ends", "frames", "others"),
    [
        ("keyframes__max_gap", (10, 90), resting, {}),
        ("keyframes__tracked_share", (0.4, 0.95), fading, {}),
        ("bundle_adjustment__window", (2, 20), strolling, {"keyframes__tracked_share": 0.95}),
        ("keyframes__redundant_share", (0.7, 1.0), strolling, {"keyframes__tracked_share": 0.95}),
    ],
)
def test_both_ends_of_a_range_give_other_results(room, name, ends, frames, others):
    """Settings that short episodes do not show."""
    results = [track_all(make_backend(room, **others, **{name: end}), frames(room)) for end in ends]
    one, other = (
        [(r.state, r.keyframe, np.nan_to_num(r.T_world_cam).tobytes()) for r in run]
        for run in results
    )
    assert one != other


@pytest.mark.parametrize("monocular", [False, True])
def test_a_frame_becomes_a_keyframe_exactly_when_it_is_told_to(room, monocular):
    wanted = np.random.default_rng(4).random(60) < 0.3
    backend = make_backend(room, monocular=monocular)
    results = []
    for index, pose in enumerate(room.path(60)):
        schedule = "every" if wanted[index] else "none"
        backend.configure(apply_overrides(backend.settings, {"keyframes.schedule": schedule}))
        begins = backend.map.keyframe_count == 0
        frame = room.see(pose, index)
        results += track_all(backend, [without_depth(frame) if monocular else frame])
        assert results[-1].keyframe == (results[-1].state == "ok" and (begins or wanted[index]))
    assert states(results).count("ok") > 40


@pytest.mark.slow
def test_without_further_keyframes_the_camera_is_lost_where_the_map_ends_and_found_where_it_returns(
    room,
):
    turn = 1.5 * np.sin(np.pi * np.arange(120) / 119)  # away and back, radians about y
    frames = [
        room.see(pose, index)
        for index, pose in enumerate(se3.exp(turn[:, None] * [0, 0, 0, 0, 1, 0]))
    ]
    none, every = (
        track_all(make_backend(room, keyframes__schedule=when), frames)
        for when in ("none", "every")
    )
    seen = states(none)
    assert seen[:10] == seen[-10:] == ["ok"] * 10
    assert "lost" in seen
    assert none[-1].keyframes == 1
    assert states(every) == ["ok"] * 120
    assert all(result.keyframe for result in every)


def test_filters_see_the_newest_keyframes_and_all_points(room, monkeypatch):
    monkeypatch.setattr(slam_map, "VIEWS", 10)
    backend = make_backend(room, keyframes__tracked_share=1.0, keyframes__redundant_share=1.0)
    track_all(backend, [replace(room.see(p, i), depth=np.ones((480, 640), np.float32))
                        for i, p in enumerate(room.path(40))])  # fmt: skip
    (views, (ids, positions)) = backend.view()
    outputs = backend.outputs()
    assert len(set(ids.tolist())) == len(positions) > 0
    assert np.array_equal(outputs.ids, ids)
    assert len(outputs.keyframes) > 10, "more than are shown"
    assert [view.depth is not None for view in views] == [True] * 8 + [False] * 2
    for record, view in zip(outputs.keyframes[::-1], views, strict=False):
        assert np.array_equal(view.T_world_cam, record.T_world_cam)
        assert view.xy.shape == (len(view.keypoints), 2)
        assert len(view.keypoints) == record.features


# Rolling-shutter compensation: features moved to the middle row's time, by the motion between
# poses.


READOUT_S = 0.026


def shaken(t):
    """Camera-to-world pose of a hand that turns by up to 2 rad/s and walks by up to 0.6 m/s."""
    swing = [0.15 * np.sin(4 * t), 0.1 * np.sin(5 * t), 0.05 * np.sin(3 * t)]
    return se3.exp(
        np.array(
            [*swing, 0.2 * np.sin(6 * t + 1), 0.35 * np.sin(5 * t + 0.5), 0.15 * np.sin(4 * t)]
        )
    )


def rolling(room, pose_at, index, **how):
    """The frame at index / 30 s whose rows are seen from the poses at their own times, and the one seen at once."""
    exact = {"noise_px": 0.0, "depth_noise": 0.0, "depthless": 0.0, "limit": 10**6} | how
    at_once = room.see(pose_at(index / 30), index, **exact)
    camera = room.camera
    observations = se3.transform(pose_at(index / 30), camera.unproject(at_once.xy, at_once.z))
    xy = at_once.xy.copy()
    z = at_once.z.copy()
    for row in range(len(observations)):
        for _ in range(4):  # the row that a point is seen by depends on where that row sees it
            late = ((xy[row, 1] + 0.5) / camera.height - 0.5) * READOUT_S
            local = se3.transform(se3.inverse(pose_at(index / 30 + late)), observations[row])
            xy[row], z[row] = camera.project(local), local[2]
    inside = (xy[:, 1] > 0) & (xy[:, 1] < camera.height - 1)
    keypoints = replace(at_once.keypoints, xy=xy.astype(np.float32))
    moved = replace(
        at_once, keypoints=keypoints.select(np.flatnonzero(inside)), xy=xy[inside], z=z[inside]
    )
    kept = replace(at_once, keypoints=at_once.keypoints.select(np.flatnonzero(inside)), xy=at_once.xy[inside],
                   z=at_once.z[inside])  # fmt: skip
    return moved, kept


def rolling_backend(room, frames, readout_s, **overrides):
    backend = make_backend(room, **overrides)
    backend.reset(replace(room.camera, readout_s=readout_s), 0)
    return backend, track_all(backend, frames)


def largest_error(results, frames, pose_at):
    return errors(results, [pose_at(frame.index / 30) for frame in frames]).max()


@pytest.fixture(scope="module")
def shaken_frames():
    room = PointWorld(count=1200)
    return room, [
        rolling(room, shaken, index, depthless=0.0, limit=500)[0] for index in range(3, 30)
    ]


@pytest.mark.parametrize("has_depth", [True, False])
def test_a_constant_motion_is_undone_to_a_tenth_of_a_pixel(room, has_depth):
    """Without depth the rotation alone."""

    def moving(t):
        return se3.inverse(
            se3.exp(t * np.array([*((0.3, -0.4, 0.1) if has_depth else (0, 0, 0)), 0.5, 1.9, -0.6]))
        )

    measured, at_once = rolling(room, moving, 6)
    measured = measured if has_depth else without_depth(measured)
    camera = replace(room.camera, readout_s=READOUT_S)
    velocity = CameraVelocity.between(*(se3.inverse(moving(t)) for t in (0.15, 0.2)), 0.05)
    observations = compensate_rolling_shutter(observed(measured, camera), camera, velocity)
    assert np.percentile(np.linalg.norm(measured.xy - at_once.xy, axis=1), 90) > 5
    assert np.linalg.norm(observations.xy - at_once.xy, axis=1).max() < 0.1
    if has_depth:
        np.testing.assert_allclose(observations.z, at_once.z, rtol=2e-3)
        np.testing.assert_allclose(
            observations.right,
            observations.xy[:, 0] - camera.fx * camera.baseline_m / observations.z,
            rtol=1e-12,
        )
    else:
        assert not observations.z.any()
        assert np.isnan(observations.right).all()


def test_a_feature_that_a_motion_would_put_behind_the_camera_stays(room):
    frame = room.see(np.eye(4), 0)
    camera = replace(room.camera, readout_s=READOUT_S)
    observations = observed(frame, camera)
    wild = compensate_rolling_shutter(
        observations, camera, CameraVelocity(np.array([0.0, 0.0, 400.0]), np.zeros(3))
    )
    behind = (frame.keypoints.xy[:, 1] > 420) & (observations.z > 0) & (observations.z < 3)
    assert behind.any()
    assert np.isfinite(wild.xy).all()
    np.testing.assert_array_equal(wild.xy[behind], observations.xy[behind])
    np.testing.assert_array_equal(wild.z[behind], observations.z[behind])
    ahead = CameraVelocity(np.ones(3), np.ones(3))
    assert len(compensate_rolling_shutter(observed(room.blind(1), camera), camera, ahead)) == 0


@pytest.mark.slow
@pytest.mark.parametrize(("stamp_noise_s", "factor"), [(0.0, 0.4), (0.003, 0.5)])
def test_a_shaken_camera_is_tracked_several_times_as_well(shaken_frames, stamp_noise_s, factor):
    room, frames = shaken_frames
    rng = np.random.default_rng(0)
    noisy = [
        replace(f, timestamp=f.timestamp + rng.uniform(-stamp_noise_s, stamp_noise_s))
        for f in frames
    ]
    without, compensated = (
        largest_error(rolling_backend(room, noisy, readout_s)[1], noisy, shaken)
        for readout_s in (0.0, READOUT_S)
    )
    assert compensated < factor * without


def test_the_first_frame_is_compensated_too(shaken_frames):
    room, frames = shaken_frames
    backend, results = rolling_backend(room, frames[:2], READOUT_S)
    slam_map = backend.map
    assert states(results) == ["ok", "ok"]
    assert slam_map.kf_id[0] == 0
    assert results[1].timings["mapping"] > 0, "the first keyframe was inserted again"
    _, at_once = rolling(room, shaken, 3, depthless=0.0, limit=500)
    left = np.linalg.norm(slam_map.kf_xy[0, : slam_map.kf_count[0]] - at_once.xy, axis=1)
    assert np.median(left) < 0.4 * np.median(np.linalg.norm(frames[0].xy - at_once.xy, axis=1))


def shifted(frames, seconds, rows):
    return [
        replace(f, timestamp=f.timestamp + (seconds if i in rows else 0))
        for i, f in enumerate(frames)
    ]


@pytest.mark.parametrize(
    ("sequence", "readout_s", "lost"),
    [
        # nothing tells the motion of the first frame
        (lambda room, f: [f[0], room.blind(4), *f[2:6]], READOUT_S, {1}),
        # nor after a long gap
        (lambda room, f: shifted(f[:5], 5.0, range(1, 5)), READOUT_S, set()),
        # stamps that nearly coincide
        (lambda room, f: shifted(f[:12], -0.0333, (1, 6)), READOUT_S, set()),
        (lambda room, f: shifted(f[:9], -0.0313, (6,)), 0.0, set()),
    ],
)
def test_odd_stamps_and_gaps(shaken_frames, sequence, readout_s, lost):
    room, frames = shaken_frames
    frames = sequence(room, frames)
    with np.errstate(all="raise"):
        backend, results = rolling_backend(room, frames, readout_s)
    assert {i for i, r in enumerate(results) if r.state != "ok"} == lost
    assert backend.map.kf_frame[0] == frames[0].index
    assert len(backend.finalize()) == len(frames) - len(lost)
    assert readout_s or backend.shutter.velocity is None


@pytest.mark.slow
@pytest.mark.parametrize("after", [[0, 0, 0, 0, 0.3, 0], [0.5, 0, 0, 0, 0, 0]])
def test_a_cut_is_no_motion(shaken_frames, after):
    """From one frame to the next the camera is elsewhere."""
    room, frames = shaken_frames

    def cut(t):
        return shaken(t) @ (se3.exp(np.array(after, float)) if t > 14.5 / 30 else np.eye(4))

    frames = [
        *frames[:12],
        *(rolling(room, cut, index, depthless=0.0, limit=500)[0] for index in range(15, 20)),
    ]
    off, on = (
        rolling_backend(room, frames, READOUT_S, tracking__rolling_shutter=use)[1]
        for use in (False, True)
    )
    assert states(on) == states(off) == ["ok"] * len(frames)
    assert largest_error(on, frames, cut) < 0.8 * largest_error(off, frames, cut)


def test_the_velocity_is_forgotten_after_a_loss(shaken_frames):
    room, frames = shaken_frames
    backend, _ = rolling_backend(room, frames[:8], READOUT_S)
    assert backend.shutter.velocity is not None
    track_all(backend, [room.blind(11)])
    assert backend.shutter.velocity is None
    assert states(track_all(backend, [frames[9]])) == ["ok"]
    assert backend.shutter.velocity is None
