"""Every layout that is read, against a writer of its published format: poses, cameras, traps, and wrong folders."""

import numpy as np
import pytest
from published_folders import WRITERS, image, lines, random_poses, write_seven_scenes

from dynslam_bench.core.errors import DynslamError, SequenceError
from dynslam_bench.geometry.camera import Camera
from dynslam_bench.sequences import open_sequence
from dynslam_bench.sequences.catalogue import catalogue
from dynslam_bench.sequences.readers.layouts import LAYOUTS, find_layout, layout_of
from dynslam_bench.testing import check_sequence

OTHERS = [layout.name for layout in LAYOUTS if layout.name != "tum"]
FOCAL = {
    "eth3d": (726.28741455078, 726.28741455078, 354.6496887207, 186.46566772461),
    "icl-nuim": (481.2, 480.0, 319.5, 239.5),
    "7-scenes": (585.0, 585.0, 320.0, 240.0),
    "tartanair-shibuya": (772.5483399593904, 772.5483399593904, 320.0, 180.0),
    "openloris": (611.0, 612.0, 433.0, 249.0),
    "vslam-lab": (60.5, 61.5, 31.5, 23.5),
    "euroc": (58.6, 57.2, 31.2, 24.3),
}


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """A folder of every layout, with three frames and known poses."""
    root, poses = tmp_path_factory.mktemp("layouts"), random_poses(0)
    for name, write in WRITERS.items():
        write(root / name, poses)
    return root, poses


def test_every_layout_has_a_writer():
    assert set(WRITERS) == {layout.name for layout in LAYOUTS} and layout_of("tum").name == "tum"
    with pytest.raises(SequenceError, match="unknown layout 'kitti'"):
        layout_of("kitti")


@pytest.mark.parametrize("name", OTHERS)
def test_a_folder_in_the_published_format_is_read(written, name):
    root, poses = written
    sequence = open_sequence(root / name)
    assert find_layout(root / name).name == name
    camera = sequence.camera
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == FOCAL[name]
    frame = sequence[len(sequence) - 1]
    assert np.median(frame.depth) == 2.0 and (frame.rgb == 90).all()
    assert len(sequence) == (4 if name == "icl-nuim" else 3)
    truth = sequence.ground_truth
    assert np.abs(truth.T_world_cam - poses).max() < 1e-12
    with_truth = sequence.timestamps[-3:]
    assert np.abs(truth.timestamps - with_truth).max() < 1e-6
    check_sequence(sequence)
    chosen = open_sequence(root / name, camera=Camera(camera.width, camera.height, 100.0, 100.0, 10.0, 10.0))
    assert chosen.camera.fx == 100.0 and chosen.digest() != sequence.digest()


@pytest.mark.parametrize("seed", range(8))
def test_poses_of_kinectfusion_are_read_to_the_last_bit(tmp_path, seed):
    poses = random_poses(seed, n=5)
    write_seven_scenes(tmp_path / "seq-01", poses, size=(640, 480))
    truth = open_sequence(tmp_path / "seq-01").ground_truth
    assert np.array_equal(truth.T_world_cam, poses) and len(truth) == 5


def test_missing_depth_of_seven_scenes_and_frames_that_kinectfusion_lost(tmp_path):
    write_seven_scenes(tmp_path / "seq-01", random_poses(3))
    lines(tmp_path / "seq-01" / "frame-000002.pose.txt", ["-1.#IND -1.#IND -1.#IND -1.#IND"] * 4)
    sequence = open_sequence(tmp_path / "seq-01")
    assert (sequence[1].depth == 0).all() and (sequence[0].depth == 2.0).all()
    assert len(sequence.ground_truth) == 2 and "1 of 3 poses lost" in sequence.dropped.describe()


def test_the_sky_of_a_rendered_depth_is_missing(written):
    depth = open_sequence(written[0] / "tartanair-shibuya")[0].depth
    assert (depth[0] == 0).all() and (depth[1:] == 2.0).all()


def test_frame_0_of_icl_has_no_pose_and_its_view_is_mirrored_back(written):
    """A point that the published camera (fy = -480) sees at a pixel is seen there by ours."""
    sequence = open_sequence(written[0] / "icl-nuim")
    assert sequence.dropped.frames_without_ground_truth == 1
    pose, mirror = sequence.ground_truth.T_world_cam[1], np.diag([1.0, -1.0, 1.0, 1.0])
    published = mirror @ pose @ mirror
    point = np.array([0.3, 0.4, 2.0, 1.0])
    pixel = np.array([481.2 * 0.3 / 2 + 319.5, -480.0 * 0.4 / 2 + 239.5])
    world = mirror @ (published @ point)
    seen = np.linalg.inv(pose) @ world
    assert np.allclose(sequence.camera.project(seen[:3]), pixel, atol=1e-9)


