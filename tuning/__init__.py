"""Optuna studies over the environments: search space, trials as runs, held-out check, presets.

`Study` is all of it from Python: preview, run or ask and tell, extend, finish, and a stored one as a pandas frame.
Its steps: `read_study` reads a study's TOML, `run_study` makes its trials, `finish` judges the best of them on
held-out instances, `write_page` shows it all. `search_space` and `distributions` serve studies of your own.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from dynslam_bench.tuning.judgement import StudySummary, Verdict, finish, read_preset_text
    from dynslam_bench.tuning.objectives import Outcome
    from dynslam_bench.tuning.page import write_page
    from dynslam_bench.tuning.plan import Plan, Preview, distributions, search_space
    from dynslam_bench.tuning.samplers import EmfoaSampler
    from dynslam_bench.tuning.study import Evaluation, Study, StudyEvent, run_study
    from dynslam_bench.tuning.study_file import ProblemInstance, SpaceSpec, StudySpec, parse_instances, read_study

_HOMES = {
    "judgement": ("StudySummary", "Verdict", "finish", "read_preset_text"),
    "objectives": ("Outcome",),
    "page": ("write_page",),
    "plan": ("Plan", "Preview", "distributions", "search_space"),
    "samplers": ("EmfoaSampler",),
    "study": ("Evaluation", "Study", "StudyEvent", "run_study"),
    "study_file": ("ProblemInstance", "SpaceSpec", "StudySpec", "parse_instances", "read_study"),
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
