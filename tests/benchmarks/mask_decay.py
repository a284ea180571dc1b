"""The decay of carried probability maps: chosen on composites and rendered people, then reported on other recordings.

    python tests/benchmarks/mask_decay.py selfie_segmentation.tflite ./excerpts/rgbd_dataset_freiburg1_xyz
    --with ./excerpts/man_130 --report ./excerpts/rgbd_bonn_crowd --yolo yolov8n-seg.onnx

The first table has a row a decay: the geometric mean over the data of the choice of `mask-rcnn`'s ATE over that without
carrying, with its range over sequences. These are composites (instances 0, 1, ...) and walking replicas of scenes for
tuning. The decay with the least mean is taken. The second table has the
ATE in mm of trackers by masks: none, the network alone, carried with that decay, and YOLO's; on the recordings, which
no choice has seen, from each start, on the people's recording, and on a further composite a host. ATE is that of the
online poses of tracked frames under tum-rgbd/v1; a share of tracked frames below 100 % stands beside it.
"""

import one_thread  # noqa: F401  # before all others

# isort: split
import argparse
from pathlib import Path

import numpy as np
from command_line import parser_of
from tracked import Clip, track

from dynslam_bench.sequences import open_sequence
from dynslam_bench.sequences.compose import compose

FOLDER = Path("results/mask_decay")
RENDERED = ("walking_xyz", "walking_halfsphere")
"""Families of rendered people."""
SCENE = 7
"""A scene for tuning."""
WITHOUT_MASKS = {"mask-rcnn": "orb-slam2", "emfoa-oft": "emfoa-oft?masks=none"}
"""Trackers with masks, and the same without."""


def main() -> None:
    """Choose the decay, and report it."""
    parser = parser_of(
        __doc__,
        instances=2,
        frames=50,
        starts=[0, 3],
        yolo="",
        decays=[0.0, 0.3, 0.5, 0.7],
        trackers=list(WITHOUT_MASKS),
    )
    parser.add_argument("network")
    parser.add_argument("hosts", nargs="+")
    parser.add_argument("--with", dest="people", required=True)
    parser.add_argument("--report", nargs="+", default=[])
    chosen = parser.parse_args()

    # composites for the choice, and one more a host for the report
    composites: list[str] = []
    further: list[str] = []
    for host in chosen.hosts:
        for instance in range(chosen.instances + 1):
            folder = FOLDER / f"{Path(host).name}_{instance}"
            if not folder.is_dir():
                compose(open_sequence(host), open_sequence(chosen.people), folder, instance)
            group = composites if instance < chosen.instances else further
            group.append(str(folder))
    rendered = [f"synthetic/{family}?scene={SCENE}&frames={chosen.frames}" for family in RENDERED]
    decay = choose(chosen, composites + rendered)
    report(chosen, decay, further)


def choose(chosen: argparse.Namespace, sequences: list[str]) -> float:
    """Print the first table; the decay with the least mean error."""
    errors = {}
    for name in sequences:
        clip = Clip(name, 0, chosen.frames)
        errors[name] = [
            track("mask-rcnn", clip, network(chosen, decay)).ate_m for decay in chosen.decays
        ]
        print(f"{Path(name).name}:", *(f"{1e3 * error:.1f}" for error in errors[name]), flush=True)
    ratios = np.log([np.array(values) / values[0] for values in errors.values()])
    means = ratios.mean(axis=0)
    print(f"\n| decay | ratio to {chosen.decays[0]} over {len(sequences)} sequences | range |")
    print("| ---: | ---: | ---: |")
    for column, decay in enumerate(chosen.decays):
        low = np.exp(ratios[:, column].min())
        high = np.exp(ratios[:, column].max())
        print(f"| {decay} | {np.exp(means[column]):.2f} | {low:.2f} to {high:.2f} |")
    best = chosen.decays[int(np.argmin(means))]
    print(f"\nchosen: {best}\n", flush=True)
    return float(best)


def report(chosen: argparse.Namespace, decay: float, further: list[str]) -> None:
    """Print the second table."""
    masks: dict[str, list[str] | None] = {
        "none": None,
        "network alone": network(chosen, 0.0),
        f"carried, {decay}": network(chosen, decay),
    }
    if chosen.yolo:
        masks["YOLO"] = [f"segmentation.source=onnx:{Path(chosen.yolo).absolute()}"]
    print("| sequence | start | tracker |", " | ".join(masks), "|")
    print("| --- | ---: | --- |", " | ".join("---:" for _ in masks), "|")
    for name in [*chosen.report, chosen.people, *further]:
        for start in chosen.starts if name in chosen.report else [0]:
            clip = Clip(name, start)
            for tracker in chosen.trackers:
                cells = []
                for assignments in masks.values():
                    used = WITHOUT_MASKS[tracker] if assignments is None else tracker
                    tracked = track(used, clip, assignments or [])
                    share = f" ({tracked.coverage:.0%})" if tracked.coverage < 1 else ""
                    cells.append(f"{1e3 * tracked.ate_m:.1f}{share}")
                row = f"| {Path(name).name} | {start} | `{tracker}` |"
                print(row, " | ".join(cells), "|", flush=True)


def network(chosen: argparse.Namespace, decay: float) -> list[str]:
    """Settings of the network's masks with a decay."""
    return [
        f"segmentation.source=tflite:{Path(chosen.network).absolute()}",
        f"segmentation.map_decay={decay}",
    ]


if __name__ == "__main__":
    main()
