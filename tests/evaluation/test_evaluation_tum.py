"""TUM's semantics against a slow, independent reference written from the published behaviour of its scripts."""

from pathlib import Path

import numpy as np
import pytest

from dynslam_bench.evaluation import Protocol, RPESpec, evaluate
from dynslam_bench.evaluation.rpe import closest, random_pairs
from dynslam_bench.geometry import se3
from dynslam_bench.geometry.trajectory import Trajectory
from dynslam_bench.geometry.trajectory_files import read_tum

SHARED = Path(__file__).resolve().parents[3] / "shared" / "data"
EXPECTED_PAIRS = [[1107, 2782], [1047, 2715], [384, 2384]]


# -- the slow reference: dictionaries, loops, one pose at a time


def bisect_closest(values, target):
    low, high, best, difference = 0, len(values), 0, abs(values[0] - target)
    while low < high:
        middle = (low + high) // 2
        if abs(values[middle] - target) < difference:
            difference, best = abs(values[middle] - target), middle
        if values[middle] == target:
            return middle
        if values[middle] > target:
            high = middle
        else:
            low = middle + 1
    return best


def angle_of(matrix):
    return np.arccos(min(1.0, max(-1.0, (np.trace(matrix[:3, :3]) - 1) / 2)))


def ominus(a, b):
    return np.linalg.inv(a) @ b


def slow_rpe(truth, estimate, delta, unit):
    t_gt, t_est = truth.timestamps.tolist(), estimate.timestamps.tolist()
    poses = estimate.T_world_cam
    if unit == "s":
        index = t_est
    elif unit == "f":
        index = list(range(len(t_est)))
    else:
        index, total = [0.0], 0.0
        for i in range(len(poses) - 1):
            step = ominus(poses[i + 1], poses[i])
            scale = 180 / np.pi if unit == "deg" else 1.0
            total += np.linalg.norm(step[:3, 3]) if unit == "m" else angle_of(step) * scale
            index.append(total)
    pairs = []
    for i in range(len(t_est)):
        j = bisect_closest(index, index[i] + delta)
        if j != len(t_est) - 1:
            pairs.append((i, j))
    tolerance = 2 * np.median(np.diff(t_gt))
    translation, rotation = [], []
    for i, j in pairs:
        gi, gj = bisect_closest(t_gt, t_est[i]), bisect_closest(t_gt, t_est[j])
        if abs(t_gt[gi] - t_est[i]) > tolerance or abs(t_gt[gj] - t_est[j]) > tolerance:
            continue
        error = ominus(ominus(poses[j], poses[i]), ominus(truth.T_world_cam[gj], truth.T_world_cam[gi]))
        translation.append(np.linalg.norm(error[:3, 3]))
        rotation.append(np.rad2deg(angle_of(error)))
    return np.array(translation), np.array(rotation)


def walk(seed, n=150, standing=False):
    rng = np.random.default_rng(seed)
    stamps = np.round(1311868163.0 + np.cumsum(rng.uniform(0.028, 0.04, n)), 6)
    steps = rng.normal(0, 0.01, (n, 6))
    if standing:
        steps[20:60] = 0  # equal path indices: only the bisection's order decides
    poses = [np.eye(4)]
    for step in steps[1:]:
        poses.append(poses[-1] @ se3.exp(step))
    return Trajectory(stamps, np.array(poses))


def truth_of(estimate, seed):
    """Ground truth at three times the rate with a hole, close to the estimate."""
    rng = np.random.default_rng(seed + 50)
    stamps = np.arange(estimate.timestamps[0] - 0.05, estimate.timestamps[-1] + 0.05, 0.0101)
    nearest = np.abs(stamps[:, None] - estimate.timestamps).argmin(1)
    poses = estimate.T_world_cam[nearest] @ se3.exp(rng.normal(0, 0.01, (len(stamps), 6)))
    keep = (stamps < estimate.timestamps[80]) | (stamps > estimate.timestamps[95])
    return Trajectory(stamps[keep], (se3.exp(rng.normal(size=6)) @ poses)[keep])


def pairs_of_trajectories():
    for seed in range(3):
        estimate = walk(seed, standing=seed == 1)
        yield pytest.param(truth_of(estimate, seed), estimate, id=f"random-{seed}")
    for path in sorted(SHARED.glob("*/*/groundtruth.txt")):
        truth = read_tum(path)
        rng = np.random.default_rng(0)
        picked = truth.select(slice(1, None, 3))
        yield pytest.param(
            truth,
            Trajectory(picked.timestamps + 0.002, picked.T_world_cam @ se3.exp(rng.normal(0, 0.01, (len(picked), 6)))),
            id=path.parent.name,
        )


@pytest.mark.parametrize(("truth", "estimate"), list(pairs_of_trajectories()))
@pytest.mark.parametrize(
    ("delta", "unit"), [(1, "f"), (10, "f"), (1, "s"), (0.5, "s"), (0.1, "m"), (5, "deg"), (0.2, "rad")]
)
def test_rpe_with_fixed_delta(truth, estimate, delta, unit):
    spec = RPESpec(delta=delta, unit=unit)
    ours = evaluate(estimate, truth, Protocol(id="x", rpe=(spec,)))
    translation, rotation = slow_rpe(truth, estimate, delta, unit)
    assert ours.n_pairs_rpe[spec.key] == len(translation) > 10
    expected = {"rmse": np.sqrt((translation**2).mean())}
    expected |= {name: getattr(np, name)(translation) for name in ("mean", "median", "std", "min", "max")}
    for name, value in expected.items():
        assert ours.metrics[f"rpe_{spec.key}_trans_{name}_m"] == pytest.approx(value, abs=1e-12)
    # the reference's arccos loses half the digits near zero, ours does not
    assert ours.metrics[f"rpe_{spec.key}_rot_rmse_deg"] == pytest.approx(np.sqrt((rotation**2).mean()), abs=1e-5)


@pytest.mark.parametrize("seed", range(20))
def test_the_vectorised_bisection_meets_the_same_value(seed):
    rng = np.random.default_rng(seed)
    values = np.sort(rng.integers(0, 12, 40) / 4.0)
    targets = np.concatenate([values, values + 0.125, rng.uniform(-1, 5, 50)])
    assert closest(values, targets).tolist() == [bisect_closest(values.tolist(), t) for t in targets.tolist()]


def test_random_pairs_are_fixed_for_good():
    pairs = random_pairs(2893, 10000)
    assert pairs.shape == (10000, 2)
    assert pairs[:3].tolist() == EXPECTED_PAIRS  # raw generator words: no version of Python or NumPy may change them
    assert pairs.min() >= 0
    assert pairs.max() == 2892
    assert abs(pairs.mean() - 1446) < 20


def test_random_pairs_of_a_short_trajectory_are_all_pairs_with_themselves_too():
    assert len(random_pairs(99, 10000)) == 99 * 99
    assert len(random_pairs(100, 10000)) == 10000
    assert len(random_pairs(300, 0)) == 300 * 300
    assert random_pairs(2, 10000).tolist() == [[0, 0], [0, 1], [1, 0], [1, 1]]


def test_more_than_the_most_fixed_pairs_are_a_seeded_sample():
    estimate = walk(0)
    for most, pairs in ((50, 50), (0, 148)):
        protocol = Protocol(id="x", rpe=(RPESpec(delta=1, unit="f", max_pairs=most),))
        result = evaluate(estimate, estimate, protocol)
        assert result.n_pairs_rpe["1f"] == pairs and result.metrics == evaluate(estimate, estimate, protocol).metrics
