"""Resident memory, keyframes and points of `orb-slam2` on a rendered room, walked to and fro.

    python tests/benchmarks/backend_memory.py [--sequence synthetic/sitting_xyz] [--frames 10000] [--loop 300]

The whole tracker runs: features, tracking, mapping, culling of keyframes and points. The sequence's first `loop` frames
are held in memory and played forwards and backwards in turn, so that nothing but the tracker grows.

Bar: less than 1 MB of growth a 1,000 frames after frame 2,000.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from dataclasses import replace
from pathlib import Path

for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ.setdefault(name, "1")
ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

import cv2  # noqa: E402
import numpy as np  # noqa: E402

from dynslam_bench.sequences.catalogue import open_sequence  # noqa: E402
from dynslam_bench.trackers import TrackerContext, build_tracker  # noqa: E402


def resident_mb() -> float:
    """Resident memory of this process in MB (Linux)."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def main() -> int:
    """Print memory every 500 frames and the growth after frame 2,000."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sequence", default="synthetic/sitting_xyz")
    parser.add_argument("--frames", type=int, default=10000)
    parser.add_argument("--loop", type=int, default=300)
    options = parser.parse_args()
    cv2.setNumThreads(1)
    sequence = open_sequence(options.sequence, frames=(0, options.loop))
    loop = [sequence[i] for i in range(len(sequence))]
    loop += loop[-2:0:-1]
    tracker = build_tracker("orb-slam2", {}, TrackerContext(sequence_id=sequence.id, masks=sequence.masks))
    tracker.reset(sequence.camera, rng=np.random.default_rng(0))
    marks: list[tuple[int, float]] = []
    lost, begin = 0, time.process_time()
    for i in range(options.frames):
        result = tracker.track(replace(loop[i % len(loop)], index=i, timestamp=i / 30))
        lost += result.state != "ok"
        if i % 500 == 499:
            marks.append((i + 1, resident_mb()))
            sys.stdout.write(
                f"frame {i + 1:6d}  {marks[-1][1]:7.1f} MB  {result.stats['keyframes']:4.0f} keyframes  "
                f"{result.stats['map_points']:6.0f} points  {lost} lost  "
                f"{1e3 * (time.process_time() - begin) / (i + 1):.1f} ms a frame\n"
            )
            sys.stdout.flush()
    late = np.array([mark for mark in marks if mark[0] >= 2000])
    if len(late) > 1:
        slope = np.polyfit(late[:, 0], late[:, 1], 1)[0]
        sys.stdout.write(f"growth after frame 2,000: {1e3 * slope:.2f} MB a 1,000 frames (bar 1)\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
