"""The supervisor of a child: its messages, its limits, its end, and the size of its log."""

from __future__ import annotations

import json
import os
import signal
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from multiprocessing.connection import wait
from pathlib import Path
from typing import Any

from dynslam_bench.core.errors import InfrastructureError
from dynslam_bench.runs.process.fork_server import Child
from dynslam_bench.runs.process.tree import memory_limit, memory_mb, process_tree
from dynslam_bench.runs.record import Status
from dynslam_bench.runs.spec import Limits

Message = dict[str, Any]
_POLL_S = 0.1
_TREE_S = 0.5
"""Seconds between two looks at the process tree, for which psutil reads the status of all processes."""
_STOP_GRACE_S = 30.0
_FIRST_WARM = 1
"""The first frame after which nothing is loaded or compiled any more: a flow needs two frames before it compiles."""
_END_GRACE_S = 10.0
_SIGNAL_GRACE_S = 0.5
_GO_ON = "the run is not stored; the same command goes on from there"


@dataclass
class Verdict:
    """How a child ended.

    Attributes:
        status: ``ok`` here means that it came to the end of its loop.
        reason: One line.
        final: Its last message.
        peak_memory_mb: Largest memory measured or reported.
        refused: Whether it is no outcome of a tracker: it failed before anything ran, because what was asked for
            cannot be, or something else than the tracker's own code raised.
    """

    status: Status
    reason: str = ""
    final: Message = field(default_factory=dict)
    peak_memory_mb: float = 0.0
    refused: bool = False


def supervise(
    child: Child,
    job: Message,
    limits: Limits,
    on_progress: Callable[[Message], bool] | None = None,
    cancelled: Callable[[], bool] | None = None,
    *,
    tick: Callable[[], None] | None = None,
    at_a_time: int = 1,
    located: bool = True,
) -> Verdict:
    """Give a child its job and supervise it to its end.

    Args:
        child: A child that waits for its job.
        job: The job.
        limits: What it may take.
        on_progress: Called with every ``progress`` message; False asks the child to stop.
        cancelled: Asked all the time; True ends the child at once.
        tick: Called all the time.
        at_a_time: Runs that share the machine, for the default memory limit.
        located: Whether reasons say on which frame it was.

    Returns:
        How it ended. The child has ended, too, and with it everything that it had started.

    Raises:
        InfrastructureError: The child could not do its work, through no fault of that.
    """
    supervisor = _Supervisor(child, limits, on_progress, cancelled, tick, located)
    supervisor.memory_mb, supervisor.memory_source = memory_limit(limits.memory_mb, at_a_time)
    try:
        child.connection.send_bytes(json.dumps(job).encode())
        return supervisor.run()
    except BrokenPipeError:
        return supervisor.verdict_of_end()
    finally:
        child.close()


