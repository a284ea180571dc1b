"""Real runs with the interface of the table; they need dynslam-bench."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from slam_hpo.spaces import STRIDE, SlamHpoError
from slam_hpo.table import Evaluation

if TYPE_CHECKING:
    from dynslam_bench.runs import RunRecord, RunStore

PROTOCOL = "tum-rgbd/v1"


def run(
    system: str,
    settings: Mapping[str, Any],
    sequence: str,
    start: int = 0,
    *,
    frames: int = 60,
    results: str | Path = "results",
) -> Evaluation:
    """Run a system; a run that is stored in `results` is not made again. Arguments as for `Benchmark.measured`.

    Raises:
        SlamHpoError: dynslam-bench is not installed.
    """
    try:
        import dynslam_bench as db
    except ModuleNotFoundError as error:
        raise SlamHpoError(
            f"real runs need dynslam-bench ({error}): in its checkout, pip install ."
        ) from error

    window = (start, start + STRIDE * frames)
    made = db.run(
        system,
        sequence,
        settings=settings,
        frames=window,
        stride=STRIDE,
        cache=True,
        results=results,
    )
    return evaluated(made.store, made.record, frames)


def evaluated(store: RunStore, record: RunRecord, frames: int) -> Evaluation:
    """Evaluate the first frames of a stored run.

    Args:
        store: Where it is stored.
        record: The run.
        frames: How many of its frames.

    Returns:
        What a run of that length has; with fewer than two tracked frames the error is that of a
        static camera.
    """
    from dynslam_bench.contracts import Trajectory
    from dynslam_bench.evaluation import evaluate
    from dynslam_bench.runs import load_frames
    from dynslam_bench.runs.running import judge_coverage
    from dynslam_bench.tuning.objectives import hold_last_pose_protocol

    part = load_frames(record, store).head(frames)
    stamps = part["timestamp"].to_numpy()
    truth = store.ground_truth(record.sequence.part)
    ok = (part["state"] == "ok").to_numpy()
    estimate = store.trajectory(record.run_id)
    tracked = int(ok.sum())
    assert truth is not None  # every sequence is rendered
    if estimate is not None and tracked > 1:
        beginning = Trajectory(estimate.timestamps[:tracked], estimate.T_world_cam[:tracked])
        protocol = hold_last_pose_protocol(PROTOCOL)
        evaluation = evaluate(beginning, truth, protocol, input_timestamps=stamps)
        error = evaluation.metrics["ate_rmse_m"]
    else:
        positions = truth.positions[
            (truth.timestamps >= stamps[0]) & (truth.timestamps <= stamps[-1])
        ]
        error = float(np.sqrt(np.square(positions - positions.mean(axis=0)).sum(axis=1).mean()))
    # the first two frames load networks and kernels
    processor = float(part["processor_s"].iloc[2:].mean())
    lost_at_end = int(ok[::-1].argmax()) if tracked else len(ok)
    status: str = record.status
    if not record.failed:
        status, *_ = judge_coverage(tracked, len(ok), lost_at_end, len(ok))
    return Evaluation(error, tracked / len(ok), processor, status)
