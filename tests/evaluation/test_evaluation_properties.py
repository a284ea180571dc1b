"""What must hold whatever the numbers: invariances, statistics, policies, holes, and clear refusals."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from evaluation_walks import moved, noisy, turned, walk

from dynslam_bench.core.errors import EvaluationError, TrajectoryError
from dynslam_bench.evaluation import (
    PROTOCOLS,
    OnlineError,
    Protocol,
    RPESpec,
    compare_masks,
    compare_protocols,
    evaluate,
    evaluate_files,
    get_protocol,
    hints,
    hold,
    pose_errors,
    static_camera,
)
from dynslam_bench.evaluation.alignment import RELIABLE_DEG, align
from dynslam_bench.evaluation.ape import ate_rmse_m
from dynslam_bench.evaluation.comparison import nearest_match
from dynslam_bench.evaluation.evaluate import Evaluation
from dynslam_bench.evaluation.rpe import segment_errors
from dynslam_bench.geometry import se3
from dynslam_bench.geometry.rigs import (
    BONN_R_BODY_CAM,
    BONN_T_M,
    BONN_T_ROS,
    bonn_as_droid_w,
    bonn_camera,
    in_camera_axes,
    nearest_rotation,
)
from dynslam_bench.geometry.trajectory import Trajectory
from dynslam_bench.geometry.trajectory_files import load_tum, read_tum, write_kitti, write_tum

TRUTH = walk()
ESTIMATE = noisy(TRUTH)


def close(a, b, tolerance=1e-9):
    assert a.keys() == b.keys()
    for key in a:
        assert a[key] == pytest.approx(b[key], abs=tolerance, rel=1e-7), key


@pytest.mark.parametrize("name", sorted(PROTOCOLS))
def test_a_perfect_estimate_scores_zero(name):
    perfect = TRUTH
    corrected = {"bonn-camera": bonn_camera, "bonn-droid-w": bonn_as_droid_w}.get(get_protocol(name).truth)
    if corrected is not None:
        perfect = Trajectory(TRUTH.timestamps, corrected(TRUTH.T_world_cam))
    metrics = evaluate(perfect, TRUTH, name).metrics
    assert all(abs(v) < 1e-6 for k, v in metrics.items() if not k.startswith("static_camera"))
    assert metrics["static_camera_ate_rmse_m"] > 0.05


@pytest.mark.parametrize("name", ["tum-rgbd/v1", "tum-rgbd/v1-random-pairs", "vslam-lab", "kitti"])
def test_the_world_frame_of_the_estimate_does_not_matter(name):
    truth, seed = walk(), 5
    close(evaluate(ESTIMATE, truth, name).metrics, evaluate(turned(ESTIMATE, seed), truth, name).metrics)


def test_yaw_alignment_undoes_a_turn_about_z_and_nothing_else():
    about_z = se3.exp(np.array([1.0, -2.0, 0.5, 0, 0, 0])) @ se3.exp(np.array([0, 0, 0, 0, 0, 1.2]))
    protocol = Protocol(id="x", alignment="yaw")
    assert evaluate(moved(TRUTH, about_z), TRUTH, protocol).metrics["ate_rmse_m"] == pytest.approx(0, abs=1e-9)
    tilted = moved(TRUTH, se3.exp(np.array([0, 0, 0, 0.3, 0, 0])))
    assert evaluate(tilted, TRUTH, protocol).metrics["ate_rmse_m"] > 0.01


@pytest.mark.parametrize("mode", ["se3", "sim3", "yaw"])
def test_alignment_is_a_minimum(mode):
    estimate = turned(noisy(TRUTH, size=0.05), 2)
    best = align(estimate.T_world_cam, TRUTH.T_world_cam, mode)

    def cost(similarity_poses):
        return ((similarity_poses[:, :3, 3] - TRUTH.positions) ** 2).sum()

    reached = cost(best.apply(estimate.T_world_cam))
    rng = np.random.default_rng(0)
    for _ in range(50):
        twist = rng.normal(0, 0.01, 6)
        if mode == "yaw":
            twist[3:5] = 0
        assert cost(se3.exp(twist) @ best.apply(estimate.T_world_cam)) >= reached


# -- static camera


@pytest.mark.parametrize(("alignment", "fit"), [("se3", "constant"), ("sim3", "constant"), ("origin", "first")])
def test_static_camera_equals_the_evaluation_of_a_camera_that_does_not_move(alignment, fit):
    still = Trajectory(TRUTH.timestamps, np.tile(se3.exp(np.ones(6)), (len(TRUTH), 1, 1)))
    expected = static_camera(TRUTH)
    result = evaluate(still, TRUTH, Protocol(id="x", alignment=alignment))
    assert result.alignment.degenerate == (alignment != "origin")
    assert result.metrics["ate_rmse_m"] == pytest.approx(expected[f"{fit}_rmse_m"], abs=1e-9)
    assert result.metrics["static_camera_ate_rmse_m"] == pytest.approx(expected[f"{fit}_rmse_m"], abs=1e-12)
    assert expected["first_rmse_m"] > expected["constant_rmse_m"]


def test_false_motion_is_what_the_estimate_of_a_fixed_camera_moves():
    """Its numbers by hand, whatever the world frame; none where the camera moves or turns, or the scale is fitted."""
    truth = Trajectory(np.arange(5) / 10, np.tile(se3.exp(np.ones(6)), (5, 1, 1)))
    poses = np.tile(np.eye(4), (5, 1, 1))
    poses[:, :2, 3] = [[0, 0], [0.3, 0], [0.3, 0.4], [0, 0.4], [0, 0]]
    there_and_back = Trajectory(truth.timestamps, se3.exp(np.full(6, 0.7)) @ poses)
    result = evaluate(there_and_back, truth)
    assert result.metrics["false_motion_path_m"] == pytest.approx(1.4)
    assert result.metrics["false_motion_max_m"] == pytest.approx(0.5)
    spread = np.linalg.norm(poses[:, :3, 3].std(axis=0))
    assert result.metrics["ate_rmse_m"] == pytest.approx(spread) and result.metrics["static_camera_ate_rmse_m"] == 0.0
    never = evaluate(truth, truth).metrics
    assert (never["false_motion_path_m"], never["false_motion_max_m"], never["ate_rmse_m"]) == (0.0, 0.0, 0.0)
    turning = truth.T_world_cam @ np.stack([se3.exp(np.array([0, 0, 0, 0, 0.01 * i, 0])) for i in range(5)])
    for other, protocol in ((truth.with_poses(turning), "tum-rgbd/v1"), (truth, "tum-rgbd/v1-sim3")):
        assert "false_motion_max_m" not in evaluate(there_and_back, other, protocol).metrics
    assert "false_motion_max_m" not in evaluate(TRUTH, TRUTH).metrics


def test_motion_on_a_line_is_aligned_to_the_minimum_and_the_roll_comes_from_the_orientations():
    n = 60
    poses = np.tile(np.eye(4), (n, 1, 1))
    poses[:, 0, 3] = np.linspace(0, 3, n)
    truth = Trajectory(np.arange(n) / 30, poses)
    result = evaluate(turned(truth, 3), truth)
    assert result.alignment.degenerate
    assert result.metrics["ate_rmse_m"] == pytest.approx(0, abs=1e-6)
    assert result.metrics["ape_rot_rmse_deg"] == pytest.approx(0, abs=1e-4)


# -- holes, coverage, policies


def test_a_hole_in_the_ground_truth_is_measured_and_named():
    truth = walk(n=300)
    result = evaluate(noisy(truth), truth.select(np.r_[0:100, 160:300]))
    assert result.n_pairs == 240
    assert (result.association.in_holes, result.association.outside, result.association.taken) == (60, 0, 0)
    assert result.association.largest_hole_s == pytest.approx(61 / 30, abs=1e-5)
    assert any("60 of 300 poses" in line for line in result.diagnostics)


def test_poses_outside_and_doubly_claimed_are_told_apart():
    truth = walk(n=100)
    assert evaluate(noisy(truth), truth.select(slice(0, 80))).association.outside == 20
    claimed = evaluate(noisy(truth), truth.select(slice(0, None, 2)), Protocol(id="x", max_dt=0.05))
    assert claimed.n_pairs == 50
    assert claimed.association.taken == 50


@pytest.mark.parametrize("strict", [True, False])
def test_the_tolerance_of_the_nearest_match_is_strict_or_not(strict):
    matched, _ = nearest_match(np.array([0.0]), np.array([0.5]), 0.5, strict=strict)
    assert len(matched) == (not strict)


def test_coverage_counts_input_frames():
    truth = walk(n=100)
    tracked = noisy(truth).select(np.r_[0:40, 60:100])
    result = evaluate(tracked, truth, input_timestamps=truth.timestamps)
    assert (result.n_input, result.n_tracked, result.coverage) == (100, 80, pytest.approx(0.8))
    assert "80.0 % of 100 frames tracked" in result.summary()
    assert evaluate(tracked, truth).coverage is None


def test_lost_frame_policies():
    truth = walk(n=100)
    tracked = truth.select(np.r_[0:40, 60:100])
    excluded = evaluate(tracked, truth, input_timestamps=truth.timestamps)
    assert excluded.metrics["ate_rmse_m"] == pytest.approx(0, abs=1e-9)
    held_protocol = get_protocol("tum-rgbd/v1").model_copy(update={"id": "held", "lost_frames": "hold"})
    held = evaluate(tracked, truth, held_protocol, input_timestamps=truth.timestamps)
    assert held.n_pairs == 100
    assert held.coverage == pytest.approx(0.8)
    frozen = truth.T_world_cam.copy()
    frozen[40:60] = frozen[39]
    close(held.metrics, evaluate(Trajectory(truth.timestamps, frozen), truth).metrics)
    with pytest.raises(EvaluationError, match="needs the stamps of the input frames"):
        evaluate(tracked, truth, held_protocol)


@pytest.mark.parametrize("name", ["tum-rgbd/v1", "evo-default", "vslam-lab"])
def test_the_ate_alone_is_the_number_of_the_whole_evaluation(name):
    truth = walk(n=100)
    estimate = noisy(truth).select(np.r_[0:40, 52:100])
    errors = []
    for policy, stamps in (("exclude", None), ("hold", truth.timestamps)):
        protocol = get_protocol(name).model_copy(update={"lost_frames": policy})
        errors.append(ate_rmse_m(estimate, truth, protocol, held_at=stamps))
        whole = evaluate(estimate, truth, protocol, input_timestamps=truth.timestamps).metrics["ate_rmse_m"]
        assert errors[-1] == pytest.approx(whole, rel=1e-12)
    assert errors[1] > errors[0], "holding still costs"
    with pytest.raises(EvaluationError, match="only 1 of 1"):
        ate_rmse_m(estimate.select(slice(0, 1)), truth, get_protocol("tum-rgbd/v1"))


def test_frames_lost_before_the_first_tracked_one_take_its_pose():
    truth = walk(n=10)
    held = hold(truth.select(slice(3, 5)), truth.timestamps)
    assert np.array_equal(held.T_world_cam[:4], np.repeat(truth.T_world_cam[3:4], 4, axis=0))
    assert np.array_equal(held.T_world_cam[4:], np.repeat(truth.T_world_cam[4:5], 6, axis=0))


def test_foreign_stamps_are_refused_with_their_count():
    truth = walk(n=20)
    shifted = Trajectory(truth.timestamps + 0.4, truth.T_world_cam)
    with pytest.raises(EvaluationError, match="12 of 20 estimated poses belong to none of 20 input frames"):
        evaluate(shifted, truth, input_timestamps=truth.timestamps)


def test_stamps_of_the_depth_images_count_for_their_frames():
    truth = walk(n=30)
    tracked = Trajectory(truth.timestamps + 0.011, truth.T_world_cam).select(np.r_[0:10, 20:30])
    assert evaluate(tracked, truth, input_timestamps=truth.timestamps).coverage == pytest.approx(20 / 30)


# -- refusals


def test_nothing_in_common_names_the_measured_gap():
    with pytest.raises(
        EvaluationError, match=r"none of 200 poses has ground truth within 0\.02 s: the nearest is 93\."
    ) as e:
        evaluate(Trajectory(TRUTH.timestamps + 100, TRUTH.T_world_cam), TRUTH)
    assert "\n" not in str(e.value)
    with pytest.raises(EvaluationError, match="nanoseconds"):
        evaluate(Trajectory(TRUTH.timestamps * 1e9, TRUTH.T_world_cam), TRUTH)


EMPTY = Trajectory(np.zeros(0), np.zeros((0, 4, 4)))


@pytest.mark.parametrize(
    ("estimate", "truth", "named"),
    [
        (walk().select(slice(0, 1)), walk(), "only 1 of 1 poses"),
        (EMPTY, walk(), "the estimate holds no poses"),
        (walk(), EMPTY, "the ground truth holds no poses"),
    ],
)
def test_too_few_and_empty(estimate, truth, named):
    with pytest.raises(EvaluationError, match=named):
        evaluate(estimate, truth)
    with pytest.raises(EvaluationError, match="no frame was tracked"):
        hold(EMPTY, walk().timestamps)


def test_a_short_trajectory_leaves_out_what_is_not_defined():
    truth = walk(n=20)  # 0.63 s
    result = evaluate(noisy(truth), truth)
    assert result.n_pairs_rpe["1s"] == 0
    assert "rpe_1s_trans_rmse_m" not in result.metrics
    assert "rpe_1f_trans_rmse_m" in result.metrics
    assert "no pair of poses for the relative error over 1s; it is left out" in result.diagnostics


# -- files


def test_files_and_their_notes(tmp_path):
    write_tum(tmp_path / "gt.txt", walk())
    write_tum(tmp_path / "est.txt", noisy(walk()))
    with (tmp_path / "est.txt").open("a") as file:
        file.write("1311868000.0 nan 0 0 0 0 0 1\n")
    result = evaluate_files(tmp_path / "est.txt", tmp_path / "gt.txt")
    assert "estimate: 1 of 201 lines skipped: not finite" in result.diagnostics
    assert result.metrics["ate_rmse_m"] == pytest.approx(
        evaluate(noisy(walk()), walk()).metrics["ate_rmse_m"], abs=1e-6
    )


def test_pose_errors_series_gives_the_ate():
    estimate = turned(noisy(TRUTH), 3)
    aligned, true, series = pose_errors(estimate, TRUTH)
    assert np.sqrt((series["trans_m"] ** 2).mean()) == pytest.approx(evaluate(estimate, TRUTH).metrics["ate_rmse_m"])
    assert np.allclose(np.linalg.norm(aligned.positions - true.positions, axis=1), series["trans_m"])
    assert len(series["rot_deg"]) == len(TRUTH)


# -- KITTI


def test_kitti_segments_of_a_constant_drift():
    n = 2001
    true, estimated = np.tile(np.eye(4), (n, 1, 1)), np.tile(np.eye(4), (n, 1, 1))
    true[:, 2, 3] = np.arange(n) * 0.5  # 1000 m straight ahead
    estimated[:, 2, 3] = np.arange(n) * 0.5 * 1.02
    translation, rotation = segment_errors(estimated, true, (100, 200, 800))
    assert np.allclose(translation, 2.0, atol=0.02)  # a segment ends one pose behind its length
    assert np.allclose(rotation, 0, atol=1e-9)
    expected = sum(len([s for s in range(0, n, 10) if s + length / 0.5 + 1 < n]) for length in (100, 200, 800))
    assert len(translation) == expected
    result = evaluate(Trajectory(np.arange(n) / 10, estimated), Trajectory(np.arange(n) / 10, true), "kitti")
    assert result.metrics["kitti_trans_percent"] == pytest.approx(2.0, abs=0.02)
    assert result.metrics["kitti_rot_deg_per_m"] == pytest.approx(0, abs=1e-9)


def test_kitti_says_when_the_path_is_too_short():
    result = evaluate(noisy(walk()), walk(), "kitti")
    assert "kitti_trans_percent" not in result.metrics
    assert any("shorter than a segment of 100 m" in line for line in result.diagnostics)


# -- masks


def test_mask_counts():
    predicted = np.zeros((4, 5), dtype=bool)
    truth = np.zeros((4, 5), dtype=bool)
    predicted[:2], truth[1:3] = True, True
    counts = compare_masks(predicted, truth)
    assert (counts.true_positive, counts.false_positive, counts.false_negative, counts.true_negative) == (5, 5, 5, 5)
    assert (counts.iou, counts.precision, counts.recall) == (pytest.approx(1 / 3), 0.5, 0.5)
    total = counts + compare_masks(truth, truth)
    assert total.true_positive == 15
    assert total.iou == pytest.approx(15 / 25)


def test_masks_without_anything_are_not_scored_and_shapes_must_agree():
    nothing = np.zeros((3, 3), dtype=bool)
    counts = compare_masks(nothing, nothing)
    assert (counts.iou, counts.precision, counts.recall) == (None, None, None)
    with pytest.raises(EvaluationError, match=r"\(3, 3\) and \(2, 3\)"):
        compare_masks(nothing, nothing[:2])


# Rotational errors on almost straight paths: a warning there, none on ordinary paths with ordinary errors.


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


@pytest.mark.parametrize("frames", [300, 20])
def test_the_uncertainty_is_that_of_repetition(frames: int) -> None:
    """Where errors are small, it is the spread of the rotations that independent errors give; of short paths, too."""
    truth = straight(0.1, frames)
    fits = [align(disturbed(truth, 0.005, seed, frames=0.5), truth, "se3") for seed in range(40)]
    turned = se3.with_rotation(np.tile(np.eye(4), (len(fits), 1, 1)), np.array([fit.rotation for fit in fits]))
    spread = np.sqrt((np.rad2deg(se3.rotation_angle(turned)) ** 2).mean())
    assert 0.6 * spread < np.median([fit.uncertainty_deg for fit in fits]) < 1.8 * spread


def test_an_exact_estimate_and_a_short_one() -> None:
    assert align(straight(0.05), straight(0.05), "se3").uncertainty_deg == pytest.approx(0.0, abs=1e-5)
    assert align(straight(0.05, 23), straight(0.05, 23), "se3").uncertainty_deg == pytest.approx(0.0, abs=1e-5)
    assert align(straight(0.05, 2), straight(0.05, 2), "se3").uncertainty_deg is None
    assert align(straight(0.05), straight(0.05), "origin").uncertainty_deg is None


# The causal pose error: joined at the first frame with both, honest about holes, and quitting never pays.


def estimate_of(truth, seed=1):
    rng = np.random.default_rng(seed)
    return se3.exp(rng.normal(size=6)) @ (truth.T_world_cam @ se3.exp(rng.normal(0, 0.01, (len(truth), 6))))


SHORT = walk(n=60)
POSES = estimate_of(SHORT)


def run(error, truth, poses, ok):
    return [error.update(t, p if o else None) for t, p, o in zip(truth.timestamps, poses, ok, strict=True)]


def test_cumulative_error_is_the_origin_aligned_ape():
    samples = run(OnlineError(SHORT), SHORT, POSES, [True] * len(SHORT))
    result = evaluate(Trajectory(SHORT.timestamps, POSES), SHORT, Protocol(id="x", alignment="origin"))
    assert np.sqrt(np.mean([s.trans_m**2 for s in samples])) == pytest.approx(result.metrics["ate_rmse_m"], abs=1e-12)
    assert max(s.rot_deg for s in samples) == pytest.approx(result.metrics["ape_rot_max_deg"], abs=1e-9)
    assert samples[0].trans_m == pytest.approx(0, abs=1e-12)
    assert samples[0].frame_trans_m is None


def test_frame_to_frame_error_is_eq_26_over_one_frame():
    samples = run(OnlineError(SHORT), SHORT, POSES, [True] * len(SHORT))
    protocol = Protocol(id="x", rpe=(RPESpec(delta=1, unit="f", pairs="all"),))
    metrics = evaluate(Trajectory(SHORT.timestamps, POSES), SHORT, protocol).metrics
    frame = np.array([s.frame_trans_m for s in samples[1:]])
    assert np.sqrt((frame**2).mean()) == pytest.approx(metrics["rpe_1f_trans_rmse_m"], abs=1e-12)
    rotation = np.array([s.frame_rot_deg for s in samples[1:]])
    assert rotation.max() == pytest.approx(metrics["rpe_1f_rot_max_deg"], abs=1e-9)


def test_a_lost_frame_counts_as_the_last_tracked_pose_repeated():
    ok = np.ones(len(SHORT), dtype=bool)
    ok[20:30] = False
    samples = run(OnlineError(SHORT), SHORT, POSES, ok)
    way = np.linalg.norm((se3.inverse(SHORT.T_world_cam[:-1]) @ SHORT.T_world_cam[1:])[:, :3, 3], axis=1)
    for i in range(20, 30):
        assert samples[i].frame_trans_m == pytest.approx(way[i - 1], abs=1e-12)
    assert [s.lost_way_m for s in samples[19:32]] == pytest.approx([0, *np.cumsum(way[19:29]), way[19:29].sum(), 0])
    held = hold(Trajectory(SHORT.timestamps, POSES).select(ok), SHORT.timestamps)
    expected = run(OnlineError(SHORT), SHORT, held.T_world_cam, [True] * len(SHORT))
    assert [s.trans_m for s in samples] == pytest.approx([s.trans_m for s in expected], abs=1e-12)
    jumps = [[s.frame_trans_m for s in found[1:]] for found in (samples, expected)]
    assert jumps[0] == pytest.approx(jumps[1], abs=1e-12)


def test_a_predicted_pose_of_a_lost_frame_counts_for_nothing():
    ok = np.arange(len(SHORT)) < 25
    without = [pose if good else None for pose, good in zip(POSES, ok, strict=True)]
    assert run(OnlineError(SHORT), SHORT, POSES, ok) == run(OnlineError(SHORT), SHORT, without, ok)


def test_a_tracker_that_never_starts_stands_at_the_first_true_pose():
    samples = run(OnlineError(SHORT), SHORT, [None] * len(SHORT), [False] * len(SHORT))
    way = np.linalg.norm(SHORT.positions - SHORT.positions[0], axis=1)
    assert [s.trans_m for s in samples] == pytest.approx(way.tolist(), abs=1e-12)


def test_joined_at_the_first_frame_that_has_both():
    samples = run(OnlineError(SHORT), SHORT, POSES, np.arange(len(SHORT)) >= 5)
    assert samples[5].trans_m == pytest.approx(0, abs=1e-12)
    joined = run(OnlineError(SHORT.select(slice(10, None))), SHORT, POSES, [True] * len(SHORT))
    assert joined[:10] == [None] * 10
    assert joined[10].trans_m == pytest.approx(0, abs=1e-12)
    assert joined[10].frame_trans_m is None
    assert joined[11].frame_trans_m is not None


def test_holes_give_none_and_the_pose_goes_on():
    hole = SHORT.select(np.r_[0:20, 30 : len(SHORT)])
    whole = run(OnlineError(SHORT), SHORT, POSES, [True] * len(SHORT))
    samples = run(OnlineError(hole), SHORT, POSES, [True] * len(SHORT))
    assert samples[20:30] == [None] * 10
    assert samples[30].frame_trans_m is None
    assert samples[30].trans_m == pytest.approx(whole[30].trans_m, abs=1e-12)
    assert replace(samples[31], way_m=0.0) == replace(whole[31], way_m=0.0)


def test_the_true_way_goes_straight_across_holes():
    seen = np.r_[0:20, 30 : len(SHORT)]
    samples = run(OnlineError(SHORT.select(seen)), SHORT, estimate_of(SHORT), [True] * len(SHORT))
    steps = np.linalg.norm(np.diff(SHORT.positions[seen], axis=0), axis=1)
    ways = [samples[index].way_m for index in seen]
    assert ways == pytest.approx([0.0, *np.cumsum(steps)], abs=1e-12)
    assert ways[-1] < run(OnlineError(SHORT), SHORT, estimate_of(SHORT), [True] * len(SHORT))[-1].way_m


def test_without_ground_truth_there_is_no_error():
    truth = walk(n=5)
    for ground_truth in (None, truth.select(slice(0, 0))):
        assert run(OnlineError(ground_truth), truth, truth.T_world_cam, [True] * 5) == [None] * 5


def test_causal_and_repeatable():
    whole = run(OnlineError(SHORT), SHORT, POSES, [True] * len(SHORT))
    other = POSES.copy()
    other[30:] = np.eye(4)
    assert run(OnlineError(SHORT), SHORT, other, [True] * len(SHORT))[:30] == whole[:30]


def test_the_tolerance_is_strict():
    truth = Trajectory(np.array([0.0, 1.0]), np.tile(np.eye(4), (2, 1, 1)))
    assert OnlineError(truth, max_dt=0.5).update(0.5, np.eye(4)) is None
    assert OnlineError(truth, max_dt=0.5).update(0.499, np.eye(4)) is not None


TRAJECTORIES = Path(__file__).resolve().parents[3] / "shared" / "data" / "trajectories"
FR3 = "rgbd-vo/rgbd_dataset_freiburg3_"


def hand_held(frames=240, rate=30.0, seed=0, noise_m=0.0):
    """A camera that moves along and turns about all axes, as a hand does."""
    rng = np.random.default_rng(seed)
    t = np.arange(frames) / rate
    size = np.repeat([0.15, 0.12], 3)
    twists = sum(
        size / (k + 1) * np.sin(np.outer(t, rng.uniform(1, 2, 6) * (k + 1)) + rng.uniform(0, 6, 6)) for k in range(3)
    )
    poses = se3.exp(rng.normal(size=6)) @ se3.exp(twists)
    poses[:, :3, 3] += rng.normal(0, 1, (frames, 3)) * noise_m
    return Trajectory(np.round(1e9 + t, 6), poses)


def tracked(truth, seed=1, drift=0.01, jitter=5e-4, every=1):
    rng = np.random.default_rng(seed)
    steps = se3.inverse(truth.T_world_cam[:-1]) @ truth.T_world_cam[1:]
    size = np.linalg.norm(se3.log(steps), axis=1, keepdims=True)
    poses = [np.eye(4)]
    for step in steps @ se3.exp(rng.normal(size=(len(steps), 6)) * drift * size):
        poses.append(poses[-1] @ step)
    estimate = Trajectory(truth.timestamps, np.array(poses) @ se3.exp(rng.normal(0, jitter, (len(truth), 6))))
    return estimate.select(slice(None, None, every))


def ids(estimate, truth, *arguments, **options):
    return [hint.id for hint in hints(estimate, truth, *arguments, **options)]


def posed(trajectory, poses):
    return Trajectory(trajectory.timestamps, poses)


def scaled(trajectory, factor):
    poses = trajectory.T_world_cam.copy()
    poses[:, :3, 3] *= factor
    return posed(trajectory, poses)


def w_first(trajectory):
    position, quaternion = se3.to_quaternion(trajectory.T_world_cam)
    return posed(trajectory, se3.from_quaternion(position, np.roll(quaternion, 1, axis=1)))


HAND_HELD = hand_held()
TRACKED = tracked(HAND_HELD)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize(("drift", "jitter"), [(0.0, 3e-4), (0.01, 5e-4), (0.05, 2e-3)])
def test_healthy_estimates_get_none(seed, drift, jitter):
    truth = hand_held(seed=seed)
    assert ids(tracked(truth, seed, drift, jitter), truth) == []


def test_estimates_of_every_length_are_taken():
    for frames in (1, 2, 7, 8, 9, 12, 20):
        truth = hand_held(max(frames, 2)).select(slice(0, frames))
        assert ids(tracked(truth), truth) == []


@pytest.mark.parametrize("seconds", [-1, -0.2, -0.05, 0.05, 0.2, 1])
@pytest.mark.parametrize("every", [1, 3])
def test_time_shifts_are_measured(seconds, every):
    estimate = tracked(HAND_HELD, every=every)
    (hint,) = hints(Trajectory(estimate.timestamps + seconds, estimate.T_world_cam), HAND_HELD)
    assert hint.id == "time-shift"
    assert hint.numbers["shift_s"] == pytest.approx(-seconds, abs=0.01)
    assert hint.numbers["error_undone_m"] < 0.5 * hint.numbers["error_m"]


@pytest.mark.parametrize("factor", [1000, 100, 5, 1.5, 0.8, 0.2, 0.001])
def test_scales_are_measured(factor):
    (hint,) = hints(scaled(TRACKED, factor), HAND_HELD)
    assert hint.id == "scale" and hint.numbers["scale"] == pytest.approx(1 / factor, rel=0.05)
    assert ("millimetres" in hint.text) == (factor == 1000)


def test_a_scale_that_the_protocol_finds_is_no_fault():
    assert ids(scaled(TRACKED, 5), HAND_HELD, "tum-rgbd/v1-sim3") == []


@pytest.mark.parametrize("seed", range(4))
def test_conventions_are_named(seed):
    truth = hand_held(seed=seed)
    estimate = tracked(truth, seed)
    assert ids(posed(estimate, se3.inverse(estimate.T_world_cam)), truth) == ["inverted-poses"]
    assert ids(w_first(estimate), truth) == ["quaternion-order"]
    (hint,) = hints(posed(estimate, estimate.T_world_cam @ np.diag([1.0, -1.0, -1.0, 1.0])), truth)
    assert hint.id == "camera-axes" and "OpenGL" in hint.text
    turned = estimate.T_world_cam.copy()
    turned[:, :3, :3] = turned[:, :3, :3].transpose(0, 2, 1)
    assert ids(posed(estimate, turned), truth) == ["inverted-rotations"]


def test_two_faults_are_both_named():
    inverted = se3.inverse(scaled(TRACKED, 1000).T_world_cam)
    assert ids(posed(TRACKED, inverted), HAND_HELD) == ["inverted-poses", "scale"]
    late = Trajectory(TRACKED.timestamps + 0.2, scaled(TRACKED, 1000).T_world_cam)
    assert ids(late, HAND_HELD) == ["time-shift", "scale"]


def test_a_truth_with_axes_of_its_own_is_no_fault_of_the_estimate():
    truth = posed(HAND_HELD, HAND_HELD.T_world_cam @ se3.exp(np.array([0.02, 0.01, 0.0, 2.0, -0.7, 0.4])))
    assert ids(TRACKED, truth) == []
    assert ids(posed(TRACKED, se3.inverse(TRACKED.T_world_cam)), truth) == ["inverted-poses"]


def test_several_recordings_in_a_file(tmp_path):
    other = Trajectory(HAND_HELD.timestamps + 3600, TRACKED.T_world_cam)
    both = Trajectory(
        np.concatenate([TRACKED.timestamps, other.timestamps]),
        np.concatenate([TRACKED.T_world_cam, other.T_world_cam]),
    )
    (hint,) = hints(both, HAND_HELD)
    assert hint.id == "several-recordings" and hint.numbers["poses_outside"] == len(other)
    long = hand_held(600)
    write_tum(tmp_path / "run.txt", tracked(long))
    text = (tmp_path / "run.txt").read_text()
    (tmp_path / "twice.txt").write_text(text + text)
    file = load_tum(tmp_path / "twice.txt")
    assert file.notes.back_s == pytest.approx(599 / 30)
    (hint,) = hints(file.trajectory, long, notes=file.notes)
    assert hint.id == "several-recordings" and hint.numbers["repeated_stamps"] == 600


def test_frames_lost_for_long_are_not_several_recordings():
    truth = hand_held(1200)
    estimate = tracked(truth)
    kept = (truth.timestamps < truth.timestamps[0] + 5) | (truth.timestamps > truth.timestamps[0] + 30)
    assert ids(estimate.select(kept), truth) == []


def test_poses_read_from_the_truth_are_named():
    assert ids(HAND_HELD, HAND_HELD) == ["below-truth-noise"]
    measured = hand_held(1200, rate=100.0, noise_m=1e-4)
    stamps = measured.timestamps[:-4:3] + 0.004
    at = np.searchsorted(measured.timestamps, stamps)
    between = measured.T_world_cam[at].copy()
    for axis in range(3):
        between[:, axis, 3] = np.interp(stamps, measured.timestamps, measured.positions[:, axis])
    assert ids(Trajectory(stamps, between), measured) == ["below-truth-noise"]
    drift = np.cumsum(np.random.default_rng(0).normal(0, 1e-5, (len(at), 3)), axis=0)
    between[:, :3, 3] += drift + [[0.003, 0, 0]] * np.sin(stamps - stamps[0])[:, None]
    assert ids(Trajectory(stamps, between), measured) == ["below-truth-noise"]
    few = tracked(measured, drift=0.0, jitter=3e-4, every=3)
    assert ids(few, measured) == [] and ids(few.select(np.arange(len(few)) < 20), measured) == []


def test_a_camera_that_stands_still_may_be_followed_exactly():
    still = Trajectory(100 + np.arange(60) / 30, np.tile(np.eye(4), (60, 1, 1)))
    assert ids(still, still) == []
    noisy = hand_held(600, rate=100.0)
    noisy = posed(noisy, np.tile(np.eye(4), (600, 1, 1)))
    noisy.T_world_cam[:, :3, 3] += np.random.default_rng(0).normal(0, 3e-4, (600, 3))
    assert ids(Trajectory(noisy.timestamps, np.tile(np.eye(4), (600, 1, 1))), noisy) == []


def bad(kind, truth, rng):
    stamps, number, good = truth.timestamps, np.arange(len(truth)), tracked(truth).T_world_cam
    speed = se3.log(se3.inverse(good[:1]) @ good[5:6]) / 5
    walk = np.cumsum(rng.normal(0, 0.01, (len(truth), 6)), axis=0)
    poses = {
        "still": np.tile(np.eye(4), (len(truth), 1, 1)),
        "steady": se3.exp(speed * number[:, None]),
        "walk": se3.exp(walk),
        "stops": good[np.minimum(number, len(truth) // 2)],
        "jumps": se3.exp(rng.normal(0, 0.5, (4, 6)))[number * 4 // len(truth)] @ good,
        "drifts": tracked(truth, 3, 0.3, 2e-3).T_world_cam,
        "diverges": se3.exp(np.exp(0.1 * number)[:, None] * rng.normal(0, 1e-4, 6)),
    }[kind]
    return Trajectory(stamps, poses)


@pytest.mark.parametrize("kind", ["still", "steady", "walk", "stops", "jumps", "drifts", "diverges"])
@pytest.mark.parametrize("seed", range(5))
def test_bad_trackers_get_none(kind, seed):
    truth = hand_held(seed=seed)
    assert ids(bad(kind, truth, np.random.default_rng(seed)), truth) == []


def test_no_number_changes():
    estimate = posed(TRACKED, se3.inverse(TRACKED.T_world_cam))
    kept = estimate.timestamps.copy(), estimate.T_world_cam.copy()
    hints(estimate, HAND_HELD)
    assert np.array_equal(kept[0], estimate.timestamps) and np.array_equal(kept[1], estimate.T_world_cam)


@pytest.mark.skipif(not TRAJECTORIES.is_dir(), reason="needs the trajectories in ../shared/data")
@pytest.mark.parametrize(
    ("estimate", "truth", "expected"),
    [
        ("authors/dyslam/walking_xyz.txt", f"{FR3}walking_xyz/groundtruth.txt", []),
        ("authors/cds_slam/walking_rpy.txt", f"{FR3}walking_rpy/groundtruth.txt", []),
        ("authors/amos_slam/CameraTrajectory.txt", "authors/amos_slam/groundtruth.txt", []),
        (f"{FR3}walking_xyz/ours.txt", f"{FR3}walking_xyz/groundtruth.txt", ["several-recordings"]),
        (f"{FR3}walking_static/ours.txt", f"{FR3}walking_static/groundtruth.txt", ["several-recordings"]),
    ],
)
def test_published_trajectories(estimate, truth, expected):
    file = load_tum(TRAJECTORIES / estimate)
    assert ids(file.trajectory, load_tum(TRAJECTORIES / truth).trajectory, notes=file.notes) == expected


R_M = nearest_rotation(BONN_T_M[:3, :3])
SCALE = float(np.cbrt(np.linalg.det(BONN_T_M[:3, :3])))


def camera_of(markers):
    """The publisher's formula, with the rigid part of the calibration."""
    rigid = BONN_T_M.copy()
    rigid[:3, :3] = R_M
    return Trajectory(markers.timestamps, np.linalg.inv(BONN_T_ROS) @ markers.T_world_cam @ BONN_T_ROS @ rigid)


