"""A wrapper that degrades the images before the tracker sees them, to measure robustness."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import cv2
import gymnasium as gym
import numpy as np
from gymnasium.utils import RecordConstructorArgs
from numpy.typing import NDArray

from dynslam_bench.contracts.sequence import Frame
from dynslam_bench.core.errors import SettingsError
from dynslam_bench.core.seeding import stream

from .record_timings import slam_env_of


class DegradeFrames(gym.Wrapper[Any, Any, Any, Any], RecordConstructorArgs):
    """Adds seeded lighting changes, glare, shadow, motion blur and noise to every frame.

    The degradation of a frame depends on the seed, the strengths and the frame's index only, so all trackers see the
    same images. Strength 0 leaves the frame alone, 1 is the worst. Colour is degraded; depth only by `depth_noise`.

    Args:
        env: A `SlamEnv`, wrapped or not.
        lighting: Brightness and colour balance drift slowly and flicker: gain between 1 and ``1 - 0.75 * lighting``.
        glare: A bright blob that wanders over the image and saturates it: up to ``0.45 * glare`` of the image's width.
        shadow: A soft-edged half plane that sweeps over the image and darkens it to ``1 - 0.85 * shadow``.
        blur: Linear motion blur of up to ``25 * blur`` pixels, in a direction that changes from frame to frame.
        noise: Gaussian noise of standard deviation ``40 * noise`` grey levels.
        depth_noise: Depth noise of standard deviation ``0.02 * depth_noise * z^2`` metres (z in metres), and a share
            ``0.3 * depth_noise`` of the pixels loses its depth.
        seed: Seed of the degradation, apart from the tracker's.

    Raises:
        SettingsError: A strength lies outside [0, 1].
    """

    def __init__(
        self,
        env: gym.Env[Any, Any],
        *,
        lighting: float = 0.0,
        glare: float = 0.0,
        shadow: float = 0.0,
        blur: float = 0.0,
        noise: float = 0.0,
        depth_noise: float = 0.0,
        seed: int = 0,
    ) -> None:
        RecordConstructorArgs.__init__(
            self, lighting=lighting, glare=glare, shadow=shadow, blur=blur, noise=noise, depth_noise=depth_noise,
            seed=seed,
        )  # fmt: skip
        gym.Wrapper.__init__(self, env)
        self.degradation = Degradation(lighting, glare, shadow, blur, noise, depth_noise, seed)
        slam_env_of(env, "DegradeFrames").frame_transforms.append(self.degradation)


@dataclasses.dataclass(frozen=True)
class Degradation:
    """Degrades frames; see `DegradeFrames` for the meaning of the strengths in [0, 1]."""

    lighting: float = 0.0
    glare: float = 0.0
    shadow: float = 0.0
    blur: float = 0.0
    noise: float = 0.0
    depth_noise: float = 0.0
    seed: int = 0

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if field.name != "seed" and not 0.0 <= value <= 1.0:
                raise SettingsError(f"degradation '{field.name}' is {value}, expected a strength in [0, 1]")

    def __call__(self, frame: Frame) -> Frame:
        """The degraded copy of a frame."""
        image = frame.rgb.astype(np.float32)
        if self.lighting:
            image *= self._gain(frame.index)
        if self.shadow:
            image *= self._shade(frame.index, *image.shape[:2])[..., None]
        if self.glare:
            image += self._blob(frame.index, *image.shape[:2])[..., None]
        rng = stream(self.seed, "degrade", frame.index)
        if self.blur:
            kernel = _motion_kernel(25.0 * self.blur, rng)
            image = np.asarray(cv2.filter2D(np.clip(image, 0, 255), -1, kernel), dtype=np.float32)
        if self.noise:
            image = image + rng.normal(0.0, 40.0 * self.noise, image.shape).astype(np.float32)
        depth = self._noisy_depth(frame.depth, rng) if self.depth_noise else frame.depth
        rgb = np.clip(np.rint(image), 0, 255).astype(np.uint8)
        return dataclasses.replace(frame, rgb=rgb, depth=depth)

    def _phase(self, name: str, count: int) -> NDArray[np.float64]:
        return stream(self.seed, "degrade", name).uniform(0.0, 2.0 * math.pi, count)

    def _gain(self, index: int) -> NDArray[np.float32]:
        slow, colour, flicker = self._phase("lighting", 3)
        level = 0.5 + 0.4 * math.sin(2 * math.pi * index / 90.0 + slow) + 0.1 * math.sin(1.9 * index + flicker)
        tint = 0.1 * self.lighting * math.sin(2 * math.pi * index / 150.0 + colour)
        gain = 1.0 - 0.75 * self.lighting * level
        return np.array([gain * (1 + tint), gain, gain * (1 - tint)], np.float32)

    def _shade(self, index: int, height: int, width: int) -> NDArray[np.float32]:
        sweep, turn = self._phase("shadow", 2)
        angle = turn + 2 * math.pi * index / 400.0
        offset = 0.35 * math.sin(2 * math.pi * index / 120.0 + sweep) * width
        y, x = np.mgrid[0:height, 0:width].astype(np.float32)
        side = (x - width / 2) * math.cos(angle) + (y - height / 2) * math.sin(angle) - offset
        dark = 1.0 / (1.0 + np.exp(np.clip(-side / (0.02 * width), -30, 30)))
        return np.asarray(1.0 - 0.85 * self.shadow * dark, dtype=np.float32)

    def _blob(self, index: int, height: int, width: int) -> NDArray[np.float32]:
        along, up, pulse = self._phase("glare", 3)
        centre_x = width * (0.5 + 0.4 * math.sin(2 * math.pi * index / 140.0 + along))
        centre_y = height * (0.5 + 0.35 * math.sin(2 * math.pi * index / 100.0 + up))
        radius = 0.45 * self.glare * width * (0.75 + 0.25 * math.sin(2 * math.pi * index / 60.0 + pulse)) / 2
        y, x = np.mgrid[0:height, 0:width].astype(np.float32)
        distance = ((x - centre_x) ** 2 + (y - centre_y) ** 2) / max(radius, 1.0) ** 2
        return np.asarray(510.0 * np.exp(-distance), dtype=np.float32)

    def _noisy_depth(self, depth: NDArray[np.float32], rng: np.random.Generator) -> NDArray[np.float32]:
        noisy = depth + rng.normal(size=depth.shape) * (0.02 * self.depth_noise) * depth.astype(np.float64) ** 2
        lost = (rng.random(depth.shape) < 0.3 * self.depth_noise) | (depth <= 0)
        return np.where(lost, 0.0, np.maximum(noisy, 1e-3)).astype(np.float32)


def _motion_kernel(length: float, rng: np.random.Generator) -> NDArray[np.float32]:
    """A line of up to `length` pixels through the centre, in a random direction, that sums to 1."""
    extent = length * rng.uniform(0.5, 1.0)
    angle = rng.uniform(0.0, math.pi)
    half = max(math.ceil(extent / 2), 1)
    y, x = np.mgrid[-half : half + 1, -half : half + 1].astype(np.float64)
    along = x * math.cos(angle) + y * math.sin(angle)
    across = np.abs(-x * math.sin(angle) + y * math.cos(angle))
    kernel = np.clip(1.0 - across, 0.0, 1.0) * np.clip(extent / 2 + 0.5 - np.abs(along), 0.0, 1.0)
    return np.asarray(kernel / kernel.sum(), dtype=np.float32)
