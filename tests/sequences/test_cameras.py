"""The camera of a recording: all of it travels with every way of naming it, and nothing is guessed."""

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers.published_folders import WRITERS, random_poses
from helpers.sequence_folders import make_folder, rewrite

from dynslam_bench.contracts import Frame
from dynslam_bench.core import DynslamError, SequenceError
from dynslam_bench.envs import SlamEnv
from dynslam_bench.geometry import Camera, Trajectory, read_tum, se3
from dynslam_bench.geometry.rigs import BONN_R_BODY_CAM, nearest_rotation
from dynslam_bench.sequences import open_sequence
from dynslam_bench.sequences.bags import camera_of as camera_of_bag
from dynslam_bench.sequences.cameras import (
    CAMERA_FILE,
    CAMERAS,
    CameraError,
    check_camera,
    read_camera,
    write_camera,
)
from dynslam_bench.sequences.compose import compose
from dynslam_bench.sequences.doctor import diagnose
from dynslam_bench.sequences.fetch import verify

INTRINSICS = "width = 32\nheight = 24\nfx = 30.0\nfy = 30.5\ncx = 15.5\ncy = 11.5\n"
IDENTITY = "R_body_cam = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]\n"


def recording(folder, camera_file=None):
    """Three full-size frames with turned true poses; returns the folder."""
    folder, *_ = make_folder(folder, frames=3, width=640, height=480)
    truth = [f"{100 + i / 30!r} 0.{i} 0 0 0.1 0.2 0.3 0.9273618\n" for i in range(3)]
    (folder / "groundtruth.txt").write_text("".join(truth))
    (folder / CAMERA_FILE).unlink()
    if camera_file is not None:
        (folder / CAMERA_FILE).write_text(camera_file)
    return folder


def small(folder, camera_file):
    """Four small frames, their depth about 2 m at 5000 units a metre."""
    folder, *_ = make_folder(folder)
    (folder / CAMERA_FILE).write_text(camera_file)
    return folder


# What belongs to the camera does not hang on how it is named.


def written_by_write_camera(folder, name):
    write_camera(folder / CAMERA_FILE, CAMERAS[name])
    return open_sequence(folder)


def written_as_calibrate_writes(folder, name):
    """The camera of the opened sequence, with one value measured."""
    opened = open_sequence(folder, camera=name)
    write_camera(
        folder / "calibrated.toml", replace(opened.camera, depth_delay_s=0.0), fps=opened.fps
    )
    return open_sequence(folder, camera=folder / "calibrated.toml")


def named_in_the_folder_s_file(folder, name):
    (folder / CAMERA_FILE).write_text(f'name = "{name}"\n')
    return open_sequence(folder)


def named_in_another_file(folder, name):
    (folder / "mine.toml").write_text(f'name = "{name}"\n')
    return open_sequence(folder, camera=str(folder / "mine.toml"))


def named_by_the_folder(folder, name):
    prefix = {
        "bonn": "rgbd_bonn_",
        "tum-fr1": "rgbd_dataset_freiburg1_",
        "tum-fr3": "rgbd_dataset_freiburg3_",
    }[name]
    return open_sequence(folder.rename(folder.parent / f"{prefix}my_cut"))


WAYS = {
    "--camera": lambda folder, name: open_sequence(folder, camera=name),
    "object": lambda folder, name: open_sequence(folder, camera=CAMERAS[name]),
    "name in the folder": named_in_the_folder_s_file,
    "name in a file": named_in_another_file,
    "folder name": named_by_the_folder,
    "write_camera": written_by_write_camera,
    "calibrate": written_as_calibrate_writes,
}


