"""Runs in the formats of others, read back by evo, by each format's own reader and by our import: equal to 1e-6."""

import json
import shutil
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from envs_toys import CAMERA, TARGET, write_folder
from evo.core.trajectory import PoseTrajectory3D
from evo.tools import file_interface

from dynslam_bench.contracts.tracker import MapOutputs
from dynslam_bench.core.errors import DynslamError, RunError, TrajectoryError
from dynslam_bench.geometry import se3
from dynslam_bench.geometry.camera import Camera
from dynslam_bench.geometry.trajectory import Trajectory
from dynslam_bench.geometry.trajectory_files import read_tum, write_tum
from dynslam_bench.runs import RunRecord, RunSpec, RunStore, export_run, import_trajectory, read_trajectory, run_one
from dynslam_bench.runs.artifacts import read_snapshots
from dynslam_bench.runs.exchange.formats import read_colmap, write_colmap
from dynslam_bench.runs.exchange.recording import RECORDING_FILE, check_rerun, write_recording
from dynslam_bench.runs.exchange.transfer import Provenance, stated_provenance
from dynslam_bench.slam.map_files import read_ply, write_ply

TOLERANCE = 1e-6
FILES = {
    "tum": ("trajectory.txt",),
    "kitti": ("poses.txt", "times.txt"),
    "euroc": ("data.csv",),
    "vslam-lab": ("00000_KeyFrameTrajectory.csv",),
    "colmap": ("cameras.txt", "images.txt", "points3D.txt"),
    "mcap": ("metadata.yaml", "trajectory.mcap"),
}
STAMPS = 100.0 + np.arange(0, 60, 2) / 30.0


def poses(count: int) -> np.ndarray:
    """Camera-to-world poses that turn all the way round."""
    rng = np.random.default_rng(4)
    twists = np.concatenate([rng.normal(size=(count, 3)), rng.uniform(-3, 3, (count, 3))], axis=1)
    return se3.exp(twists)


def points() -> MapOutputs:
    rng = np.random.default_rng(1)
    return MapOutputs((), np.arange(5), rng.normal(size=(5, 3)), rng.integers(0, 255, (5, 3), np.uint8), np.arange(5))


@pytest.fixture
def run(store: RunStore, toy_folder: str, tmp_path: Path) -> RunRecord:
    """A stored run with poses on every other frame, and a map."""
    write_tum(tmp_path / "theirs.txt", Trajectory(STAMPS, poses(len(STAMPS))))
    record = import_trajectory(tmp_path / "theirs.txt", "slam", toy_folder, results=store, provenance="https://x.org")
    write_ply(store.folder(record.run_id) / "map.ply", points())
    return record


def stored(store: RunStore, run: RunRecord) -> Trajectory:
    found = store.trajectory(run.run_id, "final")
    assert found is not None
    return found


def assert_same(found: Trajectory, expected: Trajectory) -> None:
    assert len(found) == len(expected)
    assert np.abs(found.timestamps - expected.timestamps).max() < TOLERANCE
    assert np.abs(found.T_world_cam - expected.T_world_cam).max() < TOLERANCE


@pytest.mark.parametrize("form", FILES)
def test_an_export_is_read_back(form: str, store: RunStore, run: RunRecord, toy_folder: str) -> None:
    done = export_run(run.run_id[:6], form, results=store)
    assert done.files == (*FILES[form], "provenance.json") and done.which == "final"
    assert sorted(path.name for path in done.folder.iterdir()) == sorted(done.files)
    named = done.folder if form in ("colmap", "mcap") else done.folder / FILES[form][0]
    options = {"kitti": {"timestamps": done.folder / "times.txt"}, "mcap": {"topic": "/estimate/pose"}}.get(form, {})
    assert_same(read_trajectory(named, **options).trajectory, stored(store, run))
    again = import_trajectory(named, "again", toy_folder, results=store, **options)
    assert again.provenance.startswith(f"final trajectory of run {run.run_id} of slam")
    assert f"which came from https://x.org, exported as {form} by" in again.provenance and again.coverage == 0.5
    assert_same(stored(store, again), stored(store, run))


