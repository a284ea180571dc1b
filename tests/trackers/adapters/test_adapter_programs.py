"""Programs over JSON lines: what is exchanged."""

import importlib.util
import json
import os
import re
import resource
import shlex
import shutil
import subprocess
import sys
import tempfile
import textwrap
import time
from contextlib import closing
from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers.envs_play import play
from helpers.hostile import alive
from helpers.waiting import until
from test_adapter_controls import PACKED, XYZ, needs_data

from dynslam_bench import api as db
from dynslam_bench.contracts import Frame
from dynslam_bench.core.errors import (
    DynslamError,
    InfrastructureError,
    SettingsError,
    TrackerError,
    TrackerTimeoutError,
)
from dynslam_bench.envs.slam_env import SlamEnv
from dynslam_bench.geometry import Camera, Trajectory, se3, write_tum
from dynslam_bench.reports.model.board import load_board
from dynslam_bench.sequences import open_sequence
from dynslam_bench.sequences.readers.layouts import read_vslam_lab
from dynslam_bench.testing import CornerSequence, TurningSequence, check_tracker, tracker_report
from dynslam_bench.trackers import TRACKERS, TrackerContext, build_tracker
from dynslam_bench.trackers.adapters import subprocess_tracker as exchange
from dynslam_bench.trackers.adapters.program_file import BATCH_NAMES, CAMERA_NAMES, read_batch
from dynslam_bench.trackers.adapters.specs import SubprocessSettings

pytestmark = pytest.mark.slow

EXAMPLES = Path(__file__).resolve().parents[3] / "examples" / "batch"
CAMERA = Camera(
    64, 48, 60.0, 61.0, 31.5, 23.5, distortion=(0.1, -0.2, 0.001, 0.002, 0.3), baseline_m=0.08
)

PRELUDE = """
import json, os, sys, time
def say(answer):
    sys.stdout.write(json.dumps(index | answer) + "\\n"); sys.stdout.flush()
STILL = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]
index = {}
def read():
    for line in sys.stdin:
        request = json.loads(line)
        index.clear()
        index.update({key: request[key] for key in request if key == "index"})
        yield request
requests = read()
"""

GOOD = """
for request in requests:
    if request["op"] == "reset":
        say({"ok": True})
    elif request["op"] == "track":
        say({"state": "ok", "T_world_cam": STILL})
    elif request["op"] == "close":
        break
"""


def frame(index, seed=0):
    rng = np.random.default_rng([seed, index])
    depth = rng.uniform(0.5, 4, (48, 64)).astype(np.float32)
    depth[:5] = 0
    return Frame(index, 1.5 + index / 30, rng.integers(0, 256, (48, 64, 3), dtype=np.uint8), depth)


def reset(tracker, seed=0):
    tracker.reset(CAMERA, rng=np.random.default_rng(seed))
    return tracker


@pytest.fixture
def program(tmp_path):
    """Makes a tracker of a program's text; all of them are closed at the end."""
    made = []

    def make(text, context=None, **settings):
        path = tmp_path / f"program{len(made)}.py"
        path.write_text(PRELUDE + textwrap.dedent(text))
        made.append(
            build_tracker(
                f"subprocess:{shlex.join([sys.executable, str(path)])}", settings, context
            )
        )
        return made[-1]

    yield make
    for tracker in made:
        tracker.close()


def test_a_program_keeps_the_contract(program):
    made = program(GOOD)
    check_tracker(lambda: made, frames=3)


def test_reset_tells_all(program, tmp_path):
    told = tmp_path / "told.json"
    text = f"""
    for request in requests:
        if request["op"] == "reset":
            open({str(told)!r}, "w").write(json.dumps([request, os.environ["OMP_NUM_THREADS"], os.getcwd()]))
            say({{"ok": True}})
    """
    context = TrackerContext(sequence_id="tum/fr1/xyz", device="cuda:1", threads=3, fps=25.0)
    reset(program(text, context, folder=str(tmp_path)))
    request, threads, folder = json.loads(told.read_text())
    assert request["camera"] == request["camera"] | {
        "width": 64, "height": 48, "fx": 60.0, "fy": 61.0, "distortion": [0.1, -0.2, 0.001, 0.002, 0.3],
        "baseline_m": 0.08, "fps": 25.0,
    }  # fmt: skip
    assert request == request | {"threads": 3, "device": "cuda:1", "sequence": "tum/fr1/xyz"}
    assert threads == "3"
    assert Path(folder).resolve() == tmp_path.resolve()


RAW = """
import struct
for request in requests:
    if request["op"] == "reset":
        images, camera = request["images"], request["camera"]
        say({"ok": True})
    elif request["op"] == "track":
        with open(images["file"], "rb") as file:
            data = file.read()
        assert len(data) == images["bytes"]
        size = camera["width"] * camera["height"]
        rgb = data[images["rgb_offset"]:][:size * 3]
        depth = struct.unpack(f"<{size}f", data[images["depth_offset"]:][:size * 4])
        weights = sum((i % 251) * v for i, v in enumerate(rgb))
        say({"state": "ok", "T_world_cam": [STILL[i:i + 4] for i in (0, 4, 8, 12)],
             "stats": {"rgb": weights, "depth": sum((i % 251) * v for i, v in enumerate(depth)),
                       "index": request["index"], "timestamp": request["timestamp"]},
             "timings": {"tracking": 0.001}})
"""


