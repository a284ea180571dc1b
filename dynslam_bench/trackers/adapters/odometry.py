"""Dense frame-to-frame odometries of OpenCV and Open3D: the chain of relative motions, and the alignments.

OpenCV's is `cv2.Odometry` of OpenCV 5, or `cv2.rgbd` of the contrib packages of OpenCV 4. Open3D's is the multi-scale
odometry of the tensor pipeline, on the CPU.
"""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from copy import copy
from typing import Any, Generic, Protocol, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from dynslam_bench.contracts.sequence import Frame
from dynslam_bench.contracts.tracker import TrackingState, TrackResult
from dynslam_bench.core.errors import TrackerError
from dynslam_bench.geometry import se3
from dynslam_bench.geometry.camera import Camera
from dynslam_bench.trackers.adapters.specs import Open3dOdometrySettings, OpenCvOdometrySettings

LEAST_DEPTH_PIXELS = 1000
"""Pixels with depth that an alignment needs."""
MAX_FAILURES = 5
"""Lost frames in a row after which the chain continues from the newest frame."""
INSTALL = "pip install 'opencv-python-headless>=5' (or, for OpenCV 4, opencv-contrib-python-headless)"

Prepared = TypeVar("Prepared")


class Aligner(Protocol[Prepared]):
    """The alignment of two RGB-D images of one camera."""

    def prepare(self, rgb: NDArray[np.uint8], depth: NDArray[np.float32]) -> Prepared:
        """Prepare an image once: colour uint8 ``[H, W, 3]``, depth float32 ``[H, W]``, metres, 0 = missing."""
        ...

    def align(self, reference: Prepared, current: Prepared) -> NDArray[np.float64] | None:
        """``T_reference_current`` ``[4, 4]``; None if they cannot be aligned."""
        ...


class FrameToFrame(ABC, Generic[Prepared]):
    """Chains the motions from frame to frame; subclasses align two frames.

    A frame that cannot be aligned is lost. The next one is aligned to the last good frame again, at most five times in
    a row; then the chain continues from the newest frame as if the camera had not moved since.
    """

    def __init__(self, name: str) -> None:
        self._name = name
        self._aligner: Aligner[Prepared] | None = None

    def __deepcopy__(self, memo: dict[int, Any]) -> FrameToFrame[Prepared]:
        """A tracker at the same frame; the alignment and the last good frame are shared, since neither changes."""
        return copy(self)

    @abstractmethod
    def make_aligner(self, camera: Camera) -> Aligner[Prepared]:
        """The alignment for images of this (undistorted) camera."""

    def reset(self, camera: Camera, *, rng: np.random.Generator) -> None:
        """Begin a new sequence; nothing here is random."""
        self._aligner = self.make_aligner(camera.undistorted())
        self._maps = undistortion_maps(camera)
        self._reference: Prepared | None = None
        self._pose: NDArray[np.float64] = np.eye(4)
        self._failures = 0

    def track(self, frame: Frame) -> TrackResult:
        """``initialising`` until a frame has depth, then ``ok``, or ``lost`` where it cannot be aligned.

        Raises:
            TrackerError: `reset` was not called.
        """
        if self._aligner is None:
            raise TrackerError(f"{self._name} was given a frame before reset()")
        start = time.perf_counter()
        rgb, depth = self._undistort(frame)
        valid = np.count_nonzero(depth > 0)
        state: TrackingState = "lost"
        if valid < LEAST_DEPTH_PIXELS:
            state = "initialising" if self._reference is None else "lost"
        elif self._align(self._aligner, self._aligner.prepare(rgb, depth)):
            state = "ok"
        pose = self._pose.copy() if state == "ok" else None
        timings = {"tracking": time.perf_counter() - start}
        return TrackResult(pose, state, {"depth_fraction": valid / depth.size}, timings)

    def _align(self, aligner: Aligner[Prepared], current: Prepared) -> bool:
        """Extend the chain by a frame; False if it cannot be aligned."""
        motion = np.eye(4) if self._reference is None else aligner.align(self._reference, current)
        aligned = motion is not None and se3.is_pose(motion)
        if motion is not None and aligned:
            self._pose = self._pose @ motion
        self._failures = 0 if aligned else self._failures + 1
        if aligned or self._failures >= MAX_FAILURES:
            self._reference = current
        return aligned

    def _undistort(self, frame: Frame) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
        depth = np.nan_to_num(frame.depth, nan=0.0, posinf=0.0, neginf=0.0)
        if self._maps is None:
            return frame.rgb, depth
        rgb = np.asarray(cv2.remap(frame.rgb, *self._maps, cv2.INTER_LINEAR), dtype=np.uint8)
        return rgb, np.asarray(cv2.remap(depth, *self._maps, cv2.INTER_NEAREST), dtype=np.float32)


