"""Small programs that speak the protocol, and what tests of them share."""

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
