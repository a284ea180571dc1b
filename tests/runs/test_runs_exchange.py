"""Runs in the formats of others, read back by evo, by each format's own reader and by our import: equal to 1e-6."""

import csv
import json
import re
import shutil
import subprocess
import sys
import zipfile
from concurrent.futures import ThreadPoolExecutor
from hashlib import sha256
from pathlib import Path
from threading import Event
from time import sleep
from typing import Any

import cv2
import numpy as np
import pytest
from evo.core.trajectory import PoseTrajectory3D
from evo.tools import file_interface
from helpers.envs_toys import CAMERA, TARGET, write_folder
from published_trajectories import SINGLE
from rosbags.rosbag2 import Reader
from typer.testing import CliRunner

from dynslam_bench import api as db
from dynslam_bench.cli.app import app
from dynslam_bench.contracts.tracker import MapOutputs
from dynslam_bench.core.errors import DynslamError, InfrastructureError, RunError, TrajectoryError
from dynslam_bench.geometry import Camera, Trajectory, read_tum, se3, write_tum
from dynslam_bench.runs import (
    RunRecord,
    RunSpec,
    RunStore,
    bank,
    export_run,
    import_trajectory,
    read_trajectory,
    run_many,
    run_one,
)
from dynslam_bench.runs.artifacts import read_snapshots
from dynslam_bench.runs.exchange.formats import read_colmap, write_colmap
from dynslam_bench.runs.exchange.recording import RECORDING_FILE, check_rerun, write_recording
from dynslam_bench.runs.exchange.transfer import Provenance, stated_provenance
from dynslam_bench.sequences.catalogue import entry_of
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
    return se3.exp(
        np.concatenate([rng.normal(size=(count, 3)), rng.uniform(-3, 3, (count, 3))], axis=1)
    )


def points() -> MapOutputs:
    rng = np.random.default_rng(1)
    return MapOutputs(
        (),
        np.arange(5),
        rng.normal(size=(5, 3)),
        rng.integers(0, 255, (5, 3), np.uint8),
        np.arange(5),
    )


@pytest.fixture
def run(store: RunStore, toy_folder: str, tmp_path: Path) -> RunRecord:
    """A stored run with poses on every other frame, and a map."""
    write_tum(tmp_path / "theirs.txt", Trajectory(STAMPS, poses(len(STAMPS))))
    record = import_trajectory(
        tmp_path / "theirs.txt", "slam", toy_folder, results=store, provenance="https://x.org"
    )
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
def test_an_export_is_read_back(
    form: str, store: RunStore, run: RunRecord, toy_folder: str
) -> None:
    done = export_run(run.run_id[:6], form, results=store)
    assert done.files == (*FILES[form], "provenance.json")
    assert done.which == "final"
    assert sorted(path.name for path in done.folder.iterdir()) == sorted(done.files)
    named = done.folder if form in ("colmap", "mcap") else done.folder / FILES[form][0]
    options = {
        "kitti": {"timestamps": done.folder / "times.txt"},
        "mcap": {"topic": "/estimate/pose"},
    }.get(form, {})
    assert_same(read_trajectory(named, **options).trajectory, stored(store, run))
    again = import_trajectory(named, "again", toy_folder, results=store, **options)
    assert again.provenance.startswith(f"final trajectory of run {run.run_id} of slam")
    assert f"which came from https://x.org, exported as {form} by" in again.provenance
    assert again.coverage == 0.5
    assert_same(stored(store, again), stored(store, run))


