"""Agreement with evo to 1e-9 under equal association, alignment and pair selection."""

from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest

from dynslam_bench.evaluation import Protocol, RPESpec, evaluate
from dynslam_bench.geometry import se3
from dynslam_bench.geometry.trajectory import Trajectory
from dynslam_bench.geometry.trajectory_files import read_tum

pytest.importorskip("evo")
from evo.core import metrics, sync
from evo.core.trajectory import PoseTrajectory3D

SHARED = Path(__file__).resolve().parents[3] / "shared" / "data"
REAL = [
    path for path in sorted(SHARED.glob("*/*/groundtruth.txt")) if path.parts[-3] != "fixed_camera"
]  # evo needs motion


def smooth(seed, n=240, start=1305031102.0):
    """A random smooth trajectory at about 100 Hz with a hole of one second."""
    rng = np.random.default_rng(seed)
    stamps = start + np.cumsum(rng.uniform(0.008, 0.012, n))
    stamps[n // 2 :] += 1.0
    steps = np.cumsum(rng.normal(0, 0.002, (n, 6)), axis=0) + rng.normal(0, 0.002, (n, 6))
    poses = [se3.exp(rng.normal(size=6))]
    for step in steps[1:]:
        poses.append(poses[-1] @ se3.exp(step))
    return Trajectory(stamps, np.array(poses))


def perturbed(truth, seed):
    """Every third pose, noisy, with other stamps, scaled a little and in another world frame."""
    rng = np.random.default_rng(seed + 1000)
    picked = truth.select(slice(0, None, 3))
    poses = picked.T_world_cam @ se3.exp(rng.normal(0, 0.01, (len(picked), 6)))
    poses[:, :3, 3] *= 1.07
    return Trajectory(picked.timestamps + rng.uniform(-0.006, 0.006, len(picked)), se3.exp(rng.normal(size=6)) @ poses)


def cases():
    for seed in range(4):
        truth = smooth(seed)
        yield pytest.param(perturbed(truth, seed), truth, id=f"random-{seed}")
    for path in REAL:
        truth = read_tum(path)
        yield pytest.param(perturbed(truth, 7), truth, id=path.parent.name)
    # an estimate with more poses than the ground truth: evo then starts from the ground truth
    truth = smooth(9)
    yield pytest.param(
        perturbed(truth.select(slice(0, None, 1)), 9), truth.select(slice(0, None, 7)), id="longer-estimate"
    )


def to_evo(trajectory):
    return PoseTrajectory3D(poses_se3=list(trajectory.T_world_cam), timestamps=trajectory.timestamps.copy())


@lru_cache(maxsize=128)
def evo_pair(estimate, truth, alignment, max_dt):
    """What evo compares, associated and aligned; its metrics only read it."""
    reference, estimated = sync.associate_trajectories(to_evo(truth), to_evo(estimate), max_diff=max_dt)
    if alignment == "origin":
        estimated.align_origin(reference)
    elif alignment in ("se3", "sim3"):
        estimated.align(reference, correct_scale=alignment == "sim3")
    return reference, estimated


@pytest.mark.parametrize(("estimate", "truth"), list(cases()))
@pytest.mark.parametrize("alignment", ["none", "origin", "se3", "sim3"])
@pytest.mark.parametrize("max_dt", [0.01, 0.003])
def test_absolute_errors(estimate, truth, alignment, max_dt):
    protocol = Protocol(id="x", max_dt=max_dt, strict=False, one_to_one=False, alignment=alignment)
    ours = evaluate(estimate, truth, protocol)
    pair = evo_pair(estimate, truth, alignment, max_dt)
    assert ours.n_pairs == pair[0].num_poses
    for relation, prefix, unit in (
        (metrics.PoseRelation.translation_part, "ate", "m"),
        (metrics.PoseRelation.rotation_angle_deg, "ape_rot", "deg"),
    ):
        ape = metrics.APE(relation)
        ape.process_data(pair)
        for name, value in ape.get_all_statistics().items():
            key = f"{prefix}_{name}_{unit}{'2' if name == 'sse' else ''}"
            assert ours.metrics[key] == pytest.approx(value, abs=1e-9, rel=1e-9), key


@pytest.mark.parametrize(("estimate", "truth"), list(cases()))
@pytest.mark.parametrize("alignment", ["none", "se3", "sim3"])
@pytest.mark.parametrize("mode", ["consecutive", "all"])
@pytest.mark.parametrize("delta", [1, 7])
def test_relative_errors(estimate, truth, alignment, mode, delta):
    spec = RPESpec(delta=delta, unit="f", pairs=mode)
    protocol = Protocol(id="x", max_dt=0.01, strict=False, one_to_one=False, alignment=alignment, rpe=(spec,))
    ours = evaluate(estimate, truth, protocol)
    pair = evo_pair(estimate, truth, alignment, 0.01)
    for relation, part, ending in (
        (metrics.PoseRelation.translation_part, "trans", "m"),
        (metrics.PoseRelation.rotation_angle_deg, "rot", "deg"),
    ):
        rpe = metrics.RPE(relation, delta, metrics.Unit.frames, all_pairs=mode == "all")
        try:
            rpe.process_data(pair)
        except Exception as error:  # evo refuses where there is no such pair; we leave the metric out and say so
            assert "produced an empty index list" in str(error)
            assert ours.n_pairs_rpe[spec.key] == 0
            assert any("no pair of poses" in line for line in ours.diagnostics)
            assert f"rpe_{spec.key}_{part}_rmse_{ending}" not in ours.metrics
            continue
        assert ours.n_pairs_rpe[spec.key] == len(rpe.error)
        for name, value in rpe.get_all_statistics().items():
            key = f"rpe_{spec.key}_{part}_{name}_{ending}{'2' if name == 'sse' else ''}"
            assert ours.metrics[key] == pytest.approx(value, abs=1e-9, rel=1e-9), key
