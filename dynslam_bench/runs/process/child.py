"""The process that makes a run: it steps an environment and reports to the parent.

Messages are JSON bytes over the connection, never pickles. The parent sends the job (`make_job`)
and may send ``stop`` later. The child sends ``ready`` first (its time counts from then on),
``started``, ``frame`` (once a frame, the sign of life) and ``progress`` every so many frames; it
ends with ``done``, ``stopped`` or ``failed``. Its results are files in the job's folder:
``frames.jsonl``, written frame by frame so that a crash loses nothing, and at the end the final
trajectory and the map. Its temporary files lie in a private folder that is removed with it.
"""

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

import psutil

from dynslam_bench.core import (
    DynslamError,
    InfrastructureError,
    PluginError,
    RunError,
    SegmentationError,
    SequenceError,
    SettingsError,
    TemporaryFolder,
    TrackerTimeoutError,
    TrajectoryError,
)
from dynslam_bench.core.plugins import ISOLATED_VARIABLE, load_object
from dynslam_bench.runs.process.fork_server import THREAD_VARIABLES, adopt_orphans

LOG_FILE = "log.txt"
READS_FILE = "reads.json"
"""Where the child puts what plug-ins and programs have read."""
_LONGEST = 400
_REFUSALS = (SettingsError, PluginError, TrajectoryError)
"""Raised before the first frame is tracked, these say that what was asked for cannot be."""
_DATA_FAULTS = (SequenceError, SegmentationError)
"""These say, whenever they are raised, that an image, a mask or a network's weights are at fault."""
_DISK_ERRORS = (errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EIO, errno.ESTALE)
"""Errors of a disk that is full, read-only, damaged or gone: no tracker is at fault."""


def main(connection: Connection) -> int:
    """Make one run.

    Args:
        connection: To the parent.

    Returns:
        Exit code: 0 even if the tracker failed and could say so.
    """
    with contextlib.suppress(OSError):
        os.setsid()  # so that the parent can end this process together with what a tracker starts
    # so that what a tracker starts and forgets stays below this process
    adopt_orphans(die_with_parent=True)
    spare_ancestors()
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
            with recording_reads(job, temporary.path) as keep_reads:

                def send(message: dict[str, Any]) -> None:
                    if message["type"] in ("started", "progress") or message.get("index") == 0:
                        keep_reads()  # a run that is killed later has read this much at least
                    _send(connection, message)

                message = work(job, send, stop.is_set)
    except BaseException as error:
        traceback.print_exc()
        message = describe_failure(error)
        if not Path(job["folder"]).is_dir():
            message |= {"infrastructure": f"{job['folder']} was removed"}
    _send(connection, message | {"peak_memory_mb": peak_memory_mb()})
    sys.stdout.flush()
    sys.stderr.flush()
    return 0


@contextmanager
def recording_reads(job: dict[str, Any], temporary: Path) -> Iterator[Callable[[], None]]:
    """Record what plug-ins and programs read while a run lasts, and write it into the run's folder at the end.

    A run that fails has read something, too: it is not made again while that is unchanged.

    Args:
        job: ``recorded`` says where plug-ins lie; None for a run without such.
        temporary: The run's private folder.

    Yields:
        A function that writes what was read so far.

    Raises:
        RunError: What was read has changed meanwhile.
    """
    if job.get("recorded") is None:
        yield lambda: None
        return
    from dynslam_bench.core.reads import Anchors, Reads
    from dynslam_bench.core.stage_cache import record_reads
    from dynslam_bench.runs.process.recorder import ReadRecorder

    about = job["recorded"]
    plugin = None if about["plugin"] is None else Path(about["plugin"])
    folder = Path(job["folder"])
    anchors = Anchors(plugin=plugin, work=Path(about["work"]))
    recorder = ReadRecorder(anchors, private=[temporary, folder], plugins=about["packages"])

    def keep(reads: Reads) -> None:
        (folder / READS_FILE).write_text(reads.to_json(), encoding="utf-8")

    recorder.start()
    record_reads(recorder.snapshot)
    try:
        yield lambda: keep(recorder.so_far())
    except BaseException:
        with contextlib.suppress(RunError):
            # the run's own error is the one to tell; what changed meanwhile shows at the look-up
            keep(recorder.finish())
        raise
    keep(recorder.finish())


def spare_ancestors() -> None:
    """From now on refuse this process' own signals to the processes above it: the fork server, the program, its shell.

    A tracker that ends its parent process, as a script does that ends what it was started by, would
    end all other runs. Python's calls alone are refused; what a program or a library signals,
    `run_one` finds out.
    """
    ancestors = {process.pid for process in psutil.Process().parents()}
    groups = {1}  # it stands for all processes
    for pid in ancestors:
        with contextlib.suppress(OSError):  # it has just ended
            groups.add(os.getpgid(pid))
    # the group of a process outside of this container; in a call 0 stands for one's own
    groups.discard(0)

    def refuse(event: str, arguments: tuple[Any, ...]) -> None:
        if event not in ("os.kill", "os.killpg"):
            return
        target, number = arguments
        is_process = event == "os.kill" and target in ancestors
        is_group = (target if event == "os.killpg" else -target) in groups
        if number and (is_process or is_group):  # number 0 asks whether the process is there
            raise PermissionError(
                errno.EPERM, f"a run may not signal process {target}, which it was started by"
            )

    sys.addaudithook(refuse)