def sequence_truth(markers):
    """What a Bonn sequence gives: positions of the markers, orientations of the camera."""
    return Trajectory(markers.timestamps, in_camera_axes(markers.T_world_cam, BONN_R_BODY_CAM))


def test_digests_of_protocols_that_were_there_before_are_what_they_were():
    kept = {"tum-rgbd/v1": "1190f97bbd77", "tum-rgbd/v1-random-pairs": "9d4145d276f0", "evo-default": "e1e985248944",
            "vslam-lab": "c3d577abd792", "kitti": "6baedd087d0f"}  # fmt: skip
    assert {name: PROTOCOLS[name].digest() for name in kept} == kept
    assert len({protocol.digest() for protocol in PROTOCOLS.values()}) == len(PROTOCOLS)


def test_bonns_lever_arm_is_undone():
    """A perfect camera scores 0 at the camera and the lever arm's effect, but not more than 18.6 mm, at the markers."""
    markers = walk(3, n=300)
    estimate = turned(camera_of(markers), 5)
    truth = sequence_truth(markers)
    at_camera, at_markers = evaluate(estimate, truth, "bonn-camera/v1"), evaluate(estimate, truth, "tum-rgbd/v1")
    assert at_camera.metrics["ate_rmse_m"] < 1e-4 and at_camera.metrics["rpe_1s_trans_rmse_m"] < 1e-4
    assert 1e-3 < at_markers.metrics["ate_rmse_m"] < 0.0187
    lever = bonn_camera(truth.T_world_cam)[:, :3, 3] - truth.positions
    assert np.allclose(np.linalg.norm(lever, axis=1), np.linalg.norm(BONN_T_M[:3, 3]), atol=1e-12)
    assert np.linalg.norm(BONN_T_M[:3, 3]) == pytest.approx(0.0186, abs=5e-5)


