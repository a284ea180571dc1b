"""Warnings, stamps that span years, pairs that are no second apart, clocks that differ; every cure is tried."""

import re

import numpy as np
import pytest
from helpers.evaluation_walks import followed, lap, scaled

from dynslam_bench.core.errors import EvaluationError
from dynslam_bench.evaluation import Protocol, RPESpec, evaluate, hints
from dynslam_bench.geometry import Trajectory, se3
from dynslam_bench.sequences.tags import motion_tags

TRUTH = lap()
ESTIMATE = followed(TRUTH)
RIGHT = evaluate(ESTIMATE, TRUTH)


def at(trajectory, stamps):
    """A trajectory's poses at other stamps, seconds."""
    return Trajectory(np.asarray(stamps, np.float64), trajectory.T_world_cam)


def kinds(result):
    """The ids of an evaluation's warnings."""
    return [line.partition(":")[0] for line in result.warnings]


def placed(trajectory, index, place):
    """The trajectory with one position put elsewhere."""
    poses = trajectory.T_world_cam.copy()
    poses[index, :3, 3] = place
    return trajectory.with_poses(poses)


def test_a_sound_estimate_gives_no_warning():
    assert RIGHT.warnings == []


# -- stamps


@pytest.mark.parametrize("stretch", [1e3, 1e6, 1e9, 1e12])
def test_the_work_does_not_grow_with_the_time_that_the_stamps_span(stretch):
    """Hints would need 243 GiB for a grid over the years that nanoseconds are when they are taken for seconds."""
    estimate, truth = (at(one, one.timestamps * stretch) for one in (ESTIMATE, TRUTH))
    result = evaluate(estimate, truth)
    assert result.metrics["ate_rmse_m"] == pytest.approx(RIGHT.metrics["ate_rmse_m"], rel=1e-9)
    assert hints(estimate, truth) == ()
    assert motion_tags(truth) == set()
    assert "slow-stamps" in kinds(result)
    assert "rpe_1s_trans_rmse_m" not in result.metrics
    assert any(
        "0 s apart by the median: the relative error over 1s is left out" in line
        for line in result.diagnostics
    )


@pytest.mark.parametrize("later", [1.3e9, 1e7])
@pytest.mark.parametrize("rows", [1, 3])
def test_rows_of_another_time_cost_nothing_and_are_named(later, rows):
    both = [
        Trajectory(
            np.concatenate([np.arange(rows) / 30, later + one.timestamps]),
            np.concatenate([np.tile(np.eye(4), (rows, 1, 1)), one.T_world_cam]),
        )
        for one in (ESTIMATE, TRUTH)
    ]
    result = evaluate(*both)
    assert kinds(result) == ["far-stamp", "far-stamp"]
    assert (
        f"{rows} of {150 + rows} poses of the estimate lie {later:.3g} s apart"
        in result.warnings[0]
    )
    assert hints(*both) == ()
    motion_tags(both[1])
    # the cure: remove those lines
    assert evaluate(*(one.select(slice(rows, None)) for one in both)).warnings == []


@pytest.mark.parametrize(("first", "every"), [(0, 1), (1, 1), (100, 3)])
def test_frame_numbers_in_place_of_stamps_are_named_and_make_no_error_over_seconds(first, every):
    numbers = first + every * np.arange(150)
    result = evaluate(at(ESTIMATE, numbers), at(TRUTH, numbers))
    assert kinds(result)[:2] == ["frame-numbers", "frame-numbers"]
    assert f"whole numbers, {every} apart by the median: frame numbers?" in result.warnings[0]
    assert "rpe_1s_trans_rmse_m" not in result.metrics
    assert result.n_pairs_rpe == {"1s": 0, "1f": 148}
    assert result.metrics["rpe_1f_trans_rmse_m"] == RIGHT.metrics["rpe_1f_trans_rmse_m"]
    # the cure: the stamps of the images
    assert evaluate(ESTIMATE, TRUTH).metrics["rpe_1s_trans_rmse_m"] > 0


def test_frame_numbers_beside_seconds_meet_a_few_poses_by_chance_and_are_named():
    result = evaluate(at(ESTIMATE, np.arange(150)), TRUTH)
    assert result.n_pairs == 5
    assert {"frame-numbers", "little-truth"} <= set(kinds(result))


@pytest.mark.parametrize("interval_s", [1.9, 2.5, 4.0])
def test_pairs_that_are_no_second_apart_make_no_error_over_one_second(interval_s):
    stamps = 0.25 + interval_s * np.arange(150)
    result = evaluate(at(ESTIMATE, stamps), at(TRUTH, stamps))
    assert "rpe_1s_trans_rmse_m" not in result.metrics
    assert any("1s is left out" in line for line in result.diagnostics)
    spec = RPESpec(delta=2 * interval_s, unit="s")
    assert (
        spec.metric("trans")
        in evaluate(at(ESTIMATE, stamps), at(TRUTH, stamps), Protocol(id="x", rpe=(spec,))).metrics
    )


def test_pairs_of_a_pose_with_itself_are_counted():
    kept = np.r_[0:60, 120:150]
    result = evaluate(ESTIMATE.select(kept), TRUTH)
    assert any(
        re.match(r"\d+ of \d+ pairs over 1s join a pose with itself", line)
        for line in result.diagnostics
    )


