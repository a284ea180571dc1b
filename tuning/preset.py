"""Tuned settings as a TOML preset that ``run --settings`` takes: what was tuned, and nothing else."""

from __future__ import annotations

import json
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from typing import Any


def preset_text(
    tuned: Mapping[str, Any],
    tracker: str,
    remark: str,
    *,
    fixed: Mapping[str, Any] | None = None,
    tuned_on: Sequence[str] = (),
    judged_on: Sequence[str] = (),
) -> str:
    """TOML text of tuned settings, dotted name to value, grouped into tables.

    What a study had fixed (where its masks came from, for one) belongs to the study and not to the preset: it stands
    there as a remark, so that the preset runs wherever the tracker does.

    Args:
        tuned: The tuned settings; empty for the default.
        tracker: For which tracker.
        remark: A line on what they are worth.
        fixed: What every run of the study had besides.
        tuned_on: Blocks that trials and choice saw.
        judged_on: Blocks that judged.
    """
    remarks = [remark]
    if tuned_on:
        remarks.append(f"Tuned on {_listed(tuned_on)}.")
    if judged_on:
        remarks.append(f"Judged on {_listed(judged_on)}.")
    if fixed:
        values = ", ".join(f"{name} = {json.dumps(value)}" for name, value in sorted(fixed.items()))
        remarks.append(f"Fixed in that study, not part of these settings: {values}.")
    head = [f"settings of {tracker}", *(line for text in remarks for line in textwrap.wrap(text, 100))]
    return "\n".join([*(f"# {line}" for line in head), "", *_tables(tuned)])


def _tables(tuned: Mapping[str, Any]) -> Iterable[str]:
    groups: dict[str, list[tuple[str, Any]]] = {}
    for name, value in sorted(tuned.items()):
        group, _, leaf = name.rpartition(".")
        groups.setdefault(group, []).append((leaf, value))
    for group in sorted(groups):
        if group:
            yield f"[{group}]"
        yield from (f"{leaf} = {json.dumps(value)}" for leaf, value in groups[group])
        yield ""


def _listed(blocks: Sequence[str]) -> str:
    """Blocks by their sequences, with their number."""
    names = list(dict.fromkeys(_scene(text) for text in blocks))
    shown = ", ".join(names[:4]) + (f" and {len(names) - 4} more" if len(names) > 4 else "")
    return f"{len(blocks)} block{'s' * (len(blocks) != 1)} of {shown}"


def _scene(block: str) -> str:
    """A block's text without its options but for the scene."""
    name, _, query = block.partition("?")
    return "?".join([name, *(option for option in query.split("&") if option.startswith("scene="))])
