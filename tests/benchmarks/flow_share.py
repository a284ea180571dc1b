"""What each part of the label search is worth: every search at equal budgets, with and without a guess, over strides.

    PYTHONPATH=. python tests/benchmarks/flow_share.py [--dense]

With ``--dense``, the dense flow is compared with a larger search of its own.

Every row uses the default settings but for the search. A cell is the share of all points, valid or
not, within `WITHIN_PX` pixels of the truth: mean +- standard deviation over the units; then the
mean paired difference to `emfoa+propagation` with Student's 95 % interval over the units. A unit is
a scene of a rendered sequence, its start offsets averaged.
"""

import itertools
from collections.abc import Mapping

import cv2
import numpy as np
from command_line import parser_of
from flow_data import DENSE_SEARCHES, Pair, corners, lengths
from scipy import stats

from dynslam_bench.flow.label_search import STRATEGIES
from dynslam_bench.flow.registry import build_flow
from dynslam_bench.flow.settings import DaisySettings, FlowSettings
from dynslam_bench.geometry import se3
from dynslam_bench.sequences.catalogue import open_sequence

MOTIONS = ("walking_xyz", "walking_halfsphere", "walking_rpy")
HIDDEN_PX = 1.0
MARGIN_PX = 4
WITHIN_PX = 3.0
SCENES = range(100, 112)
STARTS = (40, 100)
POINTS = 400
"""Points of a frame, before any is left out."""
BASE = "emfoa+propagation"
STRIDES = (1, 2, 4, 6)
FEWEST = 30
"""Points that a pair must have."""

Units = dict[str, list[Pair]]
"""Pairs by unit: what is averaged first, and drawn independently of the others (as far as that is true)."""


def share(settings: DaisySettings, pair: Pair, guess: bool) -> tuple[float, float]:
    """Percent of the points near the truth, and evaluations a point."""
    flow = build_flow(settings)
    reference = flow.prepare(pair.reference)
    target = flow.prepare(pair.target)
    result = flow.track(reference, target, pair.points, guess=pair.guess if guess else None, seed=0)
    good = np.hypot(*(result.xy - pair.truth).T) < WITHIN_PX
    return 100 * good.mean(), result.stats["evaluations"] / len(good)


def paired(values: np.ndarray, base: np.ndarray) -> str:
    """``mean +- sd`` of the values, and ``mean difference [95 % interval]`` to the base, over the units."""
    text = f"{values.mean():.1f} +- {values.std(ddof=1):.1f}"
    difference = values - base
    if not difference.any():
        return text
    half = (
        stats.t.ppf(0.975, len(difference) - 1) * difference.std(ddof=1) / np.sqrt(len(difference))
    )
    return f"{text} ({difference.mean():+.1f} [{difference.mean() - half:+.1f}, {difference.mean() + half:+.1f}])"


def measure(
    rows: Mapping[str, DaisySettings], units: Units, guess: bool
) -> tuple[dict[str, np.ndarray], dict[str, float]]:
    """Share of each unit, and mean evaluations a point, by row."""
    shares = {}
    spent = {}
    for name, settings in rows.items():
        by_unit = np.array(
            [
                np.mean([share(settings, pair, guess) for pair in unit], axis=0)
                for unit in units.values()
            ]
        )
        shares[name], spent[name] = by_unit[:, 0], by_unit[:, 1].mean()
    return shares, spent


