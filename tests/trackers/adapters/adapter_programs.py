"""Small programs that speak the protocol, and what tests of them share."""

import os
import time
from pathlib import Path

import numpy as np

from dynslam_bench.contracts.sequence import Frame
from dynslam_bench.geometry.camera import Camera

CAMERA = Camera(64, 48, 60.0, 61.0, 31.5, 23.5, distortion=(0.1, -0.2, 0.001, 0.002, 0.3), baseline_m=0.08)

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


def gone(pid):
    """Whether a process has ended (or is a zombie of somebody else's)."""
    for _ in range(100):
        try:
            os.kill(pid, 0)
        except ProcessLookupError:
            return True
        status = Path(f"/proc/{pid}/stat")
        if status.exists() and status.read_text().rsplit(")", 1)[1].split()[0] == "Z":
            return True
        time.sleep(0.02)
    return False
