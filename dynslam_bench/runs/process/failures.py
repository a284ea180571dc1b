"""What is said of an exception that ended a run: on which frame, what, and in which line of whose code."""

from __future__ import annotations

import errno
import re
import sys
import sysconfig
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from dynslam_bench.core.errors import (
    DynslamError,
    InfrastructureError,
    PluginError,
    SegmentationError,
    SequenceError,
    SettingsError,
    TrajectoryError,
)

_LONGEST = 400
_REFUSALS = (SettingsError, PluginError, TrajectoryError)
"""Raised before the first frame is tracked, these say that what was asked for cannot be."""

_DATA_FAULTS = (SequenceError, SegmentationError)
"""These say, whenever they are raised, that an image, a mask or a network's weights are at fault."""

_DISK_ERRORS = (errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EIO, errno.ESTALE)
"""What a disk says that is full, read-only, damaged or gone: no tracker can help it."""


class FailedAt(Exception):
    """Where a run was when its cause was raised."""


@contextmanager
def at(where: object) -> Iterator[None]:
    """Note where the run was for what is raised inside; `where` is put into words only then."""
    try:
        yield
    except Exception as error:
        raise FailedAt(str(where)) from error
    except SystemExit as error:
        raise FailedAt(str(where)) from error


def describe_failure(error: BaseException) -> dict[str, Any]:
    """The last message of a run that an exception ended: ``status``, ``reason`` and ``refused``.

    With ``infrastructure`` it was no fault of the run's: that says what broke. With ``data`` it was not the tracker's
    own code that raised it, or what it was given to read cannot be read: the run says nothing about the tracker.

    The reason reads ``frame 20 of 60: ValueError: too few points (my_tracker.py:31)``.
    """
    from dynslam_bench.contracts.checks import TrackerContractError, raised_by_tracker

    where, cause = "", error
    if isinstance(error, FailedAt) and error.__cause__ is not None:
        where, cause = str(error), error.__cause__
    text = " ".join(str(cause).split())[:_LONGEST]
    named = f"{type(cause).__name__}: {text}".rstrip(": ")
    if isinstance(cause, SystemExit):
        named = f"sys.exit({cause.code!r}) was called"
    kind = type(cause).__name__
    broken = _broken(error)
    if broken:
        return _message("crashed", _located(where, broken)) | {"infrastructure": broken}
    if isinstance(cause, MemoryError) or "out of memory" in text.lower() or kind == "OutOfMemoryError":
        return _message("out-of-memory", _located(where, named, cause))
    if isinstance(cause, TrackerContractError):
        return _message("invalid", _located(where, text))
    data = {} if raised_by_tracker(cause) and not isinstance(cause, _DATA_FAULTS) else {"data": True}
    if isinstance(cause, DynslamError):
        return _message("crashed", _located(where, text)) | {"refused": isinstance(cause, _REFUSALS)} | data
    return _message("crashed", _located(where, named, cause)) | data


def _broken(error: BaseException | None) -> str:
    """What of the infrastructure broke, if an exception or one of its causes says that something did."""
    while error is not None:
        if isinstance(error, InfrastructureError) or (isinstance(error, OSError) and error.errno in _DISK_ERRORS):
            return " ".join(str(error).split())[:_LONGEST]
        error = error.__cause__ or error.__context__
    return ""


def _message(status: str, reason: str) -> dict[str, Any]:
    return {"type": "failed", "status": status, "reason": reason}


def _located(where: str, what: str, cause: BaseException | None = None) -> str:
    """`what` with the frame before it, unless it names one itself, and the line of code behind it."""
    before = "" if not where or re.search(r"\bframe \d+", what) else f"{where}: "
    line = "" if cause is None else source_line(cause)
    return before + what + (f" ({line})" if line else "")


def source_line(error: BaseException) -> str:
    """``file.py:31``: the innermost line of an exception's traceback that is in nobody's library, if there is one."""
    lines = traceback.extract_tb(error.__traceback__)
    if not lines:
        return ""
    foreign = {sysconfig.get_path(name) for name in ("stdlib", "platstdlib", "purelib", "platlib")}
    outside = (*foreign, "<", sys.base_prefix)
    own = [line for line in lines if "site-packages" not in line.filename and not line.filename.startswith(outside)]
    line = (own or lines)[-1]
    return f"{Path(line.filename).name}:{line.lineno}"
