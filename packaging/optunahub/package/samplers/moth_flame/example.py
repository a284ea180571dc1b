"""Minimise a function of two numbers."""

import optuna
import optunahub

sampler = optunahub.load_module("samplers/moth_flame").MothFlameSampler(n_trials=100, seed=0)
study = optuna.create_study(sampler=sampler)
study.optimize(
    lambda trial: trial.suggest_float("x", -5, 5) ** 2 + trial.suggest_float("y", -5, 5) ** 2,
    n_trials=100,
)
print(study.best_params)
