"""The fork server: a process that has imported everything heavy and forks the children of runs in 10 ms each.

The parent asks for a child over a Unix socket: one byte with two file descriptors, the child's end
of its connection and a pipe. On the pipe the server answers with the child's process id, with 0
once that process has ended, and with its exit code, a JSON line each. The exit code is reported
after all processes that the run had started have ended and its temporary files are removed. When
the socket closes, because the parent has ended, the server kills its children and ends. It has a
session of its own, so that signals of a terminal do not reach it before.

Where forking is not safe (macOS) the server starts each child in a fresh interpreter instead.

A tracker may start processes, put them into sessions of their own and forget them. On Linux the
fork server and each run are subreapers (``prctl(2)``): they become the parents of the orphans below
them, so that the tree stays complete. ``multiprocessing``'s own fork server re-imports the caller's
main script and may not be used in daemonic processes, see ``docs/decisions/fork-server.md``.
"""

import atexit
import contextlib
import gc
import importlib
import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from multiprocessing.connection import Connection, Pipe, wait
from typing import Any

import psutil

from dynslam_bench.core import InfrastructureError, sweep
from dynslam_bench.core.module_graph import module_graph
from dynslam_bench.core.plugins import module_command
from dynslam_bench.core.reads import ImportPath
from dynslam_bench.runs.process.child import main as make_run
from dynslam_bench.runs.process.jobs import THREAD_VARIABLES
from dynslam_bench.runs.process.jobs import make_job as make_job
from dynslam_bench.runs.process.process_trees import (
    adopt_orphans,
    end_children,
    end_processes,
    end_tree,
)

_CHILD = "dynslam_bench.runs.process.child"
"""The module that a fresh interpreter runs."""
PRELOADED = (
    "numpy",
    "scipy.spatial.transform",
    "cv2",
    "torch",
    "numba",
    "gymnasium",
    "dynslam_bench.envs.slam_env",
    "dynslam_bench.evaluation.evaluate",
    "dynslam_bench.slam.pipeline",
    "dynslam_bench.slam.backend",
    "dynslam_bench.features.orb",
    "dynslam_bench.flow.moth_flame",
    "dynslam_bench.segmentation.schedule",
    "dynslam_bench.runs.loop",
    "dynslam_bench.trackers.registry",
    "dynslam_bench.sequences.synthetic.sequence",
)
"""Modules that the server imports before it forks."""
START_VARIABLE = "DYNSLAM_BENCH_START"
"""``fork`` or ``fresh``: how children start. Forking is the default on Linux; macOS' libraries do not survive it."""
_CLOSE_S = 10.0
"""Seconds that `Child.close` waits for the report of the child's end."""


class ForkServer:
    """The parent's end; the server is started when first used, and again if it has died.

    Args:
        start: ``fork`` or ``fresh``; None for what this process' environment says.
    """

    def __init__(self, start: str | None = None) -> None:
        self._start = default_start() if start is None else start
        self._lock = threading.Lock()
        self._running: tuple[socket.socket, subprocess.Popen[bytes]] | None = None
        self._owner = 0

    def spawn(self, child_fd: int) -> int:
        """Start a child that makes a run over a connection.

        Args:
            child_fd: The child's end of its connection; the caller closes it afterwards.

        Returns:
            The read end of the status pipe.

        Raises:
            InfrastructureError: The server cannot be started.
        """
        read_fd, write_fd = os.pipe()
        request = ([b"c"], [child_fd, write_fd])
        try:
            with self._lock:
                try:
                    socket.send_fds(self._connected(), *request)
                except OSError:  # it has just died
                    self._close()
                    socket.send_fds(self._connected(), *request)
            return read_fd
        except OSError as error:
            os.close(read_fd)
            raise InfrastructureError(
                f"the fork server cannot be started or does not answer: {error}"
            ) from error
        finally:
            os.close(write_fd)

    def close(self) -> None:
        """Stop the server and every child of it."""
        with self._lock:
            self._close()

    def _connected(self) -> socket.socket:
        """The socket to a server that runs; starts one where there is none."""
        is_ours = self._owner == os.getpid()  # after a fork the parent's server is not
        if self._running is not None and is_ours and self._running[1].poll() is None:
            return self._running[0]
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_STREAM)
        with theirs:
            process = subprocess.Popen(
                [*module_command(__name__), str(theirs.fileno()), self._start],
                pass_fds=[theirs.fileno()],
                stdin=subprocess.DEVNULL,
                env=os.environ | dict.fromkeys(THREAD_VARIABLES, "1"),
                start_new_session=True,
            )
        self._owner = os.getpid()
        self._running = (ours, process)
        return ours

    def _close(self) -> None:
        """Stop the server; that of the process that this one was forked from is left alone."""
        if self._running is not None and self._owner == os.getpid():
            control, process = self._running
            control.close()
            try:
                process.wait(timeout=1)
            except subprocess.TimeoutExpired:  # still importing
                process.kill()
                process.wait()
        self._running = None


