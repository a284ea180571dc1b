"""Programs that read a whole sequence and write one trajectory at its end."""

import importlib.util
import os
import re
import sys
from pathlib import Path

import cv2
import numpy as np
import psutil
import pytest
from test_adapter_orbslam3 import PACKED, XYZ

from dynslam_bench import api as db
from dynslam_bench.core.errors import SettingsError, TrackerError, TrackerTimeoutError
from dynslam_bench.geometry import Trajectory, se3, write_tum
from dynslam_bench.reports.model.board import load_board
from dynslam_bench.sequences import open_sequence
from dynslam_bench.sequences.readers.layouts import read_vslam_lab
from dynslam_bench.testing import CornerSequence, TurningSequence, isolated_tracker_report
from dynslam_bench.trackers import TRACKERS, TrackerContext, build_tracker
from dynslam_bench.trackers.adapters.specs import BatchSettings

EXAMPLES = Path(__file__).resolve().parents[3] / "examples" / "batch"

HEAD = """
import os, sys, time
sequence, associations, camera, output, threads = sys.argv[1:]
rows = [line.split() for line in open(associations)]
def write(rows, text="{} {} 0 0 0 0 0 1"):
    with open(output, "w") as file:
        file.write("".join(text.format(*row) + "\\n" for row in rows))
"""
GOOD = "write([[row[0], 0.01 * i] for i, row in enumerate(rows)])\n"
WORDS = ["{sequence}", "{associations}", "{camera}", "{output}", "{threads}"]


@pytest.fixture
def toml(tmp_path):
    """Writes a program and the file that describes it; returns that file."""

    def write(code, **fields):
        (tmp_path / "slam.py").write_text(HEAD + code)
        told = {
            "name": "Toy",
            "version": "7",
            "license": "MIT",
            "command": [sys.executable, "slam.py", *WORDS],
        } | fields
        path = tmp_path / "slam.toml"
        path.write_text("".join(f"{name} = {value!r}\n" for name, value in told.items()))
        return path

    return write


def ran(path, folder, **settings):
    """The trajectory of a program on the first frames of a folder, its tracker, and the sequence."""
    sequence = open_sequence(folder, frames=(0, 12))
    tracker = build_tracker(f"batch:{path}", settings, TrackerContext(fps=sequence.fps, threads=3))
    tracker.reset(sequence.camera, rng=np.random.default_rng(0))
    try:
        results = [tracker.track(sequence[index]) for index in range(len(sequence))]
        assert {(result.state, result.T_world_cam) for result in results} == {("initialising", None)}
        return tracker.finalize(), tracker, sequence
    finally:
        tracker.close()


def test_the_program_sees_the_frames_as_they_are(toml, toy_folder, tmp_path):
    copies = f"""
import shutil
shutil.copytree(sequence, {str(tmp_path / "seen")!r})
shutil.copy(camera, {str(tmp_path / "camera.yaml")!r})
assert threads == os.environ["OMP_NUM_THREADS"] == "3" and os.listdir() == []
"""
    trajectory, tracker, sequence = ran(toml(copies + GOOD), toy_folder)
    assert np.allclose(trajectory.timestamps, sequence.timestamps, atol=1e-6)
    assert np.allclose(trajectory.positions[:, 0], 0.01 * np.arange(12))
    assert tracker.measured["program_s"] > 0 and tracker.measured["notes"] == []
    stamp, rgb, _, depth = (tmp_path / "seen" / "associations.txt").read_text().splitlines()[5].split()
    assert float(stamp) == pytest.approx(sequence.timestamps[5], abs=1e-6)
    assert np.array_equal(cv2.imread(str(tmp_path / "seen" / rgb))[:, :, ::-1], sequence[5].rgb)
    units = cv2.imread(str(tmp_path / "seen" / depth), cv2.IMREAD_UNCHANGED)
    assert np.abs(units / sequence.camera.depth_factor - sequence[5].depth).max() <= 0.51 / sequence.camera.depth_factor
    stored = cv2.FileStorage(str(tmp_path / "camera.yaml"), cv2.FILE_STORAGE_READ)
    for new, old in (("Camera1.fx", "Camera.fx"), ("RGBD.DepthMapFactor", "DepthMapFactor")):
        assert stored.getNode(new).real() == stored.getNode(old).real() > 0
    assert stored.getNode("DepthMapFactor").real() == sequence.camera.depth_factor