def peak_memory_mb() -> float:
    """Largest resident memory of this process so far."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (
        1e6 if sys.platform == "darwin" else 1e3
    )


def _listen(connection: Connection, stop: threading.Event) -> None:
    """Wait for ``stop``; when the parent closes the connection, this process ends with its group."""
    with contextlib.suppress(EOFError, OSError):
        while connection.recv_bytes() == b"stop":
            stop.set()
    os.killpg(0, signal.SIGKILL)


def _send(connection: Connection, message: dict[str, Any]) -> None:
    try:
        connection.send_bytes(json.dumps(message).encode())
    except OSError:
        os.killpg(0, signal.SIGKILL)


def _redirect(log: Path) -> None:
    """Send everything that is printed, by whatever library, to the log, and the stack of a fatal signal."""
    with log.open("ab") as file:
        for number, stream in ((1, sys.stdout), (2, sys.stderr)):
            stream.flush()
            os.dup2(file.fileno(), number)
            if hasattr(stream, "reconfigure"):
                stream.reconfigure(line_buffering=True)
    faulthandler.enable(file=2, all_threads=False)
    programs = logging.getLogger("dynslam_bench.trackers.adapters.subprocess_tracker")
    programs.setLevel(logging.INFO)
    programs.addHandler(logging.StreamHandler(sys.stderr))


def _prepare(job: dict[str, Any]) -> None:
    """Take over the parent's environment, working folder and import path, and limit the threads."""
    wanted = {name: text for name, text in job["environment"].items() if name != "TMPDIR"}
    # the fork server still has what its parent has removed since
    for name in os.environ.keys() - wanted.keys() - {"TMPDIR", *THREAD_VARIABLES}:
        del os.environ[name]
    os.environ.update(wanted | {ISOLATED_VARIABLE: "1"})
    with contextlib.suppress(OSError):
        os.chdir(job["working_folder"])
    sys.path[:] = job["path"]
    limit_threads(job["spec"]["threads"])


def limit_threads(threads: int) -> None:
    """Give OpenCV, torch and numba that many threads; BLAS has one (see `fork_server.THREAD_VARIABLES`)."""
    import cv2

    cv2.setNumThreads(threads)
    torch = sys.modules.get("torch")
    numba = sys.modules.get("numba")
    if torch is None:
        os.environ["OMP_NUM_THREADS"] = str(threads)
    else:
        torch.set_num_threads(threads)
    if numba is None:
        os.environ["NUMBA_NUM_THREADS"] = str(threads)
    else:
        numba.set_num_threads(min(threads, numba.config.NUMBA_NUM_THREADS))


class FailedAt(Exception):
    """Where a run was when its cause was raised."""


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
    kind = type(cause).__name__

    def message(status: str, what: str, *, line: bool = False, **more: Any) -> dict[str, Any]:
        before = "" if not where or re.search(r"\bframe \d+", what) else f"{where}: "
        after = f" ({source})" if line and (source := source_line(cause)) else ""
        return {"type": "failed", "status": status, "reason": before + what + after, **more}

    broken = _broken_infrastructure(error)
    if broken:
        return message("crashed", broken, infrastructure=broken)
    if isinstance(cause, TrackerContractError):
        return message("invalid", text)
    named = (
        f"sys.exit({cause.code!r}) was called"
        if isinstance(cause, SystemExit)
        else f"{kind}: {text}".rstrip(": ")
    )
    if (
        isinstance(cause, MemoryError)
        or "out of memory" in text.lower()
        or kind == "OutOfMemoryError"
    ):
        return message("out-of-memory", named, line=True)
    data = (
        {} if raised_by_tracker(cause) and not isinstance(cause, _DATA_FAULTS) else {"data": True}
    )
    if isinstance(cause, TrackerTimeoutError):
        return message("timeout", text)
    if isinstance(cause, DynslamError):
        return message("crashed", text, refused=isinstance(cause, _REFUSALS), **data)
    return message("crashed", named, line=True, **data)


def _one_line(error: BaseException) -> str:
    return " ".join(str(error).split())[:_LONGEST]


def _broken_infrastructure(error: BaseException | None) -> str:
    """What of the infrastructure broke, by an exception or one of its causes; empty if nothing did."""
    while error is not None:
        if isinstance(error, InfrastructureError) or (
            isinstance(error, OSError) and error.errno in _DISK_ERRORS
        ):
            return _one_line(error)
        error = error.__cause__ or error.__context__
    return ""


def source_line(error: BaseException) -> str:
    """``file.py:31``: the innermost line of an exception's traceback outside of libraries, else the innermost."""
    lines = traceback.extract_tb(error.__traceback__)
    folders = map(sysconfig.get_path, ("stdlib", "platstdlib", "purelib", "platlib"))
    libraries = (*folders, "<", sys.base_prefix, __file__)
    outside = [
        line
        for line in lines
        if "site-packages" not in line.filename and not line.filename.startswith(libraries)
    ]
    return "".join(f"{Path(line.filename).name}:{line.lineno}" for line in (outside or lines)[-1:])


if __name__ == "__main__":
    # from the module, not from here: the loop raises the module's `FailedAt`
    from dynslam_bench.runs.process.child import main as make_run

    # threads that a tracker left running must not hold it up
    os._exit(make_run(Connection(int(sys.argv[1]))))
