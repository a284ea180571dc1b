"""A rolling shutter: features moved to the middle row's time, by the motion that the poses tell."""

from dataclasses import replace

import numpy as np
import pytest

from dynslam_bench.core.settings import apply_overrides
from dynslam_bench.geometry import se3
from dynslam_bench.slam.backend import RgbdBackend
from dynslam_bench.slam.observation import observe
from dynslam_bench.slam.rolling_shutter import CameraVelocity, compensate_rolling_shutter
from dynslam_bench.slam.settings import BackendSettings, TrackingSettings

READOUT_S = 0.026


def shaken(t):
    """Camera-to-world pose of a hand that turns by up to 2 rad/s and walks by up to 0.6 m/s."""
    swing = [0.15 * np.sin(4 * t), 0.1 * np.sin(5 * t), 0.05 * np.sin(3 * t)]
    return se3.exp(np.array([*swing, 0.2 * np.sin(6 * t + 1), 0.35 * np.sin(5 * t + 0.5), 0.15 * np.sin(4 * t)]))


def steady(t):
    """A constant twist: half a metre and 2 rad a second."""
    return se3.inverse(se3.exp(t * np.array([0.3, -0.4, 0.1, 0.5, 1.9, -0.6])))


def rolling(room, pose_at, index, **how):
    """The frame at index / 30 s whose rows are seen from the poses at their own times, and the one seen at once."""
    exact = {"noise_px": 0.0, "depth_noise": 0.0, "depthless": 0.0, "limit": 10**6} | how
    at_once = room.see(pose_at(index / 30), index, **exact)
    camera = room.camera
    seen = se3.transform(pose_at(index / 30), camera.unproject(at_once.xy, at_once.z))
    xy, z = at_once.xy.copy(), at_once.z.copy()
    for row in range(len(seen)):
        for _ in range(4):  # the row that a point is seen by depends on where that row sees it
            late = ((xy[row, 1] + 0.5) / camera.height - 0.5) * READOUT_S
            local = se3.transform(se3.inverse(pose_at(index / 30 + late)), seen[row])
            xy[row], z[row] = camera.project(local), local[2]
    inside = (xy[:, 1] > 0) & (xy[:, 1] < camera.height - 1)
    keypoints = replace(at_once.keypoints, xy=xy.astype(np.float32))
    moved = replace(at_once, keypoints=keypoints.select(np.flatnonzero(inside)), xy=xy[inside], z=z[inside])
    kept = replace(at_once, keypoints=at_once.keypoints.select(np.flatnonzero(inside)), xy=at_once.xy[inside],
                   z=at_once.z[inside])  # fmt: skip
    return moved, kept


def observed(frame, camera, *, deep=True):
    all_of_them = np.ones(len(frame), bool), np.ones(len(frame), np.float32)
    frame = frame if deep else replace(frame, z=np.zeros_like(frame.z))
    return observe(frame, *all_of_them, camera, np.ones(8), TrackingSettings())


def drive(room, pose_at, frames, readout_s, **overrides):
    """Largest error of the poses in metres, over all that are `ok`, and the back end."""
    names = {name.replace("__", "."): value for name, value in overrides.items()}
    backend = RgbdBackend(apply_overrides(BackendSettings(), names))
    backend.reset(replace(room.camera, readout_s=readout_s), 0)
    found = [backend.track(frame, np.ones(len(frame), bool), np.ones(len(frame), np.float32)) for frame in frames]
    truth = [pose_at(frame.index / 30) for frame in frames]
    pairs = [(r.T_world_cam, t) for r, t in zip(found, truth, strict=True) if r.state == "ok"]
    start = pairs[0][0] @ se3.inverse(pairs[0][1])
    return max(np.linalg.norm((se3.inverse(start @ t) @ p)[:3, 3]) for p, t in pairs), found, backend


@pytest.fixture(scope="module")
def shaken_frames():
    from point_world import PointWorld

    room = PointWorld(count=1200)
    return room, [rolling(room, shaken, index, depthless=0.0, limit=500)[0] for index in range(3, 30)]