def test_indices_stand_for_stamps(toml, toy_folder):
    half = toml("write([[i, 0.01 * i] for i in (8, 4, 0)])", format="indices")
    trajectory, _, sequence = ran(half, toy_folder)
    assert trajectory.timestamps.tolist() == sequence.timestamps[[0, 4, 8]].tolist()
    assert np.allclose(trajectory.positions[:, 0], [0.0, 0.04, 0.08])


def test_a_program_that_crashes_behind_its_trajectory_is_taken_and_noted(toml, toy_folder):
    _, tracker, _ = ran(toml(GOOD + "print('bye', flush=True); os.abort()"), toy_folder)
    assert len(tracker.measured["notes"]) == 1 and "SIGABRT" not in tracker.measured["notes"][0]
    assert "signal 6" in tracker.measured["notes"][0] and "'bye'" in tracker.measured["notes"][0]


BAD = {
    "writes no file": ("print('loading'); sys.exit('no licence')", {}, "exit code 1, and wrote no .*'no licence'"),
    "in colours": ("print('\\x1b[31mbroken\\x1b[0m\\n\\x1b[0;m'); sys.exit(2)", {}, "its last words: 'broken'"),
    "needs a display": ("sys.exit('Pangolin X11: Failed to open X display')", {}, "X display'.*xvfb-run"),
    "half a line": ("write(rows, '{} 0.5 0 0')", {}, "slam|line 1"),
    "without stamps": ("write(rows, '1 0 0 0 0 1 0 0 0 0 1 0')", {}, "line 1"),
    "no pose": ("write([])", {}, "holds no poses"),
    "another clock": ("write([[9e5 + i, 0] for i in range(12)])", {}, "none of the 12 poses .*900000.000.*frames from"),
    "nanoseconds": ("write([[int(float(row[0]) * 1e9), 0] for row in rows])", {}, "no seconds"),
    "index too large": ("write([[99, 0]])", {"format": "indices"}, "indices of frames 0 to 11"),
    "dies": ("os.abort()", {}, "killed by signal 6"),
}


@pytest.mark.parametrize("code, fields, words", BAD.values(), ids=BAD)
def test_what_a_program_does_wrong_is_one_line(toml, toy_folder, code, fields, words):
    with pytest.raises(TrackerError, match=words) as caught:
        ran(toml(code, **fields), toy_folder)
    assert "\n" not in str(caught.value) and str(caught.value).startswith("Toy: ")


def test_one_that_never_ends_is_killed_with_what_it_started(toml, toy_folder, tmp_path):
    child = (
        f"import subprocess; print(subprocess.Popen(['sleep', '60']).pid, file=open({str(tmp_path / 'pid')!r}, 'w'))\n"
    )
    with pytest.raises(TrackerTimeoutError, match="not done within 1 s, killed; its last words: 'frame 3'"):
        ran(toml(child + "print('frame 3', flush=True)\ntime.sleep(60)"), toy_folder, timeout_s=1)
    pid = int((tmp_path / "pid").read_text())
    assert not psutil.pid_exists(pid) or psutil.Process(pid).status() == psutil.STATUS_ZOMBIE


@pytest.mark.parametrize(
    "fields, words",
    [
        ({"comand": ["x"]}, "unknown key 'comand'.*did you mean 'command'"),
        ({"command": []}, "command"),
        ({"command": ["nowhere-to-be-found"]}, "cannot start 'nowhere-to-be-found'"),
        ({"format": "kitti"}, "format"),
        ({"name": ""}, "name"),
    ],
)
def test_files_that_describe_no_program(toml, fields, words):
    with pytest.raises(SettingsError, match=words):
        build_tracker(f"batch:{toml(GOOD, **fields)}")


