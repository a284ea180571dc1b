"""Loop closing in simulation: a ring of corridors driven once and a little more, with and without it.

    python tests/benchmarks/loop_closing.py [--side 9 14] [--alike]

Prints the error of the last online position, the RMSE of the final trajectory (frame of the first camera, no
alignment), the loops, and processor milliseconds a frame.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "tests" / "slam")]

from ring_world import RingWorld  # noqa: E402

from dynslam_bench.geometry import se3  # noqa: E402
from dynslam_bench.slam.backend import RgbdBackend  # noqa: E402
from dynslam_bench.slam.settings import BackendSettings, LoopClosingSettings  # noqa: E402

STEP_M = 0.15
MORE = 15
"""Frames after the lap."""


def drive(world: RingWorld, frames: int, *, closing: bool) -> str:
    """One drive, in words."""
    backend = RgbdBackend(BackendSettings(loop_closing=LoopClosingSettings(enabled=closing)))
    backend.reset(world.camera, 0)
    poses = world.lap(frames, STEP_M)
    true = se3.transform(se3.inverse(poses[0]), poses[:, :3, 3])
    spent, online = 0.0, np.zeros((frames, 3))
    for index, pose in enumerate(poses):
        frame = world.see(pose, index, noise_px=1.2, depth_noise=0.01, limit=500)
        begin = time.process_time()
        found = backend.track(frame, np.ones(len(frame), bool), np.ones(len(frame), np.float32))
        spent += time.process_time() - begin
        assert found.state == "ok" and found.T_world_cam is not None
        online[index] = found.T_world_cam[:3, 3]
    final = backend.finalize().positions
    end = np.linalg.norm(online[-1] - true[-1])
    rmse = np.sqrt(np.square(final - true).sum(axis=1).mean())
    loops = ", ".join(
        f"to frame {loop.frame}: {loop.inliers} points, {loop.moved_m:.3f} m" for loop in backend.loops.closed
    )
    return (
        f"loop closing {'on' if closing else 'off'}: last {end:.3f} m, final {rmse:.3f} m RMSE, "
        f"{1e3 * spent / frames:.1f} ms a frame, {backend.world.keyframe_count} keyframes, loops: {loops or 'none'}"
    )


def main() -> None:
    """Drive each ring twice."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--side", type=float, nargs="+", default=[9.0, 14.0], help="metres")
    parser.add_argument("--alike", action="store_true", help="half of the points the same in all corridors")
    options = parser.parse_args()
    for side in options.side:
        world = RingWorld(side, alike=0.5 if options.alike else 0.0)
        way = 4 * (side - 2) + 2 * np.pi
        print(f"{way:.1f} m a lap, {len(world.walls)} points", flush=True)
        for closing in (False, True):
            print(drive(world, int(way / STEP_M) + MORE, closing=closing), flush=True)


if __name__ == "__main__":
    main()
