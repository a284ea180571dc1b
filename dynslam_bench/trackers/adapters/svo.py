"""The real SVO (PyPI package svo-cpp) in a process of its own, which isolates its crashes, threads and output."""

import ctypes
import time
from importlib import import_module
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from dynslam_bench.contracts import TrackerContext
from dynslam_bench.core.plugins import module_command
from dynslam_bench.geometry import Camera, se3
from dynslam_bench.trackers.adapters.serve import serve
from dynslam_bench.trackers.adapters.specs import SvoSettings
from dynslam_bench.trackers.adapters.subprocess_tracker import ProgramTracker

STATES = {"DEFAULT_FRAME": "ok", "RELOCALIZING": "lost"}
"""Tracking states by SVO's stages; any other is ``initialising``."""
_VALUE = object.__basicsize__
"""Offset at which an object of pybind11 keeps the address of its value: behind Python's own fields."""


class Svo(ProgramTracker):
    """SVO, untouched; it gets no depth.

    Args:
        settings: Its settings and time limits.
        context: Where it runs. SVO starts a thread of its own whatever `threads` says.
    """

    def __init__(self, settings: SvoSettings, context: TrackerContext) -> None:
        self._settings = settings
        super().__init__("svo", settings, context, module_command(__name__))

    def options(self, camera: Camera, folder: Path) -> dict[str, Any]:
        """The settings under SVO's names."""
        return {
            "max_fts": self._settings.features,
            "init_min_disparity": self._settings.init_disparity_px,
            "quality_max_drop_fts": self._settings.max_lost_features,
        }


class Worker:
    """In the process of its own: one SVO system; stages and poses as its bindings give them."""

    def reset(self, request: dict[str, Any]) -> None:
        """Begin with an empty map."""
        try:
            self._svo = import_module("svo_cpp")
        except ImportError as error:
            raise RuntimeError(f"svo_cpp cannot be imported: {error}") from error
        stated = request["camera"]
        names = ("width", "height", "fx", "fy", "cx", "cy", "distortion")
        camera = Camera(**{name: stated[name] for name in names})
        self._maps = camera.undistortion_maps() if camera.is_distorted else None
        self._svo.set_svo_config(request["options"])
        self._system = self._svo.SVO(
            self._svo.PinholeCamera(*(float(stated[name]) for name in names[:6]))
        )
        self._system.start()

    def track(
        self, index: int, timestamp: float, rgb: NDArray[np.uint8], depth: NDArray[np.float32]
    ) -> dict[str, Any]:
        """One frame, without its depth; SVO has no model of distortion, so the image is undistorted first."""
        start = time.perf_counter()
        grey = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)
        if self._maps is not None:
            grey = cv2.remap(grey, *self._maps, cv2.INTER_LINEAR)
        self._system.addImage(np.ascontiguousarray(grey), timestamp)
        state = STATES.get(self._system.stage().name, "initialising")
        pose = None if state != "ok" else pose_of(self._system.lastFrame().T_f_w)
        matches = float(self._system.lastNumObservations())
        return {
            "state": state,
            "T_world_cam": None if pose is None else pose.tolist(),
            "stats": {"matches": matches, "inliers": matches},
            "timings": {"tracking": time.perf_counter() - start},
        }


def pose_of(T_cam_world: Any) -> NDArray[np.float64]:
    """``T_world_cam`` ``[4, 4]`` of a transformation of the bindings.

    They cannot hand out its quaternion. It is read where the object keeps it, before the
    translation, and checked against the translations of the transformation and of its inverse,
    which they do hand out.

    Raises:
        RuntimeError: What lies there is not the transformation.
    """
    # where the object keeps it
    address = ctypes.c_void_p.from_address(id(T_cam_world) + _VALUE).value
    values = np.array((ctypes.c_double * 7).from_address(address or 0))
    pose = np.zeros((4, 4))
    if abs(np.linalg.norm(values[:4]) - 1) < 1e-6:
        pose = se3.from_quaternion(values[None, 4:], values[None, :4])[0]

    # check it against what the bindings hand out
    translation = np.ravel(T_cam_world.translation())
    centre = np.ravel(T_cam_world.inverse().translation())
    same_translation = np.array_equal(values[4:], translation)
    if not same_translation or not np.allclose(-pose[:3, :3] @ centre, translation):
        raise RuntimeError(
            "this build of svo-cpp keeps its poses in another way, and cannot hand out rotations"
        )
    return se3.inverse(pose)


if __name__ == "__main__":
    worker = Worker()
    serve(worker.reset, worker.track)
