"""What users want: values by hand, speed at shown equal accuracy, a front of presets that hold tuned settings alone."""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from simulated import SimulatedTuner, make_spec

from dynslam_bench.core.errors import StudyError
from dynslam_bench.core.toml import read_settings
from dynslam_bench.tuning import Outcome, ProblemInstance, Verdict, finish, read_preset_text, write_page
from dynslam_bench.tuning.objectives import (
    OBJECTIVES,
    Configuration,
    InstanceFailedError,
    find_objective,
    own_objective,
    together,
)

PLAIN = [ProblemInstance(f"synthetic/walking_xyz?scene={scene}") for scene in range(4)]
BLURRED = replace(PLAIN[0], degradation=(("blur", 0.5),))


def outcome(instance: ProblemInstance, ate: float, time: float = 0.03, coverage: float = 1.0) -> Outcome:
    return Outcome(instance, "", ate, coverage, time, time, 1.0)


def test_objectives_are_logarithms_of_ratios_by_hand() -> None:
    default = {instance: outcome(instance, 0.02) for instance in [*PLAIN, BLURRED]}
    tuned = {instance: outcome(instance, 0.01 * (1 + scene), 0.015, 0.98) for scene, instance in enumerate(PLAIN)}
    values = {name: each.value(tuned, default) for name, each in OBJECTIVES.items() if name != "robustness"}
    assert values["accuracy"] == pytest.approx(sum(math.log(n / 2) for n in (1, 2, 3, 4)) / 4)
    assert values["speed"] == pytest.approx(math.log(0.5))
    assert values["worst"] == pytest.approx(math.log(2)), "the worst of four scenes"
    assert values["coverage"] == pytest.approx(math.log(3)), "2 % more lost, beside a floor of 1 %"
    blurred = {**tuned, BLURRED: outcome(BLURRED, 0.06)}
    assert OBJECTIVES["robustness"].value(blurred, default) == pytest.approx(math.log(3))
    balance = together([OBJECTIVES["accuracy"], OBJECTIVES["speed"]])
    assert balance.value(tuned, default) == pytest.approx((values["accuracy"] + values["speed"]) / 2)


def test_what_cannot_be_an_objective_is_refused() -> None:
    default = {instance: outcome(instance, 0.02) for instance in PLAIN}
    with pytest.raises(StudyError, match="'robustness' counts degraded instances alone"):
        OBJECTIVES["robustness"].value(default, default)
    with pytest.raises(StudyError, match=r"'sped'.*'speed'"):
        find_objective("sped")
    with pytest.raises(StudyError, match="gives 0 on instance"):
        own_objective(lambda run: 0.0).value(default, default)


class TimedTuner(SimulatedTuner):
    """`wobble` takes time and leaves the poses alone; a smaller `gain` saves time and may cost accuracy."""

    price = 0.0

    def outcomes(
        self,
        settings: Mapping[str, Any],
        instances: Sequence[ProblemInstance],
        *,
        tracker: str = "",
        cache: bool | None = None,
    ) -> dict[ProblemInstance, Outcome]:
        gain, wobble = float(settings.get("gain", 1.5)), int(settings.get("wobble", 2))
        found = super().outcomes({"gain": gain}, instances, cache=cache)
        time = 0.02 * (0.5 + 0.25 * wobble) * gain
        cost = math.exp(self.price * max(0.0, 1.5 - gain))
        return {instance: replace(each, ate_m=each.ate_m * cost, processor_s=time) for instance, each in found.items()}


def spec(objectives: list[str], include: list[str], **changes: object):
    values = {"objectives": objectives, "space": {"include": include}, "trials": 14, "top": 3}
    return make_spec(**values | changes)


def test_speed_decides_where_the_poses_stay_as_they_are(tmp_path: Path) -> None:
    tuner = TimedTuner(spec(["speed"], ["wobble"], pruner="halving"), tmp_path)
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)  # a constraint is told once, when it is final
        tuner.run()
    summary = finish(tuner)
    chosen = summary.candidates[0]
    assert summary.verdict == Verdict.PROVEN and chosen.params == {"wobble": 0}
    assert chosen.held_out is not None and chosen.held_out.ratio == pytest.approx(0.5)
    assert chosen.on_held_out["accuracy"].ratio == pytest.approx(1.0)


def test_speed_that_is_paid_for_with_accuracy_is_no_gain(tmp_path: Path) -> None:
    tuner = TimedTuner(spec(["speed"], ["gain"], pruner="halving"), tmp_path)
    tuner.price = 0.6
    tuner.run()
    summary = finish(tuner)
    assert not summary.candidates[0].chosen and summary.verdict in (Verdict.WORSE, Verdict.PROMISING)
    assert read_settings(tuner.folder / "best.toml") == summary.candidates[0].params, "written with its status"
    assert f'status = "{summary.verdict.value}"' in (tuner.folder / "best.toml").read_text()


@pytest.mark.parametrize("objectives", [["accuracy", "speed"], ["speed", "accuracy"]])
def test_the_best_of_a_front_is_the_best_in_all_objectives_together(objectives: list[str], tmp_path: Path) -> None:
    study = spec(objectives, ["wobble"], space={"include": ["wobble"], "fixed": {"mode": "fine"}})
    tuner = TimedTuner(study, tmp_path, in_memory=False)
    tuner.run()
    summary = finish(tuner)
    assert summary.best is not None and summary.best.params == {"wobble": 0}
    assert read_settings(tuner.folder / "best.toml") == {"wobble": 0}
    assert 'mode = "fine"' in read_preset_text(study, tmp_path), "what the study fixed is a comment"
    assert "<h3>Pareto front</h3>" in write_page(tuner, summary).read_text()


class DriftingTuner(SimulatedTuner):
    """A machine that slows down with every run, and settings that change nothing; a gain of 13 breaks."""

    calls = 0

    def outcomes(
        self,
        settings: Mapping[str, Any],
        instances: Sequence[ProblemInstance],
        *,
        tracker: str = "",
        cache: bool | None = None,
    ) -> dict[ProblemInstance, Outcome]:
        if settings.get("gain") == 13.0:
            raise InstanceFailedError(f"{instances[0]}: crashed")
        drawn: dict[ProblemInstance, Outcome] = {}
        for instance, run in super().outcomes(settings, instances).items():
            self.calls += 1
            drawn[instance] = replace(run, ate_m=0.02, processor_s=0.03 * 1.02 ** (self.calls / 2))
        return drawn


def test_a_machine_that_slows_down_decides_nothing(tmp_path: Path) -> None:
    tuner = DriftingTuner(make_spec(objectives=["speed"]), tmp_path)
    instances = tuner.design.held_out
    default, (same, broken) = tuner.evaluate_beside(
        [Configuration("", settings) for settings in ({"gain": 1.1}, {"gain": 13.0})], instances
    )
    assert isinstance(broken, InstanceFailedError) and isinstance(same, dict)
    assert list(default) == list(instances) == list(same)
    assert OBJECTIVES["speed"].value(same, default) == pytest.approx(math.log(1.01), abs=0.002), "one run apart"
    apart = [tuner.outcomes(settings, instances) for settings in ({}, {"gain": 1.1})]
    assert OBJECTIVES["speed"].value(apart[1], apart[0]) > 0.2, "all of one after all of the other"
