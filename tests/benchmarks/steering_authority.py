"""What is worth steering: how far the poses of an episode move between the ends of each online setting's range.

    python tests/benchmarks/steering_authority.py [--trackers emfoa-oft emfoa-oft?masks=none] [--frames 14] [--stride 3]
        [--scene 'synthetic/walking_xyz?scene=103'] [--prefix flow]

Each row is one setting of one tracker, alone: the mean over the frames of the distance in mm between the camera centres
with the setting at the low end, and at the high end, and with the default, and whether all frames were tracked.
Small images (half the resolution) of a rendered sequence, masks that err as a network's do (`tests/trackers`).
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "tests" / "trackers")]

import numpy as np  # noqa: E402
from steering_scene import FRAMES, STRIDE, SmallScene, construct, play  # noqa: E402

from dynslam_bench.core.errors import DynslamError  # noqa: E402
from dynslam_bench.core.settings import online_parameters  # noqa: E402
from dynslam_bench.trackers import TRACKERS  # noqa: E402


def apart_mm(first, second) -> float:
    """Mean distance of the camera centres over the frames that both have a pose for."""
    pairs = [
        (a.T_world_cam[:3, 3], b.T_world_cam[:3, 3])
        for a, b in zip(first, second, strict=True)
        if a.T_world_cam is not None and b.T_world_cam is not None
    ]
    return 1e3 * float(np.mean([np.linalg.norm(a - b) for a, b in pairs])) if pairs else float("nan")


def main() -> int:
    """Print one row a setting."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--trackers", nargs="+", default=["emfoa-oft", "emfoa-oft?masks=none"])
    parser.add_argument("--frames", type=int, default=FRAMES)
    parser.add_argument("--stride", type=int, default=STRIDE)
    parser.add_argument("--scene", default="synthetic/walking_xyz?scene=103")
    parser.add_argument("--prefix", default="")
    options = parser.parse_args()
    scene = SmallScene(options.scene, options.frames, options.stride)
    sys.stdout.write("| tracker | setting | low | high | change at low, mm | at high, mm | tracked at low, high |\n")
    sys.stdout.write("| --- | --- | --- | --- | --- | --- | --- |\n")
    for name in options.trackers:
        spec = TRACKERS.get(name)
        base = play(construct(spec, scene), scene, options.frames)
        for parameter in online_parameters(spec.settings()):
            if not parameter.name.startswith(options.prefix):
                continue
            cells, tracked = [], []
            for value in (parameter.low, parameter.high):
                try:
                    ended = play(construct(spec, scene, **{parameter.name: value}), scene, options.frames)
                except DynslamError:
                    cells.append("refused")
                    tracked.append("-")
                    continue
                cells.append(f"{apart_mm(base, ended):.1f}")
                tracked.append(f"{sum(result.state == 'ok' for result in ended)}/{len(ended)}")
            sys.stdout.write(
                f"| {name} | `{parameter.name}` | {parameter.low:g} | {parameter.high:g} | {cells[0]} | {cells[1]} "
                f"| {tracked[0]}, {tracked[1]} |\n"
            )
            sys.stdout.flush()
    return 0


if __name__ == "__main__":
    sys.exit(main())