def test_droid_ws_truth_is_theirs_to_the_last_digit_and_smaller():
    markers = walk(4, n=120)
    theirs = BONN_T_ROS.T @ markers.T_world_cam @ BONN_T_ROS @ BONN_T_M
    theirs = np.linalg.inv(theirs[0]) @ theirs
    assert np.abs(bonn_as_droid_w(sequence_truth(markers).T_world_cam)[:, :3, 3] - theirs[:, :3, 3]).max() < 1e-12
    assert SCALE == pytest.approx(1.059, abs=1e-3)
    estimate = noisy(camera_of(markers))
    error = evaluate(estimate, sequence_truth(markers), "droid-w/v1-bonn").metrics["ate_rmse_m"]
    unscaled = Trajectory(markers.timestamps, bonn_camera(sequence_truth(markers).T_world_cam))
    assert error * SCALE == pytest.approx(evaluate(estimate, unscaled, "droid-w/v1").metrics["ate_rmse_m"], rel=2e-3)


def test_a_file_of_bonn_scores_as_its_sequence_does(tmp_path):
    markers = walk(6, n=200)
    estimate = noisy(camera_of(markers))
    write_tum(tmp_path / "truth.txt", markers)
    write_tum(tmp_path / "estimate.txt", estimate)
    for name in ("bonn-camera/v1", "droid-w/v1-bonn", "tum-rgbd/v1"):
        of_files = evaluate_files(tmp_path / "estimate.txt", tmp_path / "truth.txt", name).metrics["ate_rmse_m"]
        of_sequence = evaluate(estimate, sequence_truth(markers), name).metrics["ate_rmse_m"]
        assert of_files == pytest.approx(of_sequence, abs=1e-6)


