"""Scoring stored runs; runs are never made again for it."""

from __future__ import annotations

from typing import Literal

from dynslam_bench.core.errors import EvaluationError, TrajectoryError
from dynslam_bench.evaluation.evaluate import Evaluation, evaluate
from dynslam_bench.evaluation.protocol import Protocol, get_protocol
from dynslam_bench.geometry.trajectory import Trajectory

from .record import MetricRecord, RunRecord
from .store import RunStore

DEFAULT_PROTOCOL = "tum-rgbd/v1"


def score(
    store: RunStore, record: RunRecord, protocol: Protocol | str = DEFAULT_PROTOCOL, *, again: bool = False
) -> MetricRecord:
    """The metrics of a stored run under a protocol, from its stored trajectories and ground truth.

    Args:
        store: Where the run lies.
        record: The run.
        protocol: A protocol or its id.
        again: Compute them even if they are stored.

    Returns:
        The metrics; evaluations that are not possible are None, with the reason.
    """
    protocol = get_protocol(protocol)
    stored = None if again else store.metrics(record.run_id, protocol)
    if stored is not None:
        return stored
    truth = store.ground_truth(record.sequence.part)
    found: dict[str, Evaluation | None] = {}
    reasons: dict[str, str] = {}
    for which in ("online", "final"):
        trajectory = store.trajectory(record.run_id, which)
        try:
            found[which] = _evaluate(trajectory, truth, protocol, store, record)
        except (EvaluationError, TrajectoryError) as error:
            found[which], reasons[which] = None, str(error)
    metrics = MetricRecord(
        run_id=record.run_id, protocol_id=protocol.id, protocol_digest=protocol.digest(),
        trajectory=_which(store, record, protocol), online=found["online"], final=found["final"], reasons=reasons,
    )  # fmt: skip
    store.add_metrics(metrics)
    return metrics


def _evaluate(
    trajectory: Trajectory | None, truth: Trajectory | None, protocol: Protocol, store: RunStore, record: RunRecord
) -> Evaluation:
    if truth is None:
        raise EvaluationError(f"sequence '{record.sequence.id}' has no ground truth")
    if trajectory is None:
        raise EvaluationError("there is no such trajectory, or it holds no tracked frame")
    stamps = store.timestamps(record.sequence.part) if record.stamps_match else None
    return evaluate(trajectory, truth, protocol, input_timestamps=stamps)


def _which(store: RunStore, record: RunRecord, protocol: Protocol) -> Literal["online", "final"]:
    """The trajectory that the protocol asks for; an imported run has only one."""
    if record.kind == "imported":
        return "online" if (store.folder(record.run_id) / "trajectory_online.txt").is_file() else "final"
    return protocol.trajectory
