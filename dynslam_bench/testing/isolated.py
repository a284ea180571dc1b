"""The conformance checks of a tracker in processes of their own: one that exits, hangs or crashes fails a check.

The checks run one after the other in a child of the kind that makes runs. If the child dies, or gives no sign of life
for too long, the check that it was at has failed, and another child goes on with the next one.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping
from dataclasses import asdict
from typing import Any

from dynslam_bench.core import errors
from dynslam_bench.core.errors import DynslamError
from dynslam_bench.core.files import TemporaryFolder
from dynslam_bench.runs.process.child import LOG_FILE
from dynslam_bench.runs.process.fork_server import Child, make_job
from dynslam_bench.runs.process.supervisor import LogFile, Verdict, supervise
from dynslam_bench.runs.spec import Limits
from dynslam_bench.testing.report import OBSERVER, Check, ConformanceReport

FRAME_S = 60.0
START_S = 300.0
_WORK = "dynslam_bench.testing.isolated:work"
_CAUSES = {
    "crashed": "os._exit, exit() or a fault in a library that the tracker calls",
    "timeout": "an endless loop or a lock; --time-limit gives slow trackers more time",
    "out-of-memory": "what a frame allocates is never freed; --memory-limit gives more",
}

OnCheck = Callable[[Check], None]


def isolated_tracker_report(
    tracker: str,
    *,
    settings: Mapping[str, Any] | None = None,
    frames: int = 6,
    seed: int = 0,
    frame_s: float = FRAME_S,
    start_s: float = START_S,
    memory_mb: float | None = None,
    on_check: OnCheck | None = None,
    on_wait: Callable[[str], None] | None = None,
) -> ConformanceReport:
    """`tracker_report` in child processes, each with everything that it started ended afterwards.

    Args:
        tracker: Id, ``id:value``, ``module:Attr`` or ``file.py:Attr``; only the children load it.
        settings: Overrides of its settings by dotted name.
        frames: How many frames to track in each check.
        seed: Seed of the randomness.
        frame_s: Seconds for one frame, or for any other step of a check.
        start_s: Seconds until the first frame is tracked: loading, compiling.
        memory_mb: Memory that it may take; None for the default share of the machine's, 0 for no limit.
        on_check: Told of every outcome at once.
        on_wait: Told many times a second which check is running.

    Returns:
        Every check's outcome.

    Raises:
        PluginError: There is no such tracker.
        SettingsError: The settings do not fit.
        DynslamError: The children cannot be started.
    """
    subject = f"tracker {tracker!r}"
    known: list[Check] = []
    limits = Limits(start_s=start_s, frame_s=frame_s, memory_mb=memory_mb)
    while True:
        follow = _Follower(known, on_check, on_wait)
        with contextlib.closing(TemporaryFolder()) as folder:
            log = LogFile(folder.path / LOG_FILE)
            told = [asdict(check) for check in known]
            wanted = {"tracker": tracker, "settings": dict(settings or {}), "frames": frames, "seed": seed}
            job = make_job(_WORK, folder.path, spec={"threads": 1}, known=told, **wanted)

            def tick(log: LogFile = log, follow: _Follower = follow) -> None:
                log.look()
                follow.wait()

            verdict = supervise(Child(), job, limits, follow.told, tick=tick, located=False)
        subject = verdict.final.get("subject", subject)
        if verdict.status == "ok":
            return ConformanceReport(subject, known)
        failure = _failure(verdict, follow)
        known.append(failure)
        if on_check is not None:
            on_check(failure)
        if not follow.running:  # not at any check: another child would fare no better
            return ConformanceReport(subject, known)


class _Follower:
    """The parent's side: collects what the child tells."""

    def __init__(self, known: list[Check], on_check: OnCheck | None, on_wait: Callable[[str], None] | None) -> None:
        self.known, self.on_check, self.on_wait = known, on_check, on_wait
        self.running = ""

    def told(self, message: dict[str, Any]) -> bool:
        if "running" in message:
            self.running = message["running"]
        else:
            check = Check(**message["check"])
            self.known.append(check)
            self.running = ""
            if self.on_check is not None:
                self.on_check(check)
        return True

    def wait(self) -> None:
        if self.on_wait is not None and self.running:
            self.on_wait(self.running)


def _failure(verdict: Verdict, follow: _Follower) -> Check:
    """The outcome of the check at which a child ended.

    Raises:
        DynslamError: What was asked for cannot be: no such tracker, or unfit settings.
    """
    kind = verdict.final.get("error", "")
    if kind and not follow.running:
        raise _error(kind, verdict.reason)
    name = follow.running or (f"after {follow.known[-1].name}" if follow.known else "loading")
    cause = _CAUSES.get(verdict.status, "") if not kind else ""
    return Check(name, "failed", f"{verdict.reason} (likely cause: {cause})" if cause else verdict.reason)


def _error(kind: str, text: str) -> DynslamError:
    found = getattr(errors, kind, DynslamError)
    return found(text) if isinstance(found, type) and issubclass(found, DynslamError) else DynslamError(text)


class _Teller:
    """The child's side: an observer of the report."""

    def __init__(self, known: list[Check], send: Callable[[dict[str, Any]], None]) -> None:
        self._known = {check.name: check for check in known}
        self._send = send
        self._tracked = -1

    def verdict(self, name: str) -> Check | None:
        if name not in self._known:
            self._send({"type": "progress", "running": name})
        return self._known.get(name)

    def alive(self) -> None:
        self._tracked += 1
        self._send({"type": "frame", "index": self._tracked})

    def ended(self, check: Check) -> None:
        self._send({"type": "progress", "check": asdict(check)})


def work(job: dict[str, Any], send: Callable[[dict[str, Any]], None], stopping: Callable[[], bool]) -> dict[str, Any]:
    """What the child does: the checks whose outcome is not known yet."""
    from dynslam_bench.testing.tracker import tracker_report

    known = [Check(**check) for check in job["known"]]
    token = OBSERVER.set(_Teller(known, send))
    try:
        report = tracker_report(job["tracker"], settings=job["settings"], frames=job["frames"], seed=job["seed"])
    except DynslamError as error:
        return {"type": "failed", "status": "crashed", "reason": str(error), "error": type(error).__name__}
    finally:
        OBSERVER.reset(token)
    return {"type": "done", "subject": report.subject}
