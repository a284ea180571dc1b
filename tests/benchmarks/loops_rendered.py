"""Loops on rendered sequences: the same frames without and with loop closing.

    python tests/benchmarks/loops_rendered.py [--sequences "synthetic/loop_room?frames=1800"] [--stride 2]

Frames are rendered, their ORB features kept, nothing else. Prints for each back end: frames that count as tracked and
RMSE of their positions after the best rigid alignment, online and final (with `full`: all of the map refined at the
end), and every loop with the true distance between its two ends.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from pathlib import Path

for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ.setdefault(name, "1")
ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

import cv2  # noqa: E402
import numpy as np  # noqa: E402

from dynslam_bench.contracts.filter import FrameBundle  # noqa: E402
from dynslam_bench.core.settings import apply_overrides  # noqa: E402
from dynslam_bench.evaluation.alignment import align  # noqa: E402
from dynslam_bench.features.build_extractor import build_extractor  # noqa: E402
from dynslam_bench.features.settings import FeatureSettings  # noqa: E402
from dynslam_bench.sequences import open_sequence  # noqa: E402
from dynslam_bench.sequences.synthetic.sequence import SyntheticSequence  # noqa: E402
from dynslam_bench.slam.backend import RgbdBackend  # noqa: E402
from dynslam_bench.slam.settings import BackendSettings  # noqa: E402

SETTINGS = {
    "off": {},
    "on": {"loop_closing.enabled": True},
    "on, full": {"loop_closing.enabled": True, "bundle_adjustment.full": True},
}


def features_of(source: str, stride: int) -> tuple[SyntheticSequence, list[FrameBundle]]:
    """The sequence, and every `stride`-th of its frames without pixels."""
    found = open_sequence(source)
    assert isinstance(found, SyntheticSequence), "rendered sequences alone"
    sequence = SyntheticSequence(found._id, None, found.settings, 1)  # private: the same sequence without a cache
    camera, extractor, frames = sequence.camera, build_extractor(FeatureSettings()), []
    blank = np.zeros((camera.height, camera.width, 3), np.uint8)
    for number, index in enumerate(range(0, len(sequence), stride)):
        frame = sequence[index]
        keypoints = extractor.extract(cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2GRAY))
        column, row = np.rint(keypoints.xy).astype(int).T
        z = frame.depth[row.clip(0, camera.height - 1), column.clip(0, camera.width - 1)].clip(min=0)
        unseen = blank, blank[..., 0], np.zeros(blank.shape[:2], np.float32)
        frames.append(FrameBundle(number, frame.timestamp, *unseen, keypoints, keypoints.xy.astype(np.float64), z))
    return sequence, frames


def rmse(positions: np.ndarray, true: np.ndarray) -> float:
    """Metres, after the best rigid alignment."""
    estimate, truth = np.tile(np.eye(4), (len(true), 1, 1)), np.tile(np.eye(4), (len(true), 1, 1))
    estimate[:, :3, 3], truth[:, :3, 3] = positions, true
    moved = align(estimate, truth, "se3").apply(estimate)[:, :3, 3]
    return float(np.sqrt(np.square(moved - true).sum(axis=1).mean()))


def drive(sequence: SyntheticSequence, frames: list[FrameBundle], settings: BackendSettings) -> str:
    """One run, in words."""
    backend = RgbdBackend(settings)
    backend.reset(sequence.camera, 0)
    truth = sequence.ground_truth
    true = truth.T_world_cam[np.searchsorted(truth.timestamps, [frame.timestamp - 1e-6 for frame in frames])][:, :3, 3]
    online, spent, loops = np.full((len(frames), 3), np.nan), 0.0, []
    for number, frame in enumerate(frames):
        begin = time.process_time()
        found = backend.track(frame, np.ones(len(frame), bool), np.ones(len(frame), np.float32))
        spent += time.process_time() - begin
        if found.state == "ok" and found.T_world_cam is not None:
            online[number] = found.T_world_cam[:3, 3]
        for loop in backend.loops.closed[len(loops) :]:
            apart = np.linalg.norm(true[number] - true[loop.frame])
            kind = "join" if loop.joins else "loop"
            loops.append(f"{kind} {number} -> {loop.frame}, {loop.inliers} points, {apart:.2f} m apart")
    tracked = np.isfinite(online[:, 0])
    final = backend.finalize()
    at = np.searchsorted([frame.timestamp for frame in frames], final.timestamps - 1e-6)
    return (
        f"online {rmse(online[tracked], true[tracked]):.3f} m on {tracked.sum()}, "
        f"final {rmse(final.positions, true[at]):.3f} m on {len(at)} of {len(frames)} frames, "
        f"{1e3 * spent / len(frames):.0f} ms a frame, {'; '.join(loops) or 'no loop'}"
    )


def main() -> None:
    """Each sequence, with each setting."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sequences", nargs="+", default=["synthetic/loop_room?frames=1800"])
    parser.add_argument("--stride", type=int, default=2)
    parser.add_argument("--settings", nargs="+", choices=sorted(SETTINGS), default=list(SETTINGS))
    options = parser.parse_args()
    cv2.setNumThreads(1)
    for source in options.sequences:
        sequence, frames = features_of(source, options.stride)
        for name in options.settings:
            settings = apply_overrides(BackendSettings(), SETTINGS[name])
            print(f"{source}, closing {name}: {drive(sequence, frames, settings)}", flush=True)


if __name__ == "__main__":
    main()
