"""An external program that answers JSON lines; a fault or its death becomes one clear error."""

from __future__ import annotations

import contextlib
import ctypes
import json
import logging
import os
import selectors
import signal
import subprocess
import sys
import threading
import time
import weakref
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from dynslam_bench.core.errors import TrackerError
from dynslam_bench.core.reading import parse_json

_SET_PARENT_DEATH_SIGNAL = 1
LOGGER = logging.getLogger(__name__)
"""Gets, at level INFO, every line that a program writes beside its answers; a run keeps them in its log."""
LONGEST_LINE = 1 << 26
"""Bytes of the longest line that is taken from a program: a final trajectory of half a million poses."""


class Program:
    """One run of an external program.

    Requests go to its standard input, one JSON object a line; it answers each with one JSON object a line on its
    standard output. Lines that do not begin with ``{`` are log output and skipped, as is its standard error; the last
    ones are kept for error messages, all of them go to `LOGGER`. It has a session of its own, so that its child
    processes end with it. It should end by itself at the end of its standard input; on Linux it is killed when the
    process that started it dies.

    Args:
        name: For messages.
        command: Program and arguments.
        folder: Its working folder; None for the current one.
        environment: Variables to set beside the inherited ones.

    Raises:
        TrackerError: The program cannot be started.
    """

    def __init__(
        self,
        name: str,
        command: Sequence[str],
        *,
        folder: Path | None = None,
        environment: Mapping[str, str] | None = None,
    ) -> None:
        self.name = name
        self._lines: dict[str, str] = {}
        self._fresh_lines: dict[str, str] = {}  # since the last request
        self._partial = {"out": b"", "err": b""}
        self._answers: deque[str] = deque()
        try:
            self._process = subprocess.Popen(
                list(command),
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                cwd=folder,
                env={**os.environ, **(environment or {})},
                start_new_session=True,
                preexec_fn=end_with_parent(),
            )
        except (OSError, ValueError) as error:
            reason = error.strerror if isinstance(error, OSError) else str(error)
            raise TrackerError(f"{name}: cannot start '{command[0]}': {reason}", "check its path") from error
        assert self._process.stdin and self._process.stdout and self._process.stderr
        for stream in (self._process.stdin, self._process.stdout, self._process.stderr):
            os.set_blocking(stream.fileno(), False)
        self._selector = selectors.DefaultSelector()
        self._selector.register(self._process.stdout, selectors.EVENT_READ, "out")
        self._selector.register(self._process.stderr, selectors.EVENT_READ, "err")
        self._kill = weakref.finalize(self, _kill_group, self._process)

    @property
    def alive(self) -> bool:
        """Whether the program runs."""
        return self._process.poll() is None

    @property
    def last_line(self) -> str:
        """The last line that is not blank of what it wrote as log.

        Lines since the last request count before earlier ones, and standard error before standard output, which often
        arrives late, when it is flushed at the end.
        """
        for channel, partial in self._partial.items():
            self._keep_line(channel, partial.decode(errors="replace"))
            self._partial[channel] = b""
        lines = (self._fresh_lines, self._lines)
        return next((kept[channel] for kept in lines for channel in ("err", "out") if channel in kept), "")

    def _keep_line(self, channel: str, text: str) -> None:
        if text.strip():
            self._lines[channel] = self._fresh_lines[channel] = text.strip()[:300]

    def ask(self, request: Mapping[str, Any], timeout_s: float, doing: str) -> dict[str, Any]:
        """Send a request and wait for its answer.

        Args:
            request: JSON-able; ``op`` names what is asked.
            timeout_s: Seconds until the program is given up and killed.
            doing: For messages, e.g. ``at frame 12``.

        Raises:
            TrackerError: It died, did not answer in time, answered no JSON object, or answered ``{"error": ...}``.
        """
        self._refuse_surplus(doing)
        self._fresh_lines.clear()
        line = memoryview(json.dumps(request, allow_nan=False).encode() + b"\n")
        text = self._exchange(line, timeout_s, doing)
        try:
            answer = parse_answer(text)
        except TrackerError as error:
            self.kill()
            raise TrackerError(f"{self.name} {doing}: {error.args[0]}", "one JSON object a line") from None
        if answer.get("error"):
            raise TrackerError(f"{self.name} {doing}: {' '.join(str(answer['error']).split())[:400]}")
        self._refuse_surplus(doing)
        return answer

    def _refuse_surplus(self, doing: str) -> None:
        """Raise on an unrequested answer: it would be taken for the next one, a pose of the wrong frame."""
        if self.alive:
            self._read(0.0)
        if self._answers:
            surplus = self._answers.popleft()
            self.kill()
            raise TrackerError(
                f"{self.name} {doing}: wrote an answer that was not asked for: '{surplus[:80]}'",
                "one line that begins with { for each request",
            )

    def close(self, timeout_s: float) -> None:
        """Ask it to end, wait, and kill it if it does not; may be called more than once."""
        if self.alive:
            assert self._process.stdin
            with contextlib.suppress(OSError):
                os.write(self._process.stdin.fileno(), b'{"op": "close"}\n')
            with contextlib.suppress(OSError):
                self._process.stdin.close()
            deadline = time.monotonic() + timeout_s
            while self.alive and time.monotonic() < deadline:
                if not self._read(0.02):
                    time.sleep(0.005)
            self._drain()
        self.kill()

    def kill(self) -> None:
        """End it and everything it started, at once."""
        self._kill()
        self._selector.close()

    def _exchange(self, line: memoryview, timeout_s: float, doing: str) -> str:
        """Write the request, read until there is an answer."""
        assert self._process.stdin
        deadline = time.monotonic() + timeout_s
        while line or not self._answers:
            if line:
                try:
                    line = line[os.write(self._process.stdin.fileno(), line) :]
                except BlockingIOError:
                    pass  # its input is full: read what it says, then try again
                except (OSError, ValueError):  # it has closed its input, or was killed before
                    raise self._death(doing) from None
            left = deadline - time.monotonic()
            if left <= 0:
                line_shown = f"; its last line: '{self.last_line}'" if self.last_line else ""
                self.kill()
                raise TrackerError(f"{self.name} {doing}: no answer within {timeout_s:g} s, killed{line_shown}")
            alive = self.alive
            open_ = self._read(min(left, 0.01 if line else 0.5))
            if not self._answers and not (alive and open_):
                raise self._death(doing)
        return self._answers.popleft()

    def _read(self, wait: float) -> bool:
        """Read its output for up to `wait` seconds; False once its standard output has ended."""
        if not self._selector.get_map():
            return False
        for key, _ in self._selector.select(wait):
            channel = str(key.data)
            data = os.read(key.fd, 1 << 16)
            if not data:
                self._selector.unregister(key.fileobj)
            *lines, rest = (self._partial[channel] + data).split(b"\n")
            self._partial[channel] = rest
            if len(rest) > LONGEST_LINE:
                self.kill()
                raise TrackerError(f"{self.name}: wrote a line of more than {LONGEST_LINE >> 20} MB, killed")
            for raw in lines:
                text = raw.decode(errors="replace")
                if channel == "out" and text.lstrip().startswith("{"):
                    self._answers.append(text)
                elif text.strip():
                    self._keep_line(channel, text)
                    LOGGER.info("[%s] %s", self.name, text)
        return any(key.data == "out" for key in self._selector.get_map().values())

    def _drain(self) -> None:
        """Read the rest of its output; a grandchild may hold the pipe open for ever."""
        for _ in range(64):
            if not self._selector.get_map() or not self._selector.select(0.0):
                break
            self._read(0.0)

    def _death(self, doing: str) -> TrackerError:
        try:
            code = self._process.wait(timeout=1.0)
        except subprocess.TimeoutExpired:
            self.kill()
            return TrackerError(f"{self.name} {doing}: closed its output without an answer")
        self._drain()
        line = self.last_line
        self.kill()
        shown = f"its last line: '{line}'" if line else "it wrote no message"
        return TrackerError(f"{self.name} {doing}: the program {_describe(code)}; {shown}")


