"""What each part of the label search is worth: every search at equal budgets, with and without a guess, over strides.

    PYTHONPATH=. python tests/benchmarks/flow_share.py [--instances 12] [--starts 40 100] [--budget 64] [--sets ...]

Every row uses the default settings but for the search (and the budget). A cell is the share of all points, valid or
not, within `--within` pixels of the truth: mean +- standard deviation over the units; then the mean paired difference
to `emfoa+propagation` with Student's 95 % interval over the units. A unit is an instance of a rendered sequence (its
start offsets averaged), a first image of a recording, or, on the one KITTI pair, a seed of the search.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Sequence

import numpy as np
from flow_accuracy import kitti_pair
from flow_data import Pair, real
from flow_rendered import rendered
from scipy import stats

from dynslam_bench.flow.label_search import STRATEGIES
from dynslam_bench.flow.registry import build_flow
from dynslam_bench.flow.settings import FlowSettings

BASE = "emfoa+propagation"
STRIDES = (1, 2, 4, 6)
FEWEST = 30
"""Points that a pair must have."""

Units = dict[str, list[Pair]]
"""Pairs by unit: what is averaged first, and drawn independently of the others (as far as that is true)."""


def share(settings: FlowSettings, pair: Pair, guess: bool, seeds: Iterable[int], within: float) -> tuple[float, float]:
    """Percent of the points within so many pixels of the truth, and evaluations a point; means over the seeds."""
    flow = build_flow(settings)
    reference, target = flow.prepare(pair.reference), flow.prepare(pair.target)
    found = []
    for seed in seeds:
        result = flow.track(reference, target, pair.points, guess=pair.guess if guess else None, seed=seed)
        good = np.hypot(*(result.xy - pair.truth).T) < within
        found.append((100 * good.mean(), result.stats["evaluations"] / len(good)))
    shares, spent = np.mean(found, axis=0)
    return float(shares), float(spent)


def paired(values: np.ndarray, base: np.ndarray) -> str:
    """``mean +- sd`` of the values, and ``mean difference [95 % interval]`` to the base, over the units."""
    text = f"{values.mean():.1f} +- {values.std(ddof=1):.1f}" if len(values) > 1 else f"{values.mean():.1f}"
    difference = values - base
    if len(difference) < 3 or not difference.any():
        return text
    half = stats.t.ppf(0.975, len(difference) - 1) * difference.std(ddof=1) / np.sqrt(len(difference))
    return f"{text} ({difference.mean():+.1f} [{difference.mean() - half:+.1f}, {difference.mean() + half:+.1f}])"


def measure(
    rows: dict[str, FlowSettings], units: Units, guess: bool, seeds: Sequence[int], within: float
) -> tuple[dict[str, np.ndarray], dict[str, float]]:
    """Share of each unit, and mean evaluations a point, by row."""
    shares, spent = {}, {}
    for name, settings in rows.items():
        each = [np.mean([share(settings, p, guess, seeds, within) for p in pairs], axis=0) for pairs in units.values()]
        shares[name], spent[name] = np.array(each)[:, 0], float(np.mean(each, axis=0)[1])
    return shares, spent


def table(title: str, rows: dict[str, FlowSettings], columns: dict[str, Units], guess: bool, options) -> None:  # type: ignore[no-untyped-def]
    """One Markdown table: a row a search, a column a stride (or whatever the columns are)."""
    measured = {name: measure(rows, units, guess, options.seeds, options.within) for name, units in columns.items()}
    heads = []
    for name, units in columns.items():
        pairs = [pair for each in units.values() for pair in each]
        moved = np.concatenate([np.hypot(*(p.truth - p.points).T) for p in pairs])
        head = f"{name}: {len(units)} units, {len(pairs)} pairs, {np.median(moved):.0f} px"
        if guess:
            off = np.concatenate([np.hypot(*(p.truth - p.guess).T) for p in pairs])
            head += f", guess off by {np.nanmedian(off):.0f}"
        heads.append(head)
    print(f"\n### {title}\n\n| search | evaluations a point | {' | '.join(heads)} |\n|{' --- |' * (2 + len(heads))}")
    base = next(iter(rows))
    for name in rows:
        spent = np.mean([evaluations[name] for _, evaluations in measured.values()])
        cells = [paired(shares[name], shares[base]) for shares, _ in measured.values()]
        print(f"| {name} | {spent:.0f} | {' | '.join(cells)} |", flush=True)


def rendered_sets(instances: int, starts: Sequence[int], strides: Sequence[int], points: int) -> dict[str, Units]:
    """Held-out instances by stride."""
    columns: dict[str, Units] = {f"stride {stride}": {} for stride in strides}
    for instance in range(100, 100 + instances):
        for start in starts:
            for pair in rendered(instance, start, strides, points):
                if len(pair.points) >= FEWEST:
                    columns[f"stride {pair.name.split('+')[1]}"].setdefault(str(instance), []).append(pair)
    return columns


def recorded_sets(names: Sequence[str], points: int, every: int) -> dict[str, Units]:
    """First images of recordings by stride."""
    lengths = {"fr1_xyz": 100, "fr1_rpy": 40, "bonn": 180}
    columns: dict[str, Units] = {}
    for stride in STRIDES:
        units = columns.setdefault(f"stride {stride}", {})
        for name in names:
            starts = tuple(range(stride, lengths[name] - stride - 3, every))
            for pair in real(name, (stride,), limit=points, starts=starts):
                units[f"{name} {pair.start}"] = [pair]
    return columns


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--instances", type=int, default=12)
    parser.add_argument("--starts", type=int, nargs="+", default=[40, 100])
    parser.add_argument("--every", type=int, default=10, help="first images of recordings are so many frames apart")
    parser.add_argument("--points", type=int, default=400)
    parser.add_argument("--budget", type=int, default=FlowSettings().budget)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--within", type=float, default=3.0)
    parser.add_argument("--sets", nargs="+", default=["rendered", "fr1", "bonn", "kitti"])
    options = parser.parse_args()
    names = sorted(STRATEGIES, key=lambda name: (name != BASE, not STRATEGIES[name].propagates))
    rows = {name: FlowSettings(search=name, budget=options.budget) for name in names}
    sets: dict[str, dict[str, Units]] = {}
    if "rendered" in options.sets:
        sets["Rendered"] = rendered_sets(options.instances, options.starts, STRIDES, options.points)
    if "fr1" in options.sets:
        sets["TUM fr1_xyz, fr1_rpy"] = recorded_sets(("fr1_xyz", "fr1_rpy"), options.points, options.every)
    if "bonn" in options.sets:
        sets["Bonn crowd, static points"] = recorded_sets(("bonn",), options.points, options.every)
    for title, columns in sets.items():
        table(f"{title}, guess given", rows, columns, True, options)
        table(f"{title}, no guess", rows, columns, False, options)
    if "kitti" in options.sets:
        pair, seeds = kitti_pair(), range(8)
        columns = {"one pair, 8 seeds": {str(seed): [pair] for seed in seeds}}
        measured = {
            name: np.array([share(settings, pair, False, [seed], options.within)[0] for seed in seeds])
            for name, settings in rows.items()
        }
        print(f"\n### KITTI, no guess\n\n| search | {next(iter(columns))} |\n| --- | --- |")
        for name, values in measured.items():
            print(f"| {name} | {paired(values, measured[BASE])} |")


if __name__ == "__main__":
    main()
