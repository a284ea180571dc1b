"""Images of folders without lists: what their names are, and what a user is told where they may be two things."""

import cv2
import numpy as np
import pytest
from helpers.sequence_folders import make_folder, rewrite

from dynslam_bench.core import SequenceError
from dynslam_bench.sequences import open_sequence
from dynslam_bench.sequences.cameras import CameraError

CAMERA = (
    "width = 32\nheight = 24\nfx = 30.0\nfy = 30.5\ncx = 15.5\ncy = 11.5\ndepth_factor = 5000.0\n"
)


def named(folder, names, fps=None, suffix=".png"):
    """A recording without lists whose images have these names."""
    for kind, image in (
        ("rgb", np.full((24, 32, 3), 90, np.uint8)),
        ("depth", np.full((24, 32), 10000, np.uint16)),
    ):
        (folder / kind).mkdir(parents=True)
        for name in names:
            cv2.imwrite(str(folder / kind / f"{name}{suffix}"), image)
    (folder / "camera.toml").write_text(CAMERA + ("" if fps is None else f"fps = {fps}\n"))
    return folder


UNIX = {
    "seconds": [1_700_000_000, 1_700_000_001, 1_700_000_002],
    "milliseconds": [1_700_000_000_000, 1_700_000_000_033, 1_700_000_000_067],
    "microseconds": [1_700_000_000_000_000, 1_700_000_000_033_333, 1_700_000_000_066_667],
    "nanoseconds": [
        1_700_000_000_000_000_000,
        1_700_000_000_033_333_000,
        1_700_000_000_066_666_000,
    ],
}
PER_S = {"seconds": 1, "milliseconds": 10**3, "microseconds": 10**6, "nanoseconds": 10**9}


