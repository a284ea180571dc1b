"""Loop closing: drift is removed where a place is recognised, and nothing moves where places only look the same."""

import numpy as np
import pytest
from point_world import make_backend, states, track_all, without_depth
from ring_world import RingWorld, drive, position_errors
from scipy.optimize import least_squares

from dynslam_bench.evaluation.alignment import align
from dynslam_bench.geometry import se3
from dynslam_bench.slam import loop_closing
from dynslam_bench.slam.loop_closing import (
    LOOP_WEIGHT,
    SIGMAS,
    Correction,
    Edge,
    optimise_poses,
    spread_scale,
    transferred_edges,
)
from dynslam_bench.slam.motion_model import FramePose, rescale, trajectory
from dynslam_bench.slam.tracking import weakly_connected

NOISE = {"noise_px": 1.2, "depth_noise": 0.01, "limit": 500}
MONOCULAR_NOISE = {"noise_px": 0.8, "limit": 700}
STEP, MONOCULAR_STEP = 0.15, 0.07


def lap(world, frames, *, closing):
    """A back end that has driven along a ring, and the error of each online position in metres."""
    path = [*range(frames)]
    backend, results, truth = drive(world, path, STEP, rate=30.0, noise=NOISE, loop_closing__enabled=closing)
    assert states(results) == ["ok"] * frames and results[-1].loops == len(backend.loops.closed)
    final = np.linalg.norm(backend.finalize().positions - truth[:, :3, 3], axis=1).max()
    return backend, position_errors(results, path, truth), final


def monocular_lap(world, frames, *, closing):
    """A monocular back end along a ring, and the RMSE of its final trajectory, scaled and aligned, metres."""
    backend, _, truth = drive(
        world, [*range(frames)], MONOCULAR_STEP, rate=30.0, monocular=True, noise=MONOCULAR_NOISE,
        loop_closing__enabled=closing, mapping__min_parallax_sigmas=0.0,  # with the default scale hardly drifts
    )  # fmt: skip
    final = backend.finalize()
    true = truth[np.rint(final.timestamps * 30).astype(int)]
    aligned = align(final.T_world_cam, true, "sim3").apply(final.T_world_cam)
    return backend, np.sqrt(np.square(aligned[:, :3, 3] - true[:, :3, 3]).sum(axis=1).mean())


def test_a_lap_comes_back_to_where_it_began():
    world = RingWorld(side=9.0)
    frames = world.frames_of_a_lap(STEP)
    backend, errors, final = lap(world, frames + 15, closing=True)
    drift = errors[frames - 5 : frames + 5].max()
    assert drift > 0.1 and errors[-1] < 0.3 * drift
    loop = backend.loops.closed[0]
    assert loop.frame < 20 and loop.moved_m == pytest.approx(drift, rel=0.5)
    _, _, without = lap(world, frames + 15, closing=False)
    assert final < 0.8 * without, "the whole trajectory is corrected, not its end alone"
    index = backend.world.points
    assert (backend.world.n_obs[index] > 0).all() and np.isfinite(backend.world.position[index]).all()


@pytest.fixture(scope="module")
def closed_monocular():
    """A ring, and a monocular back end that has closed it: frames, back end, and its RMSE."""
    world = RingWorld(side=9.0, seed=3)
    frames = world.frames_of_a_lap(MONOCULAR_STEP) + 40
    return world, frames, *monocular_lap(world, frames, closing=True)


def test_without_depth_a_lap_gets_its_scale_back(closed_monocular):
    world, frames, backend, closed = closed_monocular
    _, without = monocular_lap(world, frames, closing=False)
    loop = backend.loops.closed[0]
    assert loop.frame < 20 and abs(np.log(loop.scale)) > 0.03 and closed < 0.6 * without


