"""The decay of carried probability maps: chosen on composites and rendered people, then reported on other recordings.

    python tests/benchmarks/mask_decay.py selfie_segmentation.tflite ./excerpts/rgbd_dataset_freiburg1_xyz
    ./excerpts/rgbd_dataset_freiburg1_rpy --with ./excerpts/man_130 --report ./excerpts/rgbd_bonn_crowd
    --yolo yolov8n-seg.onnx

The first table has a row a decay: the geometric mean over the data of the choice of `mask-rcnn`'s hold-last-pose ATE
over that without carrying, with a 95 % interval (bootstrap over sequences). These are composites (instances 0, 1, ...),
and walking replicas of scenes for tuning. The decay with the least mean is taken. The second table has
the ATE in mm of trackers by masks: none, the network alone, carried with that decay, and YOLO's; on the
recordings, which no choice has seen, from each start, on the people's recording, and on further composites.
"""

import argparse
from pathlib import Path

import numpy as np
from command_line import parser_of

import dynslam_bench as db
from dynslam_bench.api import make_specs, run_specs
from dynslam_bench.sequences.catalogue import open_sequence
from dynslam_bench.sequences.compose import compose

FOLDER = Path("results/mask_decay")
DECAYS = (0.0, 0.3, 0.5, 0.65, 0.8)
RENDERED = ("walking_xyz", "walking_halfsphere", "walking_rpy")
"""Families of rendered people; scene 7 of each is one for tuning."""
TRACKERS = {"mask-rcnn": "orb-slam2", "emfoa-oft": "emfoa-oft?masks=none"}
"""Trackers with masks, and the same without."""


def main() -> None:
    """Choose the decay, and report it."""
    parser = parser_of(__doc__, instances=3, frames=60, starts=[0, 3], yolo="")
    parser.add_argument("network")
    parser.add_argument("hosts", nargs="+")
    parser.add_argument("--with", dest="people", required=True)
    parser.add_argument("--report", nargs="+", default=[])
    chosen = parser.parse_args()
    network = f"tflite:{Path(chosen.network).absolute()}"

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
    rendered = [f"synthetic/{family}?scene=7&frames={chosen.frames}" for family in RENDERED]

    decay = choose(network, composites + rendered, chosen.frames)
    report(network, decay, chosen, further)


def choose(network: str, sequences: list[str], frames: int) -> float:
    """Print the first table; the decay with the least mean error."""
    errors = {}
    for decay in DECAYS:
        masks = {"segmentation.source": network, "segmentation.map_decay": decay}
        errors[decay] = np.array(
            [errors_of("mask-rcnn", name, masks, frames=(0, frames))[0] for name in sequences]
        )
    print(f"| decay | ratio to 0 over {len(sequences)} sequences [95 %] | median mm |")
    print("| ---: | ---: | ---: |")
    rng = np.random.default_rng(0)
    means = {}
    for decay, values in errors.items():
        ratios = np.log(values / errors[0.0])
        drawn = rng.choice(ratios, (2000, len(ratios))).mean(axis=1)
        low, high = np.exp(np.quantile(drawn, [0.025, 0.975]))
        means[decay] = float(ratios.mean())
        print(
            f"| {decay} | {np.exp(means[decay]):.2f} [{low:.2f}, {high:.2f}] | {1e3 * np.median(values):.1f} |"
        )
    best = min(means, key=lambda decay: means[decay])
    print(f"\nchosen: {best}; mm by sequence:\n")
    for row, name in enumerate(sequences):
        print(f"{Path(name).name}:", *(f"{1e3 * errors[decay][row]:.1f}" for decay in DECAYS))
    print()
    return best


def report(network: str, decay: float, chosen: argparse.Namespace, further: list[str]) -> None:
    """Print the second table."""
    carried = {"segmentation.source": network, "segmentation.map_decay": decay}
    masks = {
        "none": None,
        "network alone": {**carried, "segmentation.map_decay": 0.0},
        f"carried, {decay}": carried,
    }
    if chosen.yolo:
        masks["YOLO"] = {"segmentation.source": f"onnx:{Path(chosen.yolo).absolute()}"}
    print("| tracker | sequence, starts |", " | ".join(masks), "|")
    print("| --- | --- |", " | ".join("---:" for _ in masks), "|")
    for tracker, without in TRACKERS.items():
        for name in [*chosen.report, chosen.people, *further]:
            starts = chosen.starts if name in chosen.report else [0]
            cells = []
            for settings in masks.values():
                used = without if settings is None else tracker
                errors = errors_of(used, name, settings or {}, offsets=starts)
                cells.append(", ".join(f"{1e3 * error:.1f}" for error in errors))
            listed = ", ".join(map(str, starts))
            print(
                f"| `{tracker}` | {Path(name).name}, {listed} |", " | ".join(cells), "|", flush=True
            )


def errors_of(
    tracker: str, sequence: str, settings: dict[str, object], **options: object
) -> list[float]:
    """Hold-last-pose ATE in metres of a tracker from each start; a run without one counts as a static camera."""
    specs = make_specs(tracker, [sequence], settings=settings, cache=True, **options)
    runs = run_specs(specs, results=FOLDER / "runs")
    table = db.load(FOLDER / "runs").set_index("run_id").loc[[run.record.run_id for run in runs]]
    errors = table["hold_last_pose_ate_m"].fillna(table["static_camera_ate_rmse_m"])
    return errors.astype(float).tolist()


if __name__ == "__main__":
    main()