def undistortion_maps(camera: Camera) -> tuple[NDArray[np.float32], NDArray[np.float32]] | None:
    """Column and row ``[H, W]`` in the distorted image of each undistorted pixel; None without distortion."""
    if not camera.is_distorted:
        return None
    distortion, turn, size = np.asarray(camera.distortion), np.eye(3), (camera.width, camera.height)
    columns, rows = cv2.initUndistortRectifyMap(camera.matrix, distortion, turn, camera.matrix, size, cv2.CV_32FC1)
    return np.asarray(columns, dtype=np.float32), np.asarray(rows, dtype=np.float32)


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
        return (_Odometry5 if hasattr(cv2, "Odometry") else _Odometry4)(camera, self.settings)


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
        valid = depth > 0
        masked = np.where(valid, depth, np.float32(np.nan))
        return cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), masked, valid.astype(np.uint8) * 255

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


class Open3dOdometry(FrameToFrame[Any]):
    """Dense frame-to-frame odometry of Open3D."""

    def __init__(self, settings: Open3dOdometrySettings) -> None:
        super().__init__("open3d-odometry")
        self.settings = settings

    def make_aligner(self, camera: Camera) -> Aligner[Any]:
        """Open3D's multi-scale alignment."""
        return _MultiScale(camera, self.settings)


class _MultiScale:
    def __init__(self, camera: Camera, settings: Open3dOdometrySettings) -> None:
        import open3d as o3d

        self._o3d = o3d
        self._pipeline = o3d.t.pipelines.odometry
        methods = {
            "hybrid": self._pipeline.Method.Hybrid,
            "intensity": self._pipeline.Method.Intensity,
            "point-to-plane": self._pipeline.Method.PointToPlane,
        }
        self._method = methods[settings.method]
        self._max_depth = settings.max_depth_m
        self._parameters = self._pipeline.OdometryLossParams(depth_outlier_trunc=settings.max_depth_difference_m)
        counts = (settings.iterations_coarse, settings.iterations_middle, settings.iterations_fine)
        self._criteria = [self._pipeline.OdometryConvergenceCriteria(count) for count in counts]
        self._intrinsics = o3d.core.Tensor(camera.matrix, o3d.core.Dtype.Float64)
        self._still = o3d.core.Tensor(np.eye(4), o3d.core.Dtype.Float64)

    def prepare(self, rgb: NDArray[np.uint8], depth: NDArray[np.float32]) -> Any:
        colour = self._o3d.t.geometry.Image(self._o3d.core.Tensor(np.ascontiguousarray(rgb)))
        return self._o3d.t.geometry.RGBDImage(
            colour, self._o3d.t.geometry.Image(self._o3d.core.Tensor(np.ascontiguousarray(depth)))
        )

    def align(self, reference: Any, current: Any) -> NDArray[np.float64] | None:
        try:
            with self._o3d.utility.VerbosityContextManager(self._o3d.utility.VerbosityLevel.Error):
                scales = (self._criteria, self._method, self._parameters)
                result = self._pipeline.rgbd_odometry_multi_scale(
                    current, reference, self._intrinsics, self._still, 1.0, self._max_depth, *scales
                )
        except RuntimeError:  # singular: too little texture or depth
            return None
        return np.asarray(result.transformation.numpy(), dtype=np.float64) if result.fitness > 0 else None
