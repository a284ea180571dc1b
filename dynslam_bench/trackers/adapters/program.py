"""An external program that answers JSON lines; a fault or its death becomes one clear error."""

from __future__ import annotations

import contextlib
import ctypes
import json
import logging
import os
import queue
import signal
import subprocess
import sys
import threading
import weakref
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import IO, Any

from dynslam_bench.core.errors import TrackerError
from dynslam_bench.core.reading import parse_json

_SET_PARENT_DEATH_SIGNAL = 1
LOGGER = logging.getLogger(__name__)
"""Gets, at level INFO, every line that a program writes beside its answers; a run keeps them in its log."""
LONGEST_LINE = 1 << 26
"""Bytes of the longest line that is read from a program: a final trajectory of half a million poses."""


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
        self._kill = weakref.finalize(self, _kill_group, self._process)
        self._answers: queue.SimpleQueue[str | None] = queue.SimpleQueue()  # None: standard output has ended
        self._old_lines: dict[str, str] = {}
        self._new_lines: dict[str, str] = {}  # since the last request
        self._readers = [
            threading.Thread(target=_read, args=(name, channel, stream, self._answers, self._new_lines), daemon=True)
            for channel, stream in (("out", self._process.stdout), ("err", self._process.stderr))
        ]
        for reader in self._readers:
            reader.start()

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
        self._old_lines.update(self._new_lines)
        self._new_lines.clear()
        try:
            self._write(request)
            text = self._answers.get(timeout=timeout_s)
        except (OSError, ValueError):  # it has closed its input, or was killed before
            text = None
        except queue.Empty:
            line_shown = f"; its last line: '{self._last_line()}'" if self._last_line() else ""
            self.kill()
            raise TrackerError(f"{self.name} {doing}: no answer within {timeout_s:g} s, killed{line_shown}") from None
        if text is None:
            raise self._death(doing)
        try:
            answer = parse_answer(text)
        except TrackerError as error:
            self.kill()
            raise TrackerError(f"{self.name} {doing}: {error.args[0]}", "one JSON object a line") from None
        if answer.get("error"):
            raise TrackerError(f"{self.name} {doing}: {' '.join(str(answer['error']).split())[:400]}")
        self._refuse_surplus(doing)
        return answer

    def close(self, timeout_s: float) -> None:
        """Ask it to end, wait, and kill it if it does not; may be called more than once."""
        with contextlib.suppress(OSError, ValueError, subprocess.TimeoutExpired):
            self._write({"op": "close"})
            self._process.stdin.close()  # type: ignore[union-attr]
            self._process.wait(timeout_s)
        self.kill()

    def kill(self) -> None:
        """End it and everything it started, at once."""
        self._kill()
        for reader in self._readers:
            reader.join(timeout=0.5)  # a process in another session may hold the pipe open for ever

    def _write(self, message: Mapping[str, Any]) -> None:
        assert self._process.stdin is not None
        self._process.stdin.write(json.dumps(message, allow_nan=False).encode() + b"\n")
        self._process.stdin.flush()

    def _refuse_surplus(self, doing: str) -> None:
        """Raise on an unrequested answer: it would be taken for the next one, a pose of the wrong frame."""
        if self._answers.empty():
            return
        surplus = self._answers.get()
        if surplus is None:
            raise self._death(doing)
        self.kill()
        raise TrackerError(
            f"{self.name} {doing}: wrote an answer that was not asked for: '{surplus[:80]}'",
            "one line that begins with { for each request",
        )

    def _last_line(self) -> str:
        """The last line of its log.

        Lines since the last request count before earlier ones, and standard error before standard output, which often
        arrives late, when it is flushed at the end.
        """
        lines = (self._new_lines.get("err"), self._new_lines.get("out"), self._old_lines.get("err"))
        return next(filter(None, lines), self._old_lines.get("out", ""))

    def _death(self, doing: str) -> TrackerError:
        try:
            code = self._process.wait(timeout=1.0)
        except subprocess.TimeoutExpired:
            self.kill()
            return TrackerError(f"{self.name} {doing}: closed its output without an answer")
        self.kill()
        line = self._last_line()
        shown = f"its last line: '{line}'" if line else "it wrote no message"
        return TrackerError(f"{self.name} {doing}: the program {_describe(code)}; {shown}")


def _read(
    name: str, channel: str, stream: IO[bytes], answers: queue.SimpleQueue[str | None], lines: dict[str, str]
) -> None:
    """Sort the lines of a program's output into answers and log until it ends; runs in a thread of its own."""
    with stream:
        for raw in iter(lambda: stream.readline(LONGEST_LINE), b""):
            text = raw.decode(errors="replace").strip()
            if channel == "out" and text.startswith("{"):
                answers.put(text)
            elif text:
                lines[channel] = text[:300]
                LOGGER.info("[%s] %s", name, text)
    if channel == "out":
        answers.put(None)


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
    """Kill the program with all that it started."""
    if process.poll() is None:
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(process.pid, signal.SIGKILL)
    with contextlib.suppress(subprocess.TimeoutExpired):
        process.wait(timeout=5.0)
    with contextlib.suppress(OSError):
        assert process.stdin is not None
        process.stdin.close()