@pytest.mark.slow
@pytest.mark.parametrize("name", ["bonn", "tum-fr1", "tum-fr3"])
@pytest.mark.parametrize("way", WAYS)
def test_every_way_of_naming_a_camera_gives_the_same_sequence(tmp_path, way, name):
    """Truth, depth, rolling shutter, distortion, baseline and frame rate."""
    reference = open_sequence(recording(tmp_path / "reference"), camera=name)
    sequence = WAYS[way](recording(tmp_path / "other"), name)
    np.testing.assert_array_equal(
        sequence.ground_truth.T_world_cam, reference.ground_truth.T_world_cam
    )
    np.testing.assert_array_equal(sequence[1].depth, reference[1].depth)
    assert sequence.camera == reference.camera == CAMERAS[name]
    assert sequence.fps == reference.fps
    assert sequence.digest() == reference.digest()


def test_bonn_s_truth_is_turned_once_into_the_camera_s_axes(tmp_path):
    folder = recording(tmp_path / "rec", 'name = "bonn"\n')
    markers = read_tum(folder / "groundtruth.txt")
    truth = open_sequence(folder).ground_truth
    np.testing.assert_array_equal(truth.positions, markers.positions)
    turns = se3.inverse(markers.T_world_cam) @ truth.T_world_cam
    for turn in turns:
        np.testing.assert_allclose(turn[:3, :3], nearest_rotation(BONN_R_BODY_CAM), atol=1e-9)
    assert "turned into the camera's axes" in open_sequence(folder).dropped


def test_a_rig_of_one_s_own_is_stated_in_the_camera_file(tmp_path):
    """A body whose x axis is the camera's z axis."""
    folder = recording(tmp_path / "rec", 'name = "tum-fr3"\n')
    body = open_sequence(folder).ground_truth
    turned = "R_body_cam = [[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]\n"
    (folder / CAMERA_FILE).write_text('name = "tum-fr3"\n' + turned)
    sequence = open_sequence(folder)
    R_body_cam = np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])
    np.testing.assert_allclose(
        sequence.ground_truth.T_world_cam[:, :3, :3],
        body.T_world_cam[:, :3, :3] @ R_body_cam,
        atol=1e-12,
    )
    write_camera(folder / CAMERA_FILE, sequence.camera)
    np.testing.assert_array_equal(
        open_sequence(folder).ground_truth.T_world_cam, sequence.ground_truth.T_world_cam
    )


def test_a_data_set_s_rig_holds_under_intrinsics_of_one_s_own(tmp_path):
    reference = open_sequence(recording(tmp_path / "reference"), camera="bonn")
    own = "width = 640\nheight = 480\nfx = 540.0\nfy = 541.0\ncx = 315.0\ncy = 238.0\ndepth_factor = 5000\n"
    catalogued = open_sequence(recording(tmp_path / "rgbd_bonn_crowd", own))
    uncatalogued = open_sequence(recording(tmp_path / "rgbd_bonn_my_cut", own))
    elsewhere = open_sequence(recording(tmp_path / "mine", own))
    for sequence in (catalogued, uncatalogued):
        np.testing.assert_array_equal(
            sequence.ground_truth.T_world_cam, reference.ground_truth.T_world_cam
        )
        assert sequence.camera.fx == 540.0
    assert (
        np.abs(elsewhere.ground_truth.T_world_cam - reference.ground_truth.T_world_cam).max() > 0.1
    )


def test_the_identity_says_that_the_poses_are_the_camera_s(tmp_path):
    folder = recording(tmp_path / "rgbd_bonn_my_cut", 'name = "bonn"\n' + IDENTITY)
    np.testing.assert_array_equal(
        open_sequence(folder).ground_truth.T_world_cam,
        read_tum(folder / "groundtruth.txt").T_world_cam,
    )