@pytest.mark.parametrize("unix_is_truth", [True, False])
def test_clocks_that_differ_are_told_with_a_cure_that_works(unix_is_truth):
    unix = at(TRUTH if unix_is_truth else ESTIMATE, 1305031102.175304 + TRUTH.timestamps)
    since_start = ESTIMATE if unix_is_truth else TRUTH
    pair = (since_start, unix) if unix_is_truth else (unix, since_start)
    with pytest.raises(EvaluationError) as caught:
        evaluate(*pair)
    whose = "estimate" if unix_is_truth else "ground truth"
    later = re.search(rf"add ([0-9.]+) s to each stamp of the {whose}", caught.value.hint)
    moved = at(since_start, since_start.timestamps + float(later[1]))
    pair = (moved, unix) if unix_is_truth else (unix, moved)
    assert evaluate(*pair).metrics["ate_rmse_m"] == pytest.approx(
        RIGHT.metrics["ate_rmse_m"], rel=1e-6
    )


def test_frame_numbers_beside_unix_time_are_told():
    with pytest.raises(
        EvaluationError,
        match="the estimate are whole numbers, 1 apart by the median: frame numbers",
    ):
        evaluate(at(ESTIMATE, np.arange(150)), at(TRUTH, 1305031102.175304 + TRUTH.timestamps))


# -- positions


@pytest.mark.parametrize("index", [0, 77, 149])
@pytest.mark.parametrize("far_m", [1e9, -1e4, 300.0])
def test_a_true_pose_that_no_camera_reaches_is_named(index, far_m):
    result = evaluate(ESTIMATE, placed(TRUTH, index, [far_m, 0, 0]))
    (line,) = [line for line in result.warnings if line.startswith("far-positions")]
    stamp = re.search(r"the pose at the stamp ([0-9.]+) lies ([0-9.e+]+) m", line)
    assert float(stamp[1]) == pytest.approx(TRUTH.timestamps[index], abs=1e-6)
    assert float(stamp[2]) == pytest.approx(abs(far_m), rel=0.02)
    # the cure: remove it
    assert kinds(evaluate(ESTIMATE, TRUTH.select(np.arange(150) != index))) == []


@pytest.mark.parametrize("far_m", [1e9, 1e5])
def test_an_estimated_pose_that_no_camera_reaches_is_named(far_m):
    result = evaluate(placed(ESTIMATE, 20, [0, far_m, 0]), TRUTH)
    assert any("steps of the estimate are faster than 100 m/s" in line for line in result.warnings)


def test_positions_in_millimetres_on_both_sides_are_named():
    result = evaluate(scaled(ESTIMATE, 1000), scaled(TRUTH, 1000))
    assert kinds(result) == ["far-positions", "far-positions"]
    assert "m/s by the median: are its positions in millimetres?" in result.warnings[0]


@pytest.mark.parametrize("far_m", [1e13, 1e200])
def test_positions_whose_squares_are_no_numbers_end_in_no_traceback(far_m):
    for pair in (
        (ESTIMATE, placed(TRUTH, 5, [far_m, 0, 0])),
        (placed(ESTIMATE, 5, [far_m, 0, 0]), TRUTH),
    ):
        assert hints(*pair) == ()
        if far_m < 1e150:
            assert np.isfinite(list(evaluate(*pair).metrics.values())).all()
            continue
        with pytest.raises(EvaluationError, match=r"at the stamp 0\.166667 lies 1e\+200 m away"):
            evaluate(*pair)


# -- too little truth, a static camera


@pytest.mark.parametrize(
    ("rows", "named"),
    [
        ([0, 70, 149], "only 3 of 150 poses have ground truth within 0.02 s"),
        (range(0, 150, 3), "only 50 of 150 poses"),
        (range(40), "only 40 of 150 poses"),
    ],
)
def test_a_truth_of_few_frames_is_named(rows, named):
    result = evaluate(ESTIMATE, TRUTH.select(np.array(rows)))
    assert any(line.startswith(f"little-truth: {named}") for line in result.warnings)


@pytest.mark.parametrize("frames", [2, 7])
def test_few_poses_that_an_alignment_fits_are_named(frames):
    result = evaluate(
        *(one.select(np.linspace(0, 149, frames).astype(int)) for one in (ESTIMATE, TRUTH))
    )
    assert any("the alignment fits most of their error" in line for line in result.warnings)


@pytest.mark.parametrize(("seed", "size_m"), [(0, 1.6), (1, 1.2), (2, 3.0)])
def test_an_error_near_that_of_a_static_camera_is_named(seed, size_m):
    steps = np.random.default_rng(seed).normal(size=(150, 3))
    drift = np.cumsum(steps, axis=0) * size_m / np.sqrt(150)
    lost = ESTIMATE.with_poses(se3.from_matrix(drift, ESTIMATE.T_world_cam[:, :3, :3]))
    result = evaluate(lost, TRUTH)
    share = result.metrics["ate_rmse_m"] / result.metrics["static_camera_ate_rmse_m"]
    assert ("static-camera" in kinds(result)) == (share >= 0.8)
    assert share > 0.8, "the case is there"


def test_a_camera_that_truly_stands_still_is_no_fault():
    still = TRUTH.with_poses(np.tile(np.eye(4), (150, 1, 1)))
    assert kinds(evaluate(still, still)) == []


def test_the_scale_that_an_alignment_finds_is_told():
    result = evaluate(scaled(ESTIMATE, 0.5), TRUTH, "tum-rgbd/v1-sim3")
    assert any(
        re.match(r"the alignment scales the estimate by (1\.99|2\.0)", line)
        for line in result.diagnostics
    )
