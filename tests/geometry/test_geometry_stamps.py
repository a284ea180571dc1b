"""Stamps: decimal text, nanoseconds and floats are one another's, exactly."""

from __future__ import annotations

from decimal import Decimal
from pathlib import Path

import numpy as np
import pytest
from evo.tools import file_interface

from dynslam_bench.core.errors import TrajectoryError
from dynslam_bench.geometry import stamps
from dynslam_bench.geometry.association import associate
from dynslam_bench.geometry.trajectory import Trajectory
from dynslam_bench.geometry.trajectory_files import load_tum, read_kitti, read_tum, write_kitti, write_tum

EUROC = 1403636579763555584
"""The first stamp of EuRoC's V1_01, in nanoseconds."""
POSE = "0 0 0 0 0 0 1"


def test_text_and_nanoseconds_are_one_anothers() -> None:
    for ns in [0, 1, -1, EUROC, 2**63 - 1, *np.random.default_rng(0).integers(-(2**62), 2**62, 2000).tolist()]:
        text = stamps.format_ns(ns)
        assert stamps.parse_ns(text) == ns == int(Decimal(text).scaleb(9))


@pytest.mark.parametrize(
    ("text", "ns"),
    [
        ("12", 12_000_000_000),
        ("12.", 12_000_000_000),
        (".5", 500_000_000),
        ("+1.5", 1_500_000_000),
        ("-0.000000001", -1),
        ("1.305031102175304055e+09", 1305031102175304055),  # as evo writes it
        ("0.0333333333333333", 33_333_333),
        ("1e-30", 0),
    ],
)
def test_further_ways_to_write_a_stamp(text: str, ns: int) -> None:
    assert stamps.parse_ns(text) == ns


@pytest.mark.parametrize("text", ["nan", "inf", "", "1.2.3", "1e300", "9300000000.0", "-1e999999", "x"])
def test_what_is_no_stamp(text: str) -> None:
    with pytest.raises(ValueError, match="is not a number of seconds"):
        stamps.parse_ns(text)


def test_floats_are_those_of_the_text() -> None:
    """So that differences are TUM's and evo's to the last bit."""
    ns = np.random.default_rng(1).integers(0, 2 * 10**18, 20_000)
    ns = np.concatenate([ns, ns // 10**9, ns // 10**3, np.arange(20_000) * 50_000 + 1_305_031_102_000_000_000])
    assert stamps.to_seconds(ns).tolist() == [float(stamps.format_ns(stamp)) for stamp in ns.tolist()]
    six = [f"{1305031102 + i / 7:.6f}" for i in range(2000)]
    assert [stamps.format_ns(stamps.ns_of(float(text))) for text in six] == [f"{text}000" for text in six]


def test_files_keep_nanoseconds(tmp_path: Path) -> None:
    texts = [stamps.format_ns(EUROC + 50_000_000 * i + i) for i in range(40)]
    (tmp_path / "a.txt").write_text("".join(f"{text} {POSE}\n" for text in texts))
    read = read_tum(tmp_path / "a.txt")
    write_tum(tmp_path / "b.txt", read.select(slice(3, None)))
    assert [line.split()[0] for line in (tmp_path / "b.txt").read_text().splitlines()[1:]] == texts[3:]
    write_kitti(tmp_path / "k.txt", read, tmp_path / "times.txt")
    assert (tmp_path / "times.txt").read_text().split() == texts
    assert read_kitti(tmp_path / "k.txt", tmp_path / "times.txt").timestamps_ns.tolist() == read.timestamps_ns.tolist()
    assert (
        file_interface.read_tum_trajectory_file(tmp_path / "b.txt").timestamps.tolist() == read.timestamps[3:].tolist()
    )


@pytest.mark.parametrize("gap", [1, 200, 999])
@pytest.mark.parametrize("start", [EUROC, 0])
def test_true_poses_that_cannot_be_told_apart_are_refused_with_gap_and_lines(
    tmp_path: Path, start: int, gap: int
) -> None:
    rows = [start, start + 2_000_000, start + 1_000_000, start + 1_000_000 + gap]
    path = tmp_path / "groundtruth.txt"
    path.write_text("# a comment\n" + "".join(f"{stamps.format_ns(ns)} {POSE}\n" for ns in rows))
    with pytest.raises(TrajectoryError, match=rf"groundtruth\.txt lines 4 and 5: .* {gap} ns apart .*remove") as caught:
        load_tum(path)
    assert "\n" not in str(caught.value)


def test_equal_stamps_and_stamps_a_microsecond_apart_are_read(tmp_path: Path) -> None:
    rows = [EUROC, EUROC, EUROC + 1000, EUROC + 2000]
    (tmp_path / "a.txt").write_text("".join(f"{stamps.format_ns(ns)} {POSE}\n" for ns in rows))
    file = load_tum(tmp_path / "a.txt")
    assert file.trajectory.timestamps_ns.tolist() == rows[1:] and file.notes.duplicates == 1


def test_a_tolerance_is_met_or_missed_as_in_tums_script() -> None:
    """Differences that equal the tolerance on paper are decided by the floats of the texts, as in associate.py."""
    first = [1_305_031_102_000_000_000 + 103_700_000 * i for i in range(300)]
    second = [ns + 20_000_000 for ns in first]
    texts = [[stamps.format_ns(ns) for ns in list_] for list_ in (first, second)]
    found, _ = associate(*(stamps.to_seconds(np.array(list_)) for list_ in (first, second)), 0.02)
    expected = [i for i, (a, b) in enumerate(zip(*texts, strict=True)) if abs(float(a) - float(b)) < 0.02]
    assert 0 < len(expected) < 300 and found.tolist() == expected


def test_nanoseconds_and_poses_are_as_many() -> None:
    with pytest.raises(TrajectoryError, match="2 stamps but 1 in ns"):
        Trajectory(np.array([1.0, 2.0]), np.tile(np.eye(4), (2, 1, 1)), np.array([10**9]))
