"""How the program ends on Ctrl-C, SIGTERM and SIGHUP: at once, its runs with it, in one line and the shell's code."""

from __future__ import annotations

import os
import signal
import sys
from types import FrameType

STORING = ("run", "bench", "tune", "demo", "report", "segmenter", "sequences")
"""Verbs that keep what they have finished."""
_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
_TOLD = 128
"""A shell's exit code for a signal is this and the signal's number."""
_received: list[int] = []


def watch_signals() -> None:
    """From now on each of the signals raises `KeyboardInterrupt` in the main thread; a second one ends at once.

    A signal that is ignored already, as a program that is to outlive its terminal ignores SIGHUP, stays so.
    """
    for number in _SIGNALS:
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, _interrupt)


def code() -> int:
    """The exit code after an interrupt: 130 for Ctrl-C, 143 for SIGTERM, 129 for SIGHUP."""
    return _TOLD + (_received[0] if _received else signal.SIGINT)


def interrupted() -> bool:
    """Whether a signal has asked for the end."""
    return bool(_received)


def leave_interrupted() -> None:
    """Say how to go on, and exit."""
    goes_on = "; what is finished is stored, the same command goes on from there"
    sys.stderr.write(f"interrupted{goes_on if sys.argv[1:2] and sys.argv[1] in STORING else ''}\n")
    sys.exit(code())


def _interrupt(number: int, _: FrameType | None) -> None:
    _received.append(number)
    if len(_received) > 1:
        os._exit(_TOLD + number)  # the fork server sees it, and ends the runs
    raise KeyboardInterrupt
