"""The control row that claims the camera stands still."""

from __future__ import annotations

import numpy as np

from dynslam_bench.contracts.result import TrackResult
from dynslam_bench.contracts.sequence import Frame
from dynslam_bench.core.settings import Settings
from dynslam_bench.geometry.camera import Camera


class NeverMove:
    """Gives the identity pose on every frame, whatever it shows.

    Its error is the spread of the ground truth: a tracker that does not beat it has learned nothing from the images.
    """

    def __init__(self, settings: Settings) -> None:
        self.settings = settings

    def reset(self, camera: Camera, *, rng: np.random.Generator) -> None:
        """Begin a new sequence; there is nothing to prepare."""

    def track(self, frame: Frame) -> TrackResult:
        """The identity pose, state ``ok``."""
        return TrackResult(T_world_cam=np.eye(4), state="ok")
