"""Optuna studies over the environments."""
