"""Memory and frame time of the back end where the camera never comes back: a straight corridor without end.

    python tests/benchmarks/backend_territory.py [--frames 10000] [--step 0.04] [--features 1000] [--set KEY=VALUE ...]

Walls, floor and ceiling are points with random descriptors; nothing is rendered. Every 1,000 frames it prints the
map, the resident memory of the process between frames, what of the map lies in files, the processor time of a frame,
and how far off the way over 100 frames is (root mean square, which has what the direction has drifted so far in it); in
the end the growth between the second thousand and the last, and the largest memory at any time. Machines become faster
and slower within minutes: so a second camera drives its second thousand frames in turn with the thousand after
`--frames` of the first one, fifty frames each, and these are compared.

Bars: 1 MB of resident memory a 1,000 frames, frame time at the end at most 1.2 times that after 1,000 frames.
"""

from __future__ import annotations

import argparse
import os
import resource
import sys
import time
from pathlib import Path

for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ.setdefault(name, "1")
ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "tests" / "slam")]

import numpy as np  # noqa: E402
from point_world import PointWorld  # noqa: E402

from dynslam_bench.contracts.filter import FrameBundle  # noqa: E402
from dynslam_bench.core.settings import apply_overrides, parse_assignments  # noqa: E402
from dynslam_bench.slam.backend import RgbdBackend  # noqa: E402
from dynslam_bench.slam.settings import BackendSettings  # noqa: E402

AHEAD_M, POINTS_A_METRE = 10.0, 250
BAR_MB, BAR_SLOWER = 1.0, 1.2
IN_TURN = 50


class Corridor(PointWorld):
    """A corridor along z, 2.4 m wide and high, of which a camera sees the next ten metres."""

    def __init__(self, length_m: float, seed: int = 0) -> None:
        super().__init__(seed, count=10)
        rng = np.random.default_rng(seed)
        count = int(length_m * POINTS_A_METRE)
        across = rng.uniform(-1.2, 1.2, count)
        side, wall = rng.integers(0, 2, count).astype(bool), rng.choice([-1.2, 1.2], count)
        x, y = np.where(side, wall, across), np.where(side, across, wall)
        self.all_points = np.stack([x, y, np.sort(rng.uniform(0, length_m, count))], axis=1)
        self.looks = rng.integers(0, 256, (count, 32), dtype=np.uint8)

    def at(self, z: float, index: int, features: int) -> tuple[FrameBundle, np.ndarray]:
        """The frame of that number, taken so many metres from the beginning, and where exactly."""
        first, last = np.searchsorted(self.all_points[:, 2], [z + 0.3, z + AHEAD_M])
        self.points, self.descriptors = self.all_points[first:last], self.looks[first:last]
        pose = np.eye(4)
        pose[:3, 3] = 0.1 * np.sin(index / 20), 0.05 * np.sin(index / 13), z
        return self.see(pose, index, limit=features), pose[:3, 3]


def resident_mb() -> float:
    """Resident memory of this process in MB (Linux)."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6


class Drive:
    """A camera on its way through the corridor, one frame after the other."""

    def __init__(self, world: Corridor, settings: BackendSettings, step: float, features: int) -> None:
        self.world, self.step, self.features = world, step, features
        self.backend = RgbdBackend(settings)
        self.backend.reset(world.camera, 0)
        self.spent: list[float] = []
        self.memory: list[float] = []
        self.off: list[np.ndarray] = []
        self.lost = 0

    def go(self, frames: int) -> None:
        """Drive so many frames on."""
        for index in range(len(self.spent), len(self.spent) + frames):
            frame, true = self.world.at(index * self.step, index, self.features)
            keep, sure = np.ones(len(frame), bool), np.ones(len(frame), np.float32)
            begin = time.process_time()
            found = self.backend.track(frame, keep, sure)
            self.spent.append(time.process_time() - begin)
            self.memory.append(resident_mb())
            self.lost += found.state != "ok"
            assert found.T_world_cam is not None
            self.off.append(found.T_world_cam[:3, 3] - true)

    def __str__(self) -> str:
        newest, world = slice(-1000, None), self.backend.world
        off = np.array(self.off[newest])
        way_mm = 1e3 * np.linalg.norm(off[100:] - off[:-100], axis=1)
        return (
            f"{len(self.spent)} frames: {world.keyframe_count} keyframes, {world.point_count} points, "
            f"{np.mean(self.memory[newest]):.1f} MB resident, {world.space.bytes_in_files / 1e6:.0f} MB in files, "
            f"{1e3 * np.mean(self.spent[newest]):.1f} ms a frame, way off by {np.sqrt(np.square(way_mm).mean()):.1f} mm"
        )


def main() -> int:
    """Drive it once."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=10_000)
    parser.add_argument("--step", type=float, default=0.04, help="metres between frames")
    parser.add_argument("--features", type=int, default=1000)
    parser.add_argument("--set", nargs="*", default=[], help="settings of the back end, e.g. loop_closing.enabled=true")
    options = parser.parse_args()
    world = Corridor((options.frames + 1000) * options.step + AHEAD_M)
    settings = apply_overrides(BackendSettings(), parse_assignments(options.set))
    first, second = (Drive(world, settings, options.step, options.features) for _ in range(2))
    for _ in range(options.frames // 1000):
        first.go(1000)
        print(first, flush=True)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e6
    growth = (np.mean(first.memory[-1000:]) - np.mean(first.memory[1000:2000])) / max(options.frames // 1000 - 2, 1)
    second.go(1000)
    for _ in range(1000 // IN_TURN):
        second.go(IN_TURN)
        first.go(IN_TURN)
    early, late = (1e3 * np.mean(each.spent[-1000:]) for each in (second, first))
    slower = late / early
    print(
        f"{growth:.2f} MB a 1,000 frames after frame 2,000, at most {peak:.0f} MB; in turn {early:.1f} ms a frame in "
        f"the second thousand, {late:.1f} after {options.frames}: x {slower:.3f}; {first.lost + second.lost} lost"
    )
    return int(growth > BAR_MB or slower > BAR_SLOWER)


if __name__ == "__main__":
    sys.exit(main())
