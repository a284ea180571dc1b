"""Agreement with evo to 1e-9 under equal association, alignment and pair selection."""

import csv
import itertools
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest
from evo.core import metrics, sync
from evo.core.trajectory import PoseTrajectory3D
from evo.tools import file_interface
from helpers.evaluation_walks import chained, followed, lap, noisy, walk

from dynslam_bench.core.errors import EvaluationError
from dynslam_bench.evaluation import Protocol, RPESpec, evaluate, evaluate_files
from dynslam_bench.evaluation.compare_protocols import ComparisonRow, agrees, compare_protocols
from dynslam_bench.evaluation.rpe import closest, random_pairs
from dynslam_bench.geometry import RepeatedStamps, Trajectory, load_tum, read_tum, se3, write_tum

SHARED = Path(__file__).resolve().parents[3] / "shared" / "data"


def smooth(seed, n=240):
    """A random smooth trajectory at about 100 Hz with a hole of one second."""
    rng = np.random.default_rng(seed)
    stamps = 1305031102.0 + np.cumsum(rng.uniform(0.008, 0.012, n))
    stamps[n // 2 :] += 1.0
    steps = np.cumsum(rng.normal(0, 0.002, (n, 6)), axis=0) + rng.normal(0, 0.002, (n, 6))
    return Trajectory(stamps, chained(se3.exp(steps)))


def perturbed(truth, seed):
    """Every third pose, noisy, with other stamps, scaled a little and in another world frame."""
    rng = np.random.default_rng(seed + 1000)
    picked = truth.select(slice(0, None, 3))
    poses = picked.T_world_cam @ se3.exp(rng.normal(0, 0.01, (len(picked), 6)))
    poses[:, :3, 3] *= 1.07
    return Trajectory(
        picked.timestamps + rng.uniform(-0.006, 0.006, len(picked)),
        se3.exp(rng.normal(size=6)) @ poses,
    )


TRUTHS = {f"random-{seed}": smooth(seed) for seed in range(4)} | {
    path.parent.name: read_tum(path)
    for path in sorted(SHARED.glob("*/*/groundtruth.txt"))
    if path.parts[-3] != "fixed_camera"  # evo needs motion
}
CASES = [
    pytest.param(perturbed(truth, at), truth, id=name)
    for at, (name, truth) in enumerate(TRUTHS.items())
]
# evo starts from the ground truth where the estimate has more poses, and from the estimate where
# both have 80
CASES += [
    pytest.param(
        perturbed(smooth(9), 9), smooth(9).select(slice(0, None, 7)), id="longer-estimate"
    ),
    pytest.param(perturbed(smooth(9), 9), smooth(9).select(slice(80)), id="equally-long"),
]


@lru_cache(maxsize=128)
def evo_pair(estimate, truth, alignment, max_dt):
    """What evo compares, associated and aligned; its metrics only read it."""
    pair = (
        PoseTrajectory3D(poses_se3=list(t.T_world_cam), timestamps=t.timestamps.copy())
        for t in (truth, estimate)
    )
    return aligned(*pair, alignment, max_dt)


def aligned(reference, estimated, alignment, max_dt):
    reference, estimated = sync.associate_trajectories(reference, estimated, max_diff=max_dt)
    if alignment == "origin":
        estimated.align_origin(reference)
    elif alignment in ("se3", "sim3"):
        estimated.align(reference, correct_scale=alignment == "sim3")
    return reference, estimated


def statistics_of(evaluation, prefix, unit):
    """The statistics of one error, by evo's names."""
    names = {"sse": f"{prefix}_sse_{unit}2"} | {
        name: f"{prefix}_{name}_{unit}" for name in STATISTICS
    }
    return {name: evaluation.metrics[key] for name, key in names.items()}


@pytest.mark.parametrize(("estimate", "truth"), CASES)
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
        assert statistics_of(ours, prefix, unit) == pytest.approx(
            ape.get_all_statistics(), abs=1e-9, rel=1e-9
        )


@pytest.mark.parametrize(("estimate", "truth"), CASES)
@pytest.mark.parametrize("alignment", ["none", "se3", "sim3"])
@pytest.mark.parametrize("mode", ["consecutive", "all"])
@pytest.mark.parametrize("delta", [1, 7])
def test_relative_errors(estimate, truth, alignment, mode, delta):
    spec = RPESpec(delta=delta, unit="f", pairs=mode)
    protocol = Protocol(
        id="x", max_dt=0.01, strict=False, one_to_one=False, alignment=alignment, rpe=(spec,)
    )
    ours = evaluate(estimate, truth, protocol)
    pair = evo_pair(estimate, truth, alignment, 0.01)
    for relation, part, ending in (
        (metrics.PoseRelation.translation_part, "trans", "m"),
        (metrics.PoseRelation.rotation_angle_deg, "rot", "deg"),
    ):
        rpe = metrics.RPE(relation, delta, metrics.Unit.frames, all_pairs=mode == "all")
        try:
            rpe.process_data(pair)
        # evo refuses where there is no such pair; we leave the metric out and say so
        except Exception as error:
            assert "produced an empty index list" in str(error)
            assert "no pair of poses" in str(ours.diagnostics)
            assert ours.n_pairs_rpe[spec.key] == 0
            assert f"rpe_{spec.key}_{part}_rmse_{ending}" not in ours.metrics
            continue
        assert ours.n_pairs_rpe[spec.key] == len(rpe.error)
        found = statistics_of(ours, f"rpe_{spec.key}_{part}", ending)
        assert found == pytest.approx(rpe.get_all_statistics(), abs=1e-9, rel=1e-9)


# Units and coordinates that are far from a metre: centred, in double precision, without absolute
# limits.


UTM_M = np.array([4.1e5, 5.54e6, 210.0])


def elsewhere(trajectory, unit, offset):
    """The trajectory with its positions in another unit, in other coordinates."""
    return trajectory.with_poses(
        se3.from_matrix(offset + unit * trajectory.positions, trajectory.T_world_cam[:, :3, :3])
    )


@pytest.mark.parametrize("alignment", ["se3", "sim3"])
@pytest.mark.parametrize("unit", [1.0, 1e-9, 1e6])
@pytest.mark.parametrize("true_unit", [1.0, 0.1, 1e4])
@pytest.mark.parametrize("offset", [0.0, UTM_M])
def test_alignment_in_other_units_and_with_map_coordinates_is_evos(
    alignment, unit, true_unit, offset
):
    truth = elsewhere(lap(), true_unit, offset)
    estimate = elsewhere(followed(lap()), unit, 0.0)
    protocol = Protocol(id="x", max_dt=0.01, strict=False, one_to_one=False, alignment=alignment)
    ours = evaluate(estimate, truth, protocol)
    error = metrics.APE(metrics.PoseRelation.translation_part)
    error.process_data(evo_pair(estimate, truth, alignment, 0.01))
    expected = error.get_statistic(metrics.StatisticsType.rmse)
    assert ours.metrics["ate_rmse_m"] == pytest.approx(expected, rel=1e-6, abs=1e-8)
    if alignment == "sim3":
        assert ours.alignment.scale == pytest.approx(true_unit / unit, rel=0.01)


@pytest.mark.parametrize("unit", [1e-150, 1e-9, 1e9, 1e140])
@pytest.mark.parametrize("true_unit", [1e-9, 1.0, 1e9])
def test_the_unit_of_either_side_makes_no_difference_where_the_scale_is_fitted(unit, true_unit):
    """Also where evo finds no rotation, for the product of the two is too small."""
    protocol = Protocol(id="x", alignment="sim3")
    plain = evaluate(followed(lap()), lap(), protocol)
    ours = evaluate(
        elsewhere(followed(lap()), unit, 0.0), elsewhere(lap(), true_unit, 0.0), protocol
    )
    assert ours.metrics["ate_rmse_m"] == pytest.approx(
        true_unit * plain.metrics["ate_rmse_m"], rel=1e-9
    )
    assert ours.alignment.scale == pytest.approx(true_unit / unit * plain.alignment.scale, rel=1e-9)
    assert not ours.alignment.degenerate


@pytest.mark.parametrize("offset", [0.0, 1.0, UTM_M])
@pytest.mark.parametrize("alignment", ["se3", "sim3", "yaw"])
def test_a_camera_that_stands_still_anywhere_does_not_move(offset, alignment):
    """Rounding of its coordinates is no motion: no scale is fitted to it."""
    truth = lap()
    still = elsewhere(truth, 0.0, 0.3 + offset)
    found = evaluate(still, truth, Protocol(id="x", alignment=alignment))
    assert found.alignment.scale == 1.0
    assert found.metrics["ate_rmse_m"] == pytest.approx(
        found.metrics["static_camera_ate_rmse_m"], abs=1e-8
    )


# Published numbers from published trajectories, repeated stamps beside evo, rows that agree with a
# printed number.


AUTHOR = SHARED / "trajectories" / "rgbd-vo"
STATISTICS = ("rmse", "mean", "median", "std", "min", "max")


def published():
    """Estimate, truth and the author's numbers of every line of the author's tables."""
    for table in sorted(AUTHOR.glob("*/published.csv")):
        for line in csv.DictReader(table.open()):
            numbers = {name: float(line[f"{name}_m"]) for name in STATISTICS}
            yield table.parent / line["trajectory"], table.parent / "groundtruth.txt", numbers


needs_author = pytest.mark.skipif(
    not AUTHOR.is_dir(), reason="the author's trajectories are not beside the checkout"
)


@pytest.mark.slow
@needs_author
def test_an_authors_evo_tables_are_given_back():
    lines = list(published())
    assert len(lines) == 44
    for estimate, truth, numbers in lines:
        metrics = evaluate_files(estimate, truth, "evo-as/v1").metrics
        assert {name: metrics[f"ate_{name}_m"] for name in STATISTICS} == pytest.approx(
            numbers, abs=1e-9
        ), estimate


@needs_author
def test_tolerance_and_scale_move_one_published_number():
    estimate = AUTHOR / "rgbd_bonn_crowd" / "rgbdvo.txt"
    truth = AUTHOR / "rgbd_bonn_crowd" / "groundtruth.txt"
    rows = compare_protocols(load_tum(estimate), load_tum(truth))
    expected = {
        "evo_ape -as": (0.0733, 554), "Sim(3)-aligned": (0.1099, 904),
        "evo_ape -a": (54.8671, 554), "SE(3)-aligned (TUM's ATE)": (53.3026, 904),
    }  # fmt: skip
    assert {
        row.label: (round(row.rmse_m, 4), row.pairs) for row in rows if row.label in expected
    } == expected
    assert [row.label for row in rows if agrees(row, "0.0733")] == ["evo_ape -as"]


@pytest.mark.parametrize("longer", ["estimate", "truth"])
@pytest.mark.parametrize("scaled", [True, False])
def test_repeated_stamps_are_taken_as_evo_takes_them(tmp_path, longer, scaled):
    truth = walk(n=300)
    estimate = noisy(truth).select(slice(0, None, 3))
    pair = (
        {"truth": truth, "estimate": estimate}
        if longer == "truth"
        else {"truth": estimate, "estimate": truth}
    )
    for name, trajectory in pair.items():
        write_tum(tmp_path / f"{name}.txt", trajectory)
        *lines, last = (tmp_path / f"{name}.txt").read_text().splitlines()
        stamp, x, *rest = lines[20].split()
        moved = " ".join([stamp, f"{float(x) + 0.5:.9f}", *rest])
        (tmp_path / f"{name}.txt").write_text(
            "\n".join([*lines[:20], moved, moved, *lines[20:], last]) + "\n"
        )
    reference, estimated = (
        file_interface.read_tum_trajectory_file(str(tmp_path / f"{name}.txt")) for name in pair
    )
    error = metrics.APE(metrics.PoseRelation.translation_part)
    error.process_data(aligned(reference, estimated, "sim3" if scaled else "se3", 0.01))
    files = tmp_path / "estimate.txt", tmp_path / "truth.txt"
    ours = evaluate_files(*files, "evo-as/v1" if scaled else "evo-as/v1-se3")
    assert ours.n_pairs == len(error.error)
    assert ours.metrics["ate_rmse_m"] == pytest.approx(
        error.get_statistic(metrics.StatisticsType.rmse), abs=1e-9
    )
    assert any("repeat the next line's stamp, all are taken" in line for line in ours.diagnostics)
    under_tum = evaluate_files(*files, "tum-rgbd/v1")
    assert any("replaced by a later line" in line for line in under_tum.diagnostics)
    assert under_tum.metrics["ate_max_m"] < 0.3 < ours.metrics["ate_max_m"]


def test_repeated_stamps_stay_in_order_and_are_kept():
    poses = np.tile(np.eye(4), (3, 1, 1))
    twice = RepeatedStamps(np.array([1.0, 1.0, 2.0]), poses)
    assert isinstance(twice.select(slice(0, 2)), RepeatedStamps)
    assert isinstance(twice.with_poses(poses), RepeatedStamps)
    with pytest.raises(Exception, match="not strictly increasing"):
        RepeatedStamps(np.array([1.0, 2.0, 1.0]), poses)


@pytest.mark.parametrize(
    ("value", "printed", "same"),
    [
        (0.073255, "0.0733", True), (0.073255, "0.0732", False), (0.07325, "0.073", True), (0.0735, "7.3e-2", True),
        (0.0736, "0.0730", False), (1.4, "1", True), (None, "0.07", False),
    ],
)  # fmt: skip
def test_a_row_agrees_to_the_last_printed_digit(value, printed, same):
    assert agrees(ComparisonRow("ATE", "", value, 9, ""), printed) is same


@pytest.mark.parametrize("printed", ["7 cm", "", "nan", "inf"])
def test_what_is_no_printed_number_is_refused(printed):
    with pytest.raises(EvaluationError, match="as it was printed"):
        agrees(ComparisonRow("ATE", "", 0.1, 9, ""), printed)


# -- the slow reference: dictionaries, loops, one pose at a time


def bisect_closest(values, target):
    low = 0
    high = len(values)
    best = 0
    difference = abs(values[0] - target)
    while low < high:
        middle = (low + high) // 2
        if abs(values[middle] - target) < difference:
            difference = abs(values[middle] - target)
            best = middle
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


LENGTHS = {"m": lambda step: np.linalg.norm(step[:3, 3]), "deg": lambda step: angle_of(step) * 180 / np.pi,
           "rad": angle_of, "f": lambda step: 1}  # fmt: skip
"""How far a step goes, by the unit of the delta."""


def slow_rpe(truth, estimate, delta, unit):
    t_gt = truth.timestamps.tolist()
    t_est = estimate.timestamps.tolist()
    poses = estimate.T_world_cam
    steps = [ominus(after, before) for before, after in itertools.pairwise(poses)]
    index = (
        t_est if unit == "s" else list(itertools.accumulate(map(LENGTHS[unit], steps), initial=0.0))
    )
    tolerance = 2 * np.median(np.diff(t_gt))
    translation = []
    rotation = []
    for i, start in enumerate(index):
        j = bisect_closest(index, start + delta)
        if j == len(t_est) - 1:
            continue
        gi = bisect_closest(t_gt, t_est[i])
        gj = bisect_closest(t_gt, t_est[j])
        if abs(t_gt[gi] - t_est[i]) > tolerance or abs(t_gt[gj] - t_est[j]) > tolerance:
            continue
        error = ominus(
            ominus(poses[j], poses[i]), ominus(truth.T_world_cam[gj], truth.T_world_cam[gi])
        )
        translation.append(np.linalg.norm(error[:3, 3]))
        rotation.append(np.rad2deg(angle_of(error)))
    return np.array(translation), np.array(rotation)


def stamped_walk(seed, n=150, standing=False):
    rng = np.random.default_rng(seed)
    stamps = np.round(1311868163.0 + np.cumsum(rng.uniform(0.028, 0.04, n)), 6)
    steps = rng.normal(0, 0.01, (n, 6))
    if standing:
        steps[20:60] = 0  # equal path indices: only the bisection's order decides
    return Trajectory(stamps, chained(se3.exp(steps)))


def truth_of(estimate, seed):
    """Ground truth at three times the rate with a hole, close to the estimate."""
    rng = np.random.default_rng(seed + 50)
    stamps = np.arange(estimate.timestamps[0] - 0.05, estimate.timestamps[-1] + 0.05, 0.0101)
    nearest = np.abs(stamps[:, None] - estimate.timestamps).argmin(1)
    poses = estimate.T_world_cam[nearest] @ se3.exp(rng.normal(0, 0.01, (len(stamps), 6)))
    # the hole begins more than one interval before a pose, but not two
    keep = (stamps < estimate.timestamps[80] - 0.0101) | (stamps > estimate.timestamps[95])
    return Trajectory(stamps[keep], (se3.exp(rng.normal(size=6)) @ poses)[keep])


def pairs_of_trajectories():
    for seed in range(3):
        estimate = stamped_walk(seed, standing=seed == 1)
        yield pytest.param(truth_of(estimate, seed), estimate, id=f"random-{seed}")
    for path in sorted(SHARED.glob("*/*/groundtruth.txt")):
        picked = noisy(read_tum(path).select(slice(1, None, 3)))
        estimate = Trajectory(picked.timestamps + 0.002, picked.T_world_cam)
        yield pytest.param(read_tum(path), estimate, id=path.parent.name)


@pytest.mark.parametrize(("truth", "estimate"), list(pairs_of_trajectories()))
@pytest.mark.parametrize(
    ("delta", "unit"),
    [(1, "f"), (10, "f"), (1, "s"), (0.5, "s"), (0.1, "m"), (5, "deg"), (0.2, "rad")],
)
def test_rpe_with_fixed_delta(truth, estimate, delta, unit):
    spec = RPESpec(delta=delta, unit=unit)
    ours = evaluate(estimate, truth, Protocol(id="x", rpe=(spec,)))
    translation, rotation = slow_rpe(truth, estimate, delta, unit)
    assert ours.n_pairs_rpe[spec.key] == len(translation) > 10
    expected = {"rmse": np.sqrt((translation**2).mean()), "sse": (translation**2).sum()}
    expected |= {
        name: getattr(np, name)(translation) for name in ("mean", "median", "std", "min", "max")
    }
    assert statistics_of(ours, f"rpe_{spec.key}_trans", "m") == pytest.approx(expected, abs=1e-12)
    # the reference's arccos loses half the digits near zero, ours does not
    assert ours.metrics[f"rpe_{spec.key}_rot_rmse_deg"] == pytest.approx(
        np.sqrt((rotation**2).mean()), abs=1e-5
    )


@pytest.mark.parametrize("seed", range(20))
def test_the_vectorised_bisection_meets_the_same_value(seed):
    rng = np.random.default_rng(seed)
    values = np.sort(rng.integers(0, 12, 40) / 4.0)
    targets = np.concatenate([values, values + 0.125, rng.uniform(-1, 5, 50)])
    assert closest(values, targets).tolist() == [
        bisect_closest(values.tolist(), t) for t in targets.tolist()
    ]


def test_random_pairs_are_fixed_for_good():
    pairs = random_pairs(2893, 10000)
    # raw generator words: no version of Python or NumPy may change them
    assert pairs[:3].tolist() == [[1107, 2782], [1047, 2715], [384, 2384]]
    assert pairs.shape == (10000, 2)
    assert (pairs.min(), pairs.max()) == (0, 2892)
    assert abs(pairs.mean() - 1446) < 20


def test_random_pairs_of_a_short_trajectory_are_all_pairs_with_themselves_too():
    assert [len(random_pairs(*args)) for args in ((99, 10000), (100, 10000), (300, 0))] == [
        99**2,
        10000,
        300**2,
    ]
    assert len(np.unique(random_pairs(100, 10000), axis=0)) < 10000, (
        "as many as there are, and yet drawn"
    )
    assert random_pairs(2, 10000).tolist() == [[0, 0], [0, 1], [1, 0], [1, 1]]


def test_more_than_the_most_fixed_pairs_are_a_seeded_sample():
    estimate = stamped_walk(0)
    for most, pairs in ((50, 50), (0, 148)):
        protocol = Protocol(id="x", rpe=(RPESpec(delta=1, unit="f", max_pairs=most),))
        result = evaluate(estimate, estimate, protocol)
        assert result.n_pairs_rpe["1f"] == pairs
        assert result.metrics == evaluate(estimate, estimate, protocol).metrics