def test_bonns_protocols_refuse_other_sequences():
    get_protocol("bonn-camera/v1").check_sequence("bonn/crowd")
    get_protocol("tum-rgbd/v1").check_sequence("anything")
    with pytest.raises(EvaluationError, match=r"holds for bonn/\* only, not for 'tum/fr1/xyz'"):
        get_protocol("droid-w/v1-bonn").check_sequence("tum/fr1/xyz")


def test_every_image_takes_the_nearest_true_pose_within_80_ms():
    truth = walk(1, n=100, rate=10.0)
    estimate = Trajectory(truth.timestamps[:60] + 0.03, truth.T_world_cam[:60])
    assert evaluate(estimate, truth, "droid-w/v1").n_pairs == 60
    with pytest.raises(EvaluationError, match="none of 60 poses"):
        evaluate(estimate, truth, "tum-rgbd/v1")


def test_90_frames_are_every_third_that_has_a_true_pose():
    """As the preparation of MonST3R picks them: pair images with truth, take every third, stop at 90."""
    truth = walk(2, n=600)
    frames = truth.timestamps.copy()
    holey = truth.select(np.r_[0:100, 130:600])
    estimate = noisy(truth)
    found = evaluate(estimate, holey, "tum-dynamics-90/v1", input_timestamps=frames)
    matched = [stamp for stamp in frames if np.abs(holey.timestamps - stamp).min() < 0.02][::3][:90]
    chosen = estimate.select(np.isin(estimate.timestamps, matched))
    assert found.n_pairs == 90 == len(chosen) and found.n_pairs_rpe == {"1f": 89}
    sim3 = get_protocol("tum-dynamics-90/v1").model_copy(update={"every": 1, "most_frames": 0})
    assert found.metrics["ate_rmse_m"] == evaluate(chosen, holey, sim3).metrics["ate_rmse_m"]
    assert "90 poses on 90 frames are compared: every 3 of 570 matched" in found.diagnostics
    lost = evaluate(estimate.select(slice(100, None)), holey, "tum-dynamics-90/v1", input_timestamps=frames)
    assert lost.n_pairs == 90 - 34
    with pytest.raises(EvaluationError, match="none of 100 poses is of the 90 frames"):
        evaluate(estimate.select(slice(500, None)), holey, "tum-dynamics-90/v1", input_timestamps=frames)


