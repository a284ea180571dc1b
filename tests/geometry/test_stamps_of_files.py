"""Stamps and columns of trajectory files: their unit, their headings, digits that were lost; every cure is tried."""

import itertools
import re

import numpy as np
import pytest
from helpers.evaluation_walks import followed, lap, rows_of

from dynslam_bench.core.errors import TrajectoryError
from dynslam_bench.geometry import (
    Trajectory,
    load_tum,
    read_kitti,
    read_tum,
    write_kitti,
    write_tum,
)
from dynslam_bench.geometry.headings import Heading, parse_heading
from dynslam_bench.geometry.stamp_units import SECONDS, UNITS, are_frame_numbers, unit_of

UNIX = 1305031102.175304
MS, US, NS = UNITS[1:]


def written(stamps, unit, start=0.0):
    """Stamps in seconds as a file has them in a unit, with all digits."""
    return [
        f"{round((start + stamp) * 1e9) / 10 ** (9 - unit.digits):.6f}"
        for stamp in np.asarray(stamps).tolist()
    ]


# -- the unit of the stamps


@pytest.mark.parametrize("unit", [US, NS])
@pytest.mark.parametrize("rate", [10.0, 30.0, 200.0])
def test_stamps_since_the_start_in_small_units_are_recognised(unit, rate):
    found, note = unit_of(np.arange(90) / rate * unit.per_s, "x")
    assert found is unit
    assert note.endswith(f"apart by the median: taken as {unit.name} ({rate:g} Hz)")


@pytest.mark.parametrize("unit", [MS, US, NS])
@pytest.mark.parametrize("rate", [1.0, 30.0, 1000.0])
def test_unix_time_is_recognised_in_every_unit(unit, rate):
    found, note = unit_of((UNIX + np.arange(60) / rate) * unit.per_s, "x")
    assert found is unit
    assert unit.name in note


@pytest.mark.parametrize("unit", [SECONDS, MS, US, NS])
def test_a_single_stamp_of_unix_time_tells_its_unit(unit):
    assert unit_of([UNIX * unit.per_s], "x")[0] is unit


@pytest.mark.parametrize(
    "stamps",
    [
        np.arange(100) / 30,
        UNIX + np.arange(20) * 0.5,
        np.array([0.0]),
        np.arange(50.0),  # one pose a second, or frame numbers
        # keyframes of a camera that hardly moves
        UNIX + np.cumsum(np.random.default_rng(0).uniform(6, 9, 12)),
        np.cumsum(np.random.default_rng(1).uniform(6, 9, 5)),
        np.append(0.0, UNIX + np.arange(30) / 30),  # one row without a stamp
    ],
)
def test_seconds_are_taken_without_a_word(stamps):
    assert unit_of(stamps, "x") == (SECONDS, "")


@pytest.mark.parametrize(
    ("step", "named"),
    [
        (
            100 / 3,
            "33.3333 apart by the median: milliseconds (30 Hz) or seconds (one pose in 33.3 s)?",
        ),
        (50.0, "50 apart by the median: milliseconds (20 Hz) or seconds (one pose in 50 s)?"),
        (
            1000.0,
            "1000 apart by the median: milliseconds (one pose in 1 s) or microseconds (1e+03 Hz)?",
        ),
        (
            2e6,
            "2000000 apart by the median: microseconds (one pose in 2 s) or nanoseconds (500 Hz)?",
        ),
    ],
)
def test_where_two_units_are_possible_both_are_named_and_what_decides(step, named):
    with pytest.raises(TrajectoryError) as caught:
        unit_of(step * np.arange(100), "x")
    assert named in str(caught.value)
    assert "name the unit in the first line" in caught.value.hint


@pytest.mark.parametrize(
    ("stamps", "hint"),
    [
        (np.append(UNIX + np.arange(30) / 30, 1e17), "remove the line with the stamp 1e+17"),
        (np.arange(30) * 1e13, "write seconds"),
        (np.array([1e30]), "write seconds"),
    ],
)
def test_stamps_of_no_unit_are_refused(stamps, hint):
    with pytest.raises(TrajectoryError) as caught:
        unit_of(stamps, "x")
    assert caught.value.hint == hint


@pytest.mark.parametrize(("unit", "scale"), [(NS, 1.0), (SECONDS, 1e9), (MS, 1e12)])
def test_a_heading_that_contradicts_the_stamps_is_refused_with_both(unit, scale):
    with pytest.raises(
        TrajectoryError,
        match=f"the heading of x says {unit.name}, but its stamps .* apart by the median",
    ):
        unit_of(scale * np.arange(30) / 30, "x", unit)


