"""Failures of a run in words: where it was, what was raised, and whose fault it is."""

import errno
import re
import sys
import sysconfig
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from dynslam_bench.core import (
    DynslamError,
    InfrastructureError,
    PluginError,
    SegmentationError,
    SequenceError,
    SettingsError,
    TrackerTimeoutError,
    TrajectoryError,
)

_LONGEST_REASON = 400
"""Characters that are kept of a reason."""
_REFUSALS = (SettingsError, PluginError, TrajectoryError)
"""Raised before the first frame is tracked, these say that what was asked for cannot be."""
_DATA_FAULTS = (SequenceError, SegmentationError)
"""These say, whenever they are raised, that an image, a mask or a network's weights are at fault."""
_DISK_ERRORS = (errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EIO, errno.ESTALE)
"""Errors of a disk that is full, read-only, damaged or gone: no tracker is at fault."""
_RUNNER_FILES = (__file__, str(Path(__file__).with_name("child.py")))
"""Every failure passes through these: they do not say where it arose."""


class FailedAt(Exception):
    """Frame at which a run was when its cause was raised."""


@contextmanager
def at(where: Callable[[], str]) -> Iterator[None]:
    """Note where the run was for what is raised inside; `where` is asked only then."""
    try:
        yield
    except (Exception, SystemExit) as error:
        raise FailedAt(where()) from error


def describe_failure(error: BaseException) -> dict[str, Any]:
    """The last message of a run that an exception ended: ``status``, ``reason`` and ``refused``.

    The key ``infrastructure`` says what broke beside the run. The key ``data`` says that something
    other than the tracker's own code raised, or that its input cannot be read: the run says nothing
    about the tracker.

    The reason reads ``frame 20 of 60: ValueError: too few points (my_tracker.py:31)``.
    """
    from dynslam_bench.contracts.checks import TrackerContractError, raised_by_tracker

    where = ""
    cause = error
    if isinstance(error, FailedAt) and error.__cause__ is not None:
        where = str(error)
        cause = error.__cause__
    text = _one_line(cause)

    # what broke beside the run
    broken = _broken_infrastructure(error)
    if broken:
        return _message("crashed", _located(where, broken), infrastructure=broken)

    # outcomes of the tracker that have a status of their own
    if isinstance(cause, TrackerContractError):
        return _message("invalid", _located(where, text))
    if _is_out_of_memory(cause, text):
        return _message("out-of-memory", _located(where, _named(cause, text), cause))
    if isinstance(cause, TrackerTimeoutError):
        return _message("timeout", _located(where, text))

    # everything else; an error of this package says itself what to do
    is_of_tracker = raised_by_tracker(cause) and not isinstance(cause, _DATA_FAULTS)
    fault = {} if is_of_tracker else {"data": True}
    if isinstance(cause, DynslamError):
        is_refusal = isinstance(cause, _REFUSALS)
        return _message("crashed", _located(where, text), refused=is_refusal, **fault)
    return _message("crashed", _located(where, _named(cause, text), cause), **fault)


def _message(status: str, reason: str, **details: Any) -> dict[str, Any]:
    return {"type": "failed", "status": status, "reason": reason, **details}


def _located(where: str, what: str, raised: BaseException | None = None) -> str:
    """A reason with the place in the sequence before it and the place in the code behind it.

    Args:
        where: Where the run was; left out where the reason names a frame itself.
        what: What happened.
        raised: The exception whose line is named; None for none.
    """
    before = "" if not where or re.search(r"\bframe \d+", what) else f"{where}: "
    line = "" if raised is None else source_line(raised)
    return before + what + (f" ({line})" if line else "")


def _named(error: BaseException, text: str) -> str:
    """An exception with its name and what it says."""
    if isinstance(error, SystemExit):
        return f"sys.exit({error.code!r}) was called"
    return f"{type(error).__name__}: {text}".rstrip(": ")


def _is_out_of_memory(error: BaseException, text: str) -> bool:
    """Whether memory ran out: Python's, a library's or, by torch's ``OutOfMemoryError``, the GPU's."""
    if isinstance(error, MemoryError) or type(error).__name__ == "OutOfMemoryError":
        return True
    return "out of memory" in text.lower()


def _one_line(error: BaseException) -> str:
    """The text of an exception on one line of bounded length."""
    return " ".join(str(error).split())[:_LONGEST_REASON]


def _broken_infrastructure(error: BaseException | None) -> str:
    """Name the infrastructure that broke, by an exception or one of its causes; empty if nothing did."""
    while error is not None:
        is_of_disk = isinstance(error, OSError) and error.errno in _DISK_ERRORS
        if is_of_disk or isinstance(error, InfrastructureError):
            return _one_line(error)
        error = error.__cause__ or error.__context__
    return ""


def source_line(error: BaseException) -> str:
    """``file.py:31``: the innermost line of an exception's traceback outside of libraries, else the innermost."""
    lines = traceback.extract_tb(error.__traceback__)
    folders = map(sysconfig.get_path, ("stdlib", "platstdlib", "purelib", "platlib"))
    # "<" begins the file names of frozen and generated code
    left_out = (*folders, "<", sys.base_prefix, *_RUNNER_FILES)
    outside = [
        line
        for line in lines
        if "site-packages" not in line.filename and not line.filename.startswith(left_out)
    ]
    innermost = (outside or lines)[-1:]
    return "".join(f"{Path(line.filename).name}:{line.lineno}" for line in innermost)