@pytest.mark.slow
@pytest.mark.parametrize("target", ["made", "rgbd_bonn_made"])
def test_a_composite_of_bonn_is_not_turned_a_second_time(tmp_path, target):
    """`compose` writes poses in the camera's axes."""

    class Host:
        """A wall, filmed by Bonn's camera."""

        id = "host"
        license = ""
        citation = ""
        masks = None
        fps = 30.0
        camera = replace(
            CAMERAS["bonn"], width=160, height=120, fx=130.0, fy=130.0, cx=79.5, cy=59.5
        )
        timestamps = np.round(100 + np.arange(6) / 30, 6)
        ground_truth = Trajectory(
            timestamps, np.tile(se3.exp(np.array([0, 0, 0, 0.3, 0.2, 0.1])), (6, 1, 1))
        )
        walker = False

        def digest(self):
            return "h"

        def __len__(self):
            return 6

        def __getitem__(self, index):
            rgb = np.random.default_rng(1).integers(60, 200, (120, 160, 3)).astype(np.uint8)
            depth = np.full((120, 160), 3.0, np.float32)
            if self.walker and 1 <= index < 5:
                left = 40 + 15 * index
                rgb[20:110, left : left + 30] = (200, 40, 40)
                depth[20:110, left : left + 30] = 1.5
            return Frame(index, float(self.timestamps[index]), rgb, depth)

    people = type("People", (Host,), {"walker": True, "ground_truth": None})()
    compose(Host(), people, tmp_path / target, 0)
    composed = open_sequence(tmp_path / target)
    np.testing.assert_allclose(
        composed.ground_truth.T_world_cam, Host.ground_truth.T_world_cam, atol=1e-9
    )


def test_bodies_of_other_layouts_are_carried_to_the_camera_once(tmp_path):
    """A truth that ``T_BS`` has made the camera's is not turned by the camera's rig; one of an identity is."""
    poses = random_poses(0)
    for name in ("vslam-lab", "euroc"):
        WRITERS[name](tmp_path / name, poses)
        stated = replace(open_sequence(tmp_path / name).camera, R_body_cam=BONN_R_BODY_CAM)
        np.testing.assert_allclose(
            open_sequence(tmp_path / name, camera=stated).ground_truth.T_world_cam,
            poses,
            atol=1e-12,
        )
    calibration = tmp_path / "vslam-lab" / "calibration.yaml"
    text = calibration.read_text()
    start = text.index("T_BS: [")
    end = text.index("]", text.index("T_BS: ["))
    calibration.write_text(f"{text[:start]}T_BS: [1,0,0,0, 0,1,0,0, 0,0,1,0, 0,0,0,1{text[end:]}")
    body = open_sequence(tmp_path / "vslam-lab").ground_truth.T_world_cam
    turned = open_sequence(
        tmp_path / "vslam-lab", camera=stated_by_bonn(tmp_path / "vslam-lab")
    ).ground_truth
    np.testing.assert_allclose(
        turned.T_world_cam[:, :3, :3],
        body[:, :3, :3] @ nearest_rotation(BONN_R_BODY_CAM),
        atol=1e-9,
    )


def stated_by_bonn(folder):
    return replace(open_sequence(folder).camera, R_body_cam=BONN_R_BODY_CAM)


def test_a_camera_file_that_another_camera_replaces_is_said(tmp_path):
    folder = recording(tmp_path / "rec", 'name = "tum-fr1"\n')
    said = "camera.toml of the folder is not used: another camera was chosen"
    for choice in ("tum-fr3", CAMERAS["bonn"]):
        assert said in open_sequence(folder, camera=choice).dropped
    assert said not in open_sequence(folder).dropped


def test_what_a_file_states_beside_a_name_counts(tmp_path):
    """It was ignored, so that depth in millimetres was read as TUM's."""
    text = 'name = "tum-fr1"\ndepth_factor = 1000.0\nreadout_s = 0.0\nfx = 500.0\n'
    camera = open_sequence(recording(tmp_path / "rec", text)).camera
    assert camera == replace(CAMERAS["tum-fr1"], depth_factor=1000.0, readout_s=0.0, fx=500.0)


