"""Programs over JSON lines: what is exchanged."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from adapter_programs import GOOD, frame, gone, reset

from dynslam_bench.core.errors import TrackerError
from dynslam_bench.testing import check_tracker
from dynslam_bench.trackers import TrackerContext


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
