"""How much memory a run may take where nobody said."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path

DEFAULT_SHARE = 0.8
"""Of the machine's memory, for all runs at a time together."""
_CGROUP_LIMITS = (Path("/sys/fs/cgroup/memory.max"), Path("/sys/fs/cgroup/memory/memory.limit_in_bytes"))


def machine_memory_mb() -> float:
    """Main memory in MB: the machine's, or the container's if that is less."""
    amounts = [float(os.sysconf("SC_PAGE_SIZE")) * os.sysconf("SC_PHYS_PAGES")]
    for file in _CGROUP_LIMITS:
        with contextlib.suppress(OSError, ValueError):  # there is none, or it says "max"
            amounts.append(float(file.read_text()))
    return min(amounts) / 1e6


def memory_limit(asked_mb: float | None, at_a_time: int = 1) -> tuple[float | None, str]:
    """The limit in MB that is in force, and where it comes from.

    Args:
        asked_mb: What was asked for; None for the default, 0 for no limit.
        at_a_time: Runs that share the machine, for the default.

    Returns:
        None and "" without a limit.
    """
    if asked_mb is not None:
        return (asked_mb, "") if asked_mb else (None, "")
    whole = machine_memory_mb()
    shared = f", shared by {at_a_time} runs at a time" if at_a_time > 1 else ""
    source = f"by default {100 * DEFAULT_SHARE:.0f} % of this machine's {whole:.0f} MB{shared}"
    return DEFAULT_SHARE * whole / at_a_time, source
