"""The back end on a simulated world: accuracy, repeatability, honest loss, bad input."""

import warnings
from importlib.util import find_spec

import numpy as np
import pytest

from dynslam_bench.core.settings import apply_overrides, parameters
from dynslam_bench.geometry import se3
from dynslam_bench.slam.backend import RgbdBackend
from dynslam_bench.slam.settings import BackendSettings


def make(room, seed=0, **overrides):
    names = {name.replace("__", "."): value for name, value in overrides.items()}
    backend = RgbdBackend(apply_overrides(BackendSettings(), names))
    backend.reset(room.camera, seed)
    return backend


def errors(results, truth):
    """Translation errors in metres of the tracked frames, in the frame of the first pose."""
    ok = [i for i, r in enumerate(results) if r.state == "ok"]
    start = results[ok[0]].T_world_cam @ se3.inverse(truth[ok[0]])
    return np.array([np.linalg.norm((se3.inverse(start @ truth[i]) @ results[i].T_world_cam)[:3, 3]) for i in ok])


def test_follows_a_smooth_path_to_millimetres(room, tracked):
    truth = room.path(90)
    backend = make(room)
    results = tracked(backend, [room.see(pose, i, wrong=40) for i, pose in enumerate(truth)])
    assert [r.state for r in results] == ["ok"] * 90
    assert errors(results, truth).max() < 0.012
    final = backend.finalize()
    assert len(final) == 90 and np.isfinite(final.T_world_cam).all()
    online = np.sqrt((errors(results, truth) ** 2).mean())

    start = final.T_world_cam[0] @ se3.inverse(truth[0])
    refined = np.linalg.norm((se3.inverse(start @ truth) @ final.T_world_cam)[:, :3, 3], axis=1)
    assert np.sqrt((refined**2).mean()) < 1.5 * online + 0.001


COUNTS = ("matches", "inliers", "residual_px", "relocalised", "keyframe", "map_points", "keyframes")


def test_counts_and_times_are_there_on_every_frame(room, tracked):
    truth = room.path(12)
    frames = [room.blind(0), *(room.see(pose, i + 1) for i, pose in enumerate(truth)), room.blind(20)]
    results = tracked(make(room), frames)
    assert [r.state for r in results] == ["initialising"] + ["ok"] * 12 + ["lost"]
    for r in results:
        assert np.isfinite([getattr(r, name) for name in COUNTS]).all()
        assert list(r.timings) == ["tracking", "mapping", "bundle_adjustment"]
    first, lost = results[1], results[-1]
    assert first.keyframe and first.keyframes == 1 and first.inliers == first.map_points > 60
    assert not lost.keyframe and lost.inliers == 0 and lost.keyframes == results[-2].keyframes


def test_same_seed_same_bits_and_reset_forgets(room, tracked):
    truth = room.path(50)
    frames = [room.see(pose, i) for i, pose in enumerate(truth)]
    frames[20:25] = [room.blind(i) for i in range(20, 25)]  # relocalisation draws random samples
    backend = make(room, seed=5)
    first = tracked(backend, frames)
    final = backend.finalize().T_world_cam
    backend.reset(room.camera, 5)
    second = tracked(backend, frames)
    for a, b in zip(first, second, strict=True):
        assert a.state == b.state and all(getattr(a, name) == getattr(b, name) for name in COUNTS)
        assert np.array_equal(a.T_world_cam, b.T_world_cam)
    assert np.array_equal(final, backend.finalize().T_world_cam)


def test_finalize_with_all_of_the_map_refined_may_be_asked_at_any_time(room):
    """It gives the same when asked twice, and a run that goes on is what it would have been."""
    asked, quiet = (make(room, bundle_adjustment__full=True) for _ in range(2))
    keep = np.ones(2000, bool), np.ones(2000, np.float32)
    for index, pose in enumerate(room.path(60)):
        frame = room.see(pose, index)
        for backend in (asked, quiet):  # what filters look at, as the pipeline does
            backend.mapper.resume()
        views = [(backend.keyframe_views(3), backend.map_points()) for backend in (asked, quiet)]
        assert np.array_equal(views[0][1][1], views[1][1][1])
        for one, other in zip(views[0][0], views[1][0], strict=True):
            assert np.array_equal(one.T_world_cam, other.T_world_cam)
        outcomes = [backend.track(frame, *(each[: len(frame)] for each in keep)) for backend in (asked, quiet)]
        assert outcomes[0].state == outcomes[1].state
        assert outcomes[0].state != "ok" or np.array_equal(outcomes[0].T_world_cam, outcomes[1].T_world_cam)
        if index in (30, 45):
            before = asked.outputs().positions
            first, second = asked.finalize(), asked.finalize()
            assert np.array_equal(first.T_world_cam, second.T_world_cam)
            assert not np.array_equal(before, asked.outputs().positions), "files show the refined map"
            assert np.array_equal(asked.map_points()[1], asked.outputs().positions), "and so does who asks now"
    finals = [backend.finalize().T_world_cam for backend in (asked, quiet)]
    assert len(finals[0]) > 40 and np.array_equal(*finals)


