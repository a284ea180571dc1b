"""Programs that read a whole sequence and write one trajectory at its end."""

import importlib.util
import lzma
import shutil
import sys
from pathlib import Path

import cv2
import numpy as np
import psutil
import pytest
from test_adapter_orbslam3 import PACKED, XYZ

from dynslam_bench import api as db
from dynslam_bench.core.errors import SettingsError, TrackerError, TrackerTimeoutError
from dynslam_bench.reports.model.board import load_board
from dynslam_bench.sequences import open_sequence
from dynslam_bench.trackers import TRACKERS, TrackerContext, build_tracker

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


@pytest.mark.skipif(importlib.util.find_spec("pyorbslam3") is None, reason="pyorbslam3 is not installed")
@pytest.mark.skipif(
    not (PACKED.is_file() and XYZ.is_dir()), reason="no ORB vocabulary or TUM excerpt beside the checkout"
)
def test_orb_slam3_as_a_batch_program(tmp_path):
    """Its final trajectory is as near to the truth as that of the same system, frame by frame."""
    (tmp_path / "words.txt").write_bytes(lzma.decompress(PACKED.read_bytes()))
    shutil.copy(Path(__file__).with_name("orbslam3_batch.py"), tmp_path)
    arguments = ["words.txt", "{camera}", "{sequence}", "{associations}", "{output}"]
    command = [sys.executable, "orbslam3_batch.py", *arguments]
    (tmp_path / "orb.toml").write_text(f"name = 'ORB-SLAM3'\ncommand = {command!r}\n")
    how = {"frames": (0, 40), "results": tmp_path / "results", "protocol": "tum-rgbd/v1"}
    batch = db.run(f"batch:{tmp_path / 'orb.toml'}", XYZ, **how)
    online = db.run("orbslam3", XYZ, settings={"vocabulary": str(tmp_path / "words.txt")}, **how)
    assert batch.status == online.status == "ok" and batch.record.coverage == 1.0
    final = online.store.score(online.record, "tum-rgbd/v1").final.metrics["ate_rmse_m"]
    assert batch.metrics["ate_rmse_m"] == pytest.approx(final, rel=0.5) and final < 0.03
    assert batch.record.peak_memory_mb > 100
