"""How long each stage of a frame took."""

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
        """Time what happens inside as part of a stage."""
        cached = self._cached.get(stage)
        if cached is not None:
            cached.hit, cached.saved_s = False, 0.0
        start = time.perf_counter()
        try:
            yield
        finally:
            elapsed = time.perf_counter() - start + (0.0 if cached is None else cached.saved_s)
            self.seconds[stage] = self.seconds.get(stage, 0.0) + elapsed


# What the filters of a frame decided together.


@dataclass(frozen=True, eq=False)
class CullingResult:
    """Which keypoints are left to be tracked.

    Attributes:
        keep: bool ``[N]``; False rows enter neither tracking nor map.
        weight: float32 ``[N]`` in [0, 1], confidence that a keypoint is static.
        mask: bool ``[H, W]``, pixels held for dynamic; None where no filter has an opinion on pixels.
        undone: How many of the last filters the guard set aside because they would have starved tracking.
        stats: Every filter's stats, each name with the filter's before it.
        flow: Flow to the previous image, None where none was found.
        image: This frame's image as the flow prepared it; None if no flow ran.
    """

    keep: NDArray[np.bool_]
    weight: NDArray[np.float32]
    mask: NDArray[np.bool_] | None
    undone: int
    stats: Mapping[str, float]
    flow: FlowResult | None
    image: Any


def combine_verdicts(
    state: FilterState, verdicts: Sequence[tuple[str, FilterResult]], image: Any, guard: GuardSettings
) -> CullingResult:
    """The verdicts taken together, as far as the guard lets them.

    Args:
        state: What the filters were told, with the flow.
        verdicts: Name of each filter and its verdict, in order.
        image: This frame's image as the flow prepared it, or None.
        guard: What must be left.
    """
    keep, undone, weight = state.keep, 0, np.ones(len(state.keep), np.float32)
    if verdicts:
        keep, undone = restore_starved([verdict.keep for _, verdict in verdicts], guard)
    used = [verdict for _, verdict in verdicts[: len(verdicts) - undone]]
    if used:
        weight = np.prod([verdict.weight for verdict in used], axis=0, dtype=np.float32)
    masks = [verdict.mask for verdict in used if verdict.mask is not None]
    stats = {f"{name}_{key}": value for name, verdict in verdicts for key, value in verdict.stats.items()}
    return CullingResult(keep, weight, np.logical_or.reduce(masks) if masks else None, undone, stats, state.flow, image)


# Flow of the keypoints that are left to the previous image, started where the motion model expects them.


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