def test_the_record_and_the_board_say_that_only_the_final_trajectory_exists(toml, toy_folder, tmp_path):
    results = tmp_path / "results"
    path = toml(GOOD.replace("enumerate(rows)", "enumerate(rows[:15])"))
    spec = TRACKERS.get(f"batch:{path}")
    assert (spec.label, spec.license, spec.online) == ("Toy", "MIT", False) and spec.version.startswith("7+")
    run = db.run(f"batch:{path}", toy_folder, frames=(0, 20), results=results)
    record = run.record
    assert run.status == "ok" and record.coverage == 0.75 and (record.n_tracked, record.n_lost) == (15, 5)
    assert record.timings["total"].median_s > 0 and any("only the final trajectory" in note for note in record.notes)
    assert run.metrics["ate_rmse_m"] >= 0
    gone = db.run(f"batch:{toml('sys.exit(3)')}", toy_folder, frames=(0, 20), results=results)
    assert gone.status == "crashed" and "exit code 3" in gone.record.reason and gone.record.run_id != record.run_id
    board = load_board(results)
    assert len(board.final_only) == 1 and not board.ranked
    assert board.runs(board.final_only[0])[0].trajectory == "final"


ROWS = {
    "no file": ("print('loading'); sys.exit('no licence')", "crashed", "exit code 1, and wrote no .*'no licence'"),
    "half a file": ("write([[row[0], 0] for row in rows[:3]]); print('lost')", "lost", "tracked on 3 of 12.*'lost'"),
    "no stamps": ("write(rows, '1 0 0 0 0 1 0 0 0 0 1 0'); print('bye')", "crashed", "line 1.*'bye'"),
    "another clock": ("write([[9e5 + i, 0] for i in range(12)]); print('bye')", "crashed", "stamps from 900000.*'bye'"),
    "never ends": ("print('frame 3', flush=True); time.sleep(60)", "timeout", "not done within 2 s.*'frame 3'"),
    "needs a display": ("sys.exit('Failed to open X display')", "crashed", "'Failed to open X display'.*xvfb-run"),
}


@pytest.mark.parametrize("code, status, words", ROWS.values(), ids=ROWS)
def test_each_way_to_fail_is_a_row_with_the_program_s_last_words(toml, toy_folder, tmp_path, code, status, words):
    settings = {"timeout_s": 2}
    run = db.run(f"batch:{toml(code)}", toy_folder, frames=(0, 12), settings=settings, results=tmp_path / "results")
    assert run.status == status
    assert re.search(words, " ".join([run.record.reason, *run.record.notes]))


BY_HEART = """
width = next(line.split()[1] for line in open(camera) if line.startswith("Camera.width"))
truth = [line.split() for line in open(os.path.join(os.path.dirname(__file__), width + ".txt")) if line[0] != "#"]
write([pose for pose in truth if float(pose[0]) in {float(row[0]) for row in rows}], "{} {} {} {} {} {} {} {}")
"""


@pytest.mark.parametrize("inverted", [False, True], ids=["good", "world to camera"])
def test_the_conformance_kit_checks_the_final_trajectory(toml, tmp_path, inverted):
    path = toml(BY_HEART)
    for scene in (CornerSequence(4), TurningSequence()):
        truth = scene.ground_truth
        poses = se3.inverse(truth.T_world_cam) if inverted else truth.T_world_cam
        write_tum(tmp_path / f"{scene.camera.width}.txt", Trajectory(truth.timestamps, poses))
    report = isolated_tracker_report(f"batch:{path}", frames=4)
    statuses = {check.name: check.status for check in report.checks}
    assert [check.name for check in report.failed] == ["camera to world"] * inverted, report.checks
    assert statuses["results"] == statuses["final trajectory"] == statuses["two resets"] == "passed"
    assert statuses["one frame"] == "skipped"


def test_the_conformance_kit_names_what_a_program_does_wrong(toml):
    report = isolated_tracker_report(f"batch:{toml('sys.exit(7)')}", frames=4)
    assert [check.name for check in report.failed] == ["results"] and "exit code 7" in report.failed[0].message


