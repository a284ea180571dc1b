"""Dense frame-to-frame odometries of OpenCV and Open3D: the chain of relative motions, and the alignments.

OpenCV's is `cv2.Odometry` of OpenCV 5, or `cv2.rgbd` of the contrib packages of OpenCV 4. Open3D's
is the multi-scale odometry of the tensor pipeline, on the CPU.
"""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from copy import copy
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from dynslam_bench.contracts import Frame, TrackingState, TrackResult
from dynslam_bench.geometry import Camera, se3
from dynslam_bench.trackers.adapters.specs import Open3dOdometrySettings, OpenCvOdometrySettings

LEAST_DEPTH_PIXELS = 1000
"""Pixels with depth that an alignment needs."""
MAX_FAILURES = 5
"""Lost frames in a row after which the chain continues from the newest frame."""
INSTALL = (
    "pip install 'opencv-python-headless>=5' (or, for OpenCV 4, opencv-contrib-python-headless)"
)
"""Advice on getting an OpenCV with RGB-D odometry."""


class FrameToFrame(ABC):
    """Chains the motions from frame to frame; subclasses align two RGB-D images of one camera.

    A frame that cannot be aligned is lost. The next one is aligned to the last good frame again, at
    most five times in a row; then the chain continues from the newest frame as if the camera had
    not moved since.
    """

    def __deepcopy__(self, memo: dict[int, Any]) -> FrameToFrame:
        """A tracker at the same frame; the alignment and the last good frame are shared, since neither changes."""
        return copy(self)

    @abstractmethod
    def start(self, camera: Camera) -> None:
        """Set up the alignment for images of this (undistorted) camera."""

    @abstractmethod
    def prepare(self, rgb: NDArray[np.uint8], depth: NDArray[np.float32]) -> Any:
        """Prepare an image once: colour uint8 ``[H, W, 3]``, depth float32 ``[H, W]``, metres, 0 = missing."""

    @abstractmethod
    def align(self, reference: Any, current: Any) -> NDArray[np.float64] | None:
        """``T_reference_current`` ``[4, 4]`` of two prepared images; None if they cannot be aligned."""

    def reset(self, camera: Camera, *, rng: np.random.Generator) -> None:
        """Begin a new sequence; nothing here is random."""
        self.start(camera.undistorted())
        self._maps = camera.undistortion_maps() if camera.is_distorted else None
        self._reference: Any = None
        self._pose: NDArray[np.float64] = np.eye(4)
        self._failures = 0

    def track(self, frame: Frame) -> TrackResult:
        """``initialising`` until a frame has depth, then ``ok``, or ``lost`` where it cannot be aligned."""
        start = time.perf_counter()
        rgb = frame.rgb
        depth = np.nan_to_num(frame.depth, nan=0.0, posinf=0.0, neginf=0.0)

        # undistort; depth keeps its values
        if self._maps is not None:
            rgb = np.asarray(cv2.remap(rgb, *self._maps, cv2.INTER_LINEAR), dtype=np.uint8)
            depth = np.asarray(cv2.remap(depth, *self._maps, cv2.INTER_NEAREST), dtype=np.float32)

        # align to the last good frame
        valid = np.count_nonzero(depth > 0)
        state: TrackingState = "initialising" if self._reference is None else "lost"
        if valid >= LEAST_DEPTH_PIXELS:
            state = "ok" if self._extend(self.prepare(rgb, depth)) else "lost"
        pose = self._pose.copy() if state == "ok" else None
        timings = {"tracking": time.perf_counter() - start}
        return TrackResult(pose, state, {"depth_fraction": valid / depth.size}, timings)

    def _extend(self, current: Any) -> bool:
        """Extend the chain by a frame; False if it cannot be aligned."""
        motion = np.eye(4) if self._reference is None else self.align(self._reference, current)
        aligned = motion is not None and se3.is_pose(motion)
        if motion is not None and aligned:
            self._pose = self._pose @ motion
        self._failures = 0 if aligned else self._failures + 1
        if aligned or self._failures >= MAX_FAILURES:
            self._reference = current
        return aligned


def unavailable() -> str:
    """Advice on getting an OpenCV with RGB-D odometry; empty if this one has it."""
    if hasattr(cv2, "Odometry") or hasattr(cv2, "rgbd"):
        return ""
    return f"OpenCV {cv2.__version__} lacks it: {INSTALL}"


