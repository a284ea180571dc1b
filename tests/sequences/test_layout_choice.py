"""Which layout a folder has: its files tell; what is not used is said, and what cannot be read is an error."""

import shutil
from pathlib import Path

import numpy as np
import pytest
from helpers.published_folders import WRITERS, lines, random_poses
from helpers.sequence_folders import make_folder, rewrite

from dynslam_bench.core import DynslamError, SequenceError
from dynslam_bench.sequences import open_sequence
from dynslam_bench.sequences.catalogue import catalogue, entry_of
from dynslam_bench.sequences.readers.layouts import find_layout

POSES = random_poses(0)

# The name of a folder picks nothing that its files contradict.


@pytest.mark.parametrize(
    "name",
    [
        "rgbd_dataset_freiburg1_xyz",
        "rgbd_bonn_crowd",
        "living_room_traj0_frei_png",
        "rgbd_bonn_my_cut",
        "mine",
    ],
)
@pytest.mark.parametrize("layout", [layout for layout in WRITERS if layout != "tum"])
def test_a_folder_opens_by_its_files_whatever_its_name(tmp_path, layout, name):
    WRITERS[layout](tmp_path / "reference" / "s", POSES)
    WRITERS[layout](tmp_path / "named" / name, POSES)
    reference = open_sequence(tmp_path / "reference" / "s")
    sequence = open_sequence(tmp_path / "named" / name)
    assert find_layout(tmp_path / "named" / name).name == layout
    assert len(sequence) == len(reference)
    assert sequence.camera == reference.camera
    np.testing.assert_array_equal(sequence[1].depth, reference[1].depth)
    np.testing.assert_array_equal(
        sequence.ground_truth.T_world_cam, reference.ground_truth.T_world_cam
    )
    entry = entry_of(name)
    stated = layout if entry is None else entry.layout
    said = f"read in the layout {layout}, by its files; the data set is published in {stated}"
    assert (said in sequence.dropped) == (stated != layout)


@pytest.mark.parametrize(
    "name", ["living_room_traj0_frei_png", "rgbd_dataset_freiburg1_xyz", "mine"]
)
def test_plain_folders_open_under_any_name(tmp_path, name):
    folder, *_ = make_folder(tmp_path / name)
    for kind in ("rgb", "depth"):
        (folder / f"{kind}.txt").unlink()
    sequence = open_sequence(folder)
    assert len(sequence) == 4
    assert (sequence.camera.width, sequence.camera.height) == (32, 24)


def test_an_id_finds_its_folder_in_another_layout(tmp_path):
    """As VSLAM-LAB leaves a published folder."""
    for id in ("tum/fr1/xyz", "bonn/crowd"):
        place = catalogue()[id].folders(tmp_path)[0]
        WRITERS["vslam-lab"](place, POSES)
        sequence = open_sequence(id, data_root=tmp_path)
        assert sequence.id == id
        assert len(sequence) == 3


@pytest.mark.parametrize(
    "name", ["rgbd_dataset_freiburg1_xyz", "rgbd_bonn_crowd", "living_room_traj0_frei_png"]
)
def test_a_published_name_that_is_a_folder_here_says_how_to_open_that_and_it_works(
    tmp_path, monkeypatch, name
):
    monkeypatch.chdir(tmp_path)
    WRITERS["vslam-lab"](tmp_path / name, POSES)
    with pytest.raises(SequenceError, match="which is not at") as caught:
        open_sequence(name, data_root=tmp_path / "data")
    assert caught.value.hint == f"for the folder of that name here write ./{name}"
    assert (
        len(open_sequence(caught.value.hint.rpartition(" ")[2], data_root=tmp_path / "data")) == 3
    )


def test_half_of_a_published_folder_is_not_another_layout(tmp_path):
    """ETH3D's first archive holds rgb.txt; what lacks is said in its terms, and `fetch` goes on."""
    entry = catalogue()["eth3d/cables_1"]
    place = entry.folders(tmp_path)[0]
    WRITERS["eth3d"](place, POSES)
    (place / "associated.txt").unlink()
    shutil.rmtree(place / "depth")
    assert entry.find(tmp_path) is None
    assert find_layout(place, "eth3d").name == "eth3d"


# A folder that is two layouts at once: the one that is taken is said, and what is not used.


