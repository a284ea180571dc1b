"""Messages of ROS as images, stamps, poses and cameras; ROS 1 and 2 name a few fields otherwise."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from dynslam_bench.core.errors import SequenceError
from dynslam_bench.geometry.camera import Camera

COLOURS: dict[str, int | None] = {
    "rgb8": cv2.COLOR_RGB2BGR,
    "bgr8": None,
    "rgba8": cv2.COLOR_RGBA2BGR,
    "bgra8": cv2.COLOR_BGRA2BGR,
    "mono8": None,
    "8UC3": None,
    "8UC1": None,
}
DEPTHS: dict[str, np.dtype[Any]] = {
    "16UC1": np.dtype(np.uint16),
    "mono16": np.dtype(np.uint16),
    "32FC1": np.dtype(np.float32),
}
MILLIMETRES = 1000.0
"""Units a metre of a 16-bit depth image, as REP 118 of ROS has it; one of floating-point numbers is in metres."""


def stamp_text(message: Any) -> str:
    """The header's stamp in seconds, to the nanosecond."""
    stamp = message.header.stamp
    return f"{int(stamp.sec)}.{int(stamp.nanosec):09d}"


def kind_of(message: Any) -> str:
    """``colour``, ``depth`` or empty, of an image message, compressed or not."""
    if hasattr(message, "encoding"):
        return "depth" if message.encoding in DEPTHS else "colour" if message.encoding in COLOURS else ""
    return "" if "compressedDepth" in message.format else "colour"


def colour_file(message: Any, where: str) -> tuple[str, bytes]:
    """Suffix and content of a file that holds the colour image: as it came where it is compressed, else a PNG.

    Raises:
        SequenceError: It is no such image.
    """
    if not hasattr(message, "encoding"):
        data = bytes(message.data)
        return (".png" if data.startswith(b"\x89PNG") else ".jpg"), data
    if message.encoding not in COLOURS:
        raise SequenceError(f"{where} is of '{message.encoding}', expected one of {', '.join(COLOURS)}")
    pixels = _pixels(message, np.dtype(np.uint8), where)
    code = COLOURS[message.encoding]
    return ".png", cv2.imencode(".png", pixels if code is None else cv2.cvtColor(pixels, code))[1].tobytes()


def depth_array(message: Any, where: str) -> NDArray[np.generic]:
    """The depth image ``[H, W]``: uint16 millimetres or float32 metres.

    Raises:
        SequenceError: It is no such image.
    """
    kind = DEPTHS.get(getattr(message, "encoding", ""))
    if kind is None:
        raise SequenceError(f"{where} holds no depth image of {', '.join(DEPTHS)}", "choose another topic with --depth")
    return _pixels(message, kind, where)


def _pixels(message: Any, kind: np.dtype[Any], where: str) -> NDArray[Any]:
    height, width, step = int(message.height), int(message.width), int(message.step)
    data = np.frombuffer(bytes(message.data), np.uint8)
    if min(height, width) < 1 or len(data) != height * step or step < width * kind.itemsize:
        raise SequenceError(f"{where} is {width}x{height} in {len(data)} bytes, {step} a row")
    channels = {"rgb8": 3, "bgr8": 3, "8UC3": 3, "rgba8": 4, "bgra8": 4}.get(message.encoding, 1)
    used = width * channels * kind.itemsize
    if used > step:
        raise SequenceError(f"{where} has rows of {step} bytes, too short for {width} pixels of {message.encoding}")
    rows = np.ascontiguousarray(data.reshape(height, step)[:, :used])
    order = kind.newbyteorder(">" if message.is_bigendian else "<")
    values = rows.view(order).astype(kind)
    return values.reshape(height, width, channels) if channels > 1 else values


def camera_of(message: Any, where: str) -> Camera:
    """The camera of a ``CameraInfo``.

    Raises:
        SequenceError: Its distortion is not the radial-tangential one of five coefficients, or it is none.
    """
    k, d = (np.asarray(getattr(message, name, getattr(message, name.upper(), ())), float).ravel() for name in "kd")
    if len(k) != 9 or not np.isfinite(k).all() or min(k[0], k[4], message.width, message.height) <= 0:
        raise SequenceError(f"{where} holds no calibration (K = {k.tolist()})", "the camera was not calibrated")
    if message.distortion_model not in ("", "plumb_bob", "rational_polynomial") or d[5:].any():
        raise SequenceError(f"{where} has the distortion '{message.distortion_model}', only plumb_bob is read")
    coefficients = [*d[:5].tolist(), *[0.0] * 5][:5]
    size = int(message.width), int(message.height)
    return Camera(*size, k[0], k[4], k[2], k[5], tuple(coefficients), MILLIMETRES)


def pose_line(message: Any) -> str:
    """A line ``timestamp tx ty tz qx qy qz qw`` of a stamped pose, transformation or odometry."""
    inner = getattr(message, "pose", None) or message.transform
    inner = getattr(inner, "pose", inner)  # with covariance
    position = getattr(inner, "position", None) or inner.translation
    rotation = getattr(inner, "orientation", None) or inner.rotation
    values = (position.x, position.y, position.z, rotation.x, rotation.y, rotation.z, rotation.w)
    return " ".join([stamp_text(message), *[repr(float(value)) for value in values]])
