"""What a study's page warns of agrees with which trial was chosen."""

from types import SimpleNamespace

import optuna
import pytest

from dynslam_bench.tuning.page import warnings_of
from dynslam_bench.tuning.samplers import CONSTRAINTS


@pytest.mark.parametrize(
    ("bounds", "said"),
    [
        ((0.01, 0.02, 0.03), "None of the 3 trials fulfils the constraints on its own instances"),
        ((-0.01, 0.02, 0.03), "2 trials violate a constraint and are not candidates"),
        ((-0.01, -0.02, -0.03), None),
    ],
)
def test_trials_that_were_judged_are_not_called_out_of_the_choice(bounds, said):
    study = optuna.create_study()
    for bound in bounds:
        study.add_trial(optuna.trial.create_trial(value=1.0, user_attrs={CONSTRAINTS: {"ate": bound}}))
    tuner = SimpleNamespace(study=study, spec=SimpleNamespace(objectives=("accuracy",)))
    notes = [note for note in warnings_of(tuner) if "constraint" in note]
    assert len(notes) == (said is not None) and all(said in note for note in notes)


@pytest.mark.parametrize("objective", ["speed", "accuracy"])
def test_times_of_the_race_are_called_unpaired(objective):
    tuner = SimpleNamespace(study=optuna.create_study(), spec=SimpleNamespace(objectives=(objective,)))
    assert any("processor time" in note for note in warnings_of(tuner)) == (objective == "speed")
