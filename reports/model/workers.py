"""Worker processes that score runs and write pages: Python programs of their own, which get calls through pipes.

`multiprocessing` starts its workers with the caller's ``__main__``: a script without
``if __name__ == "__main__"`` would run again in every worker, and there is no option against it. A
worker here imports nothing but the modules of the functions that it is asked to call.
"""

import os
import pickle
import subprocess
import sys
import threading
import traceback
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from itertools import starmap
from queue import SimpleQueue
from typing import Any, BinaryIO, TypeVar

from dynslam_bench.core import InfrastructureError
from dynslam_bench.runs.process.jobs import THREAD_VARIABLES

T = TypeVar("T")
Call = tuple[Callable[..., Any], Sequence[tuple[Any, ...]]]
"""A function of a module, and its arguments in each of several jobs."""
MANY = 250
"""Runs from which on worker processes save more time than they need to start."""
MOST_WORKERS = 8
"""Worker processes of one report at most."""
_AT_ONCE = 40
"""Jobs that a worker takes at once."""
_PROGRAM = (
    "import sys; sys.path[:] = sys.argv[1:]; import pickle, signal; "
    "signal.signal(signal.SIGINT, signal.SIG_IGN); pickle.load(sys.stdin.buffer)()"
)
"""Program of a worker.

It finds modules where the caller does, leaves Ctrl-C to the caller, and gets `serve` as first message.
"""


# -- in the caller's process


class WorkerPool:
    """Worker processes, each started when there is work for it. One thread of the caller waits for each."""

    def __init__(self, most: int) -> None:
        """Prepare a pool of at most so many workers."""
        self._threads = ThreadPoolExecutor(most)
        self._idle: list[subprocess.Popen[bytes]] = []

    def answers(self, function: Callable[..., T], jobs: Sequence[tuple[Any, ...]]) -> Iterator[T]:
        """Yield what the function returns for each job, in the order of the jobs, each as soon as it is there."""
        chunks = [jobs[first : first + _AT_ONCE] for first in range(0, len(jobs), _AT_ONCE)]
        futures = [self._threads.submit(self._call, (function, chunk)) for chunk in chunks]
        try:
            for future in futures:
                yield from future.result()
        finally:
            for future in futures:
                future.cancel()

    def _call(self, call: Call) -> list[Any]:
        """Make one call in a worker that is idle, or in a new one; raise what it raised there."""
        try:
            worker = self._idle.pop()
        except IndexError:
            worker = _start_worker()
        try:
            answer, trace = _exchange(worker, call)
        finally:
            self._idle.append(worker)
        if isinstance(answer, Exception):
            raise answer from RuntimeError(f"in a worker process:\n{trace}")
        return list(answer)

    def close(self) -> None:
        """Wait for the calls that are made, and end the workers."""
        self._threads.shutdown(cancel_futures=True)
        for worker in self._idle:
            # a worker ends with its input; one that has died may have left some of it unread
            with suppress(BrokenPipeError):
                worker.communicate()


def _start_worker() -> "subprocess.Popen[bytes]":
    """Start a worker that imports modules from where the caller does."""
    command = [sys.executable, "-c", _PROGRAM, *sys.path]
    # a worker a core: the numerical libraries get no threads of their own
    environment = os.environ | dict.fromkeys(THREAD_VARIABLES, "1")
    worker = subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=environment
    )
    with suppress(BrokenPipeError):  # it has died; the first call tells
        _send(worker.stdin, serve)
    return worker


def _exchange(worker: "subprocess.Popen[bytes]", call: Call) -> tuple[Any, str]:
    """Send a call and wait for the answer: the results or an error, and the trace of the error.

    Raises:
        InfrastructureError: The worker has died.
    """
    assert worker.stdout is not None
    try:
        _send(worker.stdin, call)
        answer, trace = pickle.load(worker.stdout)
    except (BrokenPipeError, EOFError, pickle.UnpicklingError) as error:
        status = worker.wait()
        raise InfrastructureError(
            f"a worker process of the report ended early: exit status {status}"
        ) from error
    return answer, trace


def _send(stream: Any, value: object) -> None:
    """Write one message to a pipe."""
    stream.write(pickle.dumps(value))
    stream.flush()


@contextmanager
def worker_pool(runs: int) -> Iterator[WorkerPool | None]:
    """As many worker processes as so many runs are worth on this machine; None where they are worth none."""
    cores = os.cpu_count() or 1
    if hasattr(os, "sched_getaffinity"):
        cores = len(os.sched_getaffinity(0))
    if runs < MANY or cores == 1:
        yield None
        return
    pool = WorkerPool(min(cores, MOST_WORKERS))
    try:
        yield pool
    finally:
        pool.close()


def run_jobs(
    pool: WorkerPool | None, function: Callable[..., T], jobs: Sequence[tuple[Any, ...]]
) -> Iterator[T]:
    """Call a function once a job, in worker processes or here.

    Args:
        pool: The workers; None to call it here.
        function: A function of a module.
        jobs: Its arguments.

    Yields:
        The answers in the order of the jobs, each as soon as it is there.

    Raises:
        DynslamError: A job cannot be done.
        InfrastructureError: A worker has died.
    """
    if pool is None:
        yield from starmap(function, jobs)
    else:
        yield from pool.answers(function, jobs)


# -- in a worker


def serve() -> None:
    """Make the calls that come through standard input, and answer through standard output, until the input ends."""
    # what functions print goes to standard error, since answers have standard output for themselves
    answers = os.fdopen(os.dup(sys.stdout.fileno()), "wb")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())

    # a thread of its own reads, so that a worker ends with its caller and not only after its call
    calls: SimpleQueue[Call | Exception] = SimpleQueue()
    threading.Thread(target=_read_calls, args=(sys.stdin.buffer, calls), daemon=True).start()
    while True:
        call = calls.get()
        try:
            if isinstance(call, Exception):
                raise call
            function, jobs = call
            answer: tuple[Any, str] = (list(starmap(function, jobs)), "")
        except Exception as error:
            answer = (error, traceback.format_exc())
        _send(answers, answer)


def _read_calls(stream: BinaryIO, calls: "SimpleQueue[Call | Exception]") -> None:
    """Hand on the calls that come; end the process with the stream."""
    while True:
        try:
            calls.put(pickle.load(stream))
        except EOFError:
            os._exit(0)
        except Exception as error:  # e.g. the function's module cannot be imported
            calls.put(error)
