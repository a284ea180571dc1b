"""Rolling-shutter compensation: features moved to the middle row's time, by the motion between poses."""

from dataclasses import replace

import numpy as np
import pytest
from point_world import PointWorld, errors, make_backend, observed, states, track_all, without_depth

from dynslam_bench.geometry import se3
from dynslam_bench.slam.rolling_shutter import CameraVelocity, compensate_rolling_shutter

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
    observations = se3.transform(pose_at(index / 30), camera.unproject(at_once.xy, at_once.z))
    xy, z = at_once.xy.copy(), at_once.z.copy()
    for row in range(len(observations)):
        for _ in range(4):  # the row that a point is seen by depends on where that row sees it
            late = ((xy[row, 1] + 0.5) / camera.height - 0.5) * READOUT_S
            local = se3.transform(se3.inverse(pose_at(index / 30 + late)), observations[row])
            xy[row], z[row] = camera.project(local), local[2]
    inside = (xy[:, 1] > 0) & (xy[:, 1] < camera.height - 1)
    keypoints = replace(at_once.keypoints, xy=xy.astype(np.float32))
    moved = replace(at_once, keypoints=keypoints.select(np.flatnonzero(inside)), xy=xy[inside], z=z[inside])
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
    return room, [rolling(room, shaken, index, depthless=0.0, limit=500)[0] for index in range(3, 30)]


@pytest.mark.parametrize("has_depth", [True, False])
def test_a_constant_motion_is_undone_to_a_tenth_of_a_pixel(room, has_depth):
    """Without depth the rotation alone."""

    def moving(t):
        return se3.inverse(se3.exp(t * np.array([*((0.3, -0.4, 0.1) if has_depth else (0, 0, 0)), 0.5, 1.9, -0.6])))

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
            observations.right, observations.xy[:, 0] - camera.fx * camera.baseline_m / observations.z, rtol=1e-12
        )
    else:
        assert not observations.z.any() and np.isnan(observations.right).all()


def test_a_feature_that_a_motion_would_put_behind_the_camera_stays(room):
    frame, camera = room.see(np.eye(4), 0), replace(room.camera, readout_s=READOUT_S)
    observations = observed(frame, camera)
    wild = compensate_rolling_shutter(observations, camera, CameraVelocity(np.array([0.0, 0.0, 400.0]), np.zeros(3)))
    behind = (frame.keypoints.xy[:, 1] > 420) & (observations.z > 0) & (observations.z < 3)
    assert behind.any() and np.isfinite(wild.xy).all()
    np.testing.assert_array_equal(wild.xy[behind], observations.xy[behind])
    np.testing.assert_array_equal(wild.z[behind], observations.z[behind])
    blind = observed(room.blind(1), camera)
    assert len(compensate_rolling_shutter(blind, camera, CameraVelocity(np.ones(3), np.ones(3)))) == 0


@pytest.mark.parametrize(("stamp_noise_s", "factor"), [(0.0, 0.4), (0.003, 0.5)])
def test_a_shaken_camera_is_tracked_several_times_as_well(shaken_frames, stamp_noise_s, factor):
    room, frames = shaken_frames
    rng = np.random.default_rng(0)
    noisy = [replace(f, timestamp=f.timestamp + rng.uniform(-stamp_noise_s, stamp_noise_s)) for f in frames]
    without, compensated = (
        largest_error(rolling_backend(room, noisy, readout_s)[1], noisy, shaken) for readout_s in (0.0, READOUT_S)
    )
    assert compensated < factor * without


def test_the_first_frame_is_compensated_too(shaken_frames):
    room, frames = shaken_frames
    backend, results = rolling_backend(room, frames[:2], READOUT_S)
    world = backend.world
    assert states(results) == ["ok", "ok"] and world.kf_id[0] == 0
    _, at_once = rolling(room, shaken, 3, depthless=0.0, limit=500)
    left = np.linalg.norm(world.kf_xy[0, : world.kf_count[0]] - at_once.xy, axis=1)
    assert np.median(left) < 0.4 * np.median(np.linalg.norm(frames[0].xy - at_once.xy, axis=1))


def shifted(frames, seconds, rows):
    return [replace(f, timestamp=f.timestamp + (seconds if i in rows else 0)) for i, f in enumerate(frames)]


@pytest.mark.parametrize(
    ("sequence", "readout_s", "lost"),
    [
        (lambda room, f: [f[0], room.blind(4), *f[2:6]], READOUT_S, {1}),  # nothing tells the motion of the first frame
        (lambda room, f: shifted(f[:5], 5.0, range(1, 5)), READOUT_S, set()),  # nor after a long gap
        (lambda room, f: shifted(f[:12], -0.0333, (1, 6)), READOUT_S, set()),  # stamps that nearly coincide
        (lambda room, f: shifted(f[:9], -0.0313, (6,)), 0.0, set()),
    ],
)
def test_odd_stamps_and_gaps(shaken_frames, sequence, readout_s, lost):
    room, frames = shaken_frames
    frames = sequence(room, frames)
    with np.errstate(all="raise"):
        backend, results = rolling_backend(room, frames, readout_s)
    assert {i for i, r in enumerate(results) if r.state != "ok"} == lost
    assert backend.world.kf_frame[0] == frames[0].index and len(backend.finalize()) == len(frames) - len(lost)
    assert readout_s or backend.shutter.velocity is None


@pytest.mark.parametrize(
    "after", [[0, 0, 0, 0, 0.3, 0], [0, 0, 0, 0, 0.5, 0], [0.3, 0, 0, 0, 0, 0], [0.5, 0, 0, 0, 0, 0]]
)
def test_a_cut_is_no_motion(shaken_frames, after):
    """From one frame to the next the camera is elsewhere."""
    room, frames = shaken_frames

    def cut(t):
        return shaken(t) @ (se3.exp(np.array(after, float)) if t > 14.5 / 30 else np.eye(4))

    frames = [*frames[:12], *(rolling(room, cut, index, depthless=0.0, limit=500)[0] for index in range(15, 20))]
    _, off = rolling_backend(room, frames, READOUT_S, tracking__rolling_shutter=False)
    _, on = rolling_backend(room, frames, READOUT_S)
    assert states(on) == states(off) == ["ok"] * len(frames)
    assert largest_error(on, frames, cut) < 0.8 * largest_error(off, frames, cut)


def test_the_velocity_is_forgotten_after_a_loss(shaken_frames):
    room, frames = shaken_frames
    backend, _ = rolling_backend(room, frames[:8], READOUT_S)
    assert backend.shutter.velocity is not None
    track_all(backend, [room.blind(11)])
    assert backend.shutter.velocity is None
    assert states(track_all(backend, [frames[9]])) == ["ok"] and backend.shutter.velocity is None
