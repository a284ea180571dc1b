"""Loops on rendered sequences: the same frames without and with loop closing.

    python tests/benchmarks/loops_rendered.py [--sequences 'synthetic/loop_corridor?scene=3'] [--stride 2] [--rivals 5]

Frames are rendered, their ORB features kept, nothing else. Prints for each back end: frames that count as tracked and
RMSE of their positions after the best rigid alignment, online and final (with `full`: all of the map refined at the
end, which takes minutes in a large one), and every loop with the true distance between its two ends. `--rivals`
gives each frame to so many ORB-SLAM3s, with depth, while it is there (docs/orbslam3.md). With `--without-depth` the
monocular back end drives, and the alignment has a scale.
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
from synthetic_difficulty import SideBySide, error, trajectory  # noqa: E402

from dynslam_bench.contracts.filter import FrameBundle  # noqa: E402
from dynslam_bench.core.settings import apply_overrides  # noqa: E402
from dynslam_bench.evaluation.alignment import align  # noqa: E402
from dynslam_bench.features.registry import build_extractor  # noqa: E402
from dynslam_bench.features.settings import FeatureSettings  # noqa: E402
from dynslam_bench.geometry.trajectory import Trajectory  # noqa: E402
from dynslam_bench.sequences import open_sequence  # noqa: E402
from dynslam_bench.sequences.synthetic.sequence import SyntheticSequence  # noqa: E402
from dynslam_bench.slam.backend import build_backend  # noqa: E402
from dynslam_bench.slam.settings import BackendSettings, MonocularBackendSettings  # noqa: E402

SETTINGS = {
    "off": {},
    "on": {"loop_closing.enabled": True},
    "on, full": {"loop_closing.enabled": True, "bundle_adjustment.full": True},
}


def features_of(source: str, stride: int, rivals: int) -> tuple[SyntheticSequence, list[FrameBundle], SideBySide]:
    """The sequence, every `stride`-th of its frames without pixels, and the rivals, which have seen them."""
    opened = open_sequence(source)
    assert isinstance(opened, SyntheticSequence), "rendered sequences alone"
    sequence = SyntheticSequence(opened._id, None, opened.settings, 1)  # private: the same sequence without a cache
    together = SideBySide(sequence, list(range(rivals)), sequence.fps / stride)
    camera, extractor, frames = sequence.camera, build_extractor(FeatureSettings()), []
    blank = np.zeros((camera.height, camera.width, 3), np.uint8)
    for number, index in enumerate(range(0, len(sequence), stride)):
        frame = sequence[index]
        together.track(frame)
        keypoints = extractor.extract(cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2GRAY))
        column, row = np.rint(keypoints.xy).astype(int).T
        z = frame.depth[row.clip(0, camera.height - 1), column.clip(0, camera.width - 1)].clip(min=0)
        unseen = blank, blank[..., 0], np.zeros(blank.shape[:2], np.float32)
        frames.append(FrameBundle(number, frame.timestamp, *unseen, keypoints, keypoints.xy.astype(np.float64), z))
    return sequence, frames, together


def drive(sequence: SyntheticSequence, frames: list[FrameBundle], backend) -> str:
    """One run as a line of text."""
    backend.reset(sequence.camera, 0)
    truth = sequence.ground_truth
    true = truth.T_world_cam[np.searchsorted(truth.timestamps, [frame.timestamp - 1e-6 for frame in frames])][:, :3, 3]
    online, spent, loops = [], 0.0, []
    for number, frame in enumerate(frames):
        begin = time.process_time()
        result = backend.track(frame, np.ones(len(frame), bool), np.ones(len(frame), np.float32))
        spent += time.process_time() - begin
        if result.state == "ok" and result.T_world_cam is not None:
            online.append((frame.timestamp, result.T_world_cam))
        for loop in backend.loops.closed[len(loops) :]:
            distance = np.linalg.norm(true[number] - true[loop.frame])
            kind = "merge" if loop.merges else "loop"
            scale = "" if backend.uses_depth else f", scale x {loop.scale:.2f}"
            loops.append(f"{kind} {number} -> {loop.frame}, {loop.inliers} points, {distance:.2f} m apart{scale}")
    final = backend.finalize()

    rmse = error if backend.uses_depth else scaled_error
    return (
        f"online {rmse(trajectory(online), truth)} m on {len(online)}, "
        f"final {rmse(final, truth)} m on {len(final)} of {len(frames)} frames, "
        f"{1e3 * spent / len(frames):.0f} ms a frame, {'; '.join(loops) or 'no loop'}"
    )


def scaled_error(estimate: Trajectory, truth: Trajectory) -> float | None:
    """RMSE of positions after the best similarity, metres; None for fewer than three poses."""
    if len(estimate) < 3:
        return None
    true = truth.T_world_cam[np.searchsorted(truth.timestamps, estimate.timestamps - 1e-6)]
    moved = align(estimate.T_world_cam, true, "sim3").apply(estimate.T_world_cam)
    return round(float(np.sqrt(np.square(moved[:, :3, 3] - true[:, :3, 3]).sum(axis=1).mean())), 5)


def main() -> None:
    """Each sequence, with each setting."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sequences", nargs="+", default=["synthetic/loop_corridor?scene=3"])
    parser.add_argument("--stride", type=int, default=2)
    parser.add_argument("--rivals", type=int, default=0, metavar="RUNS")
    parser.add_argument("--settings", nargs="+", choices=sorted(SETTINGS), default=list(SETTINGS))
    parser.add_argument("--without-depth", action="store_true", help="with the monocular back end")
    options = parser.parse_args()
    if options.without_depth and options.rivals:
        parser.error("the rivals get depth; their monocular mode: dynslam-bench run orbslam3-mono SEQUENCE --stride 2")
    cv2.setNumThreads(1)
    for source in options.sequences:
        sequence, frames, together = features_of(source, options.stride, options.rivals)
        if options.without_depth:
            frames = [replace(frame, z=np.zeros_like(frame.z)) for frame in frames]
        for name in options.settings:
            defaults = MonocularBackendSettings() if options.without_depth else BackendSettings()
            features = FeatureSettings()
            backend = build_backend(
                apply_overrides(defaults, SETTINGS[name]), features.scale_factor, features.levels, features.extractor
            )
            print(f"{source}, closing {name}: {drive(sequence, frames, backend)}", flush=True)
        for row in together.results():
            print(f"{source}, ORB-SLAM3: {row}", flush=True)


if __name__ == "__main__":
    main()