class OpenCvOdometry(FrameToFrame):
    """Dense frame-to-frame odometry of OpenCV with its default pyramid and iterations; see `unavailable`."""

    def __init__(self, settings: OpenCvOdometrySettings) -> None:
        self.settings = settings

    def start(self, camera: Camera) -> None:
        """Set up that of the OpenCV at hand."""
        settings = self.settings
        matrix = camera.matrix.astype(np.float32)
        if hasattr(cv2, "Odometry"):
            options = cv2.OdometrySettings()
            options.setCameraMatrix(matrix)
            options.setMinDepth(settings.min_depth_m)
            options.setMaxDepth(settings.max_depth_m)
            options.setMaxDepthDiff(settings.max_depth_difference_m)
            kinds = {
                "rgbd": cv2.OdometryType_RGB_DEPTH,
                "icp": cv2.OdometryType_DEPTH,
                "rgb": cv2.OdometryType_RGB,
            }
            # OdometryAlgoType_FAST fails for colour alone in 5.0.0 and was no faster here
            self._odometry: Any = cv2.Odometry(
                kinds[settings.method], options, cv2.OdometryAlgoType_COMMON
            )
        else:
            rgbd: Any = getattr(cv2, "rgbd")  # noqa: B009 - only the contrib packages of OpenCV 4 have it
            names = {
                "rgbd": "RgbdICPOdometry_create",
                "icp": "ICPOdometry_create",
                "rgb": "RgbdOdometry_create",
            }
            self._odometry = getattr(rgbd, names[settings.method])(
                matrix,
                minDepth=settings.min_depth_m,
                maxDepth=settings.max_depth_m,
                maxDepthDiff=settings.max_depth_difference_m,
            )

    def prepare(self, rgb: NDArray[np.uint8], depth: NDArray[np.float32]) -> Any:
        """OpenCV 5's frame, or the arguments of OpenCV 4: intensities, depth (missing is NaN) and its mask."""
        grey = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)
        measured = np.where(depth > 0, depth, np.float32(np.nan))
        if hasattr(cv2, "Odometry"):
            return cv2.OdometryFrame(measured, grey)
        return grey, measured, (depth > 0).astype(np.uint8) * 255

    def align(self, reference: Any, current: Any) -> NDArray[np.float64] | None:
        """The motion that OpenCV finds."""
        try:
            if hasattr(cv2, "Odometry"):
                self._odometry.prepareFrames(reference, current)
                success, T_current_reference = self._odometry.compute(reference, current)
            else:
                success, T_current_reference = self._odometry.compute(*reference, *current)
        except cv2.error:
            # too little texture or depth in one of them
            return None
        pose = np.asarray(T_current_reference, dtype=np.float64)
        return se3.inverse(pose) if success and se3.is_pose(pose) else None


class Open3dOdometry(FrameToFrame):
    """Dense frame-to-frame odometry of Open3D."""

    def __init__(self, settings: Open3dOdometrySettings) -> None:
        self.settings = settings

    def start(self, camera: Camera) -> None:
        """Set up Open3D's multi-scale alignment."""
        import open3d as o3d

        settings = self.settings
        odometry = o3d.t.pipelines.odometry
        self._o3d = o3d
        method = {
            "hybrid": odometry.Method.Hybrid,
            "intensity": odometry.Method.Intensity,
            "point-to-plane": odometry.Method.PointToPlane,
        }[settings.method]
        counts = (settings.iterations_coarse, settings.iterations_middle, settings.iterations_fine)
        self._arguments = (
            o3d.core.Tensor(camera.matrix, o3d.core.Dtype.Float64),
            o3d.core.Tensor(np.eye(4), o3d.core.Dtype.Float64),
            1.0,
            settings.max_depth_m,
            [odometry.OdometryConvergenceCriteria(count) for count in counts],
            method,
            odometry.OdometryLossParams(depth_outlier_trunc=settings.max_depth_difference_m),
        )

    def prepare(self, rgb: NDArray[np.uint8], depth: NDArray[np.float32]) -> Any:
        """Open3D's image with depth."""
        tensors = [self._o3d.core.Tensor(np.ascontiguousarray(image)) for image in (rgb, depth)]
        return self._o3d.t.geometry.RGBDImage(*map(self._o3d.t.geometry.Image, tensors))

    def align(self, reference: Any, current: Any) -> NDArray[np.float64] | None:
        """The motion that Open3D finds."""
        try:
            with self._o3d.utility.VerbosityContextManager(self._o3d.utility.VerbosityLevel.Error):
                result = self._o3d.t.pipelines.odometry.rgbd_odometry_multi_scale(
                    current, reference, *self._arguments
                )
        except RuntimeError:
            # singular: too little texture or depth
            return None
        return (
            np.asarray(result.transformation.numpy(), dtype=np.float64)
            if result.fitness > 0
            else None
        )