def test_a_constant_motion_is_undone_to_a_tenth_of_a_pixel(room):
    moved, at_once = rolling(room, steady, 6)
    camera = replace(room.camera, readout_s=READOUT_S)
    speeds = CameraVelocity.between(*(se3.inverse(steady(t)) for t in (0.15, 0.2)), 0.05)
    straight = compensate_rolling_shutter(observed(moved, camera), camera, speeds)
    off = np.linalg.norm(moved.xy - at_once.xy, axis=1)
    left = np.linalg.norm(straight.xy - at_once.xy, axis=1)
    assert np.percentile(off, 90) > 5 and left.max() < 0.1
    np.testing.assert_allclose(straight.z, at_once.z, rtol=2e-3)
    np.testing.assert_allclose(
        straight.right, straight.xy[:, 0] - camera.fx * camera.baseline_m / straight.z, rtol=1e-12
    )


def test_without_depth_the_turning_is_undone(room):
    def turning(t):
        return se3.inverse(se3.exp(t * np.array([0, 0, 0, 0.5, 1.9, -0.6])))

    moved, at_once = rolling(room, turning, 6)
    camera = replace(room.camera, readout_s=READOUT_S)
    speeds = CameraVelocity.between(*(se3.inverse(turning(t)) for t in (0.15, 0.2)), 0.05)
    straight = compensate_rolling_shutter(observed(moved, camera, deep=False), camera, speeds)
    assert np.linalg.norm(straight.xy - at_once.xy, axis=1).max() < 0.1
    assert not straight.z.any() and np.isnan(straight.right).all()


def test_speeds_are_those_that_move_the_points():
    before, now = (se3.inverse(steady(t)) for t in (0.2, 0.2 + 1e-4))
    speeds = CameraVelocity.between(before, now, 1e-4)
    point = np.array([0.3, -0.2, 2.0])
    change = (se3.transform(now, point) - se3.transform(before, point)) / 1e-4
    local = se3.transform(now, point)
    np.testing.assert_allclose(change, np.cross(speeds.turning, local) + speeds.velocity, atol=1e-2)


def test_a_shaken_camera_is_followed_several_times_as_well(shaken_frames):
    room, frames = shaken_frames
    without, _, _ = drive(room, shaken, frames, 0.0)
    with_it, _, _ = drive(room, shaken, frames, READOUT_S)
    assert with_it < 0.4 * without, (with_it, without)


def test_stamps_that_are_off_by_milliseconds_do_no_harm(shaken_frames):
    room, frames = shaken_frames
    rng = np.random.default_rng(0)
    late = [replace(frame, timestamp=frame.timestamp + rng.uniform(-0.003, 0.003)) for frame in frames]
    without, _, _ = drive(room, shaken, late, 0.0)
    with_it, _, _ = drive(room, shaken, late, READOUT_S)
    assert with_it < 0.5 * without, (with_it, without)


def test_the_first_frame_is_straightened_too(shaken_frames):
    room, frames = shaken_frames
    _, found, backend = drive(room, shaken, frames[:2], READOUT_S)
    world = backend.world
    assert [each.state for each in found] == ["ok", "ok"] and world.kf_id[0] == 0
    count = int(world.kf_count[0])
    _, at_once = rolling(room, shaken, 3, depthless=0.0, limit=500)
    left = np.linalg.norm(world.kf_xy[0, :count] - at_once.xy, axis=1)
    off = np.linalg.norm(frames[0].xy - at_once.xy, axis=1)
    assert np.median(left) < 0.4 * np.median(off)


def test_a_second_frame_that_shows_nothing_leaves_the_first_map_alone(shaken_frames):
    room, frames = shaken_frames
    story = [frames[0], room.blind(4), *frames[2:6]]
    _, found, backend = drive(room, shaken, story, READOUT_S)
    assert [each.state for each in found][:2] == ["ok", "lost"] and found[-1].state == "ok"
    assert backend.world.kf_frame[0] == frames[0].index