def test_frame_numbers_are_whole_and_no_unix_time():
    assert are_frame_numbers(np.arange(10))
    assert are_frame_numbers(np.array([5.0, 8.0, 14.0]))
    assert not are_frame_numbers(np.arange(10) / 2)
    assert not are_frame_numbers(1305031102 + np.arange(10))
    assert not are_frame_numbers([0.0, 1.0])


@pytest.mark.parametrize("unit", [MS, US, NS])
@pytest.mark.parametrize("start", [0.0, UNIX])
def test_files_in_other_units_are_read_to_the_last_digit(tmp_path, unit, start):
    truth = lap()
    texts = [
        f"{round((start + stamp) * 1e9) // 10 ** (9 - unit.digits)}"
        for stamp in truth.timestamps.tolist()
    ]
    text = rows_of(truth, texts)
    (tmp_path / "a.txt").write_text(text)
    if unit is MS and not start:
        with pytest.raises(
            TrajectoryError, match=r"milliseconds \(30\.3 Hz\) or seconds"
        ) as caught:
            load_tum(tmp_path / "a.txt")
        # the cure: the heading that the hint shows
        (tmp_path / "a.txt").write_text(re.search("'(#.*)'", caught.value.hint)[1] + "\n" + text)
    file = load_tum(tmp_path / "a.txt")
    assert file.trajectory.timestamps_ns.tolist() == [
        int(stamp) * 10 ** (9 - unit.digits) for stamp in texts
    ]
    assert np.allclose(file.trajectory.positions, truth.positions, atol=1e-8)


def test_the_other_cures_of_a_unit_work_as_well(tmp_path):
    truth = lap()
    text = rows_of(truth, written(truth.timestamps, MS))
    for heading in (
        "# time [s] x y z qx qy qz qw",
        "#timestamp_ms,tx,ty,tz,qx,qy,qz,qw",
        "t (ms) x y z q_x q_y q_z q_w",
    ):
        (tmp_path / "a.txt").write_text(f"{heading}\n# timestamp tx ty tz qx qy qz qw\n{text}")
        step = 33.333333 if "[s]" in heading else 0.033333
        assert np.median(np.diff(read_tum(tmp_path / "a.txt").timestamps)) == pytest.approx(
            step, rel=1e-4
        )
    (tmp_path / "a.txt").write_text(rows_of(truth, written(truth.timestamps, SECONDS)))
    assert load_tum(tmp_path / "a.txt").notes.describe() == []


def test_sparse_poses_are_read_back(tmp_path):
    """Their steps do not tell the unit, so that their heading states it."""
    sparse = Trajectory(33.0 * np.arange(150), lap().T_world_cam)
    write_tum(tmp_path / "a.txt", sparse)
    assert "# timestamp [s] tx" in (tmp_path / "a.txt").read_text()
    assert read_tum(tmp_path / "a.txt").timestamps.tolist() == sparse.timestamps.tolist()


@pytest.mark.parametrize("unit", [MS, US, NS])
def test_the_stamps_of_kittis_poses_have_a_unit_too(tmp_path, unit):
    truth = lap()
    write_kitti(tmp_path / "poses.txt", truth)
    times = "\n".join(written(truth.timestamps, unit, UNIX))
    (tmp_path / "times.txt").write_text(times)
    read = read_kitti(tmp_path / "poses.txt", tmp_path / "times.txt")
    assert np.allclose(read.timestamps, UNIX + truth.timestamps, atol=1e-5)


# -- digits that were lost


@pytest.mark.parametrize(
    ("form", "repeats"),
    [
        (lambda stamp: f"{stamp:g}", 149),
        (lambda stamp: f"{stamp:.0f}", 144),
        (lambda stamp: str(float(np.float32(stamp))), 148),
        (lambda stamp: f"{1000 * stamp:.6e}", 149),
    ],
    ids=["%g", "whole seconds", "32-bit floats", "seven digits of milliseconds"],
)
def test_stamps_that_lost_their_digits_are_told_and_the_cure_works(tmp_path, form, repeats):
    truth = lap()
    stamps = (UNIX + truth.timestamps).tolist()
    (tmp_path / "a.txt").write_text(rows_of(truth, map(form, stamps)))
    with pytest.raises(
        TrajectoryError,
        match=f"{repeats} of 150 lines of .*a.txt repeat the stamp .*digits were lost",
    ) as caught:
        read_tum(tmp_path / "a.txt")
    assert "%.9f" in caught.value.hint
    (tmp_path / "a.txt").write_text(rows_of(truth, [f"{stamp:.9f}" for stamp in stamps]))
    assert len(read_tum(tmp_path / "a.txt")) == 150


