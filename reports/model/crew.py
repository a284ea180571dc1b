"""Helper processes of a report: thousands of runs are read, scored and drawn on all cores.

A helper is a fresh interpreter that runs `reports.worker`; jobs and answers are JSON, one a line. A fork would be
cheaper to start, but a library cannot know which threads its caller has; few runs need no helpers at all.
"""

from __future__ import annotations

import json
import os
import queue
import subprocess
import sys
import threading
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from types import TracebackType
from typing import Any

from dynslam_bench.core.errors import InfrastructureError, ReportError
from dynslam_bench.runs.process.server import child_environment

MODULE = "dynslam_bench.reports.worker"
MANY = 250
"""Runs from which on helpers save more time than they need to start."""
MOST = 8
JOB = 40
"""Runs of one job, at most."""

Heard = Callable[[int, str], None]
"""Called as ``heard(runs that were done, what was done)``, by one thread at a time."""


def unheard_run(done: int, what: str) -> None:
    """Progress that nobody wants to hear of."""


def helpers_for(runs: int) -> int:
    """How many helpers so many runs are worth on this machine; 0 for none."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return min(cores, MOST) if runs >= MANY and cores > 1 else 0


class Crew:
    """Some helpers, who go with the block that they were hired for.

    Args:
        count: How many.
        setup: What all of them have to know, see `reports.worker`.

    Raises:
        InfrastructureError: They cannot be started.
    """

    def __init__(self, count: int, setup: Mapping[str, Any]) -> None:
        self._helpers: list[subprocess.Popen[str]] = []
        try:
            for _ in range(count):
                self._helpers.append(
                    subprocess.Popen(
                        [sys.executable, "-m", MODULE],
                        stdin=subprocess.PIPE,
                        stdout=subprocess.PIPE,
                        text=True,
                        encoding="utf-8",
                        env=child_environment(),
                        start_new_session=True,  # Ctrl-C is for us; they end when their input does
                    )
                )
                _send(self._helpers[-1], dict(setup))
        except OSError as error:
            self.__exit__(None, None, None)
            raise InfrastructureError(f"cannot start {sys.executable}: {error.strerror}") from error

    def __enter__(self) -> Crew:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        for helper in self._helpers:
            helper.kill()
        for helper in self._helpers:
            with suppress(OSError):  # what was not sent yet goes nowhere
                helper.communicate()

    def work(
        self,
        kind: str,
        jobs: Sequence[Mapping[str, Any]],
        heard: Heard,
        understood: Callable[[Any], Any] = lambda answer: answer,
    ) -> list[Any]:
        """Share jobs out among the helpers, the next job to whoever is free.

        Args:
            kind: A function of `reports.worker`.
            jobs: What each is called with.
            heard: Told of every run that is done.
            understood: Makes of an answer, as soon as it is there, what is kept of it.

        Returns:
            The answers in the order of the jobs.

        Raises:
            ReportError: A job cannot be done.
            InfrastructureError: A helper has died.
        """
        open_jobs: queue.SimpleQueue[int] = queue.SimpleQueue()
        for number in range(len(jobs)):
            open_jobs.put(number)
        answers: list[Any] = [None] * len(jobs)
        faults: list[Exception] = []
        lock = threading.Lock()

        def tell(done: int, what: str) -> None:
            with lock:
                heard(done, what)

        def serve(helper: subprocess.Popen[str]) -> None:
            with suppress(queue.Empty):
                while not faults:
                    number = open_jobs.get_nowait()
                    try:
                        answers[number] = understood(_asked(helper, kind, jobs[number], tell))
                    except Exception as error:  # raised again below, by the thread that asked
                        faults.append(error)

        threads = [threading.Thread(target=serve, args=(helper,), daemon=True) for helper in self._helpers]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        if faults:
            raise faults[0]
        return answers


def _send(helper: subprocess.Popen[str], message: Mapping[str, Any]) -> None:
    assert helper.stdin is not None
    helper.stdin.write(json.dumps(message) + "\n")
    helper.stdin.flush()


def _asked(helper: subprocess.Popen[str], kind: str, job: Mapping[str, Any], tell: Heard) -> Any:
    """The answer of one helper to one job."""
    assert helper.stdout is not None
    with suppress(BrokenPipeError):  # it is gone: there is no answer either
        _send(helper, {"kind": kind, "job": job})
        for line in helper.stdout:
            said = json.loads(line)
            if "answer" in said:
                return said["answer"]
            if "fault" in said:
                raise ReportError(*said["fault"])
            tell(said["done"], said["what"])
    raise InfrastructureError(f"a helper process of the report ended early (exit status {helper.wait()})")
