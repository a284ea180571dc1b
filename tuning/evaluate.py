"""Evaluating a configuration: on each instance it is a run of the run store, made once, in its own process."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from dynslam_bench.core.errors import StudyError
from dynslam_bench.evaluation.protocol import Protocol, get_protocol
from dynslam_bench.runs import RunEvent, RunRecord, RunStore, run_many, score
from dynslam_bench.trackers.registry import TRACKERS
from dynslam_bench.tuning.instances import ProblemInstance


@dataclass(frozen=True)
class Outcome:
    """One configuration on one instance.

    Attributes:
        instance: Where.
        run_id: The run.
        ate_m: ATE RMSE in metres, lost frames held at the last pose.
        coverage: Share of frames that were tracked.
        frame_s: Mean seconds a frame, segmentation included.
        processor_s: Mean processor seconds of that, all threads together; `frame_s` where the work is done elsewhere (a
            foreign program, a GPU). Unlike `frame_s` it hardly depends on what else the machine does.
        rtf: Real-time factor: duration of the instance's frames over the time they took.
    """

    instance: ProblemInstance
    run_id: str
    ate_m: float
    coverage: float
    frame_s: float
    processor_s: float
    rtf: float


class Configuration(NamedTuple):
    """A tracker and the overrides of its settings, by dotted name."""

    tracker: str
    settings: Mapping[str, Any]


FOREIGN = "transfer"
"""Stage that only trackers in another program have."""


class InstanceFailedError(StudyError):
    """A run did not come to its end; carries the instance, the run's status and the reason."""


class CancelledError(Exception):
    """The caller cancelled the evaluation."""


def evaluate(
    tracker: str,
    settings: Mapping[str, Any],
    instances: Iterable[ProblemInstance],
    *,
    results: RunStore | str | Path = "results",
    jobs: int = 1,
    protocol: Protocol | str = "tum-rgbd/v1",
    threads: int = 1,
    cache: bool = False,
    data_root: str | None = None,
    study: str = "",
    cancelled: Callable[[], bool] | None = None,
    on_run: Callable[[RunEvent], None] | None = None,
) -> dict[ProblemInstance, Outcome]:
    """Run a configuration on instances; runs that are stored are taken from there.

    Args:
        tracker: Id, ``module:Attr`` or ``file.py:Attr``.
        settings: Overrides of its settings, dotted name to value.
        instances: Where; in the order in which they are begun.
        results: The results folder, or a store.
        jobs: Runs at a time.
        protocol: Protocol of the errors; lost frames are always held at the last pose.
        threads: Threads of a run.
        cache: Whether runs use the stage cache; times are then those of when its entries were made.
        data_root: Folder of the recorded sequences.
        study: Name of the study that the runs are made for, which is in their records.
        cancelled: Called many times a second; True ends the runs at once.
        on_run: Called with every event of every run, by several threads where `jobs` is more than 1.

    Returns:
        The outcome on each instance, in their order.

    Raises:
        InstanceFailedError: A run crashed, timed out, ran out of memory or was invalid; the others are not waited for.
        CancelledError: `cancelled` said so.
        DynslamError: Tracker, settings or an instance are unknown or unfit; nothing ran.
    """
    store = results if isinstance(results, RunStore) else RunStore(results)
    held, instances, stop = held_protocol(protocol), list(instances), [False]
    held.check_scale(tracker, TRACKERS.get(tracker).sensors)

    def ended() -> bool:
        return stop[0] or (cancelled is not None and cancelled())

    def one(instance: ProblemInstance) -> Outcome:
        how = {"threads": threads, "cache": cache, "data_root": data_root, "study": study}
        spec = instance.run_spec(tracker, settings=dict(settings), **how)
        if ended():
            raise CancelledError(str(instance))
        (record,) = run_many([spec], results=store, protocol=held, cancelled=ended, on_event=on_run)
        return outcome(store, record, instance, held, data_root)

    with ThreadPoolExecutor(max(1, min(jobs, len(instances))), thread_name_prefix="dynslam-instance") as pool:
        try:
            return dict(zip(instances, pool.map(one, instances), strict=True))
        except BaseException:
            stop[0] = True
            raise


def outcome(
    store: RunStore, record: RunRecord, instance: ProblemInstance, protocol: Protocol, data_root: str | None
) -> Outcome:
    """The outcome of a stored run; one in which nothing was tracked has the error of a static camera.

    Raises:
        InstanceFailedError: It did not come to its end.
        CancelledError: It was stopped.
    """
    if record.status == "stopped":
        raise CancelledError(str(instance))
    if record.failed:
        raise InstanceFailedError(f"{instance}: {record.status}: {record.reason}")
    evaluation = score(store, record, protocol).online
    ate = static_camera_m(instance, data_root) if evaluation is None else float(evaluation.metrics["ate_rmse_m"])
    total = record.timings["total"].mean_s
    period = record.sequence.duration_s / max(record.sequence.frames - 1, 1)
    return Outcome(instance, record.run_id, ate, record.coverage, total, processor_seconds(record), period / total)


def processor_seconds(record: RunRecord) -> float:
    """Mean processor seconds a frame of a run; its frame time where the work is not that of its own process."""
    own = record.timings.get("processor")
    elsewhere = record.device.startswith("cuda") or FOREIGN in record.timings
    return record.timings["total"].mean_s if own is None or elsewhere else own.mean_s


def held_protocol(protocol: Protocol | str) -> Protocol:
    """The protocol with lost frames held at the last pose, so that losing track never pays."""
    protocol = get_protocol(protocol)
    if protocol.lost_frames == "hold":
        return protocol
    return protocol.model_copy(update={"id": f"{protocol.id}+hold", "lost_frames": "hold"})


@lru_cache(maxsize=256)
def static_camera_m(instance: ProblemInstance, data_root: str | None) -> float:
    """ATE RMSE in metres of a static camera on an instance, from the ground truth of its frames alone."""
    sequence: Any = instance.open(data_root)
    truth, stamps = sequence.ground_truth, sequence.timestamps
    positions = truth.positions[(truth.timestamps >= stamps[0]) & (truth.timestamps <= stamps[-1])]
    return float(np.sqrt(np.square(positions - positions.mean(axis=0)).sum(axis=1).mean()))
