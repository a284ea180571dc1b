"""A run's metrics under a protocol, from what is stored of it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.core.errors import DynslamError, EvaluationError
from dynslam_bench.core.fingerprint import package_digest
from dynslam_bench.evaluation.evaluate import Evaluation, evaluate
from dynslam_bench.evaluation.hints import hints
from dynslam_bench.evaluation.protocol import Protocol
from dynslam_bench.geometry.trajectory import Trajectory
from dynslam_bench.runs.record import MetricRecord, RunRecord

DEFAULT_PROTOCOL = "tum-rgbd/v1"
Which = Literal["online", "final"]


def evaluation_code() -> str:
    """Digest of the code that metrics are computed by."""
    return package_digest(("evaluation", "geometry"))


def evaluate_run(
    record: RunRecord,
    read_trajectory: Callable[[Which], Trajectory | None],
    read_truth: Callable[[], Trajectory | None],
    read_stamps: Callable[[], NDArray[np.float64]],
    protocol: Protocol,
) -> MetricRecord:
    """The metrics of a run under a protocol.

    Args:
        record: The run.
        read_trajectory: Reads its ``online`` or ``final`` trajectory; None for one that does not exist or holds no
            pose.
        read_truth: Reads the ground truth of its part of the sequence; None if there is none.
        read_stamps: Reads the stamps of the part's input frames; asked only where they are needed.
        protocol: How to evaluate.

    Returns:
        The metrics; evaluations that are not possible are None, with the reason.
    """
    found: dict[Which, Evaluation | None] = {}
    reasons: dict[str, str] = {}
    lines: list[str] = []
    which: Which
    for which in ("online", "final"):
        try:
            protocol.check_sequence(record.sequence.id)
            protocol.check_scale(record.tracker.id, record.tracker.sensors)
            truth = read_truth()
            if truth is None:
                raise EvaluationError(f"sequence '{record.sequence.id}' has no ground truth")
            trajectory = read_trajectory(which)
            if trajectory is None:
                raise EvaluationError("there is no such trajectory, or it holds no tracked frame")
            inputs = read_stamps() if record.stamps_match else None
            found[which] = evaluate(trajectory, truth, protocol, input_timestamps=inputs)
        except DynslamError as error:
            found[which], reasons[which] = None, str(error)
            continue
        if which == protocol.trajectory or not found.get(protocol.trajectory):
            lines = [str(hint) for hint in hints(trajectory, truth, protocol)]
    return MetricRecord(
        run_id=record.run_id,
        protocol_id=protocol.id,
        protocol_digest=protocol.digest(),
        trajectory=protocol.trajectory,
        online=found.get("online"),
        final=found.get("final"),
        reasons=reasons,
        hints=lines,
    )
