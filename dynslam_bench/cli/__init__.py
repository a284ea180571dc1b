"""The command line: every verb is a thin call of a public function; heavy modules load when a verb needs them."""

import os
import signal
import sys
from io import TextIOWrapper
from types import FrameType

__all__ = ["interrupted", "leave_interrupted", "main"]

RESUMABLE = ("run", "bench", "round", "tune", "demo", "report", "segmenter", "sequences")
"""Verbs that keep finished work when they are interrupted."""

# Signals that ask a process to end: Ctrl-C, `kill`, and a terminal that is closed.
_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
_SIGNAL_CODE = 128
"""A shell's exit code for a signal is this plus the signal's number."""
_received: list[int] = []
"""Numbers of the signals to end that were received."""


def main() -> None:
    """Entry point of ``dynslam-bench``.

    Exit codes: 0 done, 1 user error (one line, no traceback), 2 usage, 3 some runs failed or were
    lost (or could not write the map that was asked for), 4 verification failed or regressed, 5 undecided,
    128 plus the signal's number after one (130 for Ctrl-C).
    """
    for number in _SIGNALS:  # an ignored signal, e.g. SIGHUP below `nohup`, stays ignored
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, _interrupt)
    for stream in (sys.stdout, sys.stderr):
        # a terminal of another encoding shows ? for characters that it lacks
        if isinstance(stream, TextIOWrapper):
            stream.reconfigure(errors="replace")
    try:
        from dynslam_bench.cli.app import start

        start()
    except KeyboardInterrupt:
        leave_interrupted()


def interrupted() -> bool:
    """Whether a signal to end was received."""
    return bool(_received)


def leave_interrupted() -> None:
    """Say how to continue, and exit: with 130 for Ctrl-C, 143 for SIGTERM, 129 for SIGHUP."""
    text = "interrupted"
    if sys.argv[1:2] and sys.argv[1] in RESUMABLE:
        text += "; what is finished is stored, the same command goes on from there"
    sys.stderr.write(f"{text}\n")
    number = _received[0] if _received else signal.SIGINT
    sys.exit(_SIGNAL_CODE + number)


def _interrupt(number: int, _: FrameType | None) -> None:
    """Raise `KeyboardInterrupt` in the main thread; a second signal ends the process at once."""
    _received.append(number)
    if len(_received) > 1:
        os._exit(_SIGNAL_CODE + number)  # the fork server notices, and ends the runs
    raise KeyboardInterrupt
