"""Relocalisation with many keyframes: time of a frame and recall, all keyframes matched against the few most alike.

    python tests/benchmarks/relocalisation.py [--keyframes 600] [--searched 3 10 100000] [--sequence ID_OR_FOLDER]

Every frame but each fifth becomes a keyframe; of the others, `--queries` are pnp_poses without any prediction. Without
`--sequence` the frames are those of a simulated room with known features, in which the camera looks about; with one,
they are its own. A frame is found if its pose has the inliers that tracking after a loss needs, and right if it is
within 5 cm of the pose that tracking through the frame would give (the truth in the simulated room).
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
sys.path[:0] = [str(ROOT), str(ROOT / "tests/benchmarks"), str(ROOT / "tests/slam")]

import backend_accuracy  # noqa: E402
import cv2  # noqa: E402
import numpy as np  # noqa: E402
from point_world import PointWorld  # noqa: E402

from dynslam_bench.core.settings import apply_overrides  # noqa: E402
from dynslam_bench.features.registry import build_extractor  # noqa: E402
from dynslam_bench.geometry import se3  # noqa: E402
from dynslam_bench.sequences.catalogue import open_sequence  # noqa: E402
from dynslam_bench.slam.backend import RgbdBackend  # noqa: E402
from dynslam_bench.slam.observation import observe  # noqa: E402
from dynslam_bench.slam.place_recognition import (
    pnp_poses,
    top_candidates,
)
from dynslam_bench.slam.settings import BackendSettings  # noqa: E402

DENSE = {
    "keyframes.tracked_share": 1.0,
    "keyframes.established": 1,
    "keyframes.redundant_share": 1.0,
    "keyframes.maximum": 100000,
    "bundle_adjustment.enabled": False,
}
RIGHT_M = 0.05


def room_frames(count: int):
    """Frames of a simulated room, and the true poses ``[N, 4, 4]`` relative to the first."""
    room = PointWorld()
    t = np.arange(count) / 30.0
    position = np.stack([0.6 * np.sin(0.37 * t), 0.2 * np.sin(0.9 * t), 0.5 * np.sin(0.53 * t)], axis=1)
    turn = np.stack([0.3 * np.sin(0.41 * t), 0.9 * np.sin(0.6 * t), np.zeros(count)], axis=1)
    poses = se3.exp(np.hstack([position, np.zeros((count, 3))])) @ se3.exp(np.hstack([np.zeros((count, 3)), turn]))
    return room.camera, [room.see(pose, i) for i, pose in enumerate(poses)], se3.inverse(poses[0]) @ poses


def sequence_frames(name: str):
    """Frames of a sequence; the poses are those that tracking gives, filled in later."""
    sequence, extractor = open_sequence(name), build_extractor()
    return sequence.camera, [backend_accuracy.bundle(frame, sequence.camera, extractor) for frame in sequence], None


def main() -> int:
    """Print one row for each number of keyframes that is matched."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--keyframes", type=int, default=600)
    parser.add_argument("--searched", type=int, nargs="+", default=[3, 10, 100000])
    parser.add_argument("--queries", type=int, default=30)
    parser.add_argument("--sequence", default="")
    options = parser.parse_args()
    cv2.setNumThreads(1)
    settings = apply_overrides(BackendSettings(), DENSE)
    camera, frames, truth = (
        sequence_frames(options.sequence) if options.sequence else room_frames(options.keyframes * 5 // 4 + 5)
    )
    mapped, through = RgbdBackend(settings), RgbdBackend(settings)
    mapped.reset(camera, 0)
    through.reset(camera, 0)
    poses, queries = [], []
    for index, frame in enumerate(frames):
        keep = np.ones(len(frame), bool), np.ones(len(frame), np.float32)
        if truth is None:
            poses.append(through.track(frame, *keep).T_world_cam)
        if index % 5 == 2:
            queries.append(index)
        elif mapped.track(frame, *keep).state != "ok":
            sys.stdout.write(f"frame {index} is lost while mapping\n")
    true = np.array(poses) if truth is None else truth
    queries = [queries[i] for i in np.linspace(0, len(queries) - 1, min(options.queries, len(queries))).astype(int)]
    world = mapped.world
    sys.stdout.write(f"{world.keyframe_count} keyframes, {len(queries)} queries\n")
    sys.stdout.write(
        "| matched | found | right | cpu ms a frame: median | largest |\n| --- | --- | --- | --- | --- |\n"
    )
    for searched in options.searched:
        found, right, times = 0, 0, []
        for index in [queries[0], *queries]:  # the first compiles
            seen = observe(frames[index], np.ones(len(frames[index]), bool), np.ones(len(frames[index]), np.float32),
                           mapped.camera, mapped._scales, settings.tracking)  # fmt: skip
            start = time.process_time()
            chosen = top_candidates(world, world.keyframes, seen, searched)
            rng = np.random.default_rng(index)
            least = settings.relocalisation.min_inliers
            pose = next(pnp_poses(world, chosen, seen, settings.relocalisation, rng, least), None)
            times.append(time.process_time() - start)
            if pose is None or pose.estimate.count < settings.relocalisation.min_inliers or len(times) == 1:
                continue
            found += 1
            off = se3.inverse(true[index]) @ se3.inverse(pose.estimate.T_cam_world)
            right += bool(np.linalg.norm(off[:3, 3]) < RIGHT_M)
        ms = 1e3 * np.array(times[1:])
        sys.stdout.write(
            f"| {min(searched, world.keyframe_count)} | {found}/{len(queries)} | {right}/{len(queries)} "
            f"| {np.median(ms):.0f} | {ms.max():.0f} |\n"
        )
        sys.stdout.flush()
    return 0


if __name__ == "__main__":
    sys.exit(main())
