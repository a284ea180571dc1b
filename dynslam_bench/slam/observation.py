"""The static features of one frame as the back end uses them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.contracts.features import Keypoints
from dynslam_bench.contracts.filter import FrameBundle
from dynslam_bench.features.matching import CellGrid, Words, as_words
from dynslam_bench.geometry.camera import Camera

MAX_DEPTH_M = 40.0
"""Depth beyond this is treated as missing."""
RIGHT_SIGMA_PX = 1.5
"""Standard deviation of the right coordinate at octave 0, beside the depth sensor's noise."""
DEPTH_NOISE = 0.0025
"""Standard deviation of the depth over its square, 1/m (structured-light sensors)."""


@dataclass(frozen=True, eq=False)
class Observations:
    """Features of one frame that no filter removed, one row each, ready for matching.

    Attributes:
        keypoints: Raw keypoints (distorted pixels).
        xy: float64 ``[N, 2]`` undistorted pixels.
        z: float64 ``[N]`` depth in metres, 0 missing.
        right: float64 ``[N]`` right coordinate ``u - fx * baseline / z``, NaN without depth.
        octave: int64 ``[N]``.
        angle: float64 ``[N]`` degrees.
        words: uint64 ``[N, W]`` descriptors.
        info: float64 ``[N]`` inverse variance of the pixel coordinates, 1/px^2, times the filters' weight.
        info_right: float64 ``[N]`` inverse variance of the right coordinate, times the weight; 0 without depth.
        grid: Cells of the features.
        rgb: uint8 ``[N, 3]`` colour at the feature.
        mask: bool ``[H, W]``, dynamic pixels, behind which no map point is visible; None without masks.
    """

    keypoints: Keypoints
    xy: NDArray[np.float64]
    z: NDArray[np.float64]
    right: NDArray[np.float64]
    octave: NDArray[np.int64]
    angle: NDArray[np.float64]
    words: Words
    info: NDArray[np.float64]
    info_right: NDArray[np.float64]
    grid: CellGrid
    rgb: NDArray[np.uint8]
    mask: NDArray[np.bool_] | None = None

    def __len__(self) -> int:
        return len(self.xy)

    @property
    def arrays(self) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.int64], Words]:
        """Input of `search_in_radius`: pixels, right coordinates, octaves, descriptors."""
        return self.xy, self.right, self.octave, self.words


def observe(
    frame: FrameBundle,
    keep: NDArray[np.bool_],
    weight: NDArray[np.float32],
    camera: Camera,
    scales: NDArray[np.float64],
) -> Observations:
    """Select and prepare the features of a frame.

    The right coordinate ``u - b f / z`` carries the depth (ORB-SLAM2, Eq. for RGB-D); its variance is the pixel's plus
    that of the depth sensor, ``(b f / z^2 * c z^2)^2 = (b f c)^2``, constant in disparity.

    Args:
        frame: The frame with its keypoints.
        keep: bool ``[N]``, False rows are left out entirely.
        weight: float32 ``[N]`` in [0, 1], scales the information of a feature.
        camera: Intrinsics.
        scales: Scale of each octave.
    """
    weight = np.clip(np.nan_to_num(np.asarray(weight, np.float64), nan=0.0), 0.0, 1.0)
    finite = np.isfinite(frame.xy).all(axis=1) if len(frame) else np.zeros(0, bool)
    index = np.flatnonzero(np.asarray(keep, bool) & finite & (weight > 0))
    keypoints = frame.keypoints.select(index)
    xy = np.ascontiguousarray(frame.xy[index], dtype=np.float64)
    z = np.nan_to_num(frame.z[index].astype(np.float64), nan=0.0, posinf=0.0, neginf=0.0)
    z = np.where((z > 0) & (z < MAX_DEPTH_M), z, 0.0)
    octave = np.clip(keypoints.octave.astype(np.int64), 0, len(scales) - 1)
    variance = scales[octave] ** 2
    noise = RIGHT_SIGMA_PX**2 * variance + (camera.fx * camera.baseline_m * DEPTH_NOISE) ** 2
    column = np.clip(np.rint(keypoints.xy[:, 0]).astype(np.int64), 0, frame.rgb.shape[1] - 1)
    row = np.clip(np.rint(keypoints.xy[:, 1]).astype(np.int64), 0, frame.rgb.shape[0] - 1)
    return Observations(
        keypoints,
        xy,
        z,
        right_coordinates(xy, z, camera),
        octave,
        keypoints.angle.astype(np.float64),
        as_words(keypoints.descriptors),
        weight[index] / variance,
        np.where(z > 0, weight[index] / noise, 0.0),
        CellGrid.of(xy, camera.width, camera.height),
        frame.rgb[row, column],
        frame.mask,
    )


def right_coordinates(xy: NDArray[np.float64], z: NDArray[np.float64], camera: Camera) -> NDArray[np.float64]:
    """Right coordinates ``[N]`` of pixels ``[N, 2]`` with depths ``[N]`` in metres; NaN where the depth is 0."""
    has_depth = z > 0
    return np.where(has_depth, xy[:, 0] - camera.fx * camera.baseline_m / np.where(has_depth, z, 1.0), np.nan)