def test_a_file_without_intrinsics_adds_to_what_the_folder_says(tmp_path):
    WRITERS["vslam-lab"](tmp_path / "s", random_poses(0))
    before = open_sequence(tmp_path / "s")
    (tmp_path / "s" / CAMERA_FILE).write_text("readout_s = 0.02\ndepth_factor = 2000.0\n")
    after = open_sequence(tmp_path / "s")
    assert after.camera == replace(before.camera, readout_s=0.02, depth_factor=2000.0)
    assert (after[0].depth == 1.0).all()
    (tmp_path / "s" / CAMERA_FILE).write_text("fx = 60.0\nfy = 60.0\n")
    with pytest.raises(CameraError, match=r"lacks width, height, cx, cy"):
        open_sequence(tmp_path / "s")


def test_all_of_a_camera_is_written(tmp_path):
    """Whatever field a camera has, it comes back."""
    turn = ((0.0, 0.0, 1.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0))
    lens = (0.1, -0.2, 1e-4, -2e-5, 0.3)
    camera = Camera(320, 200, 300.1, 301.2, 159.5, 99.5, lens, 1000.0, 0.05, 0.02, -1 / 30, turn)
    for stated in (camera, replace(camera, depth_factor=None, R_body_cam=None), *CAMERAS.values()):
        write_camera(tmp_path / CAMERA_FILE, stated, fps=15)
        file = read_camera(tmp_path / CAMERA_FILE)
        assert file.camera() == stated
        assert file.fps == 15


# The depth factor is stated, or the recording is refused with a file to copy.


def vslam_lab_without(folder):
    WRITERS["vslam-lab"](folder, random_poses(0))
    text = (folder / "calibration.yaml").read_text()
    (folder / "calibration.yaml").write_text(text.replace("     depth_factor: 1000.0,\n", ""))
    return {"name": folder}


def euroc_without(folder):
    WRITERS["euroc"](folder, random_poses(0))
    (folder / "mav0" / "depth0" / "sensor.yaml").unlink()
    return {"name": folder}


def in_a_file(folder):
    small(folder, INTRINSICS)
    (folder / CAMERA_FILE).rename(folder / "mine.toml")
    return {"name": folder, "camera": folder / "mine.toml"}


def beside_associations(folder):
    small(folder, INTRINSICS)
    for name in ("rgb.txt", "depth.txt"):
        (folder / name).unlink()
    pairs = [f"{100 + i / 30:.6f} rgb/{i}.png {100 + i / 30:.6f} depth/{i}.png\n" for i in range(4)]
    (folder / "associations.txt").write_text("".join(pairs))
    return {"name": folder}


WITHOUT_FACTOR = {
    "folder": lambda folder: {"name": small(folder, INTRINSICS + "fps = 30\n")},
    "--camera FILE": in_a_file,
    "Camera": lambda folder: {
        "name": small(folder, ""),
        "camera": Camera(32, 24, 30.0, 30.5, 15.5, 11.5),
    },
    "associations": beside_associations,
    "vslam-lab": vslam_lab_without,
    "euroc": euroc_without,
    "published name": lambda folder: {
        "name": small(folder.parent / "rgbd_dataset_freiburg1_xyz", INTRINSICS),
    },
}


@pytest.mark.parametrize("entrance", WITHOUT_FACTOR)
def test_depth_without_a_stated_factor_is_refused_at_every_entrance(tmp_path, entrance):
    how = WITHOUT_FACTOR[entrance](tmp_path / "rec")
    with pytest.raises(CameraError, match="nothing says how many make a metre") as caught:
        open_sequence(**how)
    assert "\n" not in str(caught.value)
    for part in (
        "width = ",
        "height = ",
        "fx = ",
        "depth_factor = 1000.0",
        "depth_factor = 5000.0",
    ):
        assert part in caught.value.template
        assert part in str(caught.value)


