"""A study's own space: ranges, choices, conditions, and the design of a system as a search."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import optuna
import pytest
from helpers.simulated import make_spec
from optuna.distributions import CategoricalDistribution, FloatDistribution, IntDistribution

from dynslam_bench.core import DynslamError, StudyError
from dynslam_bench.core.records import validated
from dynslam_bench.tuning import StudyPlan, StudySpec, read_study
from dynslam_bench.tuning.study_file import SpaceSpec

WITHOUT_MASKS = "emfoa-oft?masks=none"
SYSTEMS = ["orb-slam2", WITHOUT_MASKS, "mask-rcnn", "emfoa-oft?flow=lucas-kanade"]
SPLITS = {
    "tune": ["synthetic/walking_xyz?scene=0&frames=20"],
    "held_out": ["synthetic/walking_xyz?scene=100&frames=20"],
}


def plan(tmp_path: Path, space: Any, tracker: str = WITHOUT_MASKS) -> StudyPlan:
    values = make_spec(tracker=tracker, **SPLITS).model_dump() | {"space": space}
    return StudyPlan(validated(StudySpec, values, "the study", StudyError), tmp_path)


def proposals(plan: StudyPlan, count: int = 40) -> list[dict[str, Any]]:
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    study = optuna.create_study(sampler=optuna.samplers.RandomSampler(seed=0))
    found = []
    for _ in range(count):
        trial = study.ask()
        plan.search.suggest(trial)
        found.append(trial.params)
        study.tell(trial, 0.0)
    return found


def test_a_file_gives_ranges_steps_and_choices_of_its_own(tmp_path: Path) -> None:
    file = tmp_path / "study.toml"
    file.write_text(
        f'tracker = "{WITHOUT_MASKS}"\ntune = {SPLITS["tune"]}\nheld_out = {SPLITS["held_out"]}\nrecorded = []\n'
        'space.range."features.n_features" = [200, 1500]\n'
        "space.range.features.levels = [4, 10]\n"
        'space.range."backend.tracking.map_radius_px" = { low = 2.0, high = 6.0, step = 0.5 }\n'
        'space.choices."flow.search" = ["emfoa+propagation", "patchmatch"]\n'
    )
    study = StudyPlan(read_study(file), tmp_path)
    assert study.search.distributions() == {
        # the scale is the setting's own where the file says none
        "features.n_features": IntDistribution(200, 1500, log=True),
        "features.levels": IntDistribution(4, 10),
        "flow.search": CategoricalDistribution(("emfoa+propagation", "patchmatch")),
        "backend.tracking.map_radius_px": FloatDistribution(2.0, 6.0, step=0.5),
    }
    assert StudySpec.model_validate_json(study.spec.model_dump_json()) == study.spec


def test_distributions_of_optuna_say_the_same_from_python(tmp_path: Path) -> None:
    spans = {
        "features.n_features": IntDistribution(200, 1400, step=100),
        "motion.threshold_px": FloatDistribution(1.0, 4.0, log=True),
        "flow.method": CategoricalDistribution(("daisy", "dis")),
    }
    assert plan(tmp_path, spans).search.distributions() == spans
    assert plan(tmp_path, {"range": spans}).search.distributions() == spans
    assert SpaceSpec.model_validate({"exclude": ["flow.*"]}).include == ("*",)


@pytest.mark.parametrize(
    ("space", "words"),
    [
        ({"range": {"features.n_features": [200, 10**8]}}, "n_features' is 100000000: input should be"),
        ({"range": {"motion.threshold_px": [-3, 4]}}, "motion.threshold_px' is -3"),
        ({"range": {"features.n_features": [1200, 1500]}}, "the baseline sets features.n_features = 1000, out"),
        ({"range": {"features.n_features": [200.5, 1500]}}, "low = 200.5, but it takes whole numbers"),
        ({"range": {"features.n_features": [1500, 200]}}, "the range ends at 200, below its beginning 1500"),
        ({"range": {"features.n_features": [200]}}, r"write a range as \[low, high\]"),
        ({"range": {"features.n_feature": [200, 1500]}}, "unknown 'features.n_feature'"),
        ({"range": {"motion.enabled": [0, 1]}}, "'motion.enabled' takes no range: it is False or True"),
        ({"range": {"motion.threshold_px": {"low": 0, "high": 4, "scale": "log"}}}, "no logarithm|is 0"),
        ({"choices": {"flow.method": ["daisy", "nope"]}}, "flow.method' is 'nope'"),
        ({"choices": {"tracker": ["orb-slam2", "mask-rcnn"]}}, "lack 'emfoa-oft"),
        ({"choices": {"tracker": [WITHOUT_MASKS, "orb-slam9"]}}, "orb-slam9"),
        ({"choices": {"flow.method": ["daisy"]}}, "flow.method"),
        ({"range": {"flow.budget": [30, 90]}, "fixed": {"flow.budget": 40}}, "both tuned and fixed"),
        ({"range": {"flow.budget": [30, 90]}, "fixed": {"flow.method": "dis"}}, "has no effect in this study"),
        ({"include": ["flow.window_px"]}, "it exists, but has no range"),
        ({"include": ["motion.*"], "fixed": {"motion.enabeld": True}}, "unknown .*motion.enabeld"),
    ],
)  # fmt: skip
def test_what_a_setting_does_not_take_is_one_line_before_anything_runs(
    space: dict[str, Any], words: str, tmp_path: Path
) -> None:
    with pytest.raises(DynslamError, match=words) as refused:
        plan(tmp_path, space)
    assert "\n" not in str(refused.value)


def test_conditions_that_depend_on_each_other_are_refused(tmp_path: Path) -> None:
    space = {
        "range": {"flow.budget": [30, 90], "flow.sweeps": [2, 6]},
        "when": {"flow.budget": {"flow.sweeps": 4}, "flow.sweeps": {"flow.budget": 64}},
    }
    with pytest.raises(StudyError, match="depend on each other"):
        plan(tmp_path, space)


def test_a_setting_is_proposed_only_where_the_chosen_system_has_it_and_uses_it(
    tmp_path: Path,
) -> None:
    space = {
        "include": ["motion.*"],
        "range": {"features.n_features": [200, 1500], "flow.budget": [24, 96]},
        "choices": {
            "tracker": SYSTEMS,
            "flow.method": ["daisy", "dis"],
            "segmentation.schedule": ["every", "every_nth"],
        },
        "when": {"segmentation.n": {"segmentation.schedule": "every_nth"}},
        "fixed": {"segmentation.source": "embedded"},
    }
    space["range"]["segmentation.n"] = [2, 6]
    study = plan(tmp_path, space)
    found = proposals(study)
    assert {params["tracker"] for params in found} == set(SYSTEMS)
    for params in found:
        tracker = params["tracker"]
        has_masks = tracker in ("mask-rcnn", "emfoa-oft?flow=lucas-kanade")
        assert "features.n_features" in params
        assert ("flow.method" in params) == ("emfoa" in tracker)
        # the label search is one of DAISY Filter Flow alone, which one of the systems does not have
        assert ("flow.budget" in params) == (
            tracker == WITHOUT_MASKS and params["flow.method"] == "daisy"
        )
        assert ("motion.threshold_px" in params) == params.get("motion.enabled", False)
        assert ("segmentation.schedule" in params) == has_masks
        assert ("segmentation.n" in params) == (params.get("segmentation.schedule") == "every_nth")
        # what runs has no setting that the tracker lacks
        configuration = study.configuration(params)
        assert configuration.tracker == tracker
        assert "tracker" not in configuration.settings
        assert ("segmentation.source" in configuration.settings) == has_masks
    assert study.configuration({}).tracker == WITHOUT_MASKS


def test_a_search_without_moths_or_neighbours_has_none_of_their_settings(tmp_path: Path) -> None:
    space = {
        "include": ["flow.population", "flow.cauchy_step_px", "flow.sweeps"],
        "choices": {"flow.search": ["emfoa+propagation", "mfo", "random", "patchmatch"]},
    }
    used = {
        "emfoa+propagation": {"flow.population", "flow.cauchy_step_px", "flow.sweeps"},
        "mfo": {"flow.population"},
        "random": set(),
        "patchmatch": {"flow.sweeps"},
    }
    for params in proposals(plan(tmp_path, space)):
        assert params.keys() == {"flow.search"} | used[params["flow.search"]]


def test_a_value_that_only_some_systems_have_may_be_fixed(tmp_path: Path) -> None:
    space = {
        "choices": {"tracker": ["orb-slam2", "mask-rcnn"]},
        "fixed": {"segmentation.source": "embedded"},
    }
    study = plan(tmp_path, space, tracker="orb-slam2")
    assert study.baseline.settings == {}
    assert study.configuration({"tracker": "mask-rcnn"}).settings == space["fixed"]
    assert study.preview().scenes == 1
