"""Optuna studies over the environments: search space, trials as runs, held-out check, presets.

`read_study` reads a study's TOML, `run_study` makes its trials, `finish` judges the best of them on held-out sequences,
`write_page` shows it all. `search_space` and `suggest` serve studies of your own.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .emfoa_sampler import EmfoaSampler
    from .final_runs import StudySummary, finish
    from .page import write_page
    from .space import search_space, suggest
    from .study import StudyEvent, Tuner, run_study
    from .study_file import SpaceSpec, StudySpec, read_study

_HOMES = {
    "EmfoaSampler": "emfoa_sampler", "SpaceSpec": "study_file", "StudyEvent": "study", "StudySpec": "study_file",
    "StudySummary": "final_runs", "Tuner": "study", "finish": "final_runs", "read_study": "study_file",
    "run_study": "study", "search_space": "space", "suggest": "space", "write_page": "page",
}  # fmt: skip

__all__ = [
    "EmfoaSampler",
    "SpaceSpec",
    "StudyEvent",
    "StudySpec",
    "StudySummary",
    "Tuner",
    "finish",
    "read_study",
    "run_study",
    "search_space",
    "suggest",
    "write_page",
]


def __getattr__(name: str) -> Any:
    """Load what is asked for; Optuna takes its time."""
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from importlib import import_module

    return getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)
