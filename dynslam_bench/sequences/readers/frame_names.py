"""Images of folders without lists: found by their names, sized by their headers."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.core.errors import SequenceError
from dynslam_bench.core.image_header import image_size
from dynslam_bench.core.reading import MEGABYTE, read_bytes
from dynslam_bench.geometry.camera import Camera
from dynslam_bench.geometry.stamps import format_ns, refuse_close

from .lists import MOST_LINES, ImageList


def find_names(folder: Path, pattern: str) -> list[str]:
    """Paths of the files that match, relative to the folder, in the order of their names; at least one.

    Raises:
        SequenceError: There is none.
    """
    found = sorted(path.relative_to(folder).as_posix() for path in folder.glob(pattern))
    if not found or len(found) > MOST_LINES:
        raise SequenceError(f"{folder} holds {len(found)} files {pattern}", "is it the folder of one sequence?")
    return found


def stamped(files: list[str], stamps: NDArray[np.int64], where: str) -> ImageList:
    """Images with a stamp each, in nanoseconds, put in order of time.

    Raises:
        SequenceError: The numbers differ, or stamps are equal or less than 1 us apart.
    """
    if len(files) != len(stamps):
        raise SequenceError(f"{where} holds {len(files)} images but {len(stamps)} stamps")
    order = np.argsort(stamps, kind="stable")
    ordered = stamps[order]
    equal = np.flatnonzero(np.diff(ordered) == 0)
    if len(equal):
        raise SequenceError(
            f"{where} holds {len(equal)} stamps twice, the first is {format_ns(int(ordered[equal[0]]))} s"
        )
    refuse_close(ordered, where, SequenceError)
    return ImageList(ordered, tuple(files[i] for i in order))


def pinhole(folder: Path, first: str, fx: float, fy: float, cx: float, cy: float, depth_factor: float) -> Camera:
    """A camera without distortion; its size is that of the first colour image.

    Raises:
        SequenceError: The image has no size, or a focal length is not positive.
    """
    size = image_size(read_bytes(folder / first, limit=512 * MEGABYTE, kind=SequenceError))
    if size is None:
        raise SequenceError(f"image {folder / first} is no PNG, JPEG, TIFF, BMP or PNM")
    if not (fx > 0 and fy > 0 and depth_factor > 0):
        raise SequenceError(
            f"the camera of {folder} has the focal lengths {fx:g} and {fy:g} and {depth_factor:g} depth units a metre"
        )
    return Camera(*size, fx, fy, cx, cy, depth_factor=depth_factor)
