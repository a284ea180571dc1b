"""The presets that ship, beside the default settings: error and processor time on held-out scenes and on recordings.

    python tests/benchmarks/shipped_presets.py

Both run instance by instance in turn, so that whatever else the machine does slows them alike. Rendered scenes are
instances that no choice has seen, two start offsets each; the Bonn excerpt has 23 start offsets, others than the
choice saw; the fr1 excerpts, with nobody in view, have four each, likewise. Masks, where a tracker asks for them, are
YOLO's on Bonn and the embedded network's elsewhere. Recordings are looked for in ``../shared``; what is not there is
named. Ratios are preset : default, with 95 % intervals over scenes (over starts where there is one scene). "Not
worse" is said where the one-sided 95 % bound of the error's ratio lies below 1 + MARGIN. Two runs that differ in
anything differ by 0.12 to 0.27 in the logarithm: a closer margin takes hundreds of runs."""

from itertools import product
from pathlib import Path

from dynslam_bench.core.settings import field_names
from dynslam_bench.runs import RunStore, run_many
from dynslam_bench.trackers import TRACKERS
from dynslam_bench.tuning.judgement import compared
from dynslam_bench.tuning.objectives import SPEED, Outcome, held_protocol, outcome
from dynslam_bench.tuning.study_file import ProblemInstance, parse_instances

SHARED = Path(__file__).resolve().parents[3] / "shared"
NETWORK = SHARED / "weights/yolov8n-seg_480x640_fp32.onnx"
MARGIN = 0.1
PARTS = {
    "rendered": tuple(
        f"synthetic/{instances}&frames=60&offsets=0-1"
        for instances in (
            "walking_xyz?scene=160-164", "walking_halfsphere?scene=165-169", "walking_rpy?scene=170-174",
            "walking_static?scene=175-177", "sitting_xyz?scene=178-179",
        )
    ),
    "bonn": (f"{SHARED}/data/bonn/rgbd_bonn_crowd?offsets=8-30",),
    "fr1": tuple(f"{SHARED}/data/tum/rgbd_dataset_freiburg1_{name}?offsets=4-15" for name in ("xyz", "rpy")),
}  # fmt: skip


def judge(tracker: str, preset: str, part: str) -> str:
    """One line: what the preset is worth on that part."""
    spec = TRACKERS.get(tracker)
    network = f"onnx:{NETWORK}" if part == "bonn" else "embedded"
    source = {name: network for name in field_names(spec.settings) if name == "segmentation.source"}
    instances = [instance for text in PARTS[part] for instance in parse_instances(text)]
    settings = [source, {**source, **spec.presets[preset]}]
    outcomes: list[dict[ProblemInstance, Outcome]] = [{}, {}]
    store, protocol = RunStore("results/presets"), held_protocol("tum-rgbd/v1")
    for instance in instances:
        for of_settings, values in zip(outcomes, settings, strict=True):
            (record,) = run_many([instance.run_spec(tracker, settings=values)], results=store, protocol=protocol)
            of_settings[instance] = outcome(store, record, instance, protocol, None)
    default, own = outcomes
    error, time_taken = compared(own, default), compared(own, default, objective=SPEED)
    lost = max(1 - run.coverage for run in own.values())
    verdict = "not worse" if error.bound is not None and error.bound < 1 + MARGIN else "not shown to be no worse"
    return (
        f"{tracker} {preset}, {part}, {error.n} pairs: {error}, bound {error.bound:.3f} ({verdict}); {time_taken}; "
        f"most frames lost {lost:.1%}"
    )


def main() -> None:
    """Judge the presets of all trackers."""
    presets = [(tracker.spec.id, preset) for tracker in TRACKERS.all() for preset in tracker.spec.presets]
    for (tracker, preset), part in product(presets, PARTS):
        if part == "rendered" or Path(PARTS[part][0].partition("?")[0]).is_dir():
            print(judge(tracker, preset, part), flush=True)
        else:
            print(f"{tracker} {preset}, {part}: not judged, no recording under {SHARED}")


if __name__ == "__main__":
    main()
