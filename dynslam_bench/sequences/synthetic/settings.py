"""Ids and settings of the rendered sequences; light: imports neither numba nor OpenCV."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Literal

from pydantic import Field

from dynslam_bench.core.errors import SequenceError, did_you_mean
from dynslam_bench.core.settings import Settings
from dynslam_bench.geometry.camera import Camera

RENDERER_VERSION = 5
"""Raised whenever any pixel, pose or mask of any sequence changes; part of every digest and cache folder."""

CAMERA = Camera(width=640, height=480, fx=535.4, fy=539.2, cx=320.1, cy=247.6, depth_factor=5000.0)
"""The camera of TUM's fr3 sequences."""

FPS = 30.0
DEFAULT_FRAMES = 600
MAX_FRAMES = 36_000
TUNE_INSTANCES = range(0, 100)
HELD_OUT_INSTANCES = range(100, 200)

PEOPLE = ("walking", "sitting")
MOTIONS = ("xyz", "static", "halfsphere", "rpy")
SYNTHETIC_IDS = tuple(f"synthetic/{people}_{motion}" for people in PEOPLE for motion in MOTIONS)
"""The eight rendered twins of TUM's fr3 dynamic sequences, instance 0, 600 frames."""

_OPTIONS = {"frames": (1, MAX_FRAMES), "noise": (0, 999_999_999)}
"""What may stand behind the question mark, with the least and the largest value."""
_ID = re.compile(r"synthetic/(?P<name>[^@?]*)(?:@(?P<instance>[^?]*))?(?:\?(?P<query>.*))?", re.DOTALL)


@dataclass(frozen=True)
class SyntheticId:
    """A parsed id ``synthetic/<people>_<motion>[@instance][?frames=N][&noise=SEED]``.

    Attributes:
        people: ``walking`` or ``sitting``.
        motion: The camera's motion: ``xyz``, ``static``, ``halfsphere`` or ``rpy``.
        instance: Selects room, textures, clothes and paths: 0-99 for tuning and training, 100-199 held out.
        frames: Length of the sequence; frames are the same whatever the length.
        noise: Seed of the sensors' noise: another draw of the same scene. None is the instance's own draw.
    """

    people: Literal["walking", "sitting"]
    motion: Literal["xyz", "static", "halfsphere", "rpy"]
    instance: int = 0
    frames: int = DEFAULT_FRAMES
    noise: int | None = None

    @property
    def name(self) -> str:
        """For example ``walking_xyz``."""
        return f"{self.people}_{self.motion}"

    @property
    def split(self) -> Literal["tune", "held-out"]:
        """Which split the instance belongs to."""
        return "held-out" if self.instance in HELD_OUT_INSTANCES else "tune"

    @property
    def whole(self) -> str:
        """The id without its length: what is seen, however much of it."""
        noise = "" if self.noise is None else f"?noise={self.noise}"
        return f"synthetic/{self.name}@{self.instance}{noise}"

    def __str__(self) -> str:
        noise = "" if self.noise is None else f"&noise={self.noise}"
        return f"synthetic/{self.name}@{self.instance}?frames={self.frames}{noise}"


def parse_synthetic_id(text: str) -> SyntheticId:
    """Parse an id such as ``synthetic/walking_xyz@101?frames=150`` or ``synthetic/walking_xyz?frames=150&noise=3``.

    Raises:
        SequenceError: Unknown name (with a did-you-mean), or an instance, length or noise seed out of range.
    """
    match = _ID.fullmatch(text)
    if match is None:
        raise SequenceError(f"'{text}' is not the id of a rendered sequence", did_you_mean(text, SYNTHETIC_IDS))
    name = f"synthetic/{match['name']}"
    if name not in SYNTHETIC_IDS:
        raise SequenceError(f"unknown rendered sequence '{name}'", did_you_mean(name, SYNTHETIC_IDS))
    instance = 0
    if match["instance"] is not None:
        instance = _integer(match["instance"], "instance", text, 0, HELD_OUT_INSTANCES.stop - 1)
    options = {"frames": DEFAULT_FRAMES, "noise": None} | _options(match["query"], text)
    people, _, motion = match["name"].partition("_")
    return SyntheticId(people, motion, instance, **options)  # type: ignore[arg-type]  # checked against SYNTHETIC_IDS


def _options(query: str | None, text: str) -> dict[str, int]:
    """The options behind the question mark, each at most once."""
    found: dict[str, int] = {}
    for option in [] if query is None else query.split("&"):
        key, separator, value = option.partition("=")
        if key not in _OPTIONS or not separator:
            forms = "write ?frames=N, ?noise=SEED or both, as ?frames=N&noise=SEED"
            raise SequenceError(f"'{text}' has an unknown option '{option}'", forms)
        if key in found:
            raise SequenceError(f"'{text}' names {key} twice", "leave one out")
        found[key] = _integer(value, key, text, *_OPTIONS[key])
    return found


def _integer(value: str, what: str, text: str, low: int, high: int) -> int:
    if not re.fullmatch(r"[0-9]{1,9}", value) or not low <= int(value) <= high:
        raise SequenceError(f"{what} '{value}' of '{text}' is not a whole number from {low} to {high}")
    return int(value)


class DepthSensor(Settings):
    """The structured-light depth camera."""

    noise: bool = Field(True, description="False gives the exact depth, only rounded to the file's units")
    disparity_noise_px: float = Field(0.045, ge=0, le=2, description="standard deviation of the disparity in pixels")
    near_m: float = Field(0.5, ge=0.05, le=2, description="nothing nearer is measured")
    far_m: float = Field(5.0, ge=1, le=12, description="nothing further is measured; it fades out from 80 % of this")
    edge_px: int = Field(2, ge=0, le=8, description="half the window in which a depth edge spoils the correlation")
    dark: float = Field(0.018, ge=0, le=1, description="least albedo x cosine / z^2 that still gives a measurement")


class ColorSensor(Settings):
    """The colour camera."""

    noise: bool = Field(True, description="False leaves out read and shot noise")
    read_noise: float = Field(1.2, ge=0, le=20, description="standard deviation at black, grey levels")
    shot_noise: float = Field(0.02, ge=0, le=1, description="variance a grey level of signal")
    shutter: float = Field(0.35, ge=0, le=1, description="share of the frame interval during which the shutter is open")
    exposure_drift: float = Field(0.04, ge=0, le=0.5, description="slow drift of the automatic exposure, relative")
    flicker: float = Field(0.015, ge=0, le=0.3, description="mains flicker rolling down the rows, relative")


class RenderSettings(Settings):
    """Everything that changes the pixels of a rendered sequence beside its id."""

    people: Literal["moving", "frozen", "none"] = Field(
        "moving", description="controls: people and chairs frozen at their first pose, or nobody in the room"
    )
    depth: DepthSensor = DepthSensor()
    color: ColorSensor = ColorSensor()
    antialias: bool = Field(True, description="four samples a pixel on edges")
    lighting_change: bool = Field(False, description="the room lights dim and brighten, and one lamp switches")
    glare: bool = Field(False, description="a bright veil from a window drifts over part of the image")
    shadow: bool = Field(False, description="a soft shadow sweeps through the room")
