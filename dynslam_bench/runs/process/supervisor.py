"""The supervisor of a child: its messages, its limits, its memory, its end, and the size of its log."""

import contextlib
import json
import os
import signal
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from multiprocessing.connection import wait
from pathlib import Path
from typing import Any

import psutil

from dynslam_bench.core import InfrastructureError
from dynslam_bench.runs.process.fork_server import Child
from dynslam_bench.runs.process.process_trees import process_tree
from dynslam_bench.runs.record import Status
from dynslam_bench.runs.spec import Limits

Message = dict[str, Any]
_POLL_S = 0.1
"""Longest wait for a message, and least time between two measurements of the memory."""
_TREE_S = 0.5
"""Seconds between two looks at the process tree, for which psutil reads the status of all processes."""
_STOP_GRACE_S = 30.0
"""A child that was asked to stop is ended after this time."""
_FIRST_WARM = 1
"""The first frame after which nothing is loaded or compiled any more: a flow needs two frames before it compiles."""
_END_GRACE_S = 10.0
"""A child that has sent its last message is ended after this time."""
_SIGNAL_GRACE_S = 0.5
"""Seconds that a signal may take to reach this process after a child was killed."""
_NOT_STORED_HINT = "the run is not stored; the same command goes on from there"
DEFAULT_SHARE = 0.8
"""Share of the machine's memory that all runs at a time may take together where no limit was given."""
_CGROUP_LIMITS = (
    Path("/sys/fs/cgroup/memory.max"),
    Path("/sys/fs/cgroup/memory/memory.limit_in_bytes"),
)


@dataclass
class ProcessEnd:
    """End of a child.

    Attributes:
        status: ``ok`` here means that it came to the end of its loop.
        reason: One line.
        final: Its last message.
        peak_memory_mb: Largest memory measured or reported.
        refused: Whether it is no outcome of a tracker: it failed before anything ran, because what
            was asked for cannot be, or something else than the tracker's own code raised.
    """

    status: Status
    reason: str = ""
    final: Message = field(default_factory=dict)
    peak_memory_mb: float = 0.0
    refused: bool = False


class ServerDiedError(InfrastructureError):
    """The fork server died while a run was made, for example since the run itself has killed it.

    Args:
        where: Where the run was; empty if it had not begun.
    """

    def __init__(self, where: str) -> None:
        super().__init__(
            f"the run could not go on: the fork server was ended from outside{where}",
            _NOT_STORED_HINT,
        )
        self.where = where

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.where,)


