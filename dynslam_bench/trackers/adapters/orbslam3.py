"""The real ORB-SLAM3, through the PyPI package pyorbslam3, in a process of its own."""

from __future__ import annotations

import math
import os
import sys
from pathlib import Path
from typing import Any

import numpy as np

import dynslam_bench
from dynslam_bench.contracts.tracker import TrackerContext
from dynslam_bench.core.errors import TrackerError
from dynslam_bench.geometry.camera import Camera

from .settings import OrbSlam3Settings
from .subprocess_tracker import FinalizingProgramTracker, ProgramTracker
from .vocabulary import find_vocabulary

WORKER = "dynslam_bench.trackers.adapters.orbslam3_worker"
BORDER_PX = 16  # ORB-SLAM3 looks for no corners so near to the edge of a pyramid level
_VIEWER = (
    ("KeyFrameSize", 0.05), ("KeyFrameLineWidth", 1.0), ("GraphLineWidth", 0.9), ("PointSize", 2.0),
    ("CameraSize", 0.08), ("CameraLineWidth", 3.0), ("ViewpointX", 0.0), ("ViewpointY", -0.7), ("ViewpointZ", -1.8),
    ("ViewpointF", 500.0),
)  # fmt: skip


class OrbSlam3Program(ProgramTracker):
    """ORB-SLAM3, untouched: its own threads, loop closing and relocalisation included.

    It runs in a child process: ORB-SLAM3 ends its process on bad input, writes to standard output and cannot be
    stopped otherwise.

    Args:
        settings: What goes into its settings file, the vocabulary, and time limits.
        context: Where it runs. ORB-SLAM3 starts three threads of its own whatever `threads` says.

    Raises:
        TrackerError: The vocabulary is missing or damaged.
    """

    sensor: str
    """How ORB-SLAM3 calls what it is given."""

    def __init__(self, settings: OrbSlam3Settings, context: TrackerContext) -> None:
        self.settings = settings
        self._vocabulary = find_vocabulary(settings.vocabulary)
        packages = [str(Path(dynslam_bench.__file__).resolve().parents[1]), os.environ.get("PYTHONPATH", "")]
        super().__init__(
            "orbslam3",
            settings,
            context,
            [sys.executable, "-m", WORKER],
            environment={"PYTHONPATH": os.pathsep.join(filter(None, packages))},
        )

    def reset(self, camera: Camera, *, rng: np.random.Generator) -> None:
        """Write its settings file from the camera, start it and load the vocabulary.

        Raises:
            TrackerError: ORB-SLAM3 cannot take the camera, or does not start; names what it said last.
        """
        check_camera(camera, self.settings)
        super().reset(camera, rng=rng)

    def options(self, camera: Camera, folder: Path) -> dict[str, Any]:
        """Paths of the vocabulary and of the settings file, which is written here."""
        path = folder / "settings.yaml"
        path.write_text(settings_yaml(camera, self.settings, self.context.fps))
        return {"vocabulary": str(self._vocabulary), "settings_file": str(path), "sensor": self.sensor}


class OrbSlam3(OrbSlam3Program, FinalizingProgramTracker):
    """In RGB-D mode: online what it answers at each frame, final what it saves at the end."""

    sensor = "RGBD"


class OrbSlam3Monocular(OrbSlam3Program):
    """In monocular mode, which saves no poses of frames at the end; depth is not handed to it."""

    sensor = "MONOCULAR"


def check_camera(camera: Camera, settings: OrbSlam3Settings) -> None:
    """Refuse what would make ORB-SLAM3 crash or track nonsense.

    Raises:
        TrackerError: Another camera model, intrinsics that are none, or an image too small for the pyramid.
    """
    if type(camera) is not Camera:
        raise TrackerError(
            f"orbslam3 cannot take a {type(camera).__name__}",
            "its RGB-D mode knows the pinhole camera with radial-tangential distortion only; undistort the images",
        )
    values = (camera.fx, camera.fy, camera.cx, camera.cy, camera.baseline_m, *camera.distortion)
    if not all(math.isfinite(value) for value in values) or min(camera.fx, camera.fy, camera.baseline_m) <= 0:
        raise TrackerError(
            f"orbslam3 cannot take the camera fx={camera.fx:g} fy={camera.fy:g} cx={camera.cx:g} cy={camera.cy:g} "
            f"baseline={camera.baseline_m:g} m distortion={camera.distortion}",
            "focal lengths and baseline must be positive, all values finite",
        )
    if len(camera.distortion) != 5:
        raise TrackerError(
            f"orbslam3 cannot take {len(camera.distortion)} distortion coefficients", "it knows k1 k2 p1 p2 k3"
        )
    shrunk = settings.scale_factor ** (settings.levels - 1)
    columns, rows = (round(side / shrunk) - 2 * BORDER_PX for side in (camera.width, camera.height))
    size = (
        f"images of {camera.width}x{camera.height} with {settings.levels} pyramid levels of {settings.scale_factor:g}"
    )
    if min(columns, rows) < 1:
        raise TrackerError(
            f"orbslam3 cannot take {size}: the smallest level has no pixel inside its border of {BORDER_PX}",
            f"each side needs {math.ceil((2 * BORDER_PX + 0.5) * shrunk)} pixels; resize the sequence or lower levels",
        )
    if columns / rows < 0.5:
        raise TrackerError(
            f"orbslam3 cannot take {size}: the smallest level is {rows / columns:.2f} times as high as wide",
            "it crashes above 2; turn the images, or lower levels",
        )


def settings_yaml(camera: Camera, settings: OrbSlam3Settings, fps: float) -> str:
    """ORB-SLAM3's settings file (format 1.0) for images of this camera; depth comes in metres already."""
    k1, k2, p1, p2, k3 = camera.distortion
    numbers = {
        "Camera1.fx": camera.fx, "Camera1.fy": camera.fy, "Camera1.cx": camera.cx, "Camera1.cy": camera.cy,
        "Camera1.k1": k1, "Camera1.k2": k2, "Camera1.p1": p1, "Camera1.p2": p2, "Camera1.k3": k3,
        "Stereo.b": camera.baseline_m, "Stereo.ThDepth": settings.close_depth_baselines, "RGBD.DepthMapFactor": 1.0,
        "ORBextractor.scaleFactor": settings.scale_factor,
        **{f"Viewer.{key}": value for key, value in _VIEWER},
    }  # fmt: skip
    integers = {
        "Camera.width": camera.width, "Camera.height": camera.height, "Camera.fps": max(1, round(fps)), "Camera.RGB": 1,
        "ORBextractor.nFeatures": settings.features, "ORBextractor.nLevels": settings.levels,
        "ORBextractor.iniThFAST": settings.fast_threshold, "ORBextractor.minThFAST": settings.min_fast_threshold,
    }  # fmt: skip
    lines = ["%YAML:1.0", "---", 'File.version: "1.0"', 'Camera.type: "PinHole"']
    lines += [f"{key}: {_real(float(value))}" for key, value in numbers.items()]
    lines += [f"{key}: {int(value)}" for key, value in integers.items()]
    return "\n".join(lines) + "\n"


def _real(value: float) -> str:
    """A number that OpenCV's parser takes for a real one: always with a point, as ``1.0`` or ``1.0e-07``."""
    text = repr(value)
    mantissa, exponent, power = text.partition("e")
    return (mantissa if "." in mantissa else f"{mantissa}.0") + exponent + power