@pytest.mark.parametrize("factor", [1000.0, 5000.0])
@pytest.mark.parametrize("entrance", WITHOUT_FACTOR)
def test_the_printed_file_opens_the_recording_once_a_line_is_chosen(tmp_path, entrance, factor):
    how = WITHOUT_FACTOR[entrance](tmp_path / "rec")
    with pytest.raises(CameraError) as caught:
        open_sequence(**how)
    template = caught.value.template
    chosen = template.replace(f"# depth_factor = {factor}", f"depth_factor = {factor}")
    assert chosen != template
    path = how["name"] / CAMERA_FILE
    if isinstance(how.get("camera"), Path):
        path = how["camera"]
    how = {key: value for key, value in how.items() if not isinstance(value, Camera)}
    path.write_text(template)
    with pytest.raises(CameraError):  # nothing was chosen
        open_sequence(**how)
    path.write_text(chosen)
    sequence = open_sequence(**how)
    raw = cv2.imread(str(sorted(how["name"].glob("**/depth*/**/*.png"))[0]), cv2.IMREAD_UNCHANGED)
    np.testing.assert_allclose(sequence[0].depth, raw / factor, rtol=1e-6)


def test_the_hint_says_which_distance_each_factor_gives(tmp_path):
    folder = small(tmp_path / "rec", INTRINSICS)
    for path in (folder / "depth").iterdir():
        cv2.imwrite(str(path), np.full((24, 32), 1720, np.uint16))
    with pytest.raises(CameraError) as caught:
        open_sequence(folder)
    assert "depth_factor = 1000.0 (millimetres) if the scene is 1.72 m away" in caught.value.hint
    assert "depth_factor = 5000.0 (TUM's files) if it is 0.344 m" in caught.value.hint


def test_an_unknown_camera_brings_the_same_file(tmp_path):
    folder = small(tmp_path / "rec", "")
    (folder / CAMERA_FILE).unlink()
    with pytest.raises(CameraError, match="is not known") as caught:
        open_sequence(folder)
    lines = caught.value.template.splitlines()
    assert lines[0].startswith("width = 32")
    assert lines[1] == "height = 24"
    assert lines[2].startswith("fx =  ")
    (folder / CAMERA_FILE).write_text(caught.value.template)
    with pytest.raises(SequenceError, match="not valid TOML"):  # it has to be completed
        open_sequence(folder)


def test_arrays_of_metres_need_no_factor(tmp_path):
    folder = small(tmp_path / "rec", INTRINSICS)
    for path in sorted((folder / "depth").iterdir()):
        np.save(path.with_suffix(".npy"), np.full((24, 32), 1.5, np.float32))
    rewrite(folder / "depth.txt", lambda lines: [line.replace(".png", ".npy") for line in lines])
    assert (open_sequence(folder)[0].depth == 1.5).all()


def test_layouts_whose_publisher_states_the_unit_keep_it_under_another_camera(tmp_path):
    """7-Scenes' depth is in millimetres, ETH3D's and ICL-NUIM's in TUM's units."""
    for name, factor in (
        ("7-scenes", 1000.0),
        ("eth3d", 5000.0),
        ("icl-nuim", 5000.0),
        ("openloris", 1000.0),
    ):
        WRITERS[name](tmp_path / name, random_poses(0))
        before = open_sequence(tmp_path / name).camera
        other = Camera(before.width, before.height, 400.0, 400.0, 300.0, 200.0)
        sequence = open_sequence(tmp_path / name, camera=other)
        assert sequence.camera.depth_factor == factor
        assert (sequence[0].depth == 2.0).all()


def test_checks_of_a_recording_name_the_missing_factor(tmp_path):
    folder = small(tmp_path / "rec", INTRINSICS)
    (finding,) = diagnose(folder).findings
    assert finding.severity == "fault"
    assert "depth_factor" in finding.text
    assert "depth_factor = 1000.0" in finding.cure
    with pytest.raises(CameraError):
        verify(str(folder))


