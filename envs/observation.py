"""What an agent sees: a documented vector of diagnostics, or the images. Ground truth never enters it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from dynslam_bench.contracts.result import TrackResult
from dynslam_bench.contracts.sequence import Frame
from dynslam_bench.geometry import se3
from dynslam_bench.geometry.camera import Camera

ObservationKind = Literal["stats", "rgbd"]
MAX_DEPTH_M = 20.0
"""Upper end of the depth image in ``rgbd`` observations, metres; farther values are clipped."""

STATS_LAYOUT: tuple[tuple[str, str], ...] = (
    ("initialising", "1 while the tracker initialises, else 0"),
    ("ok", "1 if the frame was tracked, else 0"),
    ("lost", "1 if the tracker is lost, else 0"),
    ("lost_streak", "n / (n + 10) of the frames n that were lost in a row, this one included"),
    ("progress", "frame index / last index"),
    ("keypoints", "n / (n + 1000) of the keypoints found"),
    ("culled", "culled / found keypoints"),
    ("matches", "matches / kept keypoints"),
    ("inliers", "inliers / matches"),
    ("residual", "r / (r + 1 px) of the reprojection residual r"),
    ("mask_fraction", "share of the image held for dynamic"),
    ("map_points", "n / (n + 5000) of the map points"),
    ("keyframes", "n / (n + 100) of the keyframes"),
    ("keyframe", "1 if this frame became a keyframe, else 0"),
    ("motion_x", "tanh(x / 0.1 m) of the estimated motion since the previous frame, in the previous camera frame"),
    ("motion_y", "likewise, y"),
    ("motion_z", "likewise, z (forward)"),
    ("motion_rx", "tanh(r / 0.1 rad) of the rotation vector of that motion"),
    ("motion_ry", "likewise, y"),
    ("motion_rz", "likewise, z"),
    ("brightness", "mean grey level / 255"),
    ("contrast", "standard deviation of the grey level / 128"),
    ("depth_valid", "share of the pixels with depth"),
    ("depth_median", "d / (d + 3 m) of the median valid depth d"),
)
"""Name and meaning of every entry of the ``stats`` observation, in order. What a tracker does not report is 0."""

STATS_SIZE = len(STATS_LAYOUT)
_SIGNED = np.array([name.startswith("motion_") for name, _ in STATS_LAYOUT])


@dataclass(frozen=True)
class ObservationContext:
    """What an observation may use beside the frame and the tracker's result.

    Attributes:
        index: Index of the frame.
        last_index: Index of the sequence's last frame.
        lost_streak: Frames lost in a row, this one included.
        T_prev_cur: Estimated motion since the previous frame, None if either frame has no pose.
    """

    index: int
    last_index: int
    lost_streak: int
    T_prev_cur: NDArray[np.float64] | None


def stats_space() -> spaces.Box:
    """``Box`` of float32 ``[24]``: entries in [0, 1], the motion's in [-1, 1]; see `STATS_LAYOUT`."""
    low = np.where(_SIGNED, -1.0, 0.0).astype(np.float32)
    return spaces.Box(low, np.ones(STATS_SIZE, np.float32), dtype=np.float32)


def rgbd_space(camera: Camera) -> spaces.Dict:
    """``Dict`` of ``rgb`` uint8 ``[H, W, 3]``, ``depth`` float32 ``[H, W]`` metres (0 missing) and ``stats``."""
    size = (camera.height, camera.width)
    return spaces.Dict(
        {
            "rgb": spaces.Box(0, 255, (*size, 3), np.uint8),
            "depth": spaces.Box(0.0, MAX_DEPTH_M, size, np.float32),
            "stats": stats_space(),
        }
    )


def stats_observation(frame: Frame, result: TrackResult, context: ObservationContext) -> NDArray[np.float32]:
    """The vector of `STATS_LAYOUT` for one tracked frame; finite whatever the tracker reports."""
    stats = result.stats
    found = _stat(stats, "keypoints")
    culled = _stat(stats, "culled")
    matches = _stat(stats, "matches")
    motion = np.zeros(6)
    if context.T_prev_cur is not None:
        motion = np.tanh(se3.log(context.T_prev_cur) / 0.1)
    gray = frame.rgb[::4, ::4].mean(axis=2, dtype=np.float32)
    depth = frame.depth[::4, ::4]
    valid = depth[(depth > 0) & np.isfinite(depth)]
    values = [
        float(result.state == "initialising"),
        float(result.state == "ok"),
        float(result.state == "lost"),
        _saturate(context.lost_streak, 10.0),
        context.index / max(context.last_index, 1),
        _saturate(found, 1000.0),
        _ratio(culled, found),
        _ratio(matches, found - culled),
        _ratio(_stat(stats, "inliers"), matches),
        _saturate(_stat(stats, "residual_px"), 1.0),
        _stat(stats, "mask_fraction"),
        _saturate(_stat(stats, "map_points"), 5000.0),
        _saturate(_stat(stats, "keyframes"), 100.0),
        float(_stat(stats, "keyframe") > 0),
        *motion,
        float(gray.mean()) / 255.0,
        float(gray.std()) / 128.0,
        valid.size / max(depth.size, 1),
        _saturate(float(np.median(valid)), 3.0) if valid.size else 0.0,
    ]
    vector = np.asarray(values, dtype=np.float32)
    return np.clip(vector, np.where(_SIGNED, -1.0, 0.0), 1.0).astype(np.float32)


def rgbd_observation(
    frame: Frame, result: TrackResult, context: ObservationContext
) -> dict[str, NDArray[np.uint8] | NDArray[np.float32]]:
    """Copies of the images, and the vector of `stats_observation`."""
    depth = np.nan_to_num(frame.depth, nan=0.0, posinf=MAX_DEPTH_M, neginf=0.0)
    return {
        "rgb": np.array(frame.rgb, dtype=np.uint8),
        "depth": np.clip(depth, 0.0, MAX_DEPTH_M).astype(np.float32),
        "stats": stats_observation(frame, result, context),
    }


def _stat(stats: Mapping[str, float], name: str) -> float:
    value = float(stats.get(name, 0.0))
    return value if np.isfinite(value) else 0.0


def _saturate(value: float, scale: float) -> float:
    return max(value, 0.0) / (max(value, 0.0) + scale)


def _ratio(part: float, whole: float) -> float:
    return min(max(part / whole, 0.0), 1.0) if whole > 0 else 0.0
