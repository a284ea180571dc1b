"""Tune two settings of a SLAM system in real runs, then ask what they are worth on scenes of the other split."""

import optuna
import optunahub

dynslam = optunahub.load_module("benchmarks/dynslam")
problem = dynslam.Problem()
sampler = dynslam.MothFlameSampler(n_trials=10, population=4, seed=0)
study = optuna.create_study(directions=problem.directions, sampler=sampler)
study.optimize(problem, n_trials=10)
tested = dynslam.Problem(split="held_out").evaluate(study.best_params)
print(
    f"log ratio to the default's error: {study.best_value:.3f} where it was tuned, {tested:.3f} elsewhere"
)
