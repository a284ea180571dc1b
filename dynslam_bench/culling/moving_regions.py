"""The region rule: in a moving region many points fail a test, and a lone failure is noise."""

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from dynslam_bench.geometry import at_width

CELL = 16
"""Side of the cells in which failing points are counted, pixels at an image width of 640."""
NEIGHBOURHOOD = (5, 5)
"""Cells around a point in which it needs company: 80 x 80 px at an image width of 640."""
MIN_FAILING = 3
"""Fewest failing points of a moving region."""


def cell_index(
    xy: NDArray[np.floating], size: float, shape: tuple[int, ...]
) -> tuple[NDArray[np.intp], tuple[int, int]]:
    """Cell of each pixel ``[N, 2]`` in a grid over an image ``(H, W)``, row by row, and the grid's rows and columns."""
    rows = math.ceil(shape[0] / size)
    columns = math.ceil(shape[1] / size)
    cell = np.floor(xy / size).astype(np.intp)
    return cell[:, 1].clip(0, rows - 1) * columns + cell[:, 0].clip(0, columns - 1), (rows, columns)


def _neighbourhood_sum(
    values: NDArray[np.generic], cell: NDArray[np.intp], grid: tuple[int, int]
) -> NDArray[np.float64]:
    """Sum of values ``[N]`` in the neighbourhood of each cell of a grid; cells as in `cell_index`."""
    total = np.bincount(cell, weights=values, minlength=grid[0] * grid[1]).reshape(grid)
    summed = cv2.boxFilter(
        total, -1, NEIGHBOURHOOD, normalize=False, borderType=cv2.BORDER_CONSTANT
    )
    return np.asarray(summed, dtype=np.float64).ravel()


def in_moving_region(
    failing: NDArray[np.bool_],
    tested: NDArray[np.bool_],
    xy: NDArray[np.floating],
    share: float,
    size: tuple[int, ...],
) -> NDArray[np.bool_]:
    """The region rule: failing points in whose neighbourhood enough of the tested points fail.

    The neighbourhood is 5 x 5 cells of 16 px at an image width of 640.

    Args:
        failing: bool ``[N]``, points that failed a test.
        tested: bool ``[N]``, points that were tested.
        xy: Raw pixels ``[N, 2]``.
        share: Share of the tested points in the neighbourhood that must fail; 0 keeps all failures.
        size: Image height and width.

    Returns:
        Bool ``[N]``, a subset of `failing`.
    """
    if share <= 0 or not failing.any():
        return failing
    index, grid = cell_index(xy, at_width(CELL, size[1]), size)
    failures = _neighbourhood_sum(failing & tested, index, grid)[index]
    tests = _neighbourhood_sum(tested, index, grid)[index]
    return np.asarray(failing & (failures >= MIN_FAILING) & (failures >= share * tests))
