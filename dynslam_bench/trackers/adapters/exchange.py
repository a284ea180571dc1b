"""How a foreign program gets the images: a memory-mapped file that is overwritten, or PNG files."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np

from dynslam_bench.contracts.sequence import Frame
from dynslam_bench.core.errors import InfrastructureError, TrackerError
from dynslam_bench.core.temporary import SHARED_MEMORY, TemporaryFolder
from dynslam_bench.geometry.camera import Camera

FRAME_FILE = "frame.raw"


class ImageExchange:
    """A private folder through which the frames reach a program; removed by `close`, at the latest with the object.

    ``raw``: one file ``frame.raw`` of fixed size, in shared memory where the system has it. It holds the colour image
    (uint8 ``[H, W, 3]``, red first, row by row) at `rgb_offset` and the depth (little-endian float32 ``[H, W]``,
    metres, 0 = missing) at `depth_offset`, and is overwritten before each ``track``. ``png``: for each frame an 8-bit
    colour PNG and a 16-bit depth PNG in units of ``1 / depth_factor`` metres, as in TUM's files; those of the frame
    before are removed.

    Args:
        camera: Of the frames.
        mode: ``raw`` or ``png``.
    """

    def __init__(self, camera: Camera, mode: Literal["raw", "png"]) -> None:
        self.camera, self.mode = camera, mode
        self._last: tuple[Path, ...] = ()
        colour = camera.height * camera.width * 3
        self.depth_offset = -(-colour // 16) * 16
        size = self.depth_offset + camera.height * camera.width * 4
        self._temporary = _with_space(size) if mode == "raw" else TemporaryFolder()
        self.folder = self._temporary.path
        if mode == "raw":
            self._memory = np.memmap(self.folder / FRAME_FILE, np.uint8, "r+", shape=(size,))
            self._rgb = self._memory[:colour].reshape(camera.height, camera.width, 3)
            self._depth = self._memory[self.depth_offset :].view("<f4").reshape(camera.height, camera.width)

    def announce(self) -> dict[str, Any]:
        """What the program is told once, in ``reset``."""
        if self.mode == "png":
            return {"mode": "png", "depth_factor": self.camera.depth_factor}
        return {
            "mode": "raw",
            "file": str(self.folder / FRAME_FILE),
            "rgb_offset": 0,
            "depth_offset": self.depth_offset,
            "bytes": int(self._memory.size),
        }

    def put(self, frame: Frame) -> dict[str, Any]:
        """Hand over a frame; what the program is told of it in ``track``.

        Raises:
            TrackerError: The images do not have the camera's size.
        """
        expected = (self.camera.height, self.camera.width)
        if frame.rgb.shape != (*expected, 3) or frame.depth.shape != expected:
            raise TrackerError(
                f"frame {frame.index} has colour {frame.rgb.shape} and depth {frame.depth.shape}, "
                f"but the camera is {self.camera.width}x{self.camera.height}"
            )
        if self.mode == "raw":
            np.copyto(self._rgb, frame.rgb)
            np.copyto(self._depth, frame.depth)
            return {}
        return self._write_png(frame)

    def _write_png(self, frame: Frame) -> dict[str, Any]:
        rgb, depth = (self.folder / f"{kind}-{frame.index:06d}.png" for kind in ("rgb", "depth"))
        units = np.rint(np.nan_to_num(frame.depth) * self.camera.depth_factor).clip(0, 65535).astype(np.uint16)
        fast = [cv2.IMWRITE_PNG_COMPRESSION, 1]
        for path, image in ((rgb, cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2BGR)), (depth, units)):
            if not cv2.imwrite(str(path), image, fast):
                raise TrackerError(f"cannot write {path}", "is the temporary folder full?")
        for old in self._last:
            if old not in (rgb, depth):
                old.unlink(missing_ok=True)
        self._last = (rgb, depth)
        return {"rgb": str(rgb), "depth": str(depth)}

    def close(self) -> None:
        """Remove the folder; may be called more than once."""
        self._temporary.close()


def _with_space(size: int) -> TemporaryFolder:
    """A folder with the file for the frames, its space taken already: a full disk would end the run by SIGBUS later.

    Raises:
        InfrastructureError: There is no room, neither in shared memory nor among the temporary files.
    """
    reasons = []
    for base in (SHARED_MEMORY, None):
        try:
            folder = TemporaryFolder(base)
        except OSError as error:
            reasons.append(f"{base or tempfile.gettempdir()}: {error.strerror}")
            continue
        try:
            (folder.path / FRAME_FILE).write_bytes(bytes(size))
        except OSError as error:
            folder.close()
            reasons.append(f"{folder.path.parent}: {error.strerror}")
            continue
        return folder
    raise InfrastructureError(f"no room for a frame of {size / 1e6:.1f} MB: {'; '.join(reasons)}", "free some space")
