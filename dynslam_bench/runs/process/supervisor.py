"""Watching a child: its messages, its limits, its end."""

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
from dynslam_bench.runs.process.tree import memory_limit, memory_mb
from dynslam_bench.runs.record import Status
from dynslam_bench.runs.spec import Limits

Message = dict[str, Any]
_POLL_S = 0.1
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
        peak_memory_mb: Largest memory seen or reported.
        n_frames: Frames it announced; 0 if it never began.
        refused: Whether it is no outcome of a tracker: it failed before anything ran, because what was asked for
            cannot be, or something else than the tracker's own code raised.
    """

    status: Status
    reason: str = ""
    final: Message = field(default_factory=dict)
    peak_memory_mb: float = 0.0
    n_frames: int = 0
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
    """Give a child its job and watch it to its end.

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
    watch = _Watch(child, limits, on_progress, cancelled, tick or (lambda: None), at_a_time, located)
    try:
        child.connection.send_bytes(json.dumps(job).encode())
        return watch.run()
    except BrokenPipeError:
        return watch.died()
    finally:
        child.close()


class _Watch:
    def __init__(
        self,
        child: Child,
        limits: Limits,
        on_progress: Callable[[Message], bool] | None,
        cancelled: Callable[[], bool] | None,
        tick: Callable[[], None],
        at_a_time: int,
        located: bool,
    ) -> None:
        self.child, self.limits, self.on_progress, self.cancelled = child, limits, on_progress, cancelled
        self.tick, self.located = tick, located
        self.memory_mb, self.memory_source = memory_limit(limits.memory_mb, at_a_time)
        self.final_at = 0.0
        self.sign_of_life = time.monotonic()
        self.began: float | None = None
        self.frame = -1
        self.n_frames = 0
        self.final: Message = {}
        self.peak_mb = 0.0
        self.stop_sent: float | None = None
        self.next_look = 0.0

    def run(self) -> Verdict:
        open_connection = True
        while True:
            handles: list[Any] = [self.child.connection] if open_connection else []
            status = self.child.wait_handle()
            handles += [] if status is None else [status]
            ready: list[Any] = wait(handles, _POLL_S) if handles else []
            if not handles:
                time.sleep(_POLL_S)
            if self.child.connection in ready:
                open_connection = self._receive()
            ended = self.child.poll() is not None
            if ended:
                while open_connection and self.child.connection.poll(0):
                    open_connection = self._receive()
                return self.died()
            over = self._over_limit()
            if over is not None:
                self.child.kill()
                return over

    def died(self) -> Verdict:
        """The verdict on a child that is no more."""
        kind = self.final.get("type")
        if self.final.get("infrastructure"):
            raise InfrastructureError(self.final["infrastructure"], _GO_ON)
        if kind == "done":
            return self._verdict("ok")
        if kind == "stopped":
            return self._verdict("stopped", f"stopped on request after {self.final['frames']} frames")
        if kind == "failed":
            verdict = self._verdict(self.final["status"], self.final["reason"])
            verdict.refused = self.final.get("data", False) or (self.final.get("refused", False) and self.frame < 0)
            return verdict
        code = _wait_exit(self.child)
        if code < 0 and self._is_cancelled(_SIGNAL_GRACE_S):  # what ends this process ended the child first
            return self._verdict("stopped", f"cancelled{self._where()}")
        if self.child.lost or self.began is None:
            lost = self.child.lost or f"the process that was to make it ended with code {code}"
            raise InfrastructureError(f"the run could not go on: {lost}", _GO_ON)
        return self._verdict(*_reason_of_exit(code, self._where()))

    def _is_cancelled(self, wait_s: float = 0.0) -> bool:
        end = time.monotonic() + wait_s
        while self.cancelled is not None and not self.cancelled():
            if time.monotonic() >= end:
                return False
            time.sleep(0.02)
        return self.cancelled is not None

    def _receive(self) -> bool:
        try:
            message = json.loads(self.child.connection.recv_bytes())
        except (EOFError, OSError):
            return False
        kind = message["type"]
        self.sign_of_life = time.monotonic()
        if kind == "ready":
            self.began = self.sign_of_life
        elif kind == "started":
            self.n_frames = message["frames"]
        elif kind == "frame":
            self.frame = message["index"]
        elif kind == "progress":
            if self.on_progress is not None and not self.on_progress(message) and self.stop_sent is None:
                self._stop()
        else:
            self.final, self.final_at = message, self.sign_of_life
            self.peak_mb = max(self.peak_mb, message["peak_memory_mb"])
        return True

    def _stop(self) -> None:
        self.stop_sent = time.monotonic()
        try:
            self.child.connection.send_bytes(b"stop")
        except OSError:
            return

    def _over_limit(self) -> Verdict | None:
        now = time.monotonic()
        limits = self.limits
        if self.final:
            return self.died() if now - self.final_at > _END_GRACE_S else None
        if self._is_cancelled():
            return self._verdict("stopped", f"cancelled{self._where()}")
        if self.stop_sent is not None and now - self.stop_sent > _STOP_GRACE_S:
            return self._verdict("stopped", f"stopped on request after frame {self.frame}")
        if self.began is None:
            if now - self.sign_of_life > limits.start_s:
                raise InfrastructureError(f"no process for the run within {limits.start_s:g} s", _GO_ON)
            return None
        if limits.time_s is not None and now - self.began > limits.time_s:
            return self._verdict("timeout", f"not done within {limits.time_s:g} s{self._where()}")
        patience = limits.start_s if self.frame < _FIRST_WARM else limits.frame_s
        if now - self.sign_of_life > patience:
            return self._verdict("timeout", f"no sign of life for {patience:g} s{self._where()}")
        if now < self.next_look:
            return None
        self.next_look = now + _POLL_S
        self.tick()
        used = memory_mb(pid) if (pid := self.child.run_pid or self.child.pid) else 0.0
        self.peak_mb = max(self.peak_mb, used)
        if self.memory_mb is not None and used > self.memory_mb:
            source = f" ({self.memory_source})" if self.memory_source else ""
            reason = f"{used:.0f} MB resident, the limit is {self.memory_mb:.0f} MB{source}{self._where()}"
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
        return Verdict(status, reason, self.final, self.peak_mb, self.n_frames)


