"""Cells of the image, and the region rule: in a moving region many points fail, and a lone failure is noise."""

import cv2
import numpy as np
from numpy.typing import NDArray

CELL = 16
"""Side of the cells in which failing points are counted, pixels."""
NEIGHBOURHOOD = (5, 5)
"""Cells around a point in which it needs company: 80 x 80 px."""
MIN_FAILING = 3
"""Fewest failing points of a moving region."""


NEAR = np.array([(dx, dy) for dy in (-1, 0, 1) for dx in (-1, 0, 1)])
"""Offsets of the 3x3 pixels around a pixel, row by row."""


def cell_index(xy: NDArray[np.floating], size: int, shape: tuple[int, ...]) -> tuple[NDArray[np.intp], tuple[int, int]]:
    """Cell of each pixel ``[N, 2]`` in a grid over an image ``(H, W)``, row by row, and the grid's rows and columns."""
    rows, columns = -(-shape[0] // size), -(-shape[1] // size)
    cell = np.floor(xy / size).astype(np.intp)
    return cell[:, 1].clip(0, rows - 1) * columns + cell[:, 0].clip(0, columns - 1), (rows, columns)


def cell_mean(
    values: NDArray[np.generic], cell: NDArray[np.intp], grid: tuple[int, int], *, empty: float = 0.0
) -> NDArray[np.float64]:
    """Mean of values ``[N]`` in each cell of a grid, `empty` where there are none; cells as in `cell_index`."""
    count = np.bincount(cell, minlength=grid[0] * grid[1])
    total = np.bincount(cell, weights=values, minlength=grid[0] * grid[1])
    return np.where(count > 0, total / np.maximum(count, 1), empty)


def _neighbourhood_sum(
    values: NDArray[np.generic], cell: NDArray[np.intp], grid: tuple[int, int]
) -> NDArray[np.float64]:
    """Sum of values ``[N]`` in the neighbourhood of each cell of a grid; cells as in `cell_index`."""
    total = np.bincount(cell, weights=values, minlength=grid[0] * grid[1]).reshape(grid)
    summed = cv2.boxFilter(total, -1, NEIGHBOURHOOD, normalize=False, borderType=cv2.BORDER_CONSTANT)
    return np.asarray(summed, dtype=np.float64).ravel()


def failing_regions(
    failing: NDArray[np.bool_],
    tested: NDArray[np.bool_],
    xy: NDArray[np.floating],
    share: float,
    size: tuple[int, ...],
) -> NDArray[np.bool_]:
    """The region rule: failing points of whose tested neighbours enough fail too.

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
    index, grid = cell_index(xy, CELL, size)
    failures, tests = (_neighbourhood_sum(flags, index, grid)[index] for flags in (failing & tested, tested))
    return np.asarray(failing & (failures >= MIN_FAILING) & (failures >= share * tests))