BROKEN = {
    "eth3d": [("associated.txt", None, "no depth"), ("calibration.txt", "726 726 354", "3 values, not the 4")],
    "icl-nuim": [
        ("depth/1.png", "x", "cannot be decoded"),
        ("livingRoom0.gt.freiburg", "1 2", "2 values"),
    ],
    "7-scenes": [
        ("frame-000001.pose.txt", None, "cannot read"),
        ("frame-000001.pose.txt", "1 0 0 0 0 1", "6 values, expected the 16"),
        ("frame-000001.pose.txt", "2 0 0 0 0 2 0 0 0 0 2 0 0 0 0 1", "no rigid"),
        ("frame-000001.depth.png", None, "1 of 3 depth images"),
        ("frame-x.color.png", "", "named by no number"),
    ],
    "tartanair-shibuya": [
        ("times.txt", "0.0", "3 colour images, 3 depth arrays, 1 stamps and 3 poses"),
        ("depth_0/000000.npy", "not an array", "is no .npy file"),
        ("gt_pose.txt", "1 2 3", "3 values, not the 7"),
    ],
    "openloris": [
        ("sensors.yaml", "a: [", "no valid YAML"),
        ("sensors.yaml", "d400_color_optical_frame: 3", "lacks 'intrinsics'"),
        ("trans_matrix.yaml", "trans_matrix: []", "no rigid transformation from base_link"),
        ("aligned_depth.txt", None, "cannot read"),
        ("groundtruth.txt", "4711.0 0 0 0 0 0 0 1", r"never nearer than 4705\.9.*bias of their own"),
    ],
    "vslam-lab": [
        ("rgb.csv", "ts_rgb_0 (ns),path_rgb_0\n1,a.png", "no column 'ts_depth_0"),
        (
            "rgb.csv",
            "ts_rgb_0 (ns),path_rgb_0,ts_depth_0 (ns),path_depth_0\n1,../a.png,1,depth_0/0.png",
            "does not lie in",
        ),
        ("calibration.yaml", "cameras: []", "describes no camera 'rgb_0'"),
        ("groundtruth.csv", "ts (ns),tx (m),ty (m),tz (m),qx,qy,qz,qw\n1,2,3,4,5,6,x,8", "'x' is not a number"),
    ],
    "euroc": [
        ("mav0/depth0/data.csv", None, "that is no depth"),
        ("mav0/cam0/sensor.yaml", "resolution: [1]", "resolution holds no 2 numbers"),
        ("mav0/cam0/data.csv", "#timestamp [ns],filename\nx,a.png", "'x' is not a stamp in nanoseconds"),
    ],
}


@pytest.mark.parametrize(("name", "at"), [(name, at) for name, cases in BROKEN.items() for at in range(len(cases))])
def test_wrong_or_partial_folders_give_one_clear_line(tmp_path, name, at):
    file, content, words = BROKEN[name][at]
    WRITERS[name](tmp_path / "s", random_poses(2))
    if content is None:
        (tmp_path / "s" / file).unlink()
    else:
        (tmp_path / "s" / file).write_text(content)
    with pytest.raises(DynslamError, match=words) as caught:
        layout_of(name).read(tmp_path / "s")
        sequence = open_sequence(tmp_path / "s")
        [sequence[i] for i in range(len(sequence))]
    assert "\n" not in str(caught.value) and str(tmp_path / "s") in str(caught.value)


def test_every_catalogued_sequence_opens_once_it_lies_where_it_belongs(tmp_path):
    """Nothing is listed that cannot be opened: the reader named reads a folder of the published layout."""
    entries, root, first = catalogue(), tmp_path / "root", {}
    for entry in entries.values():
        made = tmp_path / f"{entry.layout} {entry.camera}"
        if not made.exists():
            camera = entry.intrinsics()
            WRITERS[entry.layout](
                made, random_poses(5), **({} if camera is None else {"size": (camera.width, camera.height)})
            )
        place = entry.folders(root)[0]
        place.parent.mkdir(parents=True, exist_ok=True)
        place.symlink_to(made)
        first.setdefault((entry.dataset, entry.layout, entry.camera), entry.id)
    assert len(entries) > 200 and len(first) >= 11
    assert {name: entry.find(root) for name, entry in entries.items()} == {
        name: entry.folders(root)[0] for name, entry in entries.items()
    }
    for name in first.values():
        sequence = open_sequence(name, data_root=root)
        assert sequence.id == name and sequence.license and sequence.tags and len(sequence.ground_truth) == 3


def test_a_folder_of_ones_own_with_one_image_more(tmp_path):
    """What lies beside a sequence does not change what it is."""
    WRITERS["tum"](tmp_path / "s", random_poses(2))
    image(tmp_path / "s" / "frame.color.png", 1, (4, 4))
    assert find_layout(tmp_path / "s").name == "tum"
