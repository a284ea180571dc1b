"""Decode colour and depth images, and say in one line what is wrong with those that cannot be."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from dynslam_bench.core.errors import SequenceError

Image = NDArray[np.integer | np.floating]
_PNG_START = b"\x89PNG\r\n\x1a\n"
_PNG_END = b"IEND\xaeB`\x82"


def read_colour(path: Path) -> NDArray[np.uint8]:
    """The image as uint8 ``[H, W, 3]``, red first; grey images are repeated over the channels.

    Raises:
        SequenceError: The file is missing, empty, truncated, no image, or has more than 8 bits a channel.
    """
    image = _decode(path, cv2.IMREAD_UNCHANGED | cv2.IMREAD_IGNORE_ORIENTATION)
    if image.dtype != np.uint8:
        raise SequenceError(
            f"colour image {path} has {image.dtype.itemsize * 8} bits a channel, expected 8",
            "do rgb.txt and depth.txt name the right files?",
        )
    if image.ndim == 2:
        return np.asarray(cv2.cvtColor(image, cv2.COLOR_GRAY2RGB), dtype=np.uint8)
    code = cv2.COLOR_BGRA2RGB if image.shape[2] == 4 else cv2.COLOR_BGR2RGB
    return np.asarray(cv2.cvtColor(image, code), dtype=np.uint8)


def read_depth(path: Path, depth_factor: float) -> NDArray[np.float32]:
    """The image as float32 ``[H, W]`` in metres, 0 where the depth is missing.

    Args:
        path: A 16-bit image of one channel.
        depth_factor: Raw units a metre.

    Raises:
        SequenceError: The file is missing, empty, truncated, no image, or not of 16 bits in one channel.
    """
    image = _decode(path, cv2.IMREAD_UNCHANGED | cv2.IMREAD_IGNORE_ORIENTATION)
    if image.dtype != np.uint16 or image.ndim != 2:
        channels = 1 if image.ndim == 2 else image.shape[2]
        raise SequenceError(
            f"depth image {path} has {channels} channel(s) of {image.dtype.itemsize * 8} bits (values {image.min()} to "
            f"{image.max()}), expected 1 of 16 bits",
            f"store depth x {depth_factor:g} as 16-bit PNG; an 8-bit image has lost its range",
        )
    return image.astype(np.float32) / np.float32(depth_factor)


def _decode(path: Path, flags: int) -> Image:
    try:
        data = path.read_bytes()
    except OSError as error:
        raise SequenceError(f"cannot read image {path}: {error.strerror}") from error
    if not data:
        raise SequenceError(f"image {path} is empty (0 bytes)", "fetch the sequence again")
    truncated = data.startswith(_PNG_START) and _PNG_END not in data[-64:]
    if not truncated:
        # some OpenCV versions fill what is missing of a truncated PNG with zeros, hence the check above
        image = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
        if image is not None:
            return np.asarray(image)
    state = "is truncated" if truncated else "cannot be decoded"
    raise SequenceError(f"image {path} {state} ({len(data)} bytes)", "fetch the sequence again")