def test_after_a_long_gap_the_first_map_stays_as_it_was_begun(shaken_frames):
    room, frames = shaken_frames
    later = [frames[0], *(replace(frame, timestamp=frame.timestamp + 5) for frame in frames[1:5])]
    _, found, backend = drive(room, shaken, later, READOUT_S)
    assert [each.state for each in found] == ["ok"] * 5 and len(backend.finalize()) == 5


def test_stamps_that_nearly_coincide_tell_no_breakneck_motion(shaken_frames):
    room, frames = shaken_frames
    story = [
        replace(frame, timestamp=frame.timestamp - (0.0333 if i in (1, 6) else 0)) for i, frame in enumerate(frames)
    ]
    _, found, _ = drive(room, shaken, story[:12], READOUT_S)
    assert [each.state for each in found] == ["ok"] * 12


def test_off_and_a_global_shutter_are_the_same_to_the_last_bit(shaken_frames):
    room, frames = shaken_frames
    _, plain, _ = drive(room, shaken, frames[:8], 0.0)
    _, off, _ = drive(room, shaken, frames[:8], READOUT_S, tracking__rolling_shutter=False)
    for a, b in zip(plain, off, strict=True):
        np.testing.assert_array_equal(a.T_world_cam, b.T_world_cam)


@pytest.mark.parametrize(
    "after", [[0, 0, 0, 0, 0.3, 0], [0, 0, 0, 0, 0.5, 0], [0.3, 0, 0, 0, 0, 0], [0.5, 0, 0, 0, 0, 0]]
)
def test_a_cut_is_no_motion(shaken_frames, after):
    """From one frame to the next the camera is elsewhere: what holds without the rolling shutter holds with it."""
    room, frames = shaken_frames

    def cut(t):
        return shaken(t) @ (se3.exp(np.array(after, float)) if t > 14.5 / 30 else np.eye(4))

    story = [*frames[:12], *(rolling(room, cut, index, depthless=0.0, limit=500)[0] for index in range(15, 20))]
    off, found_off, _ = drive(room, cut, story, READOUT_S, tracking__rolling_shutter=False)
    on, found, _ = drive(room, cut, story, READOUT_S)
    assert [each.state for each in found] == [each.state for each in found_off] == ["ok"] * len(story)
    assert on < 0.8 * off, (on, off)


def test_nothing_is_told_of_the_time_before_a_loss(shaken_frames):
    room, frames = shaken_frames
    backend = drive(room, shaken, frames[:8], READOUT_S)[2]
    assert backend.motion.last_speeds is not None
    backend.track(room.blind(11), np.zeros(0, bool), np.zeros(0, np.float32))
    assert backend.motion.last_speeds is None
    found = backend.track(frames[9], np.ones(len(frames[9]), bool), np.ones(len(frames[9]), np.float32))
    assert found.state == "ok" and backend.motion.last_speeds is None


def test_global_shutters_ask_for_no_speeds_however_frames_are_stamped(shaken_frames):
    room, frames = shaken_frames
    close = [
        replace(frame, timestamp=frame.timestamp - (0.0313 if i == 6 else 0)) for i, frame in enumerate(frames[:9])
    ]
    with np.errstate(all="raise"):
        _, found, backend = drive(room, shaken, close, 0.0)
    assert [each.state for each in found] == ["ok"] * 9 and backend.motion.last_speeds is None


def test_a_feature_that_a_motion_would_put_behind_the_camera_stays(room):
    frame = room.see(np.eye(4), 0)
    camera = replace(room.camera, readout_s=READOUT_S)
    seen = observed(frame, camera)
    wild = compensate_rolling_shutter(seen, camera, CameraVelocity(np.array([0.0, 0.0, 400.0]), np.zeros(3)))
    gone = (frame.keypoints.xy[:, 1] > 420) & (seen.z > 0) & (seen.z < 3)
    assert gone.any() and np.isfinite(wild.xy).all()
    np.testing.assert_array_equal(wild.xy[gone], seen.xy[gone])
    np.testing.assert_array_equal(wild.z[gone], seen.z[gone])
    blind = observed(room.blind(1), camera)
    assert len(compensate_rolling_shutter(blind, camera, CameraVelocity(np.ones(3), np.ones(3)))) == 0
