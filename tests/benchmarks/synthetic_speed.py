"""Speed of the renderer: the first frame, all others with PNG writing, and reading back.

Usage: python tests/benchmarks/synthetic_speed.py [--frames 120] [--threads 2]

A Markdown table of wall and CPU time a frame: on a machine shared with others only the CPU time
says something.
"""

import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from command_line import parser_of

from dynslam_bench.sequences.synthetic import open_synthetic


def timed(what: str, frames: int, work: Callable[[], object]) -> None:
    """Print a row: how long some work on so many frames takes."""
    wall = time.perf_counter()
    cpu = time.process_time()
    work()
    wall = time.perf_counter() - wall
    cpu = time.process_time() - cpu
    print(f"| {what} | {1e3 * wall / frames:.1f} | {1e3 * cpu / frames:.1f} |", flush=True)


if __name__ == "__main__":
    arguments = parser_of(__doc__, frames=120, threads=2).parse_args()
    with tempfile.TemporaryDirectory() as folder:
        sequence = open_synthetic(
            f"synthetic/walking_xyz?frames={arguments.frames}",
            Path(folder),
            threads=arguments.threads,
        )
        print("| work | wall ms a frame | CPU ms a frame |\n| --- | ---: | ---: |")
        timed("first frame (textures, compilation if not cached)", 1, lambda: sequence[0])
        timed("render and write", arguments.frames - 1, sequence.render)
        timed(
            "read back",
            arguments.frames,
            lambda: list(map(sequence.__getitem__, range(len(sequence)))),
        )
        timed("check a complete cache", arguments.frames, sequence.render)
        size = sum(path.stat().st_size for path in Path(folder).rglob("*.png")) / len(sequence)
        print(f"\nA frame takes {size / 1e6:.2f} MB on disk.")
