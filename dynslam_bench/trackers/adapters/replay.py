"""Any trajectory file as a tracker, so that foreign results enter the same pipeline."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from dynslam_bench.contracts.result import TrackResult
from dynslam_bench.contracts.sequence import Frame
from dynslam_bench.geometry.camera import Camera
from dynslam_bench.geometry.tum_file import read_tum

from .settings import ReplaySettings


class Replay:
    """Gives each frame the pose whose stamp lies nearest, as it stands in the file.

    A frame with no pose within the tolerance is lost; the two poses beside it are not interpolated. The poses stay in
    the file's world frame.

    Args:
        settings: Which file, and the tolerance.

    Raises:
        TrajectoryError: The file is missing, damaged, or holds no pose.
    """

    def __init__(self, settings: ReplaySettings) -> None:
        self.settings = settings
        self._trajectory = read_tum(Path(settings.file).expanduser())

    def reset(self, camera: Camera, *, rng: np.random.Generator) -> None:
        """Begin a new sequence; the poses depend on the frames' stamps only."""

    def track(self, frame: Frame) -> TrackResult:
        """The pose of the frame's stamp, ``ok``; or ``lost`` without a pose. Stats: ``stamp_gap_s`` to the nearest."""
        stamps = self._trajectory.timestamps
        at = int(np.searchsorted(stamps, frame.timestamp))
        nearest = min((i for i in (at - 1, at) if 0 <= i < len(stamps)), key=lambda i: abs(stamps[i] - frame.timestamp))
        gap = float(abs(stamps[nearest] - frame.timestamp))
        stats = {"stamp_gap_s": gap}
        if gap > self.settings.tolerance_s + 1e-9:  # rounding of the difference
            return TrackResult(T_world_cam=None, state="lost", stats=stats)
        return TrackResult(T_world_cam=self._trajectory.T_world_cam[nearest].copy(), state="ok", stats=stats)