@pytest.mark.parametrize("form", ["tum", "kitti", "euroc", "mcap"])
def test_evo_reads_it(form: str, store: RunStore, run: RunRecord) -> None:
    folder = export_run(run, form, results=store).folder
    if form == "mcap":
        with Reader(folder) as bag:
            assert {c.topic for c in bag.connections} == {
                f"/{name}/{kind}"
                for name in ("estimate", "ground_truth")
                for kind in ("pose", "path")
            }
            found = file_interface.read_bag_trajectory(bag, "/estimate/pose")
    else:
        reader = {
            "tum": file_interface.read_tum_trajectory_file,
            "kitti": file_interface.read_kitti_poses_file,
            "euroc": file_interface.read_euroc_csv_trajectory,
        }[form]
        found = reader(str(folder / FILES[form][0]))
    expected = stored(store, run)
    assert np.abs(np.array(found.poses_se3) - expected.T_world_cam).max() < TOLERANCE
    stamps = (
        found.timestamps
        if isinstance(found, PoseTrajectory3D)
        else np.loadtxt(folder / "times.txt")
    )
    assert np.abs(stamps - expected.timestamps).max() < TOLERANCE


@pytest.mark.parametrize(
    ("distortion", "model"),
    [
        ((0.0,) * 5, "PINHOLE"),
        ((0.1, -0.2, 0.01, 0.02, 0), "OPENCV"),
        ((0.1, -0.2, 0.01, 0.02, 0.3), "FULL_OPENCV"),
    ],
)
def test_colmap_reads_it(
    tmp_path: Path, distortion: tuple[float, float, float, float, float], model: str
) -> None:
    pycolmap = pytest.importorskip("pycolmap", reason="pycolmap is not installed")
    camera = Camera(640, 480, 525.5, 524.5, 319.25, 239.75, distortion)
    track = Trajectory(STAMPS, poses(len(STAMPS)))
    write_ply(tmp_path / "map.ply", points())
    write_colmap(
        tmp_path,
        track,
        camera,
        [f"rgb/{s:.6f}.png" for s in STAMPS],
        read_ply(tmp_path / "map.ply"),
    )
    found = pycolmap.Reconstruction()
    found.read_text(str(tmp_path))
    images = sorted(found.images.values(), key=lambda image: image.name)
    moved = np.array([image.cam_from_world().matrix() for image in images])
    assert np.abs(moved - se3.inverse(track.T_world_cam)[:, :3]).max() < TOLERANCE
    assert [image.name for image in images] == [f"rgb/{stamp:.6f}.png" for stamp in STAMPS]
    assert found.cameras[1].model.name == model
    assert found.num_points3D() == 5
    ray = np.array([0.3, -0.2, 1.0])  # a point of the camera's frame, in COLMAP's pixels
    ours = camera.distort_points(camera.project(ray)[None])[0] + 0.5
    assert np.abs(np.asarray(found.cameras[1].img_from_cam(ray)).ravel() - ours).max() < TOLERANCE
    seen = np.array([point.xyz for _, point in sorted(found.points3D.items())])
    # the map is stored in single precision
    assert np.abs(seen - points().positions).max() < TOLERANCE * 10


def test_images_that_are_not_named_by_stamps(tmp_path: Path) -> None:
    track = Trajectory(STAMPS, poses(len(STAMPS)))
    write_colmap(
        tmp_path,
        track,
        Camera(8, 8, 8.0, 8.0, 4.0, 4.0),
        [f"{i:04d}.png" for i in range(len(STAMPS))],
    )
    with pytest.raises(
        TrajectoryError, match=r"'0000.png' .* is not named by its stamp .*--timestamps FILE"
    ):
        read_trajectory(tmp_path)
    rows = [f"{stamp:.6f} images/{i:04d}.png" for i, stamp in enumerate(STAMPS)]
    (tmp_path / "rgb.txt").write_text("\n".join(rows) + "\n")
    assert_same(read_trajectory(tmp_path, tmp_path / "rgb.txt").trajectory, track)
    (tmp_path / "rgb.txt").write_text("\n".join(rows[1:]) + "\n")
    with pytest.raises(
        TrajectoryError, match=r"the image '0000.png', which the list of stamps does not"
    ):
        read_trajectory(tmp_path, tmp_path / "rgb.txt")


