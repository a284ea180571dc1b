"""Odometry for cameras that slide sideways: phase correlation of grey images, scaled by the scene's depth."""

import cv2
import numpy as np

from dynslam_bench.contracts import Camera, Frame, TrackResult

from . import ShiftSettings


class ShiftOdometry:
    """Takes the whole image's shift since the last frame for a translation of the camera."""

    def __init__(self, settings: ShiftSettings) -> None:
        self.settings = settings

    def reset(self, camera: Camera, *, rng: np.random.Generator) -> None:
        """A new sequence begins; nothing here is random."""
        self.camera = camera
        self.last: np.ndarray | None = None
        self.T_world_cam = np.eye(4)

    def track(self, frame: Frame) -> TrackResult:
        """The camera-to-world pose of one frame."""
        gray = cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2GRAY).astype(np.float32)
        response = 1.0
        if self.last is not None:
            # the shift of the whole image in pixels; a window hides its edges
            window = cv2.createHanningWindow(gray.shape[::-1], 5)
            (right, down), response = cv2.phaseCorrelate(self.last, gray, window)
            measured = frame.depth[frame.depth > 0]
            if response < self.settings.min_response or not measured.size:
                return TrackResult(None, "lost", {"response": float(response)})

            # at the median depth that shift is a translation in metres, against the image's
            depth = float(np.median(measured))
            shift = np.array([right / self.camera.fx, down / self.camera.fy])
            self.T_world_cam[:2, 3] -= depth * shift
        self.last = gray
        return TrackResult(self.T_world_cam.copy(), "ok", {"response": float(response)})