def test_a_map_without_depth_goes_on_after_its_loop_was_closed_and_it_was_saved(closed_monocular, tmp_path):
    world, _, made, _ = closed_monocular
    made.save_map(tmp_path / "lap.npz")
    again = make_backend(world, monocular=True, seed=1, loop_closing__enabled=True, map__file=str(tmp_path / "lap.npz"))
    poses = world.lap(60, MONOCULAR_STEP)
    frames = [without_depth(world.see(pose, 1000 + i, **MONOCULAR_NOISE)) for i, pose in enumerate(poses)]
    results = track_all(again, frames)
    assert states(results) == ["ok"] * 60 and not again.loops.closed
    online = np.array([result.T_world_cam for result in results])
    aligned = align(online, poses, "sim3").apply(online)
    assert np.linalg.norm(aligned[:, :3, 3] - poses[:, :3, 3], axis=1).max() < 0.05
    before = trajectory(made.history, made.world, made.settings.motion).T_world_cam[:60]  # in the saved map's unit
    lengths = [np.linalg.norm(np.diff(track[:, :3, 3], axis=0), axis=1).sum() for track in (online, before)]
    assert lengths[0] == pytest.approx(lengths[1], rel=0.1)


@pytest.mark.parametrize(("scale", "second", "agree"), [(1.6, 1.6, True), (2.5, 2.4, True), (1.05, 2.5, False)])
def test_consecutive_keyframes_agree_on_a_similarity(scale, second, agree):
    """Two keyframes 0.2 apart; lengths where they are should be `scale` times as large, by the second one `second`."""
    corrections = []
    for at, factor in ((5.0, scale), (5.2, second)):
        before, now = np.eye(4), np.eye(4)
        before[0, 3], now[0, 3] = -at, -scale * (at - 5.0)
        corrections.append(Correction(before, now, factor))
    assert corrections[1].agrees(corrections[0], np.array([5.2, 0.0, 0.0])) is agree


def test_frames_of_a_rescaled_keyframe_move_with_it():
    pose, information = se3.exp(np.array([0.3, 0.0, 0.1, 0.0, 0.2, 0.0])), np.diag([4.0, 4.0, 4.0, 1.0, 1.0, 1.0])
    history = [FramePose(stamp, slot, pose.copy(), information.astype(np.float32)) for stamp, slot in ((0, 7), (1, 9))]
    rescale(history, {7: 2.0})
    rescaled, other = history
    np.testing.assert_allclose(rescaled.T_cam_ref[:3, 3], 2.0 * pose[:3, 3])
    np.testing.assert_array_equal(rescaled.T_cam_ref[:3, :3], pose[:3, :3])
    np.testing.assert_allclose(np.diag(rescaled.information), 1.0)
    assert np.array_equal(other.T_cam_ref, pose) and np.array_equal(other.information, information)


def test_corridors_that_look_the_same_are_not_taken_for_one():
    backend, errors, _ = lap(RingWorld(alike=0.5), 70, closing=True)
    assert not backend.loops.closed and errors.max() < 0.2


@pytest.mark.parametrize(("section", "closed"), [(100.0, True), (0.001, False)])
def test_sections_of_a_long_path_drift_independently(monkeypatch, section, closed):
    monkeypatch.setattr(loop_closing, "DRIFT_SECTION", section)
    world = RingWorld(side=9.0)
    backend, _, _ = lap(world, world.frames_of_a_lap(STEP) + 6, closing=True)
    assert bool(backend.loops.closed) == closed


def test_it_changes_nothing_where_no_place_is_seen_again():
    _, without, _ = lap(RingWorld(), 60, closing=False)
    backend, errors, _ = lap(RingWorld(), 60, closing=True)
    assert len(weakly_connected(backend.world, int(backend.world.keyframes[-1]))) and (errors == without).all()


# ---------------------------------------------------------------------- the pose graph


def test_a_pose_graph_spreads_the_error_of_a_loop_edge():
    ids = np.arange(5) * 10
    true = np.tile(np.eye(4), (5, 1, 1))
    true[:, 0, 3] = np.arange(5)
    drifted = true.copy()
    drifted[:, 0, 3] *= 1.1
    steps = [Edge(int(a), int(a + 10), drifted[i + 1] @ se3.inverse(drifted[i])) for i, a in enumerate(ids[:-1])]
    loop_edge = Edge(0, 40, true[4] @ se3.inverse(true[0]))
    optimised = optimise_poses(ids, drifted, [*steps, loop_edge])
    np.testing.assert_allclose(optimised[:, 0, 3], np.arange(5) * 1.02, atol=1e-6)  # five edges share 0.4 m equally
    np.testing.assert_allclose(optimise_poses(ids, drifted, steps), drifted, atol=1e-9)