@pytest.mark.parametrize(
    ("first", "second", "taken"),
    [
        ("tum", "vslam-lab", "vslam-lab"),
        ("tum", "icl-nuim", "icl-nuim"),
        ("tum", "openloris", "openloris"),
        ("tum", "euroc", "euroc"),
        ("vslam-lab", "euroc", "vslam-lab"),
    ],
)
def test_of_two_layouts_the_one_taken_is_said(tmp_path, first, second, taken):
    folder = tmp_path / "both"
    WRITERS[first](folder, POSES)
    WRITERS[second](folder, POSES)
    other = {first, second} - {taken}
    sequence = open_sequence(folder)
    assert f"read in the layout {taken} (" in sequence.dropped
    assert f" of the layout {other.pop()} is not used" in sequence.dropped


def test_a_published_folder_with_a_second_layout_is_read_as_published(tmp_path):
    folder = tmp_path / "rgbd_dataset_freiburg3_walking_xyz"
    WRITERS["tum"](folder, POSES)
    WRITERS["vslam-lab"](folder, POSES, size=(640, 480))
    sequence = open_sequence(folder)
    assert (sequence[0].depth == 2.0).all()
    assert (
        "read in the layout tum (rgb.txt); rgb.csv, calibration.yaml of the layout vslam-lab is not used"
        in (sequence.dropped)
    )


def test_a_list_whose_images_were_moved_away_does_not_decide(tmp_path):
    """VSLAM-LAB renames rgb/ to rgb_0/ and may leave rgb.txt."""
    folder = tmp_path / "rgbd_dataset_freiburg1_xyz"
    WRITERS["vslam-lab"](folder, POSES)
    lines(folder / "rgb.txt", ["5.0 rgb/0.png", "5.1 rgb/1.png"])
    sequence = open_sequence(folder)
    assert len(sequence) == 3
    assert "rgb.txt of the layout tum is not used" in sequence.dropped


def test_a_folder_of_one_layout_says_nothing(tmp_path):
    for name, write in WRITERS.items():
        write(tmp_path / name, POSES)
        how = {"camera": "tum-fr3"} if name == "tum" else {}
        assert "not used" not in open_sequence(tmp_path / name, **how).dropped


# What is there and not used is said.


def pairs(folder, name, numbers):
    lines(
        folder / name,
        [f"{100 + i / 30:.6f} rgb/{i}.png {100 + i / 30:.6f} depth/{i}.png" for i in numbers],
    )


@pytest.mark.parametrize(
    "name", ["associations.txt", "associated.txt", "associate.txt", "association.txt"]
)
def test_pairs_beside_both_lists_are_said_to_be_unused(tmp_path, name):
    folder, *_ = make_folder(tmp_path / "rec")
    pairs(folder, name, [1, 2])
    sequence = open_sequence(folder)
    assert len(sequence) == 4
    said = f"{name} is not used: rgb.txt and depth.txt list the images"
    assert said in sequence.dropped
    assert said in sequence.remarks


@pytest.mark.parametrize(("gone", "left"), [("depth", "rgb"), ("rgb", "depth")])
def test_pairs_are_used_where_a_list_is_missing(tmp_path, gone, left):
    folder, *_ = make_folder(tmp_path / "rec")
    pairs(folder, "associations.txt", [1, 2])
    (folder / f"{gone}.txt").unlink()
    sequence = open_sequence(folder)
    assert len(sequence) == 2
    assert f"{left}.txt is not used: associations.txt lists the images" in sequence.dropped


@pytest.mark.parametrize("gone", ["depth", "rgb"])
def test_a_missing_list_is_said(tmp_path, gone):
    folder, *_ = make_folder(tmp_path / "rec")
    (folder / f"{gone}.txt").unlink()
    for i in range(4):
        (folder / gone / f"{i}.png").rename(folder / gone / f"{100 + i / 30:.6f}.png")
    sequence = open_sequence(folder)
    assert len(sequence) == 4
    assert (
        f"there is no {gone}.txt: the images of {gone}/ are stamped by their names"
        in sequence.dropped
    )


def test_a_second_truth_and_a_second_list_of_pairs_are_said(tmp_path):
    folder, *_ = make_folder(tmp_path / "rec")
    (folder / "pose.txt").write_text("100 0 0 0 0 0 0 1\n")
    for name in ("rgb.txt", "depth.txt"):
        (folder / name).unlink()
    pairs(folder, "associations.txt", range(4))
    pairs(folder, "associated.txt", [0])
    dropped = open_sequence(folder).dropped
    assert "pose.txt is not used: groundtruth.txt is taken" in dropped
    assert "associated.txt is not used: associations.txt is taken" in dropped


