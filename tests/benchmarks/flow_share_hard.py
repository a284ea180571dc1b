"""Where a metaheuristic could matter: no guess, wide gaps, roll and zoom, few points, points that move on their own.

    PYTHONPATH=. python tests/benchmarks/flow_share_hard.py [--budgets 64 256] [--cases gap lone] [--variants]

The tables read as those of `flow_share.py`. ``--variants`` compares settings of EMFOA instead of searches; instances
below 100 (``--first 0``) are for choosing among them, 100 and above for judging.
"""

from __future__ import annotations

import argparse

import cv2
import numpy as np
from flow_data import Pair, _similarity, _warp, corners, textures
from flow_rendered import MOTIONS, rendered
from flow_share import BASE, FEWEST, Units, table

from dynslam_bench.flow.settings import FlowSettings

GAPS = (10, 20)
LONE = 24
TILE = 80


def lone(pair: Pair, seed: int) -> Pair:
    """A few points of a pair, as far apart as they come: what is left when people fill the image."""
    rng = np.random.default_rng(seed)
    chosen = [int(rng.integers(len(pair.points)))]
    distance = np.full(len(pair.points), np.inf)
    while len(chosen) < min(LONE, len(pair.points)):
        distance = np.minimum(distance, np.hypot(*(pair.points - pair.points[chosen[-1]]).T))
        chosen.append(int(distance.argmax()))
    return Pair(pair.name, pair.reference, pair.target, pair.points[chosen], pair.truth[chosen], None, pair.start)


def gaps(first: int, instances: int, points: int) -> dict[str, Units]:
    """Rendered pairs a third and two thirds of a second apart: dropped frames, relocalisation."""
    columns: dict[str, Units] = {f"gap {gap}": {} for gap in GAPS}
    for instance in range(first, first + instances):
        for start, motion in ((40, ""), (100, MOTIONS[(instance + 1) % 3])):
            for pair in rendered(instance, start, GAPS, points, motion):
                if len(pair.points) >= FEWEST:
                    columns[f"gap {pair.name.split('+')[1]}"].setdefault(str(instance), []).append(pair)
    return columns


def rolled(images: int, points: int, skip: int) -> dict[str, Units]:
    """Warps of photographs and frames: roll of 20-45 degrees, zoom by half to one octave, both."""
    rng = np.random.default_rng(11 + skip)
    columns: dict[str, Units] = {"roll 20-45 deg": {}, "zoom 0.5-1 octave": {}, "both": {}}
    for index, image in enumerate(textures(skip + images)[skip:]):
        height, width = image.shape
        xy = corners(image, points)
        for kind, units in columns.items():
            angle = rng.choice((-1, 1)) * rng.uniform(20, 45) if kind != "zoom 0.5-1 octave" else rng.uniform(-5, 5)
            octaves = rng.choice((-1, 1)) * rng.uniform(0.5, 1) if kind != "roll 20-45 deg" else rng.uniform(-0.1, 0.1)
            matrix = _similarity(2**octaves, angle, *rng.uniform(-30, 30, 2), (width / 2, height / 2))
            truth = cv2.perspectiveTransform(xy[:, None].astype(np.float64), matrix)[:, 0]
            seen = ((truth >= 8) & (truth < (width - 8, height - 8))).all(axis=1)
            if seen.sum() >= FEWEST:
                noisy = [_noisy(each, rng) for each in (image, _warp(image, matrix, (width, height)))]
                units[str(index)] = [Pair(kind, *noisy, xy[seen], truth[seen])]
    return columns


def swarm(images: int, points: int, skip: int) -> dict[str, Units]:
    """A mosaic whose tiles each move on their own, by up to 24 and up to 60 pixels: hardly a neighbour knows."""
    rng = np.random.default_rng(13 + skip)
    columns: dict[str, Units] = {"own motions to 24 px": {}, "to 60 px": {}}
    for index, image in enumerate(textures(skip + images)[skip:]):
        height, width = image.shape
        xy = corners(image, points)
        for (name, units), reach in zip(columns.items(), (24, 60), strict=True):
            target, truth = np.roll(image, 200, axis=1), np.full(xy.shape, np.nan)
            taken = np.zeros_like(image, dtype=bool)
            for x in range(0, width - TILE + 1, TILE):
                for y in range(0, height - TILE + 1, TILE):
                    centre = (x + TILE / 2, y + TILE / 2)
                    move = _similarity(
                        2 ** rng.uniform(-0.3, 0.3), rng.uniform(-20, 20), *rng.uniform(-reach, reach, 2), centre
                    )
                    mask = np.zeros_like(image)
                    mask[y : y + TILE, x : x + TILE] = 255
                    there = (_warp(mask, move, (width, height)) > 127) & ~taken  # the first tile lies on top
                    target = np.where(there, _warp(image, move, (width, height)), target)
                    taken |= there
                    mine = (abs(xy - centre) < TILE / 2 - 12).all(axis=1)
                    moved = xy[mine] @ move[:2, :2].T + move[:2, 2]
                    column, row = np.clip(np.rint(moved).astype(int), 0, (width - 1, height - 1)).T
                    seen = there[row, column] & ((moved >= 8) & (moved < (width - 8, height - 8))).all(axis=1)
                    truth[np.flatnonzero(mine)[seen]] = moved[seen]
            known = np.isfinite(truth).all(axis=1)
            if known.sum() >= FEWEST:
                noisy = [_noisy(each, rng) for each in (image, target)]
                units[str(index)] = [Pair(name, *noisy, xy[known], truth[known])]
    return columns


