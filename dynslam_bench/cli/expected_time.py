"""How many frames runs have, and how long they take by what stored runs of the same trackers took here."""

from __future__ import annotations

from collections.abc import Collection
from statistics import median
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from dynslam_bench.runs import RunStore
    from dynslam_bench.runs.identity import ResolvedRun

MOST_LOOKED_AT, MOST_ALIKE = 100, 5
"""Stored runs, the newest first, that are looked through for those of a tracker, and how many of these count."""


def plan_words(runs: Collection[ResolvedRun], store: RunStore, jobs: int) -> str:
    """How many frames are to be tracked, and how long that takes by what stored runs of the same trackers took."""
    from dynslam_bench.runs.one import PROGRESS_EVERY

    frames = sum(len(run.sequence) for run in runs)
    words = f"{len(runs)} run{'s' * (len(runs) != 1)}, {frames} frames"
    times = frame_times(runs, store)
    known = [run for run in runs if _kind(run) in times]
    if not known:
        later = f"; how long it takes is known after the first {PROGRESS_EVERY}" if frames > PROGRESS_EVERY else ""
        return words + later
    expected_s = sum(len(run.sequence) * times[_kind(run)] for run in known) / min(jobs, len(runs))
    low, high = _seconds(min(times.values())), _seconds(max(times.values()))
    rate = low if low == high else f"{low} to {high}"
    some = f" for {len(known)} of them" if len(known) < len(runs) else ""
    return f"{words}, about {_seconds(expected_s)}{some} (stored runs on this machine took {rate} a frame)"


def frame_times(runs: Collection[ResolvedRun], store: RunStore) -> dict[tuple[str, str], float]:
    """Seconds of wall-clock time a frame of stored runs on a machine like this: the median by tracker and masks."""
    from dynslam_bench.core.machine import this_machine

    wanted, times = {_kind(run) for run in runs}, dict[tuple[str, str], list[float]]()
    newest = sorted(store.ids(), key=lambda run_id: -store.folder(run_id).stat().st_mtime)
    machine = this_machine()
    for record in filter(None, map(store.get, newest[:MOST_LOOKED_AT])):
        kind = (record.tracker.id, record.segmentation)
        here = record.machine is not None and (record.machine.cpu, record.machine.cores) == (machine.cpu, machine.cores)
        if kind in wanted and here and record.status in ("ok", "lost") and record.n_processed and record.wall_s:
            times.setdefault(kind, []).append(record.wall_s / record.n_processed)
    return {kind: median(found[:MOST_ALIKE]) for kind, found in times.items()}


def _kind(run: ResolvedRun) -> tuple[str, str]:
    return run.tracker.id, run.segmentation


def _seconds(value: float) -> str:
    for unit, seconds in (("h", 3600.0), ("min", 60.0), ("s", 1.0)):
        if value >= 1.5 * seconds:
            return f"{value / seconds:.2g} {unit}" if value < 10 * seconds else f"{value / seconds:.0f} {unit}"
    return f"{1000 * value:.0f} ms"
