"""The conformance checks of a tracker in child processes: a tracker that exits, hangs or crashes fails a check.

The checks run one after the other in a child of the kind that makes runs. If the child dies, or
makes no progress for too long, the running check has failed, and another child continues with the
next one.
"""

import contextlib
from collections.abc import Callable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from dynslam_bench.core import DynslamError, TemporaryFolder, errors
from dynslam_bench.runs.process.child import LOG_FILE
from dynslam_bench.runs.process.fork_server import Child, make_job
from dynslam_bench.runs.process.supervisor import LONGEST_YET, ProcessEnd, bound_log, supervise
from dynslam_bench.runs.spec import Limits
from dynslam_bench.testing.report import Check, ConformanceReport

_WORK = "dynslam_bench.testing.isolated:work"
"""The function that a child runs."""
_CAUSES = {
    "crashed": "os._exit, exit() or a fault in a library that the tracker calls",
    "timeout": "an endless loop or a lock; --time-limit gives slow trackers more time",
    "out-of-memory": "what a frame allocates is never freed; --memory-limit gives more",
}
"""Likely causes of the ends of a child."""


def isolated_tracker_report(
    tracker: str,
    *,
    settings: Mapping[str, Any] | None = None,
    frames: int = 6,
    seed: int = 0,
    frame_s: float = 60.0,
    start_s: float = 300.0,
    memory_mb: float | None = None,
    on_check: Callable[[Check], None] = lambda _: None,
    on_wait: Callable[[str], None] = lambda _: None,
) -> ConformanceReport:
    """`tracker_report` in child processes, each with everything that it started ended afterwards.

    Args:
        tracker: Id, ``id:value``, ``module:Attr`` or ``file.py:Attr``; only the children load it.
        settings: Overrides of its settings by dotted name.
        frames: How many frames to track in each check.
        seed: Seed of the randomness.
        frame_s: Seconds for one frame, or for any other step of a check.
        start_s: Seconds until the first frame is tracked: loading, compiling.
        memory_mb: Memory that it may take; None for the default share of the machine's, 0 for no
            limit.
        on_check: Called with every outcome at once.
        on_wait: Called many times a second with the name of the running check.

    Returns:
        Every check's outcome.

    Raises:
        PluginError: There is no such tracker.
        SettingsError: The settings do not fit.
        DynslamError: The children cannot be started.
    """
    checks: list[Check] = []
    limits = Limits(start_s=start_s, frame_s=frame_s, memory_mb=memory_mb)
    job_options = {
        "tracker": tracker,
        "settings": dict(settings or {}),
        "frames": frames,
        "seed": seed,
    }
    running = ""  # the check that runs in the child; empty between two

    def add(check: Check) -> None:
        checks.append(check)
        on_check(check)

    def receive(message: dict[str, Any]) -> bool:
        nonlocal running
        running = message.get("running", "")
        if not running:
            add(Check(**message["check"]))
        return True

    # a child for all checks; after one that died or hung, another for those that are left
    while True:
        running = ""
        with contextlib.closing(TemporaryFolder()) as folder:

            def tick(log: Path = folder.path / LOG_FILE) -> None:
                bound_log(log, LONGEST_YET)
                if running:  # noqa: B023
                    on_wait(running)  # noqa: B023

            job = make_job(
                _WORK,
                folder.path,
                spec={"threads": 1},
                known=[asdict(check) for check in checks],
                **job_options,
            )
            end = supervise(Child(), job, limits, receive, tick=tick, located=False)
        if end.status != "ok":
            add(_failure(end, running, checks))
        # between two checks, another child would fail alike
        if end.status == "ok" or not running:
            return ConformanceReport(end.final.get("subject", f"tracker {tracker!r}"), checks)


def _failure(end: ProcessEnd, running: str, checks: list[Check]) -> Check:
    """The outcome of the check at which a child ended.

    Raises:
        DynslamError: There is no such tracker, or the settings do not fit.
    """
    kind = end.final.get("error", "")
    if kind and not running:
        raise getattr(errors, kind, DynslamError)(end.reason)
    name = running or (f"after {checks[-1].name}" if checks else "loading")
    cause = "" if kind else _CAUSES.get(end.status, "")
    message = f"{end.reason} (likely cause: {cause})" if cause else end.reason
    return Check(name, "failed", message)


class _SentReport(ConformanceReport):
    """In the child: sends its progress to the parent, and skips the checks whose outcome is known."""

    def __init__(self, known: list[Check], send: Callable[[dict[str, Any]], None]) -> None:
        super().__init__("")
        self._known = {check.name: check for check in known}
        self._send = send
        self._tracked = -1

    def run(self, name: str, check: Callable[[], object]) -> bool:
        if name in self._known:
            self.checks.append(self._known[name])
            return self.checks[-1].status != "failed"
        self._send({"type": "progress", "running": name})
        passed = super().run(name, check)
        self._send({"type": "progress", "check": asdict(self.checks[-1])})
        return passed

    def alive(self) -> None:
        self._tracked += 1
        self._send({"type": "frame", "index": self._tracked})


def work(
    job: dict[str, Any], send: Callable[[dict[str, Any]], None], stopping: Callable[[], bool]
) -> dict[str, Any]:
    """The child's work: the checks whose outcome is not known yet."""
    from dynslam_bench.testing.tracker import tracker_report

    report = _SentReport([Check(**check) for check in job["known"]], send)
    try:
        tracker_report(
            job["tracker"],
            settings=job["settings"],
            frames=job["frames"],
            seed=job["seed"],
            report=report,
        )
    except DynslamError as error:
        return {
            "type": "failed",
            "status": "crashed",
            "reason": str(error),
            "error": type(error).__name__,
        }
    return {"type": "done", "subject": report.subject}