@pytest.mark.parametrize("form", ["tum", "kitti", "euroc"])
def test_evo_reads_it(form: str, store: RunStore, run: RunRecord) -> None:
    folder = export_run(run, form, results=store).folder
    reader = {
        "tum": file_interface.read_tum_trajectory_file,
        "kitti": file_interface.read_kitti_poses_file,
        "euroc": file_interface.read_euroc_csv_trajectory,
    }[form]
    found = reader(str(folder / FILES[form][0]))
    expected = stored(store, run)
    assert np.abs(np.array(found.poses_se3) - expected.T_world_cam).max() < TOLERANCE
    stamps = found.timestamps if isinstance(found, PoseTrajectory3D) else np.loadtxt(folder / "times.txt")
    assert np.abs(stamps - expected.timestamps).max() < TOLERANCE


def test_evo_reads_the_mcap_file(store: RunStore, run: RunRecord) -> None:
    from rosbags.rosbag2 import Reader

    folder = export_run(run, "mcap", results=store).folder
    with Reader(folder) as bag:
        assert {c.topic for c in bag.connections} == {
            f"/{name}/{kind}" for name in ("estimate", "ground_truth") for kind in ("pose", "path")
        }
        found = file_interface.read_bag_trajectory(bag, "/estimate/pose")
    assert np.abs(np.array(found.poses_se3) - stored(store, run).T_world_cam).max() < TOLERANCE
    assert np.abs(found.timestamps - STAMPS).max() < TOLERANCE


@pytest.mark.parametrize(
    ("distortion", "model"),
    [((0.0,) * 5, "PINHOLE"), ((0.1, -0.2, 0.01, 0.02, 0), "OPENCV"), ((0.1, -0.2, 0.01, 0.02, 0.3), "FULL_OPENCV")],
)
def test_colmap_reads_it(tmp_path: Path, distortion: tuple[float, float, float, float, float], model: str) -> None:
    pycolmap = pytest.importorskip("pycolmap", reason="pycolmap is not installed")
    camera = Camera(640, 480, 525.5, 524.5, 319.25, 239.75, distortion)
    track = Trajectory(STAMPS, poses(len(STAMPS)))
    write_ply(tmp_path / "map.ply", points())
    write_colmap(tmp_path, track, camera, [f"rgb/{s:.6f}.png" for s in STAMPS], read_ply(tmp_path / "map.ply"))
    found = pycolmap.Reconstruction()
    found.read_text(str(tmp_path))
    images = sorted(found.images.values(), key=lambda image: image.name)
    moved = np.array([image.cam_from_world().matrix() for image in images])
    assert np.abs(moved - se3.inverse(track.T_world_cam)[:, :3]).max() < TOLERANCE
    assert [image.name for image in images] == [f"rgb/{stamp:.6f}.png" for stamp in STAMPS]
    assert found.cameras[1].model.name == model and found.num_points3D() == 5
    ray = np.array([0.3, -0.2, 1.0])  # a point of the camera's frame, in COLMAP's pixels
    ours = camera.distort_points(camera.project(ray)[None])[0] + 0.5
    assert np.abs(np.asarray(found.cameras[1].img_from_cam(ray)).ravel() - ours).max() < TOLERANCE
    seen = np.array([point.xyz for _, point in sorted(found.points3D.items())])
    assert np.abs(seen - points().positions).max() < TOLERANCE * 10  # the map is stored in single precision


def test_images_that_are_not_named_by_stamps(tmp_path: Path) -> None:
    track = Trajectory(STAMPS, poses(len(STAMPS)))
    write_colmap(tmp_path, track, Camera(8, 8, 8.0, 8.0, 4.0, 4.0), [f"{i:04d}.png" for i in range(len(STAMPS))])
    with pytest.raises(TrajectoryError, match=r"'0000.png' .* is not named by its stamp .*--timestamps FILE"):
        read_trajectory(tmp_path)
    rows = [f"{stamp:.6f} images/{i:04d}.png" for i, stamp in enumerate(STAMPS)]
    (tmp_path / "rgb.txt").write_text("\n".join(rows) + "\n")
    assert_same(read_trajectory(tmp_path, tmp_path / "rgb.txt").trajectory, track)
    (tmp_path / "rgb.txt").write_text("\n".join(rows[1:]) + "\n")
    with pytest.raises(TrajectoryError, match=r"the image '0000.png', which the list of stamps does not"):
        read_trajectory(tmp_path, tmp_path / "rgb.txt")


def test_points_of_images_are_skipped(tmp_path: Path) -> None:
    """COLMAP's own files have a line of points below every image, empty or not."""
    lines = ["# a comment", "1 1 0 0 0 0 0 0 1 1.5.png", "3.0 4.0 -1 5 6 7", "2 1 0 0 0 0 0 -2 1 2.5.png", ""]
    (tmp_path / "images.txt").write_text("\n".join(lines) + "\n")
    found = read_colmap(tmp_path)
    assert found.timestamps.tolist() == [1.5, 2.5] and found.positions.tolist() == [[0, 0, 0], [0, 0, 2]]