def test_points_of_images_are_skipped(tmp_path: Path) -> None:
    """COLMAP's own files have a line of points below every image, empty or not."""
    lines = [
        "# a comment",
        "1 1 0 0 0 0 0 0 1 1.5.png",
        "3.0 4.0 -1 5 6 7",
        "2 1 0 0 0 0 0 -2 1 2.5.png",
        "",
    ]
    (tmp_path / "images.txt").write_text("\n".join(lines) + "\n")
    found = read_colmap(tmp_path)
    assert found.timestamps.tolist() == [1.5, 2.5]
    assert found.positions.tolist() == [[0, 0, 0], [0, 0, 2]]


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
    with pytest.raises(
        RunError, match=r"exists and is no export \(name a folder that does not exist, with -o\)"
    ):
        export_run(run, "tum", tmp_path / "mine", results=store)
    assert (tmp_path / "mine" / "thesis.tex").read_text() == "precious"
    first = export_run(run, "euroc", tmp_path / "out", results=store)
    assert export_run(run, "tum", tmp_path / "out", results=store).folder == first.folder
    assert not (first.folder / "data.csv").exists()


def test_the_sequence_may_have_changed_or_gone(
    store: RunStore, run: RunRecord, tmp_path: Path
) -> None:
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
        ("ts (ns),a,b\n1,2,3\n", "line 1 is neither a pose nor a known heading: 'ts \\(ns\\),a,b'"),
        (
            "ts (ns),tx (m),ty (m),tz (m),qx,qy,qz,qw\n1,0,0,0,0,0,1\n",
            "line 2 has 7 values, not the 8",
        ),
        ("#timestamp,x,y,z,q_w,q_x,q_y,q_z\n1,0,0,0,1,0,0\n", "line 2 has 7 values, not the 8"),
        (
            "#timestamp,x,y,z,q_w,q_x,q_y,q_z\n1,0,0,0,0,0,0,0\n",
            "no valid pose .1 of 1 lines .* all-zero quaternion",
        ),
    ],
)
def test_damaged_tables(tmp_path: Path, text: str, complaint: str) -> None:
    (tmp_path / "data.csv").write_text(text)
    with pytest.raises(DynslamError, match=complaint):
        read_trajectory(tmp_path / "data.csv")


def test_what_a_table_or_a_reconstruction_repeats_or_lacks_is_said(tmp_path: Path) -> None:
    rows = [
        f"{stamp},0,0,0,{w},0,0,0" for stamp, w in ((20000, 1), (10000, 1), (20000, 1), (30000, 0))
    ]
    (tmp_path / "data.csv").write_text("\n".join(["#timestamp,x,y,z,q_w,q_x,q_y,q_z", *rows]))
    notes = read_trajectory(tmp_path / "data.csv").notes
    assert (notes.lines, notes.duplicates, notes.out_of_order, notes.zero_quaternions) == (
        4,
        1,
        1,
        1,
    )
    (tmp_path / "images.txt").write_text(
        "".join(f"{n} 1 0 0 0 0 0 0 {n} cam{n}/1.5.png\n\n" for n in (1, 2))
    )
    with pytest.raises(TrajectoryError, match=r"line 3 repeats a stamp, 1\.5"):
        read_colmap(tmp_path)