def test_a_rate_is_the_error_over_the_time_between_its_poses():
    truth = walk(7, n=300, rate=7.0)  # 1 s is no multiple of a frame: pairs lie 0.857 or 1 or 1.143 s apart
    estimate = noisy(truth)
    rate, error = evaluate(estimate, truth, "tum-rgbd/v1-rate").metrics, evaluate(estimate, truth).metrics
    assert rate["rpe_1s_rate_trans_rmse_m_per_s"] == pytest.approx(error["rpe_1s_trans_rmse_m"], rel=0.01)
    slow = Trajectory(truth.timestamps[0] + (truth.timestamps - truth.timestamps[0]) * 10, truth.T_world_cam)
    slow_estimate = Trajectory(slow.timestamps, estimate.T_world_cam)
    tenth = evaluate(slow_estimate, slow, "tum-rgbd/v1-rate").metrics  # now 1.43 s between frames
    per_frame = evaluate(slow_estimate, slow, "tum-rgbd/v1").metrics["rpe_1f_trans_rmse_m"]
    assert tenth["rpe_1s_rate_trans_rmse_m_per_s"] == pytest.approx(per_frame * 0.7, rel=1e-3)
    assert "rpe_1s_rate_trans_sse_m_per_s2" not in rate and "rpe_1s_rate_rot_rmse_deg_per_s" in rate
    with pytest.raises(ValueError, match="a rate is taken over seconds"):
        RPESpec(delta=1, unit="f", rate=True)


