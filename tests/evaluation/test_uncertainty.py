"""NEES and coverage of motion covariances, against scipy's matrix exponential and logarithm and simulated errors."""

import re

import numpy as np
import pytest
from scipy.linalg import expm, logm
from scipy.stats import chi2

from dynslam_bench.core import TrajectoryError
from dynslam_bench.evaluation import evaluate
from dynslam_bench.evaluation.uncertainty import (
    CHI2_95,
    CHI2_MEDIAN,
    NO_NOISE,
    PoseNoise,
    motion_uncertainty,
    nees,
    truth_noise,
)
from dynslam_bench.geometry import RepeatedStamps, Trajectory
from dynslam_bench.geometry.motion_covariances import (
    MotionCovariances,
    adjoint,
    check_covariances,
    read_motion_covariances,
    write_motion_covariances,
)

FPS = 10


def twist_matrix(xi):
    """4x4 matrix of a twist, translation first."""
    x, y, z = xi[3:]
    matrix = np.zeros((4, 4))
    matrix[:3, :3] = [[0, -z, y], [z, 0, -x], [-y, x, 0]]
    matrix[:3, 3] = xi[:3]
    return matrix


def exponential(xi):
    return expm(twist_matrix(xi))


def logarithm(pose):
    matrix = np.real(logm(pose))
    return np.array([*matrix[:3, 3], matrix[2, 1], matrix[0, 2], matrix[1, 0]])


def random_covariance(rng, sizes=(0.002, 0.002, 0.004, 0.001, 0.001, 0.0005)):
    root = rng.normal(size=(6, 6)) + 5 * np.eye(6)
    scale = np.diag(sizes)
    return scale @ root @ root.T @ scale / 30


def simulated(count, seed=0, *, truth_sigma=(0.0, 0.0)):
    """A walk whose motions are wrong by draws from their covariances: estimate, covariances, truth."""
    rng = np.random.default_rng(seed)
    true = [np.eye(4)]
    estimated = [np.eye(4)]
    matrices = []
    for _ in range(count - 1):
        motion = exponential(rng.normal(size=6) * [0.02, 0.02, 0.03, 0.02, 0.03, 0.02] + 0.01)
        covariance = random_covariance(rng)
        error = np.linalg.cholesky(covariance) @ rng.normal(size=6)
        true.append(true[-1] @ motion)
        # the true motion is the estimated one times Exp(error)
        estimated.append(estimated[-1] @ motion @ exponential(-error))
        matrices.append(covariance)
    sigma = np.repeat(truth_sigma, 3)
    measured = [pose @ exponential(rng.normal(size=6) * sigma) for pose in true]
    stamps = 1000 + np.arange(count) / FPS
    return (
        Trajectory(stamps, np.array(estimated)),
        MotionCovariances(stamps[1:], np.array(matrices)),
        Trajectory(stamps, np.array(measured)),
    )


def test_scores_are_those_of_an_independent_derivation():
    estimate, covariances, truth = simulated(40)
    metrics = motion_uncertainty(estimate, covariances, truth).metrics

    # one frame by scipy's exponential and logarithm
    single = []
    for k in range(1, 40):
        motion = np.linalg.inv(estimate.T_world_cam[k - 1]) @ estimate.T_world_cam[k]
        true = np.linalg.inv(truth.T_world_cam[k - 1]) @ truth.T_world_cam[k]
        xi = logarithm(np.linalg.inv(motion) @ true)
        single.append(xi @ np.linalg.inv(covariances.matrices[k - 1]) @ xi)
    assert metrics["nees_1f_mean"] == pytest.approx(np.mean(single) / 6, rel=1e-6)
    assert metrics["nees_1f_median"] == pytest.approx(
        np.median(single) / chi2(6).median(), rel=1e-4
    )
    assert metrics["within95_1f"] == pytest.approx(np.mean(np.array(single) < chi2(6).ppf(0.95)))

    # one second, ten frames, by derivatives of the whole motion with respect to each error, taken numerically
    estimate, covariances, truth = simulated(FPS + 3)
    metrics = motion_uncertainty(estimate, covariances, truth).metrics
    seconds = []
    step = 1e-6
    for first in range(3):
        motions = [
            np.linalg.inv(estimate.T_world_cam[k]) @ estimate.T_world_cam[k + 1]
            for k in range(first, first + FPS)
        ]
        whole = np.linalg.multi_dot(motions)
        total = np.zeros((6, 6))
        for at in range(FPS):
            columns = []
            for axis in np.eye(6):
                changed = list(motions)
                changed[at] = motions[at] @ exponential(step * axis)
                columns.append(
                    logarithm(np.linalg.inv(whole) @ np.linalg.multi_dot(changed)) / step
                )
            jacobian = np.array(columns).T
            total += jacobian @ covariances.matrices[first + at] @ jacobian.T
        true = np.linalg.inv(truth.T_world_cam[first]) @ truth.T_world_cam[first + FPS]
        xi = logarithm(np.linalg.inv(whole) @ true)
        seconds.append(xi @ np.linalg.inv(total) @ xi)
    assert metrics["nees_1s_mean"] == pytest.approx(np.mean(seconds) / 6, rel=1e-3)


