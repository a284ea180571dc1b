"""The benchmark as a problem of OptunaHub: minimise the error, over the default's, on the sequences of a split."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal, get_args

import numpy as np
import optuna
import optunahub
from numpy.typing import NDArray
from optuna.distributions import BaseDistribution, FloatDistribution, IntDistribution

from slam_hpo.real import run
from slam_hpo.spaces import FRAMES, SEQUENCES, SPLITS, STARTS, SlamHpoError, defaults, known, whole
from slam_hpo.table import METRICS, load, natural

Source = Literal["surrogate", "run"]
MIN_COVERAGE = 0.95
"""Mean coverage that the constraint asks for."""
OBJECTIVES = ("ate_m", "processor_s")


class Problem(optunahub.benchmarks.BaseProblem):
    """Settings of a SLAM system; values are mean log ratios to the default configuration, so that 0 is the default.

    Args:
        system: ``mask-rcnn`` or ``emfoa-oft?masks=none``.
        split: ``tune`` or ``test``.
        frames: Frames of a run: 20, 40 or 60.
        metrics: ``ate_m``, ``processor_s``, or both.
        source: ``surrogate``, or ``run`` for real runs, which need dynslam-bench.
        noise: Add noise of the size that two starts of a run differ by, drawn again at each
            evaluation.
        seed: Of the noise.

    Raises:
        SlamHpoError: The system, the split or a metric is unknown.
    """

    def __init__(
        self,
        system: str = "mask-rcnn",
        *,
        split: str = "tune",
        frames: int = 60,
        metrics: Sequence[str] = ("ate_m",),
        source: Source = "surrogate",
        noise: bool = False,
        seed: int | None = None,
    ) -> None:
        self._bench = load(system)
        self._split = known("split", split, SPLITS)
        self._frames = known("frames", frames, FRAMES)
        self._source = known("source", source, get_args(Source))
        if not isinstance(metrics, list | tuple) or not metrics:
            raise SlamHpoError(f"metrics are {metrics!r}: give a list of {', '.join(OBJECTIVES)}")
        self.metric_names = [known("metric", name, OBJECTIVES) for name in metrics]
        # noise of a run by metric; that of a mean over all instances of the split
        of_run = np.zeros(len(metrics))
        if noise:
            of_run = np.array([self._bench.noise(frames, metric) for metric in metrics])
        self._noise = of_run / np.sqrt(len(SPLITS[split]) * len(STARTS))
        self.reseed(seed)
        self._default = self._measured(defaults(system))

    def reseed(self, seed: int | None = None) -> None:
        """Draw the noise from another stream."""
        self._rng = np.random.default_rng(None if seed is None else whole("seed", seed))

    @property
    def search_space(self) -> dict[str, BaseDistribution]:
        """The settings' ranges."""
        space: dict[str, BaseDistribution] = {}
        for name, setting in self._bench.space.items():
            if setting.whole:
                low = int(setting.low)
                high = int(setting.high)
                space[name] = IntDistribution(low, high, log=setting.log)
            else:
                space[name] = FloatDistribution(setting.low, setting.high, log=setting.log)
        return space

    @property
    def directions(self) -> list[optuna.study.StudyDirection]:
        """Every metric is minimised."""
        return [optuna.study.StudyDirection.MINIMIZE] * len(self.metric_names)

    def evaluate(self, params: dict[str, Any]) -> float | Sequence[float]:
        """Mean over sequences and starts of the log ratio to the default, one for each metric."""
        ratios = np.log(self._measured(params) / self._default).mean(axis=0)
        noises = self._noise * self._rng.standard_normal(len(self._noise))
        values = [
            float(ratios[METRICS.index(name)] + noise)
            for name, noise in zip(self.metric_names, noises, strict=True)
        ]
        return values[0] if len(values) == 1 else values

    def evaluate_constraints(self, params: dict[str, Any]) -> dict[str, float]:
        """How much of the frames is missing to 95 % coverage."""
        return {"coverage": MIN_COVERAGE - float(self._measured(params)[:, 1].mean())}

    def _measured(self, params: dict[str, Any]) -> NDArray[np.float64]:
        """ATE, coverage and processor time of every instance, ``[instances, 3]``."""
        if self._source == "run":
            instances = [(sequence, start) for sequence in SPLITS[self._split] for start in STARTS]
            runs = [
                run(self._bench.system, params, *instance, frames=self._frames)
                for instance in instances
            ]
            return np.array([one[:3] for one in runs])
        sequences = [SEQUENCES.index(sequence) for sequence in SPLITS[self._split]]
        mean, _ = self._bench.surrogate.predict(self._bench.units(params)[None])
        return natural(mean[0, sequences, :, FRAMES.index(self._frames)].reshape(-1, 3))
