"""Flow of the keypoints that are left to the previous image, started where the motion model expects them."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.contracts.filter import FilterState, FrameBundle
from dynslam_bench.contracts.flow import FlowEstimator, FlowResult
from dynslam_bench.geometry import se3


def flow_to_previous(
    flow: FlowEstimator, image: Any, previous: Any, frame: FrameBundle, state: FilterState
) -> FlowResult:
    """Flow of the kept keypoints, in rows of all keypoints; the others' rows are not valid.

    Args:
        flow: The method.
        image: This frame's image as `flow` prepared it.
        previous: The previous frame's.
        frame: This frame.
        state: With the keypoints that are left and both poses.
    """
    chosen = np.flatnonzero(state.keep)
    guess = predicted_flow(frame, state)[chosen]
    found = flow.track(image, previous, frame.keypoints.xy[chosen], guess=guess, seed=state.seed)
    xy = np.full((len(frame), 2), np.nan, np.float32)
    valid = np.zeros(len(frame), bool)
    cost = np.full(len(frame), np.inf, np.float32)
    xy[chosen], valid[chosen], cost[chosen] = found.xy, found.valid, found.cost
    return FlowResult(xy, valid, cost, found.stats)


def predicted_flow(bundle: FrameBundle, state: FilterState) -> NDArray[np.float32]:
    """Where the motion model expects this frame's keypoints in the previous image.

    Args:
        bundle: The current frame.
        state: With the previous pose and the predicted one.

    Returns:
        Raw pixels float32 ``[N, 2]``; NaN where depth or a prediction is missing.
    """
    guess = np.full((len(bundle), 2), np.nan, np.float32)
    known = bundle.z > 0
    if state.T_world_prev is None or state.T_world_pred is None or not known.any():
        return guess
    T_prev_cur = se3.inverse(state.T_world_prev) @ state.T_world_pred
    points = se3.transform(T_prev_cur, state.camera.unproject(bundle.xy[known], bundle.z[known]))
    ahead = points[:, 2] > 0.05
    pixels = np.full((len(points), 2), np.nan)
    pixels[ahead] = state.camera.distort_points(state.camera.project(points[ahead]))
    guess[known] = pixels
    return guess
