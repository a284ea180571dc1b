"""Stages of the frame pipeline: their clock, the flow to the previous image, and the verdicts of the filters."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.contracts.filter import FilterResult, FilterState, FrameBundle
from dynslam_bench.contracts.flow import FlowEstimator, FlowResult
from dynslam_bench.culling.guard import GuardSettings, restore_starved
from dynslam_bench.geometry import se3


class CachedStage(Protocol):
    """A stage that may have answered its last call from the stage cache.

    Attributes:
        hit: Whether it did.
        saved_s: Seconds that this saved.
    """

    hit: bool
    saved_s: float


class StageClock:
    """Wall-clock seconds by stage, in the order of first use; what the stage cache saved is added again.

    Args:
        cached: Stages that answer from the stage cache, by name.
    """

    def __init__(self, cached: Mapping[str, CachedStage]) -> None:
        self.seconds: dict[str, float] = {}
        self._cached = cached

    @contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        """Time the body as part of a stage."""
        cached = self._cached.get(stage)
        if cached is not None:
            cached.hit, cached.saved_s = False, 0.0
        start = time.perf_counter()
        try:
            yield
        finally:
            elapsed = time.perf_counter() - start + (0.0 if cached is None else cached.saved_s)
            self.seconds[stage] = self.seconds.get(stage, 0.0) + elapsed


@dataclass(frozen=True, eq=False)
class CullingResult:
    """Which keypoints are static, by all filters.

    Attributes:
        keep: bool ``[N]``; False rows enter neither tracking nor map.
        weight: float32 ``[N]`` in [0, 1], confidence that a keypoint is static.
        mask: bool ``[H, W]``, dynamic pixels; None where no filter gives a mask.
        undone: How many of the last filters the guard set aside because too few keypoints would be left.
        stats: Every filter's stats, each name with the filter's before it.
        image: This frame's image as the flow prepared it; None if no flow ran.
    """

    keep: NDArray[np.bool_]
    weight: NDArray[np.float32]
    mask: NDArray[np.bool_] | None
    undone: int
    stats: Mapping[str, float]
    image: Any


def combine_verdicts(
    verdicts: Sequence[tuple[str, FilterResult]], count: int, image: Any, guard: GuardSettings
) -> CullingResult:
    """The verdicts taken together, as far as the guard lets them.

    Args:
        verdicts: Name of each filter and its verdict, in order.
        count: Number of keypoints.
        image: This frame's image as the flow prepared it, or None.
        guard: What must be left.
    """
    keep, undone, weight = np.ones(count, bool), 0, np.ones(count, np.float32)
    if verdicts:
        keep, undone = restore_starved([verdict.keep for _, verdict in verdicts], guard)
    used = [verdict for _, verdict in verdicts[: len(verdicts) - undone]]
    if used:
        weight = np.prod([verdict.weight for verdict in used], axis=0, dtype=np.float32)
    masks = [verdict.mask for verdict in used if verdict.mask is not None]
    stats = {f"{name}_{key}": value for name, verdict in verdicts for key, value in verdict.stats.items()}
    return CullingResult(keep, weight, np.logical_or.reduce(masks) if masks else None, undone, stats, image)


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
    kept = np.flatnonzero(state.keep)
    guess = predicted_flow(frame, state)[kept]
    result = flow.track(image, previous, frame.keypoints.xy[kept], guess=guess, seed=state.seed)
    xy = np.full((len(frame), 2), np.nan, np.float32)
    valid = np.zeros(len(frame), bool)
    cost = np.full(len(frame), np.inf, np.float32)
    xy[kept], valid[kept], cost[kept] = result.xy, result.valid, result.cost
    return FlowResult(xy, valid, cost, result.stats)


def predicted_flow(frame: FrameBundle, state: FilterState) -> NDArray[np.float32]:
    """Where the motion model expects this frame's keypoints in the previous image.

    Args:
        frame: The current frame.
        state: With the previous pose and the predicted one.

    Returns:
        Raw pixels float32 ``[N, 2]``; NaN where depth or a prediction is missing.
    """
    guess = np.full((len(frame), 2), np.nan, np.float32)
    has_depth = frame.z > 0
    if state.T_world_prev is None or state.T_world_pred is None or not has_depth.any():
        return guess
    T_prev_cur = se3.inverse(state.T_world_prev) @ state.T_world_pred
    points = se3.transform(T_prev_cur, state.camera.unproject(frame.xy[has_depth], frame.z[has_depth]))
    ahead = points[:, 2] > 0.05
    pixels = np.full((len(points), 2), np.nan)
    pixels[ahead] = state.camera.distort_points(state.camera.project(points[ahead]))
    guess[has_depth] = pixels
    return guess