def test_the_adjoint_transports_a_twist():
    rng = np.random.default_rng(1)
    pose = exponential(rng.normal(size=6))
    xi = rng.normal(size=6) * 0.3
    moved = pose @ exponential(xi) @ np.linalg.inv(pose)
    assert exponential(adjoint(pose) @ xi) == pytest.approx(moved, abs=1e-12)


def test_right_covariances_score_one_and_95_percent():
    metrics = motion_uncertainty(*simulated(1500, seed=2)).metrics
    # six standard errors of a mean of 1500 chi-squares are 0.09
    assert metrics["nees_1f_mean"] == pytest.approx(1, abs=0.09)
    assert metrics["nees_1f_median"] == pytest.approx(1, abs=0.12)
    assert metrics["within95_1f"] == pytest.approx(0.95, abs=0.03)
    # those over a second overlap: there are 150 independent ones
    assert metrics["nees_1s_mean"] == pytest.approx(1, abs=0.3)
    assert metrics["within95_1s"] == pytest.approx(0.95, abs=0.1)
    assert chi2(6).ppf(0.95) == pytest.approx(CHI2_95, abs=1e-3)
    assert chi2(6).median() == pytest.approx(CHI2_MEDIAN, abs=1e-3)


def test_noise_of_the_truth_is_no_error_of_the_tracker():
    noise = PoseNoise(0.003, 0.003)
    walk = simulated(1500, seed=3, truth_sigma=(0.003, 0.003))
    assert motion_uncertainty(*walk).metrics["nees_1f_mean"] > 3
    assert motion_uncertainty(*walk, noise).metrics["nees_1f_mean"] == pytest.approx(1, abs=0.1)
    assert truth_noise("tum/fr1/xyz").rotation_rad > 0
    assert truth_noise("synthetic/walking_xyz?scene=3") == NO_NOISE


@pytest.mark.parametrize("sequence", ["euroc/MH_01_easy", "/home/me/walk", "tum"])
def test_where_the_noise_of_the_truth_is_not_known_the_scores_say_so(sequence):
    assert truth_noise(sequence) is None
    walk = simulated(60)
    scored = motion_uncertainty(*walk, None)
    assert scored.metrics == motion_uncertainty(*walk, NO_NOISE).metrics
    assert scored.warnings == motion_uncertainty(*walk, NO_NOISE).warnings == []
    (line,) = scored.diagnostics
    assert "the errors of the truth, whose noise is not known" in line


@pytest.mark.parametrize("repeated", [[5], [0, 7, 39], [20, 20]])
def test_of_several_true_poses_at_one_stamp_the_last_counts(repeated):
    estimate, covariances, truth = simulated(40)
    expected = motion_uncertainty(estimate, covariances, truth).metrics
    # wrong poses stand before the right ones of the same stamps
    rows = np.sort(np.concatenate([np.arange(40), repeated])).astype(int)
    poses = truth.T_world_cam[rows].copy()
    poses[:-1][np.diff(rows) == 0] = exponential(np.full(6, 0.5))
    several = RepeatedStamps(truth.timestamps[rows], poses)
    assert motion_uncertainty(estimate, covariances, several).metrics == pytest.approx(expected)


def test_covariances_belong_to_stamps_to_the_nanosecond():
    estimate, covariances, truth = simulated(40)
    scored = motion_uncertainty(estimate, covariances, truth)
    assert "over 39 motions" in scored.diagnostics[0]
    later = MotionCovariances(covariances.timestamps + 4e-7, covariances.matrices)
    assert not motion_uncertainty(estimate, later, truth).metrics


@pytest.mark.parametrize("scale", [1.0, 1e-6, 1e6])
def test_covariances_are_checked_by_their_correlations(scale):
    good = random_covariance(np.random.default_rng(5)) * scale
    tilted = good + np.triu(1e-3 * np.sqrt(np.outer(np.diag(good), np.diag(good))), 1)
    checks = check_covariances(np.stack([good, tilted, -good, np.full((6, 6), np.nan)]))
    assert checks.symmetric.tolist()[:2] == [True, False]
    assert checks.positive.tolist() == [True, True, False, False]
    assert checks.finite.tolist() == [True, True, True, False]


