"""Speed of the renderer: frames a second with PNG writing, reading back, and the stages of one frame.

Usage: python tests/benchmarks/synthetic_speed.py [ID] [--frames 120] [--threads 2]

Prints wall and CPU time: on a machine shared with others only the CPU time says something. The first frame, with
compilation where nothing is cached, is timed apart.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path

from dynslam_bench.sequences.synthetic import open_synthetic


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("id", nargs="?", default="synthetic/walking_xyz")
    parser.add_argument("--frames", type=int, default=120)
    parser.add_argument("--threads", type=int, default=2)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        chosen = f"{arguments.id}{'&' if '?' in arguments.id else '?'}frames={arguments.frames}"
        sequence = open_synthetic(chosen, Path(folder), threads=arguments.threads)
        wall, cpu = time.perf_counter(), time.process_time()
        sequence[0]
        print(
            f"first frame (load, textures, compile if not cached): {time.perf_counter() - wall:.1f} s wall, "
            f"{time.process_time() - cpu:.1f} s CPU"
        )
        wall, cpu = time.perf_counter(), time.process_time()
        made = sequence.render()
        wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
        size = sum(path.stat().st_size for path in Path(folder).rglob("*.png")) / len(sequence)
        print(
            f"render and write {made} frames, {arguments.threads} threads: {made / wall:.1f} frames/s wall; "
            f"{1e3 * cpu / made:.0f} ms CPU a frame = {2 * made / cpu:.1f} frames/s on two free cores; "
            f"{size / 1e3:.0f} kB a frame"
        )
        wall, cpu = time.perf_counter(), time.process_time()
        for index in range(len(sequence)):
            sequence[index]
        wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
        print(f"read back: {1e3 * wall / len(sequence):.1f} ms wall, {1e3 * cpu / len(sequence):.1f} ms CPU a frame")
        wall = time.perf_counter()
        assert sequence.render() == 0
        print(f"checking a complete cache: {1e3 * (time.perf_counter() - wall) / len(sequence):.1f} ms a frame")


if __name__ == "__main__":
    main()
