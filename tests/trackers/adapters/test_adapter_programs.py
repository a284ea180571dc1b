"""Programs over JSON lines: what is exchanged."""

import json
import resource
import shutil
import subprocess
import tempfile
import time
from pathlib import Path

import cv2
import numpy as np
import pytest
from adapter_programs import GOOD, frame, gone, reset

from dynslam_bench.core.errors import InfrastructureError, SettingsError, TrackerError
from dynslam_bench.envs.slam_env import SlamEnv
from dynslam_bench.geometry.camera import Camera
from dynslam_bench.testing import check_tracker
from dynslam_bench.trackers import TrackerContext, build_tracker
from dynslam_bench.trackers.adapters import subprocess_tracker as exchange
from dynslam_bench.trackers.adapters.specs import SubprocessSettings


def test_a_program_keeps_the_contract(program):
    made = program(GOOD)
    check_tracker(lambda: made)


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
    camera = request["camera"]
    assert (camera["width"], camera["height"], camera["fx"], camera["fy"]) == (64, 48, 60.0, 61.0)
    assert camera["distortion"] == [0.1, -0.2, 0.001, 0.002, 0.3] and camera["baseline_m"] == 0.08
    assert camera["fps"] == 25.0 and request["threads"] == 3 and request["device"] == "cuda:1"
    assert request["sequence"] == "tum/fr1/xyz" and threads == "3"
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
        assert result.stats["index"] == index and result.stats["timestamp"] == sent.timestamp
        assert list(result.timings) == ["tracking", "transfer"] and result.timings["transfer"] >= 0


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
        assert depth.dtype == np.uint16 and np.array_equal(depth, np.rint(sent.depth * result.stats["factor"]))
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
    assert final.timestamps.tolist() == [1.5, 1.6]
    assert final.positions.tolist() == [[1, 2, 3], [0, 0, 0]]
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
    for request in requests:
        say(next(answers))
    """
    tracker = reset(program(text))
    results = [tracker.track(frame(index)) for index in range(3)]
    assert [result.state for result in results] == ["initialising", "lost", "lost"]
    assert results[0].T_world_cam is None and results[2].T_world_cam is not None


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
    assert pids[0] != pids[1] and all(gone(pid) for pid in pids)
    with pytest.raises(TrackerError, match="before reset"):
        tracker.track(frame(2))


# The example in C++: compiled with the system's compiler, run as anybody would.


SOURCE = Path(__file__).resolve().parents[3] / "examples" / "cpp" / "direct_odometry.cpp"
COMPILER = shutil.which("c++") or shutil.which("g++") or shutil.which("clang++")


@pytest.mark.skipif(COMPILER is None, reason="there is no C++ compiler here")
def test_a_tracker_in_one_cpp_file_follows_the_camera(tmp_path: Path) -> None:
    program = tmp_path / "direct_odometry"
    assert COMPILER is not None
    command = [COMPILER, "-O2", "-Wall", "-Wextra", "-Werror", "-o", str(program), str(SOURCE)]
    subprocess.run(command, check=True, capture_output=True)
    env = SlamEnv("synthetic/sitting_xyz?scene=100", f"subprocess:{program}", frames=(0, 12))
    env.reset(seed=0)
    info: dict = {}
    for _ in range(11):
        *_, info = env.step(0)
    outcomes = env.episode.outcomes
    assert [each.state for each in outcomes] == ["ok"] * 12
    assert all(set(each.timings) >= {"odometry", "transfer"} for each in outcomes[1:])
    metrics = info["episode_metrics"]
    env.close()
    assert metrics["ate_rmse_m"] < 0.3 * metrics["static_camera_ate_rmse_m"]


# Every way in which a program over JSON lines can fail, and how it is ended.


FAULTS = {
    "raises": ("raise ValueError('no such camera')", "exit code 1; its last line: 'ValueError: no such camera'"),
    "exits": (
        "sys.stderr.write('cannot open\\nconfig.yaml\\n'); sys.exit(3)",
        "exit code 3; its last line: 'config.yaml'",
    ),
    "silent exit": ("os._exit(0)", "exit code 0; it wrote no message"),
    "segfault": ("os.kill(os.getpid(), 11)", "killed by signal 11 "),
    "no json": ("print('{pose: 1}', flush=True)", "is no valid JSON"),
    "error": ("say({'error': 'out of\\nmemory'})", "at frame 7: out of memory"),
    "no pose": ("say({'state': 'ok'})", "'ok' without T_world_cam"),
    "state": ("say({'state': 'fine', 'T_world_cam': STILL})", "known: initialising, ok, lost"),
    "shape": ("say({'state': 'ok', 'T_world_cam': STILL[:12]})", "not 16 numbers"),
    "text": ("say({'state': 'ok', 'T_world_cam': 'identity'})", "not 16 numbers"),
    "not rigid": ("say({'state': 'ok', 'T_world_cam': [2 * v for v in STILL]})", "no rigid pose"),
    "nan": ("say({'state': 'ok', 'T_world_cam': [float('nan')] * 16})", "no rigid pose"),
    "stats": ("say({'state': 'ok', 'T_world_cam': STILL, 'stats': {'a': 'b'}})", "stats is not"),
    "hangs": (
        "sys.stderr.write('optimising\\n'); sys.stderr.flush(); time.sleep(60)",
        "no answer within 0.5 s.*'optimising'",
    ),
    "of another frame": ("index['index'] = 6; say({'state': 'ok', 'T_world_cam': STILL})", "answered index 6"),
    "of no frame": ("index.clear(); say({'state': 'ok', 'T_world_cam': STILL})", "answered index None"),
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
    assert "\n" not in str(caught.value) and "at frame 7" in str(caught.value)
    tracker.close()
    assert gone(pid)
    reset(tracker)
    assert tracker.track(frame(0)).state == "ok", "a reset starts the program again"


def test_a_second_answer_is_never_taken_for_the_next_frame(program):
    """However late it comes, it is seen before the next pose is believed."""
    for pause in ("", "time.sleep(0.2);"):
        tracker = reset(
            program(f"""
            for request in requests:
                say({{"state": "ok", "T_world_cam": STILL}})
                if request["op"] == "track":
                    {pause} say({{"state": "ok", "T_world_cam": STILL}})
            """)
        )
        with pytest.raises(TrackerError, match="answered index 0"):
            for index in range(3):
                tracker.track(frame(index))
        tracker.close()


def test_refusals_at_reset(program):
    with pytest.raises(TrackerError, match="at reset: fisheye cameras only"):
        reset(program("next(requests); say({'error': 'fisheye cameras only'}); time.sleep(60)", close_timeout_s=0.1))


def test_faults_at_finalize(program):
    for answer, expected in (
        ("{'trajectory': [[1, 2]]}", "rows of 8"),
        ("{}", "rows of 8"),
        ("{'trajectory': [[1, 0, 0, 0, 0, 0, 0, 0]]}", "norm 0"),
        ("{'trajectory': [[2, 0, 0, 0, 0, 0, 0, 1], [1, 0, 0, 0, 0, 0, 0, 1]]}", "strictly increasing"),
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
    with pytest.raises(TrackerError, match=r"exit code 3; its last line: 'FATAL: no such camera model'"):
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
    assert time.monotonic() - start < 5
    assert gone(int(stats["pid"])) and gone(int(stats["child"]))


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
        stats = tracker.track(sent).stats
        assert stats == {"sum": float(sent.rgb.sum()), "known": float((sent.depth > 0).sum())}
    with pytest.raises(TrackerError, match="at frame 2: RuntimeError: no features"):
        tracker.track(frame(2))
    assert tracker.track(frame(3)).state == "ok", "an answered error does not end the program"
    assert len(tracker.finalize()) == 1


def test_a_program_in_the_present_folder_is_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    program = tmp_path / "odometry"
    program.write_text("#!/bin/sh\nexit 0\n")
    program.chmod(0o755)
    monkeypatch.chdir(tmp_path)
    SubprocessSettings(command="./odometry").verify()
    with pytest.raises(SettingsError, match="cannot start 'odometry'"):
        SubprocessSettings(command="odometry").verify()  # as in a shell: by its path, or on PATH


def test_room_for_a_frame_is_taken_first_elsewhere_if_need_be(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    camera = Camera(640, 480, 500.0, 500.0, 320.0, 240.0)
    monkeypatch.setattr(exchange, "SHARED_MEMORY", tmp_path / "missing")
    beside = exchange.ImageExchange(camera, "raw")
    file = beside.folder / exchange.FRAME_FILE
    assert file.is_relative_to(tmp_path) and file.stat().st_blocks * 512 >= 640 * 480 * 7, "not a file of holes"
    beside.close()
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1_000_000, hard))  # as if the disk were full
    try:
        with pytest.raises(InfrastructureError, match=r"no room for a frame of 2.2 MB: .*free some space"):
            exchange.ImageExchange(camera, "raw")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert [path for path in tmp_path.rglob("*") if path.is_file()] == [], "nothing is left of it"