@pytest.mark.slow
def test_the_command_line_prints_the_file_as_it_stands(tmp_path):
    folder = small(tmp_path / "rec", INTRINSICS)
    command = [sys.executable, "-m", "dynslam_bench", "sequences", "info", str(folder)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 1
    error, *lines = done.stderr.splitlines()
    assert error.startswith("error: the depth images of ")
    assert lines[0].startswith("width = 32")
    (folder / CAMERA_FILE).write_text(
        "\n".join(lines).replace("# depth_factor = 5000.0", "depth_factor = 5000.0")
    )
    done = subprocess.run([*command, "--json"], capture_output=True, text=True, check=True)
    assert json.loads(done.stdout)["frames"] == 4


# Values that nobody could mean.


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("fx = 1e-300", "focal length fx is 1e-300 px in 32 px"),
        ("fy = 1e9", "focal length fy is 1e\\+09 px"),
        ("fx = inf", "'fx' is inf"),
        ("fx = -30.0", "'fx' is -30.0"),
        ("cx = -40.0", "principal point's cx is -40 px, outside of the image's 32 px"),
        ("cy = 400.0", "principal point's cy is 400 px, outside of the image's 24 px"),
        ("cy = nan", "'cy' is nan"),
        ("depth_factor = 1e-5", "depth_factor is 1e-05 raw units a metre, expected 1 to 655350"),
        ("depth_factor = 1e9", "depth_factor is 1e\\+09"),
        ("depth_factor = -5000.0", "'depth_factor' is -5000.0"),
        ("depth_factor = inf", "'depth_factor' is inf"),
        ("baseline_m = 75.0", "baseline_m is 75 m"),
        ("distortion = [0.0, 0.0, 0.0, 0.0, nan]", "'distortion.4' is nan"),
        ("distortion = [-1.5, 0.0, 0.0, 0.0, 0.0]", "folds the image: \\d+ % of its pixels"),
        ("distortion = [0.0, 0.0, 3.0, 0.0, 0.0]", "folds the image"),
        ("distortion = [1e200, 0.0, 0.0, 0.0, 0.0]", "folds the image"),
        ("distortion = [1e6, 0.0, 0.0, 0.0, 0.0]", "draws a corner of the image to 0.0"),
        ("distortion = [0.0, 0.0, 0.0, 0.0, 2e4]", "draws a corner of the image to 0."),
        ("R_body_cam = [[2.0, 0, 0], [0, 1.0, 0], [0, 0, 1.0]]", "R_body_cam is no rotation"),
        ("R_body_cam = [[-1.0, 0, 0], [0, 1.0, 0], [0, 0, 1.0]]", "R_body_cam is no rotation"),
        ("fps = 1e-300", "'fps' is 1e-300"),
        ("fps = 1e12", "'fps' is 1000000000000.0"),
        ("readout_s = 26.0", "'readout_s' is 26.0"),
    ],
)
def test_values_that_nobody_could_mean_are_named_in_a_line(tmp_path, line, words):
    key = line.partition(" = ")[0]
    stated = [*INTRINSICS.splitlines(), "depth_factor = 5000.0"]
    lines = [other for other in stated if not other.startswith(f"{key} = ")]
    folder = small(tmp_path / "rec", "\n".join([*lines, line]) + "\n")
    with pytest.raises(SequenceError, match=words) as caught:
        open_sequence(folder)
    assert "\n" not in str(caught.value)
    assert str(folder / CAMERA_FILE) in str(caught.value)


@pytest.mark.parametrize("name", CAMERAS)
def test_published_cameras_are_plausible(name):
    check_camera(CAMERAS[name], name)
    check_camera(CAMERAS[name].resized(320, 240), name)
    check_camera(CAMERAS[name].undistorted(), name)