def test_raw_images_arrive_exactly(program):
    tracker = reset(program(RAW))
    for index in range(3):
        sent = frame(index)
        result = tracker.track(sent)
        weights = np.arange(48 * 64 * 3) % 251
        assert result.stats["rgb"] == float((weights * sent.rgb.reshape(-1).astype(np.int64)).sum())
        expected = (weights[: 48 * 64] * sent.depth.reshape(-1).astype(np.float64)).sum()
        assert result.stats["depth"] == pytest.approx(expected, rel=1e-12)
        assert result.stats["index"] == index
        assert result.stats["timestamp"] == sent.timestamp
        assert list(result.timings) == ["tracking", "transfer"]
        assert result.timings["transfer"] >= 0


def test_png_images_arrive_exactly(program, tmp_path):
    text = f"""
    import shutil
    for request in requests:
        if request["op"] == "reset":
            assert request["images"]["mode"] == "png", request
            factor = request["images"]["depth_factor"]
            say({{"ok": True}})
        elif request["op"] == "track":
            shutil.copy(request["rgb"], {str(tmp_path)!r}); shutil.copy(request["depth"], {str(tmp_path)!r})
            say({{"state": "ok", "T_world_cam": STILL,
                  "stats": {{"factor": factor, "files": len(os.listdir(os.path.dirname(request["rgb"])))}}}})
    """
    tracker = reset(program(text, images="png"))
    for index in range(3):
        sent = frame(index)
        result = tracker.track(sent)
        rgb = cv2.imread(str(tmp_path / f"rgb-{index:06d}.png"), cv2.IMREAD_COLOR)[..., ::-1]
        depth = cv2.imread(str(tmp_path / f"depth-{index:06d}.png"), cv2.IMREAD_UNCHANGED)
        assert np.array_equal(rgb, sent.rgb)
        assert depth.dtype == np.uint16
        assert np.array_equal(depth, np.rint(sent.depth * result.stats["factor"]))
        assert result.stats["files"] <= 4, "files of frames before the last one are removed"


def test_final_trajectory(program):
    text = """
    for request in requests:
        if request["op"] == "finalize":
            say({"trajectory": [[1.5, 1, 2, 3, 0, 0, 0.6, 0.8], [1.6, 0, 0, 0, 0, 0, 0, 1]]})
        else:
            say({"state": "ok", "T_world_cam": STILL})
    """
    tracker = reset(program(text, final=True))
    tracker.track(frame(0))
    final = tracker.finalize()
    assert (final.timestamps.tolist(), final.positions.tolist()) == (
        [1.5, 1.6],
        [[1, 2, 3], [0, 0, 0]],
    )
    assert np.allclose(final.T_world_cam[0, :3, :3], [[0.28, -0.96, 0], [0.96, 0.28, 0], [0, 0, 1]])
    assert not hasattr(program(text), "finalize")


def test_chatter_is_no_answer(program):
    """What a program prints beside its answers, to either channel and in any amount, disturbs nothing."""
    text = """
    for request in requests:
        print("Loading ...", "x" * 5000); sys.stderr.write("warning: y\\n" * 20000); sys.stderr.flush()
        say({"state": "ok", "T_world_cam": STILL})
        print("done")
    """
    tracker = reset(program(text))
    assert [tracker.track(frame(index)).state for index in range(5)] == ["ok"] * 5


def test_lost_and_initialising(program):
    text = """
    answers = iter([{"ok": True}, {"state": "initialising"}, {"state": "lost", "T_world_cam": None},
                    {"state": "lost", "T_world_cam": STILL}])
    for answer in answers:
        next(requests); say(answer)
    """
    tracker = reset(program(text))
    results = [tracker.track(frame(index)) for index in range(3)]
    assert [result.state for result in results] == ["initialising", "lost", "lost"]
    assert results[0].T_world_cam is None
    assert results[2].T_world_cam is not None


def test_second_reset_starts_afresh(program):
    text = """
    count = 0
    for request in requests:
        count += 1
        say({"state": "ok", "T_world_cam": STILL, "stats": {"count": count, "pid": os.getpid()}})
    """
    tracker = program(text)
    pids = []
    for _ in range(2):
        reset(tracker)
        results = [tracker.track(frame(index)) for index in range(2)]
        assert [result.stats["count"] for result in results] == [2, 3]
        pids.append(int(results[0].stats["pid"]))
    tracker.close()
    tracker.close()
    assert pids[0] != pids[1]
    until(lambda: not alive(pids))
    with pytest.raises(TrackerError, match="before reset"):
        tracker.track(frame(2))


@pytest.mark.parametrize(
    "end, words",
    [
        ("sys.exit('disk full')", "exit code 1; its last line: 'disk full'"),
        ("os._exit(7)", "exit code 7; it wrote no message"),
        ("os.kill(os.getpid(), 11)", "killed by signal 11 "),
    ],
)
@pytest.mark.parametrize("when", ["close", "last answer"])
def test_a_program_that_fails_behind_its_last_answer_fails(program, end, words, when):
    text = f"""
    for request in requests:
        if request["op"] == "close":
            {end}
        say({{"state": "ok", "T_world_cam": STILL}})
        if request.get("index") == 1 and {when == "last answer"}:
            {end}
    """
    tracker = reset(program(text))
    for index in range(2):
        tracker.track(frame(index))
    with pytest.raises(
        TrackerError, match=f"after its last answer: the program .*{words}"
    ) as raised:
        tracker.close()
    tracker.close()
    code = int(re.search(r"exit_codes=\[0,(-?\d+)\]", raised.value.hint).group(1))
    fine = reset(program(text, exit_codes=[0, code]))
    for index in range(2):
        fine.track(frame(index))
    fine.close()


