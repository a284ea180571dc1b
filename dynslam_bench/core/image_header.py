"""The size that an image file claims, read without decoding it: what is too large is refused before it costs memory."""

from __future__ import annotations

import re
import struct
from collections.abc import Iterator

_JPEG_SIZES = {0xC0 + kind for kind in range(16)} - {0xC4, 0xC8, 0xCC}
"""Markers of the start of a frame, which hold the size."""
_PNM = re.compile(rb"P[1-6]\s+(?:#[^\n]*\s+)*(\d{1,9})\s+(?:#[^\n]*\s+)*(\d{1,9})\s")


def image_size(data: bytes) -> tuple[int, int] | None:
    """Width and height in pixels that the header of a PNG, JPEG, TIFF, BMP or PNM file states; None if it is none."""
    try:
        if data.startswith(b"\x89PNG\r\n\x1a\n") and data[12:16] == b"IHDR":
            return _pair(">II", data, 16)
        if data.startswith(b"\xff\xd8"):
            return _jpeg(data)
        if data.startswith(b"BM"):
            wide = struct.unpack_from("<I", data, 14)[0] != 12  # the oldest headers count in 16 bits
            return _pair("<ii" if wide else "<HH", data, 18)
        if data[:4] in (b"II*\0", b"MM\0*"):
            return _tiff(data, "<" if data.startswith(b"II") else ">")
    except struct.error:
        return None
    match = _PNM.match(data[:4096])
    return None if match is None else (int(match[1]), int(match[2]))


def is_whole_jpeg(data: bytes) -> bool:
    """Whether the image data of a JPEG file ends with its end marker, which occurs nowhere within that data."""
    scan = next((position for position in _segments(data) if data[position + 1] == 0xDA), len(data))
    return data.find(b"\xff\xd9", scan) >= 0


def _pair(layout: str, data: bytes, position: int) -> tuple[int, int]:
    width, height = struct.unpack_from(layout, data, position)
    return abs(width), abs(height)  # a BMP whose rows come from the top has a negative height


def _jpeg(data: bytes) -> tuple[int, int] | None:
    """The largest of the sizes that the file states: decoders differ in which they take."""
    found = [
        _pair(">HH", data, position + 5)[::-1] for position in _segments(data) if data[position + 1] in _JPEG_SIZES
    ]
    return max(found, key=lambda size: size[0] * size[1], default=None)


def _segments(data: bytes) -> Iterator[int]:
    """Where the segments before the image data begin."""
    position = 2
    while position + 4 <= len(data):
        if data[position] != 0xFF:
            position += 1
            continue
        kind = data[position + 1]
        if kind == 0xFF or kind in (0x00, 0x01) or 0xD0 <= kind <= 0xD9:
            position += 1 if kind == 0xFF else 2
            continue
        yield position
        if kind == 0xDA:  # the image data begins
            return
        position += 2 + max(2, int(struct.unpack_from(">H", data, position + 2)[0]))


def _tiff(data: bytes, order: str) -> tuple[int, int] | None:
    """The largest width and height of the first directory, tiles among them."""
    (start,) = struct.unpack_from(order + "I", data, 4)
    (count,) = struct.unpack_from(order + "H", data, start)
    sizes: dict[int, int] = {}
    for entry in range(count):
        position = start + 2 + 12 * entry
        tag, kind = struct.unpack_from(order + "HH", data, position)
        if tag in (256, 257, 322, 323):  # width, height, and those of a tile
            (value,) = struct.unpack_from(order + ("H" if kind == 3 else "I"), data, position + 8)
            sizes[tag] = max(int(value), sizes.get(tag, 0))
    if 256 not in sizes or 257 not in sizes:
        return None
    return max(sizes[256], sizes.get(322, 0)), max(sizes[257], sizes.get(323, 0))
