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
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from dynslam_bench.core.plugin_probe import ISOLATED_VARIABLE
from dynslam_bench.core.plugins import load_object
from dynslam_bench.core.temporary import TemporaryFolder

from .failures import describe_failure
from .family import adopt_orphans, die_with_parent

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
