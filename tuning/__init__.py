"""Optuna studies over the environments: search space, trials as runs, held-out check, presets.

`Study` is all of it from Python: preview, run or ask and tell, extend, finish, and a stored one as a pandas frame.
Its steps: `read_study` reads a study's TOML, `run_study` makes its trials, `finish` judges the best of them on
held-out instances, `write_page` shows it all. `search_space` and `distributions` serve studies of your own.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from dynslam_bench.tuning.evaluate import Outcome
    from dynslam_bench.tuning.final_runs import finish, read_preset_text
    from dynslam_bench.tuning.instances import ProblemInstance, parse_instances
    from dynslam_bench.tuning.page import write_page
    from dynslam_bench.tuning.plan import Plan, Preview
    from dynslam_bench.tuning.samplers import EmfoaSampler
    from dynslam_bench.tuning.space import distributions, search_space
    from dynslam_bench.tuning.study import Study, run_study
    from dynslam_bench.tuning.study_file import SpaceSpec, StudySpec, read_study
    from dynslam_bench.tuning.summary import StudySummary, Verdict
    from dynslam_bench.tuning.tuner import Evaluation, StudyEvent, Tuner

_HOMES = {
    "instances": ("ProblemInstance", "parse_instances"),
    "samplers": ("EmfoaSampler",),
    "evaluate": ("Outcome",),
    "final_runs": ("finish", "read_preset_text"),
    "page": ("write_page",),
    "plan": ("Plan", "Preview"),
    "study": ("Study", "run_study"),
    "space": ("distributions", "search_space"),
    "tuner": ("Evaluation", "StudyEvent", "Tuner"),
    "study_file": ("SpaceSpec", "StudySpec", "read_study"),
    "summary": ("StudySummary", "Verdict"),
}

__all__ = [
    "EmfoaSampler",
    "Evaluation",
    "Outcome",
    "Plan",
    "Preview",
    "ProblemInstance",
    "SpaceSpec",
    "Study",
    "StudyEvent",
    "StudySpec",
    "StudySummary",
    "Tuner",
    "Verdict",
    "distributions",
    "finish",
    "parse_instances",
    "read_preset_text",
    "read_study",
    "run_study",
    "search_space",
    "write_page",
]


def __getattr__(name: str) -> Any:
    """Load what is asked for; Optuna takes its time."""
    from importlib import import_module

    for home, names in _HOMES.items():
        if name in names:
            return getattr(import_module(f"{__name__}.{home}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