def test_a_run_of_a_program_that_fails_behind_its_last_answer_has_crashed(toy_folder, tmp_path):
    path = tmp_path / "program.py"
    path.write_text(PRELUDE + textwrap.dedent(GOOD) + "sys.exit('cannot write the map')\n")
    run = db.run(
        f"subprocess:{shlex.join([sys.executable, str(path)])}",
        toy_folder,
        frames=(0, 3),
        results=tmp_path,
    )
    assert run.status == "crashed"
    assert "exit code 1; its last line: 'cannot write the map'" in run.record.reason


# The example in C++: compiled with the system's compiler, run as anybody would.


COMPILER = shutil.which("c++") or shutil.which("g++") or shutil.which("clang++")


@pytest.mark.skipif(COMPILER is None, reason="there is no C++ compiler here")
def test_a_tracker_in_one_cpp_file_follows_the_camera(tmp_path: Path) -> None:
    program = tmp_path / "direct_odometry"
    source = EXAMPLES.parent / "cpp" / "direct_odometry.cpp"
    command = [COMPILER, "-O2", "-Wall", "-Wextra", "-Werror", "-o", program, source]
    subprocess.run(command, check=True, capture_output=True)
    env = SlamEnv("synthetic/sitting_xyz?scene=100", f"subprocess:{program}", frames=(0, 12))
    _, infos, _ = play(env)
    outcomes = env.episode.outcomes
    assert [each.state for each in outcomes] == ["ok"] * 12
    assert all(set(each.timings) >= {"odometry", "transfer"} for each in outcomes[1:])
    metrics = infos[-1]["episode_metrics"]
    env.close()
    assert metrics["ate_rmse_m"] < 0.3 * metrics["static_camera_ate_rmse_m"]


# Every way in which a program over JSON lines can fail, and how it is ended.