def default_start() -> str:
    """Start method of children: what `START_VARIABLE` says, or what is safe on this system."""
    return os.environ.get(START_VARIABLE) or ("fork" if sys.platform == "linux" else "fresh")


SERVERS = {start: ForkServer(start) for start in ("fork", "fresh")}
"""The fork servers that all runs of this process share."""
for _server in SERVERS.values():
    atexit.register(_server.close)


class Child:
    """A child of a fork server, which waits for its job.

    Args:
        server: The fork server; None for the one that all runs share.

    Attributes:
        connection: The parent's end.
        pid: Its process id; 0 until it is known, and when the process has ended: the system may
            give it to another.
        members: Its process tree when it was last looked at; for the case that the server is
            killed.
        lost: Why nothing is known of its end, if that is so: the server has died, or cannot start a
            process.
        server_died: Whether the server has died.

    Raises:
        InfrastructureError: The fork server cannot be started.
    """

    def __init__(self, server: ForkServer | None = None) -> None:
        self.connection, theirs = Pipe()
        with theirs:
            self.status_fd = (server or SERVERS[default_start()]).spawn(theirs.fileno())
        os.set_blocking(self.status_fd, False)
        self.pid = 0
        self.lost = ""
        self.server_died = False
        self.members: list[psutil.Process] = []
        self._buffer = b""
        self._exit: int | None = None

    def poll(self) -> int | None:
        """Exit code of the child (minus the signal's number if one ended it), None while it runs."""
        while self._exit is None:
            try:
                data = os.read(self.status_fd, 4096)
            except BlockingIOError:
                break
            if not data:
                self._exit = -signal.SIGKILL
                self.server_died = not self.lost
                self.lost = self.lost or "the fork server was ended from outside"
                break
            # a line may come in two parts
            *lines, self._buffer = (self._buffer + data).split(b"\n")
            for message in map(json.loads, lines):
                self.pid = message.get("pid", self.pid)
                self._exit = message.get("exit", self._exit)
                self.lost = message.get("refused", self.lost)
        return self._exit

    def kill(self) -> None:
        """End it, with everything that it started."""
        # in this order: the answer may be that the process has ended
        if self.poll() is None and self.pid:
            end_tree(self.pid)

    def close(self) -> None:
        """Kill it if it still runs, wait until it and all that it started have ended, and release the pipes."""
        self.kill()
        self.connection.close()
        deadline = time.monotonic() + _CLOSE_S
        while self.poll() is None and time.monotonic() < deadline:
            wait([self.status_fd], 0.1)
        os.close(self.status_fd)
        if self.lost:
            end_processes(self.members)
            sweep()


