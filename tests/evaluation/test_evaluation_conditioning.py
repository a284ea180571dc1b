"""Rotational errors on almost straight paths: a warning there, none on ordinary paths with ordinary errors."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from dynslam_bench.evaluation.alignment import RELIABLE_DEG, align
from dynslam_bench.evaluation.evaluate import Evaluation, evaluate
from dynslam_bench.geometry import se3
from dynslam_bench.geometry.trajectory import Trajectory
from dynslam_bench.geometry.trajectory_files import read_tum

SHARED = Path(__file__).resolve().parents[3] / "shared" / "data"


def straight(side_m: float, frames: int = 300) -> np.ndarray:
    """Poses ``[N, 4, 4]`` along 1.5 m of a line that swings to the sides by so much."""
    poses = np.tile(np.eye(4), (frames, 1, 1))
    u = np.linspace(0, 1, frames)
    poses[:, :3, 3] = np.stack([1.5 * u, side_m * np.sin(6 * u), side_m * np.cos(4 * u)], axis=1)
    return poses


def disturbed(poses: np.ndarray, sigma_m: float, seed: int, frames: float = 20.0) -> np.ndarray:
    """Errors that last for so many frames: a first-order autoregression; orientations are off by 0.5 degrees."""
    rng = np.random.default_rng(seed)
    keep = np.exp(-1 / frames)
    errors = np.zeros((len(poses), 6))
    for row in range(1, len(poses)):
        errors[row] = keep * errors[row - 1] + np.sqrt(1 - keep**2) * rng.normal(size=6)
    errors *= [sigma_m] * 3 + [np.deg2rad(0.5)] * 3
    return np.array([pose @ se3.exp(error) for pose, error in zip(poses, errors, strict=True)])


def judged(truth: np.ndarray, estimate: np.ndarray) -> Evaluation:
    stamps = np.arange(len(truth)) / 30.0
    return evaluate(Trajectory(stamps, estimate), Trajectory(stamps, truth))


@pytest.mark.parametrize("sigma_m", [0.003, 0.03])
def test_a_straight_path_gives_the_warning(sigma_m: float) -> None:
    found = [judged(truth, disturbed(truth, sigma_m, seed)) for seed in range(12) for truth in [straight(0.001)]]
    wrong = [each for each in found if each.metrics["ape_rot_rmse_deg"] > 15]
    assert len(wrong) >= 6, "the case is there"
    for each in wrong:
        assert each.alignment.uncertainty_deg > RELIABLE_DEG
        assert any("ape_rot) is unreliable" in line for line in each.diagnostics)
        assert each.metrics["ate_rmse_m"] < 3 * sigma_m, "while the positions fit"


def path_of(name: str) -> np.ndarray:
    file = SHARED / name / "groundtruth.txt"
    if not file.is_file():
        pytest.skip(f"{file} is not here")
    poses = read_tum(file).T_world_cam
    return poses[:: max(1, len(poses) // 300)]


@pytest.mark.parametrize(
    ("name", "sigma_m"),
    [
        ("tum/rgbd_dataset_freiburg1_xyz", 0.002),
        ("bonn/rgbd_bonn_crowd", 0.003),
        ("synthetic/walking_xyz?scene=100-3f02d1f6", 0.01),
        ("synthetic/walking_halfsphere?scene=100-3f02d1f6", 0.02),
    ],
)
def test_ordinary_paths_do_not(name: str, sigma_m: float) -> None:
    truth = path_of(name)
    for seed in range(6):
        found = judged(truth, disturbed(truth, sigma_m, seed))
        assert found.alignment.uncertainty_deg <= RELIABLE_DEG
        assert not any("unreliable" in line for line in found.diagnostics)
        assert found.metrics["ape_rot_rmse_deg"] < 10


def test_the_uncertainty_is_that_of_repetition() -> None:
    """Where errors are small, it is the spread of the rotations that independent errors give."""
    truth = straight(0.1)
    fits = [align(disturbed(truth, 0.005, seed, frames=1.0), truth, "se3") for seed in range(40)]
    turned = se3.with_rotation(np.tile(np.eye(4), (len(fits), 1, 1)), np.array([fit.rotation for fit in fits]))
    spread = np.sqrt((np.rad2deg(se3.rotation_angle(turned)) ** 2).mean())
    assert 0.6 * spread < np.median([fit.uncertainty_deg for fit in fits]) < 1.8 * spread


def test_an_exact_estimate_and_a_short_one() -> None:
    assert align(straight(0.05), straight(0.05), "se3").uncertainty_deg == pytest.approx(0.0, abs=1e-5)
    assert align(straight(0.05, 23), straight(0.05, 23), "se3").uncertainty_deg == pytest.approx(0.0, abs=1e-5)
    assert align(straight(0.05, 2), straight(0.05, 2), "se3").uncertainty_deg is None
    assert align(straight(0.05), straight(0.05), "origin").uncertainty_deg is None