def test_kitti_files_are_taken_with_their_stamps(tmp_path):
    truth = walk(8, n=60)
    estimate = noisy(truth)
    write_tum(tmp_path / "truth.txt", truth)
    write_kitti(tmp_path / "estimate.txt", estimate)
    (tmp_path / "rgb.txt").write_text("# list\n" + "".join(f"{s:.6f} rgb/{s}.png\n" for s in truth.timestamps))
    found = evaluate_files(tmp_path / "estimate.txt", tmp_path / "truth.txt", timestamps=tmp_path / "rgb.txt")
    assert found.metrics["ate_rmse_m"] == pytest.approx(evaluate(estimate, truth).metrics["ate_rmse_m"], abs=1e-6)
    with pytest.raises(TrajectoryError, match=r"12 values.*--timestamps FILE"):
        evaluate_files(tmp_path / "estimate.txt", tmp_path / "truth.txt")
    (tmp_path / "short.txt").write_text("x\n")
    with pytest.raises(TrajectoryError, match=r"short\.txt line 1: 'x' is not a stamp"):
        evaluate_files(tmp_path / "estimate.txt", tmp_path / "truth.txt", timestamps=tmp_path / "short.txt")


# Protocols: frozen, told apart, described, and how far their numbers lie apart.


def test_protocols_are_frozen_told_apart_and_described():
    tum = get_protocol("tum-rgbd/v1")
    assert get_protocol(tum) is tum
    assert tum.digest() == "1190f97bbd77"  # stored with every number: a change of v1 is a new version
    for change in ({"max_dt": 0.03}, {"strict": False}, {"alignment": "sim3"}, {"lost_frames": "hold"}, {"rpe": ()}):
        assert tum.model_copy(update=change).digest() != tum.digest()
    with pytest.raises(Exception, match="frozen"):
        tum.max_dt = 1.0
    assert "1190f97bbd77" in tum.describe()
    assert Protocol.model_validate_json(tum.model_dump_json()) == tum


