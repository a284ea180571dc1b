"""Studies whose runs are drawn from a noise model, so that their truth is known and they take milliseconds."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any
from unittest.mock import patch

import optuna

from dynslam_bench.core.records import digest
from dynslam_bench.core.seeding import stream
from dynslam_bench.tuning import Outcome, ProblemInstance, Study, StudySpec
from dynslam_bench.tuning.plan import Design, design_of
from dynslam_bench.tuning.storage import open_storage
from helpers import toy_tracker

TRACKER = f"{toy_tracker.__file__}:SPEC"
TUNE = "synthetic/walking_xyz?scene=0-11&frames=20&offsets=0-1"
HELD_OUT = "synthetic/walking_xyz?scene=100-107&frames=20&offsets=0-2"
STARTS_SD = 0.28
"""Standard deviation of the log ratio of two runs in one scene: measured 0.24 to 0.31 for real trackers."""
SCENES_SD = 0.15
"""How far a setting's effect differs from scene to scene."""

_PATCHING = threading.Lock()
"""Workers in threads must not restore each other's patches."""

Effect = Callable[[Mapping[str, Any]], float]


def make_spec(**changes: object) -> StudySpec:
    values: dict[str, object] = {
        "name": "simulated", "tracker": TRACKER, "tune": [TUNE], "held_out": [HELD_OUT], "recorded": [], "trials": 12,
        "space": {"include": ["gain", "wobble"]}, "sampler": "random", "min_coverage": None,
    }  # fmt: skip
    return StudySpec.model_validate({**values, **changes})


def toy_spec(**changes: object) -> StudySpec:
    """A study of a few real runs on recordings, each from one start."""
    values = {"name": "toy", "trials": 2, "held_out": [], "offsets": [0], "pruner": "none"}
    return make_spec(**values | {"space": {"include": ["gain"]}} | changes)


def nothing(settings: Mapping[str, Any]) -> float:
    """No setting is better or worse than another."""
    return 0.0


def valley(settings: Mapping[str, Any]) -> float:
    """A gain of 1 is best; the default of 1.5 is 28 % worse, and the ends of the range by a factor of 4 and 2."""
    return 1.5 * min(1.0, math.log(settings.get("gain", 1.5)) ** 2)


class SimulatedTuner(Study):
    """A study whose runs are drawn.

    Args:
        spec: The study.
        results: Where its files lie.
        effect: True log ratio of settings to the best there is.
        seed: Seed of the noise; the same run always comes out the same.
        in_memory: Keep the trials in memory, which is faster.
    """

    def __init__(
        self,
        spec: StudySpec,
        results: Path,
        *,
        effect: Effect = nothing,
        seed: int = 0,
        in_memory: bool = True,
    ) -> None:
        self._made = set[tuple[str, ProblemInstance]]()
        self.effect = effect
        self.noise_seed = seed
        with (
            _PATCHING,
            patch.multiple(
                "dynslam_bench.tuning.study",
                open_storage=(lambda *_: optuna.storages.InMemoryStorage())
                if in_memory
                else open_storage,
                design_of=simulated_design,
            ),
            patch("dynslam_bench.tuning.plan.design_of", simulated_design),
        ):
            super().__init__(spec, results)

    @property
    def runs(self) -> int:
        """How many runs were made; the store makes none twice."""
        return len(self._made)

    def extend(self, **more: int) -> None:
        with _PATCHING, patch("dynslam_bench.tuning.study.design_of", simulated_design):
            super().extend(**more)

    def _identify(self) -> dict[str, Any]:
        return {"code": "simulated"}  # looking it up takes longer than a study here

    def outcomes(
        self, settings: Mapping[str, Any], instances: Sequence[ProblemInstance], **how: Any
    ) -> dict[ProblemInstance, Outcome]:
        who = digest({**self.base, **settings})
        self._made |= {(who, instance) for instance in instances}
        return {
            instance: Outcome(
                instance, "", self._error(who, settings, instance), 1.0, 0.03, 0.03, 1.0
            )
            for instance in instances
        }

    def _error(self, who: str, settings: Mapping[str, Any], instance: ProblemInstance) -> float:
        scene = stream(self.noise_seed, "scene", instance.scene).normal(0, 0.5)
        own = stream(self.noise_seed, "own", who, instance.scene).normal(
            0, SCENES_SD / math.sqrt(2)
        )
        start = stream(self.noise_seed, "start", who, str(instance)).normal(
            0, STARTS_SD / math.sqrt(2)
        )
        return math.exp(math.log(0.03) + scene + self.effect(settings) + own + start)


def simulated_design(spec: StudySpec, *, further: int = 0) -> Design:
    return _design(spec.tune, spec.confirm, spec.held_out, spec.extendable, further)


@cache
def _design(
    tune: tuple[str, ...],
    confirm: tuple[str, ...],
    held_out: tuple[str, ...],
    extendable: bool,
    further: int,
) -> Design:
    """Opening the sequences takes longer than a study here."""
    spec = make_spec(tune=tune, confirm=confirm, held_out=held_out, extendable=extendable)
    return design_of(spec, further=further)
