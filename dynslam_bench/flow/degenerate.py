"""Degenerate input, answered the same way by every method: rows that are not valid, with a reason in the statistics."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.contracts.flow import FlowResult

FLAT_RANGE = 2
"""Grey levels between the darkest and the brightest pixel up to which an image has no texture."""


STATS_NAMES = ("points", "valid", "evaluations", "degenerate")
"""Of `flow_stats`."""


def flow_stats(points: int, valid: int = 0, evaluations: int = 0, *, degenerate: bool = False) -> dict[str, float]:
    """The stats of all our flows, the same keys in every result.

    Args:
        points: How many were asked for.
        valid: How many were found.
        evaluations: Matching costs computed.
        degenerate: Whether the images allow no flow: identical, without texture, too small.
    """
    return {
        "points": float(points),
        "valid": float(valid),
        "evaluations": float(evaluations),
        "degenerate": float(degenerate),
    }


def empty_result() -> FlowResult:
    """The result for no points."""
    return FlowResult(np.empty((0, 2), np.float32), np.empty(0, np.bool_), np.empty(0, np.float32), flow_stats(0))


def invalid_result(points: NDArray[np.float32]) -> FlowResult:
    """The result for images that allow no flow: each point stays where it is, or at 0 where it is not finite."""
    n = len(points)
    stats = flow_stats(n, degenerate=True)
    xy = np.where(np.isfinite(points), points, 0).astype(np.float32)
    return FlowResult(xy, np.zeros(n, np.bool_), np.ones(n, np.float32), stats)


def is_degenerate(reference: NDArray[np.uint8], target: NDArray[np.uint8]) -> bool:
    """Whether a pair of images says nothing about motion: equal pixel by pixel, or one of them without texture.

    Raises:
        ValueError: They differ in size, or are no uint8 ``[H, W]`` images.
    """
    if reference.shape != target.shape:
        raise ValueError(f"images differ in size: {reference.shape} and {target.shape}")
    if reference.dtype != np.uint8 or target.dtype != np.uint8 or reference.ndim != 2:
        raise ValueError(f"images must be uint8 [H, W], got {reference.dtype} {reference.shape} and {target.dtype}")
    if reference is target or not reference.size:
        return True
    flat = any(int(image.max()) - int(image.min()) <= FLAT_RANGE for image in (reference, target))
    return flat or bool(np.array_equal(reference, target))


def usable_points(points: NDArray[np.float32], shape: tuple[int, ...]) -> NDArray[np.bool_]:
    """Finite points inside an image of shape ``(H, W)``."""
    height, width = shape[:2]
    with np.errstate(invalid="ignore"):
        inside = (points >= 0).all(axis=1) & (points <= (width - 1, height - 1)).all(axis=1)
    return np.asarray(inside, dtype=np.bool_)


class Request(NamedTuple):
    """Points to be tracked.

    Attributes:
        points: float32 ``[N, 2]``, the points, 0 where they are not usable.
        usable: bool ``[N]``, finite and inside the reference.
    """

    points: NDArray[np.float32]
    usable: NDArray[np.bool_]


def request(
    reference: NDArray[np.uint8], target: NDArray[np.uint8], points: NDArray[np.float32]
) -> Request | FlowResult:
    """The points as a method may use them, or the result where there is nothing to track (no points, equal images)."""
    points = np.ascontiguousarray(points, dtype=np.float32).reshape(-1, 2)
    if not len(points):
        return empty_result()
    if is_degenerate(reference, target):
        return invalid_result(points)
    usable = usable_points(points, reference.shape)
    return Request(np.where(usable[:, None], points, 0).astype(np.float32), usable)
