"""The cache of rendered frames: a folder in TUM layout, written frame by frame and checked when read.

``rgb/``, ``depth/`` and ``masks/`` hold one PNG a frame, named by its stamp; ``rgb.txt``, ``depth.txt`` and
``groundtruth.txt`` list them. Every file appears by an atomic rename and every read checks the PNG's checksums, so
several processes may render into one folder, an interrupted rendering goes on where it stopped, and a damaged file
counts as missing.
"""

from __future__ import annotations

import struct
import zlib
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from dynslam_bench.core.errors import SequenceError
from dynslam_bench.core.files import write_atomic
from dynslam_bench.core.reading import read_lines
from dynslam_bench.geometry import se3
from dynslam_bench.geometry.camera import Camera
from dynslam_bench.geometry.stamps import format_ns
from dynslam_bench.geometry.trajectory import Trajectory

from ..published.cameras import write_camera
from ..readers.lists import read_stamped_lines
from .settings import FPS

_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_KINDS = ("masks", "depth", "rgb")


# Huffman coding after the SUB filter: as small as level 1 on noisy images, and more than twice as fast.
_FAST_PNG = [cv2.IMWRITE_PNG_COMPRESSION, 1, cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_HUFFMAN_ONLY]
if hasattr(cv2, "IMWRITE_PNG_FILTER"):
    _FAST_PNG += [cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_SUB]
_MASK_PNG = [cv2.IMWRITE_PNG_COMPRESSION, 1]


def encode_png(image: NDArray[Any]) -> bytes:
    """A PNG of an RGB (uint8, three channels) or single-channel (uint8, uint16) image.

    Raises:
        SequenceError: The encoder refuses the image.
    """
    stored = cv2.cvtColor(image, cv2.COLOR_RGB2BGR) if image.ndim == 3 else image
    done, data = cv2.imencode(".png", stored, _MASK_PNG if image.ndim == 2 and image.dtype == np.uint8 else _FAST_PNG)
    if not done:
        raise SequenceError(f"cannot encode an image of shape {image.shape} and type {image.dtype} as PNG")
    return bytes(data.tobytes())


def is_intact_png(data: bytes) -> bool:
    """Whether the bytes are a complete PNG whose chunks all carry the right checksum."""
    if data[:8] != _SIGNATURE:
        return False
    position = 8
    while position + 12 <= len(data):
        (length,) = struct.unpack_from(">I", data, position)
        end = position + 12 + length
        if end > len(data):
            return False
        (stored,) = struct.unpack_from(">I", data, end - 4)
        if zlib.crc32(data[position + 4 : end - 4]) != int(stored):
            return False
        if data[position + 4 : position + 8] == b"IEND":
            return bool(end == len(data))
        position = end
    return False


class FrameStore:
    """The cache folder of one rendered sequence.

    Args:
        folder: The folder; it need not exist.
        camera: For ``camera.toml`` and the expected image size.
    """

    def __init__(self, folder: Path, camera: Camera) -> None:
        self.folder = folder
        self.camera = camera

    def path(self, kind: str, stamp: float) -> Path:
        """Where a frame's image of a kind (``rgb``, ``depth``, ``masks``) lies."""
        return self.folder / kind / f"{stamp:.6f}.png"

    def is_intact(self, stamp: float) -> bool:
        """Whether all images of a frame lie in the cache, complete and of the right size and type."""
        return all(self._bytes(kind, stamp) is not None for kind in _KINDS)

    def read(self, kind: str, stamp: float) -> NDArray[Any] | None:
        """An image (RGB order), or None if it is missing or damaged.

        Raises:
            SequenceError: The file exists but cannot be read (permissions, input error).
        """
        data = self._bytes(kind, stamp)
        try:
            image = None if data is None else cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
        except cv2.error:
            return None
        if image is None:
            return None
        return cv2.cvtColor(image, cv2.COLOR_BGR2RGB) if kind == "rgb" else image

    def _bytes(self, kind: str, stamp: float) -> bytes | None:
        """The bytes of an image file if it is intact and what it should be."""
        path = self.path(kind, stamp)
        try:
            data = path.read_bytes()
        except FileNotFoundError:
            return None
        except OSError as error:
            raise SequenceError(
                f"cannot read {path}: {error.strerror}", "check the permissions of the cache"
            ) from error
        bits, color = {"rgb": (8, 2), "depth": (16, 0), "masks": (8, 0)}[kind]
        header = struct.pack(">IIBB", self.camera.width, self.camera.height, bits, color)
        return data if is_intact_png(data) and data[16:26] == header else None

    def write(self, stamp: float, rgb: NDArray[np.uint8], depth: NDArray[np.uint16], masks: NDArray[np.uint8]) -> None:
        """Store a frame; the colour image comes last, so that a frame with one is complete.

        Raises:
            DynslamError: The folder cannot be written.
        """
        images: dict[str, NDArray[Any]] = {"masks": masks, "depth": depth, "rgb": rgb}
        for kind, image in images.items():
            write_atomic(self.path(kind, stamp), encode_png(image))

    def has(self, stamp: float) -> bool:
        """Whether all images of a frame lie in the cache (not checked for damage)."""
        return all(self.path(kind, stamp).is_file() for kind in _KINDS)

    def write_lists(self, truth: Trajectory) -> None:
        """Write ``rgb.txt``, ``depth.txt`` and ``masks.txt`` of the frames there are, the poses and the camera.

        The poses are those of `truth`, or those already listed where these are more.
        """
        listed = [float(stamp) for stamp in truth.timestamps if self.has(float(stamp))]
        for kind in _KINDS:
            lines = [f"# {kind} images of a rendered sequence", "# timestamp filename", "#"]
            known = {f"{stamp:.6f}" for stamp in listed}
            known |= self._listed(kind)
            lines += [f"{stamp} {kind}/{stamp}.png" for stamp in sorted(known, key=float)]
            write_atomic(self.folder / f"{kind}.txt", "\n".join(lines) + "\n")
        poses = self.folder / "groundtruth.txt"
        if not poses.is_file() or sum(1 for _ in read_lines(poses, kind=SequenceError)) < len(truth) + 3:
            translation, quaternion = se3.to_quaternion(truth.T_world_cam)
            rows = np.concatenate([translation, quaternion], axis=1)
            lines = ["# exact poses of a rendered sequence", "# timestamp tx ty tz qx qy qz qw", "#"]
            lines += [
                f"{t:.6f} " + " ".join(f"{x:.9f}" for x in row) for t, row in zip(truth.timestamps, rows, strict=True)
            ]
            write_atomic(poses, "\n".join(lines) + "\n")
        write_camera(self.folder / "camera.toml", self.camera, fps=FPS)

    def _listed(self, kind: str) -> set[str]:
        path = self.folder / f"{kind}.txt"
        if not path.is_file():
            return set()
        stamps = {format_ns(ns)[:-3] for ns, _ in read_stamped_lines(path) if ns is not None}
        return {stamp for stamp in stamps if (self.folder / kind / f"{stamp}.png").is_file()}
