"""What studies claim where nothing is better, and what pruning saves: simulated studies.

    python tests/benchmarks/study_null.py [--studies 400]

Whole studies (trials, choice, held-out check) over runs from a noise model with the measured spread of starts: each
setting is as good as the default, up to a share of 0.15 in log that differs from scene to scene. `best trial` is what a
study without the choice on unseen instances would go by: the best trial's own value. The second table compares pruners
on settings of which the best is known; a run is one of a configuration on one instance.
"""

from __future__ import annotations

import argparse
import math
import sys
import tempfile
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tuning"))


def null(studies: int, spread: float, folder: Path) -> str:
    """One line: of so many studies in which nothing is better, how many say otherwise."""
    import simulated

    from dynslam_bench.tuning import finish

    simulated.STARTS_SD = spread
    lucky = chosen = claimed = 0
    for seed in range(studies):
        spec = simulated.make_spec(sampler_seed=seed)
        tuner = simulated.SimulatedTuner(spec, folder / f"{spread}-{seed}", seed=seed)
        lucky += tuner.run().best_value < math.log(0.95)
        summary = finish(tuner)
        chosen += summary.chosen is not None
        claimed += summary.improves
    shares = "".join(f"{100 * count / studies:12.1f} %" for count in (lucky, chosen, claimed))
    return f"{spread:24.2f}{shares}"


def pruned(pruner: str, studies: int, folder: Path) -> str:
    """One line: regret of a pruner, and its runs."""
    import simulated

    regret, runs = [], 0
    for seed in range(studies):
        spec = simulated.make_spec(pruner=pruner, trials=24, sampler_seed=seed)
        tuner = simulated.SimulatedTuner(spec, folder / f"{pruner}-{seed}", effect=simulated.valley, seed=seed)
        regret.append(simulated.valley(tuner.run().best_trial.params))
        runs += tuner.runs - len(tuner.design.reference)
    return f"{pruner:24}{np.mean(regret):12.3f}{runs / studies:12.0f}"


def main() -> None:
    """Print both tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--studies", type=int, default=400)
    studies = parser.parse_args().studies
    with tempfile.TemporaryDirectory() as temporary:
        print(f"{studies} studies each; claims of a gain where there is none")
        print(f"{'sd between starts':24}{'best trial':>14}{'chosen':>14}{'Better':>14}")
        for spread in (0.24, 0.28, 0.31):
            print(null(studies, spread, Path(temporary)), flush=True)
        print(f"\n{'pruner':24}{'regret':>12}{'runs':>12}")
        for pruner in ("none", "halving", "wilcoxon"):
            print(pruned(pruner, max(1, studies // 10), Path(temporary)), flush=True)


if __name__ == "__main__":
    main()
