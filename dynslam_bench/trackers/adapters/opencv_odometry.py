"""OpenCV's dense RGB-D odometry: `cv2.Odometry` of OpenCV 5, `cv2.rgbd` of the contrib packages of OpenCV 4."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from dynslam_bench.core.errors import TrackerError
from dynslam_bench.geometry import se3
from dynslam_bench.geometry.camera import Camera

from .frame_to_frame import Aligner, FrameToFrame
from .settings import OpenCvOdometrySettings

INSTALL = "pip install 'opencv-python-headless>=5' (or, for OpenCV 4, opencv-contrib-python-headless)"


def unavailable() -> str:
    """How to get an OpenCV with RGB-D odometry; empty if this one has it."""
    return "" if hasattr(cv2, "Odometry") or hasattr(cv2, "rgbd") else f"OpenCV {cv2.__version__} lacks it: {INSTALL}"


class OpenCvOdometry(FrameToFrame[Any]):
    """Dense frame-to-frame odometry of OpenCV with its default pyramid and iterations.

    Raises:
        TrackerError: This OpenCV has none.
    """

    def __init__(self, settings: OpenCvOdometrySettings) -> None:
        super().__init__("opencv-odometry")
        reason = unavailable()
        if reason:
            raise TrackerError("opencv-odometry cannot run", reason)
        self.settings = settings

    def make_aligner(self, camera: Camera) -> Aligner[Any]:
        """That of the OpenCV at hand."""
        return _Odometry5(camera, self.settings) if hasattr(cv2, "Odometry") else _Odometry4(camera, self.settings)


class _Odometry5:
    """`cv2.Odometry`, OpenCV 5; missing depth is NaN there."""

    def __init__(self, camera: Camera, settings: OpenCvOdometrySettings) -> None:
        options = cv2.OdometrySettings()
        options.setCameraMatrix(camera.matrix.astype(np.float32))
        options.setMinDepth(settings.min_depth_m)
        options.setMaxDepth(settings.max_depth_m)
        options.setMaxDepthDiff(settings.max_depth_difference_m)
        kinds = {
            "rgbd": cv2.OdometryType_RGB_DEPTH,
            "icp": cv2.OdometryType_DEPTH,
            "rgb": cv2.OdometryType_RGB,
        }
        # OdometryAlgoType_FAST fails for colour alone in 5.0.0 and was no faster here
        self._odometry = cv2.Odometry(kinds[settings.method], options, cv2.OdometryAlgoType_COMMON)

    def prepare(self, rgb: NDArray[np.uint8], depth: NDArray[np.float32]) -> Any:
        return cv2.OdometryFrame(np.where(depth > 0, depth, np.float32(np.nan)), cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY))

    def align(self, reference: Any, current: Any) -> NDArray[np.float64] | None:
        try:
            self._odometry.prepareFrames(reference, current)
            success, T_current_reference = self._odometry.compute(reference, current)
        except cv2.error:  # too little texture or depth in one of them
            return None
        return _inverted(success, T_current_reference)


class _Odometry4:
    """`cv2.rgbd`, OpenCV 4 contrib."""

    def __init__(self, camera: Camera, settings: OpenCvOdometrySettings) -> None:
        rgbd: Any = getattr(cv2, "rgbd")  # noqa: B009 - only the contrib packages have it
        create = {
            "rgbd": rgbd.RgbdICPOdometry_create,
            "icp": rgbd.ICPOdometry_create,
            "rgb": rgbd.RgbdOdometry_create,
        }
        self._odometry = create[settings.method](
            camera.matrix.astype(np.float32),
            minDepth=settings.min_depth_m,
            maxDepth=settings.max_depth_m,
            maxDepthDiff=settings.max_depth_difference_m,
        )

    def prepare(self, rgb: NDArray[np.uint8], depth: NDArray[np.float32]) -> Any:
        known = depth > 0
        masked = np.where(known, depth, np.float32(np.nan))
        return cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), masked, known.astype(np.uint8) * 255

    def align(self, reference: Any, current: Any) -> NDArray[np.float64] | None:
        try:
            success, T_current_reference = self._odometry.compute(*reference, *current)
        except cv2.error:
            return None
        return _inverted(success, T_current_reference)


def _inverted(success: bool, T_current_reference: Any) -> NDArray[np.float64] | None:
    if not success:
        return None
    pose = np.asarray(T_current_reference, dtype=np.float64)
    return se3.inverse(pose) if se3.is_pose(pose) else None
