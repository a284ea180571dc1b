"""A process and everything it started: finding the members, their memory, ending them, and those who slipped away.

A tracker may start processes, put them into sessions of their own and forget them. On Linux the process that started a
run adopts what the run leaves behind (it is a *subreaper*), so that nothing outlives its run; elsewhere only the run's
own process group is ended.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Collection
from pathlib import Path

_PROC = Path("/proc")
_SET_PARENT_DEATH_SIGNAL, _SET_CHILD_SUBREAPER = 1, 36
_SWEEP_S = 5.0


def die_with_parent(by: int = signal.SIGKILL) -> None:
    """Ask Linux for that signal when the one that forked this process ends; elsewhere the closing connection has to do.

    For Linux the parent is the thread that forked.
    """
    _prctl(_SET_PARENT_DEATH_SIGNAL, by)


def adopt_orphans() -> bool:
    """Become the parent of every descendant whose own parent ends; False where the system cannot do that."""
    return _prctl(_SET_CHILD_SUBREAPER, 1)


def children(pid: int) -> list[int]:
    """The direct children of a process, by the kernel's lists; empty where there are none to read."""
    found: list[int] = []
    for listing in (_PROC / str(pid) / "task").glob("*/children"):
        with contextlib.suppress(OSError, ValueError):
            found += [int(text) for text in listing.read_text().split()]
    return found


def family(pid: int) -> list[int]:
    """The process and all its descendants."""
    members, fresh = [pid], [pid]
    while fresh:
        found = [child for child in children(fresh.pop()) if child not in members]
        members += found
        fresh += found
    return members


def end_family(pid: int) -> None:
    """Kill a process with its group and all its descendants, wherever these have put themselves."""
    members = family(pid) if _PROC.is_dir() else [pid]
    _signal(os.killpg, pid)
    for member in members:
        _signal(os.kill, member)


def end_descendants(keep: Collection[int] = ()) -> int:
    """Kill and bury all children of this process but those in `keep`, and theirs, until there are none.

    With `adopt_orphans` in force this reaches everything that was ever started below this process.

    Returns:
        How many there were.
    """
    own = os.getpid()
    ended: set[int] = set()
    deadline = time.monotonic() + _SWEEP_S
    while time.monotonic() < deadline:
        strangers = [child for child in children(own) if child not in keep]
        if not strangers:
            break
        for stranger in strangers:
            for member in family(stranger):
                ended.add(member)
                _signal(os.kill, member)
        buried = [stranger for stranger in strangers if _bury(stranger)]
        if not buried:
            time.sleep(0.002)
    return len(ended)


def memory_mb(pid: int) -> float:
    """Memory in MB of a process with its descendants, each page counted once; 0 if it is gone.

    For one process its resident memory. Of several the larger of two values, both of which are at most the truth: the
    resident memory of the first, and the sum of the proportional ones (a page that n processes share counts 1/n each).
    Where the system states no proportional memory, resident memory is added up instead.
    """
    if not _PROC.is_dir():
        result = subprocess.run(["ps", "-o", "rss=", "-p", str(pid)], capture_output=True, text=True, check=False)
        return sum(float(line) for line in result.stdout.split()) * 1024 / 1e6
    first, *others = family(pid)
    resident = _resident_mb(first)
    if not others:
        return resident
    return max(resident, sum(map(_proportional_mb, (first, *others))))


def _resident_mb(pid: int) -> float:
    try:
        pages = int((_PROC / str(pid) / "statm").read_text().split()[1])
    except (OSError, IndexError, ValueError):
        return 0.0
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def _proportional_mb(pid: int) -> float:
    try:
        lines = (_PROC / str(pid) / "smaps_rollup").read_text().splitlines()
    except OSError:
        return _resident_mb(pid)
    for line in lines:
        if line.startswith("Pss:"):
            return int(line.split()[1]) * 1024 / 1e6
    return 0.0


def _bury(pid: int) -> bool:
    try:
        return os.waitpid(pid, os.WNOHANG)[0] != 0
    except ChildProcessError:
        return True


def _signal(send: Callable[[int, int], None], target: int) -> None:
    with contextlib.suppress(ProcessLookupError, PermissionError):
        send(target, signal.SIGKILL)


def _prctl(option: int, value: int) -> bool:
    if sys.platform != "linux":
        return False
    try:
        return bool(ctypes.CDLL(None, use_errno=True).prctl(option, value, 0, 0, 0) == 0)
    except (OSError, AttributeError):
        return False


# How much memory a run may take where nobody said.

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