def test_a_loop_edge_moves_to_the_replacement_of_a_culled_keyframe():
    poses = [se3.exp(np.random.default_rng(number).normal(size=6)) for number in range(4)]
    edge = lambda a, b: Edge(a, b, poses[b] @ se3.inverse(poses[a]), 2.0)  # noqa: E731
    for culled, expected in ((0, edge(3, 1)), (1, edge(0, 3))):
        (moved,) = transferred_edges([edge(0, 1)], culled, 3, poses[culled] @ se3.inverse(poses[3]))
        assert (moved.one, moved.other, moved.weight) == (expected.one, expected.other, 2.0)
        np.testing.assert_allclose(moved.T_other_one, expected.T_other_one, atol=1e-12)
    assert transferred_edges([edge(0, 1)], 0, 1, poses[0] @ se3.inverse(poses[1])) == []
    assert len(transferred_edges([edge(0, 1), edge(1, 2)], 3, 2, np.eye(4))) == 2


def test_scale_is_spread_over_the_edges_along_which_it_drifted():
    ids = np.arange(5) * 10
    steps, loop_edge = [Edge(int(a), int(a + 10), np.eye(4)) for a in ids[:-1]], Edge(0, 40, np.eye(4))
    spread = spread_scale(ids, steps, loop_edge, 2.0)
    np.testing.assert_allclose(spread, 2.0 ** (np.arange(5) / 5), rtol=1e-6)  # five edges share a factor of two
    np.testing.assert_allclose(spread_scale(ids, steps, loop_edge, 1.0), 1.0)
    # what is not connected keeps its scale, and so does the oldest of each connected component
    np.testing.assert_allclose(spread_scale(np.r_[ids, 50], steps, loop_edge, 2.0), [*spread, 1.0], rtol=1e-6)
    np.testing.assert_allclose(spread_scale(np.r_[-1, ids], steps, loop_edge, 2.0), [1.0, *spread], rtol=1e-6)
    assert spread_scale(ids, steps, Edge(0, 40, np.eye(4), LOOP_WEIGHT), 2.0)[4] == pytest.approx(2.0, rel=0.01)
    inner = spread_scale(ids, steps, Edge(10, 30, np.eye(4)), 2.0)
    assert inner[1] == pytest.approx(inner[0]) and inner[3] == pytest.approx(inner[4])


@pytest.mark.parametrize("weight", [1.0, LOOP_WEIGHT])
def test_a_pose_graph_agrees_with_general_least_squares(weight):
    rng, count = np.random.default_rng(0), 12
    noise = rng.normal(0, [0.01] * 3 + [0.005] * 3, (2, count, 6))
    steps = se3.exp(np.tile([0.2, 0.0, 0.05, 0.0, 2 * np.pi / count, 0.0], (count, 1)) + noise[0])
    true, drifted = [np.eye(4)], [np.eye(4)]
    for step, slip in zip(steps[1:], se3.exp(noise[1])[1:], strict=True):
        true.append(step @ true[-1])
        drifted.append(slip @ step @ drifted[-1])
    pairs = [(i, j) for i in range(count) for j in (i + 1, i + 2) if j < count]
    edges = [Edge(i, j, drifted[j] @ se3.inverse(drifted[i])) for i, j in pairs]
    edges.append(Edge(0, count - 1, true[-1], weight))

    def moved(twists):
        return np.concatenate([[drifted[0]], se3.exp(twists.reshape(-1, 6)) @ np.array(drifted[1:])])

    def residuals(twists):
        poses = moved(twists)
        between = [poses[e.other] @ se3.inverse(poses[e.one]) @ se3.inverse(e.T_other_one) for e in edges]
        return (se3.log(np.array(between)) / SIGMAS * np.sqrt([[e.weight] for e in edges])).ravel()

    reference = moved(least_squares(residuals, np.zeros(6 * (count - 1)), xtol=1e-12, ftol=1e-12).x)
    optimised = optimise_poses(np.arange(count), np.array(drifted), edges)
    np.testing.assert_allclose(optimised, reference, atol=1e-4)
    assert np.linalg.norm(optimised[6, :3, 3] - drifted[6][:3, 3]) > 0.001
