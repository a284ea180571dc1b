"""A study of dynslam-bench as a problem of OptunaHub: minimise its objectives over its instances, in real runs."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import optuna
import optunahub
from optuna.distributions import BaseDistribution

from dynslam_bench.tuning import Outcome, ProblemInstance, Study, StudySpec

Outcomes = dict[ProblemInstance, Outcome]
FEATURES = StudySpec(
    name="optunahub",
    tracker="orb-slam2",
    tune=("synthetic/walking_xyz?scene=0-1&frames=40", "synthetic/sitting_xyz?scene=2-3&frames=40"),
    held_out=("synthetic/walking_xyz?scene=100-105&frames=40",),
    recorded=(),
    offsets=(0,),
    space={"include": ["features.n_features", "features.fast_threshold"]},
)
"""The problem that is taken where none is named: two settings of ORB features on four rendered scenes."""


class Problem(optunahub.benchmarks.BaseProblem):
    """Values are mean log ratios to the baseline, so that 0 is the baseline and -0.1 is 9.5 % less.

    Each evaluation makes one run an instance; a run that is stored in `results` is not made again.

    Args:
        study: A study or its TOML file: tracker, space, instances, objectives and constraints.
        split: ``tune``, or ``held_out`` to ask what settings are worth elsewhere.
        results: The results folder.

    Raises:
        DynslamError: The study does not fit.
        ValueError: There is no such split.
    """

    def __init__(
        self,
        study: StudySpec | Path | str = FEATURES,
        *,
        split: str = "tune",
        results: Path | str = "results",
    ) -> None:
        if split not in ("tune", "held_out"):
            raise ValueError(f"split {split!r} is none of tune, held_out")
        self._study = Study(study, results)
        self._instances = getattr(self._study.design, split)
        self._baseline: Outcomes = {}

    @property
    def search_space(self) -> dict[str, BaseDistribution]:
        """The settings' ranges."""
        return self._study.search.distributions()

    @property
    def directions(self) -> list[optuna.study.StudyDirection]:
        """Every objective is minimised."""
        return [optuna.study.StudyDirection.MINIMIZE] * len(self._study.objectives)

    def evaluate(self, params: dict[str, Any]) -> float | Sequence[float]:
        """Mean over the scenes of the log ratio to the baseline, one for each objective."""
        outcomes = self._outcomes(params)
        baseline = self._reference()
        values = [objective.value(outcomes, baseline) for objective in self._study.objectives]
        return values[0] if len(values) == 1 else values

    def evaluate_constraints(self, params: dict[str, Any]) -> dict[str, float]:
        """How far each constraint of the study is violated; 0 or less where it holds."""
        return self._study.violations(self._outcomes(params), self._reference())

    def _outcomes(self, params: dict[str, Any]) -> Outcomes:
        """What the settings came to on each instance."""
        tracker, settings = self._study.configuration(params)
        return self._study.outcomes(settings, self._instances, tracker=tracker)

    def _reference(self) -> Outcomes:
        """What the baseline came to on each instance."""
        if not self._baseline:
            self._baseline, _ = self._study.evaluate_beside([], self._instances)
        return self._baseline
