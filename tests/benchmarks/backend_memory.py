"""Resident memory, keyframes and points of the back end on a loop through a simulated room.

    python tests/benchmarks/backend_memory.py [--frames 10000] [--loop 300]

Bar: less than 1 MB of growth a 1,000 frames after frame 2,000.
"""

from __future__ import annotations

import argparse
import importlib.util
import os
import sys
import time
from pathlib import Path

for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ.setdefault(name, "1")
ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

import numpy as np  # noqa: E402

from dynslam_bench.geometry import se3  # noqa: E402
from dynslam_bench.slam.backend import RgbdBackend  # noqa: E402


def resident_mb() -> float:
    """Resident memory of this process in MB (Linux)."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def main() -> int:
    """Print memory every 500 frames and the growth after frame 2,000."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=10000)
    parser.add_argument("--loop", type=int, default=300)
    options = parser.parse_args()
    spec = importlib.util.spec_from_file_location("slam_conftest", ROOT / "tests/slam/conftest.py")
    assert spec is not None and spec.loader is not None
    simulated = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(simulated)
    room = simulated.PointWorld(count=6000)
    backend = RgbdBackend()
    backend.reset(room.camera, 0)
    angle = 2 * np.pi * np.arange(options.loop) / options.loop
    zero = np.zeros_like(angle)
    turn = se3.exp(np.stack([zero, zero, zero, 0.1 * np.sin(2 * angle), 0.9 * np.sin(angle), zero], axis=1))
    shift = se3.exp(
        np.stack([0.5 * np.sin(angle), 0.2 * np.sin(2 * angle), 0.3 * np.cos(angle), zero, zero, zero], axis=1)
    )
    loop = shift @ turn
    marks: list[tuple[int, float]] = []
    lost, spent = 0, 0.0
    for i in range(options.frames):
        frame = room.see(loop[i % options.loop], i)
        begin = time.process_time()
        result = backend.track(frame, np.ones(len(frame), bool), np.ones(len(frame), np.float32), None)
        spent += time.process_time() - begin
        lost += result.state != "ok"
        if (i + 1) % 500 == 0:
            marks.append((i + 1, resident_mb()))
            print(
                f"frame {i + 1}: {marks[-1][1]:.1f} MB, {result.stats['keyframes']:.0f} keyframes, "
                f"{result.stats['map_points']:.0f} points, {lost} lost, {1e3 * spent / (i + 1):.1f} ms cpu a frame",
                flush=True,
            )
    late = [(frame, memory) for frame, memory in marks if frame >= 2000]
    if len(late) > 1:
        growth = (late[-1][1] - late[0][1]) / (late[-1][0] - late[0][0]) * 1000
        print(f"growth after frame 2,000: {growth:.2f} MB a 1,000 frames (bar: < 1)")
    return 0


if __name__ == "__main__":
    sys.exit(main())