def test_unknown_protocol_has_a_did_you_mean():
    with pytest.raises(EvaluationError, match=r"unknown protocol 'tum-rgbd'.*did you mean 'tum-rgbd/v1'"):
        get_protocol("tum-rgbd")


def test_a_delta_in_frames_is_whole():
    with pytest.raises(ValueError, match="whole number"):
        RPESpec(delta=1.5, unit="f")
    with pytest.raises(ValueError, match="all pairs are taken over frames"):
        RPESpec(delta=1.0, unit="m", pairs="all")


def test_compare_protocols_shows_how_far_they_are_apart():
    truth = walk(n=400)
    rows = compare_protocols(turned(noisy(truth), 2), truth)
    by_label = {row.label: row for row in rows}
    assert (
        by_label["not aligned"].rmse_m
        > by_label["origin-aligned"].rmse_m
        > by_label["SE(3)-aligned (TUM's ATE)"].rmse_m
    )
    assert by_label["Sim(3)-aligned"].rmse_m <= by_label["SE(3)-aligned (TUM's ATE)"].rmse_m
    assert {row.metric for row in rows} == {"ATE", "RPE"}
    assert all(row.rmse_m is not None and row.pairs > 0 for row in rows)
    short = compare_protocols(noisy(walk(n=20)), walk(n=20))
    missing = next(row for row in short if row.label == "TUM, 1 s, fixed delta")
    assert missing.rmse_m is None
    assert "1 s" in missing.note
