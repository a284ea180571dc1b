"""How often the doctor's interval of the depth factor holds the right value, and whether it finds faults in sound data.

    python tests/benchmarks/depth_factor.py [--scenes 100]

A Markdown table, one row a part of a recording: pairs of frames, what is found as it is, and what
is found where depth in millimetres is read as TUM's (factor 5000; 1000 is right). Excerpts are
looked for in ``../shared``; what is not there is named.
"""

import re
import sys
from collections.abc import Iterator
from dataclasses import replace
from itertools import product
from pathlib import Path

from command_line import parser_of

from dynslam_bench.contracts.sequence import Sequence
from dynslam_bench.core import find_data_root
from dynslam_bench.geometry import Array, Camera, Trajectory
from dynslam_bench.sequences import SequenceView, open_sequence
from dynslam_bench.sequences.doctor import Finding, stretches, truth_findings
from dynslam_bench.sequences.rgbd_motion import RgbdPair, rgbd_pairs
from dynslam_bench.sequences.synthetic import open_synthetic

SHARED = Path(__file__).resolve().parents[3] / "shared/data"
REAL = {
    "bonn/rgbd_bonn_crowd": [
        (0, 200),
        (0, 100),
        (100, 200),
        (0, 60),
        (25, 145),
        (75, 195),
        (120, 180),
        (140, 200),
    ],
    "tum/rgbd_dataset_freiburg1_xyz": [(0, 100), (0, 50), (50, 100), (25, 75), (60, 100)],
    "tum/rgbd_dataset_freiburg1_rpy": [(0, 40), (0, 20), (20, 40)],
}
RENDERED = ("walking_xyz", "walking_halfsphere", "walking_rpy", "walking_static", "sitting_xyz", "sitting_halfsphere",
            "sitting_rpy", "crowd_xyz", "crowd_static", "synchronous", "tracking", "loop_room", "loop_rooms",
            "loop_corridor", "fast_desk", "fast_rpy", "fast_spin", "fast_walking", "objects_balloon", "objects_trolley",
            "objects_box_obstructing", "dark_walking", "far_empty", "far_walking")  # fmt: skip
FRAMES = 120
MOST_FRAMES = 240


def parts(scenes: list[int]) -> Iterator[tuple[str, Sequence]]:
    """Names and parts of recordings."""
    for folder, ranges in REAL.items():
        if not (SHARED / folder).is_dir():
            print(f"{folder}: not measured, nothing under {SHARED}", file=sys.stderr)
            continue
        whole = open_sequence(SHARED / folder)
        for start, stop in ranges:
            yield f"{Path(folder).name}[{start}:{stop}]", SequenceView(whole, start, stop)
    for scene, kind in product(scenes, RENDERED):
        name = f"{kind}?scene={scene}&frames={FRAMES}"
        yield name, open_synthetic(f"synthetic/{name}", find_data_root(None))


def pairs_of(sequence: Sequence) -> list[RgbdPair]:
    """The pairs of frames that the doctor measures."""
    pairs = []
    for stretch in stretches(len(sequence), MOST_FRAMES):
        pairs += rgbd_pairs([sequence[index] for index in range(*stretch)], sequence.camera)
    return pairs


def smaller(pair: RgbdPair) -> RgbdPair:
    """A pair of images whose depth in millimetres is read as TUM's."""
    pose = pair.T_first_second
    if pose is not None:
        pose = pose.copy()
        pose[:3, 3] /= 5
    return replace(pair, depth_first=pair.depth_first / 5, T_first_second=pose)


def found_in(
    stamps: Array, truth: Trajectory | None, camera: Camera, pairs: list[RgbdPair]
) -> list[Finding]:
    """The doctor's findings by the truth."""
    return truth_findings(stamps, truth, camera, pairs)


def main() -> None:
    """One line a part, then the counts."""
    options = parser_of(__doc__, scenes=[100]).parse_args()
    held = []
    falsely = []
    print(
        "| part | pairs | as it is | depth in millimetres | 1000 within |\n| --- | ---: | --- | --- | --- |"
    )
    for name, sequence in parts(options.scenes):
        pairs = pairs_of(sequence)
        known = sequence.timestamps, sequence.ground_truth, sequence.camera
        as_it_is = found_in(*known, pairs)
        falsely.append(any(finding.severity == "fault" for finding in as_it_is))
        wrong = found_in(*known, [smaller(pair) for pair in pairs])
        interval = next((re.search(r"interval ([\d.]+) to ([\d.]+)", finding.text) for finding in wrong
                         if finding.id == "depth-factor"), None)  # fmt: skip
        within = ""
        shown = ", ".join(finding.id for finding in wrong)
        if interval is not None:
            low, high = map(float, interval.groups())
            held.append(low <= 1000 <= high)
            within = "yes" if held[-1] else "no"
            shown = f"{low:g} to {high:g}"
        notes = ", ".join(finding.id for finding in as_it_is)
        print(f"| {name} | {len(pairs)} | {notes} | {shown} | {within} |", flush=True)
    print(
        f"\nThe right factor lies within {sum(held)} of {len(held)} intervals. {len(falsely) - len(held)} parts give "
        f"none. A fault is found in {sum(falsely)} of {len(falsely)} parts that have none."
    )


if __name__ == "__main__":
    main()
