"""Corners followed through the images of a window, and the depth at pixels."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

POINTS = 110
"""So many corners are followed at a time."""


def track(images: list[NDArray[np.uint8]], allowed: list[NDArray[np.uint8]]) -> Array:
    """Corners followed from image to image by Lucas and Kanade, pixels ``[L, n, 2]``; NaN where they are not seen.

    A corner whose way back ends more than half a pixel off is lost; new ones are found where few are left, and where
    `allowed` is not 0.
    """
    n, (height, width) = len(images), images[0].shape
    tracks = np.full((0, n, 2), np.nan)
    window: dict[str, Any] = {
        "winSize": (21, 21),
        "maxLevel": 4,
        "criteria": (3, 30, 0.01),
        "flags": cv2.OPTFLOW_USE_INITIAL_FLOW,
    }
    for i in range(n - 1):
        alive = np.isfinite(tracks[:, i, 0])
        if alive.sum() < POINTS and i < n - 3:
            fresh = corners(images[i], allowed[i], tracks[alive, i], POINTS - int(alive.sum()))
            new = np.full((len(fresh), n, 2), np.nan)
            new[:, i] = fresh
            tracks = np.concatenate([tracks, new])
            alive = np.isfinite(tracks[:, i, 0])
        here = tracks[alive, i].astype(np.float32)
        if not len(here):
            continue
        flow = here - tracks[alive, i - 1] if i else np.full(here.shape, np.nan)
        known = np.isfinite(flow[:, 0])
        flow[~known] = np.median(flow[known], axis=0) if known.any() else 0.0
        guess, start = (each.astype(np.float32).reshape(-1, 1, 2) for each in (here + flow, here))
        there, found, _ = cv2.calcOpticalFlowPyrLK(images[i], images[i + 1], start, guess, **window)
        back, again, _ = cv2.calcOpticalFlowPyrLK(images[i + 1], images[i], there, start.copy(), **window)
        there, back = np.asarray(there)[:, 0], np.asarray(back)[:, 0]
        good = (
            (np.asarray(found)[:, 0] > 0) & (np.asarray(again)[:, 0] > 0) & (np.linalg.norm(back - here, axis=1) < 0.5)
        )
        good &= (there >= 8).all(axis=1) & (there < (width - 8, height - 8)).all(axis=1)
        tracks[np.flatnonzero(alive)[good], i + 1] = there[good]
    return np.asarray(tracks[np.isfinite(tracks[..., 0]).sum(axis=1) >= 4])


def corners(image: NDArray[np.uint8], allowed: NDArray[np.uint8], taken: Array, count: int) -> NDArray[np.float32]:
    """Corners ``[N, 2]`` spread over the cells of a grid, away from those that there are."""
    height, width = image.shape
    free = allowed.copy()
    for x, y in taken:
        cv2.circle(free, (int(x), int(y)), 12, 0, -1)
    rows, columns = 4, 5
    each = int(np.ceil(1.5 * count / (rows * columns)))
    found = [np.zeros((0, 2), np.float32)]
    for r in range(rows):
        for c in range(columns):
            ys = slice(r * height // rows, (r + 1) * height // rows)
            xs = slice(c * width // columns, (c + 1) * width // columns)
            found_here = cv2.goodFeaturesToTrack(image[ys, xs], each, 0.02, 12, mask=free[ys, xs])
            if found_here is not None:
                found.append(np.asarray(found_here.reshape(-1, 2) + np.array([xs.start, ys.start]), np.float32))
    return np.concatenate(found)


def inverse_depth(depth: NDArray[np.float32], pixels: Array) -> Array:
    """Mean inverse depth ``[N]`` of the 5x5 pixels around `pixels` ``[N, 2]``; NaN at edges, holes and outside."""
    height, width = depth.shape
    place: Array = np.asarray(np.round(pixels))
    ahead, before = (place >= 2).all(axis=1), (place < (width - 2, height - 2)).all(axis=1)
    inside = np.asarray(np.isfinite(place).all(axis=1) & ahead & before)
    u, v = np.where(inside[:, None], place, 2).astype(np.intp).T
    around = np.arange(-2, 3)
    patch = depth[v[:, None, None] + around[:, None], u[:, None, None] + around].reshape(len(u), 25).astype(np.float64)
    measured = patch > 0
    inverse = 1 / np.where(measured, patch, 1.0)
    count = measured.sum(axis=1)
    mean = (inverse * measured).sum(axis=1) / np.maximum(count, 1)
    spread = np.where(measured, inverse, -np.inf).max(axis=1) - np.where(measured, inverse, np.inf).min(axis=1)
    return np.where(inside & (count >= 20) & (spread < 0.12 * mean), mean, np.nan)
