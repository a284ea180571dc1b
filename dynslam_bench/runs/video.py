"""The video of a run, in a format that browsers play: VP9 in WebM, which OpenCV brings along."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from dynslam_bench.core.errors import RunError
from dynslam_bench.envs.slam_env import SlamEnv

VIDEO_FILE = "video.webm"


class VideoWriter:
    """Writes the rendered frames of an environment as `VIDEO_FILE`; a run that ends early leaves what it has.

    Args:
        folder: Where to write.
        env: The run's environment, in render mode ``rgb_array``.
    """

    def __init__(self, folder: Path, env: SlamEnv) -> None:
        self._path, self._env = folder / VIDEO_FILE, env
        self._writer: Any = None

    def add(self) -> None:
        """Append the picture of the current frame.

        Raises:
            RunError: This OpenCV cannot write such a video.
        """
        import cv2

        image = self._env.render()
        assert image is not None
        if self._writer is None:
            size = (image.shape[1], image.shape[0])
            code = cv2.VideoWriter.fourcc(*"VP90")
            self._writer = cv2.VideoWriter(str(self._path), code, self._env.sequence.fps, size)
            if not self._writer.isOpened():
                raise RunError(
                    f"OpenCV {cv2.__version__} cannot write VP9 video",
                    "pip install opencv-python-headless, or no --video",
                )
        self._writer.write(np.ascontiguousarray(image[:, :, ::-1]))

    def close(self) -> None:
        """Finish the file."""
        if self._writer is not None:
            self._writer.release()