@pytest.mark.parametrize("file", sorted(EXAMPLES.glob("*.toml")), ids=lambda file: file.stem)
def test_the_examples_describe_programs(file):
    program, here = BatchSettings(program=str(file)).read()
    words = program.words(here, **dict.fromkeys(("sequence", "camera", "associations", "output", "folder"), "/x"))
    assert not any(re.search(r"\{\w+\}", word) for word in words)
    scripts = [word for word in words if word.endswith(".py") and Path(word).is_absolute()]
    assert all(Path(script).is_file() for script in scripts) and program.license


PIXI = r"""#!{python}
import pathlib, sys
assert sys.argv[1:6] == ["run", "--frozen", "-e", "dpvo", "execute-mono"]
stated = dict(zip((key[2:] for key in sys.argv[6::2]), sys.argv[7::2]))
rows = [line.split(",") for line in open(stated["rgb_csv"]).read().splitlines()[1:]]
assert all(pathlib.Path(stated["sequence_path"], row[1]).is_file() for row in rows)
poses = "".join(row[0] + ",0.5,0,0,0,0,0,1\n" for row in rows)
heading = "ts (ns),tx (m),ty (m),tz (m),qx,qy,qz,qw\n"
pathlib.Path(stated["exp_folder"], "00000_KeyFrameTrajectory.csv").write_text(heading + poses)
"""


def test_a_system_of_vslam_lab_gets_its_tables(tmp_path, toy_folder, monkeypatch):
    """Our own reader of VSLAM-LAB's layout reads the tables; a program in pixi's place writes VSLAM-LAB's poses."""
    (tmp_path / "pixi").write_text(PIXI.format(python=sys.executable))
    (tmp_path / "pixi").chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    for file in EXAMPLES.glob("vslam_lab.*"):
        (tmp_path / file.name).write_text(file.read_text().replace("/opt/VSLAM-LAB", str(tmp_path)))
    with (tmp_path / "vslam_lab.py").open("a") as script:
        script.write(f"import shutil\nshutil.copytree('.', {str(tmp_path / 'seen')!r})\n")
    trajectory, _, sequence = ran(tmp_path / "vslam_lab.toml", toy_folder)
    assert np.allclose(trajectory.timestamps, sequence.timestamps, atol=1e-6)
    assert np.allclose(trajectory.positions[:, 0], 0.5)
    camera = read_vslam_lab(tmp_path / "seen", None).camera
    assert camera.matrix == pytest.approx(sequence.camera.matrix) and camera.width == sequence.camera.width


@pytest.mark.skipif(importlib.util.find_spec("pyorbslam3") is None, reason="pyorbslam3 is not installed")
@pytest.mark.skipif(
    not (PACKED.is_file() and XYZ.is_dir()), reason="no ORB vocabulary or TUM excerpt beside the checkout"
)
def test_orb_slam3_as_a_batch_program(tmp_path, monkeypatch):
    """Its final trajectory is as near to the truth as that of the same system, frame by frame."""
    monkeypatch.setenv("DYNSLAM_BENCH_ORB_VOCABULARY", str(PACKED))
    how = {"frames": (0, 40), "results": tmp_path / "results", "protocol": "tum-rgbd/v1"}
    batch = db.run(f"batch:{EXAMPLES / 'orb_slam3.toml'}", XYZ, **how)
    online = db.run("orbslam3", XYZ, **how)
    assert batch.status == online.status == "ok" and batch.record.coverage == 1.0
    final = online.store.score(online.record, "tum-rgbd/v1").final.metrics["ate_rmse_m"]
    assert batch.metrics["ate_rmse_m"] == pytest.approx(final, rel=0.5) and final < 0.03
    assert batch.record.peak_memory_mb > 100


@pytest.mark.skipif(importlib.util.find_spec("open3d") is None, reason="open3d is not installed (its wheel has 400 MB)")
@pytest.mark.skipif(not XYZ.is_dir(), reason="no TUM excerpt beside the checkout")
def test_open3d_as_a_batch_program(tmp_path):
    run = db.run(f"batch:{EXAMPLES / 'open3d.toml'}", XYZ, frames=(0, 20), results=tmp_path)
    assert run.status == "ok" and run.record.coverage == 1.0
    assert run.metrics["ate_rmse_m"] < 0.5 * run.metrics["static_camera_ate_rmse_m"]