def supervise(
    child: Child,
    job: Message,
    limits: Limits,
    on_progress: Callable[[Message], bool] = lambda _: True,
    cancelled: Callable[[], bool] = lambda: False,
    *,
    tick: Callable[[], None] = lambda: None,
    at_a_time: int = 1,
    located: bool = True,
) -> ProcessEnd:
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
        ServerDiedError: The fork server died meanwhile.
        InfrastructureError: The child could not do its work, through no fault of that.
    """
    memory = memory_limit(limits.memory_mb, at_a_time)
    try:
        # the child waits for its job
        with contextlib.suppress(BrokenPipeError):  # it has ended, which its status tells
            child.connection.send_bytes(json.dumps(job).encode())
        return _Supervisor(child, limits, on_progress, cancelled, tick, located, *memory).run()
    finally:
        child.close()


@dataclass
class _Supervisor:
    """Supervises one child; see `supervise` for the arguments.

    Times are those of `time.monotonic`, in seconds.
    """

    child: Child
    limits: Limits
    on_progress: Callable[[Message], bool]
    cancelled: Callable[[], bool]
    tick: Callable[[], None]
    located: bool
    memory_mb: float | None
    memory_source: str
    began: float | None = None
    """Time when the child said that it was ready."""
    last_message: float = field(default_factory=time.monotonic)
    """Time of the last message."""
    frame: int = -1
    """The last frame that was tracked; -1 before the first one."""
    n_frames: int = 0
    """Frames of the sequence; 0 until it is open."""
    final: Message = field(default_factory=dict)
    """The last message of the run; empty until it comes."""
    peak_mb: float = 0.0
    """Largest memory measured or reported."""
    stop_sent: float | None = None
    """Time when the child was asked to stop."""
    next_measurement: float = 0.0
    """Time of the next measurement of memory."""
    next_tree: float = 0.0
    """Time of the next look at the process tree."""

    def run(self) -> ProcessEnd:
        """Take messages until the child has ended or is over a limit."""
        connection = self.child.connection
        is_open = True
        while True:
            # a message, the child's end, or the time to look at the limits
            sources: list[Any] = [self.child.status_fd]
            if is_open:
                sources.append(connection)
            if connection in wait(sources, _POLL_S):
                is_open = self._receive()
            if self.child.poll() is not None:
                # messages that came before its end
                while is_open and connection.poll(0):
                    is_open = self._receive()
                return self._read_end()
            if end := self._over_limit():
                self.child.kill()
                return end

    def _read_end(self) -> ProcessEnd:
        """End of a child that is gone.

        Raises:
            InfrastructureError: Something beside the run broke.
        """
        match self.final:
            case {"infrastructure": str(broken)}:
                raise InfrastructureError(broken, _NOT_STORED_HINT)
            case {"type": "done"}:
                return self._end("ok")
            case {"type": "stopped", "frames": frames}:
                return self._end("stopped", f"stopped on request after {frames} frames")
            case {"type": "failed", "status": status, "reason": reason, **more}:
                refused = more.get("data", False) or (more.get("refused", False) and self.frame < 0)
                return self._end(status, reason, refused=refused)
        # no last message: it was ended, by itself, by a signal, or with its server
        code = self.child.poll()
        assert code is not None
        # the signal that ends this process may have ended the child first
        if code < 0 and not self.cancelled():
            time.sleep(_SIGNAL_GRACE_S)
        if code < 0 and self.cancelled():
            return self._end("stopped", f"cancelled{self._where()}")
        if self.child.server_died:
            raise ServerDiedError("" if self.began is None else self._where())
        if self.child.lost or self.began is None:
            lost = self.child.lost or f"the process that was to make it ended with code {code}"
            raise InfrastructureError(f"the run could not go on: {lost}", _NOT_STORED_HINT)
        return self._end("crashed", _reason_of_exit(code) + self._where())

    def _receive(self) -> bool:
        """Take a message; False if the connection is closed."""
        try:
            message = json.loads(self.child.connection.recv_bytes())
        except (EOFError, OSError):
            return False
        self.last_message = time.monotonic()
        match message["type"]:
            case "ready":
                self.began = self.last_message
            case "started":
                self.n_frames = message["frames"]
            case "frame":
                self.frame = message["index"]
            case "progress":
                if not self.on_progress(message) and self.stop_sent is None:
                    self._ask_to_stop()
            case _:
                self.final = message
                self.peak_mb = max(self.peak_mb, message["peak_memory_mb"])
        return True

    def _ask_to_stop(self) -> None:
        self.stop_sent = time.monotonic()
        with contextlib.suppress(OSError):  # it has ended, which its status tells
            self.child.connection.send_bytes(b"stop")

    def _over_limit(self) -> ProcessEnd | None:
        """End of a child that is over a limit; None where it may go on.

        Raises:
            InfrastructureError: No process has begun the run within its time to start.
        """
        # a run that has sent its last message has a moment to end
        now = time.monotonic()
        silent_s = now - self.last_message
        if self.final:
            return self._read_end() if silent_s > _END_GRACE_S else None
        end = self._stopped(now) or self._too_late(now, silent_s)
        if end is not None or self.began is None or now < self.next_measurement:
            return end
        self.next_measurement = now + _POLL_S
        self.tick()
        return self._too_large(now)

    def _stopped(self, now: float) -> ProcessEnd | None:
        """End of a child that is not wanted any more."""
        if self.cancelled():
            return self._end("stopped", f"cancelled{self._where()}")
        if self.stop_sent is not None and now - self.stop_sent > _STOP_GRACE_S:
            return self._end("stopped", f"stopped on request after frame {self.frame}")
        return None

    def _too_late(self, now: float, silent_s: float) -> ProcessEnd | None:
        """End of a child that has taken too much time.

        Args:
            now: The time.
            silent_s: Seconds since its last message.

        Raises:
            InfrastructureError: It has not begun within its time to start.
        """
        limits = self.limits
        if self.began is None:
            if silent_s > limits.start_s:
                raise InfrastructureError(
                    f"no process for the run within {limits.start_s:g} s", _NOT_STORED_HINT
                )
            return None
        if limits.time_s is not None and now - self.began > limits.time_s:
            return self._end("timeout", f"not done within {limits.time_s:g} s{self._where()}")
        # the first frames compile kernels and load networks
        patience_s = limits.start_s if self.frame < _FIRST_WARM else limits.frame_s
        if silent_s > patience_s:
            return self._end("timeout", f"no sign of life for {patience_s:g} s{self._where()}")
        return None

    def _too_large(self, now: float) -> ProcessEnd | None:
        """Measure the memory; how a child ends that has taken too much."""
        # the process tree from time to time, its memory at every call
        if now >= self.next_tree:
            self.next_tree = now + _TREE_S
            self.child.members = self._members()
        used_mb = memory_mb(self.child.members)
        self.peak_mb = max(self.peak_mb, used_mb)
        if self.memory_mb is None or used_mb <= self.memory_mb:
            return None
        limit = f"the limit is {self.memory_mb:.0f} MB{self.memory_source}"
        return self._end("out-of-memory", f"{used_mb:.0f} MB resident, {limit}{self._where()}")

    def _members(self) -> list[psutil.Process]:
        """The child's process tree, and former members of it that still run."""
        # only a part of it if the fork server is killed meanwhile; none if the process has ended
        tree = process_tree(self.child.pid) if self.child.pid else []
        others = [
            member for member in self.child.members if member not in tree and member.is_running()
        ]
        return tree + others

    def _where(self) -> str:
        """Words on where the run is, as the end of a reason."""
        if not self.located:
            return ""
        if not self.n_frames:
            return ", before the sequence was open"
        done = "before frame 0 was tracked" if self.frame < 0 else f"after frame {self.frame}"
        return f", {done} of {self.n_frames}"

    def _end(self, status: Status, reason: str = "", *, refused: bool = False) -> ProcessEnd:
        return ProcessEnd(status, reason, self.final, self.peak_mb, refused)