def test_usual_lenses_are_plausible():
    check_camera(
        Camera(752, 480, 458.654, 457.296, 367.215, 248.375, (-0.2834, 0.0740, 2e-4, 1.8e-5, 0.0)),
        "EuRoC",
    )
    check_camera(Camera(640, 480, 3000.0, 3000.0, 320.0, 240.0), "a long lens")
    check_camera(
        Camera(640, 480, 160.0, 160.0, 320.0, 240.0, (0.05, 0.0, 0.0, 0.0, 0.0)), "a wide lens"
    )


@pytest.mark.parametrize("name", ["vslam-lab", "euroc", "openloris"])
def test_calibrations_of_other_layouts_are_looked_at_as_well(tmp_path, name):
    WRITERS[name](tmp_path / "s", random_poses(0))
    file, old, new = {
        "vslam-lab": (
            "calibration.yaml",
            "principal_point: [31.5, 23.5]",
            "principal_point: [3150, 23.5]",
        ),
        "euroc": ("mav0/cam0/sensor.yaml", "intrinsics: [58.6,", "intrinsics: [1.0e-290,"),
        "openloris": ("sensors.yaml", "6.12e+02", "6.12e+22"),
    }[name]
    path = tmp_path / "s" / file
    changed = path.read_text().replace(old, new)
    assert changed != path.read_text()
    path.write_text(changed)
    with pytest.raises(SequenceError, match=r"principal point's cx|focal length") as caught:
        open_sequence(tmp_path / "s")
    assert "\n" not in str(caught.value)


def test_cameras_of_code_are_looked_at_as_well(tmp_path):
    folder, *_ = make_folder(tmp_path / "rec")
    good = Camera(32, 24, 30.0, 30.5, 15.5, 11.5, depth_factor=5000.0)
    with pytest.raises(SequenceError, match="focal length fx is 1e-300"):
        open_sequence(folder, camera=replace(good, fx=1e-300))
    with pytest.raises(SequenceError, match="cy is nan"):
        open_sequence(folder, camera=replace(good, cy=float("nan")))
    with pytest.raises(SequenceError, match="distortion has 4 coefficients"):
        open_sequence(folder, camera=replace(good, distortion=(0.1, 0.0, 0.0, 0.0)))

    class Data:
        """A data set of a plug-in."""

        id = "mine/one"
        license = ""
        citation = ""
        masks = None
        ground_truth = None
        fps = 30.0
        camera = replace(good, cx=-500.0)
        timestamps = np.array([1.0, 1.1, 1.2])

        def digest(self):
            return "d"

        def __len__(self):
            return 3

        def __getitem__(self, index):
            blank = np.zeros((24, 32, 3), np.uint8)
            return Frame(index, float(self.timestamps[index]), blank, np.ones((24, 32), np.float32))

    with pytest.raises(SequenceError, match=r"camera of 'mine/one'.*cx is -500 px"):
        SlamEnv(Data(), "never-move")
    Data.camera = good
    Data.fps = 0.0
    with pytest.raises(SequenceError, match="frame rate of 'mine/one' is 0"):
        SlamEnv(Data(), "never-move")


@pytest.mark.parametrize(("rate", "readout_s"), [(30, 0.5), (30, 0.08), (240, 0.02)])
def test_a_readout_that_is_longer_than_the_time_between_two_images(
    rate: float, readout_s: float, tmp_path: Path
) -> None:
    folder, *_ = make_folder(tmp_path / "rec", frames=5, rate=rate, fps=None)
    camera = open_sequence(folder).camera
    write_camera(folder / CAMERA_FILE, replace(camera, readout_s=1 / rate))
    assert open_sequence(folder).camera.readout_s == 1 / rate
    write_camera(folder / CAMERA_FILE, replace(camera, readout_s=readout_s))
    message = f"readout_s = {readout_s} .* is longer than the {1 / rate:.3g} s"
    with pytest.raises(SequenceError, match=message):
        open_sequence(folder)