def test_culled_features_enter_neither_tracking_nor_map(room, tracked):
    truth = room.path(40)
    frames, keeps = [], []
    for i, pose in enumerate(truth):
        frame = room.see(pose, i)
        moving = frame.keypoints.xy[:, 0] < 250
        frame.xy[moving] += (5.0 * i, 0.0)  # would drag the pose along if it were believed
        frame.keypoints.xy[moving] += (5.0 * i, 0.0)
        frames.append(frame)
        keeps.append(~moving)
    backend = make(room)
    results = tracked(backend, frames, keeps)
    assert errors(results, truth).max() < 0.025
    views = backend.keyframe_views(100)
    by_frame = {k.frame: view for k, view in zip(backend.outputs().keyframes[::-1], views, strict=True)}
    for index, view in by_frame.items():
        assert len(view.keypoints) == np.count_nonzero(keeps[index])


def test_a_covered_lens_is_lost_exactly_as_long_as_it_is_covered(room, tracked):
    truth = room.path(80)
    frames = [room.see(pose, i) for i, pose in enumerate(truth)]
    frames[40:60] = [room.blind(i) for i in range(40, 60)]
    results = tracked(make(room), frames)
    assert [r.state for r in results] == ["ok"] * 40 + ["lost"] * 20 + ["ok"] * 20
    assert errors(results, truth).max() < 0.02
    assert results[60].relocalised or results[60].inliers > 50
    for r in results[40:60]:
        assert se3.is_pose(r.T_world_cam)  # a prediction, marked as lost


def test_lost_frames_enter_no_trajectory(room, tracked):
    truth = room.path(30)
    frames = [room.see(pose, i) for i, pose in enumerate(truth)]
    frames[10:14] = [room.blind(i) for i in range(10, 14)]
    backend = make(room)
    tracked(backend, frames)
    stamps = backend.finalize().timestamps
    assert np.allclose(stamps, [i / 30 for i in range(30) if not 10 <= i < 14])


def test_relocalises_at_another_place_after_a_gap_of_a_second(room, tracked):
    truth = room.path(120)
    order = [*range(60), *range(90, 120)]
    results = tracked(make(room), [room.see(truth[i], i) for i in order])
    assert all(r.state == "ok" for r in results[:60])
    assert sum(r.state == "ok" for r in results[60:]) >= 25
    assert errors(results, truth[order]).max() < 0.03


def test_does_not_claim_to_know_an_unknown_place(room, tracked):
    truth = room.path(30)
    backend = make(room)
    tracked(backend, [room.see(pose, i) for i, pose in enumerate(truth)])
    other = type(room)(seed=9)
    results = tracked(backend, [other.see(truth[i], 30 + i) for i in range(5)])
    assert [r.state for r in results] == ["lost"] * 5


def test_pure_rotation(room, tracked):
    t = np.arange(60) / 30.0
    truth = se3.exp(np.stack([0 * t, 0 * t, 0 * t, 0.2 * np.sin(2 * t), 0.9 * np.sin(1.5 * t), 0 * t], axis=1))
    results = tracked(make(room), [room.see(pose, i) for i, pose in enumerate(truth)])
    assert [r.state for r in results] == ["ok"] * 60
    assert errors(results, truth).max() < 0.02


def test_most_of_the_image_moves_and_only_some_of_it_is_culled(room, tracked):
    truth = room.path(40)
    frames = [room.see(pose, i, wrong=500) for i, pose in enumerate(truth)]  # 500 of 700 fit nothing
    results = tracked(make(room), frames)
    assert all(r.T_world_cam is None or se3.is_pose(r.T_world_cam) for r in results)
    assert errors(results, truth).max() < 0.03


