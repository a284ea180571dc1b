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
import resource
import signal
import sys
import tempfile
import threading
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import psutil

from dynslam_bench.core import RunError, TemporaryFolder
from dynslam_bench.core.plugins import ISOLATED_VARIABLE, load_object
from dynslam_bench.runs.process.failures import describe_failure
from dynslam_bench.runs.process.jobs import LOG_FILE as LOG_FILE  # `testing` takes it from here
from dynslam_bench.runs.process.jobs import READS_FILE, THREAD_VARIABLES
from dynslam_bench.runs.process.process_trees import adopt_orphans

_CHECKPOINTS = ("started", "progress")
"""Messages before which the reads so far are written: a run that is killed later has read this much at least."""


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
    except EOFError:  # the parent wants no run any more
        return 0
    _send(connection, {"type": "ready"})
    _redirect(Path(job["folder"]) / LOG_FILE)
    stop = threading.Event()
    threading.Thread(target=_listen, args=(connection, stop), daemon=True).start()
    try:
        message = _do(job, connection, stop)
    except BaseException as error:
        traceback.print_exc()
        message = describe_failure(error)
        if not Path(job["folder"]).is_dir():
            message |= {"infrastructure": f"{job['folder']} was removed"}
    _send(connection, message | {"peak_memory_mb": peak_memory_mb()})
    sys.stdout.flush()
    sys.stderr.flush()
    return 0


def _do(job: dict[str, Any], connection: Connection, stop: threading.Event) -> dict[str, Any]:
    """Do the job in a private folder for temporary files, and give its last message."""
    with contextlib.closing(TemporaryFolder()) as temporary:
        tempfile.tempdir = str(temporary.path)
        os.environ["TMPDIR"] = tempfile.tempdir
        _prepare(job)
        work = load_object(job["work"])
        with recording_reads(job, temporary.path) as write_reads:

            def send(message: dict[str, Any]) -> None:
                if message["type"] in _CHECKPOINTS or message.get("index") == 0:
                    write_reads()
                _send(connection, message)

            last: dict[str, Any] = work(job, send, stop.is_set)
            return last


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
    from dynslam_bench.core.reads import BaseFolders, Reads
    from dynslam_bench.core.stage_cache import record_reads
    from dynslam_bench.runs.process.recorder import ReadRecorder

    recorded = job["recorded"]
    plugin = None if recorded["plugin"] is None else Path(recorded["plugin"])
    folder = Path(job["folder"])
    base_folders = BaseFolders(plugin=plugin, work=Path(recorded["work"]))
    recorder = ReadRecorder(base_folders, private=[temporary, folder], plugins=recorded["packages"])

    def write(reads: Reads) -> None:
        (folder / READS_FILE).write_text(reads.to_json(), encoding="utf-8")

    recorder.start()
    record_reads(recorder.snapshot)
    try:
        yield lambda: write(recorder.so_far())
    except BaseException:
        with contextlib.suppress(RunError):
            # the run's own error is the one to tell; what changed meanwhile shows at the look-up
            write(recorder.finish())
        raise
    write(recorder.finish())


def spare_ancestors() -> None:
    """From now on refuse this process' own signals to the processes above it: the fork server, the program, its shell.

    A tracker that ends its parent process, as a script does that ends what it was started by, would
    end all other runs. Python's calls alone are refused; what a program or a library signals,
    `run_one` finds out.
    """
    ancestors = {process.pid for process in psutil.Process().parents()}
    groups = {1}  # -1 as a target of os.kill stands for all processes
    for pid in ancestors:
        with contextlib.suppress(OSError):  # it has just ended
            groups.add(os.getpgid(pid))
    # the group of a process outside of this container; in a call 0 stands for one's own
    groups.discard(0)

    def refuse(event: str, arguments: tuple[Any, ...]) -> None:
        if event not in ("os.kill", "os.killpg"):
            return
        target, signal_number = arguments
        # os.kill takes a group as a negative number
        group = target if event == "os.killpg" else -target
        is_ancestor = event == "os.kill" and target in ancestors
        is_probe = not signal_number  # signal 0 asks whether the process is there
        if not is_probe and (is_ancestor or group in groups):
            raise PermissionError(
                errno.EPERM, f"a run may not signal process {target}, which it was started by"
            )

    sys.addaudithook(refuse)


def peak_memory_mb() -> float:
    """Largest resident memory of this process so far, in MB."""
    units_per_mb = 1e6 if sys.platform == "darwin" else 1e3  # macOS counts bytes, Linux kilobytes
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / units_per_mb


def _listen(connection: Connection, stop: threading.Event) -> None:
    """Wait for ``stop``; when the parent closes the connection, this process ends with its group."""
    with contextlib.suppress(EOFError, OSError):
        while connection.recv_bytes() == b"stop":
            stop.set()
    os.killpg(0, signal.SIGKILL)


def _send(connection: Connection, message: dict[str, Any]) -> None:
    """Send a message; when the parent has closed the connection, this process ends with its group."""
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
    variables = {name: text for name, text in job["environment"].items() if name != "TMPDIR"}
    # the fork server still has what its parent has removed since
    for name in os.environ.keys() - variables.keys() - {"TMPDIR", *THREAD_VARIABLES}:
        del os.environ[name]
    os.environ.update(variables | {ISOLATED_VARIABLE: "1"})
    with contextlib.suppress(OSError):
        os.chdir(job["working_folder"])
    sys.path[:] = job["path"]
    limit_threads(job["spec"]["threads"])


def limit_threads(threads: int) -> None:
    """Give OpenCV, torch and numba that many threads; BLAS has one (see `jobs.THREAD_VARIABLES`)."""
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


if __name__ == "__main__":
    # threads that a tracker left running must not hold it up
    os._exit(main(Connection(int(sys.argv[1]))))