def _wait_exit(child: Child) -> int:
    for _ in range(50):
        code = child.poll()
        if code is not None:
            return code
        time.sleep(0.1)
    return -signal.SIGKILL


_SIGNALS = {
    "SIGSEGV": "segmentation fault",
    "SIGABRT": "aborted by a library",
    "SIGFPE": "arithmetic error",
    "SIGILL": "illegal instruction",
    "SIGBUS": "bus error",
    "SIGKILL": "killed from outside; on Linux often because memory ran out",
}


def _reason_of_exit(code: int, where: str) -> tuple[Status, str]:
    if code >= 0:
        return "crashed", f"the process left with exit code {code}{where}"
    name = signal.Signals(-code).name if -code in {s.value for s in signal.Signals} else f"signal {-code}"
    meaning = _SIGNALS.get(name, "")
    return "crashed", f"{name}{f' ({meaning})' if meaning else ''}{where}"


# The log of a run within bounds: its beginning and its end are kept, and what was cut is said.

WHOLE = 1 << 20
"""A log of up to so many bytes is kept as it is."""
KEPT = 1 << 18
"""Bytes kept of the beginning and of the end of a longer one."""
_MOST = 1 << 23
"""While the run lasts the file is emptied when it is longer."""


class LogFile:
    """Watches a file that other processes append to.

    Args:
        path: The file; it may not exist yet.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._head = self._tail = b""
        self._seen = 0

    def look(self) -> None:
        """Empty the file if it has become long, after its first and last bytes were taken; call it often."""
        try:
            size = self.path.stat().st_size
        except OSError:
            return
        if size > _MOST:
            self._take(size)
            os.truncate(self.path, 0)  # whoever writes appends, so that writing goes on at the new end

    def finish(self) -> None:
        """Write the log as it is kept; nobody may write any more."""
        if not self.path.is_file():
            return
        size = self.path.stat().st_size
        if not self._seen and size <= WHOLE:
            return
        self._take(size)
        cut = self._seen - len(self._head) - len(self._tail)
        note = f"\n\n[... about {cut / 1e6:.1f} of {self._seen / 1e6:.1f} MB were cut here ...]\n\n"
        self.path.write_bytes(self._head + note.encode() + self._tail)

    def _take(self, size: int) -> None:
        with self.path.open("rb") as file:
            if not self._seen:
                self._head = file.read(KEPT)
            begin = max(size - KEPT, len(self._head) if not self._seen else 0)
            file.seek(begin)
            latest = file.read(size - begin)
        self._tail = (self._tail + latest)[-KEPT:]
        self._seen += size
