"""The process above a run: it adopts and ends whatever the run leaves behind, also when the one above it is killed.

Only if two of these processes (server, keeper, run) are killed at the same moment can anything outlive a run.
"""

from __future__ import annotations

import contextlib
import os
import resource
import signal
import sys
from collections.abc import Callable
from multiprocessing.connection import Connection

from dynslam_bench.core.temporary import sweep

from .child import main
from .family import adopt_orphans, die_with_parent, end_descendants

_WATCHED = (signal.SIGCHLD, signal.SIGTERM)


def keep(connection_fd: int, told: Callable[[int], None] | None = None) -> int:
    """Make the run in a process below this one.

    Args:
        connection_fd: The run's end of the connection to the parent.
        told: Called in this process with the run's process id, and in the run's with 0; None where this process was
            started by a thread, whose end would pass for the parent's.

    Returns:
        The run's exit code; does not return if a signal ended the run, but ends by the same one.
    """
    if not adopt_orphans():
        return main(Connection(connection_fd))
    signal.pthread_sigmask(signal.SIG_BLOCK, _WATCHED)
    if told is not None:
        with contextlib.suppress(OSError):
            os.setsid()
        die_with_parent(signal.SIGTERM)
    pid = os.fork()
    if told is not None:
        told(pid)
    if pid == 0:
        signal.pthread_sigmask(signal.SIG_UNBLOCK, _WATCHED)
        code = 1
        try:
            code = main(Connection(connection_fd))
        finally:
            sys.stdout.flush()
            sys.stderr.flush()
            os._exit(code)
    os.close(connection_fd)
    code = _outlast(pid)
    end_descendants()
    sweep()
    if code < 0:
        _end_by(-code)
    return code


def _outlast(pid: int) -> int:
    """Wait for the run's end, and bury what it has orphaned meanwhile; ends early when the parent has ended."""
    code = None
    while code is None:
        if signal.sigwait(_WATCHED) == signal.SIGTERM:
            return -signal.SIGTERM
        with contextlib.suppress(ChildProcessError):  # nobody is left
            while (buried := os.waitpid(-1, os.WNOHANG))[0]:
                if buried[0] == pid:
                    code = os.waitstatus_to_exitcode(buried[1])
    return code


def _end_by(number: int) -> None:
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    signal.pthread_sigmask(signal.SIG_UNBLOCK, _WATCHED)
    if number not in (signal.SIGKILL, signal.SIGSTOP):
        signal.signal(number, signal.SIG_DFL)
    os.kill(os.getpid(), number)


if __name__ == "__main__":
    os._exit(keep(int(sys.argv[1])))  # threads that a tracker left running must not hold it up
