"""Pilots: spreads that are found again, effects that so many scenes really tell, and hopeless studies refused."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from simulated import SCENES_SD, STARTS_SD, SimulatedTuner, make_spec
from toy_tracker import ToySettings

from dynslam_bench.core.errors import StudyError
from dynslam_bench.core.settings import flatten, parameters
from dynslam_bench.tuning import ProblemInstance, pilot_of
from dynslam_bench.tuning.objectives import bounds
from dynslam_bench.tuning.preliminary import (
    HOPELESS,
    PILOT_FILE,
    begin,
    detectable,
    scenes_needed,
    small_change,
    spread,
)
from dynslam_bench.tuning.tuner import StudyEvent


def logs(
    rng: np.random.Generator, scenes: int, starts: int, within: float, between: float
) -> dict[ProblemInstance, float]:
    found = {}
    for scene in range(scenes):
        own = rng.normal(0, between)
        for start in range(starts):
            found[ProblemInstance(f"synthetic/walking_xyz?scene={scene}", offset=start)] = own + rng.normal(0, within)
    return found


def test_the_spread_between_starts_and_between_scenes_is_found_again() -> None:
    rng = np.random.default_rng(0)
    found = np.array([np.square(spread(logs(rng, 6, 3, 0.3, 0.2))) for _ in range(400)]).mean(axis=0)
    assert found[0] == pytest.approx(0.09, rel=0.05) and found[1] == pytest.approx(0.04, rel=0.15)
    within, between = spread(
        {ProblemInstance("synthetic/walking_xyz?scene=0"): 0.1, ProblemInstance("synthetic/walking_xyz?scene=1"): 0.3}
    )
    assert within == 0 and between == pytest.approx(math.sqrt(0.02))


def test_four_in_five_studies_see_a_detectable_effect_and_one_in_forty_an_absent_one() -> None:
    rng = np.random.default_rng(1)
    effect = math.log(1 - detectable(0.28, 0.15, 8, 2))
    error = math.sqrt(0.15**2 + 0.28**2 / 2)

    def share_that_sees(true: float) -> float:
        seen = [bounds(rng.normal(true, error, 8)) for _ in range(3000)]
        return float(np.mean([found is not None and found[1] < 0 for found in seen]))

    assert share_that_sees(effect) == pytest.approx(0.8, abs=0.03)
    assert share_that_sees(0.0) == pytest.approx(0.025, abs=0.01)


def test_the_scenes_that_effects_need_are_the_fewest() -> None:
    assert [scenes_needed(0.1, 0.24, 0.0, 1), scenes_needed(0.1, 0.31, 0.0, 1)] == [43, 70], "measured: 40 to 70 runs"
    for effect in (0.05, 0.1, 0.2):
        count = scenes_needed(effect, 0.3, 0.2, 3)
        assert detectable(0.3, 0.2, count, 3) <= effect < detectable(0.3, 0.2, count - 1, 3)


def test_a_pilot_measures_what_was_put_in(tmp_path: Path) -> None:
    tuner = SimulatedTuner(make_spec(), tmp_path, seed=2)
    found = pilot_of(tuner)
    assert found.scenes == 8 and found.starts == 3 and (tuner.folder / PILOT_FILE).is_file()
    assert 0.5 < found.within / STARTS_SD < 1.5 and found.between < 4 * SCENES_SD
    assert [need.effect for need in found.needs] == [0.05, 0.1, 0.2]
    assert found.needs[0].instances > found.needs[1].instances > found.needs[2].instances > 0


def test_a_hopeless_study_is_refused_with_what_it_would_take(tmp_path: Path) -> None:
    spec = make_spec(pilot=True, held_out=["synthetic/walking_xyz?scene=100-102&frames=20&offsets=0"])
    tuner = SimulatedTuner(spec, tmp_path / "a")
    told: list[StudyEvent] = []
    with pytest.raises(StudyError, match=r"3 scenes.*20 % would take [0-9]+ scenes") as caught:
        begin(tuner, on_event=told.append)
    assert "\n" not in str(caught.value) and [event.kind for event in told] == ["pilot", "pilot"]
    assert pilot_of(tuner).detectable > HOPELESS and pilot_of(tuner).warning
    runs = tuner.runs
    begin(tuner)
    assert tuner.runs == runs, "one pilot a study"
    begin(SimulatedTuner(spec.model_copy(update={"pilot": False}), tmp_path / "b"))


def test_small_changes_are_small_and_change_something() -> None:
    base = flatten(ToySettings())
    space = [each for each in parameters(ToySettings) if each.name in ("gain", "wobble")]
    for seed in range(20):
        found = small_change(space, base, np.random.default_rng(seed))
        assert set(found) == {"gain", "wobble"} and found != {name: base[name] for name in found}
        assert 0.8 < found["gain"] < 1.9 and isinstance(found["wobble"], int)
    choices = [each for each in parameters(ToySettings) if each.name == "mode"]
    assert small_change(choices, base, np.random.default_rng(0)) == {"mode": "crash"}, "where there are no numbers"