def test_masks_are_read_beside_pairs(tmp_path):
    """They were left out without a word."""
    folder, *_ = make_folder(tmp_path / "rec", frames=2)
    for name in ("rgb.txt", "depth.txt"):
        (folder / name).unlink()
    pairs(folder, "associations.txt", range(2))
    (folder / "people").mkdir()
    import cv2

    for i in range(2):
        cv2.imwrite(str(folder / "people" / f"{i}.png"), np.full((24, 32), i, np.uint8))
    lines(folder / "people.txt", [f"{100 + i / 30:.6f} people/{i}.png" for i in range(2)])
    assert (open_sequence(folder).masks[1].instances == 1).all()


def test_poses_of_other_layouts_that_are_not_taken_are_counted(tmp_path):
    for name, table in (
        ("vslam-lab", "groundtruth.csv"),
        ("euroc", "mav0/state_groundtruth_estimate0/data.csv"),
    ):
        WRITERS[name](tmp_path / name, POSES)
        rows = (tmp_path / name / table).read_text().splitlines()
        zero = [*rows[-1].split(",")[:4], "0", "0", "0", "0", *rows[-1].split(",")[8:]]
        (tmp_path / name / table).write_text("\n".join([*rows[:-1], ",".join(zero)]) + "\n")
        sequence = open_sequence(tmp_path / name)
        assert len(sequence.ground_truth) == 2
        assert "ground truth: " in sequence.dropped
        (tmp_path / name / table).write_text("\n".join([rows[0], ",".join(zero)]) + "\n")
        assert "ground truth: no row of" in open_sequence(tmp_path / name).dropped


# A name that is there but is no file is an error, never a reason to take something else.


def dangling(path):
    path.unlink(missing_ok=True)
    path.symlink_to("nowhere/at/all.txt")


def folder_of_that_name(path):
    path.unlink(missing_ok=True)
    path.mkdir()


def link_to_itself(path):
    path.unlink(missing_ok=True)
    path.symlink_to(path.name)


@pytest.mark.parametrize("damage", [dangling, folder_of_that_name, link_to_itself])
@pytest.mark.parametrize(
    "name",
    ["rgb.txt", "depth.txt", "groundtruth.txt", "associations.txt", "people.txt", "camera.toml"],
)
def test_a_file_that_cannot_be_one_is_refused(tmp_path, name, damage):
    """rgb.txt as a link to nowhere gave the images of the folder instead."""
    folder, *_ = make_folder(tmp_path / "rec")
    for i in range(4):
        for kind in ("rgb", "depth"):
            shutil.copy(folder / kind / f"{i}.png", folder / kind / f"{200 + i}.5.png")
    damage(folder / name)
    with pytest.raises(SequenceError, match=name) as caught:
        open_sequence(folder)
    assert "\n" not in str(caught.value)
    if damage is dangling:
        assert "is a link to nowhere/at/all.txt, which is not there" in str(caught.value)


@pytest.mark.parametrize(
    ("layout", "file"),
    [
        ("vslam-lab", "groundtruth.csv"),
        ("vslam-lab", "rgb.csv"),
        ("vslam-lab", "calibration.yaml"),
        ("euroc", "mav0/state_groundtruth_estimate0/data.csv"),
        ("euroc", "mav0/depth0/sensor.yaml"),
        ("eth3d", "associated.txt"),
        ("openloris", "color.txt"),
        ("openloris", "groundtruth.txt"),
        ("icl-nuim", "livingRoom0.gt.freiburg"),
    ],
)
def test_likewise_in_other_layouts(tmp_path, layout, file):
    WRITERS[layout](tmp_path / "s", POSES)
    dangling(tmp_path / "s" / file)
    with pytest.raises(DynslamError, match=Path(file).name) as caught:
        open_sequence(tmp_path / "s")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("content", ["", "# nothing\n", "\n\n"])
def test_an_empty_list_is_refused_where_it_would_be_used(tmp_path, content):
    folder, *_ = make_folder(tmp_path / "rec")
    for name in ("rgb.txt", "depth.txt"):
        (folder / name).unlink()
    (folder / "associations.txt").write_text(content)
    with pytest.raises(SequenceError, match=r"associations.txt lists no image"):
        open_sequence(folder)


def test_links_that_lead_somewhere_are_followed(tmp_path):
    folder, *_ = make_folder(tmp_path / "rec")
    for name in ("rgb.txt", "groundtruth.txt", "camera.toml"):
        (folder / name).rename(tmp_path / name)
        (folder / name).symlink_to(tmp_path / name)
    sequence = open_sequence(folder)
    assert len(sequence) == 4
    assert len(sequence.ground_truth) == 4
    rewrite(tmp_path / "rgb.txt", lambda lines: lines[:-1])
    assert len(open_sequence(folder)) == 3