@pytest.mark.parametrize("rate", [15.0, 20.0, 25.0])
def test_digits_that_tell_some_poses_apart_are_too_few_as_well(tmp_path, rate):
    texts = [f"{UNIX + n / rate:.1f}" for n in range(150)]
    repeats = sum(later == earlier for earlier, later in itertools.pairwise(texts))
    (tmp_path / "a.txt").write_text(rows_of(lap(), texts))
    with pytest.raises(TrajectoryError, match=f"{repeats} of 150 lines .* digits were lost"):
        read_tum(tmp_path / "a.txt")


def test_the_times_of_kittis_poses_may_have_lost_them_too(tmp_path):
    write_kitti(tmp_path / "poses.txt", lap())
    (tmp_path / "times.txt").write_text("1.30503e+09\n" * 150)
    with pytest.raises(TrajectoryError, match=r"149 of 150 lines of .*times\.txt repeat"):
        read_kitti(tmp_path / "poses.txt", tmp_path / "times.txt")


def test_lines_that_are_written_twice_lost_nothing(tmp_path):
    rows = rows_of(lap(), written(lap().timestamps, SECONDS)).splitlines()
    (tmp_path / "a.txt").write_text("".join(f"{row}\n{row}\n" for row in rows))
    file = load_tum(tmp_path / "a.txt")
    assert (len(file.trajectory), file.notes.duplicates) == (150, 150)


# -- columns and headings


@pytest.mark.parametrize(
    ("line", "heading"),
    [
        ("# timestamp tx ty tz qx qy qz qw", Heading(8, (0, 1, 2, 3, 4, 5, 6, 7), None)),
        ("timestamp,tx,ty,tz,qx,qy,qz,qw", Heading(8, (0, 1, 2, 3, 4, 5, 6, 7), None)),
        (
            "#timestamp [s],p_x,p_y,p_z,q_w,q_x,q_y,q_z",
            Heading(8, (0, 1, 2, 3, 5, 6, 7, 4), SECONDS),
        ),
        ("ts (ns),tx (m),ty (m),tz (m),qx,qy,qz,qw", Heading(8, (0, 1, 2, 3, 4, 5, 6, 7), NS)),
        ("Time_us, qw, qx, qy, qz, X, Y, Z", Heading(8, (0, 5, 6, 7, 2, 3, 4, 1), US)),
        (
            "#timestamp [ns], p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z [], "
            "v_RS_R_x [m s^-1], v_RS_R_y [m s^-1], v_RS_R_z [m s^-1]",
            Heading(11, (0, 1, 2, 3, 5, 6, 7, 4), NS),
        ),
        ("# my tracker, run 3; timestamps in seconds", None),
        ("# ground truth trajectory, timestamp tx ty tz qx qy qz qw", None),
        ("# file: 'rgbd_dataset_freiburg3.bag'", None),
        ("# timestamp, position, orientation", None),
        ("timestamp,tx,ty,tz,q0,q1,q2,q3", None),
        (",timestamp,x,y,z,qx,qy,qz,qw", Heading(9, (1, 2, 3, 4, 5, 6, 7, 8), None)),
        (
            'frame,"t [s]","x","y","z","qx","qy","qz","qw",',
            Heading(9, (1, 2, 3, 4, 5, 6, 7, 8), SECONDS),
        ),
        ("", None),
    ],
)
def test_headings_are_names_of_columns_and_prose_is_none(line, heading):
    assert parse_heading(line) == heading


@pytest.mark.parametrize(
    "comment",
    [
        "# timestamp, tx, ty, tz, qx, qy, qz, qw",
        "# my tracker, run 3; timestamps in seconds",
        "# timestamp [s], then the pose, w last",
        "#timestamp,x,y",
        "# stamps of (ns) precision, timestamp first",
    ],
)
def test_a_comment_makes_no_table_of_a_tum_file(tmp_path, comment):
    truth = lap()
    (tmp_path / "a.txt").write_text(
        f"{comment}\n{rows_of(truth, written(truth.timestamps, SECONDS, UNIX))}"
    )
    assert np.allclose(read_tum(tmp_path / "a.txt").T_world_cam, truth.T_world_cam, atol=1e-8)


