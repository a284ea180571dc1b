"""How near `sequences calibrate` comes to the truth: rolling shutters of known readout, global ones, real excerpts.

    python tests/benchmarks/calibration.py [--scenes 0 1]

A Markdown table, one row a recording: true and estimated readout in ms with the 95 % interval,
whether the truth lies within, the delay of depth, the depth factor, processor time. Then how often
the truth lies within the interval, and how often a global shutter was taken for a rolling one. The
`fast_*` families are rendered with other readout times than their 26 ms, too, each below a data
root of its own. Excerpts are looked for in ``../shared``; what is not there is named.
"""

import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from itertools import product
from pathlib import Path

from command_line import parser_of

from dynslam_bench.contracts.sequence import Sequence
from dynslam_bench.core import SequenceError, find_data_root
from dynslam_bench.sequences import open_sequence
from dynslam_bench.sequences.calibration import Quantity, calibrate
from dynslam_bench.sequences.synthetic import families, open_synthetic

SHARED = Path(__file__).resolve().parents[3] / "shared/data"
REAL = ("tum/rgbd_dataset_freiburg1_xyz", "tum/rgbd_dataset_freiburg1_rpy", "bonn/rgbd_bonn_crowd")
FRAMES = 100
READOUTS_MS = (0.0, 26.0)
FAST = ("desk", "rpy", "spin", "walking")
GLOBAL = (
    "walking_xyz",
    "walking_rpy",
    "walking_halfsphere",
    "walking_static",
    "sitting_rpy",
    "crowd_xyz",
    "loop_room",
)


def recordings(scenes: list[int]) -> Iterator[tuple[str, float | None, Sequence]]:
    """Name, true readout in ms where it is known, and the recording."""
    root = find_data_root(None)
    optics = families.OPTICS
    for ms, kind, scene in product(READOUTS_MS, FAST, scenes):
        families.OPTICS = replace(optics, readout_s=1e-3 * ms)
        name = f"synthetic/fast_{kind}@{scene}?frames={FRAMES}"
        sequence = open_synthetic(name, root / f"readout_{ms:g}ms")
        # the scene is built while the optics are these
        assert sequence.camera.readout_s == 1e-3 * ms
        yield name, ms, sequence
    families.OPTICS = optics
    for kind, scene in product(GLOBAL, scenes):
        name = f"synthetic/{kind}@{scene}?frames={FRAMES}"
        yield name, 0.0, open_synthetic(name, root)
    for folder in REAL:
        if (SHARED / folder).is_dir():
            yield folder, None, open_sequence(SHARED / folder)
        else:
            print(f"{folder}: not measured, nothing under {SHARED}", file=sys.stderr)


def text(quantity: Quantity, scale: float) -> str:
    """Estimate and interval, and whether it counts as observable."""
    if quantity.value is None or quantity.low is None or quantity.high is None:
        return "-"
    interval = (
        f"{scale * quantity.value:.1f} [{scale * quantity.low:.1f}, {scale * quantity.high:.1f}]"
    )
    return interval if quantity.observable else f"({interval})"


def main() -> None:
    """One line a recording, then the counts."""
    options = parser_of(__doc__, scenes=[0, 1]).parse_args()
    rolling = []
    still = []
    observable = 0
    head = (
        "recording",
        "true ms",
        "readout ms",
        "truth within",
        "delay of depth ms",
        "depth factor",
        "processor s",
    )
    print(f"| {' | '.join(head)} |\n|{' --- |' * len(head)}")
    for name, truth, sequence in recordings(options.scenes):
        began = time.process_time()
        try:
            result = calibrate(sequence)
        except SequenceError as error:
            print(f"| {name} | | {error} | | | | |")
            continue
        readout, delay, factor = result.quantities
        within = None
        if truth is not None and readout.low is not None and readout.high is not None:
            within = 1e3 * readout.low <= truth <= 1e3 * readout.high
            (rolling if truth else still).append(within)
            observable += readout.observable
        known = (
            ("", "")
            if truth is None
            else (f"{truth:g}", {True: "yes", False: "no", None: "-"}[within])
        )
        row = (
            name.rpartition("/")[2],
            known[0],
            text(readout, 1e3),
            known[1],
            text(delay, 1e3),
            text(factor, 1),
        )
        print(f"| {' | '.join(row)} | {time.process_time() - began:.1f} |", flush=True)
    print(
        f"\nThe truth lies within the interval of {sum(rolling)} of {len(rolling)} rolling shutters, and zero within "
        f"that of {sum(still)} of {len(still)} global ones. {observable} readout times of {len(rolling) + len(still)} "
        "are observable."
    )


if __name__ == "__main__":
    main()
