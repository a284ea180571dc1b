"""What the renderer's kernels are handed."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Ints = NDArray[np.integer]
Reals = NDArray[np.floating]
Intrinsics = tuple[float, float, float, float]
"""Focal lengths and principal point, pixels."""
