"""A child process and its connection, whichever way it was started."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from abc import ABC, abstractmethod
from multiprocessing.connection import Connection, Pipe, wait

from dynslam_bench.core.temporary import sweep

from .family import end_family, family
from .server import SERVER, child_environment

_KEEPER_S = 3.0
_BURIAL_S = 10.0
START_VARIABLE = "DYNSLAM_BENCH_START"
"""``fork`` or ``fresh``: how children start. Forking is the default on Linux; macOS' libraries do not survive it."""


class Child(ABC):
    """A running child; `connection` speaks to it.

    Args:
        connection: The parent's end.
        pid: Its process id, 0 until it is known; on Linux that of its keeper.
        run_pid: That of the run itself, or 0 where it is not known.
        lost: Why nothing is known of its end, if that is so: who was to report it has died itself.
    """

    def __init__(self, connection: Connection) -> None:
        self.connection = connection
        self.pid = 0
        self.run_pid = 0
        self.lost = ""

    def wait_handle(self) -> int | None:
        """A file descriptor that becomes readable when the child ends, if there is one."""
        return None

    @abstractmethod
    def poll(self) -> int | None:
        """Its exit code (minus the signal's number if one ended it), None while it runs."""

    def kill(self) -> None:
        """End it, with everything that it started."""
        if self.pid and self.poll() is None:
            end_family(self.pid)

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
                self._exit, self.lost = -signal.SIGKILL, self.lost or "the fork server was ended from outside"
                break
            self._buffer += data
            *lines, self._buffer = self._buffer.split(b"\n")
            for line in lines:
                message = json.loads(line)
                self.pid = message.get("pid", self.pid)
                self.run_pid = message.get("run", self.run_pid)
                self._exit = message.get("exit", self._exit)
                self.lost = message.get("refused", self.lost)
        return self._exit

    def close(self) -> None:
        """Kill it if it still runs, wait until it and all that it started are buried, and release the pipes."""
        super().close()
        deadline = time.monotonic() + _BURIAL_S
        while self.poll() is None and time.monotonic() < deadline:
            wait([self._status_fd], 0.1)
        if self._status_fd >= 0:
            os.close(self._status_fd)
            self._status_fd = -1


class FreshChild(Child):
    """A child in an interpreter of its own; on Linux below a keeper, see `keeper`."""

    def __init__(self) -> None:
        ours, theirs = Pipe()
        command = [sys.executable, "-m", "dynslam_bench.runs.process.keeper", str(theirs.fileno())]
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

    def kill(self) -> None:
        """End it, with everything that it started; a keeper ends by itself once it has buried them."""
        if self.poll() is not None:
            return
        below = family(self.pid)[1:]
        for member in below:
            with contextlib.suppress(ProcessLookupError, PermissionError):
                os.kill(member, signal.SIGKILL)
        try:
            self._process.wait(_KEEPER_S if below else 0.0)
        except subprocess.TimeoutExpired:
            end_family(self.pid)

    def close(self) -> None:
        """Kill it if it still runs, reap it, end what is left of its process group, and remove its temporary files."""
        super().close()
        self._process.wait()
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(self.pid, signal.SIGKILL)
        sweep()


def start_child() -> Child:
    """Start a child that waits for its job.

    Raises:
        InfrastructureError: The fork server cannot be started.
    """
    how = os.environ.get(START_VARIABLE) or ("fork" if sys.platform == "linux" else "fresh")
    return FreshChild() if how == "fresh" else ForkedChild()