def test_a_changed_file_has_lost_its_provenance(store: RunStore, run: RunRecord) -> None:
    folder = export_run(run, "tum", results=store).folder
    assert stated_provenance(folder / "trajectory.txt").startswith("final trajectory of run")
    assert Provenance.read(folder / "provenance.json").run.overrides == run.overrides
    (folder / "trajectory.txt").write_text((folder / "trajectory.txt").read_text() + "# edited\n")
    assert stated_provenance(folder / "trajectory.txt") == ""
    (folder / "provenance.json").write_text(json.dumps({"run_id": "../../x"}))
    assert stated_provenance(folder / "trajectory.txt") == ""


def test_what_cannot_be_exported(store: RunStore, run: RunRecord, tmp_path: Path) -> None:
    with pytest.raises(RunError, match=r"there is no format 'eurok' \(did you mean 'euroc'"):
        export_run(run, "eurok", results=store)
    with pytest.raises(RunError, match=f"run {run.run_id} has no online trajectory"):
        export_run(run, "tum", results=store, which="online")
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.tex").write_text("precious")
    with pytest.raises(RunError, match=r"exists and is no export \(name a folder that does not exist, with -o\)"):
        export_run(run, "tum", tmp_path / "mine", results=store)
    assert (tmp_path / "mine" / "thesis.tex").read_text() == "precious"
    first = export_run(run, "euroc", tmp_path / "out", results=store)
    assert export_run(run, "tum", tmp_path / "out", results=store).folder == first.folder
    assert not (first.folder / "data.csv").exists()


def test_the_sequence_may_have_changed_or_gone(store: RunStore, run: RunRecord, tmp_path: Path) -> None:
    moved = run.model_copy(update={"place": str(tmp_path / "gone")})
    with pytest.raises(DynslamError, match="gone"):
        export_run(moved, "colmap", results=store)
    shutil.copytree(run.place, tmp_path / "gone")
    last = sorted((tmp_path / "gone" / "rgb").iterdir())[-1]
    last.write_bytes(last.read_bytes() + b"x")
    with pytest.raises(RunError, match="has changed since the run"):
        export_run(moved, "colmap", results=store)


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("ts (ns),a,b\n1,2,3\n", "has no column 'tx \\(m\\)'"),
        ("#timestamp,x,y,z,q_x,q_y,q_z,q_w\n1,0,0,0,0,0,0,1\n", "neither EuRoC's nor VSLAM-LAB's"),
        ("#timestamp,x,y,z,q_w,q_x,q_y,q_z\n1,0,0,0,1,0,0\n", "line 2 has 7 columns, the heading 8"),
        ("#timestamp,x,y,z,q_w,q_x,q_y,q_z\n1,0,0,0,0,0,0,0\n", "no row of .* holds a rotation"),
    ],
)
def test_damaged_tables(tmp_path: Path, text: str, complaint: str) -> None:
    (tmp_path / "data.csv").write_text(text)
    with pytest.raises(DynslamError, match=complaint):
        read_trajectory(tmp_path / "data.csv")