@pytest.mark.parametrize(
    ("rate", "stated", "taken"),
    [
        (10, 31.0, 10.0),
        (30, 300.0, 30.0),
        (30, 0.5, 30.0),
        (30, 25.0, 25.0),
        (30, 30.0, 30.0),
        (30, 15.0, 15.0),
    ],
)
def test_a_frame_rate_that_the_stamps_contradict_is_not_taken_and_said(
    tmp_path, rate, stated, taken
):
    folder, *_ = make_folder(tmp_path / "rec", frames=5, rate=rate, fps=stated)
    sequence = open_sequence(folder)
    assert sequence.fps == pytest.approx(taken)
    said = f"fps = {stated:g} is stated, the stamps say {rate}"
    assert (said in sequence.dropped) == (stated in (31.0, 300.0, 0.5, 15.0))
    assert ("which is taken" in sequence.dropped) == (taken != stated)
    assert [said in remark for remark in sequence.remarks] == [True] * (said in sequence.dropped)


@pytest.mark.parametrize(
    ("factor", "said"),
    [
        (1.0, "depth_factor = 1: depth_factor = 5000 would give 2."),
        (100.0, "depth_factor = 100: depth_factor = 5000 would give 2."),
        (600_000.0, "depth_factor = 600000: depth_factor = 5000 would give 2."),
        (1000.0, ""),
        (5000.0, ""),
    ],
)
def test_a_depth_that_nobody_could_mean_is_said_where_it_is_opened(tmp_path, factor, said):
    folder, *_ = make_folder(tmp_path / "rec")
    file = folder / CAMERA_FILE
    file.write_text(file.read_text().replace("5000.0", f"{factor}"))
    sequence = open_sequence(folder)
    assert len(sequence.remarks) == bool(said)
    assert all(said in remark for remark in sequence.remarks)
    assert said in sequence.dropped


@pytest.mark.parametrize(
    ("share", "raw", "said"),
    [
        (1.0, 0, "the first depth image holds no depth"),
        (1.0, 65535, "the first depth image holds no depth"),
        (0.1, 65535, ""),
        (0.1, 0, ""),
    ],
)
def test_a_first_depth_image_without_depth_is_said_where_it_is_opened(tmp_path, share, raw, said):
    folder, *_ = make_folder(tmp_path / "rec")
    file = min((folder / "depth").iterdir())
    image = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
    image[: round(share * len(image)) or 1] = raw
    cv2.imwrite(str(file), image)
    sequence = open_sequence(folder)
    assert len(sequence.remarks) == bool(said)
    assert all(said in remark for remark in sequence.remarks)


def test_a_true_pose_that_no_camera_reaches_is_said_where_it_is_opened(tmp_path):
    folder, *_ = make_folder(tmp_path / "rec", frames=6)
    truth = folder / "groundtruth.txt"
    assert "faster than" not in open_sequence(folder).dropped
    rows = truth.read_text().splitlines()
    rows[3] = rows[3].replace(" 0.03 ", " 1e9 ")
    truth.write_text("\n".join(rows) + "\n")
    assert (
        "2 of 5 steps of the ground truth are faster than 100 m/s" in open_sequence(folder).dropped
    )


def test_a_bag_s_camera_states_its_unit():
    message = type("Info", (), {})()
    message.k = np.array([300.0, 0, 8, 0, 301.0, 6, 0, 0, 1])
    message.d = np.zeros(5)
    message.width = 16
    message.height = 12
    message.distortion_model = "plumb_bob"
    assert camera_of_bag(message, "info").depth_factor == 1000.0


def test_errors_with_a_file_to_copy_survive_pickling():
    import pickle

    error = DynslamError(
        "what", "how", options=["a"], template="x = 1  # one\n# y = 2  # two\n# words"
    )
    again = pickle.loads(pickle.dumps(error))
    assert again.template == error.template
    assert str(again) == "what (how) (choose: a) (template: x = 1; # y = 2)"
