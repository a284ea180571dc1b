"""DynaSLAM's low-cost tracking: a pose for the geometric test before the frame is really tracked."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.contracts.filter import FilterState, FrameBundle
from dynslam_bench.contracts.flow import FlowResult
from dynslam_bench.features.matching import CellGrid, as_words, search_in_radius
from dynslam_bench.geometry import se3

from .ego_motion import refine_prediction

MIN_MATCHES = 20
"""Fewer matches are sought again in twice the radius, then given up."""
MAX_DISTANCE = 100
"""Largest Hamming distance of a match."""


def light_track(frame: FrameBundle, state: FilterState, radius_px: float = 15.0) -> NDArray[np.float64] | None:
    """The pose predicted for this frame, refined on the matches of the features that earlier filters kept.

    The previous frame's features are projected under constant velocity and matched by descriptor within `radius_px`;
    the pose is the one that explains most of the matches. The authors match the local map instead of the last frame.

    Args:
        frame: The current frame.
        state: With the previous frame, its pose and the predicted one.
        radius_px: Half side of the search windows (DynaSLAM: 15, doubled where too little matches).

    Returns:
        Camera-to-world pose ``[4, 4]``; the prediction itself (or None) where there are fewer than 20 matches, or
        where an optical flow has refined it already.
    """
    previous = state.previous
    if state.flow is not None or previous is None or state.T_world_prev is None or state.T_world_pred is None:
        return state.T_world_pred
    trusted = np.ones(len(previous), dtype=bool) if state.previous_keep is None else state.previous_keep
    rows = np.flatnonzero(trusted & (previous.z > 0))
    if len(rows) < MIN_MATCHES or np.count_nonzero(state.keep) < MIN_MATCHES:
        return state.T_world_pred
    T_cur_prev = se3.inverse(state.T_world_pred) @ state.T_world_prev
    points = se3.transform(T_cur_prev, state.camera.unproject(previous.xy[rows], previous.z[rows]))
    rows, points = rows[points[:, 2] > 0.1], points[points[:, 2] > 0.1]
    expected = np.asarray(state.camera.project(points), dtype=np.float64)
    for radius in (radius_px, 2 * radius_px):
        match = _match(frame, state, rows, expected, radius)
        matched = match >= 0
        if np.count_nonzero(matched) >= MIN_MATCHES:
            xy = np.full((len(frame), 2), np.nan, np.float32)
            valid = np.zeros(len(frame), dtype=bool)
            xy[match[matched]] = previous.keypoints.xy[rows[matched]]
            valid[match[matched]] = True
            found = FlowResult(xy, valid, np.zeros(len(frame), np.float32))
            return refine_prediction(frame, replace(state, flow=found))
    return state.T_world_pred


def _match(
    frame: FrameBundle, state: FilterState, rows: NDArray[np.intp], expected: NDArray[np.float64], radius: float
) -> NDArray[np.int64]:
    """The current keypoint of each of the previous frame's `rows`, ``[M]``; -1 for none."""
    assert state.previous is not None
    xy = np.ascontiguousarray(frame.xy, dtype=np.float64)
    octave = frame.keypoints.octave.astype(np.int64)
    unknown = np.full(len(frame), np.nan)
    before = state.previous.keypoints.octave[rows].astype(np.int64)
    match, _ = search_in_radius(
        CellGrid.of(xy, state.camera.width, state.camera.height),
        (xy, unknown, octave, as_words(frame.keypoints.descriptors)),
        state.keep,
        (expected, np.full(len(rows), np.nan), np.full(len(rows), radius)),
        (before - 1, before + 1),
        as_words(state.previous.keypoints.descriptors[rows]),
        max_distance=MAX_DISTANCE,
    )
    return match