def _reason_of_exit(code: int) -> str:
    """Describe what ended a process, by its exit code: minus the number of a signal."""
    if code >= 0:
        return f"the process left with exit code {code}"
    name = {number.value: number.name for number in signal.Signals}.get(-code, f"signal {-code}")
    hint = ", on Linux often because memory ran out" if -code == signal.SIGKILL else ""
    return f"{name} ({str(signal.strsignal(-code)).lower()}{hint})"


def memory_mb(members: list[psutil.Process]) -> float:
    """Memory in MB of a process tree, each page counted once.

    Of one process this is its resident memory. Of several it is the larger of two lower bounds: the
    resident memory of the first, and the sum of the proportional memories (a page that n processes
    share counts 1/n in each). Where the system states no proportional memory, resident memory is
    summed.
    """
    resident = []
    proportional = []
    for process in members:
        with contextlib.suppress(psutil.Error):  # it has ended
            memory = process.memory_info() if len(members) == 1 else process.memory_full_info()
            resident.append(memory.rss)
            proportional.append(getattr(memory, "pss", memory.rss))
    return float(max([sum(proportional), *resident[:1]]) / 1e6)  # of no process 0


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
        None and "" without a limit; "" for one that was asked for.
    """
    if asked_mb is not None:
        return (asked_mb or None), ""
    machine_mb = machine_memory_mb()
    shared = f", shared by {at_a_time} runs at a time" if at_a_time > 1 else ""
    source = (
        f" (by default {100 * DEFAULT_SHARE:.0f} % of this machine's {machine_mb:.0f} MB{shared})"
    )
    return DEFAULT_SHARE * machine_mb / at_a_time, source


LONGEST_LOG = 1 << 20
"""A log of up to so many bytes is kept as it is."""
LONGEST_YET = 1 << 23
"""A log is shortened to its ends while the run lasts when it is longer."""
_KEPT_BYTES = 1 << 18
"""Bytes kept of the beginning and of the end of a longer one."""


def bound_log(log: Path, most: int) -> None:
    """Keep of a log that is longer than `most` bytes its beginning and its end; processes may append to it."""
    if not log.is_file() or log.stat().st_size <= most:
        return
    # a full disk: the log stays as far as it came
    with contextlib.suppress(OSError), log.open("r+b") as file:
        file.seek(-_KEPT_BYTES, os.SEEK_END)
        end = file.read()
        file.truncate(_KEPT_BYTES)
        file.seek(0, os.SEEK_END)  # the processes append, so that they go on behind it
        file.write(b"\n\n[... the middle of the log was cut here ...]\n\n" + end)
