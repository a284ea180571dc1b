"""Every layout that is read, against a writer of its published format: poses, cameras, traps, and wrong folders."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from published_folders import WRITERS, image, lines, random_poses, write_seven_scenes
from sequence_folders import SHARED, make_folder, needs_shared, rewrite

from dynslam_bench.core.errors import DynslamError, SequenceError
from dynslam_bench.geometry import se3
from dynslam_bench.geometry.camera import Camera
from dynslam_bench.geometry.trajectory_files import read_tum
from dynslam_bench.sequences import PreprocessingSettings, Sequence, SequenceView, open_sequence
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


# TUM-layout folders: what is read, and one clear line for everything that is wrong with them.


def test_reads_what_was_written(tmp_path):
    folder, rgb, depth = make_folder(tmp_path / "seq", frames=4)
    sequence = open_sequence(folder)
    assert isinstance(sequence, Sequence)
    assert sequence.id == "folder/seq"
    assert len(sequence) == 4
    assert (sequence.camera.width, sequence.camera.height) == (32, 24)
    frame = sequence[2]
    assert (frame.index, frame.timestamp) == (2, 100.066666667)  # to the nanosecond
    assert frame.rgb.dtype == np.uint8 and (frame.rgb == rgb[2]).all()
    assert frame.depth.dtype == np.float32
    assert np.allclose(frame.depth, depth[2] / 5000, rtol=1e-6) and (frame.depth[depth[2] == 0] == 0).all()
    assert sequence[-1].index == 3
    with pytest.raises(IndexError):
        sequence[4]
    assert np.array_equal(sequence.ground_truth.timestamps, sequence.timestamps)
    assert sequence.fps == 30 and sequence.masks is None
    assert sequence.dropped.describe().startswith("4 frames of 4 colour and 4 depth images (|dt| < 0.02 s)")
    assert sequence.dropped.absent == sequence.dropped.colour_unpaired == 0


@pytest.mark.parametrize(("frames", "fps"), [(5, 10), (1, 30)])
def test_fps_follows_from_the_stamps_where_nothing_states_it(tmp_path, frames, fps):
    folder, *_ = make_folder(tmp_path / "seq", frames=frames, rate=10, fps=None)
    sequence = open_sequence(folder)
    assert len(sequence) == frames and sequence.fps == pytest.approx(fps)


@pytest.mark.parametrize(("per_s", "unit"), [(1e3, "milliseconds"), (1e6, "microseconds")])
@pytest.mark.parametrize("fps", [None, 30])
def test_stamps_in_another_unit_are_refused_with_the_unit(tmp_path, per_s, unit, fps):
    folder, *_ = make_folder(tmp_path / "seq", frames=5, rate=1 / (round(per_s / 30)), fps=fps)
    with pytest.raises(SequenceError, match=f"look like {unit}") as caught:
        open_sequence(folder)
    assert f"{round(per_s / 30):g} s apart" in str(caught.value) and "\n" not in str(caught.value)


def test_digest_tells_contents_apart_and_survives_moving(tmp_path):
    folder, *_ = make_folder(tmp_path / "a", frames=3)
    before = open_sequence(folder).digest()
    moved = folder.rename(tmp_path / "b")
    assert open_sequence(moved).digest() == before
    rolling = replace(open_sequence(moved).camera, readout_s=0.02)
    assert open_sequence(moved, camera=rolling).digest() != before
    rewrite(moved / "groundtruth.txt", lambda lines: lines[:-1])
    assert open_sequence(moved).digest() != before


def test_frames_and_stride(tmp_path):
    folder, rgb, _ = make_folder(tmp_path / "seq", frames=7)
    view = open_sequence(folder, frames="1:6", stride=2)
    assert isinstance(view, SequenceView) and isinstance(view, Sequence)
    assert len(view) == 3 and [view[i].index for i in range(3)] == [0, 1, 2]
    assert (view[1].rgb == rgb[3]).all()
    assert view.dropped.pairs == 7
    assert len(open_sequence(folder, frames=(2, None))) == 5
    for bad, words in (("3", "no range"), ("a:b", "no range"), ("5:5", "no range"), ("-2:", "no range")):
        with pytest.raises(SequenceError, match=words):
            open_sequence(folder, frames=bad)
    with pytest.raises(SequenceError, match="hold none of the 7 frames"):
        open_sequence(folder, frames="7:9")
    with pytest.raises(SequenceError, match="stride is 0"):
        open_sequence(folder, stride=0)


def test_ground_truth_hole_and_bad_lines_are_counted(tmp_path):
    folder, *_ = make_folder(tmp_path / "seq", frames=30)
    rewrite(folder / "groundtruth.txt", lambda lines: [*lines[:11], "100.4 nan 0 0 0 0 0 1", *lines[21:]])
    dropped = open_sequence(folder).dropped
    assert dropped.frames_without_ground_truth == 10
    assert dropped.largest_hole_s == pytest.approx(11 / 30)
    assert "1 of 21 lines skipped: not finite" in dropped.describe()
    assert "10 frames without ground truth within 0.02 s (largest hole 0.37 s)" in dropped.describe()


def test_pairing_is_strict_one_to_one_and_counted(tmp_path):
    folder, *_ = make_folder(tmp_path / "seq", frames=5)
    stamps = [100.0, 100.1, 100.2, 100.3, 100.4]
    shifted = [100.019, 100.121, 100.1999, 100.2001, 100.4]  # near, too far, near, spare, equal
    rewrite(folder / "rgb.txt", lambda _: [f"{s:.4f} rgb/{i}.png" for i, s in enumerate(stamps)])
    rewrite(folder / "depth.txt", lambda _: [f"{s:.4f} depth/{i}.png" for i, s in enumerate(shifted)])
    sequence = open_sequence(folder)
    assert sequence.timestamps.tolist() == [100.0, 100.2, 100.4]
    assert (sequence.dropped.colour_unpaired, sequence.dropped.depth_unpaired) == (2, 2)
    assert "2 colour images without depth; 2 depth images unused" in sequence.dropped.describe()


def test_disordered_lists_are_put_in_order_and_counted(tmp_path):
    folder, rgb, _ = make_folder(tmp_path / "seq", frames=6)

    def disorder(lines):
        stamp = lines[3].split()[0]
        return ["# comment", lines[1], lines[0], *lines[2:], "nan rgb/0.png", f"{stamp} rgb/0.png", "101.5", ""]

    rewrite(folder / "rgb.txt", disorder)
    sequence = open_sequence(folder)
    assert (np.diff(sequence.timestamps) > 0).all() and len(sequence) == 6
    assert (sequence[0].rgb == rgb[0]).all()
    assert (sequence[3].rgb == rgb[0]).all()  # the last of two equal stamps wins, as in TUM's associate.py
    dropped = sequence.dropped
    assert (dropped.bad_stamps, dropped.duplicate_stamps, dropped.unnamed, dropped.unsorted) == (1, 1, 1, 2)
    for words in ("1 stamps not finite", "1 duplicate stamps", "2 stamps out of order", "1 lines without a file name"):
        assert words in dropped.describe()


def test_other_separators(tmp_path):
    folder, *_ = make_folder(tmp_path / "seq", frames=3)
    rewrite(folder / "rgb.txt", lambda lines: [line.replace(" ", ",") for line in lines])
    rewrite(folder / "depth.txt", lambda lines: [line.replace(" ", "\t") + "\r" for line in lines])
    assert len(open_sequence(folder)) == 3


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (lambda f: rewrite(f / "groundtruth.txt", lambda _: ["# nothing"]), "holds no poses"),
        (lambda f: (f / "rgb.txt").write_bytes((f / "depth.txt").read_bytes()), "has 16 bits a channel, expected 8"),
        (lambda f: (f / "rgb" / "0.png").write_bytes(b"<html>404</html>"), "cannot be decoded"),
        (
            lambda f: (f / "rgb" / "2.png").write_bytes((f / "rgb" / "2.png").read_bytes()[:-20]),
            r"2\.png is truncated \(\d+ bytes\)",
        ),
        (
            lambda f: cv2.imwrite(str(f / "depth" / "0.png"), np.full((24, 32), 77, np.uint8)),
            r"1 channel\(s\) of 8 bits \(values 77 to 77\), expected 1 of 16 bits",
        ),
        (lambda f: rewrite(f / "rgb.txt", lambda _: []), "lists no image"),
        (lambda f: rewrite(f / "rgb.txt", lambda _: ["abc rgb/0.png"]), "line 1: 'abc' is not a timestamp"),
        (lambda f: (f / "rgb.txt").write_bytes(b"\xff\xfe\x00"), "not a text file"),
        (lambda f: rewrite(f / "depth.txt", lambda ls: [f"9{line}" for line in ls]), "none of the 4 colour images"),
        (lambda f: (f / "rgb" / "1.png").unlink(), "1 of 4 colour images .* are missing, the first is rgb/1.png"),
        (lambda f: (f / "depth" / "1.png").write_bytes(b""), r"1 of 4 depth images .* are empty \(0 bytes\)"),
    ],
)
def test_damaged_folders_give_one_clear_line(tmp_path, damage, words):
    folder, *_ = make_folder(tmp_path / "seq", frames=4)
    damage(folder)
    with pytest.raises(DynslamError, match=words) as caught:
        list(map(open_sequence(folder).__getitem__, range(4)))
    assert "\n" not in str(caught.value)


def test_wrong_sizes(tmp_path):
    folder, *_ = make_folder(tmp_path / "seq")
    with pytest.raises(SequenceError, match="is 32x24, but the camera of folder/seq is 640x480"):
        open_sequence(folder, camera="tum-fr1")
    for i in range(4):
        cv2.imwrite(str(folder / "depth" / f"{i}.png"), np.full((12, 16), 9000, np.uint16))
    with pytest.raises(SequenceError, match="is 16x12, but its colour image is 32x24"):
        open_sequence(folder)
    frame = open_sequence(folder, preprocessing=PreprocessingSettings(width=32, height=24))[0]
    assert frame.depth.shape == frame.rgb.shape[:2] == (24, 32)


def test_associations_file(tmp_path):
    folder, rgb, _ = make_folder(tmp_path / "seq", frames=3)
    for name in ("rgb.txt", "depth.txt"):
        (folder / name).unlink()
    rows = [f"{100 + i} rgb/{i}.png {107 + i} depth/{i}.png" for i in (2, 0, 1)]
    (folder / "associations.txt").write_text("\n".join(rows))
    sequence = open_sequence(folder)
    assert sequence.timestamps.tolist() == [100, 101, 102] and sequence.dropped.unsorted == 1
    assert (sequence[0].rgb == rgb[0]).all()
    (folder / "associations.txt").write_text("100 rgb/0.png depth/0.png")
    with pytest.raises(SequenceError, match="has 3 parts, expected 4"):
        open_sequence(folder)


def test_folders_without_lists(tmp_path):
    folder, rgb, _ = make_folder(tmp_path / "seq", frames=3, fps=None)
    for name in ("rgb.txt", "depth.txt"):
        (folder / name).unlink()
    with pytest.raises(SequenceError, match="named by a frame number, which has no time"):
        open_sequence(folder)
    with (folder / "camera.toml").open("a") as file:
        file.write("fps = 25.0\n")
    sequence = open_sequence(folder)
    assert sequence.timestamps.tolist() == [0, 0.04, 0.08] and (sequence[1].rgb == rgb[1]).all()
    for kind in ("rgb", "depth"):
        for i in range(3):
            (folder / kind / f"{i}.png").rename(folder / kind / f"{50 + i}.5.png")
    assert open_sequence(folder).timestamps.tolist() == [50.5, 51.5, 52.5]
    for path in (folder / "depth").iterdir():
        path.unlink()
    (folder / "depth").rmdir()
    with pytest.raises(SequenceError, match=r"neither depth.txt nor a folder depth"):
        open_sequence(folder)


def test_grey_and_alpha_images_become_rgb(tmp_path):
    folder, *_ = make_folder(tmp_path / "seq", frames=2)
    cv2.imwrite(str(folder / "rgb" / "0.png"), np.full((24, 32), 90, np.uint8))
    cv2.imwrite(str(folder / "rgb" / "1.png"), np.dstack([np.full((24, 32), v, np.uint8) for v in (1, 2, 3, 200)]))
    sequence = open_sequence(folder)
    assert sequence[0].rgb.shape == (24, 32, 3) and (sequence[0].rgb == 90).all()
    assert sequence[1].rgb[0, 0].tolist() == [3, 2, 1]


def test_few_missing_files_are_tolerated_and_counted(tmp_path):
    """Bonn's lists name a few depth images that its archives lack."""
    folder, *_ = make_folder(tmp_path / "seq", frames=60)
    (folder / "depth" / "17.png").unlink()
    sequence = open_sequence(folder)
    assert len(sequence) == 59 and sequence.dropped.absent == 1
    assert "1 colour images without depth; 1 listed files that do not exist" in sequence.dropped.describe()
    (folder / "depth" / "18.png").unlink()
    with pytest.raises(SequenceError, match="2 of 60 depth images"):
        open_sequence(folder)


@needs_shared
def test_bonn_poses_are_the_camera_s_and_positions_stay_those_of_the_file():
    folder = SHARED / "data" / "bonn" / "rgbd_bonn_crowd"
    raw, truth = read_tum(folder / "groundtruth.txt"), open_sequence(folder).ground_truth
    np.testing.assert_array_equal(truth.positions, raw.positions)
    relative = se3.inverse(raw.T_world_cam) @ truth.T_world_cam
    assert np.ptp(relative[:, :3, :3], axis=0).max() < 1e-9, "one fixed rotation between markers and camera"
    assert se3.is_pose(truth.T_world_cam[0], 1e-9)


def test_a_change_behind_a_linked_folder_is_another_content(tmp_path):
    folder = tmp_path / "fr3_x"
    make_folder(folder)
    (folder / "rgb").rename(tmp_path / "elsewhere")
    (folder / "rgb").symlink_to(tmp_path / "elsewhere")
    (folder / "up").symlink_to(folder)
    before = open_sequence(str(folder)).digest()
    images = sorted((tmp_path / "elsewhere").iterdir())
    images[0].write_bytes(images[1].read_bytes() + b"\0")
    assert open_sequence(str(folder)).digest() != before
