"""Process trees: their members, their memory, and how they are ended.

A tracker may start processes, put them into sessions of their own and forget them. On Linux the fork server and each
run are subreapers (``prctl(2)``): they become the parents of the orphans below them, so that the tree stays complete.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import signal
import sys
import time
from collections.abc import Collection, Iterable
from pathlib import Path

import psutil

_SET_PARENT_DEATH_SIGNAL, _SET_CHILD_SUBREAPER = 1, 36
_END_S = 5.0
DEFAULT_SHARE = 0.8
"""Share of the machine's memory that all runs at a time may take together where no limit was given."""
_CGROUP_LIMITS = (Path("/sys/fs/cgroup/memory.max"), Path("/sys/fs/cgroup/memory/memory.limit_in_bytes"))


def die_with_parent() -> None:
    """Ask Linux to kill this process when the thread that forked it ends; elsewhere the closed connection has to do."""
    _prctl(_SET_PARENT_DEATH_SIGNAL, signal.SIGKILL)


def adopt_orphans() -> None:
    """Become the parent of every descendant whose own parent ends, on Linux."""
    _prctl(_SET_CHILD_SUBREAPER, 1)


def _prctl(option: int, value: int) -> None:
    if sys.platform == "linux":
        with contextlib.suppress(OSError, AttributeError):
            ctypes.CDLL(None).prctl(option, value, 0, 0, 0)


def process_tree(pid: int) -> list[psutil.Process]:
    """A process, first, and all its descendants; empty if it has ended."""
    try:
        top = psutil.Process(pid)
        return [top, *top.children(recursive=True)]
    except psutil.Error:
        return []


def end_processes(processes: Iterable[psutil.Process]) -> None:
    """Kill those that still run; a process that has taken the number of one that ended is left alone."""
    for process in processes:
        with contextlib.suppress(psutil.Error):
            process.kill()


def end_tree(pid: int) -> None:
    """Kill a process with its process group and all its descendants, whatever their groups."""
    members = process_tree(pid)
    with contextlib.suppress(ProcessLookupError, PermissionError):
        os.killpg(pid, signal.SIGKILL)
    end_processes(members)


def end_children(keep: Collection[int] = ()) -> None:
    """Kill and reap all descendants of this process but the children in `keep` and their descendants."""
    deadline = time.monotonic() + _END_S
    while time.monotonic() < deadline:
        ending = [child for child in psutil.Process().children() if child.pid not in keep]
        if not ending:
            return
        for child in ending:
            end_processes(process_tree(child.pid))
        psutil.wait_procs(ending, timeout=0.1)


def memory_mb(members: list[psutil.Process]) -> float:
    """Memory in MB of a process tree, each page counted once.

    Of one process this is its resident memory. Of several it is the larger of two lower bounds: the resident memory of
    the first, and the sum of the proportional memories (a page that n processes share counts 1/n in each). Where the
    system states no proportional memory, resident memory is summed.
    """
    if len(members) < 2:
        return sum(_resident_mb(process) for process in members)
    return max(_resident_mb(members[0]), sum(_proportional_mb(process) for process in members))


def _resident_mb(process: psutil.Process) -> float:
    try:
        return float(process.memory_info().rss / 1e6)
    except psutil.Error:
        return 0.0


def _proportional_mb(process: psutil.Process) -> float:
    try:
        return float(process.memory_full_info().pss / 1e6)
    except (psutil.Error, AttributeError):
        return _resident_mb(process)


def machine_memory_mb() -> float:
    """Main memory in MB: the machine's, or the container's if that is less."""
    amounts = [float(psutil.virtual_memory().total)]
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
        return (asked_mb or None), ""
    machine_mb = machine_memory_mb()
    shared = f", shared by {at_a_time} runs at a time" if at_a_time > 1 else ""
    source = f"by default {100 * DEFAULT_SHARE:.0f} % of this machine's {machine_mb:.0f} MB{shared}"
    return DEFAULT_SHARE * machine_mb / at_a_time, source
