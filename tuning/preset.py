"""Settings as a TOML preset that ``run --settings`` takes."""

from __future__ import annotations

import json
import textwrap
from collections.abc import Mapping
from typing import Any


def preset_text(settings: Mapping[str, Any], tracker: str, remark: str) -> str:
    """TOML text of overrides, dotted name to value, grouped into tables.

    Args:
        settings: The overrides.
        tracker: For which tracker.
        remark: A line on where they come from.
    """
    lines = [f"# settings of {tracker}", *(f"# {line}" for line in textwrap.wrap(remark, 100)), ""]
    groups: dict[str, list[tuple[str, Any]]] = {}
    for name, value in sorted(settings.items()):
        group, _, leaf = name.rpartition(".")
        groups.setdefault(group, []).append((leaf, value))
    for group in sorted(groups):
        if group:
            lines.append(f"[{group}]")
        lines += [f"{leaf} = {json.dumps(value)}" for leaf, value in groups[group]]
        lines.append("")
    return "\n".join(lines)
