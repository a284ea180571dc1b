"""Reading an image at points."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def inside(mask: NDArray[np.bool_], xy: NDArray[np.floating]) -> NDArray[np.bool_]:
    """Bool ``[N]``: which raw pixels ``[N, 2]`` lie on the mask ``[H, W]``; pixels outside the image do not."""
    height, width = mask.shape
    column, row = np.rint(xy).astype(np.intp).T
    seen = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    return np.asarray(seen & mask[row.clip(0, height - 1), column.clip(0, width - 1)])
