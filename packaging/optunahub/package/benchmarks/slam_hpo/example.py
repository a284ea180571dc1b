"""Tune the settings of a SLAM system on the surrogate, then ask what they are worth on sequences of the other split."""

import optuna
import optunahub

slam_hpo = optunahub.load_module("benchmarks/slam_hpo")
problem = slam_hpo.Problem("mask-rcnn", noise=True, seed=0)
study = optuna.create_study(
    directions=problem.directions, sampler=optuna.samplers.TPESampler(seed=0)
)
study.optimize(problem, n_trials=50)
tested = slam_hpo.Problem("mask-rcnn", split="test").evaluate(study.best_params)
print(
    f"log ratio to the default's error: {study.best_value:.3f} where it was tuned, {tested:.3f} elsewhere"
)