@pytest.mark.parametrize(
    ("heading", "order", "unit"),
    [
        ("timestamp,tx,ty,tz,qx,qy,qz,qw", (0, 1, 2, 3, 4, 5, 6), SECONDS),
        ("#timestamp [s],p_x,p_y,p_z,q_w,q_x,q_y,q_z", (0, 1, 2, 6, 3, 4, 5), SECONDS),
        (
            "#timestamp,p_RS_R_x,p_RS_R_y,p_RS_R_z,q_RS_w,q_RS_x,q_RS_y,q_RS_z",
            (0, 1, 2, 6, 3, 4, 5),
            NS,
        ),
        ("t,qw,qx,qy,qz,x,y,z", (6, 3, 4, 5, 0, 1, 2), US),
        ("#time [ms],x,y,z,qx,qy,qz,qw", (0, 1, 2, 3, 4, 5, 6), MS),
    ],
)
@pytest.mark.parametrize("separator", [",", ", ", " "])
def test_tables_are_read_by_their_headings(tmp_path, heading, order, unit, separator):
    truth = lap()
    rows = rows_of(truth, written(truth.timestamps, unit, UNIX), separator, order)
    (tmp_path / "a.csv").write_text(f"{heading}\n{rows}")
    read = read_tum(tmp_path / "a.csv")
    assert np.allclose(read.T_world_cam, truth.T_world_cam, atol=1e-8)
    assert np.allclose(read.timestamps, UNIX + truth.timestamps, atol=2e-6)


@pytest.mark.parametrize(
    "heading", [",timestamp,x,y,z,qx,qy,qz,qw", "frame,time [s],x,y,z,qx,qy,qz,qw"]
)
def test_a_column_that_numbers_the_rows_is_passed_over(tmp_path, heading):
    truth = lap()
    rows = rows_of(truth, written(truth.timestamps, SECONDS, UNIX), ",").splitlines()
    (tmp_path / "a.csv").write_text(
        "\n".join([heading, *(f"{number},{row}" for number, row in enumerate(rows))])
    )
    read = read_tum(tmp_path / "a.csv")
    assert np.allclose(read.T_world_cam, truth.T_world_cam, atol=1e-8)
    assert np.allclose(read.timestamps, UNIX + truth.timestamps, atol=1e-6)


def test_a_first_line_that_is_neither_a_pose_nor_a_heading_is_named_and_the_cure_works(tmp_path):
    rows = rows_of(lap(), written(lap().timestamps, SECONDS), ",")
    (tmp_path / "a.csv").write_text(f"when,where,how\n{rows}")
    with pytest.raises(
        TrajectoryError, match="line 1 is neither a pose nor a known heading: 'when,where,how'"
    ) as caught:
        read_tum(tmp_path / "a.csv")
    (tmp_path / "a.csv").write_text(re.search("'(.*)'", caught.value.hint)[1] + f"\n{rows}")
    assert len(read_tum(tmp_path / "a.csv")) == 150


def test_17_columns_need_their_heading(tmp_path):
    truth = lap()
    rows = rows_of(
        truth, written(truth.timestamps, NS, UNIX), ",", (0, 1, 2, 6, 3, 4, 5)
    ).splitlines()
    (tmp_path / "a.csv").write_text("".join(f"{row}{',0' * 9}\n" for row in rows))
    with pytest.raises(TrajectoryError, match=r"17 values, not the 8 .*leave its heading in"):
        read_tum(tmp_path / "a.csv")
    names = (
        "#timestamp,p_RS_R_x [m],p_RS_R_y [m],p_RS_R_z [m],q_RS_w [],q_RS_x [],q_RS_y [],q_RS_z []"
    )
    others = ",".join(
        f"{name}_{axis}" for name in ("v_RS_R", "b_w_RS_S", "b_a_RS_S") for axis in "xyz"
    )
    (tmp_path / "a.csv").write_text(f"{names},{others}\n" + (tmp_path / "a.csv").read_text())
    assert np.allclose(read_tum(tmp_path / "a.csv").T_world_cam, truth.T_world_cam, atol=1e-8)


def test_orb_slam3s_own_nanosecond_trajectory_is_read(tmp_path):
    """`SaveTrajectoryEuRoC`: nanoseconds with six decimals, spaces, w last, no heading."""
    estimate = followed(lap())
    ns = np.round((UNIX + estimate.timestamps) * 1e6) * 1e3
    (tmp_path / "f.txt").write_text(rows_of(estimate, [f"{stamp:.6f}" for stamp in ns.tolist()]))
    file = load_tum(tmp_path / "f.txt")
    assert file.trajectory.timestamps_ns.tolist() == ns.astype(np.int64).tolist()
    assert "taken as nanoseconds (30 Hz)" in file.notes.stamps