def test_a_walk_that_is_interrupted_is_scored_where_covariances_are():
    estimate, covariances, truth = simulated(60)
    kept = np.arange(59) != 30
    some = MotionCovariances(covariances.timestamps[kept], covariances.matrices[kept])
    scored = motion_uncertainty(estimate, some, truth)
    assert "over 58 motions" in scored.diagnostics[0].replace("NEES ", "")
    # 50 spans of a second, ten of which hold the motion
    assert "40 over one second" in scored.diagnostics[0]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda c: 0 * c, "not positive definite"),
        (lambda c: -c, "not positive definite"),
        (lambda c: c * np.nan, "none of 6x6 numbers"),
        (lambda c: np.where(np.eye(6) > 0, np.inf, c), "NaN or infinite"),
        (lambda c: c + np.triu(np.full((6, 6), 1e-3), 1), "not symmetric|not positive"),
        (
            lambda c: c + np.triu(1e-3 * np.sqrt(np.outer(np.diag(c), np.diag(c))), 1),
            "not symmetric",
        ),
    ],
    ids=["zeros", "negative", "nan", "infinite", "far from symmetric", "not symmetric"],
)
def test_what_is_no_covariance_is_counted_and_not_scored(change, words):
    estimate, covariances, truth = simulated(30)
    bad = covariances.matrices.copy()
    bad[:5] = [change(matrix) for matrix in bad[:5]]
    scored = motion_uncertainty(estimate, MotionCovariances(covariances.timestamps, bad), truth)
    (warning,) = scored.warnings
    assert warning.startswith("5 of 29 motions have a" if "none" not in words else "5 of 29")
    assert re.search(words, warning)
    rest = MotionCovariances(covariances.timestamps[5:], covariances.matrices[5:])
    expected = motion_uncertainty(estimate, rest, truth).metrics
    assert scored.metrics == pytest.approx(expected)

    # all of them: nothing to score, and no exception
    every = MotionCovariances(
        covariances.timestamps, np.array([change(matrix) for matrix in covariances.matrices])
    )
    nothing = motion_uncertainty(estimate, every, truth)
    assert not nothing.metrics
    assert len(nothing.warnings) == 1


@pytest.mark.parametrize(
    ("units", "words"),
    [
        ([1e3, 1e3], "translation .*as in millimetres"),
        ([1, 180 / np.pi], "right; standard deviations of rotation .*as in degrees"),
        ([1, 1], None),
        ([1e3, 180 / np.pi], "as in millimetres.*as in degrees"),
        ([1e6, 1e6], "translation are 1.*e\\+06 x|translation are 9.*e\\+05 x"),
        ([1e-3, 1e-3], "NEES / 6 is .*e\\+0[56]"),
        ([1e-150, 1e-150], "NEES / 6 is"),
        ([1e150, 1e150], "NEES / 6 is"),
    ],
)
def test_other_units_are_named_by_their_nees(units, words):
    estimate, covariances, truth = simulated(200)
    scale = np.diag(np.repeat(np.array(units, dtype=float), 3))
    changed = MotionCovariances(covariances.timestamps, scale @ covariances.matrices @ scale)
    scored = motion_uncertainty(estimate, changed, truth)
    assert np.isfinite(list(scored.metrics.values())).all()
    if words is None:
        assert not scored.warnings
        return
    (warning,) = scored.warnings
    assert re.search(words, warning), warning


def test_nees_of_any_size_of_units():
    rng = np.random.default_rng(4)
    covariance = random_covariance(rng, (1e3, 1e3, 1e3, 1e-9, 1e-9, 1e-9))
    xi = np.linalg.cholesky(covariance) @ np.array([1.0, 0, 0, 2.0, 0, 0])
    assert nees(xi[None], covariance[None]) == pytest.approx([5.0])


def test_evaluations_hold_the_scores_of_poses_in_metres():
    estimate, covariances, truth = simulated(60)
    with_scores = evaluate(estimate, truth, motion_covariances=covariances)
    assert with_scores.metrics["nees_1f_mean"] > 0
    assert any("NEES over 59 motions" in line for line in with_scores.diagnostics)
    without = evaluate(estimate, truth)
    assert without.metrics == {
        name: value
        for name, value in with_scores.metrics.items()
        if not name.startswith(("nees", "within95"))
    }
    scaled = evaluate(estimate, truth, "droid-w/v1", motion_covariances=covariances)
    assert "nees_1f_mean" not in scaled.metrics


def test_a_file_gives_the_covariances_back(tmp_path):
    _, covariances, _ = simulated(5)
    covariances.matrices[1] = np.nan
    path = tmp_path / "covariances.txt"
    write_motion_covariances(path, covariances)
    back = read_motion_covariances(path)
    assert back.timestamps == pytest.approx(covariances.timestamps)
    assert back.matrices == pytest.approx(covariances.matrices, rel=1e-5, nan_ok=True)
    path.write_text("1.0 2.0 3.0\n")
    with pytest.raises(TrajectoryError, match="has 3 values, not the 37"):
        read_motion_covariances(path)
