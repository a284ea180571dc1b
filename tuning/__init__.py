"""Optuna studies over the environments: search space, trials as runs, held-out check, presets.

`Study` is all of it from Python: run, pilot, screen, finish, and a stored one as a pandas frame. Its steps by
themselves: `read_study` reads a study's TOML, `run_study` makes its trials, `finish` judges the best of them on
held-out blocks, `write_page` shows it all. `search_space` and `suggest` serve studies of your own.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .blocks import Block, parse_blocks
    from .emfoa_sampler import EmfoaSampler
    from .evaluate import Outcome
    from .final_runs import finish
    from .page import write_page
    from .presets import read_preset_text
    from .python_study import Study
    from .space import search_space, suggest
    from .starting import pilot_of, run_study, screen_study
    from .study import StudyEvent, Tuner
    from .study_file import SpaceSpec, StudySpec, read_study
    from .summary import StudySummary

_HOMES = {
    "blocks": ("Block", "parse_blocks"),
    "emfoa_sampler": ("EmfoaSampler",),
    "evaluate": ("Outcome",),
    "final_runs": ("finish",),
    "page": ("write_page",),
    "presets": ("read_preset_text",),
    "python_study": ("Study",),
    "space": ("search_space", "suggest"),
    "starting": ("pilot_of", "run_study", "screen_study"),
    "study": ("StudyEvent", "Tuner"),
    "study_file": ("SpaceSpec", "StudySpec", "read_study"),
    "summary": ("StudySummary",),
}

__all__ = [
    "Block",
    "EmfoaSampler",
    "Outcome",
    "SpaceSpec",
    "Study",
    "StudyEvent",
    "StudySpec",
    "StudySummary",
    "Tuner",
    "finish",
    "parse_blocks",
    "pilot_of",
    "read_preset_text",
    "read_study",
    "run_study",
    "screen_study",
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
