"""What tracking one frame gives."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

TrackingState = Literal["initialising", "ok", "lost"]
"""A pose that is given with `lost` is a prediction and enters no trajectory."""


@dataclass(frozen=True, eq=False)
class TrackResult:
    """One frame's outcome.

    Attributes:
        T_world_cam: Camera-to-world pose, float64 ``[4, 4]``; None if the tracker has none. A pose given while
            `state` is ``lost`` is a prediction and enters no trajectory.
        state: ``ok`` (tracked), ``lost`` or ``initialising``.
        stats: Diagnostics, plain floats, the same keys on every frame of a tracker. Keys the environment knows:
            ``keypoints``, ``culled``, ``matches``, ``inliers``, ``map_points``, ``keyframes``, ``keyframe``
            (1 on frames that became keyframes), ``residual_px``, ``mask_fraction``.
        timings: Seconds by stage, in the order of the pipeline (``features``, ``segmentation``, ``flow``, ...).
        dynamic_mask: bool ``[H, W]``, pixels held for dynamic, or None.
        keypoints_xy: float32 ``[N, 2]``, raw pixels of the features, for rendering; or None.
        keypoints_keep: bool ``[N]``, which of them were kept; or None.
    """

    T_world_cam: NDArray[np.float64] | None
    state: TrackingState
    stats: Mapping[str, float] = field(default_factory=dict)
    timings: Mapping[str, float] = field(default_factory=dict)
    dynamic_mask: NDArray[np.bool_] | None = None
    keypoints_xy: NDArray[np.float32] | None = None
    keypoints_keep: NDArray[np.bool_] | None = None
