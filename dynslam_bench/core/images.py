"""Decode image files; a file of a few bytes that claims to be huge is refused before any memory is taken for it."""

import contextlib
import io
import struct
import warnings
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.core.errors import DynslamError
from dynslam_bench.core.reading import MEGABYTE, read_bytes

Image = NDArray[np.integer | np.floating]
MOST_PIXELS = 1 << 26
"""Larger images (67 megapixels) are refused where nothing says which size to expect."""
MOST_BYTES = 512 * MEGABYTE
"""A larger file is not read."""
_PNG_START = b"\x89PNG\r\n\x1a\n"
"""The first bytes of a PNG file."""
_TILE_SIZE = (322, 323)
"""TIFF tags of the width and height of a tile, for which OpenCV takes memory as well."""


def image_size(data: bytes) -> tuple[int, int] | None:
    """Width and height in pixels that the header of a PNG, JPEG, TIFF, BMP or PNM file states; None if it is none."""
    from PIL import BmpImagePlugin, JpegImagePlugin, PngImagePlugin, PpmImagePlugin, TiffImagePlugin

    png = PngImagePlugin.PngImageFile
    jpeg = JpegImagePlugin.JpegImageFile
    tiff = TiffImagePlugin.TiffImageFile
    for reader in (png, jpeg, tiff, BmpImagePlugin.BmpImageFile, PpmImagePlugin.PpmImageFile):
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # of damaged metadata
                # not `PIL.Image.open`, which does not state a size that is too large
                image = reader(io.BytesIO(data))
            tags = getattr(image, "tag_v2", {})
            tile_width, tile_height = (int(tags.get(tag, 0)) for tag in _TILE_SIZE)
            return max(image.width, tile_width), max(image.height, tile_height)
        except Exception:  # Pillow raises almost anything over damaged headers
            continue
    return None


def read_image(
    path: Path,
    *,
    size: tuple[int, int] | None = None,
    mismatch: str = "another size was expected",
    hint: str = "",
    flags: int | None = None,
    kind: type[DynslamError] = DynslamError,
) -> Image:
    """Decode a PNG, JPEG, TIFF, BMP or PNM file.

    Args:
        path: The file.
        size: Width and height that it has to have, in pixels; None for any up to `MOST_PIXELS`.
        mismatch: Ends the message where it has another one, e.g. ``but the camera is 640x480``.
        hint: What to do then.
        flags: OpenCV's ``IMREAD_*``; None for the pixels as they are stored.
        kind: What is raised.

    Returns:
        ``[H, W]`` or ``[H, W, C]`` with blue first, as OpenCV gives it.

    Raises:
        DynslamError: Raised as `kind`: the file is missing, empty, truncated, of another size or no
            image.
    """
    import cv2

    data = read_bytes(path, limit=MOST_BYTES, kind=kind)
    if not data:
        raise kind(f"image {path} is empty (0 bytes)", "fetch it again")
    if not _is_whole(data):
        raise kind(f"image {path} is truncated ({len(data)} bytes)", "fetch it again")

    # the size that the header states, before any memory is taken for the pixels
    stated = image_size(data)
    if stated is not None and size is not None and stated != size:
        raise kind(f"image {path} is {stated[0]}x{stated[1]}, {mismatch}", hint)
    if stated is not None and stated[0] * stated[1] > MOST_PIXELS:
        most = f"at most {MOST_PIXELS >> 20} megapixels are decoded"
        raise kind(f"image {path} ({len(data)} bytes) claims to be {stated[0]}x{stated[1]}, {most}")

    if flags is None:
        flags = cv2.IMREAD_UNCHANGED | cv2.IMREAD_IGNORE_ORIENTATION
    image = None
    if stated is not None:
        with contextlib.suppress(cv2.error):
            image = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    if image is None or 0 in image.shape:
        raise kind(
            f"image {path} cannot be decoded ({len(data)} bytes)",
            "it is damaged, or no PNG, JPEG, TIFF, BMP or PNM",
        )
    return np.asarray(image)


def _is_whole(data: bytes) -> bool:
    """Whether a PNG or JPEG file has its end.

    OpenCV fills what is missing of a JPEG, and some versions of it of a PNG; some take the memory
    that a chunk claims.
    """
    # JPEG: the marker of its end (FFD9) does not occur within the image data (FFDA) that it ends
    if data.startswith(b"\xff\xd8\xff"):
        return data.rfind(b"\xff\xd9") > data.rfind(b"\xff\xda") > 0
    if not data.startswith(_PNG_START):
        return True
    # PNG: chunks of length, kind, data and checksum, of which IEND is the last one
    position = len(_PNG_START)
    while position + 12 <= len(data):
        (length,) = struct.unpack_from(">I", data, position)
        kind = data[position + 4 : position + 8]
        position += 12 + int(length)
        if kind == b"IEND":
            return position <= len(data)
    return False
