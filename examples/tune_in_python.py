"""A study from Python: an objective, a sampler and a callback of one's own, begun from a preset.

    python examples/tune_in_python.py [RESULTS]

The tracker assumes that the camera keeps its velocity, so it takes seconds; any other goes the same
way.
"""

import sys

import optuna

from dynslam_bench.tuning import Outcome, ProblemInstance, Study


def error_and_time(run: Outcome) -> float:
    """Cost of a run: a number above 0, compared with the default's on the same instance; less is better."""
    return run.ate_m * run.processor_s**0.1


def main(results: str = "results", frames: int = 20) -> None:
    study = Study(
        name="in-python", tracker="constant-velocity", results=results, trials=4, recorded=(),
        tune=[
            ProblemInstance("synthetic/walking_xyz?scene=0", frames=(0, frames)),
            f"synthetic/sitting_xyz?scene=1-2&frames={frames}",
        ],
        held_out=[f"synthetic/walking_xyz?scene=100-105&frames={frames}"],
        objective=error_and_time,
        sampler=optuna.samplers.RandomSampler(seed=1),
        callbacks=[lambda _, trial: print(f"trial {trial.number}: {trial.params}")],
        start=[{"frames": 2}],  # a preset's file does as well
    )  # fmt: skip
    summary = study.run().finish()
    print(study.frame()[["trial", "state", "params.frames"]])
    print(summary.conclusion)


if __name__ == "__main__":
    main(*sys.argv[1:2])