def test_folders_that_hold_no_trajectory(store: RunStore, run: RunRecord, tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    with pytest.raises(
        TrajectoryError, match=r"holds neither images\.txt of COLMAP nor a bag of ROS 2"
    ):
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

needs_rerun = pytest.mark.skipif(
    chunk is None, reason="rerun-sdk with its reader rerun.chunk is not installed"
)
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
        return {
            row.get("frame"): row[component]
            for name, row in self._rows
            if name == entity and row.get(component)
        }


def test_without_the_library_one_line_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(
        RunError,
        match=r"rerun-sdk, which is not installed \(pip install '\.\[rerun\]' in the checkout of dynslam-bench\)",
    ):
        check_rerun()


@pytest.mark.slow
@needs_rerun
def test_a_recording_of_100_frames(store: RunStore, tmp_path: Path) -> None:
    record = run_one(
        RunSpec(tracker=TARGET, sequence=str(write_folder(tmp_path / "toy", FRAMES)), rrd=True),
        store,
    )
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
    mask = np.array(seen(f"{IMAGE}/mask", "SegmentationImage:buffer")[40][0], np.uint8).reshape(
        image.shape[:2]
    )
    # the toy's, at half size
    assert mask.sum() == 20 * 15
    assert mask[20:40, 25:40].all()
    for name, count in (("kept", 80), ("culled", 20)):
        points = seen(f"{IMAGE}/{name}", "Points2D:positions")
        assert [len(points[index]) for index in range(FRAMES)] == [count] * FRAMES
    errors = seen("/error/trans_m", "Scalars:scalars")
    assert len(errors) == FRAMES
    assert 0 < max(row[0] for row in errors.values()) < 0.05
    (line,) = seen("/world/truth", "LineStrips3D:strips")[None]
    estimate = read_tum(own / "trajectory_final.txt").positions
    assert len(line) == FRAMES
    assert np.linalg.norm(np.array(line) - estimate, axis=1).max() < 0.05

    exported = export_run(record, "rrd", results=store)
    assert (exported.folder / RECORDING_FILE).read_bytes() == (own / RECORDING_FILE).read_bytes()
    assert not exported.notes


@needs_rerun
def test_a_recording_that_cannot_be_written_says_so(tmp_path: Path) -> None:
    nothing = Trajectory(np.zeros(0), np.zeros((0, 4, 4)))
    with pytest.raises(RunError, match=r"cannot write .*missing/recording.rrd: "):
        write_recording(tmp_path / "missing" / RECORDING_FILE, CAMERA, "toy", [], (nothing, None))


@pytest.mark.slow
@needs_rerun
def test_the_recording_of_a_stored_run(store: RunStore, tmp_path: Path) -> None:
    record = run_one(
        RunSpec(tracker=TARGET, sequence=str(write_folder(tmp_path / "toy", 40)), snapshots=True),
        store,
    )
    write_ply(store.folder(record.run_id) / "map.ply", points())
    exported = export_run(record, "rrd", results=store)
    known = [shot.index for shot in read_snapshots(store.folder(record.run_id))[1]]
    assert exported.notes == (
        f"features and masks are known of {len(known)} of 40 frames; `run --rrd` records all",
    )
    seen = Opened(exported.folder / RECORDING_FILE)
    assert list(seen("/world/camera", "Transform3D:translation")) == list(range(40))
    assert 0 < len(known) < 40
    assert list(seen("/features/kept", "Scalars:scalars")) == known
    cleared = sorted(frame or 0 for frame in seen(f"{IMAGE}/kept", "Clear:is_recursive"))
    assert cleared == [index + 1 for index in known if index + 1 < 40 and index + 1 not in known]
    assert (
        np.abs(np.array(seen("/world/map", "Points3D:positions")[None]) - points().positions).max()
        < 1e-6
    )


PUBLISHED = Path(__file__).resolve().parents[3] / "shared" / "data" / "trajectories"


def invoke(*words):
    return CliRunner().invoke(app, [str(word) for word in words])


@pytest.fixture(scope="module")
def results(tmp_path_factory, toy_folder):
    """A results folder with two runs."""
    folder = tmp_path_factory.mktemp("bank") / "results"
    run_many(
        [RunSpec(tracker=TARGET, sequence=toy_folder, frames=(0, 8), seed=seed) for seed in (0, 1)],
        results=folder,
    )
    return folder


@pytest.fixture
def made(results, tmp_path):
    """A bank of the two runs."""
    bank.add([results], tmp_path / "bank")
    return tmp_path / "bank"


@pytest.fixture
def remote(tmp_path, monkeypatch):
    """An empty bare repository, and an author for commits."""
    for role in ("AUTHOR", "COMMITTER"):
        monkeypatch.setenv(f"GIT_{role}_NAME", "A. Uthor")
        monkeypatch.setenv(f"GIT_{role}_EMAIL", "author@example.org")
    subprocess.run(["git", "init", "--quiet", "--bare", tmp_path / "bank.git"], check=True)
    return str(tmp_path / "bank.git")


def altered(folder):
    """Changes a digit of the first trajectory."""
    file = sorted(folder.rglob("trajectory_online.txt"))[0]
    file.write_text(file.read_text().replace("1", "2", 1))


def sum_up(folder):
    """Checksums of what a bank holds now, as whoever changed it would make them."""
    (folder / "SHA256SUMS").unlink()
    lines = [
        f"{sha256((folder / name).read_bytes()).hexdigest()}  {name}\n"
        for name in bank.Bank(folder).files()
    ]
    (folder / "SHA256SUMS").write_text("".join(lines))


@pytest.mark.slow
def test_a_bank_is_a_results_folder_of_text_files(results, made):
    files = sorted(
        path.relative_to(made).as_posix() for path in made.rglob("*") if not path.is_dir()
    )
    assert {Path(name).name for name in files} == {
        "SHA256SUMS", "bank.json", "run.json", "trajectory_online.txt", "trajectory_final.txt",
        "timestamps.txt", "groundtruth.txt",
    }  # fmt: skip
    if shutil.which("sha256sum"):
        subprocess.run(["sha256sum", "-c", "--quiet", "SHA256SUMS"], cwd=made, check=True)
    columns = ["run_id", "tracker", "coverage", "ate_rmse_m", "rpe_1f_trans_rmse_m"]
    assert RunStore(made).frame()[columns].equals(RunStore(results).frame()[columns])
    for run_id in RunStore(made).ids():
        record = json.loads((made / "runs" / run_id / "run.json").read_text())
        assert (record["command"], record["place"]) == ([], "")
        assert "/" not in record["tracker"]["given"]
    assert db.report(made, protocol="evo-as/v1").html.is_file()
    assert bank.verify(made) == []  # what was computed beside it is no fault
    again = bank.add([results], made)
    assert (again.added, len(again.stored), again.left_out) == ([], 2, [])


@pytest.mark.slow
def test_two_who_add_at_once_lose_nothing(results, made, tmp_path, monkeypatch):
    """The second one comes while the first has copied its runs and not yet written their checksums."""
    copied = Event()
    merge = bank.merge
    target = tmp_path / "shared"

    def slow(*words, **options):
        merged = merge(*words, **options)
        copied.set()
        sleep(0.2)
        return merged

    first, second = RunStore(made).ids()
    for run_id in (first, second):
        shutil.copytree(
            made, tmp_path / run_id, ignore=shutil.ignore_patterns(*({first, second} - {run_id}))
        )
    monkeypatch.setattr(bank, "merge", slow)
    with ThreadPoolExecutor() as pool:
        earlier = pool.submit(bank.add, [tmp_path / first], target)
        assert copied.wait(60)
        later = pool.submit(bank.add, [tmp_path / second], target)
        assert (earlier.result().added, later.result().added) == ([first], [second])
    assert bank.verify(target) == []
    assert RunStore(target).ids() == [first, second]


@pytest.mark.slow
def test_trials_of_studies_are_left_out(results, tmp_path):
    store = RunStore(tmp_path / "with_trial")
    shutil.copytree(results, store.root)
    record = store.all()[0][0]
    (store.folder(record.run_id) / "run.json").write_text(
        record.model_copy(
            update={"study": "mine", "overrides": {"drift": 0.1}, "settings": {"drift": 0.1}}
        ).to_json()
    )
    assert len(bank.add([store.root], tmp_path / "bank").added) == 1


FAULTS = {
    "changed": (altered, "trajectory_online.txt is not what SHA256SUMS says"),
    "missing": (
        lambda folder: sorted(folder.rglob("groundtruth.txt"))[0].unlink(),
        "groundtruth.txt is missing",
    ),
    "not listed": (
        lambda folder: (folder / "runs" / "x.txt").write_text("x"),
        "runs/x.txt is not listed",
    ),
    "a link": (
        lambda folder: (folder / "runs" / "x.txt").symlink_to("/etc/hostname"),
        "runs/x.txt is a link",
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("change, words", FAULTS.values(), ids=FAULTS)
def test_faults_are_named_and_such_a_bank_is_neither_taken_nor_given(
    made, remote, tmp_path, change, words
):
    shutil.copytree(made, tmp_path / "sound")
    change(made)
    assert any(words in fault for fault in bank.verify(made))
    done = invoke("bank", "verify", made)
    assert done.exit_code == 4
    assert words in done.output
    for refused in (
        lambda: bank.pull(str(made), tmp_path / "other"),
        lambda: bank.pull(str(tmp_path / "sound"), made),
        lambda: bank.push(made, remote),
        lambda: bank.add([tmp_path / "sound"], made),
    ):
        with pytest.raises(RunError, match=words):
            refused()
    assert not (tmp_path / "other").exists()


@pytest.mark.slow
def test_records_that_do_not_fit_are_named(made):
    """Their checksums are right: whoever changed them made those, too."""
    (first, second) = RunStore(made).ids()
    store = RunStore(made)
    record = store.read(first)
    changed = record.model_copy(update={"identity": record.identity | {"seed": 7}})
    (made / "runs" / first / "run.json").write_text(changed.to_json())
    (made / "runs" / second / "run.json").write_text("{")
    for timestamps in made.glob("sequences/*/timestamps.txt"):
        timestamps.unlink()
    sum_up(made)
    faults = bank.verify(made)
    assert len(faults) == 4
    assert second in faults[0]
    assert first in faults[1]
    assert "id" in faults[1]
    assert "its seed" in faults[2]
    assert "stamps" in faults[3]


@pytest.mark.slow
def test_through_a_bare_git_repository_and_back(made, remote, tmp_path, monkeypatch):
    assert len(bank.push(made, remote).added) == 2
    monkeypatch.chdir(Path(remote).parent)
    assert bank.push(made, Path(remote).name).added == []
    assert (
        subprocess.check_output(["git", "-C", remote, "log", "--format=%s"], text=True)
        == "Add runs: 2\n"
    )
    assert len(bank.pull(remote, tmp_path / "pulled").added) == 2
    assert bank.verify(tmp_path / "pulled") == []
    assert (tmp_path / "pulled" / "SHA256SUMS").read_bytes() == (made / "SHA256SUMS").read_bytes()


@pytest.mark.slow
def test_a_submission_with_an_altered_trajectory_is_refused(made, remote, tmp_path):
    """With new checksums, it contradicts the run's record."""
    bank.push(made, remote)
    altered(made)
    sum_up(made)
    with pytest.raises(RunError, match=r"trajectory_online.txt was changed since run"):
        bank.push(made, remote)


@pytest.mark.slow
def test_what_a_full_disk_cut_short_is_a_bank_and_can_be_gone_on_with(
    results, tmp_path, monkeypatch
):
    copies = []

    def copy_one(source, target):
        copies.append(target)
        if len(copies) == 3:
            raise OSError(28, "No space left on device")
        Path(target).write_bytes(Path(source).read_bytes())

    monkeypatch.setattr(bank.shutil, "copyfile", copy_one)
    with pytest.raises(InfrastructureError, match="No space left"):
        bank.add([results], tmp_path / "bank")
    assert bank.verify(tmp_path / "bank") == []
    assert len(RunStore(tmp_path / "bank").ids()) == 1
    assert len(bank.add([results], tmp_path / "bank").added) == 1


@pytest.mark.slow
@pytest.mark.parametrize("file", ["trajectory_online.txt", "timestamps.txt", "groundtruth.txt"])
def test_text_that_is_no_trajectory_is_a_fault_though_its_checksum_fits(made, file):
    sorted(made.rglob(file))[0].write_text("total garbage\n")
    sum_up(made)
    assert bank.verify(made)
    assert all("runs/" in fault for fault in bank.verify(made))


@pytest.mark.slow
def test_a_repository_of_something_else_gets_no_bank(made, remote, tmp_path):
    subprocess.run(
        ["git", "clone", "--quiet", remote, tmp_path / "code"], check=True, capture_output=True
    )
    (tmp_path / "code" / "main.py").write_text("")
    for words in (
        ["add", "main.py"],
        ["commit", "--quiet", "--message", "Begin"],
        ["push", "--quiet", "origin", "HEAD"],
    ):
        subprocess.run(["git", *words], cwd=tmp_path / "code", check=True)
    with pytest.raises(RunError, match=r"is no bank: it has no SHA256SUMS, and holds main\.py"):
        bank.push(made, remote)


@pytest.mark.slow
def test_an_archive_is_pulled_from_its_address(made, tmp_path, monkeypatch):
    def download(url, target):
        assert url == "https://example.org/bank.zip"
        with zipfile.ZipFile(target, "w") as archive:
            for path in made.rglob("*"):
                archive.write(path, Path("bank-main") / path.relative_to(made))

    monkeypatch.setattr(bank, "download", download)
    assert len(bank.pull("https://example.org/bank.zip", tmp_path / "pulled").added) == 2
    altered(made)
    with pytest.raises(RunError, match=r"^bank\.zip/bank-main has faults"):
        bank.pull("https://example.org/bank.zip", tmp_path / "pulled")


def walk(folder, drift=0.0):
    """A trajectory file of 50 poses."""
    stamps = 100 + np.arange(50) / 30
    motions = np.stack(
        [se3.exp(np.array([0.01 * i, drift * np.sin(i), 0, 0, 0.01 * i, 0])) for i in range(50)]
    )
    write_tum(folder, Trajectory(stamps, motions))
    return folder.name, sha256(folder.read_bytes()).hexdigest()


def test_a_manifest_names_trajectories_of_sequences_that_are_not_here(tmp_path):
    (truth, _), (file, digest) = (
        walk(tmp_path / "truth.txt"),
        walk(tmp_path / "theirs.txt", drift=0.01),
    )
    entry = f'file = "{file}"\ntracker = "theirs"\nsequence = "tum/fr3/walking_xyz"\ntruth = "{truth}"\n'
    (tmp_path / "manifest.toml").write_text(
        f'[[trajectory]]\n{entry}sha256 = "{digest}"\nprovenance = "page 7"\n'
        f'[[trajectory]]\n{entry}sha256 = "{"0" * 64}"\n'
    )
    added = bank.add([tmp_path / "manifest.toml"], tmp_path / "bank")
    assert len(added.added) == 1
    assert f"checksum {digest}" in added.left_out[0].reason
    record = RunStore(tmp_path / "bank").read(added.added[0])
    assert (record.coverage, record.incomplete, record.provenance) == (None, False, "page 7")
    assert any("the coverage are not known" in note for note in record.notes)
    assert record.truth_share == pytest.approx(1.0)
    assert "high-dynamic" in record.sequence.tags
    row = RunStore(tmp_path / "bank").frame().iloc[0]
    assert 0 < row["ate_rmse_m"] < 0.01
    assert row.isna()["coverage"]
    listed = invoke("runs", "list", "--results", tmp_path / "bank")
    assert listed.exit_code == 0
    assert "theirs" in listed.output
    page = db.report(tmp_path / "bank").html.read_text()
    assert "theirs" in page
    assert "100.0 %" not in page
    with pytest.raises(RunError, match=r"unknown key .*sha265"):
        (tmp_path / "manifest.toml").write_text(
            f'[[trajectory]]\n{entry}sha256 = "{digest}"\nsha265 = ""\n'
        )
        bank.add([tmp_path / "manifest.toml"], tmp_path / "bank")


def test_a_truth_of_another_time_is_refused(tmp_path):
    walk(tmp_path / "truth.txt")
    words = [
        "--tracker",
        "x",
        "--sequence",
        "mine",
        "--results",
        tmp_path / "r",
        "--truth",
        tmp_path / "truth.txt",
    ]
    assert invoke("import", tmp_path / "truth.txt", *words).exit_code == 0
    (tmp_path / "other.txt").write_text("900 0 0 0 0 0 0 1\n901 0 0 0 0 0 0 1\n")
    with pytest.raises(RunError, match="shares 0 stamps"):
        import_trajectory(
            tmp_path / "other.txt",
            "x",
            "mine",
            truth=tmp_path / "truth.txt",
            results=tmp_path / "r",
        )


@pytest.mark.slow
@pytest.mark.skipif(
    not PUBLISHED.is_dir(), reason="needs the authors' trajectories in ../shared/data/trajectories"
)
def test_published_trajectories_give_the_published_numbers_out_of_a_bank(tmp_path):
    """44 with numbers of their author, of which evo takes repeated stamps of the truth for five, and nine without."""
    lines = []
    numbers = {}

    def name(file, truth, tracker, sequence):
        lines.append(
            f'[[trajectory]]\nfile = "{file}"\nsha256 = "{sha256(file.read_bytes()).hexdigest()}"\n'
            f'tracker = "{tracker}"\nsequence = "{sequence}"\ntruth = "{truth}"\n'
        )

    for table in sorted(PUBLISHED.glob("rgbd-vo/*/published.csv")):
        for row in csv.DictReader(table.open()):
            tracker, sequence = Path(row["trajectory"]).stem, entry_of(table.parent.name).id
            name(
                table.parent / row["trajectory"],
                table.parent / "groundtruth.txt",
                tracker,
                sequence,
            )
            numbers[tracker, sequence] = float(row["rmse_m"])
    own = {"amos_slam": "bonn/synchronous2", "lc_crf_slam": "tum/fr3/walking_xyz"}
    for file, of_truth in SINGLE.items():
        estimate = PUBLISHED / "authors" / f"{file}.txt"
        truth = PUBLISHED / "rgbd-vo" / of_truth if of_truth else estimate.parent
        tracker = estimate.parent.name
        name(
            estimate,
            truth / "groundtruth.txt",
            tracker,
            entry_of(of_truth).id if of_truth else own[tracker],
        )
    (tmp_path / "manifest.toml").write_text("".join(lines))
    added = bank.add([tmp_path / "manifest.toml"], tmp_path / "bank")
    assert (len(added.added), added.left_out) == (53, [])
    assert bank.verify(tmp_path / "bank") == []
    frame = (
        RunStore(tmp_path / "bank")
        .frame("evo-as/v1")
        .set_index(["tracker", "sequence"])["ate_rmse_m"]
    )
    assert len(frame) == 53
    assert frame.notna().all()
    differences = {key: abs(frame[key] - value) for key, value in numbers.items()}
    assert len(differences) == 44
    assert max(differences.values()) < 1e-6
    ranked = RunStore(tmp_path / "bank").frame("tum-rgbd/v1").set_index("tracker")["ate_rmse_m"]
    assert ranked["lc_crf_slam"] == pytest.approx(0.0221, abs=1e-4)


def test_the_shipped_manifest_is_one():
    """Every entry is pinned to a commit and a checksum, which is that of the published file."""
    entries = bank.read_manifest(
        Path(__file__).resolve().parents[2] / "docs" / "how-to" / "authors.toml"
    )
    assert len(entries) == len({entry.sha256 for entry in entries}) == 21
    assert all(
        re.search("/[0-9a-f]{40}/", place)
        for entry in entries
        for place in (entry.file, entry.truth)
        if place
    )
    assert all(bool(entry.truth) == bool(entry.truth_sha256) for entry in entries)
    # none without ../shared
    published = {sha256(path.read_bytes()).hexdigest() for path in PUBLISHED.rglob("*.txt")}
    named = {digest for entry in entries for digest in (entry.sha256, entry.truth_sha256) if digest}
    assert not published or named <= published