NEEDS_GTSAM = pytest.mark.skipif(find_spec("gtsam") is None, reason="the extra [gtsam] is not installed")


@pytest.mark.parametrize("solver", ["schur", pytest.param("gtsam", marks=NEEDS_GTSAM)])
def test_both_solvers_run(room, tracked, solver):
    truth = room.path(40)
    results = tracked(make(room, bundle_adjustment__solver=solver), [room.see(p, i) for i, p in enumerate(truth)])
    assert errors(results, truth).max() < 0.015


def test_covisible_local_map_tracks_too(room, tracked):
    truth = room.path(40)
    backend = make(room, tracking__local_map="covisible")
    assert errors(tracked(backend, [room.see(p, i) for i, p in enumerate(truth)]), truth).max() < 0.015


def test_features_without_depth_become_points_by_triangulation(room, tracked):
    truth = room.path(60)
    frames = [room.see(pose, i, depthless=0.0 if i == 0 else 0.75) for i, pose in enumerate(truth)]
    with_it, without = make(room, mapping__triangulate_below=1.0), make(room, mapping__triangulate_below=0.0)
    results = tracked(with_it, frames)
    tracked(without, frames)
    assert errors(results, truth).max() < 0.02
    assert len(with_it.map_points()[0]) > len(without.map_points()[0])
    # every point lies on a wall of the room: z = 2.5, |x| = 3 or |y| = 2 in the world of the first camera
    local = with_it.map_points()[1]
    wall = np.minimum.reduce([abs(local[:, 2] - 2.5), abs(abs(local[:, 0]) - 3), abs(abs(local[:, 1]) - 2)])
    assert np.median(wall) < 0.02 and np.quantile(wall, 0.9) < 0.08


def test_hostile_numbers_in_the_frame(room, tracked):
    truth = room.path(20)
    frames = [room.see(pose, i) for i, pose in enumerate(truth)]
    for frame in frames[5:]:
        frame.z[::7] = np.nan
        frame.z[1::7] = -1.0
        frame.z[2::7] = np.inf
        frame.xy[3::11] = np.nan
    backend = make(room)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        results = tracked(backend, frames)
    assert [r.state for r in results] == ["ok"] * 20
    assert errors(results, truth).max() < 0.02


def test_weights_scale_the_say_of_a_feature(room):
    truth = room.path(20)
    backend = make(room)
    for i, pose in enumerate(truth):
        frame = room.see(pose, i)
        weight = np.ones(len(frame), np.float32)
        shifted = np.arange(len(frame)) % 2 == 0
        if i > 3:
            frame.xy[shifted] += (6.0, 0.0)
            weight[shifted] = 0.0
        result = backend.track(frame, np.ones(len(frame), bool), weight)
        assert result.state == "ok"
    step = se3.inverse(truth[0]) @ truth[-1]
    assert np.linalg.norm((se3.inverse(step) @ result.T_world_cam)[:3, 3]) < 0.015


def test_no_depth_at_all_never_initialises(room, tracked):
    results = tracked(make(room), [room.see(p, i, depthless=1.1) for i, p in enumerate(room.path(5))])
    assert [r.state for r in results] == ["initialising"] * 5
    assert all(r.T_world_cam is None for r in results)


def test_tracks_on_through_frames_without_depth(room, tracked):
    truth = room.path(30)
    frames = [room.see(p, i, depthless=1.1 if 10 <= i < 20 else 0.1) for i, p in enumerate(truth)]
    results = tracked(make(room), frames)
    assert [r.state for r in results] == ["ok"] * 30
    assert errors(results, truth).max() < 0.02


def test_prediction_is_the_motion_models(room, tracked):
    backend = make(room)
    assert backend.predict(0.0) is None
    truth = room.path(20)
    results = tracked(backend, [room.see(pose, i) for i, pose in enumerate(truth[:19])])
    start = results[0].T_world_cam @ se3.inverse(truth[0])
    ahead = np.linalg.norm((se3.inverse(start @ truth[19]) @ backend.predict(19 / 30))[:3, 3])
    stay = np.linalg.norm((se3.inverse(truth[19]) @ truth[18])[:3, 3])
    assert ahead < 0.6 * stay


