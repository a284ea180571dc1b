"""What a tracker says after a gap: the right pose, that it is lost, or, worst, a wrong pose as `ok`.

    python tests/benchmarks/backend_gaps.py [--tracker orb-slam2] [--gaps 18 30 36] [--wrong 0.06]

Three consecutive frames start a map, then so many frames are missing, then three come again. A case is wrong if one of
these is `ok` but its camera centre, relative to the third frame's, is farther than `--wrong` metres from the true one.
Sequences: the sitting twins (300 frames) and, where ../shared/data has them, the two TUM excerpts.
"""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path

for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ.setdefault(name, "1")
ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

import cv2  # noqa: E402
import numpy as np  # noqa: E402

from dynslam_bench.contracts.sequence import Sequence  # noqa: E402
from dynslam_bench.sequences.catalogue import open_sequence  # noqa: E402
from dynslam_bench.trackers import TrackerContext, build_tracker  # noqa: E402

TWINS = [f"synthetic/sitting_{motion}" for motion in ("xyz", "static", "halfsphere", "rpy")]
EXCERPTS = [ROOT.parent / "shared/data/tum" / f"rgbd_dataset_freiburg1_{motion}" for motion in ("xyz", "rpy")]


def after_gap(tracker_id: str, sequence: Sequence, first: int, gap: int) -> tuple[float, bool]:
    """The largest error in metres of the frames after the gap that are `ok`, and whether one was lost."""
    assert sequence.ground_truth is not None
    stamps, truth = sequence.ground_truth.timestamps, sequence.ground_truth.T_world_cam
    tracker = build_tracker(tracker_id, {}, TrackerContext(sequence_id=sequence.id, masks=sequence.masks))
    tracker.reset(sequence.camera, rng=np.random.default_rng(0))
    for index in range(first, first + 3):
        before = tracker.track(sequence[index]).T_world_cam
    start = truth[np.abs(stamps - sequence.timestamps[first + 2]).argmin()]
    worst, lost = 0.0, False
    for index in range(first + 2 + gap, first + 5 + gap):
        result = tracker.track(sequence[index])
        if result.state != "ok":
            lost = True
            continue
        true = np.linalg.inv(start) @ truth[np.abs(stamps - sequence.timestamps[index]).argmin()]
        found = np.linalg.inv(before) @ result.T_world_cam
        worst = max(worst, float(np.linalg.norm(found[:3, 3] - true[:3, 3])))
    return worst, lost


def main() -> int:
    """Print one line a sequence and the totals."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tracker", default="orb-slam2")
    parser.add_argument("--gaps", type=int, nargs="+", default=[18, 30, 36])
    parser.add_argument("--wrong", type=float, default=0.06)
    options = parser.parse_args()
    cv2.setNumThreads(1)
    totals = np.zeros(3, int)
    for source in [*TWINS, *(str(path) for path in EXCERPTS if path.is_dir())]:
        sequence = open_sequence(source, frames=(0, 300) if source in TWINS else None)
        counts = np.zeros(3, int)
        for gap in options.gaps:
            room = len(sequence) - gap - 5
            for first in range(5, room, max(23, room // 7)):
                worst, lost = after_gap(options.tracker, sequence, first, gap)
                counts += (1, worst > options.wrong, lost)
        sys.stdout.write(f"{sequence.id}: {counts[0]} cases, {counts[1]} wrong, {counts[2]} said lost\n")
        sys.stdout.flush()
        totals += counts
    sys.stdout.write(f"all: {totals[0]} cases, {totals[1]} wrong, {totals[2]} said lost\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
