"""The benchmark as an objective function of CARP-S: instance, seed and budget are sequence, start and frames."""

from __future__ import annotations

from typing import Any

from carps.objective_functions.objective_function import ObjectiveFunction
from carps.utils.trials import StatusType, TrialInfo, TrialValue
from ConfigSpace import ConfigurationSpace, Float, Integer

from slam_hpo.spaces import FRAMES, SEQUENCES, STARTS, known
from slam_hpo.table import load


class SlamHpo(ObjectiveFunction):
    """ATE in metres of a SLAM system on one instance.

    ``TrialInfo.instance`` is an index of `SEQUENCES` (default 0), ``seed`` of `STARTS` (modulo),
    ``budget`` one of `FRAMES` (default the most).

    Args:
        system: ``mask-rcnn`` or ``emfoa-oft?masks=none``.
        loggers: Of CARP-S.
    """

    def __init__(self, system: str = "mask-rcnn", loggers: list[Any] | None = None) -> None:
        super().__init__(loggers)
        self._bench = load(system)

    @property
    def configspace(self) -> ConfigurationSpace:
        """The settings' ranges."""
        space = ConfigurationSpace(name=f"slam-hpo {self._bench.system}")
        for name, setting in self._bench.space.items():
            low, high, default, log = setting
            if setting.whole:
                space.add(Integer(name, (int(low), int(high)), default=int(default), log=log))
            else:
                space.add(Float(name, (low, high), default=default, log=log))
        return space

    def _evaluate(self, trial_info: TrialInfo) -> TrialValue:
        instance = known("instance", trial_info.instance or 0, range(len(SEQUENCES)))
        frames = FRAMES[-1] if trial_info.budget is None else trial_info.budget
        start = STARTS[(trial_info.seed or 0) % len(STARTS)]
        found = self._bench.predicted(
            dict(trial_info.config), SEQUENCES[instance], start=start, frames=frames
        )
        return TrialValue(
            cost=found.ate_m, time=found.processor_s * frames, status=StatusType.SUCCESS
        )