def test_the_prediction_is_for_the_time_of_the_frame_not_for_the_interval_before(room, tracked):
    """Intervals of one, two and four thirtieths in turn, as when frames are dropped."""
    steps = np.cumsum([0, *([1, 2, 4] * 10)])
    path = room.path(int(steps[-1]) + 1)
    backend, ahead, old = make(room), [], []
    start = np.eye(4)
    for number, step in enumerate(steps):
        stamp, before = step / 30.0, steps[number - 1] / 30.0
        if number > 6:
            truth = start @ path[step]
            previous = before - steps[number - 2] / 30.0
            ahead.append(np.linalg.norm((se3.inverse(truth) @ backend.predict(stamp))[:3, 3]))
            old.append(np.linalg.norm((se3.inverse(truth) @ backend.predict(before + previous))[:3, 3]))
            shorter, longer = backend.motion_covariance(stamp), backend.motion_covariance(stamp + 1 / 30)
            assert np.trace(shorter) < np.trace(longer)
        (result,) = tracked(backend, [room.see(path[step], number, stamp=stamp)])
        if number == 0:
            start = result.T_world_cam @ se3.inverse(path[0])
    assert np.mean(ahead) < 0.5 * np.mean(old), (np.mean(ahead), np.mean(old))


def test_nothing_is_assumed_of_a_long_gap(room, tracked):
    backend = make(room)
    last = tracked(backend, [room.see(pose, i) for i, pose in enumerate(room.path(12))])[-1].T_world_cam
    assert backend.motion_covariance(12 / 30) is not None
    beyond = 11 / 30 + backend.settings.motion.max_gap_s + 1e-6
    assert backend.motion_covariance(beyond) is None
    np.testing.assert_allclose(backend.predict(beyond), last, atol=1e-12)


def test_views_and_points_fit_each_other(room, tracked):
    truth = room.path(60)
    backend = make(room)
    tracked(backend, [room.see(pose, i) for i, pose in enumerate(truth)])
    ids, positions = backend.map_points()
    assert len(ids) == len(set(ids.tolist())) == len(positions) and ids.dtype == np.int64
    views = backend.keyframe_views(3)
    assert len(views) == 3
    assert views[0].depth is not None and views[0].xy.shape == (len(views[0].keypoints), 2)
    outputs = backend.outputs()
    assert np.array_equal(views[0].T_world_cam, outputs.keyframes[-1].T_world_cam)
    assert (outputs.observations >= 1).all() and np.array_equal(outputs.ids, ids)
    assert backend.keyframe_views(0) == ()


def test_the_number_of_keyframes_is_bounded(room, tracked):
    truth = room.path(90)
    backend = make(room, keyframes__maximum=10, keyframes__tracked_share=0.95, keyframes__redundant_share=1.0)
    results = tracked(backend, [room.see(pose, i) for i, pose in enumerate(truth)])
    assert sum(r.keyframe for r in results) > 15
    assert max(r.keyframes for r in results) <= 10
    assert len(backend.finalize()) == 90
    assert errors(results, truth).max() < 0.03


def test_where_there_are_too_many_keyframes_those_around_the_camera_stay(room):
    """They overlap most: once they were the first to go, and the local error grew tenfold on long ways."""
    most = 16
    backend = make(room, keyframes__maximum=most, keyframes__tracked_share=1.0, keyframes__redundant_share=1.0)
    made = []
    for index, pose in enumerate(room.path(240)):
        frame = room.see(pose, index)
        found = backend.track(frame, np.ones(len(frame), bool), np.ones(len(frame), np.float32))
        made += [index] if found.keyframe else []
        kept = backend.world.kf_frame[backend.world.keyframes].tolist()
        assert len(kept) == min(len(made), most) and kept[-4:] == made[-4:] and kept[0] == 0
    assert len(made) > 2 * most


def test_a_repeated_stamp_is_no_error(room, tracked):
    truth = room.path(10)
    frames = [room.see(pose, i, stamp=min(i, 5) / 30.0) for i, pose in enumerate(truth)]
    backend = make(room)
    results = tracked(backend, frames)
    assert all(r.state == "ok" for r in results)
    assert len(backend.finalize()) == 6


def test_every_tunable_setting_is_described():
    described = parameters(BackendSettings)
    assert len(described) > 20 and all(p.meaning for p in described)
