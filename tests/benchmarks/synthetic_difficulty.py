"""How hard rendered sequences are for a reference system: ORB-SLAM3, repeated, with controls.

Usage: python tests/benchmarks/synthetic_difficulty.py [ID ...] [--controls moving frozen masked] [--runs 3]

Prints a Markdown table. Controls: `frozen` renders people and things frozen at their first pose; `masked` takes the
moving sequence, removes the depth of people (and of everything while it moves) and fills their pixels smoothly from
outside, so that no feature is left on them.
"""

import tempfile
from pathlib import Path

import cv2
import numpy as np
import pandas as pd
from command_line import parser_of

from dynslam_bench.contracts import Frame, TrackerContext
from dynslam_bench.core.errors import TrackerError
from dynslam_bench.evaluation.alignment import align
from dynslam_bench.geometry import Trajectory, associate
from dynslam_bench.sequences.synthetic import RenderSettings, open_synthetic
from dynslam_bench.sequences.synthetic.sequence import SyntheticSequence
from dynslam_bench.trackers.adapters.orbslam3 import OrbSlam3
from dynslam_bench.trackers.adapters.specs import OrbSlam3Settings

VOCABULARY = Path(__file__).resolve().parents[3] / "shared" / "weights" / "orb_vocabulary_small.txt.xz"
CONTROLS = ("moving", "frozen", "masked")
FAMILIES = (
    "sitting_xyz", "walking_xyz", "crowd_xyz", "objects_box_obstructing", "objects_trolley", "synchronous", "tracking",
)  # fmt: skip


def without(frame: Frame, hidden: np.ndarray) -> Frame:
    """The frame with the hidden pixels' depth removed and their colours filled from around them."""
    grown = cv2.dilate(hidden.astype(np.uint8), np.ones((15, 15), np.uint8))
    keep = (1 - grown).astype(np.float32)
    rgb, weight = frame.rgb * keep[..., None], keep
    small = (80, 60)
    fill = cv2.resize(rgb, small, interpolation=cv2.INTER_AREA)
    mass = cv2.resize(weight, small, interpolation=cv2.INTER_AREA)
    total, amount = np.zeros_like(fill), np.full_like(mass, 1e-6)
    for sigma, trust in ((2, 1.0), (6, 1e-2), (20, 1e-4)):
        total += trust * cv2.GaussianBlur(fill, (0, 0), sigma)
        amount += trust * cv2.GaussianBlur(mass, (0, 0), sigma)
    smooth = cv2.resize(total / amount[..., None], frame.rgb.shape[1::-1], interpolation=cv2.INTER_CUBIC)
    alpha = cv2.GaussianBlur(grown.astype(np.float32), (0, 0), 3)[..., None]
    alpha = np.maximum(alpha, cv2.erode(grown, np.ones((9, 9), np.uint8))[..., None])
    mixed = np.clip(frame.rgb * (1 - alpha) + smooth * alpha + 0.5, 0, 255).astype(np.uint8)
    return Frame(frame.index, frame.timestamp, mixed, np.where(grown > 0, np.float32(0), frame.depth))


def error(estimate: Trajectory, truth: Trajectory) -> float:
    """RMSE of the positions at common stamps after the best rigid alignment, m; NaN for fewer than three poses."""
    ours, theirs = associate(estimate.timestamps, truth.timestamps, 1e-4)
    if len(ours) < 3:
        return np.nan
    poses, expected = estimate.T_world_cam[ours], truth.T_world_cam[theirs]
    offset = align(poses, expected, "se3").apply(poses)[:, :3, 3] - expected[:, :3, 3]
    return float(np.sqrt((offset**2).sum(axis=1).mean()))


def frames_of(id: str, control: str, cache: Path) -> tuple[SyntheticSequence, list[Frame]]:
    """A sequence, and its frames as a control has them."""
    people = "frozen" if control == "frozen" else "moving"
    sequence = open_synthetic(id, cache, settings=RenderSettings(people=people))
    sequence.render()
    frames = [sequence[index] for index in range(len(sequence))]
    if control == "masked":
        for index, masks in enumerate(map(sequence.masks.__getitem__, range(len(frames)))):
            ids = [k for k, name in masks.class_names.items() if name == "person" or k in masks.moving]
            frames[index] = without(frames[index], np.isin(masks.instances, ids))
    return sequence, frames


def run(sequence: SyntheticSequence, frames: list[Frame], seed: int) -> dict[str, float]:
    """RMSE of the final trajectory of ORB-SLAM3 in metres, and the coverage."""
    settings = OrbSlam3Settings(vocabulary=str(VOCABULARY))
    tracker = OrbSlam3(settings, TrackerContext(sequence_id=sequence.id, fps=sequence.fps))
    tracker.reset(sequence.camera, rng=np.random.default_rng(seed))
    tracked = sum(tracker.track(frame).state == "ok" for frame in frames)
    try:
        final = error(tracker.finalize(), sequence.ground_truth)
    except TrackerError:  # with no keyframe left it dies while it saves
        final = np.nan
    tracker.close()
    return {"final": final, "coverage": tracked / len(frames)}


def measure(id: str, control: str, runs: int, cache: Path) -> list[dict[str, object]]:
    """Several runs of ORB-SLAM3 on one control of one sequence."""
    sequence, frames = frames_of(id, control, cache)
    truth = sequence.ground_truth.positions
    never = float(np.sqrt(((truth - truth.mean(0)) ** 2).sum(1).mean()))
    return [{"id": id, "control": control, "never": never} | run(sequence, frames, seed) for seed in range(runs)]


def table(rows: list[dict]) -> str:
    """Markdown: one line an id, the median final ATE of every control, with the coverage where frames are lost."""
    frame = pd.DataFrame(rows)
    controls = [control for control in CONTROLS if control in set(frame["control"])]
    lines = [f"| sequence | {' | '.join(controls)} | static camera |", f"|{' --- |' * (len(controls) + 2)}"]
    for id, of_id in frame.groupby("id", sort=False):
        cells = [cell(of_id[of_id["control"] == control]) for control in controls]
        lines.append(f"| `{id}` | {' | '.join(cells)} | {of_id['never'].iloc[0]:.3f} |")
    return "\n".join(lines)


def cell(runs: pd.DataFrame) -> str:
    """Median error in m of some runs, and the share of the frames that were tracked where it is below 95 %."""
    if runs.empty:
        return ""
    error = "-" if runs["final"].isna().all() else f"{runs['final'].median():.3f}"
    return error if runs["coverage"].min() >= 0.95 else f"{error} ({runs['coverage'].min():.0%})"


def main() -> None:
    parser = parser_of(__doc__, runs=3)
    parser.add_argument("ids", nargs="*", default=[f"synthetic/{name}?scene=100&frames=120" for name in FAMILIES])
    parser.add_argument("--controls", nargs="+", default=list(CONTROLS), choices=CONTROLS)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as cache:
        rows = [
            row
            for id in arguments.ids
            for control in arguments.controls
            for row in measure(id, control, arguments.runs, Path(cache))
        ]
    print(table(rows))


if __name__ == "__main__":
    main()