def parse_answer(text: str) -> dict[str, Any]:
    """A program's answer.

    Raises:
        TrackerError: It is no JSON object; the name of the program is still to be added.
    """
    answer = parse_json(text, f"its answer '{text[:80]}'", kind=TrackerError)
    if not isinstance(answer, dict):
        raise TrackerError(f"its answer '{text[:80]}' is no JSON object")
    return answer


def end_with_parent() -> Callable[[], object] | None:
    """A function that runs in the new process before the program, so that Linux kills it when this process dies.

    None elsewhere, and in threads: Linux watches the thread that starts the process.
    """
    if sys.platform != "linux" or threading.current_thread() is not threading.main_thread():
        return None
    prctl = ctypes.CDLL(None).prctl  # loaded here: between fork and exec as little as possible is done
    return lambda: prctl(_SET_PARENT_DEATH_SIGNAL, signal.SIGKILL)


def _describe(code: int) -> str:
    if code >= 0:
        return f"ended with exit code {code}"
    try:
        return f"was killed by {signal.Signals(-code).name}"
    except ValueError:
        return f"was killed by signal {-code}"


def _kill_group(process: subprocess.Popen[bytes]) -> None:
    """Kill the program with all that it started, and release its pipes."""
    if process.poll() is None:
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(process.pid, signal.SIGKILL)
    with contextlib.suppress(subprocess.TimeoutExpired):
        process.wait(timeout=5.0)
    for stream in (process.stdin, process.stdout, process.stderr):
        if stream is not None:
            with contextlib.suppress(OSError):
                stream.close()
