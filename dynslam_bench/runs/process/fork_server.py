"""A process that has imported everything heavy and forks the children of runs: 10 ms instead of seconds each.

It is told what to do over a Unix socket: one byte with two file descriptors, the child's end of its connection and a
pipe on which the server answers with the child's process id and, later, its wait status, a JSON line each. When the
socket closes, because the parent ended in whatever way, the server kills its children and goes. A run's end is reported
only after everything that it had started has ended, too, and its temporary files are gone. The server has a session of
its own: what a terminal sends to all processes at once does not reach it before it has done so.

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
import time
from abc import ABC, abstractmethod
from multiprocessing.connection import Connection, Pipe, wait
from pathlib import Path
from typing import Any, NoReturn

from dynslam_bench.core.errors import InfrastructureError
from dynslam_bench.core.files import sweep
from dynslam_bench.runs.process.tree import adopt_orphans, children, end_descendants, end_family, family

PRELOADED = (
    *("numpy", "scipy.spatial.transform", "cv2", "torch", "numba", "gtsam", "gymnasium"),
    *("dynslam_bench.envs", "dynslam_bench.evaluation.evaluate"),
    *("dynslam_bench.slam.pipeline", "dynslam_bench.slam.backend", "dynslam_bench.flow.registry"),
    *("dynslam_bench.segmentation.schedule", "dynslam_bench.runs.process.child"),
    *("dynslam_bench.runs.loop", "dynslam_bench.trackers.registry"),
)
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
        """Fork a child that makes a run over a connection, see `keeper`.

        Args:
            child_fd: The child's end of its connection; the caller closes it afterwards.

        Returns:
            The read end of the status pipe.

        Raises:
            InfrastructureError: The server cannot be started.
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
                            raise InfrastructureError(f"the fork server does not answer: {error}") from error
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
        command = [sys.executable, "-m", "dynslam_bench.runs.process.fork_server", str(theirs.fileno())]
        try:
            self._process = subprocess.Popen(
                command,
                pass_fds=[theirs.fileno()],
                stdin=subprocess.DEVNULL,
                env=child_environment(),
                start_new_session=True,
            )
        except OSError as error:
            ours.close()
            raise InfrastructureError(f"cannot start {sys.executable}: {error.strerror}") from error
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
    """The server's loop, until the socket `fd` closes or SIGTERM comes."""
    control = socket.socket(fileno=fd)
    for ignored in (signal.SIGINT, signal.SIGHUP):
        signal.signal(ignored, signal.SIG_IGN)
    if not _preload(control):
        return
    adopt_orphans()  # what a run leaves behind becomes a child of this process, and is ended
    _Server(control).run()


class _Server:
    """The runs that are under way, and what wakes the server: the parent, a child's end, a signal."""

    def __init__(self, control: socket.socket) -> None:
        self.control = control
        self.own = frozenset(children(os.getpid()))
        self.runs: dict[int, int] = {}
        self.ending = False
        self.wake_read, self.wake_write = os.pipe()
        for end in (self.wake_read, self.wake_write):
            os.set_blocking(end, False)
        signal.signal(signal.SIGCHLD, lambda *_: None)
        signal.signal(signal.SIGTERM, self._end)
        signal.set_wakeup_fd(self.wake_write, warn_on_full_buffer=False)
        self.selector = selectors.DefaultSelector()
        self.selector.register(control, selectors.EVENT_READ)
        self.selector.register(self.wake_read, selectors.EVENT_READ)

    def _end(self, *_: object) -> None:
        self.ending = True

    def run(self) -> None:
        while not self.ending:
            for key, _ in self.selector.select():
                if key.fileobj is not self.control:
                    with contextlib.suppress(BlockingIOError):
                        os.read(self.wake_read, 4096)
                    self._reap()
                elif not self._accept():
                    self.ending = True
        for pid in self.runs:
            end_family(pid)
        end_descendants()
        sweep()

    def _accept(self) -> bool:
        """Fork the child that is asked for; False when nobody asks any more."""
        message, fds, _, _ = socket.recv_fds(self.control, 1, 2)
        if not message:
            return False
        connection_fd, status_fd = fds
        try:
            pid = os.fork()
        except OSError as error:
            _tell(status_fd, {"refused": f"no process can be started: {error.strerror}"})
            os.close(connection_fd)
            os.close(status_fd)
            return True
        if pid == 0:
            self.selector.close()
            for inherited in (self.wake_read, self.wake_write, *self.runs.values()):
                os.close(inherited)
            self.control.close()
            _become_keeper(connection_fd, status_fd)
        os.close(connection_fd)
        _tell(status_fd, {"pid": pid})
        self.runs[pid] = status_fd
        return True

    def _reap(self) -> None:
        """Bury the runs that have ended, end what they left behind, then report them."""
        ended: list[tuple[int, int]] = []
        for pid in list(self.runs):
            with contextlib.suppress(ChildProcessError):
                buried, status = os.waitpid(pid, os.WNOHANG)
                if buried:
                    ended.append((self.runs.pop(pid), status))
        if ended:
            end_descendants({*self.runs, *self.own})
            sweep()
        for status_fd, status in ended:
            _tell(status_fd, {"exit": os.waitstatus_to_exitcode(status)})
            os.close(status_fd)


def _tell(fd: int, message: dict[str, int] | dict[str, str]) -> None:
    with contextlib.suppress(OSError):  # the parent may have lost interest
        os.write(fd, json.dumps(message).encode() + b"\n")


def _become_keeper(connection_fd: int, status_fd: int) -> NoReturn:
    signal.set_wakeup_fd(-1)
    for number in (signal.SIGCHLD, signal.SIGINT, signal.SIGHUP, signal.SIGTERM):
        signal.signal(number, signal.SIG_DFL)

    def told(pid: int) -> None:
        if pid:
            _tell(status_fd, {"run": pid})
        os.close(status_fd)

    code = 1
    try:
        from dynslam_bench.runs.process.child import keep

        code = keep(connection_fd, told)
    finally:
        os._exit(code)


def _preload(control: socket.socket) -> bool:
    """Import what is heavy; False as soon as the parent is seen to be gone."""
    for name in PRELOADED:
        if _is_closed(control):
            return False
        with contextlib.suppress(Exception):  # the child meets it again and says what is wrong
            importlib.import_module(name)
    return True


def _is_closed(control: socket.socket) -> bool:
    try:
        return control.recv(1, socket.MSG_PEEK | socket.MSG_DONTWAIT) == b""
    except BlockingIOError:
        return False
    except OSError:
        return True


if __name__ == "__main__":
    serve(int(sys.argv[1]))
    os._exit(0)  # nothing is left to clean up, and the libraries take long to say goodbye


# A child process and its connection, whichever way it was started.

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
        command = [sys.executable, "-m", "dynslam_bench.runs.process.child", str(theirs.fileno())]
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


# What a child is told before it begins.


def make_job(work: str, folder: Path | str, **details: Any) -> dict[str, Any]:
    """A job for a child, as JSON takes it.

    Args:
        work: ``module:function`` that does it; called with the job, a function that tells the parent something, and
            one that says whether the parent wants an early end.
        folder: Where the child's log and what it finds go.
        details: What `work` wants to know; ``spec`` with the ``threads`` of the run among it.

    Returns:
        The job; the child does it in this process's working folder, with its environment and import path.
    """
    environment = {name: text for name, text in os.environ.items() if name not in THREAD_VARIABLES}
    surroundings = {"environment": environment, "working_folder": str(Path.cwd()), "path": list(sys.path)}
    return {"work": work, "folder": str(folder), **surroundings, **details}