FAULTS = {
    "raises": (
        "raise ValueError('no such camera')",
        "exit code 1; its last line: 'ValueError: no such camera'",
    ),
    "exits": (
        "sys.stderr.write('cannot open\\nconfig.yaml\\n'); sys.exit(3)",
        "exit code 3; its last line: 'config.yaml'",
    ),
    "silent exit": ("os._exit(0)", "exit code 0; it wrote no message"),
    "segfault": ("os.kill(os.getpid(), 11)", "killed by signal 11 "),
    "no json": ("print('{pose: 1}', flush=True)", "is no valid JSON"),
    "error": ("say({'error': 'out of\\nmemory'})", "at frame 7: out of memory"),
    "no pose": ("say({'state': 'ok'})", "state 'ok' without a pose"),
    "state": (
        "say({'state': 'fine', 'T_world_cam': STILL})",
        "expected one of initialising, ok, lost",
    ),
    "shape": ("say({'state': 'ok', 'T_world_cam': STILL[:12]})", "not 16 numbers"),
    "text": ("say({'state': 'ok', 'T_world_cam': 'identity'})", "not 16 numbers"),
    "not rigid": (
        "say({'state': 'ok', 'T_world_cam': [2 * v for v in STILL]})",
        "no rigid transformation",
    ),
    "nan": ("say({'state': 'ok', 'T_world_cam': [float('nan')] * 16})", "no valid JSON|not finite"),
    "stats": (
        "say({'state': 'ok', 'T_world_cam': STILL, 'stats': {'a': 'b'}})",
        "stats and timings are not",
    ),
    "hangs": (
        "sys.stderr.write('optimising\\n'); sys.stderr.flush(); time.sleep(60)",
        "no answer within 0.5 s.*'optimising'",
    ),
    "of another frame": (
        "index['index'] = 6; say({'state': 'ok', 'T_world_cam': STILL})",
        "answered index 6",
    ),
    "of no frame": (
        "index.clear(); say({'state': 'ok', 'T_world_cam': STILL})",
        "answered index None",
    ),
    "closes": ("os.close(1); time.sleep(60)", "closed its output"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_faults_become_one_line(program, fault):
    code, expected = FAULTS[fault]
    tracker = program(
        f"""
        for request in requests:
            if request["op"] == "track" and request["index"] == 7:
                {code}
            else:
                say({{"state": "ok", "T_world_cam": STILL, "stats": {{"pid": os.getpid()}}}})
        """,
        frame_timeout_s=0.5 if fault == "hangs" else 20,
        close_timeout_s=0.2,
    )
    pid = int(reset(tracker).track(frame(6)).stats["pid"])
    with pytest.raises(TrackerError, match=expected) as caught:
        tracker.track(frame(7))
    assert "at frame 7" in str(caught.value)
    tracker.close()
    until(lambda: not alive([pid]))
    reset(tracker)
    assert tracker.track(frame(0)).state == "ok", "a reset starts the program again"


def test_refusals_at_reset(program):
    with pytest.raises(TrackerError, match="at reset: fisheye cameras only"):
        reset(
            program(
                "next(requests); say({'error': 'fisheye cameras only'}); time.sleep(60)",
                close_timeout_s=0.1,
            )
        )


def test_faults_at_finalize(program):
    for answer, expected in (
        ("{'trajectory': [[1, 2]]}", "rows of 8"),
        ("{}", "rows of 8"),
        ("{'trajectory': [[1, 0, 0, 0, 0, 0, 0, 0]]}", "norm 0"),
        (
            "{'trajectory': [[2, 0, 0, 0, 0, 0, 0, 1], [1, 0, 0, 0, 0, 0, 0, 1]]}",
            "strictly increasing",
        ),
    ):
        tracker = reset(program(f"for request in requests: say({answer})", final=True))
        with pytest.raises(TrackerError, match=expected):
            tracker.finalize()


def test_commands_that_cannot_start(tmp_path):
    (tmp_path / "text").write_text("no program")
    for name, settings, words in (
        ("subprocess", {}, "subprocess:PROGRAM"),
        ("subprocess:'unclosed", {}, "cannot split"),
        ("subprocess:ls", {"folder": str(tmp_path / "none")}, "no folder"),
        ("subprocess:/no/such/program --fast", {}, "cannot start '/no/such/program'"),
        ("subprocess:no-such-program", {}, "cannot start 'no-such-program'"),
        ("subprocess:./text", {"folder": str(tmp_path)}, "cannot start './text'"),
    ):
        with pytest.raises(SettingsError, match=words):
            build_tracker(name, settings)


def test_last_words_are_the_last_ones(program):
    """Standard output that is flushed at the end must not pass for what standard error said last."""
    said = (
        "sys.stdout.write('loading vocabulary\\n'); sys.stderr.write('FATAL: no such camera model\\n'); "
        "sys.stderr.flush(); sys.stdout.flush(); os._exit(3)"
    )
    with pytest.raises(
        TrackerError, match=r"exit code 3; its last line: 'FATAL: no such camera model'"
    ):
        reset(program(said))
    early = (
        "sys.stderr.write('warning: old driver\\n'); sys.stderr.flush(); next(requests); time.sleep(1); "
        "say({'ok': True}); next(requests); time.sleep(0.3); print('lost the map', flush=True); os._exit(1)"
    )
    tracker = reset(program(early))
    with pytest.raises(TrackerError, match=r"its last line: 'lost the map'"):
        tracker.track(frame(0))


def test_close_kills_what_does_not_end(program):
    text = """
    import signal, subprocess
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    child = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(600)"])
    next(requests); say({"ok": True})
    next(requests); say({"state": "ok", "T_world_cam": STILL, "stats": {"pid": os.getpid(), "child": child.pid}})
    time.sleep(600)
    """
    tracker = reset(program(text, close_timeout_s=0.2))
    stats = tracker.track(frame(0)).stats
    start = time.monotonic()
    tracker.close()
    assert time.monotonic() - start < 300  # of the 600 s that it sleeps
    until(lambda: not alive([int(stats["pid"]), int(stats["child"])]))


def test_serve_answers_for_a_python_tracker(program):
    """The helper for Python programs: numpy views of the images, exceptions as errors, prints out of the way."""
    root = Path(__file__).resolve().parents[3]
    text = f"""
    sys.path.insert(0, {str(root)!r})
    from dynslam_bench.trackers.adapters.serve import serve
    def track(index, timestamp, rgb, depth):
        print("tracking", index)
        if index == 2:
            raise RuntimeError("no features")
        stats = {{"sum": int(rgb.sum()), "known": int((depth > 0).sum())}}
        return {{"state": "ok", "T_world_cam": STILL, "stats": stats}}
    serve(lambda request: None, track, lambda: [[1.5, 0, 0, 0, 0, 0, 0, 1]])
    """
    tracker = reset(program(text, final=True))
    for index in range(2):
        sent = frame(index)
        assert tracker.track(sent).stats == {
            "sum": float(sent.rgb.sum()),
            "known": float((sent.depth > 0).sum()),
        }
    with pytest.raises(TrackerError, match="at frame 2: RuntimeError: no features"):
        tracker.track(frame(2))
    assert tracker.track(frame(3)).state == "ok", "an answered error does not end the program"
    assert len(tracker.finalize()) == 1


def test_a_program_in_the_present_folder_is_found(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    program = tmp_path / "odometry"
    program.write_text("#!/bin/sh\nexit 0\n")
    program.chmod(0o755)
    monkeypatch.chdir(tmp_path)
    SubprocessSettings(command="./odometry").verify()
    with pytest.raises(SettingsError, match="cannot start 'odometry'"):
        SubprocessSettings(command="odometry").verify()  # as in a shell: by its path, or on PATH


def test_room_for_a_frame_is_taken_first_elsewhere_if_need_be(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    camera = Camera(640, 480, 500.0, 500.0, 320.0, 240.0)
    monkeypatch.setattr(exchange, "SHARED_MEMORY", tmp_path / "missing")
    beside = exchange.ImageExchange(camera, "raw")
    file = beside.folder / exchange.FRAME_FILE
    assert file.is_relative_to(tmp_path), "not a file of holes"
    assert file.stat().st_blocks * 512 >= 640 * 480 * 7, "not a file of holes"
    beside.close()
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1_000_000, hard))  # as if the disk were full
    try:
        with pytest.raises(
            InfrastructureError, match=r"no room for a frame of 2.2 MB: .*free some space"
        ):
            exchange.ImageExchange(camera, "raw")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert [path for path in tmp_path.rglob("*") if path.is_file()] == [], "nothing is left of it"


HEAD = """
import os, sys, time
sequence, associations, camera, output, threads = sys.argv[1:]
rows = [line.split() for line in open(associations)]
def write(rows, text="{} {} 0 0 0 0 0 1"):
    with open(output, "w") as file:
        file.write("".join(text.format(*row) + "\\n" for row in rows))
"""
GOOD_BATCH = "write([[row[0], 0.01 * i] for i, row in enumerate(rows)])\n"


@pytest.fixture
def toml(tmp_path):
    """Writes a program and the file that describes it; returns that file."""

    def write(code, **fields):
        (tmp_path / "slam.py").write_text(HEAD + code)
        words = ["{sequence}", "{associations}", "{camera}", "{output}", "{threads}"]
        given = {
            "name": "Toy",
            "version": "7",
            "license": "MIT",
            "command": [sys.executable, "slam.py", *words],
        } | fields
        path = tmp_path / "slam.toml"
        lines = []
        for name, value in given.items():
            if isinstance(value, dict):
                lines += [f"{name}.{key!r} = {text!r}\n" for key, text in value.items()]
            else:
                lines.append(f"{name} = {value!r}\n")
        path.write_text("".join(lines))
        return path

    return write


def ran(path, folder, **settings):
    """The trajectory of a program on the first frames of a folder, its tracker, and the sequence."""
    sequence = open_sequence(folder, frames=(0, 12))
    tracker = build_tracker(f"batch:{path}", settings, TrackerContext(fps=sequence.fps, threads=3))
    tracker.reset(sequence.camera, rng=np.random.default_rng(0))
    with closing(tracker):
        results = [tracker.track(sequence[index]) for index in range(len(sequence))]
        assert {(result.state, result.T_world_cam) for result in results} == {
            ("initialising", None)
        }
        return tracker.finalize(), tracker, sequence


def test_the_program_sees_the_frames_as_they_are(toml, toy_folder, tmp_path):
    copies = f"""
import shutil
shutil.copytree(sequence, {str(tmp_path / "seen")!r})
shutil.copy(camera, {str(tmp_path / "camera.yaml")!r})
assert threads == os.environ["OMP_NUM_THREADS"] == "3" and os.listdir() == []
"""
    trajectory, tracker, sequence = ran(toml(copies + GOOD_BATCH), toy_folder)
    assert np.allclose(trajectory.timestamps, sequence.timestamps, atol=1e-6)
    assert np.allclose(trajectory.positions[:, 0], 0.01 * np.arange(12))
    assert tracker.measured["program_s"] > 0
    assert tracker.measured["notes"] == []
    stamp, rgb, _, depth = (
        (tmp_path / "seen" / "associations.txt").read_text().splitlines()[5].split()
    )
    assert float(stamp) == pytest.approx(sequence.timestamps[5], abs=1e-6)
    assert np.array_equal(cv2.imread(str(tmp_path / "seen" / rgb))[:, :, ::-1], sequence[5].rgb)
    units = cv2.imread(str(tmp_path / "seen" / depth), cv2.IMREAD_UNCHANGED)
    assert (
        np.abs(units / sequence.camera.depth_factor - sequence[5].depth).max()
        <= 0.51 / sequence.camera.depth_factor
    )
    stored = cv2.FileStorage(str(tmp_path / "camera.yaml"), cv2.FILE_STORAGE_READ)
    for new, old in (("Camera1.fx", "Camera.fx"), ("RGBD.DepthMapFactor", "DepthMapFactor")):
        assert stored.getNode(new).real() == stored.getNode(old).real() > 0
    assert stored.getNode("DepthMapFactor").real() == sequence.camera.depth_factor


def test_indices_stand_for_stamps(toml, toy_folder):
    trajectory, _, sequence = ran(
        toml("write([[i, 0.01 * i] for i in (8, 4, 0)])", format="indices"), toy_folder
    )
    assert trajectory.timestamps.tolist() == sequence.timestamps[[0, 4, 8]].tolist()
    assert np.allclose(trajectory.positions[:, 0], [0.0, 0.04, 0.08])


@pytest.mark.parametrize(
    "end, code, words",
    [
        ("os.abort()", -6, "killed by signal 6 .*'bye'"),
        ("sys.exit(3)", 3, "exit code 3; .*'bye'"),
        ("os.kill(os.getpid(), 11)", -11, "killed by signal 11 "),
    ],
)
def test_an_exit_code_other_than_0_is_a_failure_unless_the_file_names_it(
    toml, toy_folder, end, code, words
):
    program = GOOD_BATCH + f"print('bye', flush=True); {end}"
    with pytest.raises(TrackerError, match=f"^Toy: .*{words}") as raised:
        ran(toml(program), toy_folder)
    assert raised.value.hint == f"if that is no failure: exit_codes = [0, {code}] in slam.toml"
    trajectory, tracker, _ = ran(toml(program, exit_codes=[0, code]), toy_folder)
    (note,) = tracker.measured["notes"]
    assert len(trajectory) == 12
    assert re.search(words, note)
    with pytest.raises(TrackerError, match="exit code 0"):
        ran(toml(GOOD_BATCH, exit_codes=[code]), toy_folder)


OLD = "1.0 0 0 0 0 0 0 1\n"
LEFT_OVER = {
    "a link": "os.symlink(old, output)",
    "a link to a link": "os.symlink(old, 'one'); os.symlink('one', output)",
    "a folder that is a link": "os.symlink(os.path.dirname(old), os.path.dirname(output))",
    "an old file, moved": "shutil.move(old, output)",
    "an old file, with its stamps": "shutil.copy2(old, output)",
    "a second name of an old file": "os.link(old, output)",
}


@pytest.mark.parametrize("code", LEFT_OVER.values(), ids=LEFT_OVER)
def test_a_trajectory_that_was_there_before_is_not_scored(toml, toy_folder, tmp_path, code):
    old = tmp_path / "elsewhere" / "traj.txt"
    old.parent.mkdir()
    rows = [
        f"{stamp:.6f} 0 0 0 0 0 0 1\n"
        for stamp in open_sequence(toy_folder, frames=(0, 12)).timestamps
    ]
    old.write_text("".join(rows))
    os.utime(old, (1.7e9, 1.7e9))
    output = "traj.txt" if "dirname" not in code else "run/traj.txt"
    with pytest.raises(
        TrackerError, match=r"outside of the working folder|before the program started"
    ) as raised:
        ran(toml(f"import shutil; old = {str(old)!r}; {code}", output=output), toy_folder)
    assert "{output}" in raised.value.hint


def test_a_link_within_the_working_folder_is_taken(toml, toy_folder):
    """Some programs keep their trajectories apart, and a link to the last one."""
    trajectory, *_ = ran(
        toml(GOOD_BATCH + "os.rename(output, 'run-1'); os.symlink('run-1', output)"), toy_folder
    )
    assert len(trajectory) == 12


def test_each_call_of_a_program_begins_in_an_empty_folder(toml, toy_folder):
    once = "assert not os.listdir() or sys.exit('not empty')\n" + GOOD_BATCH
    sequence = open_sequence(toy_folder, frames=(0, 12))
    path = toml(once)
    tracker = build_tracker(f"batch:{path}")
    with closing(tracker):
        for _ in range(2):
            tracker.reset(sequence.camera, rng=np.random.default_rng(0))
            for index in range(12):
                tracker.track(sequence[index])
            assert len(tracker.finalize()) == len(tracker.finalize()) == 12
        toml("pass")  # from now on it writes nothing
        with pytest.raises(TrackerError, match=r"exit code 0, and wrote no trajectory\.txt"):
            tracker.finalize()


@pytest.mark.parametrize("digits", ["g", ".4g", ".0f"])
def test_stamps_that_lost_their_digits_are_named(toml, toy_folder, tmp_path, digits):
    write = f"write([[format(float(row[0]), {digits!r}), 0.01 * i] for i, row in enumerate(rows)])"
    shifted = tmp_path / "late"
    shutil.copytree(toy_folder, shifted)
    for name in ("rgb.txt", "depth.txt", "groundtruth.txt"):
        rows = [
            line.split(maxsplit=1)
            for line in (shifted / name).read_text().splitlines()
            if line[0] != "#"
        ]
        (shifted / name).write_text(
            "".join(f"{1.3e9 + float(stamp):.6f} {rest}\n" for stamp, rest in rows)
        )
    with pytest.raises(
        TrackerError, match=r"^Toy: 11 of 12 lines .*repeat .*digits were lost"
    ) as raised:
        ran(toml(write), shifted)
    assert "%.9f" in raised.value.hint


def test_what_was_not_taken_of_a_trajectory_is_noted(toml, toy_folder):
    lost = "write([[row[0], 'nan' if 3 <= i < 5 else 0] for i, row in enumerate(rows)])"
    trajectory, tracker, _ = ran(toml(lost), toy_folder)
    assert len(trajectory) == 10
    assert any("2 of 12 lines skipped: not finite" in note for note in tracker.measured["notes"])


@pytest.mark.parametrize(
    "code, note",
    [
        (
            "write([[f'{float(row[0]) * 1e9:.0f}', 0] for row in rows])",
            r"traj\.txt: stamps are 33333000 apart by the median: taken as nanoseconds \(30 Hz\)",
        ),
        (
            "write([[row[0], 0] for row in rows] + [['nan', 0]])",
            "traj.txt: 1 of 13 lines skipped: not finite",
        ),
    ],
)
def test_what_was_not_taken_as_it_stands_is_noted(toml, toy_folder, code, note):
    trajectory, tracker, sequence = ran(toml(code, output="traj.txt"), toy_folder)
    assert np.allclose(trajectory.timestamps, sequence.timestamps, atol=1e-6)
    (found,) = tracker.measured["notes"]
    assert re.fullmatch(note, found)


def test_repeated_indices_are_noted(toml, toy_folder):
    _, tracker, _ = ran(
        toml("write([[i // 2, i] for i in range(24)])", format="indices"), toy_folder
    )
    assert tracker.measured["notes"] == [
        "trajectory.txt: 12 of 24 lines repeat an index, the first of each is taken"
    ]


BAD = {
    "writes no file": (
        "print('loading'); sys.exit('no licence')",
        {},
        "exit code 1, and wrote no .*'no licence'",
    ),
    "in colours": (
        "print('\\x1b[31mbroken\\x1b[0m\\n\\x1b[0;m'); sys.exit(2)",
        {},
        "its last words: 'broken'",
    ),
    "needs a display": (
        "sys.exit('Pangolin X11: Failed to open X display')",
        {},
        "X display'.*xvfb-run",
    ),
    "half a line": ("write(rows, '{} 0.5 0 0')", {}, "line 1"),
    "without stamps": ("write(rows, '1 0 0 0 0 1 0 0 0 0 1 0')", {}, "line 1"),
    "no pose": ("write([])", {}, "holds no poses"),
    "another clock": (
        "write([[9e5 + i, 0] for i in range(12)])",
        {},
        "none of the 12 poses .*900000.000.*frames from",
    ),
    "lost digits": (
        "write([[f'{1e9 + float(row[0]):g}', 0] for row in rows])",
        {},
        "11 of 12 lines of .* digits were lost",
    ),
    "whole seconds": (
        "write([[f'{float(row[0]):.0f}', 0] for row in rows])",
        {},
        "11 of 12 lines of .* digits were lost",
    ),
    "two units": (
        "write([[33.3 * i, 0] for i in range(60)])",
        {},
        "milliseconds .* or seconds .* name the unit",
    ),
    "index too large": ("write([[99, 0]])", {"format": "indices"}, "indices of frames 0 to 11"),
    "dies": ("os.abort()", {}, "killed by signal 6"),
}


@pytest.mark.parametrize("code, fields, words", BAD.values(), ids=BAD)
def test_what_a_program_does_wrong_is_one_line(toml, toy_folder, code, fields, words):
    with pytest.raises(TrackerError, match=f"^Toy: .*{words}"):
        ran(toml(code, **fields), toy_folder)


def test_one_that_never_ends_is_killed_with_what_it_started(toml, toy_folder, tmp_path):
    pid_file = str(tmp_path / "pid")
    start = "subprocess.Popen(['sleep', '60'])"
    child = f"import subprocess; print({start}.pid, file=open({pid_file!r}, 'w'))\n"
    with pytest.raises(
        TrackerTimeoutError, match="not done within 1 s, killed; its last words: 'frame 3'"
    ):
        ran(toml(child + "print('frame 3', flush=True)\ntime.sleep(60)"), toy_folder, timeout_s=1)
    until(lambda: not alive([int((tmp_path / "pid").read_text())]))


@pytest.mark.parametrize(
    "fields, words",
    [
        ({"comand": ["x"]}, "unknown key 'comand'.*did you mean 'command'"),
        ({"command": []}, "command"),
        ({"command": ["nowhere-to-be-found"]}, "cannot start 'nowhere-to-be-found'"),
        ({"format": "kitti"}, "format"),
        ({"name": ""}, "name"),
        (
            {"output": "/tmp/traj.txt"},
            "output: '/tmp/traj.txt' is no file in the program's working folder",
        ),
        (
            {"output": "../traj.txt"},
            "output: '../traj.txt' is no file in the program's working folder",
        ),
        ({"output": "a/../../traj.txt"}, "is no file in the program's working folder"),
        ({"output": "~/traj.txt"}, "is no file in the program's working folder"),
        ({"output": ""}, "is no file in the program's working folder"),
        (
            {"templates": {"trajectory.txt": "old.txt"}},
            "output: 'trajectory.txt' is made of the template 'old.txt' before the program starts",
        ),
        ({"templates": {".//trajectory.txt": "old.txt"}}, "is made of the template"),
        (
            {"output": "a/traj.txt", "templates": {"a/./traj.txt": "old.txt"}},
            "is made of the template",
        ),
        ({"exit_codes": []}, "exit_codes"),
        ({"exit_codes": [300]}, "exit_codes"),
        ({"exit_codes": ["ok"]}, "exit_codes"),
    ],
)
def test_files_that_describe_no_program(toml, fields, words):
    with pytest.raises(SettingsError, match=words):
        build_tracker(f"batch:{toml(GOOD_BATCH, **fields)}")


def test_the_record_and_the_board_say_that_only_the_final_trajectory_exists(
    toml, toy_folder, tmp_path
):
    results = tmp_path / "results"
    path = toml(GOOD_BATCH.replace("enumerate(rows)", "enumerate(rows[:15])"))
    spec = TRACKERS.get(f"batch:{path}")
    assert (spec.label, spec.license, spec.online) == ("Toy", "MIT", False)
    assert spec.version.startswith("7+")
    run = db.run(f"batch:{path}", toy_folder, frames=(0, 20), results=results)
    record = run.record
    assert run.status == "ok"
    assert record.coverage == 0.75
    assert (record.n_tracked, record.n_lost) == (15, 5)
    assert record.timings["total"].median_s > 0
    assert any("only the final trajectory" in note for note in record.notes)
    assert run.metrics["ate_rmse_m"] >= 0
    gone = db.run(f"batch:{toml('sys.exit(3)')}", toy_folder, frames=(0, 20), results=results)
    assert gone.status == "crashed"
    assert "exit code 3" in gone.record.reason
    assert gone.record.run_id != record.run_id
    board = load_board(results)
    assert len(board.final_only) == 1
    assert not board.ranked
    assert board.runs(board.final_only[0])[0].trajectory == "final"


ROWS = {
    "no file": (
        "print('loading'); sys.exit('no licence')",
        "crashed",
        "exit code 1, and wrote no .*'no licence'",
    ),
    "half a file": (
        "write([[row[0], 0] for row in rows[:3]]); print('lost')",
        "lost",
        "tracked on 3 of 12.*'lost'",
    ),
    "never ends": (
        "print('frame 3', flush=True); time.sleep(60)",
        "timeout",
        "not done within 2 s.*'frame 3'",
    ),
}


@pytest.mark.parametrize("code, status, words", ROWS.values(), ids=ROWS)
def test_each_way_to_fail_is_a_row_with_the_program_s_last_words(
    toml, toy_folder, tmp_path, code, status, words
):
    run = db.run(
        f"batch:{toml(code)}",
        toy_folder,
        frames=(0, 12),
        settings={"timeout_s": 2},
        results=tmp_path / "r",
    )
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
    for scene in (CornerSequence(2), TurningSequence()):
        truth = scene.ground_truth
        poses = se3.inverse(truth.T_world_cam) if inverted else truth.T_world_cam
        write_tum(tmp_path / f"{scene.camera.width}.txt", Trajectory(truth.timestamps, poses))
    report = tracker_report(f"batch:{path}", frames=2)
    statuses = {check.name: check.status for check in report.checks}
    assert [check.name for check in report.failed] == ["camera to world"] * inverted, report.checks
    assert statuses["results"] == statuses["final trajectory"] == statuses["two resets"] == "passed"
    assert statuses["one frame"] == "skipped"


@pytest.mark.parametrize("file", sorted(EXAMPLES.glob("*.toml")), ids=lambda file: file.stem)
def test_the_examples_describe_programs(file):
    spec = TRACKERS.get(f"batch:{file}")
    document = read_batch(file)
    program = document.program
    names = (*BATCH_NAMES, *CAMERA_NAMES, "threads")
    words = document.filled(spec.settings(), dict.fromkeys(names, "/x")).words
    assert not any(re.search(r"\{\w+\}", word) for word in words)
    scripts = [word for word in words if word.endswith(".py") and Path(word).is_absolute()]
    assert all(Path(script).is_file() for script in scripts)
    assert program.license


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
    assert camera.matrix == pytest.approx(sequence.camera.matrix)
    assert camera.width == sequence.camera.width


@pytest.mark.skipif(
    importlib.util.find_spec("pyorbslam3") is None, reason="pyorbslam3 is not installed"
)
@pytest.mark.skipif(
    not (PACKED.is_file() and XYZ.is_dir()),
    reason="no ORB vocabulary or TUM excerpt beside the checkout",
)
def test_orb_slam3_as_a_batch_program(tmp_path, monkeypatch):
    """Its final trajectory is as near to the truth as that of the same system, frame by frame."""
    monkeypatch.setenv("DYNSLAM_BENCH_ORB_VOCABULARY", str(PACKED))
    how = {"frames": (0, 40), "results": tmp_path / "results", "protocol": "tum-rgbd/v1"}
    batch = db.run(f"batch:{EXAMPLES / 'orb_slam3.toml'}", XYZ, **how)
    online = db.run("orbslam3", XYZ, **how)
    assert batch.status == online.status == "ok"
    assert batch.record.coverage == 1.0
    final = online.store.score(online.record, "tum-rgbd/v1").final.metrics["ate_rmse_m"]
    assert batch.metrics["ate_rmse_m"] == pytest.approx(final, rel=0.5)
    assert final < 0.03
    assert batch.record.peak_memory_mb > 100


@pytest.mark.skipif(
    importlib.util.find_spec("open3d") is None,
    reason="open3d is not installed (its wheel has 400 MB)",
)
@pytest.mark.skipif(not XYZ.is_dir(), reason="no TUM excerpt beside the checkout")
def test_open3d_as_a_batch_program(tmp_path):
    run = db.run(f"batch:{EXAMPLES / 'open3d.toml'}", XYZ, frames=(0, 20), results=tmp_path)
    assert run.status == "ok"
    assert run.record.coverage == 1.0
    assert run.metrics["ate_rmse_m"] < 0.5 * run.metrics["static_camera_ate_rmse_m"]


INSTALLED = importlib.util.find_spec("svo_cpp") is not None
needs_svo = pytest.mark.skipif(not INSTALLED, reason="svo-cpp is not installed")


@pytest.mark.skipif(INSTALLED, reason="svo-cpp is installed")
def test_without_its_package_one_line_says_how_to_get_it():
    with pytest.raises(DynslamError, match="pip install --no-deps svo-cpp"):
        build_tracker("svo")


@needs_svo
@needs_data
def test_on_real_frames(tmp_path):
    run = db.run("svo", XYZ, results=tmp_path, protocol="tum-rgbd/v1-sim3")
    assert run.status == "ok"
    assert run.record.coverage > 0.5
    assert run.metrics["ate_rmse_m"] < 0.4 * run.metrics["static_camera_ate_rmse_m"]
    assert run.metrics["rpe_1f_rot_rmse_deg"] < 3


@needs_svo
@needs_data
def test_as_a_batch_program(tmp_path):
    run = db.run(
        f"batch:{EXAMPLES / 'svo.toml'}", XYZ, results=tmp_path, protocol="tum-rgbd/v1-sim3"
    )
    assert run.status == "ok"
    assert run.record.coverage > 0.5
    assert run.record.tracker.sensors == "rgb"


@needs_svo
@needs_data
def test_settings_reach_it():
    """With a smaller disparity the map begins earlier."""
    sequence = open_sequence(XYZ, frames=(0, 12))
    begun = []
    for disparity in (50, 10):
        tracker = build_tracker("svo", {"init_disparity_px": disparity})
        tracker.reset(sequence.camera, rng=np.random.default_rng(0))
        states = [tracker.track(sequence[index]).state for index in range(len(sequence))]
        tracker.close()
        begun.append(states.index("ok"))
    assert begun[1] < begun[0]