def test_folders_that_hold_no_trajectory(store: RunStore, run: RunRecord, tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    with pytest.raises(TrajectoryError, match=r"holds neither images\.txt of COLMAP nor a bag of ROS 2"):
        read_trajectory(tmp_path / "empty")
    bag = export_run(run, "mcap", results=store).folder
    metadata = bag / "metadata.yaml"
    metadata.write_text(metadata.read_text().replace("trajectory.mcap", "gone.mcap"))
    with pytest.raises(DynslamError, match="cannot be read"):
        read_trajectory(bag, topic="/estimate/pose")


try:
    from rerun import chunk
except ImportError:  # not installed, or without its reader of chunks
    chunk = None

needs_rerun = pytest.mark.skipif(chunk is None, reason="rerun-sdk with its reader rerun.chunk is not installed")
FRAMES = 100
IMAGE = "/world/camera/image"


class Opened:
    """A recording in rerun's own reader."""

    def __init__(self, path: Path) -> None:
        reader = chunk.RrdReader(str(path))
        (entry,) = reader.recordings()
        self._rows = [
            (str(each.entity_path), row)
            for each in reader.stream(store=entry)
            for row in each.to_record_batch().to_pylist()
        ]

    def __call__(self, entity: str, component: str) -> dict[int | None, Any]:
        """What was logged as a component of an entity, by frame; None for what holds always."""
        return {row.get("frame"): row[component] for name, row in self._rows if name == entity and row.get(component)}


def test_without_the_library_one_line_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(
        RunError,
        match=r"rerun-sdk, which is not installed \(pip install '\.\[rerun\]' in the checkout of dynslam-bench\)",
    ):
        check_rerun()


@needs_rerun
def test_a_recording_of_100_frames(store: RunStore, tmp_path: Path) -> None:
    folder = str(write_folder(tmp_path / "toy", FRAMES))
    record = run_one(RunSpec(tracker=TARGET, sequence=folder, rrd=True), store)
    assert record.status == "ok", record.reason
    own = store.folder(record.run_id)
    seen = Opened(own / RECORDING_FILE)
    shown = seen("/world/camera", "Transform3D:translation")
    assert list(shown) == list(range(FRAMES))
    online = read_tum(own / "trajectory_online.txt")
    assert np.abs(np.array([shown[i][0] for i in range(FRAMES)]) - online.positions).max() < 1e-6
    pictures = seen(IMAGE, "EncodedImage:blob")
    assert list(pictures) == list(range(FRAMES))
    image = cv2.imdecode(np.array(pictures[40][0], np.uint8), cv2.IMREAD_COLOR)
    mask = np.array(seen(f"{IMAGE}/mask", "SegmentationImage:buffer")[40][0], np.uint8).reshape(image.shape[:2])
    assert mask.sum() == 20 * 15 and mask[20:40, 25:40].all()  # the toy's, at half size
    for name, count in (("kept", 80), ("culled", 20)):
        points = seen(f"{IMAGE}/{name}", "Points2D:positions")
        assert [len(points[index]) for index in range(FRAMES)] == [count] * FRAMES
    errors = seen("/error/trans_m", "Scalars:scalars")
    assert len(errors) == FRAMES and 0 < max(row[0] for row in errors.values()) < 0.05
    (line,) = seen("/world/truth", "LineStrips3D:strips")[None]
    estimate = read_tum(own / "trajectory_final.txt").positions
    assert len(line) == FRAMES and np.linalg.norm(np.array(line) - estimate, axis=1).max() < 0.05

    exported = export_run(record, "rrd", results=store)
    assert (exported.folder / RECORDING_FILE).read_bytes() == (own / RECORDING_FILE).read_bytes()
    assert not exported.notes


@needs_rerun
def test_a_recording_that_cannot_be_written_says_so(tmp_path: Path) -> None:
    nothing = Trajectory(np.zeros(0), np.zeros((0, 4, 4)))
    with pytest.raises(RunError, match=r"cannot write .*missing/recording.rrd: "):
        write_recording(tmp_path / "missing" / RECORDING_FILE, CAMERA, "toy", [], (nothing, None))


@needs_rerun
def test_the_recording_of_a_stored_run(store: RunStore, tmp_path: Path) -> None:
    folder = str(write_folder(tmp_path / "toy", 40))
    record = run_one(RunSpec(tracker=TARGET, sequence=folder, snapshots=True), store)
    rng = np.random.default_rng(0)
    colours = rng.integers(0, 255, (7, 3), np.uint8)
    outputs = MapOutputs((), np.arange(7), rng.normal(size=(7, 3)), colours, np.ones(7, np.int64))
    write_ply(store.folder(record.run_id) / "map.ply", outputs)
    exported = export_run(record, "rrd", results=store)
    known = [shot.index for shot in read_snapshots(store.folder(record.run_id))[1]]
    assert exported.notes == (f"features and masks are known of {len(known)} of 40 frames; `run --rrd` records all",)
    seen = Opened(exported.folder / RECORDING_FILE)
    assert list(seen("/world/camera", "Transform3D:translation")) == list(range(40)) and 0 < len(known) < 40
    assert list(seen("/features/kept", "Scalars:scalars")) == known
    cleared = sorted(frame or 0 for frame in seen(f"{IMAGE}/kept", "Clear:is_recursive"))
    assert cleared == [index + 1 for index in known if index + 1 < 40 and index + 1 not in known]
    cloud = np.array(seen("/world/map", "Points3D:positions")[None])
    assert np.abs(cloud - outputs.positions).max() < 1e-6
