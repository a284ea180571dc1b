"""The conventions of papers as protocols: Bonn's lever arm, DROID-W's shrunken truth, MonST3R's 90 frames, rates."""

import numpy as np
import pytest
from evaluation_walks import noisy, turned, walk

from dynslam_bench.core.errors import EvaluationError, TrajectoryError
from dynslam_bench.evaluation import (
    PROTOCOLS,
    Protocol,
    RPESpec,
    compare_protocols,
    evaluate,
    evaluate_files,
    get_protocol,
)
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
from dynslam_bench.geometry.trajectory_files import write_kitti, write_tum

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
