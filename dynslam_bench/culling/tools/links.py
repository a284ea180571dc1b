"""Which feature of the previous frame is this one, and which are judged by their flow at all?"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from dynslam_bench.contracts.filter import FilterState, FrameBundle
from dynslam_bench.contracts.flow import FlowResult

from .unmatched import Unmatched


def link_to_previous(frame: FrameBundle, state: FilterState, radius_px: float = 2.5) -> NDArray[np.intp]:
    """Index of the previous frame's keypoint that each keypoint continues, ``[N]``; -1 for none.

    Args:
        frame: The current frame.
        state: With the flow to the previous image.
        radius_px: How near the flow's end must be to an earlier keypoint.
    """
    link = np.full(len(frame), -1, dtype=np.intp)
    if state.flow is None or state.previous is None or not len(state.previous):
        return link
    rows = np.flatnonzero(state.flow.valid & np.isfinite(state.flow.xy).all(axis=1))
    if not len(rows):
        return link
    distance, nearest = cKDTree(state.previous.keypoints.xy).query(state.flow.xy[rows], distance_upper_bound=radius_px)
    near = np.isfinite(distance)
    link[rows[near]] = np.asarray(nearest)[near]
    return link


def judged_by_flow(flow: FlowResult, asked: NDArray[np.bool_], unmatched: Unmatched) -> NDArray[np.bool_]:
    """Which features a test on flow judges, bool ``[N]``.

    Args:
        flow: Flow of the features; where it failed, ``xy`` is the place where the tracker gave up.
        asked: bool ``[N]``, features whose flow was asked for: those that earlier filters kept.
        unmatched: ``judge`` takes those along whose flow failed.
    """
    if unmatched != "judge":
        return np.asarray(asked & flow.valid)
    return np.asarray(asked & np.isfinite(flow.xy).all(axis=1))


def inherit(values: NDArray[np.float64], link: NDArray[np.intp], default: float) -> NDArray[np.float64]:
    """Values ``[M, ...]`` of the previous keypoints, carried to the current ones ``[N, ...]`` along their links."""
    carried = np.full((len(link), *values.shape[1:]), default, dtype=np.float64)
    carried[link >= 0] = values[link[link >= 0]]
    return carried