def table(
    title: str, rows: Mapping[str, DaisySettings], columns: dict[str, Units], guess: bool
) -> None:
    """One Markdown table: a row a search, a column a stride (or whatever the columns are)."""
    measured = {name: measure(rows, units, guess) for name, units in columns.items()}
    heads = []
    for name, units in columns.items():
        pairs = [pair for each in units.values() for pair in each]
        head = f"{name}: {len(units)} units, {len(pairs)} pairs, {np.median(lengths(pairs)):.0f} px"
        if guess:
            off = np.concatenate([np.hypot(*(p.truth - p.guess).T) for p in pairs])
            head += f", guess off by {np.nanmedian(off):.0f}"
        heads.append(head)
    print(
        f"\n### {title}\n\n| search | evaluations a point | {' | '.join(heads)} |\n|{' --- |' * (2 + len(heads))}"
    )
    base = next(iter(rows))
    for name in rows:
        spent = np.mean([evaluations[name] for _, evaluations in measured.values()])
        cells = [paired(shares[name], shares[base]) for shares, _ in measured.values()]
        print(f"| {name} | {spent:.0f} | {' | '.join(cells)} |", flush=True)


def rendered(scene: int, start: int) -> list[Pair]:
    """Pairs ``(start, start + stride)`` of a rendered sequence; truth is the exact flow, also of what moves by itself.

    Points lie on whole pixels. Those that leave the second image or are hidden there (exact flow
    there and back does not return) are left out. The guess is the constant-velocity prediction from
    the exact poses at ``start - stride`` and ``start`` with the noisy depth, what a motion model at
    this frame rate would say; NaN where depth is missing.

    Args:
        scene: 100-199 are held out.
        start: Number of the first frame, at least the largest stride.
    """
    motion = MOTIONS[scene % len(MOTIONS)]
    sequence = open_sequence(f"synthetic/{motion}?scene={scene}&frames={start + max(STRIDES) + 1}")
    frame = sequence[start]
    camera = sequence.camera
    poses = sequence.ground_truth.T_world_cam
    gray = cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2GRAY)
    points = np.unique(np.rint(corners(gray, POINTS)), axis=0).astype(np.float32)
    column, row = points.astype(int).T
    pairs = []
    for stride in STRIDES:
        truth = points + sequence.flow(start, start + stride)[row, column]
        inside = (
            (truth >= MARGIN_PX) & (truth < (camera.width - MARGIN_PX, camera.height - MARGIN_PX))
        ).all(axis=1)
        there = np.where(inside[:, None], truth, 0).astype(np.float32)
        way_back = cv2.remap(
            sequence.flow(start + stride, start), *there.T[:, None], cv2.INTER_LINEAR
        )[0]
        with np.errstate(invalid="ignore"):
            seen = inside & (np.hypot(*(truth + way_back - points).T) < HIDDEN_PX)
        # T_next_now, as T_now_before was
        kept_up = se3.inverse(poses[start]) @ poses[start - stride]
        z = frame.depth[row, column]
        moved = se3.transform(kept_up, camera.unproject(points, np.maximum(z, 0.1)))
        guess = np.where(
            (z > 0)[:, None] & (moved[:, 2:] > 0.1), camera.project(moved), np.nan
        ).astype(np.float32)
        target = cv2.cvtColor(sequence[start + stride].rgb, cv2.COLOR_RGB2GRAY)
        pairs.append(
            Pair(
                f"{motion}?scene={scene} +{stride}",
                gray,
                target,
                points[seen],
                truth[seen],
                guess[seen],
            )
        )
    return pairs


def main() -> None:
    """Print the tables."""
    options = parser_of(__doc__, dense=False).parse_args()
    columns: dict[str, Units] = {f"stride {stride}": {} for stride in STRIDES}
    for scene, start in itertools.product(SCENES, STARTS):
        for pair, units in zip(rendered(scene, start), columns.values(), strict=True):
            if len(pair.points) >= FEWEST:
                units.setdefault(str(scene), []).append(pair)
    if options.dense:
        table("Dense", DENSE_SEARCHES, columns, False)
        return
    names = sorted(STRATEGIES, key=lambda name: (name != BASE, not STRATEGIES[name].propagates))
    rows = {name: FlowSettings(search=name) for name in names}
    table("Rendered, guess given", rows, columns, True)
    table("Rendered, no guess", rows, columns, False)


if __name__ == "__main__":
    main()