def _noisy(image: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    return np.clip(image + rng.normal(0, 1.5, image.shape), 0, 255).round().astype(np.uint8)


def searches(budget: int) -> dict[str, FlowSettings]:
    """The searches with propagation, and the two best without; the halving windows alone are PatchMatch without it."""
    names = ("patchmatch", "random+propagation", "emfoa-literal+propagation", "none+propagation", "emfoa")
    rows = {name: FlowSettings(search=name, budget=budget) for name in (BASE, *names)}
    alone = FlowSettings(search="patchmatch", budget=budget, neighbours=0, similarity_seeds=False)
    return {**rows, "halving windows alone": alone}


def variants(budget: int) -> dict[str, FlowSettings]:
    """EMFOA with propagation, one thing changed at a time."""
    changes: dict[str, dict[str, float]] = {
        "default": {}, "population 2": {"population": 2}, "population 3": {"population": 3},
        "population 4": {"population": 4}, "population 10": {"population": 10},
        "population 16": {"population": 16}, "Cauchy steps of 0.5 px": {"cauchy_step_px": 0.5},
        "Cauchy steps of 8 px": {"cauchy_step_px": 8.0}, "Cauchy steps of 16 px": {"cauchy_step_px": 16.0},
        "1 sweep": {"sweeps": 1}, "2 sweeps": {"sweeps": 2}, "8 sweeps": {"sweeps": 8},
        "8 neighbours": {"neighbours": 8}, "range 48 px": {"range_px": 48.0}, "range 192 px": {"range_px": 192.0},
        "rotation 15 deg, scale 0.3": {"rotation_range_deg": 15.0, "scale_range_octaves": 0.3},
    }  # fmt: skip
    return {name: FlowSettings(search=BASE, budget=budget, **change) for name, change in changes.items()}  # type: ignore[arg-type]


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--cases", nargs="+", default=["gap", "lone", "roll", "swarm"])
    parser.add_argument("--first", type=int, default=100)
    parser.add_argument("--instances", type=int, default=12)
    parser.add_argument("--points", type=int, default=200)
    parser.add_argument("--budgets", type=int, nargs="+", default=[64, 256])
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--within", type=float, default=3.0)
    parser.add_argument("--variants", action="store_true")
    parser.add_argument("--only", nargs="+", default=[], help="rows, beside the first")
    options = parser.parse_args()
    skip = 0 if options.first >= 100 else options.instances
    sets: dict[str, dict[str, Units]] = {}
    if {"gap", "lone"} & set(options.cases):
        wide = gaps(options.first, options.instances, options.points)
        if "gap" in options.cases:
            sets["Wide gaps"] = wide
        if "lone" in options.cases:
            sets[f"Wide gaps, {LONE} points"] = {
                name: {unit: [lone(pair, seed) for pair in pairs for seed in range(4)] for unit, pairs in units.items()}
                for name, units in wide.items()
            }
    if "roll" in options.cases:
        sets["Roll and zoom"] = rolled(options.instances, options.points, skip)
        sets[f"Roll and zoom, {LONE} points"] = {
            name: {unit: [lone(pair, seed) for pair in pairs for seed in range(4)] for unit, pairs in units.items()}
            for name, units in sets["Roll and zoom"].items()
        }
    if "swarm" in options.cases:
        sets["Mosaic of tiles that move on their own"] = swarm(options.instances, options.points, skip)
    for title, columns in sets.items():
        for budget in options.budgets:
            rows = variants(budget) if options.variants else searches(budget)
            kept = {next(iter(rows)), *options.only} if options.only else rows.keys()
            rows = {name: settings for name, settings in rows.items() if name in kept}
            table(f"{title}, no guess, budget {budget}", rows, columns, False, options)


if __name__ == "__main__":
    main()