class _Server:
    """The server's loop: it waits for requests of the parent and for ends of children; SIGTERM ends it.

    Args:
        control: The server's end of the socket to the parent.
        start: ``fork`` or ``fresh``.
    """

    def __init__(self, control: socket.socket, start: str) -> None:
        self._control = control
        self._start = start
        # processes that libraries have started when they were imported
        self._helpers = frozenset(child.pid for child in psutil.Process().children())
        # write ends of the status pipes, by the process id of each run
        self._status_fds: dict[int, int] = {}
        # signals write into a pipe, which wakes the loop
        self._wake_fds = os.pipe()
        for end in self._wake_fds:
            os.set_blocking(end, False)
        signal.set_wakeup_fd(self._wake_fds[1], warn_on_full_buffer=False)
        signal.signal(signal.SIGCHLD, lambda *_: None)
        signal.signal(signal.SIGTERM, lambda *_: sys.exit())

    def run(self) -> None:
        """Serve until the parent closes the socket or SIGTERM comes; end all children then."""
        with contextlib.suppress(SystemExit):
            while True:
                ready = wait([self._control, self._wake_fds[0]])
                if self._control in ready and not self._accept():
                    break
                with contextlib.suppress(BlockingIOError):
                    os.read(self._wake_fds[0], 4096)
                self._reap()
        signal.signal(signal.SIGTERM, signal.SIG_IGN)  # what follows ends by itself
        for pid in self._status_fds:
            end_tree(pid)
        end_children()
        sweep()

    def _accept(self) -> bool:
        """Start the child that is asked for; False if the parent has closed the socket."""
        message, fds, _, _ = socket.recv_fds(self._control, 1, 2)
        if not message:
            return False
        connection_fd, status_fd = fds
        os.set_inheritable(status_fd, False)
        try:
            pid = (
                self._fork(connection_fd, status_fd)
                if self._start == "fork"
                else _spawn(connection_fd)
            )
        except OSError as error:
            _tell(status_fd, {"refused": f"no process can be started: {error.strerror}"})
            os.close(status_fd)
        else:
            _tell(status_fd, {"pid": pid})
            self._status_fds[pid] = status_fd
        os.close(connection_fd)
        return True

    def _fork(self, connection_fd: int, status_fd: int) -> int:
        """Fork a child, which does not return from here."""
        pid = os.fork()
        if pid:
            return pid
        code = 1
        try:
            signal.set_wakeup_fd(-1)
            for number in (signal.SIGINT, signal.SIGHUP, signal.SIGTERM, signal.SIGCHLD):
                signal.signal(number, signal.SIG_DFL)
            self._control.close()
            for inherited in (status_fd, *self._wake_fds, *self._status_fds.values()):
                os.close(inherited)
            code = make_run(Connection(connection_fd))
        finally:
            os._exit(code)

    def _reap(self) -> None:
        """Reap the runs that have ended, end what they have left behind, then report them."""
        waited = [os.waitpid(pid, os.WNOHANG) for pid in self._status_fds]
        # status pipe and exit status of each run that has ended
        ended = [(self._status_fds.pop(pid), status) for pid, status in waited if pid]
        # at once: the system may give the number to another process, which is not to be killed
        for status_fd, _ in ended:
            _tell(status_fd, {"pid": 0})
        if ended:
            end_children({*self._status_fds, *self._helpers})
            sweep()
        for status_fd, status in ended:
            _tell(status_fd, {"exit": os.waitstatus_to_exitcode(status)})
            os.close(status_fd)


def _spawn(connection_fd: int) -> int:
    """Start a child in a fresh interpreter."""
    os.set_inheritable(connection_fd, True)
    command = [*module_command(_CHILD), str(connection_fd)]
    return os.posix_spawn(
        sys.executable, command, os.environ, setsigdef=[signal.SIGINT, signal.SIGHUP]
    )


def _tell(fd: int, message: dict[str, Any]) -> None:
    """Write a line of JSON into the status pipe of a run."""
    with contextlib.suppress(OSError):  # the parent may have closed its end
        os.write(fd, json.dumps(message).encode() + b"\n")


def serve(fd: int, start: str) -> None:
    """Serve until the socket `fd` closes or SIGTERM comes."""
    control = socket.socket(fileno=fd)
    for ignored in (signal.SIGINT, signal.SIGHUP):
        signal.signal(ignored, signal.SIG_IGN)
    if start == "fork":
        _preload()
    adopt_orphans()
    _Server(control, start).run()


def _preload() -> None:
    """Load what the children need, so that a forked one has it at once."""
    for name in PRELOADED:
        with contextlib.suppress(Exception):  # the child meets it again and says what is wrong
            importlib.import_module(name)
    with contextlib.suppress(Exception):  # what is not loaded here each child loads itself
        importlib.import_module("dynslam_bench.core.kernel_cache").load_kernels()
        # remembered: the keys of the children's stage caches are of the code that is loaded here
        module_graph()
        # it dates what was loaded here; children that record what plug-ins read find the
        # distributions read already
        importlib.import_module("dynslam_bench.runs.process.recorder")
        ImportPath(sys.path).read_all()
    # the children's garbage collector passes over what is here: it would copy nearly all of it
    gc.freeze()


if __name__ == "__main__":
    serve(int(sys.argv[1]), sys.argv[2])
    os._exit(0)  # nothing is left to clean up, and libraries take long to end