@dataclass
class _Supervisor:
    child: Child
    limits: Limits
    on_progress: Callable[[Message], bool] | None
    cancelled: Callable[[], bool] | None
    tick: Callable[[], None] | None
    located: bool
    memory_mb: float | None = None
    memory_source: str = ""
    began: float | None = None
    """When the child said that it was ready."""
    last_message: float = field(default_factory=time.monotonic)
    frame: int = -1
    n_frames: int = 0
    final: Message = field(default_factory=dict)
    peak_mb: float = 0.0
    stop_sent: float | None = None
    next_look: float = 0.0
    next_tree: float = 0.0

    def run(self) -> Verdict:
        connection = self.child.connection
        is_open = True
        while True:
            ready = wait([self.child.status_fd, *([connection] if is_open else [])], _POLL_S)
            if connection in ready:
                is_open = self._receive()
            if self.child.poll() is not None:
                while is_open and connection.poll(0):
                    is_open = self._receive()
                return self.verdict_of_end()
            verdict = self._over_limit()
            if verdict is not None:
                self.child.kill()
                return verdict

    def verdict_of_end(self) -> Verdict:
        """The verdict on a child that has ended.

        Raises:
            InfrastructureError: Something beside the run broke.
        """
        final, kind = self.final, self.final.get("type")
        if final.get("infrastructure"):
            raise InfrastructureError(final["infrastructure"], _GO_ON)
        if kind == "done":
            return self._verdict("ok")
        if kind == "stopped":
            return self._verdict("stopped", f"stopped on request after {final['frames']} frames")
        if kind == "failed":
            verdict = self._verdict(final["status"], final["reason"])
            verdict.refused = final.get("data", False) or (final.get("refused", False) and self.frame < 0)
            return verdict
        code = self._exit_code()
        if code < 0 and self._is_cancelled(_SIGNAL_GRACE_S):  # the signal that ends this process ended the child first
            return self._verdict("stopped", f"cancelled{self._where()}")
        if self.child.lost or self.began is None:
            lost = self.child.lost or f"the process that was to make it ended with code {code}"
            raise InfrastructureError(f"the run could not go on: {lost}", _GO_ON)
        return self._verdict("crashed", _reason_of_exit(code) + self._where())

    def _exit_code(self) -> int:
        deadline = time.monotonic() + 5
        while (code := self.child.poll()) is None and time.monotonic() < deadline:
            time.sleep(0.1)
        return -signal.SIGKILL if code is None else code

    def _is_cancelled(self, wait_s: float = 0.0) -> bool:
        end = time.monotonic() + wait_s
        while self.cancelled is not None and not self.cancelled():
            if time.monotonic() >= end:
                return False
            time.sleep(0.02)
        return self.cancelled is not None

    def _receive(self) -> bool:
        """Take a message; False if the connection is closed."""
        try:
            message = json.loads(self.child.connection.recv_bytes())
        except (EOFError, OSError):
            return False
        kind = message["type"]
        self.last_message = time.monotonic()
        if kind == "ready":
            self.began = self.last_message
        elif kind == "started":
            self.n_frames = message["frames"]
        elif kind == "frame":
            self.frame = message["index"]
        elif kind != "progress":
            self.final = message
            self.peak_mb = max(self.peak_mb, message["peak_memory_mb"])
        elif self.on_progress is not None and not self.on_progress(message) and self.stop_sent is None:
            self.stop_sent = time.monotonic()
            try:
                self.child.connection.send_bytes(b"stop")
            except OSError:
                return True  # it has ended, which its status tells
        return True

    def _over_limit(self) -> Verdict | None:
        now, limits, silent_s = time.monotonic(), self.limits, time.monotonic() - self.last_message
        if self.final:
            return self.verdict_of_end() if silent_s > _END_GRACE_S else None
        if self._is_cancelled():
            return self._verdict("stopped", f"cancelled{self._where()}")
        if self.stop_sent is not None and now - self.stop_sent > _STOP_GRACE_S:
            return self._verdict("stopped", f"stopped on request after frame {self.frame}")
        if self.began is None:
            if silent_s > limits.start_s:
                raise InfrastructureError(f"no process for the run within {limits.start_s:g} s", _GO_ON)
            return None
        if limits.time_s is not None and now - self.began > limits.time_s:
            return self._verdict("timeout", f"not done within {limits.time_s:g} s{self._where()}")
        patience_s = limits.start_s if self.frame < _FIRST_WARM else limits.frame_s
        if silent_s > patience_s:
            return self._verdict("timeout", f"no sign of life for {patience_s:g} s{self._where()}")
        if now < self.next_look:
            return None
        self.next_look = now + _POLL_S
        if self.tick is not None:
            self.tick()
        if now >= self.next_tree:
            self.next_tree = now + _TREE_S
            self.child.members = process_tree(self.child.pid) or self.child.members
        used_mb = memory_mb(self.child.members)
        self.peak_mb = max(self.peak_mb, used_mb)
        if self.memory_mb is not None and used_mb > self.memory_mb:
            source = f" ({self.memory_source})" if self.memory_source else ""
            reason = f"{used_mb:.0f} MB resident, the limit is {self.memory_mb:.0f} MB{source}{self._where()}"
            return self._verdict("out-of-memory", reason)
        return None

    def _where(self) -> str:
        if not self.located:
            return ""
        if not self.n_frames:
            return ", before the sequence was open"
        done = "before frame 0 was tracked" if self.frame < 0 else f"after frame {self.frame}"
        return f", {done} of {self.n_frames}"

    def _verdict(self, status: Status, reason: str = "") -> Verdict:
        return Verdict(status, reason, self.final, self.peak_mb)


_SIGNALS = {
    "SIGSEGV": "segmentation fault",
    "SIGABRT": "aborted by a library",
    "SIGFPE": "arithmetic error",
    "SIGILL": "illegal instruction",
    "SIGBUS": "bus error",
    "SIGKILL": "killed from outside; on Linux often because memory ran out",
}


def _reason_of_exit(code: int) -> str:
    if code >= 0:
        return f"the process left with exit code {code}"
    try:
        name = signal.Signals(-code).name
    except ValueError:  # a real-time signal
        name = f"signal {-code}"
    return f"{name} ({_SIGNALS[name]})" if name in _SIGNALS else name


WHOLE = 1 << 20
"""A log of up to so many bytes is kept as it is."""
KEPT = 1 << 18
"""Bytes kept of the beginning and of the end of a longer one."""
_MOST = 1 << 23
"""While the run lasts the file is emptied when it is longer."""


class LogFile:
    """Bounds a file that other processes append to: of a long one its beginning and its end are kept.

    Args:
        path: The file; it may not exist yet.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._head = self._tail = b""
        self._taken = 0

    def look(self) -> None:
        """Empty the file if it has become long, after its first and last bytes were taken; call it often."""
        if self._size() > _MOST:
            self._take()
            os.truncate(self.path, 0)  # the processes append, so that they go on at the new end

    def finish(self) -> None:
        """Write the log as it is kept; no process may write any more."""
        if not self._taken and self._size() <= WHOLE:
            return
        self._take()
        cut = self._taken - len(self._head) - len(self._tail)
        note = f"\n\n[... about {cut / 1e6:.1f} of {self._taken / 1e6:.1f} MB were cut here ...]\n\n"
        self.path.write_bytes(self._head + note.encode() + self._tail)

    def _size(self) -> int:
        try:
            return self.path.stat().st_size
        except OSError:
            return 0

    def _take(self) -> None:
        size = self._size()
        with self.path.open("rb") as file:
            if not self._taken:
                self._head = file.read(KEPT)
            file.seek(max(size - KEPT, 0 if self._taken else len(self._head)))
            self._tail = (self._tail + file.read())[-KEPT:]
        self._taken += size
