"""Study files of before there were blocks and races, in today's form."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

RACES = {"median": "halving", "hyperband": "halving", "wilcoxon": "wilcoxon", "none": "none"}
"""Who ends trials early now, by the `pruner` that did."""
NEW = ("confirm", "recorded", "race", "ate_margin")
"""What the old form could not say."""


def is_old(values: Mapping[str, Any]) -> bool:
    """Whether a study, or its stored identity, has the old form."""
    return "pruner" in values


def converted(values: Mapping[str, Any]) -> tuple[dict[str, Any], list[str]]:
    """A study's values in today's form, and what was changed, a line each.

    The names of sequences are blocks as they stand. What cannot be converted is left for the validation to refuse.
    """
    found, notes = dict(values), []
    if is_old(found):
        pruner = found.pop("pruner")
        found.setdefault("race", RACES.get(str(pruner), pruner))
        notes.append(f'pruner = "{pruner}" became race = "{found["race"]}"')
        if "speed" in str(found.get("objectives", "")):
            notes.append('objective "speed" is the processor time beside the default\'s, no real-time factor')
    return found, notes
