"""What a frame must be before anything is computed from it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.contracts.sequence import Frame
from dynslam_bench.core.errors import TrackerError
from dynslam_bench.geometry.camera import Camera


def check_frame(frame: Frame, camera: Camera) -> None:
    """Refuse what is no frame of this camera.

    Raises:
        TrackerError: Colour is not uint8, depth no floating point in metres, sizes differ from the camera's, or the
            timestamp is not finite.
    """
    rgb, depth = np.asarray(frame.rgb), np.asarray(frame.depth)
    if rgb.dtype != np.uint8:
        raise TrackerError(f"frame {frame.index} has colour of type {rgb.dtype}", "it must be uint8")
    if depth.dtype.kind != "f":
        raise TrackerError(f"frame {frame.index} has depth of type {depth.dtype}", "it must be float32, in metres")
    if rgb.shape != (camera.height, camera.width, 3) or depth.shape != (camera.height, camera.width):
        raise TrackerError(
            f"frame {frame.index} has colour {rgb.shape} and depth {depth.shape}, "
            f"the camera is {camera.width}x{camera.height}"
        )
    if not np.isfinite(frame.timestamp):
        raise TrackerError(f"frame {frame.index} has the timestamp {frame.timestamp}", "it must be finite seconds")


def own_depth(depth: NDArray[np.floating]) -> NDArray[np.float32]:
    """A depth image of our own, which later frames look at: float32 metres, 0 wherever depth is missing or not finite.

    The caller may reuse the buffer that it gave.
    """
    own = np.array(depth, dtype=np.float32)
    if not np.isfinite(own).all():
        own[~np.isfinite(own)] = 0
    return own
