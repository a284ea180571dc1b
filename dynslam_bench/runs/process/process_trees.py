"""Process trees: their members, their end, and the adoption of orphans."""

import contextlib
import ctypes
import os
import signal
import sys
import time
from collections.abc import Collection, Iterable

import psutil

_SET_PARENT_DEATH_SIGNAL = 1
"""``PR_SET_PDEATHSIG`` of ``prctl(2)``."""
_SET_CHILD_SUBREAPER = 36
"""``PR_SET_CHILD_SUBREAPER`` of ``prctl(2)``."""
_END_S = 5.0
"""Seconds for which `end_children` goes on."""


def adopt_orphans(*, die_with_parent: bool = False) -> None:
    """On Linux become the parent of every descendant whose own parent ends.

    Args:
        die_with_parent: Whether this process is killed when the thread that forked it ends;
            elsewhere than on Linux the closed connection has to do.
    """
    if sys.platform == "linux":
        prctl = ctypes.CDLL(None).prctl
        prctl(_SET_CHILD_SUBREAPER, 1, 0, 0, 0)
        if die_with_parent:
            prctl(_SET_PARENT_DEATH_SIGNAL, signal.SIGKILL, 0, 0, 0)


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
