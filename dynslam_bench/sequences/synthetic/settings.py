"""Settings of the rendered sequences; light: imports neither numba nor OpenCV."""

from typing import Literal

from pydantic import Field

from dynslam_bench.core.settings import Settings
from dynslam_bench.geometry import Camera

RENDERER_VERSION = 6
"""Raised whenever any pixel, pose or mask of any sequence changes; part of every digest and cache folder."""

CAMERA = Camera(width=640, height=480, fx=535.4, fy=539.2, cx=320.1, cy=247.6, depth_factor=5000.0)
"""The camera of TUM's fr3 sequences."""

FPS = 30.0
"""Frames a second of all rendered sequences."""
DEFAULT_FRAMES = 600
"""Frames of a sequence whose id does not say how many: 20 s."""
MAX_FRAMES = 36_000
"""Longest sequence: 20 minutes."""
TUNE_SCENES = range(0, 100)
"""Scenes to tune on."""
HELD_OUT_SCENES = range(100, 200)
"""Scenes that are kept for the final comparison; so are all scenes above them, which no list names."""


class DepthSensor(Settings):
    """The structured-light depth camera."""

    noise: bool = Field(
        True, description="False gives the exact depth, only rounded to the file's units"
    )
    disparity_noise_px: float = Field(
        0.045, ge=0, le=2, description="standard deviation of the disparity in pixels"
    )
    near_m: float = Field(0.5, ge=0.05, le=2, description="nothing nearer is measured")
    far_m: float = Field(
        5.0, ge=1, le=12, description="nothing further is measured; it fades out from 80 % of this"
    )
    edge_px: int = Field(
        2, ge=0, le=8, description="half the window in which a depth edge spoils the correlation"
    )
    dark: float = Field(
        0.018, ge=0, le=1, description="least albedo x cosine / z^2 that still gives a measurement"
    )


class ColorSensor(Settings):
    """The colour camera."""

    noise: bool = Field(True, description="False leaves out read and shot noise")
    read_noise: float = Field(
        1.2, ge=0, le=20, description="standard deviation at black, grey levels"
    )
    shot_noise: float = Field(0.02, ge=0, le=1, description="variance a grey level of signal")
    shutter: float = Field(
        0.35, ge=0, le=1, description="share of the frame interval during which the shutter is open"
    )
    exposure_drift: float = Field(
        0.04, ge=0, le=0.5, description="slow drift of the automatic exposure, relative"
    )
    flicker: float = Field(
        0.015, ge=0, le=0.3, description="mains flicker rolling down the rows, relative"
    )


class RenderSettings(Settings):
    """Everything that changes the pixels of a rendered sequence beside its id."""

    people: Literal["moving", "frozen", "none"] = Field(
        "moving",
        description="controls: people and chairs frozen at their first pose, or nobody in the room",
    )
    depth: DepthSensor = DepthSensor()
    color: ColorSensor = ColorSensor()
    antialias: bool = Field(True, description="four samples a pixel on edges")
    lighting_change: bool = Field(
        False, description="the room lights dim and brighten, and one lamp switches"
    )
    glare: bool = Field(
        False, description="a bright veil from a window drifts over part of the image"
    )
    shadow: bool = Field(False, description="a soft shadow sweeps through the room")
