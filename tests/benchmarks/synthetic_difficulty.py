"""How hard rendered sequences are for a reference system: ORB-SLAM3, repeated, with and without what moves.

Usage: python tests/benchmarks/synthetic_difficulty.py [--runs 3]

Prints a Markdown table: the median final ATE in m, with the share of the tracked frames where it is
below 95 %. `moving` is the sequence as it is; `masked` removes the depth of people (and of
everything while it moves) and fills their pixels smoothly from outside, so that no feature is left
on them.
"""

import tempfile
from pathlib import Path

import cv2
import numpy as np
from command_line import parser_of

from dynslam_bench.contracts import Frame, TrackerContext
from dynslam_bench.core.errors import EvaluationError, TrackerError
from dynslam_bench.evaluation import evaluate
from dynslam_bench.sequences.synthetic import open_synthetic
from dynslam_bench.sequences.synthetic.sequence import SyntheticSequence
from dynslam_bench.trackers.adapters.orbslam3 import OrbSlam3
from dynslam_bench.trackers.adapters.specs import OrbSlam3Settings

VOCABULARY = (
    Path(__file__).resolve().parents[3] / "shared" / "weights" / "orb_vocabulary_small.txt.xz"
)
FAMILIES = (
    "sitting_xyz", "walking_xyz", "crowd_xyz", "objects_box_obstructing", "objects_trolley", "synchronous", "tracking",
)  # fmt: skip


def without(frame: Frame, hidden: np.ndarray) -> Frame:
    """The frame with the hidden pixels' depth removed and their colours filled from around them."""
    grown = cv2.dilate(hidden.astype(np.uint8), np.ones((15, 15), np.uint8))
    keep = (1 - grown).astype(np.float32)
    rgb = frame.rgb * keep[..., None]
    weight = keep
    small = (80, 60)
    fill = cv2.resize(rgb, small, interpolation=cv2.INTER_AREA)
    mass = cv2.resize(weight, small, interpolation=cv2.INTER_AREA)
    total = np.zeros_like(fill)
    amount = np.full_like(mass, 1e-6)
    for sigma, trust in ((2, 1.0), (6, 1e-2), (20, 1e-4)):
        total += trust * cv2.GaussianBlur(fill, (0, 0), sigma)
        amount += trust * cv2.GaussianBlur(mass, (0, 0), sigma)
    smooth = cv2.resize(
        total / amount[..., None], frame.rgb.shape[1::-1], interpolation=cv2.INTER_CUBIC
    )
    alpha = cv2.GaussianBlur(grown.astype(np.float32), (0, 0), 3)[..., None]
    alpha = np.maximum(alpha, cv2.erode(grown, np.ones((9, 9), np.uint8))[..., None])
    mixed = np.clip(frame.rgb * (1 - alpha) + smooth * alpha + 0.5, 0, 255).astype(np.uint8)
    return Frame(
        frame.index, frame.timestamp, mixed, np.where(grown > 0, np.float32(0), frame.depth)
    )


def masked(sequence: SyntheticSequence, index: int) -> Frame:
    """A frame without people, and without what moves in it."""
    masks = sequence.masks[index]
    ids = [k for k, name in masks.class_names.items() if name == "person" or k in masks.moving]
    return without(sequence[index], np.isin(masks.instances, ids))


def run(sequence: SyntheticSequence, frames: list[Frame], seed: int) -> tuple[float, float]:
    """RMSE of the final trajectory of ORB-SLAM3 in metres, and the coverage."""
    tracker = OrbSlam3(
        OrbSlam3Settings(vocabulary=str(VOCABULARY)),
        TrackerContext(sequence_id=sequence.id, fps=sequence.fps),
    )
    tracker.reset(sequence.camera, rng=np.random.default_rng(seed))
    coverage = np.mean([tracker.track(frame).state == "ok" for frame in frames])
    try:
        error = evaluate(tracker.finalize(), sequence.ground_truth).metrics["ate_rmse_m"]
    # with no keyframe left it dies while it saves; two poses have no error
    except (TrackerError, EvaluationError):
        error = np.nan
    tracker.close()
    return error, coverage


def cell(runs: list[tuple[float, float]]) -> str:
    """Median error in m of some runs, and the share of the frames that were tracked where it is below 95 %."""
    errors, coverages = np.array(runs).T
    error = "-" if np.isnan(errors).all() else f"{np.nanmedian(errors):.3f}"
    return error if coverages.min() >= 0.95 else f"{error} ({coverages.min():.0%})"


def main() -> None:
    arguments = parser_of(__doc__, runs=3).parse_args()
    print("| sequence | moving | masked | static camera |\n|" + " --- |" * 4)
    with tempfile.TemporaryDirectory() as cache:
        for family in FAMILIES:
            id = f"synthetic/{family}?scene=100&frames=120"
            sequence = open_synthetic(id, Path(cache))
            sequence.render()
            controls = [
                [sequence[k] for k in range(len(sequence))],
                [masked(sequence, k) for k in range(len(sequence))],
            ]
            cells = [
                cell([run(sequence, frames, seed) for seed in range(arguments.runs)])
                for frames in controls
            ]
            static = np.linalg.norm(sequence.ground_truth.positions.std(axis=0))
            print(f"| `{id}` | {' | '.join(cells)} | {static:.3f} |", flush=True)


if __name__ == "__main__":
    main()
