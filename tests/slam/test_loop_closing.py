"""Loops: drift goes where a place is recognised, and nothing moves where places only look the same."""

from dataclasses import replace

import numpy as np
import pytest
from ring_world import RingWorld

from dynslam_bench.core.settings import apply_overrides
from dynslam_bench.evaluation.alignment import align
from dynslam_bench.geometry import se3
from dynslam_bench.slam import loop_closing
from dynslam_bench.slam.backend import MonocularBackend, RgbdBackend
from dynslam_bench.slam.keyframes import TrajectoryHistory
from dynslam_bench.slam.loop_closing import FIRM, Correction
from dynslam_bench.slam.pose_graph import SIGMAS, Edge, inherited, optimise_poses, spread_scale
from dynslam_bench.slam.settings import BackendSettings, LoopClosingSettings, MonocularBackendSettings
from dynslam_bench.slam.tracking import weakly_connected

NOISE = dict(noise_px=1.2, depth_noise=0.01, limit=500)
STEP = 0.15


def drive(world, frames, *, closing):
    """A back end that has driven around, and the error of each online position in metres."""
    settings = BackendSettings(loop_closing=LoopClosingSettings(enabled=closing))
    backend, poses = RgbdBackend(settings), world.lap(frames, STEP)
    backend.reset(world.camera, 0)
    errors = []
    for index, pose in enumerate(poses):
        frame = world.see(pose, index, **NOISE)
        found = backend.track(frame, np.ones(len(frame), bool), np.ones(len(frame), np.float32))
        assert found.state == "ok" and found.loops == len(backend.loops.closed)
        errors.append(np.linalg.norm(found.T_world_cam[:3, 3] - (se3.inverse(poses[0]) @ pose)[:3, 3]))
    return backend, poses, np.array(errors)


def drive_without_depth(world, frames, step, *, closing):
    """A monocular back end that has driven around, and the RMSE of its final path, scaled and aligned, metres."""
    drifting = {"mapping.min_parallax_sigmas": 0.0}  # with the default there is hardly a scale to give back
    settings = apply_overrides(MonocularBackendSettings(), {"loop_closing.enabled": closing, **drifting})
    backend, poses = MonocularBackend(settings), world.lap(frames, step)
    backend.reset(world.camera, 0)
    for index, pose in enumerate(poses):
        frame = world.see(pose, index, noise_px=0.8, limit=700)
        frame = replace(frame, z=np.zeros_like(frame.z))
        backend.track(frame, np.ones(len(frame), bool), np.ones(len(frame), np.float32))
    final = backend.finalize()
    true = poses[np.rint(final.timestamps * 30).astype(int)]
    found = align(final.T_world_cam, true, "sim3").apply(final.T_world_cam)
    return backend, np.sqrt(np.square(found[:, :3, 3] - true[:, :3, 3]).sum(axis=1).mean())


def farthest(backend, poses):
    """How far the final path leaves the true one, metres."""
    final = backend.finalize().positions - se3.transform(se3.inverse(poses[0]), poses[:, :3, 3])
    return np.linalg.norm(final, axis=1).max()


def test_a_lap_comes_back_to_where_it_began():
    world = RingWorld(side=9.0)
    lap = int(np.ceil((4 * (world.side - 2) + 2 * np.pi) / STEP))
    backend, poses, errors = drive(world, lap + 15, closing=True)
    drift = errors[lap - 5 : lap + 5].max()
    assert drift > 0.1, "one turn drifts so far that the old points are not found by projecting them"
    assert errors[-1] < 0.3 * drift
    loop = backend.loops.closed[0]
    assert loop.frame < 20, "to the lap's beginning"
    assert loop.moved_m == pytest.approx(drift, rel=0.5)
    without, _, _ = drive(world, lap + 15, closing=False)
    assert farthest(backend, poses) < 0.8 * farthest(without, poses), "the whole path is corrected, not its end alone"
    index = backend.world.points
    assert (backend.world.n_obs[index] > 0).all() and np.isfinite(backend.world.position[index]).all()


@pytest.fixture(scope="module")
def lap_without_depth():
    """A ring, and a monocular back end that has closed it: frames, back end, and its RMSE."""
    world = RingWorld(side=9.0, seed=3)
    frames = int(np.ceil((4 * (world.side - 2) + 2 * np.pi) / 0.07)) + 40
    return world, frames, *drive_without_depth(world, frames, 0.07, closing=True)


def test_without_depth_a_lap_gets_its_scale_back(lap_without_depth):
    world, frames, backend, closed = lap_without_depth
    _, without = drive_without_depth(world, frames, 0.07, closing=False)
    loop = backend.loops.closed[0]
    assert loop.frame < 20 and abs(np.log(loop.scale)) > 0.03, "to the lap's beginning, where lengths were others"
    assert closed < 0.6 * without


