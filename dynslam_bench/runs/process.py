"""A child process and its connection, whichever way it was started."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
from abc import ABC, abstractmethod
from multiprocessing.connection import Connection, Pipe
from pathlib import Path

from .forkserver import SERVER, child_environment

_PROC = Path("/proc/self")
START_VARIABLE = "DYNSLAM_BENCH_START"
"""``fork`` or ``fresh``: how children start. Forking is the default on Linux; macOS' libraries do not survive it."""


class Child(ABC):
    """A running child; `connection` speaks to it.

    Args:
        connection: The parent's end.
        pid: Its process id, 0 until it is known.
    """

    def __init__(self, connection: Connection) -> None:
        self.connection = connection
        self.pid = 0

    def wait_handle(self) -> int | None:
        """A file descriptor that becomes readable when the child ends, if there is one."""
        return None

    @abstractmethod
    def poll(self) -> int | None:
        """Its exit code (minus the signal's number if one ended it), None while it runs."""

    def kill(self) -> None:
        """End it, with everything that it started."""
        if self.pid and self.poll() is None:
            for end in (os.killpg, os.kill):
                with contextlib.suppress(ProcessLookupError, PermissionError):
                    end(self.pid, signal.SIGKILL)

    def close(self) -> None:
        """Kill it if it still runs, and release what belongs to it."""
        self.kill()
        self.connection.close()


class ForkedChild(Child):
    """A child of the fork server."""

    def __init__(self) -> None:
        ours, theirs = Pipe()
        try:
            self._status_fd = SERVER.spawn(theirs.fileno())
        except BaseException:
            ours.close()
            raise
        finally:
            theirs.close()
        super().__init__(ours)
        self._buffer = b""
        self._exit: int | None = None
        os.set_blocking(self._status_fd, False)

    def wait_handle(self) -> int | None:
        """The read end of the status pipe, until the exit code is known."""
        return self._status_fd if self._exit is None else None

    def poll(self) -> int | None:
        """Its exit code as the server reported it, None while it runs."""
        while self._exit is None:
            try:
                data = os.read(self._status_fd, 4096)
            except BlockingIOError:
                break
            if not data:  # the server is gone, and its children with it
                self._exit = -signal.SIGKILL
                break
            self._buffer += data
            *lines, self._buffer = self._buffer.split(b"\n")
            for line in lines:
                message = json.loads(line)
                self.pid = message.get("pid", self.pid)
                self._exit = message.get("exit", self._exit)
        return self._exit

    def close(self) -> None:
        """Kill it if it still runs, and release the pipes."""
        super().close()
        if self._status_fd >= 0:
            os.close(self._status_fd)
            self._status_fd = -1


class FreshChild(Child):
    """A child in an interpreter of its own."""

    def __init__(self) -> None:
        ours, theirs = Pipe()
        command = [sys.executable, "-m", "dynslam_bench.runs.child", str(theirs.fileno())]
        try:
            self._process = subprocess.Popen(
                command, pass_fds=[theirs.fileno()], stdin=subprocess.DEVNULL, env=child_environment()
            )
        except BaseException:
            ours.close()
            raise
        finally:
            theirs.close()
        super().__init__(ours)
        self.pid = self._process.pid

    def poll(self) -> int | None:
        """Its exit code, None while it runs."""
        return self._process.poll()

    def close(self) -> None:
        """Kill it if it still runs, and reap it."""
        super().close()
        self._process.wait()


def start_child() -> Child:
    """Start a child that waits for its job.

    Raises:
        RunError: The fork server cannot be started.
    """
    how = os.environ.get(START_VARIABLE) or ("fork" if sys.platform == "linux" else "fresh")
    return FreshChild() if how == "fresh" else ForkedChild()


def resident_mb(pid: int) -> float:
    """Resident memory in MB of a process and (on Linux) its descendants; 0 if it is gone."""
    if _PROC.is_dir():
        return sum(_linux_rss_mb(member) for member in _group_members(pid))
    result = subprocess.run(["ps", "-o", "rss=", "-p", str(pid)], capture_output=True, text=True, check=False)
    return sum(float(line) for line in result.stdout.split()) * 1024 / 1e6


def _group_members(pid: int) -> list[int]:
    """The process and its descendants, by way of the kernel's lists of children."""
    members, fresh = [pid], [pid]
    while fresh:
        parent = fresh.pop()
        for children in Path(f"/proc/{parent}/task").glob("*/children"):
            try:
                found = [int(text) for text in children.read_text().split()]
            except OSError:
                continue
            members += found
            fresh += found
    return members


def _linux_rss_mb(pid: int) -> float:
    try:
        pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    except (OSError, IndexError, ValueError):
        return 0.0
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6
