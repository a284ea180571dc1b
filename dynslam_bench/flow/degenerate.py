"""Degenerate input, handled in the same way by every method: points that are not valid, with a reason in the stats."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.contracts.flow import FlowResult

FLAT_RANGE = 2
"""Grey levels between the darkest and the brightest pixel up to which an image has no texture."""
STATS_NAMES = ("points", "valid", "evaluations", "degenerate")
"""Keys of `flow_stats`."""


def flow_stats(
    points: int, valid: int = 0, evaluations: int = 0, *, degenerate: bool = False
) -> dict[str, float]:
    """The stats of all built-in flows, the same keys in every result.

    Args:
        points: Number of points.
        valid: Number of valid points.
        evaluations: Matching costs computed.
        degenerate: Whether the images allow no flow: identical, without texture, too small.
    """
    values = (points, valid, evaluations, degenerate)
    return dict(zip(STATS_NAMES, map(float, values), strict=True))


def invalid_result(points: NDArray[np.float32], *, degenerate: bool) -> FlowResult:
    """The result where no point can be tracked: each stays at its place, or at 0 where it is not finite."""
    n = len(points)
    xy = np.where(np.isfinite(points), points, 0).astype(np.float32)
    return FlowResult(
        xy, np.zeros(n, np.bool_), np.ones(n, np.float32), flow_stats(n, degenerate=degenerate)
    )


def usable_points(points: NDArray[np.float32], shape: tuple[int, ...]) -> NDArray[np.bool_]:
    """Finite points inside an image of shape ``(H, W)``."""
    height, width = shape[:2]
    return np.asarray(((points >= 0) & (points <= (width - 1, height - 1))).all(axis=1))


def clean_points(
    reference: NDArray[np.uint8], target: NDArray[np.uint8], points: NDArray[np.float32]
) -> tuple[NDArray[np.float32], NDArray[np.bool_]] | FlowResult:
    """The points as a method may use them, or the result where there is nothing to track.

    Returns:
        float32 ``[N, 2]``, 0 where a point is not usable, and bool ``[N]``, usable; a result for no
        points and for degenerate images: equal pixel by pixel, or one of them without texture.

    Raises:
        ValueError: The images differ in size, or are no uint8 ``[H, W]`` images.
    """
    if reference.shape != target.shape:
        raise ValueError(f"images differ in size: {reference.shape} and {target.shape}")
    if reference.dtype != np.uint8 or target.dtype != np.uint8 or reference.ndim != 2:
        raise ValueError(
            f"images must be uint8 [H, W], got {reference.dtype} {reference.shape} and {target.dtype}"
        )
    points = np.ascontiguousarray(points, dtype=np.float32).reshape(-1, 2)

    # nothing to track
    if not len(points) or not reference.size:
        return invalid_result(points, degenerate=bool(len(points)))

    # images that allow no flow: one without texture, or the same image twice
    if reference is target:
        return invalid_result(points, degenerate=True)
    if np.ptp(reference) <= FLAT_RANGE or np.ptp(target) <= FLAT_RANGE:
        return invalid_result(points, degenerate=True)
    if np.array_equal(reference, target):
        return invalid_result(points, degenerate=True)

    # points that can be tracked
    usable = usable_points(points, reference.shape)
    return np.where(usable[:, None], points, 0).astype(np.float32), usable
