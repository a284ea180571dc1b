"""A process that has imported everything heavy and forks the children of runs: 10 ms instead of seconds each.

It is told what to do over a Unix socket: one byte with two file descriptors, the child's end of its connection and a
pipe on which the server answers with the child's process id and, later, its wait status, a JSON line each. When the
socket closes, because the parent ended in whatever way, the server kills its children and goes. A run's end is reported
only after everything that it had started has ended, too.

(Python's own ``forkserver`` re-imports the caller's main script in every child and may not be used in daemonic
processes; this one does neither.)
"""

from __future__ import annotations

import atexit
import contextlib
import importlib
import json
import os
import selectors
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Collection
from multiprocessing.connection import Connection
from typing import NoReturn

from dynslam_bench.core.errors import RunError

from .family import adopt_orphans, children, end_descendants, end_family

PRELOADED = (
    "numpy", "scipy.spatial.transform", "cv2", "torch", "numba", "gtsam", "gymnasium", "dynslam_bench.envs",
    "dynslam_bench.evaluation.evaluate", "dynslam_bench.slam.pipeline", "dynslam_bench.slam.backend",
    "dynslam_bench.flow.build_flow", "dynslam_bench.segmentation.masks.schedule", "dynslam_bench.runs.process.child",
)  # fmt: skip
THREAD_VARIABLES = ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS", "BLIS_NUM_THREADS")
"""Set to 1 before anything is imported: BLAS must not spin up threads of its own beside the run's."""


class ForkServer:
    """The parent's end; one server a process, started when first used and restarted if it died."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._socket: socket.socket | None = None
        self._process: subprocess.Popen[bytes] | None = None
        self._owner = 0

    def spawn(self, child_fd: int) -> int:
        """Fork a child that runs `child.main` on a connection.

        Args:
            child_fd: The child's end of its connection; the caller closes it afterwards.

        Returns:
            The read end of the status pipe.

        Raises:
            RunError: The server cannot be started.
        """
        read_fd, write_fd = os.pipe()
        try:
            with self._lock:
                for attempt in (1, 2):
                    try:
                        socket.send_fds(self._connected(), [b"f"], [child_fd, write_fd])
                        return read_fd
                    except OSError as error:
                        self._close()
                        if attempt == 2:
                            raise RunError(f"the fork server does not answer: {error}") from error
            raise AssertionError("unreachable")
        except BaseException:
            os.close(read_fd)
            raise
        finally:
            os.close(write_fd)

    def close(self) -> None:
        """Stop the server and every child of it."""
        with self._lock:
            self._close()

    def _connected(self) -> socket.socket:
        if self._owner != os.getpid():  # after a fork the parent's server is not ours
            self._socket, self._process = None, None
        if self._socket is not None and self._process is not None and self._process.poll() is None:
            return self._socket
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_STREAM)
        command = [sys.executable, "-m", "dynslam_bench.runs.process.server", str(theirs.fileno())]
        try:
            self._process = subprocess.Popen(
                command, pass_fds=[theirs.fileno()], stdin=subprocess.DEVNULL, env=child_environment()
            )
        except OSError as error:
            ours.close()
            raise RunError(f"cannot start {sys.executable}: {error.strerror}") from error
        finally:
            theirs.close()
        self._socket, self._owner = ours, os.getpid()
        return ours

    def _close(self) -> None:
        if self._socket is not None and self._owner == os.getpid():
            self._socket.close()
            if self._process is not None:
                try:
                    self._process.wait(timeout=1)
                except subprocess.TimeoutExpired:  # still importing
                    self._process.kill()
                    self._process.wait()
        self._socket, self._process = None, None


def child_environment() -> dict[str, str]:
    """The environment of a fresh interpreter: BLAS on one thread, and this process's import path."""
    environment = dict(os.environ)
    environment |= {name: "1" for name in THREAD_VARIABLES}
    environment["PYTHONPATH"] = os.pathsep.join(path for path in sys.path if path)
    return environment


SERVER = ForkServer()
atexit.register(SERVER.close)


def serve(fd: int) -> None:
    """The server's loop, until the socket `fd` closes."""
    _preload()
    adopt_orphans()  # what a run leaves behind becomes a child of this process, and is ended
    own = frozenset(children(os.getpid()))
    control = socket.socket(fileno=fd)
    wake_read, wake_write = os.pipe()
    for end in (wake_read, wake_write):
        os.set_blocking(end, False)
    signal.signal(signal.SIGCHLD, lambda *_: None)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.set_wakeup_fd(wake_write, warn_on_full_buffer=False)
    selector = selectors.DefaultSelector()
    selector.register(control, selectors.EVENT_READ)
    selector.register(wake_read, selectors.EVENT_READ)
    runs: dict[int, int] = {}
    while True:
        for key, _ in selector.select():
            if key.fileobj is control:
                message, fds, _, _ = socket.recv_fds(control, 1, 2)
                if not message:
                    _end(runs)
                    return
                connection_fd, status_fd = fds
                pid = os.fork()
                if pid == 0:
                    selector.close()
                    for inherited in (fd, wake_read, wake_write, status_fd, *runs.values()):
                        os.close(inherited)
                    control.detach()
                    _become_child(connection_fd)
                os.close(connection_fd)
                _tell(status_fd, {"pid": pid})
                runs[pid] = status_fd
            else:
                with contextlib.suppress(BlockingIOError):
                    os.read(wake_read, 4096)
        _reap(runs, own)


def _reap(runs: dict[int, int], own: Collection[int]) -> None:
    """Bury the runs that have ended, end what they left behind, then report them."""
    ended: list[tuple[int, int]] = []
    for pid in list(runs):
        with contextlib.suppress(ChildProcessError):
            buried, status = os.waitpid(pid, os.WNOHANG)
            if buried:
                ended.append((runs.pop(pid), status))
    if ended:
        end_descendants({*runs, *own})
    for status_fd, status in ended:
        _tell(status_fd, {"exit": os.waitstatus_to_exitcode(status)})
        os.close(status_fd)


def _end(runs: dict[int, int]) -> None:
    for pid in runs:
        end_family(pid)
    end_descendants()


def _tell(fd: int, message: dict[str, int]) -> None:
    with contextlib.suppress(OSError):  # the parent may have lost interest
        os.write(fd, json.dumps(message).encode() + b"\n")


def _become_child(connection_fd: int) -> NoReturn:
    signal.set_wakeup_fd(-1)
    signal.signal(signal.SIGCHLD, signal.SIG_DFL)
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    code = 1
    try:
        from .child import main

        code = main(Connection(connection_fd))
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)


def _preload() -> None:
    for name in PRELOADED:
        with contextlib.suppress(Exception):  # the child meets it again and says what is wrong
            importlib.import_module(name)


if __name__ == "__main__":
    serve(int(sys.argv[1]))
    os._exit(0)  # nothing is left to clean up, and the libraries take long to say goodbye
