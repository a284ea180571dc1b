"""Decode image files; a file of a few bytes that claims to be huge is refused before any memory is taken for it."""

from __future__ import annotations

import struct
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from dynslam_bench.core.errors import DynslamError
from dynslam_bench.core.image_header import image_size, is_whole_jpeg
from dynslam_bench.core.reading import MEGABYTE, read_bytes

Image = NDArray[np.integer | np.floating]
MOST_PIXELS = 1 << 26
"""Larger images (67 megapixels) are refused where nothing says which size to expect."""
MOST_BYTES = 512 * MEGABYTE
AS_STORED = cv2.IMREAD_UNCHANGED | cv2.IMREAD_IGNORE_ORIENTATION
_JPEG_START = b"\xff\xd8\xff"
_PNG_START = b"\x89PNG\r\n\x1a\n"


def read_image(
    path: Path,
    *,
    size: tuple[int, int] | None = None,
    mismatch: str = "another size was expected",
    hint: str = "",
    flags: int = AS_STORED,
    kind: type[DynslamError] = DynslamError,
) -> Image:
    """Decode a PNG, JPEG, TIFF, BMP or PNM file.

    Args:
        path: The file.
        size: Width and height that it has to have, in pixels; None for any up to `MOST_PIXELS`.
        mismatch: Ends the message where it has another one, e.g. ``but the camera is 640x480``.
        hint: What to do then.
        flags: OpenCV's ``IMREAD_*``.
        kind: What is raised.

    Returns:
        ``[H, W]`` or ``[H, W, C]`` with blue first, as OpenCV gives it.

    Raises:
        DynslamError: Of the given kind: the file is missing, empty, truncated, of another size or no image.
    """
    data = read_bytes(path, limit=MOST_BYTES, kind=kind)
    if not data:
        raise kind(f"image {path} is empty (0 bytes)", "fetch it again")
    whole = not data.startswith(_PNG_START) or _is_whole_png(data)
    if not whole or (data.startswith(_JPEG_START) and not is_whole_jpeg(data)):
        # OpenCV fills what is missing of a JPEG, some versions also of a PNG; some take the memory that a chunk claims
        raise kind(f"image {path} is truncated ({len(data)} bytes)", "fetch it again")
    found = image_size(data)
    if found is not None and size is not None and found != size:
        raise kind(f"image {path} is {found[0]}x{found[1]}, {mismatch}", hint)
    if found is not None and found[0] * found[1] > MOST_PIXELS:
        most = f"at most {MOST_PIXELS >> 20} megapixels are decoded"
        raise kind(f"image {path} ({len(data)} bytes) claims to be {found[0]}x{found[1]}, {most}")
    try:
        image = None if found is None else cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error:
        image = None
    if image is None or 0 in image.shape:
        raise kind(
            f"image {path} cannot be decoded ({len(data)} bytes)", "it is damaged, or no PNG, JPEG, TIFF, BMP or PNM"
        )
    return np.asarray(image)


def _is_whole_png(data: bytes) -> bool:
    """Whether every chunk up to the last ends within the file."""
    position = len(_PNG_START)
    while position + 12 <= len(data):
        (length,), kind = struct.unpack_from(">I", data, position), data[position + 4 : position + 8]
        position += 12 + int(length)
        if kind == b"IEND":
            return position <= len(data)
    return False
