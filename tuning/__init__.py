"""Optuna studies over the environments: search space, trials as runs, held-out check, presets.

`read_study` reads a study's TOML, `run_study` makes its trials, `finish` judges the best of them on held-out sequences,
`write_page` shows it all; `Study` opens a stored one and gives its trials as a pandas frame. `search_space` and
`suggest` serve studies of your own.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .emfoa_sampler import EmfoaSampler
    from .final_runs import finish
    from .frame import Study
    from .page import write_page
    from .space import search_space, suggest
    from .study import StudyEvent, Tuner, run_study
    from .study_file import SpaceSpec, StudySpec, read_study
    from .summary import StudySummary

_HOMES = {
    "emfoa_sampler": ("EmfoaSampler",),
    "final_runs": ("finish",),
    "frame": ("Study",),
    "page": ("write_page",),
    "space": ("search_space", "suggest"),
    "study": ("StudyEvent", "Tuner", "run_study"),
    "study_file": ("SpaceSpec", "StudySpec", "read_study"),
    "summary": ("StudySummary",),
}

__all__ = [
    "EmfoaSampler",
    "SpaceSpec",
    "Study",
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
    from importlib import import_module

    for home, names in _HOMES.items():
        if name in names:
            return getattr(import_module(f"{__name__}.{home}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
