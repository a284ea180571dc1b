"""The causal pose error: joined at the first frame with both, honest about holes, and quitting never pays."""

from dataclasses import replace

import numpy as np
import pytest
from evaluation_walks import walk

from dynslam_bench.evaluation import OnlineError, Protocol, RPESpec, evaluate, hold
from dynslam_bench.geometry import se3
from dynslam_bench.geometry.trajectory import Trajectory


def estimate_of(truth, seed=1):
    rng = np.random.default_rng(seed)
    return se3.exp(rng.normal(size=6)) @ (truth.T_world_cam @ se3.exp(rng.normal(0, 0.01, (len(truth), 6))))


TRUTH = walk(n=60)
POSES = estimate_of(TRUTH)


def run(error, truth, poses, ok):
    return [error.update(t, p if o else None) for t, p, o in zip(truth.timestamps, poses, ok, strict=True)]


def test_cumulative_error_is_the_origin_aligned_ape():
    samples = run(OnlineError(TRUTH), TRUTH, POSES, [True] * len(TRUTH))
    result = evaluate(Trajectory(TRUTH.timestamps, POSES), TRUTH, Protocol(id="x", alignment="origin"))
    assert np.sqrt(np.mean([s.trans_m**2 for s in samples])) == pytest.approx(result.metrics["ate_rmse_m"], abs=1e-12)
    assert max(s.rot_deg for s in samples) == pytest.approx(result.metrics["ape_rot_max_deg"], abs=1e-9)
    assert samples[0].trans_m == pytest.approx(0, abs=1e-12)
    assert samples[0].frame_trans_m is None


def test_frame_to_frame_error_is_eq_26_over_one_frame():
    samples = run(OnlineError(TRUTH), TRUTH, POSES, [True] * len(TRUTH))
    protocol = Protocol(id="x", rpe=(RPESpec(delta=1, unit="f", pairs="all"),))
    metrics = evaluate(Trajectory(TRUTH.timestamps, POSES), TRUTH, protocol).metrics
    frame = np.array([s.frame_trans_m for s in samples[1:]])
    assert np.sqrt((frame**2).mean()) == pytest.approx(metrics["rpe_1f_trans_rmse_m"], abs=1e-12)
    rotation = np.array([s.frame_rot_deg for s in samples[1:]])
    assert rotation.max() == pytest.approx(metrics["rpe_1f_rot_max_deg"], abs=1e-9)


def test_a_lost_frame_counts_as_the_last_tracked_pose_repeated():
    ok = np.ones(len(TRUTH), dtype=bool)
    ok[20:30] = False
    samples = run(OnlineError(TRUTH), TRUTH, POSES, ok)
    way = np.linalg.norm((se3.inverse(TRUTH.T_world_cam[:-1]) @ TRUTH.T_world_cam[1:])[:, :3, 3], axis=1)
    for i in range(20, 30):
        assert samples[i].frame_trans_m == pytest.approx(way[i - 1], abs=1e-12)
    assert [s.lost_way_m for s in samples[19:32]] == pytest.approx([0, *np.cumsum(way[19:29]), way[19:29].sum(), 0])
    held = hold(Trajectory(TRUTH.timestamps, POSES).select(ok), TRUTH.timestamps)
    expected = run(OnlineError(TRUTH), TRUTH, held.T_world_cam, [True] * len(TRUTH))
    assert [s.trans_m for s in samples] == pytest.approx([s.trans_m for s in expected], abs=1e-12)
    jumps = [[s.frame_trans_m for s in found[1:]] for found in (samples, expected)]
    assert jumps[0] == pytest.approx(jumps[1], abs=1e-12)


def test_a_predicted_pose_of_a_lost_frame_counts_for_nothing():
    ok = np.arange(len(TRUTH)) < 25
    without = [pose if good else None for pose, good in zip(POSES, ok, strict=True)]
    assert run(OnlineError(TRUTH), TRUTH, POSES, ok) == run(OnlineError(TRUTH), TRUTH, without, ok)


def test_a_tracker_that_never_starts_stands_at_the_first_true_pose():
    samples = run(OnlineError(TRUTH), TRUTH, [None] * len(TRUTH), [False] * len(TRUTH))
    way = np.linalg.norm(TRUTH.positions - TRUTH.positions[0], axis=1)
    assert [s.trans_m for s in samples] == pytest.approx(way.tolist(), abs=1e-12)


def test_joined_at_the_first_frame_that_has_both():
    samples = run(OnlineError(TRUTH), TRUTH, POSES, np.arange(len(TRUTH)) >= 5)
    assert samples[5].trans_m == pytest.approx(0, abs=1e-12)
    joined = run(OnlineError(TRUTH.select(slice(10, None))), TRUTH, POSES, [True] * len(TRUTH))
    assert joined[:10] == [None] * 10
    assert joined[10].trans_m == pytest.approx(0, abs=1e-12)
    assert joined[10].frame_trans_m is None
    assert joined[11].frame_trans_m is not None


def test_holes_give_none_and_the_pose_goes_on():
    hole = TRUTH.select(np.r_[0:20, 30 : len(TRUTH)])
    whole = run(OnlineError(TRUTH), TRUTH, POSES, [True] * len(TRUTH))
    samples = run(OnlineError(hole), TRUTH, POSES, [True] * len(TRUTH))
    assert samples[20:30] == [None] * 10
    assert samples[30].frame_trans_m is None
    assert samples[30].trans_m == pytest.approx(whole[30].trans_m, abs=1e-12)
    assert replace(samples[31], way_m=0.0) == replace(whole[31], way_m=0.0)


def test_the_true_way_goes_straight_across_holes():
    seen = np.r_[0:20, 30 : len(TRUTH)]
    samples = run(OnlineError(TRUTH.select(seen)), TRUTH, estimate_of(TRUTH), [True] * len(TRUTH))
    steps = np.linalg.norm(np.diff(TRUTH.positions[seen], axis=0), axis=1)
    ways = [samples[index].way_m for index in seen]
    assert ways == pytest.approx([0.0, *np.cumsum(steps)], abs=1e-12)
    assert ways[-1] < run(OnlineError(TRUTH), TRUTH, estimate_of(TRUTH), [True] * len(TRUTH))[-1].way_m


def test_without_ground_truth_there_is_no_error():
    truth = walk(n=5)
    for ground_truth in (None, truth.select(slice(0, 0))):
        assert run(OnlineError(ground_truth), truth, truth.T_world_cam, [True] * 5) == [None] * 5


def test_causal_and_repeatable():
    whole = run(OnlineError(TRUTH), TRUTH, POSES, [True] * len(TRUTH))
    other = POSES.copy()
    other[30:] = np.eye(4)
    assert run(OnlineError(TRUTH), TRUTH, other, [True] * len(TRUTH))[:30] == whole[:30]


def test_the_tolerance_is_strict():
    truth = Trajectory(np.array([0.0, 1.0]), np.tile(np.eye(4), (2, 1, 1)))
    assert OnlineError(truth, max_dt=0.5).update(0.5, np.eye(4)) is None
    assert OnlineError(truth, max_dt=0.5).update(0.499, np.eye(4)) is not None