def test_a_map_without_depth_goes_on_after_its_loop_was_closed_and_it_was_saved(lap_without_depth, tmp_path):
    world, _, made, _ = lap_without_depth
    made.save_map(tmp_path / "lap.npz")
    settings = {"loop_closing.enabled": True, "map.file": str(tmp_path / "lap.npz")}
    again, poses = MonocularBackend(apply_overrides(MonocularBackendSettings(), settings)), world.lap(60, 0.07)
    again.reset(world.camera, 1)
    found = []
    for index, pose in enumerate(poses):
        frame = world.see(pose, 1000 + index, noise_px=0.8, limit=700)
        frame = replace(frame, z=np.zeros_like(frame.z))
        found.append(again.track(frame, np.ones(len(frame), bool), np.ones(len(frame), np.float32)))
    assert [each.state for each in found] == ["ok"] * 60 and not again.loops.closed
    path = np.array([each.T_world_cam for each in found])
    aligned = align(path, poses, "sim3")
    assert np.linalg.norm(aligned.apply(path)[:, :3, 3] - poses[:, :3, 3], axis=1).max() < 0.05
    metre = made.history.poses(made.world)[1]  # in the unit of the saved map
    walked = np.linalg.norm(np.diff(se3.inverse(metre)[:60, :3, 3], axis=0), axis=1).sum()
    assert np.linalg.norm(np.diff(path[:, :3, 3], axis=0), axis=1).sum() == pytest.approx(walked, rel=0.1)


@pytest.mark.parametrize(("scale", "told", "agree"), [(1.6, 1.6, True), (2.5, 2.4, True), (1.05, 2.5, False)])
def test_keyframes_in_a_row_agree_on_a_similarity(scale, told, agree):
    """Two keyframes 0.2 apart; lengths where they are should be `scale` times as large, and the second tells `told`."""
    asked = []
    for at, factor in ((5.0, scale), (5.2, told)):
        before, now = np.eye(4), np.eye(4)
        before[0, 3], now[0, 3] = -at, -scale * (at - 5.0)
        asked.append(Correction(before, now, factor))
    assert asked[1].agrees(asked[0], np.array([5.2, 0.0, 0.0])) is agree


def test_frames_of_a_rescaled_keyframe_move_with_it(lap_without_depth):
    _, _, backend, _ = lap_without_depth
    world, history = backend.world, TrajectoryHistory(backend.world.space)
    one, other = (int(slot) for slot in world.keyframes[:2])
    information = np.diag([4.0, 4.0, 4.0, 1.0, 1.0, 1.0])
    for stamp, slot in ((0.0, one), (1.0, other), (2.0, one)):
        history.append(stamp, slot, se3.exp(np.array([0.3, 0.0, 0.1, 0.0, 0.2, 0.0])), information)
    _, before, _ = history.poses(world)
    history.rescale({one: 2.0})
    stamps, after, told = history.poses(world)
    relative = [poses @ se3.inverse(world.kf_pose[[one, other, one]]) for poses in (before, after)]
    assert stamps.tolist() == [0.0, 1.0, 2.0]
    np.testing.assert_allclose(relative[1][:, :3, 3], relative[0][:, :3, 3] * np.array([[2.0], [1.0], [2.0]]))
    np.testing.assert_allclose(relative[1][:, :3, :3], relative[0][:, :3, :3])
    np.testing.assert_allclose(np.diagonal(told, axis1=1, axis2=2)[:, [0, 5]], [[1.0, 1.0], [4.0, 1.0], [1.0, 1.0]])


def test_corridors_that_look_the_same_are_not_taken_for_one():
    backend, _, errors = drive(RingWorld(alike=0.5), 70, closing=True)
    assert not backend.loops.closed and errors.max() < 0.2


@pytest.mark.parametrize(("stretch", "closed"), [(100.0, True), (0.001, False)])
def test_of_a_way_of_many_stretches_the_root_may_be_drift(monkeypatch, stretch, closed):
    """The same lap, counted as one stretch and as thousands, that each drift by themselves."""
    monkeypatch.setattr(loop_closing, "STRETCH", stretch)
    world = RingWorld(side=9.0)
    lap = int(np.ceil((4 * (world.side - 2) + 2 * np.pi) / STEP))
    backend, _, _ = drive(world, lap + 6, closing=True)
    assert bool(backend.loops.closed) == closed


def test_it_changes_nothing_where_no_place_is_seen_again():
    world = RingWorld()
    _, _, without = drive(world, 60, closing=False)
    backend, _, errors = drive(world, 60, closing=True)
    asked = weakly_connected(backend.world, int(backend.world.keyframes[-1]), LoopClosingSettings().away)
    assert len(asked) and (errors == without).all()


def test_a_pose_graph_spreads_what_one_tie_contradicts():
    ids = np.arange(5) * 10
    true = np.tile(np.eye(4), (5, 1, 1))
    true[:, 0, 3] = np.arange(5)
    drifted = true.copy()
    drifted[:, 0, 3] *= 1.1
    steps = [Edge(int(a), int(a + 10), drifted[i + 1] @ se3.inverse(drifted[i])) for i, a in enumerate(ids[:-1])]
    ring = Edge(0, 40, true[4] @ se3.inverse(true[0]))
    found = optimise_poses(ids, drifted, [*steps, ring])
    np.testing.assert_allclose(found[:, 0, 3], np.arange(5) * 1.02, atol=1e-6, err_msg="five ties share 0.4 m equally")
    np.testing.assert_allclose(optimise_poses(ids, drifted, steps), drifted, atol=1e-9)


