"""What the filters of a frame decided together."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.contracts.filter import FilterResult, FilterState
from dynslam_bench.contracts.flow import FlowResult
from dynslam_bench.culling.guard import GuardSettings, restore_starved


@dataclass(frozen=True, eq=False)
class Culled:
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


def settled(
    state: FilterState, verdicts: Sequence[tuple[str, FilterResult]], image: Any, guard: GuardSettings
) -> Culled:
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
    return Culled(keep, weight, np.logical_or.reduce(masks) if masks else None, undone, stats, state.flow, image)
