"""CPU time of rendering a frame, paired with the twin: the families' frames and the twin's are rendered in turn.

Usage: python tests/benchmarks/synthetic_cost.py [ID ...] [--frames 12]

Only the ratio says something on a machine that others use too; a frame is colour, depth and mask, encoded as PNG.
"""

from __future__ import annotations

import argparse
import time

import numpy as np

from dynslam_bench.sequences.synthetic import SYNTHETIC_IDS, open_synthetic
from dynslam_bench.sequences.synthetic.sequence import SyntheticSequence, encode_png

TWIN = "synthetic/walking_xyz"


def cost(sequence: SyntheticSequence, index: int) -> float:
    """CPU milliseconds of one frame on one thread."""
    start = time.thread_time()
    made = sequence.renderer.render(index)
    for image in (made.rgb, made.raw_depth, made.instances):
        encode_png(image)
    return 1e3 * (time.thread_time() - start)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("ids", nargs="*", default=list(SYNTHETIC_IDS))
    parser.add_argument("--frames", type=int, default=12)
    arguments = parser.parse_args()
    twin = open_synthetic(TWIN, None, threads=1)
    cost(twin, 0)
    print("| sequence | CPU ms a frame | twin in the same minutes | ratio |")
    print("| --- | --- | --- | --- |")
    for id in arguments.ids:
        sequence = open_synthetic(id, None, threads=1)
        cost(sequence, 0)
        pairs = []
        for share in np.linspace(0.02, 0.98, arguments.frames):
            pairs.append([cost(made, int(share * len(made))) for made in (sequence, twin)])
        own, other = np.mean(pairs, axis=0)
        print(f"| {id} | {own:.0f} | {other:.0f} | {own / other:.2f} |", flush=True)


if __name__ == "__main__":
    main()
