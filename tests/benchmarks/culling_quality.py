"""Culling quality of `emfoa-oft`, its ablations and other systems, per feature, against exact masks.

    python tests/benchmarks/culling_quality.py [--frames 60:160]

Every feature of every frame lies on one of three things, by the renderer's exact masks:

- *moving*: an instance with a point that moved by more than the renderer's threshold since the previous frame;
- *still person*: a person that did not move in that frame. Masks drop these by class, geometry should not, and the map
  is better off without them; so they count neither for nor against and are shown apart;
- *background*: everything else.

Recall is the share of the moving features that were culled; precision the share of moving ones
among the culled moving and background features; the next columns are the share of the background
and of the still people that was culled, and the share of the frames in which nothing was. Counts
are pooled over all frames and sequences. What is culled is what the back end did not get, after the
starvation guard. ATE is the online one in mm under tum-rgbd/v1, the mean over the sequences.
"""

import one_thread  # noqa: F401  # before all others

# isort: split
import tempfile
from pathlib import Path

import cv2
import numpy as np
from command_line import parser_of

from dynslam_bench.contracts.sequence import FrameMasks
from dynslam_bench.core.settings import parse_assignments
from dynslam_bench.evaluation import evaluate, get_protocol
from dynslam_bench.geometry.trajectory import Trajectory
from dynslam_bench.sequences.catalogue import open_sequence, parse_frames
from dynslam_bench.trackers import TrackerContext, build_tracker

SEQUENCES = [
    f"synthetic/walking_{motion}?scene={100 + number}&frames=300"
    for number, motion in enumerate(("xyz", "static", "halfsphere", "rpy"))
]
"""Held out, those of the suite `dynamic`: on instances 0-99 the embedded network was trained."""
TRACKERS_AND_SETTINGS = (
    "emfoa-oft", "emfoa-oft?flow=none", "emfoa-oft-paper?flow=sparse", "emfoa-oft?masks=vote&depth=none",
    "emfoa-oft?masks=vote", "emfoa-oft?masks=none", "emfoa-oft?masks=none motion.enabled=false",
    "emfoa-oft?masks=none free_space.enabled=false", "emfoa-oft?masks=none&depth=none", "orb-slam2",
)  # fmt: skip


def kinds(masks: FrameMasks, xy: np.ndarray) -> np.ndarray:
    """What each feature (raw pixels ``[N, 2]``) lies on: 0 background, 1 a person standing still, 2 a moving thing."""
    height, width = masks.instances.shape
    column, row = np.rint(xy).astype(int).T
    instance = masks.instances[row.clip(0, height - 1), column.clip(0, width - 1)]
    people = [number for number, name in masks.class_names.items() if name == "person"]
    return np.where(
        np.isin(instance, list(masks.moving)), 2, np.where(np.isin(instance, people), 1, 0)
    )


def measure(
    tracker_id: str,
    settings: dict[str, object],
    name: str,
    part: tuple[int, int | None],
    cache: Path,
) -> tuple[float, float, np.ndarray]:
    """Run one tracker on one sequence.

    Returns:
        ATE in metres, coverage, and of each frame ``[F, 2, 3]`` the number of features and of
        culled ones by kind.
    """
    sequence = open_sequence(name, frames=part)
    assert sequence.masks is not None, f"{name} has no exact masks"
    assert sequence.ground_truth is not None, f"{name} has no exact masks"
    tracker = build_tracker(
        tracker_id,
        settings,
        TrackerContext(sequence_id=sequence.id, masks=sequence.masks, cache=str(cache)),
    )
    tracker.reset(sequence.camera, rng=np.random.default_rng(0))
    poses = {}
    counts = []
    for i in range(len(sequence)):
        frame = sequence[i]
        result = tracker.track(frame)
        if result.state == "ok":
            poses[frame.timestamp] = result.T_world_cam
        kind = kinds(sequence.masks[i], result.keypoints_xy)
        counts.append(
            [np.bincount(which, minlength=3) for which in (kind, kind[~result.keypoints_keep])]
        )
    coverage = len(poses) / len(sequence)
    ate = np.nan
    if len(poses) >= 3:
        online = Trajectory(np.array([*poses]), np.array([*poses.values()]))
        due = sequence.timestamps
        ate = evaluate(
            online, sequence.ground_truth, get_protocol("tum-rgbd/v1"), input_timestamps=due
        ).metrics["ate_rmse_m"]
    return ate, coverage, np.array(counts)


def row(label: str, part: tuple[int, int | None], cache: Path) -> str:
    """One system's row of the table."""
    cv2.setNumThreads(1)
    tracker_id, *assignments = label.split()
    settings = parse_assignments(assignments)
    ates, coverages, counts = zip(
        *(measure(tracker_id, settings, name, part, cache) for name in SEQUENCES), strict=True
    )
    by_frame = np.concatenate(counts)
    seen, culled = by_frame.sum(axis=0)
    precision = culled[2] / (culled[0] + culled[2]) if culled[[0, 2]].any() else np.nan
    background, still, recall = 100 * culled / np.maximum(seen, 1)
    idle = 100 * np.mean(by_frame[:, 1].sum(axis=1) == 0)
    name = f"`{tracker_id}`" + "".join(f", {each}" for each in assignments)
    return (
        f"| {name} | {100 * precision:.1f} % | {recall:.1f} % | {background:.1f} % | {still:.1f} % | {idle:.0f} % "
        f"| {1e3 * np.mean(ates):.1f} ({' '.join(f'{1e3 * ate:.1f}' for ate in ates)}) | {100 * min(coverages):.0f} % |"
    )


def main() -> None:
    """Print one table row a system."""
    chosen = parser_of(__doc__, frames="0:").parse_args()
    with tempfile.TemporaryDirectory() as cache:
        print(
            "| system | precision | recall | background culled | still people culled | frames without culling "
            "| ATE, mm | coverage |"
        )
        print("| --- | --- | --- | --- | --- | --- | --- | --- |")
        for label in TRACKERS_AND_SETTINGS:
            print(row(label, parse_frames(chosen.frames), Path(cache)), flush=True)
    print("\nATE in brackets: " + ", ".join(SEQUENCES))


if __name__ == "__main__":
    main()
