"""What an environment tells of a frame: the ``info`` of `reset` and `step`."""

from __future__ import annotations

from typing import Any

import numpy as np

from dynslam_bench.evaluation.online import OnlineSample
from dynslam_bench.geometry import se3

from .episode import FrameOutcome


def frame_info(outcome: FrameOutcome) -> dict[str, Any]:
    """Index, stamp, state and stats of a frame, its pose if it was tracked, its errors where they are defined."""
    info: dict[str, Any] = {
        "frame_index": outcome.index,
        "timestamp": float(outcome.timestamp),
        "tracking_state": str(outcome.state),
        "stats": dict(outcome.stats),
    }
    if outcome.T_world_cam is not None:
        info["pose"] = np.concatenate(se3.to_quaternion(outcome.T_world_cam))
    return info | _defined(outcome.error)


def _defined(error: OnlineSample | None) -> dict[str, float]:
    if error is None:
        return {}
    named = {
        "pose_error_trans_m": error.trans_m,
        "pose_error_rot_deg": error.rot_deg,
        "frame_error_trans_m": error.frame_trans_m,
        "frame_error_rot_deg": error.frame_rot_deg,
    }
    return {name: float(value) for name, value in named.items() if value is not None}
