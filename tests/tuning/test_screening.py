"""Screening: what matters is kept, what only stirs the chaos is not, what does nothing is said to be dead."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from simulated import SimulatedTuner, make_spec
from toy_tracker import ToySettings

from dynslam_bench.core.errors import StudyError
from dynslam_bench.core.settings import flatten, parameters
from dynslam_bench.tuning import Outcome, ProblemInstance, screen_study
from dynslam_bench.tuning.evaluate import InstanceFailedError
from dynslam_bench.tuning.preliminary import KEPT, SCREENING_FILE, plan, size_of, stepped

SPACE = parameters(ToySettings)
BASE = flatten(ToySettings())


def steep(settings: Mapping[str, Any]) -> float:
    """A strong effect of the gain; none of the rest."""
    return 2.0 * math.log(float(settings.get("gain", 1.5)))


class ScreenedTuner(SimulatedTuner):
    """The error depends on the gain alone, the time on the wobble; everything but the mode stirs the chaos."""

    def evaluate(
        self,
        settings: Mapping[str, Any],
        instances: Sequence[ProblemInstance],
        *,
        jobs: int = 1,
        cache: bool | None = None,
    ) -> dict[ProblemInstance, Outcome]:
        if settings.get("mode") == "crash":
            raise InstanceFailedError("the toy broke")
        stirring = {key: value for key, value in settings.items() if key != "mode"}
        found = super().evaluate(stirring, instances, jobs=jobs, cache=cache)
        return {
            instance: replace(each, processor_s=0.02 + 0.01 * settings["wobble"]) for instance, each in found.items()
        }


def test_what_matters_is_kept_and_said_in_what(tmp_path: Path) -> None:
    spec = make_spec(space={"include": ["gain", "wobble"]}, objectives=["accuracy", "speed"])
    tuner = ScreenedTuner(spec, tmp_path, effect=steep)
    done: list[tuple[int, int]] = []
    found = screen_study(tuner, instances=8, on_done=lambda number, total: done.append((number, total)))
    assert found.kept == ["wobble", "gain"] or found.kept == ["gain", "wobble"]
    assert {effect.name: effect.objective for effect in found.effects} == {"gain": "ATE", "wobble": "processor time"}
    assert all(effect.low <= effect.size <= effect.high for effect in found.effects)
    assert found.runs == 8 * 2 * 3 == tuner.runs and done[-1] == (6, 6)
    assert (tuner.folder / SCREENING_FILE).is_file() and len(found.kept) <= KEPT


def test_a_setting_that_breaks_runs_is_named_and_the_rest_goes_on(tmp_path: Path) -> None:
    tuner = ScreenedTuner(make_spec(space={"include": ["gain", "wobble", "mode"]}), tmp_path, effect=steep)
    found = screen_study(tuner, instances=8)
    assert found.failed == {"mode": "the toy broke"} and found.kept == ["gain"]
    assert "mode" not in {effect.name for effect in found.effects}
    with pytest.raises(StudyError, match="screening on 1 instance cannot tell an effect from chance"):
        screen_study(tuner, instances=1)


def test_chaos_alone_is_hardly_ever_kept_and_a_dead_setting_never() -> None:
    rng = np.random.default_rng(0)
    kept = [size_of(rng.normal(0, 0.31, (2, 6)))[1] > 0 for _ in range(2000)]
    assert np.mean(kept) < 0.05
    felt = [size_of(rng.normal(0.6, 0.31, (2, 6)))[1] > 0 for _ in range(500)]
    assert np.mean(felt) > 0.8
    sizes = [size_of(rng.normal(0.3, 0.31, (2, 6)))[0] for _ in range(2000)]
    assert np.sqrt(np.mean(np.square(sizes))) == pytest.approx(0.3, abs=0.02), "free of the chaos' own square"
    assert size_of(np.zeros((2, 6))) == (0.0, 0.0, 0.0)


def test_points_and_steps_stay_in_the_ranges() -> None:
    for start, steps in plan(SPACE, BASE, 6, 0):
        for parameter in SPACE:
            before, after = start[parameter.name], steps[parameter.name]
            assert before != after
            if parameter.low is not None:
                assert parameter.low <= before <= parameter.high and parameter.low <= after <= parameter.high
    rng = np.random.default_rng(0)
    gain = SPACE[0]
    assert math.log(stepped(gain, 0.2, rng) / 0.2) == pytest.approx(math.log(3.0 / 0.2) / 3), "a third of the range"
