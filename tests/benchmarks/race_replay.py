"""The race replayed on recorded runs: what share of the grid's runs it takes, and how much worse its choice is.

    python tests/benchmarks/race_replay.py RESULTS... [--default orb-slam2] [--orders 200] [--best 0] [--unseen starts]
                                             [--race halving none ...]

The trials are the configurations of stored runs (systems, and their variants), the instances what all of them ran on; each
order of the trials is one study. Values, steps and rules are those of studies. A study runs on the instances of one start
and is judged on the other starts; with `--unseen scene` it runs on all starts of all scenes but one, and is judged on
that one. Regret is the log ATE ratio, on what none of its runs has seen, of the choice to the best. `--best N` keeps
the N best alone, which lie closer together.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import get_args

import numpy as np

from dynslam_bench.evaluation import get_protocol
from dynslam_bench.reports.model.load import load_runs
from dynslam_bench.runs import RunStore
from dynslam_bench.tuning.instances import ProblemInstance, scenes
from dynslam_bench.tuning.objectives import by_scene, centre
from dynslam_bench.tuning.pruning import FIRST_STEP, is_dropped, is_worse, running_order, steps
from dynslam_bench.tuning.study_file import PrunerName

Errors = dict[ProblemInstance, float]
Grid = dict[str, Errors]


def recorded(folders: list[Path]) -> Grid:
    """ATE in metres of every configuration on the instances that all of them ran on."""
    grid: Grid = {}
    for row in load_runs([RunStore(folder) for folder in folders], get_protocol("tum-rgbd/v1"), trials=True).rows:
        if row.score_m is not None:
            grid.setdefault(row.variant_key, {})[ProblemInstance(row.sequence.id, offset=row.offset, seed=row.seed)] = (
                row.score_m
            )
    most = max(map(len, grid.values()))
    whole = {name: errors for name, errors in grid.items() if len(errors) == most}
    common = set.intersection(*(set(errors) for errors in whole.values()))
    return {name: {instance: errors[instance] for instance in sorted(common)} for name, errors in whole.items()}


def value(errors: Errors, default: Errors, instances: list[ProblemInstance]) -> float:
    """What a study tells of a trial after these instances: log ATE ratio to the default over scenes."""
    return centre(by_scene({instance: errors[instance] for instance in instances}, default).values())


def replay(
    grid: Grid, default: Errors, rule: PrunerName, order: list[str], instances: list[ProblemInstance]
) -> tuple[str, int]:
    """The choice of one study, and its runs."""
    passed = steps(rule, len(instances))
    course: dict[int, list[list[float]]] = {step: [] for step in passed}
    done: dict[str, float] = {}
    runs = 0
    for name in order:
        for step, following in zip(passed, [*passed[1:], 0], strict=True):
            mine = [value(grid[name], default, instances[:step])]
            course[step].append(mine)
            if following and rule == "wilcoxon" and done:
                seen = {instance: np.log(grid[name][instance]) for instance in instances[:step]}
                if is_worse(seen, _logs(grid[min(done, key=lambda each: done[each])])):
                    break
            elif following and rule != "wilcoxon":
                if is_dropped(mine, course[step], len(course[FIRST_STEP]), FIRST_STEP / following):
                    break
        else:
            done[name] = mine[0]
        runs += step
    return min(done, key=lambda each: done[each]), runs


def _logs(errors: Mapping[ProblemInstance, float]) -> dict[ProblemInstance, float]:
    return {instance: float(np.log(error)) for instance, error in errors.items()}


def unseen_blocks(instances: list[ProblemInstance], split: str, number: int) -> set[ProblemInstance]:
    """What the study of this number must not see."""
    if split == "starts":
        starts = sorted({instance.offset for instance in instances})
        return {instance for instance in instances if instance.offset != starts[number % len(starts)]}
    found = list(scenes(instances).values())
    return set(found[number % len(found)])


def main() -> None:
    """Replay every rule in many orders."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("results", nargs="+", type=Path)
    parser.add_argument("--default", default="orb-slam2")
    parser.add_argument("--orders", type=int, default=200)
    parser.add_argument("--best", type=int, default=0)
    parser.add_argument("--race", nargs="+", choices=get_args(PrunerName), default=get_args(PrunerName))
    parser.add_argument("--unseen", choices=("starts", "scene"), default="starts")
    options = parser.parse_args()
    grid = recorded(options.results)
    default = next(errors for name, errors in grid.items() if options.default in name)
    instances = list(default)
    worth = {name: value(errors, default, instances) for name, errors in grid.items()}
    kept = sorted(worth, key=lambda name: worth[name])[: options.best or len(worth)]
    print(
        f"{len(kept)} configurations, {len(instances)} instances in {len(scenes(instances))} scenes, {options.orders} orders"
    )
    print("| race | runs | regret |\n| --- | --- | --- |")
    for rule in options.race:
        found = []
        for number in range(options.orders):
            unseen = unseen_blocks(instances, options.unseen, number)
            seen = running_order([instance for instance in instances if instance not in unseen], number)
            order = [str(name) for name in np.random.default_rng(number).permutation(kept)]
            choice, runs = replay(grid, default, rule, order, seen)
            truth = {name: value(grid[name], default, sorted(unseen)) for name in kept}
            found.append((runs / (len(kept) * len(seen)), truth[choice] - min(truth.values())))
        runs, regret = np.mean(found, axis=0)
        error = np.std([each for _, each in found], ddof=1) / np.sqrt(len(found))
        print(f"| `{rule}` | {100 * runs:.0f} % | {regret:.3f} ± {error:.3f} |", flush=True)


if __name__ == "__main__":
    main()
