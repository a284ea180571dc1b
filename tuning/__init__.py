"""Optuna studies over the environments: search space, trials as runs, held-out check, presets.

`Study` is all of it from Python: preview, run or ask and tell, extend, finish, and a stored one as
a pandas frame. Its steps: `read_study` reads a study's TOML, `run_study` makes its trials, `finish`
judges the best of them on held-out instances, `write_page` shows it all. `search_space` and
`distributions` serve studies of your own.
"""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from dynslam_bench.evaluation.verdicts import ComparisonVerdict
    from dynslam_bench.tuning.judgement import StudySummary, finish, read_preset_text
    from dynslam_bench.tuning.objectives import Outcome
    from dynslam_bench.tuning.page import write_page
    from dynslam_bench.tuning.plan import Preview, StudyPlan
    from dynslam_bench.tuning.space import distributions, search_space
    from dynslam_bench.tuning.study import Evaluation, Study, StudyEvent, run_study
    from dynslam_bench.tuning.study_file import (
        ProblemInstance,
        SpaceSpec,
        StudySpec,
        parse_instances,
        read_study,
    )

_DEFINED_IN = {
    "Evaluation": "study",
    "Outcome": "objectives",
    "StudyPlan": "plan",
    "Preview": "plan",
    "ProblemInstance": "study_file",
    "SpaceSpec": "study_file",
    "Study": "study",
    "StudyEvent": "study",
    "StudySpec": "study_file",
    "StudySummary": "judgement",
    "ComparisonVerdict": "judgement",
    "distributions": "space",
    "finish": "judgement",
    "parse_instances": "study_file",
    "read_preset_text": "judgement",
    "read_study": "study_file",
    "run_study": "study",
    "search_space": "space",
    "write_page": "page",
}

__all__ = [
    "ComparisonVerdict",
    "Evaluation",
    "Outcome",
    "Preview",
    "ProblemInstance",
    "SpaceSpec",
    "Study",
    "StudyEvent",
    "StudyPlan",
    "StudySpec",
    "StudySummary",
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
    if name not in _DEFINED_IN:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from importlib import import_module

    return getattr(import_module(f"{__name__}.{_DEFINED_IN[name]}"), name)
