"""A wrapper that shows agents images of a size and form that networks take."""

from __future__ import annotations

from typing import Any

import cv2
import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.utils import RecordConstructorArgs
from numpy.typing import NDArray

from dynslam_bench.core.errors import SettingsError

from .observation import MAX_DEPTH_M
from .record_timings import slam_env_of


class SmallImages(gym.ObservationWrapper[Any, Any, Any], RecordConstructorArgs):
    """Makes ``rgbd`` observations small 8-bit images, colour and depth alike, as stable-baselines3 expects images.

    ``rgb`` becomes uint8 ``[height, width, 3]``, averaged over the pixels that fall together; ``depth`` becomes uint8
    ``[height, width, 1]``, the nearest pixel's, in steps of 20 m / 254: 0 is missing, 255 is 20 m or more. ``stats``
    stays.

    Args:
        env: A `SlamEnv`, wrapped or not, made with ``observation="rgbd"``.
        width: Of the images, pixels; stable-baselines3's convolutions need 36 at least.
        height: Likewise.

    Raises:
        SettingsError: The environment shows no images, or an image would have no pixels.
    """

    def __init__(self, env: gym.Env[Any, Any], width: int = 80, height: int = 60) -> None:
        RecordConstructorArgs.__init__(self, width=width, height=height)
        gym.ObservationWrapper.__init__(self, env)
        slam_env_of(env, "SmallImages")
        space = env.observation_space
        if not isinstance(space, spaces.Dict):
            raise SettingsError("SmallImages needs images, the observation is 'stats'", 'use observation="rgbd"')
        if min(width, height) < 1:
            raise SettingsError(f"an image of {width} x {height} pixels has none")
        self._size = (width, height)
        images = {name: spaces.Box(0, 255, (height, width, depth), np.uint8) for name, depth in _CHANNELS.items()}
        self.observation_space = spaces.Dict({**space.spaces, **images})

    def observation(self, observation: dict[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
        """The observation with small images in place of its own."""
        rgb = cv2.resize(observation["rgb"], self._size, interpolation=cv2.INTER_AREA)
        depth = cv2.resize(observation["depth"], self._size, interpolation=cv2.INTER_NEAREST)
        steps = np.where(depth > 0, 1 + np.rint(254 * (depth / MAX_DEPTH_M)), 0)
        return {**observation, "rgb": rgb, "depth": steps.astype(np.uint8)[..., None]}


_CHANNELS = {"rgb": 3, "depth": 1}
