"""Decode colour and depth images, and say in one line what is wrong with those that cannot be."""

from __future__ import annotations

from io import BytesIO
from pathlib import Path

import cv2
import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from dynslam_bench.core.errors import SequenceError
from dynslam_bench.core.images import MOST_BYTES, read_image
from dynslam_bench.core.reading import read_bytes


def read_colour(path: Path, *, size: tuple[int, int] | None = None, mismatch: str = "") -> NDArray[np.uint8]:
    """The image as uint8 ``[H, W, 3]``, red first; grey images are repeated over the channels.

    Args:
        path: An image of 8 bits a channel.
        size: Width and height that it has to have; None for any.
        mismatch: Ends the message where it has another one.

    Raises:
        SequenceError: The file is missing, empty, truncated, of another size, no image, or has more than 8 bits a
            channel.
    """
    image = read_image(
        path, size=size, mismatch=mismatch, hint="name the right camera with --camera", kind=SequenceError
    )
    if image.dtype != np.uint8:
        raise SequenceError(
            f"colour image {path} has {image.dtype.itemsize * 8} bits a channel, expected 8",
            "do rgb.txt and depth.txt name the right files?",
        )
    if image.ndim == 2:
        return np.asarray(cv2.cvtColor(image, cv2.COLOR_GRAY2RGB), dtype=np.uint8)
    code = cv2.COLOR_BGRA2RGB if image.shape[2] == 4 else cv2.COLOR_BGR2RGB
    return np.asarray(cv2.cvtColor(image, code), dtype=np.uint8)


def read_depth(
    path: Path,
    depth_factor: float,
    *,
    size: tuple[int, int] | None = None,
    mismatch: str = "",
    missing: int | None = None,
    furthest_m: float | None = None,
) -> NDArray[np.float32]:
    """The image as float32 ``[H, W]`` in metres, 0 where the depth is missing.

    Args:
        path: A 16-bit image of one channel, or an ``.npy`` array of metres.
        depth_factor: Raw units a metre of an image.
        size: Width and height that it has to have; None for any.
        mismatch: Ends the message where it has another one.
        missing: Raw value beside 0 that stands for a missing depth; None for none.
        furthest_m: Depth beyond this is missing; None for no limit.

    Raises:
        SequenceError: The file is missing, empty, truncated, of another size, no image, or not of 16 bits in one
            channel.
    """
    if path.suffix == ".npy":
        depth = read_metres(path, size=size, mismatch=mismatch)
    else:
        raw = _read_raw(path, depth_factor, size, mismatch)
        depth = raw.astype(np.float32) / np.float32(depth_factor)
        if missing is not None:
            depth[raw == missing] = 0
    if furthest_m is not None:
        depth[depth > furthest_m] = 0
    return depth


def _read_raw(path: Path, depth_factor: float, size: tuple[int, int] | None, mismatch: str) -> NDArray[np.uint16]:
    hint = "set the preprocessing's width and height to resize both"
    image = read_image(path, size=size, mismatch=mismatch, hint=hint, kind=SequenceError)
    if image.dtype != np.uint16 or image.ndim != 2:
        channels = 1 if image.ndim == 2 else image.shape[2]
        raise SequenceError(
            f"depth image {path} has {channels} channel(s) of {image.dtype.itemsize * 8} bits (values {image.min()} to "
            f"{image.max()}), expected 1 of 16 bits",
            f"store depth x {depth_factor:g} as 16-bit PNG; an 8-bit image has lost its range",
        )
    return image.astype(np.uint16, copy=False)


# Depth as arrays of metres in NumPy's own format; a file that claims to be huge is refused before it costs memory.


def read_metres(path: Path, *, size: tuple[int, int] | None = None, mismatch: str = "") -> NDArray[np.float32]:
    """The array as float32 ``[H, W]`` in metres; what is not finite or below 0 is missing, that is 0.

    Args:
        path: An ``.npy`` file of floating-point numbers.
        size: Width and height that it has to have; None for any.
        mismatch: Ends the message where it has another one.

    Raises:
        SequenceError: The file is missing, damaged, of another size, or holds something else.
    """
    data = read_bytes(path, limit=MOST_BYTES, kind=SequenceError)
    stream = BytesIO(data)
    try:
        version = npy.read_magic(stream)
        header = npy.read_array_header_1_0 if version == (1, 0) else npy.read_array_header_2_0
        shape, in_columns, kind = header(stream)
    except Exception as error:  # a damaged header makes numpy's reader raise whatever it likes
        raise SequenceError(f"depth array {path} cannot be read ({len(data)} bytes)", "it is no .npy file") from error
    rest = len(data) - stream.tell()
    if len(shape) != 2 or kind.kind != "f" or rest != int(kind.itemsize) * int(shape[0]) * int(shape[1]) or not rest:
        raise SequenceError(
            f"depth array {path} claims {kind} of shape {str(shape)[:60]} over {rest} bytes, expected rows of metres"
        )
    if size is not None and shape != size[::-1]:
        raise SequenceError(f"depth array {path} is {shape[1]}x{shape[0]}, {mismatch}")
    values = np.frombuffer(data, kind, offset=stream.tell()).reshape(shape, order="F" if in_columns else "C")
    with np.errstate(invalid="ignore", over="ignore"):
        depth = np.ascontiguousarray(values, dtype=np.float32)
        return np.where(np.isfinite(depth) & (depth > 0), depth, np.float32(0))