@pytest.mark.parametrize("fps", [None, 30.0])
@pytest.mark.parametrize("unit", UNIX)
def test_unix_time_is_read_in_its_unit_to_the_last_digit(tmp_path, unit, fps):
    """Names of nanoseconds with fps = 30 crashed; the size of the numbers says the unit."""
    sequence = open_sequence(named(tmp_path / "rec", UNIX[unit], fps))
    assert sequence.timestamps_ns.tolist() == [
        number * (10**9 // PER_S[unit]) for number in UNIX[unit]
    ]
    assert sequence.fps == pytest.approx(1.0 if unit == "seconds" else 30.0, rel=0.02)


@pytest.mark.parametrize("start", [1_262_304_000, 2_000_000_000])
def test_other_years_are_read_as_well(tmp_path, start):
    numbers = [start * 10**9 + i * 50_000_000 for i in range(3)]
    sequence = open_sequence(named(tmp_path / "rec", numbers))
    assert sequence.timestamps_ns.tolist() == numbers
    assert sequence.fps == pytest.approx(20.0)


SINCE_BOOT = {
    "ms": ([123456, 123489, 123522], 30.0, "milliseconds", 10**3),
    "ms at 15 Hz": ([9000, 9067, 9133], 15.0, "milliseconds", 10**3),
    "ms under a wrong rate": ([5000, 5100, 5200], 30.0, "milliseconds", 10**3),
    "us": ([7_000_000, 7_033_333, 7_066_667], 30.0, "microseconds", 10**6),
    "ns": (
        [123_456_789_012_345, 123_456_822_345_678, 123_456_855_679_011],
        30.0,
        "nanoseconds",
        10**9,
    ),
}


@pytest.mark.parametrize("stated", [True, False])
@pytest.mark.parametrize("case", SINCE_BOOT)
def test_time_since_boot_is_refused_with_both_readings_and_the_hint_works(tmp_path, case, stated):
    """Names that go up by a frame time are hardly frame numbers; a list decides."""
    numbers, fps, unit, per_s = SINCE_BOOT[case]
    folder = named(tmp_path / "rec", numbers, fps if stated else None)
    for kind in ("rgb", "depth"):
        with pytest.raises(
            SequenceError, match=f"go up by {np.median(np.diff(numbers)):.12g}: {unit} would be"
        ) as caught:
            open_sequence(folder)
        assert "\n" not in str(caught.value)
        line = f"{numbers[0] // per_s}.{numbers[0] % per_s * (10**9 // per_s):09d} {kind}/{numbers[0]}.png"
        assert (
            f"write {kind}.txt with a line an image, in seconds: '{line}' if the names are {unit}"
            in caught.value.hint
        )
        listed = [f"{number / per_s:.9f} {kind}/{number}.png\n" for number in numbers]
        (folder / f"{kind}.txt").write_text("".join(listed))
    sequence = open_sequence(folder)
    assert len(sequence) == 3
    np.testing.assert_allclose(np.diff(sequence.timestamps), np.diff(numbers) / per_s, rtol=1e-6)
    assert sequence.fps == pytest.approx(per_s / np.median(np.diff(numbers)), rel=0.25)


def test_the_other_reading_of_the_hint_works_too(tmp_path):
    """Every 33rd frame of 30 a second."""
    numbers = [33, 66, 99]
    folder = named(tmp_path / "rec", numbers, 30.0)
    with pytest.raises(SequenceError) as caught:
        open_sequence(folder)
    assert "'1.100000000 rgb/33.png' if they are frame numbers" in caught.value.hint
    for kind in ("rgb", "depth"):
        (folder / f"{kind}.txt").write_text(
            "".join(f"{number / 30:.9f} {kind}/{number}.png\n" for number in numbers)
        )
    sequence = open_sequence(folder)
    np.testing.assert_allclose(sequence.timestamps, [1.1, 2.2, 3.3], atol=1e-8)
    assert sequence.fps == pytest.approx(1 / 1.1)


def test_frame_numbers_get_their_times_from_the_frame_rate_and_both_hints_work(tmp_path):
    folder = named(tmp_path / "rec", [f"{i:06d}" for i in range(3)])
    with pytest.raises(SequenceError, match="named by a frame number, which has no time") as caught:
        open_sequence(folder)
    assert "'fps = 30' into the camera.toml" in caught.value.hint
    assert "rgb.txt with lines 'timestamp rgb/000000.png'" in caught.value.hint
    rewrite(folder / "camera.toml", lambda lines: [*lines, "fps = 30"])
    by_rate = open_sequence(folder)
    np.testing.assert_allclose(by_rate.timestamps, [0, 1 / 30, 2 / 30], atol=1e-8)
    (folder / "camera.toml").write_text(CAMERA)
    for kind in ("rgb", "depth"):
        (folder / f"{kind}.txt").write_text(
            "".join(f"{i / 30:.9f} {kind}/{i:06d}.png\n" for i in range(3))
        )
    np.testing.assert_allclose(open_sequence(folder).timestamps, by_rate.timestamps, atol=1e-8)


def test_the_frame_rate_in_a_camera_file_of_its_own_counts_too(tmp_path):
    folder = named(tmp_path / "rec", range(3))
    (tmp_path / "mine.toml").write_text(CAMERA + "fps = 25\n")
    assert open_sequence(folder, camera=tmp_path / "mine.toml").timestamps.tolist() == [
        0,
        0.04,
        0.08,
    ]


@pytest.mark.parametrize(
    ("numbers", "missing", "rate"),
    [
        ([0, 1, 2, 5, 6], 2, 30.0),
        ([10, 12, 14, 16], 3, 15.0),
        ([0, 10, 20], 18, 3.0),
        ([7, 8, 9], 0, 30.0),
    ],
)
def test_left_out_frame_numbers_are_counted_and_the_rate_is_that_of_the_stamps(
    tmp_path, numbers, missing, rate
):
    sequence = open_sequence(named(tmp_path / "rec", numbers, 30.0))
    np.testing.assert_allclose(sequence.timestamps, np.array(numbers) / 30, atol=1e-8)
    assert sequence.fps == pytest.approx(rate)
    said = f"{2 * missing} frame numbers without an image"  # colour and depth
    assert (said in sequence.dropped) == (missing > 0)


def test_a_number_beyond_all_time_is_one_line(tmp_path):
    for place, number in (("a", 10**30), ("b", 10**80)):
        folder = named(tmp_path / place, [number, number + 1, number + 2], 30.0)
        with pytest.raises(SequenceError, match="is no frame number at 30 Hz") as caught:
            open_sequence(folder)
        assert "\n" not in str(caught.value)


def test_names_with_and_without_a_point_are_all_seconds(tmp_path):
    folder = named(tmp_path / "rec", ["1700000000", "1700000000.1", "1700000000.2"], 30.0)
    assert open_sequence(folder).timestamps.tolist() == [1700000000, 1700000000.1, 1700000000.2]


@pytest.mark.parametrize(
    ("text", "unit"),
    [
        ("1700000000000000000", "nanoseconds"),
        ("1700000000000.5", "milliseconds"),
        ("1700000000000000", "microseconds"),
    ],
)
def test_a_list_in_another_unit_is_refused_with_the_unit(tmp_path, text, unit):
    folder, *_ = make_folder(tmp_path / "rec")
    rewrite(folder / "rgb.txt", lambda lines: [f"{text} rgb/0.png", *lines[1:]])
    with pytest.raises(SequenceError, match="is not a timestamp in seconds") as caught:
        open_sequence(folder)
    assert f"it looks like {unit} of Unix time" in caught.value.hint


def test_a_table_in_another_unit_is_refused(tmp_path):
    """Microseconds in a column of nanoseconds are frames 33 us apart."""
    from helpers.published_folders import random_poses, write_vslam_lab

    write_vslam_lab(tmp_path / "rec", random_poses(0))
    for table in ("rgb.csv", "groundtruth.csv"):
        text = (tmp_path / "rec" / table).read_text()
        for i in range(3):
            stamp = 1403636579763555584 + i * 33_333_333
            text = text.replace(str(stamp), str(stamp // 1000))
        (tmp_path / "rec" / table).write_text(text)
    with pytest.raises(SequenceError, match="faster than any camera"):
        open_sequence(tmp_path / "rec")


def test_files_that_are_no_images_are_counted(tmp_path):
    folder = named(tmp_path / "rec", range(3), 30.0)
    (folder / "rgb" / "0003.webp").write_bytes(b"x")
    (folder / "rgb" / ".hidden").write_bytes(b"x")
    assert "1 files that are no images" in open_sequence(folder).dropped


@pytest.mark.parametrize("stem", ["frame_1_", "left-1-2", "0000a"])
def test_names_that_are_no_numbers_say_what_to_write_and_it_works(tmp_path, stem):
    folder = named(tmp_path / "rec", [f"{stem}{i}" for i in range(3)])
    for kind in ("rgb", "depth"):
        with pytest.raises(SequenceError, match="is not a timestamp in seconds") as caught:
            open_sequence(folder)
        assert caught.value.hint == f"write {kind}.txt with lines 'timestamp {kind}/FILE'"
        (folder / f"{kind}.txt").write_text(
            "".join(f"{i / 30:.9f} {kind}/{stem}{i}.png\n" for i in range(3))
        )
    assert len(open_sequence(folder)) == 3


@pytest.mark.parametrize(
    ("colour", "names", "suffix"),
    [
        ("color", ["frame_0001", "frame_0002", "frame_0003"], ".jpg"),
        ("colour", ["000001", "000002", "000003"], ".jpeg"),
        ("image", ["1.color", "2.color", "3.color"], ".png"),
        ("images", ["img1", "img2", "img3"], ".png"),
    ],
)
def test_folders_and_names_of_other_tools_are_read(tmp_path, colour, names, suffix):
    folder = named(tmp_path / "rec", names, 30.0)
    for path in sorted((folder / "rgb").iterdir()):
        cv2.imwrite(str(path.with_name(path.stem + suffix)), cv2.imread(str(path)))
        if suffix != ".png":
            path.unlink()
    (folder / "rgb").rename(folder / colour)
    sequence = open_sequence(folder)
    np.testing.assert_allclose(sequence.timestamps, [1 / 30, 2 / 30, 3 / 30], atol=1e-8)
    assert (
        f"colour in {colour}, depth in depth, 3 frames at 30 Hz (stated)" in sequence.taken_for[0]
    )
    assert "5000 raw depth units a metre" in sequence.taken_for[1]
    assert sequence.taken_for[2] == "no ground truth"


def test_of_two_folders_of_colour_the_one_that_is_not_taken_is_named(tmp_path):
    folder = named(tmp_path / "rec", ["1", "2"], 30.0)
    (folder / "image").mkdir()
    sequence = open_sequence(folder)
    assert "image/ is not used: rgb/ is taken" in sequence.dropped
    # the table of the runs has it as a warning
    (remark,) = sequence.remarks
    assert remark not in " ".join(sequence.taken_for)


@pytest.mark.parametrize("names", [["a1", "b2"], ["1-2", "2-3"], ["first", "second"]])
def test_names_that_differ_in_more_than_a_number_are_refused(tmp_path, names):
    with pytest.raises(SequenceError, match="is not a timestamp in seconds"):
        open_sequence(named(tmp_path / "rec", names, 30.0))


def test_one_camera_file_asks_for_all_that_is_missing(tmp_path):
    folder = named(tmp_path / "rec", ["1", "2", "3"])
    (folder / "camera.toml").unlink()
    with pytest.raises(CameraError) as caught:
        open_sequence(folder)
    template = caught.value.template
    assert "width = 32" in template
    filled = (
        template.replace("fx = ", "fx = 30 ")
        .replace("fy =", "fy = 30")
        .replace("cx = ", "cx = 16 ")
    )
    filled = filled.replace("cy =", "cy = 12").replace("fps = ", "fps = 30 ")
    (folder / "camera.toml").write_text(
        filled.replace("# depth_factor = 5000", "depth_factor = 5000")
    )
    assert open_sequence(folder).fps == 30.0
