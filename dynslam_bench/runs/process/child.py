"""The process that makes a run: it steps an environment and tells the parent how it goes.

Messages are JSON bytes over the connection, never pickles. The parent sends the job (`make_job`), which names what is
to be done, then perhaps ``stop``. The child sends ``ready`` before anything else (its time counts from then on),
``started``, ``frame`` (one each, the sign of life), ``progress`` every so many frames, and ends with ``done``,
``stopped`` or ``failed``. What it found lies in files in the job's folder: `frames.jsonl`, written frame by frame so
that a crash loses nothing, and at the end the final trajectory and the map. Its temporary files lie in a private
folder that goes with it.
"""

from __future__ import annotations

import contextlib
import errno
import faulthandler
import json
import logging
import os
import re
import resource
import signal
import sys
import sysconfig
import tempfile
import threading
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from multiprocessing.connection import Connection
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
from dynslam_bench.core.files import TemporaryFolder, sweep
from dynslam_bench.core.plugins import ISOLATED_VARIABLE, load_object
from dynslam_bench.runs.process.tree import adopt_orphans, die_with_parent, end_descendants

LOG_FILE = "log.txt"


def main(connection: Connection) -> int:
    """Make one run.

    Args:
        connection: To the parent.

    Returns:
        Exit code: 0 even if the tracker failed and could say so.
    """
    with contextlib.suppress(OSError):
        os.setsid()  # so that the parent can end this process together with what a tracker starts
    die_with_parent()
    adopt_orphans()  # so that what a tracker starts and forgets is still seen below this process
    try:
        job = json.loads(connection.recv_bytes())
    except EOFError:
        return 0
    _send(connection, {"type": "ready"})
    _redirect(Path(job["folder"]) / LOG_FILE)
    stop = threading.Event()
    threading.Thread(target=_listen, args=(connection, stop), daemon=True).start()
    try:
        with contextlib.closing(TemporaryFolder()) as temporary:
            os.environ["TMPDIR"] = tempfile.tempdir = str(temporary.path)
            _prepare(job)
            work = load_object(job["work"])
            message = work(job, lambda message: _send(connection, message), stop.is_set)
    except BaseException as error:
        traceback.print_exc()
        message = describe_failure(error)
        if not Path(job["folder"]).is_dir():
            message |= {"infrastructure": f"{job['folder']} was removed"}
    _send(connection, message | {"peak_memory_mb": peak_memory_mb()})
    sys.stdout.flush()
    sys.stderr.flush()
    return 0


def peak_memory_mb() -> float:
    """Largest resident memory of this process so far."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (1e6 if sys.platform == "darwin" else 1e3)


def _listen(connection: Connection, stop: threading.Event) -> None:
    """Wait for ``stop``; a connection that closes means that nobody wants the result any more."""
    while True:
        try:
            message = connection.recv_bytes()
        except (EOFError, OSError):
            os.killpg(0, signal.SIGKILL)
            return
        if message == b"stop":
            stop.set()


def _send(connection: Connection, message: dict[str, Any]) -> None:
    try:
        connection.send_bytes(json.dumps(message).encode())
    except OSError:
        os.killpg(0, signal.SIGKILL)


def _redirect(log: Path) -> None:
    """Everything that is printed, by whatever library, goes to the log; so does the stack of a fatal signal."""
    handle = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o666)
    sys.stdout.flush()
    sys.stderr.flush()
    os.dup2(handle, 1)
    os.dup2(handle, 2)
    os.close(handle)
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(line_buffering=True)
    faulthandler.enable(file=2, all_threads=False)
    programs = logging.getLogger("dynslam_bench.trackers.adapters.program")
    programs.setLevel(logging.INFO)
    programs.addHandler(logging.StreamHandler(sys.stderr))


def _prepare(job: dict[str, Any]) -> None:
    wanted = {name: text for name, text in job["environment"].items() if name != "TMPDIR"}
    os.environ.update(wanted | {ISOLATED_VARIABLE: "1"})
    with contextlib.suppress(OSError):
        os.chdir(job["working_folder"])
    sys.path[:] = job["path"]
    limit_threads(job["spec"]["threads"])


def limit_threads(threads: int) -> None:
    """Give OpenCV, torch and numba that many threads; BLAS has one (see `server.THREAD_VARIABLES`)."""
    import cv2

    cv2.setNumThreads(threads)
    torch = sys.modules.get("torch")
    if torch is None:
        os.environ["OMP_NUM_THREADS"] = str(threads)
    else:
        torch.set_num_threads(threads)
    numba = sys.modules.get("numba")
    if numba is None:
        os.environ["NUMBA_NUM_THREADS"] = str(threads)
    else:
        numba.set_num_threads(min(threads, numba.config.NUMBA_NUM_THREADS))


# What is said of an exception that ended a run: on which frame, what, and in which line of whose code.

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


# The process above a run: it adopts and ends whatever the run leaves behind, also when the one above it is killed.

_WATCHED = (signal.SIGCHLD, signal.SIGTERM)


def keep(connection_fd: int, told: Callable[[int], None] | None = None) -> int:
    """Make the run in a process below this one.

    Args:
        connection_fd: The run's end of the connection to the parent.
        told: Called in this process with the run's process id, and in the run's with 0; None where this process was
            started by a thread, whose end would pass for the parent's.

    Returns:
        The run's exit code; does not return if a signal ended the run, but ends by the same one.
    """
    if not adopt_orphans():
        return main(Connection(connection_fd))
    signal.pthread_sigmask(signal.SIG_BLOCK, _WATCHED)
    if told is not None:
        with contextlib.suppress(OSError):
            os.setsid()
        die_with_parent(signal.SIGTERM)
    pid = os.fork()
    if told is not None:
        told(pid)
    if pid == 0:
        signal.pthread_sigmask(signal.SIG_UNBLOCK, _WATCHED)
        code = 1
        try:
            code = main(Connection(connection_fd))
        finally:
            sys.stdout.flush()
            sys.stderr.flush()
            os._exit(code)
    os.close(connection_fd)
    code = _outlast(pid)
    end_descendants()
    sweep()
    if code < 0:
        _end_by(-code)
    return code


def _outlast(pid: int) -> int:
    """Wait for the run's end, and bury what it has orphaned meanwhile; ends early when the parent has ended."""
    code = None
    while code is None:
        if signal.sigwait(_WATCHED) == signal.SIGTERM:
            return -signal.SIGTERM
        with contextlib.suppress(ChildProcessError):  # nobody is left
            while (buried := os.waitpid(-1, os.WNOHANG))[0]:
                if buried[0] == pid:
                    code = os.waitstatus_to_exitcode(buried[1])
    return code


def _end_by(number: int) -> None:
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    signal.pthread_sigmask(signal.SIG_UNBLOCK, _WATCHED)
    if number not in (signal.SIGKILL, signal.SIGSTOP):
        signal.signal(number, signal.SIG_DFL)
    os.kill(os.getpid(), number)


if __name__ == "__main__":
    os._exit(keep(int(sys.argv[1])))  # threads that a tracker left running must not hold it up