def test_a_loops_tie_goes_to_the_heir_of_a_keyframe_that_goes():
    poses = {number: se3.exp(np.random.default_rng(number).normal(size=6)) for number in range(4)}
    tie = lambda a, b: Edge(a, b, poses[b] @ se3.inverse(poses[a]), 2.0)  # noqa: E731
    for dropped in (0, 1):
        (found,) = inherited([tie(0, 1)], dropped, 3, poses[dropped] @ se3.inverse(poses[3]))
        expected = tie(3 if dropped == 0 else 0, 3 if dropped == 1 else 1)
        assert (found.one, found.other, found.weight) == (expected.one, expected.other, 2.0)
        np.testing.assert_allclose(found.T_other_one, expected.T_other_one, atol=1e-12)
    assert inherited([tie(0, 1)], 0, 1, poses[0] @ se3.inverse(poses[1])) == [], "nothing is tied to itself"
    assert len(inherited([tie(0, 1), tie(1, 2)], 3, 2, np.eye(4))) == 2


def test_a_scale_is_spread_over_the_ties_it_drifted_along():
    ids = np.arange(5) * 10
    steps = [Edge(int(a), int(a + 10), np.eye(4)) for a in ids[:-1]]
    found = spread_scale(ids, steps, Edge(0, 40, np.eye(4)), 2.0)
    np.testing.assert_allclose(
        found, 2.0 ** (np.arange(5) / 5), rtol=1e-6, err_msg="five ties share a factor of two equally"
    )
    np.testing.assert_allclose(spread_scale(ids, steps, Edge(0, 40, np.eye(4)), 1.0), 1.0)
    untied = spread_scale(np.r_[ids, 50], steps, Edge(0, 40, np.eye(4)), 2.0)
    np.testing.assert_allclose(untied, [*found, 1.0], rtol=1e-6, err_msg="what nothing ties stays")
    apart = spread_scale(np.r_[-1, ids], steps, Edge(0, 40, np.eye(4)), 2.0)
    np.testing.assert_allclose(apart, [1.0, *found], rtol=1e-6, err_msg="the oldest of what is connected stays")
    firm = spread_scale(ids, steps, Edge(0, 40, np.eye(4), FIRM), 2.0)
    assert firm[4] == pytest.approx(2.0, rel=0.01), "nothing is left open where two visits meet"
    beyond = spread_scale(ids, steps, Edge(10, 30, np.eye(4)), 2.0)
    assert beyond[1] == pytest.approx(beyond[0]) and beyond[3] == pytest.approx(beyond[4]), (
        "outside of the loop nothing is bent"
    )


@pytest.mark.parametrize("weight", [1.0, FIRM])
def test_a_pose_graph_is_gtsams_to_a_tenth_of_a_millimetre(weight):
    gtsam = pytest.importorskip("gtsam", reason="the reference is an extra")
    rng = np.random.default_rng(0)
    count, ids = 60, np.arange(60) * 3
    noise = rng.normal(0, [0.01] * 3 + [0.005] * 3, (2, count, 6))
    steps = se3.exp(np.tile([0.2, 0.0, 0.05, 0.0, 2 * np.pi / count, 0.0], (count, 1)) + noise[0])
    true, drifted = [np.eye(4)], [np.eye(4)]
    for step, slip in zip(steps[1:], se3.exp(noise[1])[1:], strict=True):
        true.append(step @ true[-1])
        drifted.append(slip @ step @ drifted[-1])
    pairs = [(i, j) for i in range(count) for j in (i + 1, i + 2) if j < count]
    edges = [Edge(int(ids[i]), int(ids[j]), drifted[j] @ se3.inverse(drifted[i])) for i, j in pairs]
    edges.append(Edge(0, int(ids[-1]), true[-1], weight))
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for key, pose in zip(ids.tolist(), se3.inverse(np.array(drifted)), strict=True):
        values.insert(key, gtsam.Pose3(pose))
    graph.add(gtsam.PriorFactorPose3(0, gtsam.Pose3(), gtsam.noiseModel.Isotropic.Sigma(6, 1e-6)))
    for edge in edges:
        sigmas = np.array([*SIGMAS[3:], *SIGMAS[:3]]) / np.sqrt(edge.weight)
        model = gtsam.noiseModel.Diagonal.Sigmas(sigmas)
        T_one_other = gtsam.Pose3(se3.inverse(edge.T_other_one))
        graph.add(gtsam.BetweenFactorPose3(edge.one, edge.other, T_one_other, model))
    result = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    reference = se3.inverse(np.array([result.atPose3(key).matrix() for key in ids.tolist()]))
    found = optimise_poses(ids, np.array(drifted), edges)
    np.testing.assert_allclose(found, reference, atol=1e-4)
    assert np.linalg.norm(found[30, :3, 3] - drifted[30][:3, 3]) > 0.01, "the tie moved the poses between"
