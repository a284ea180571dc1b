"""Open3D's dense multi-scale RGB-D odometry (the tensor pipeline, on the CPU)."""

from __future__ import annotations

from typing import Any

import numpy as np
import open3d as o3d
from numpy.typing import NDArray

from dynslam_bench.geometry.camera import Camera
from dynslam_bench.trackers.adapters.odometry import Aligner, FrameToFrame
from dynslam_bench.trackers.adapters.specs import Open3dOdometrySettings


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
        colour = o3d.t.geometry.Image(o3d.core.Tensor(np.ascontiguousarray(rgb)))
        return o3d.t.geometry.RGBDImage(colour, o3d.t.geometry.Image(o3d.core.Tensor(np.ascontiguousarray(depth))))

    def align(self, reference: Any, current: Any) -> NDArray[np.float64] | None:
        try:
            with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
                scales = (self._criteria, self._method, self._parameters)
                result = self._pipeline.rgbd_odometry_multi_scale(
                    current, reference, self._intrinsics, self._still, 1.0, self._max_depth, *scales
                )
        except RuntimeError:  # singular: too little texture or depth
            return None
        return np.asarray(result.transformation.numpy(), dtype=np.float64) if result.fitness > 0 else None
