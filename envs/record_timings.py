"""A wrapper that puts wall-clock times into ``info``."""

from __future__ import annotations

from typing import Any, SupportsFloat

import gymnasium as gym
import numpy as np
from gymnasium.utils import RecordConstructorArgs

from dynslam_bench.core.errors import SettingsError

from .slam_env import SlamEnv


class RecordTimings(gym.Wrapper[Any, Any, Any, Any], RecordConstructorArgs):
    """Adds ``info["timings"]``: seconds of the frame by stage (see `FrameOutcome.timings`).

    Times differ from run to run, so an environment with this wrapper is not deterministic in its ``info``.

    Args:
        env: A `SlamEnv`, wrapped or not.
    """

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        RecordConstructorArgs.__init__(self)
        gym.Wrapper.__init__(self, env)
        self._base = slam_env_of(env, "RecordTimings")

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Reset, with the times of frame 0 in ``info``."""
        observation, info = self.env.reset(seed=seed, options=options)
        return observation, info | {"timings": self._last()}

    def step(self, action: Any) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        """Step, with the frame's times in ``info``."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        return observation, reward, terminated, truncated, info | {"timings": self._last()}

    def summary(self) -> dict[str, dict[str, float]]:
        """``median`` and ``p95`` of every stage over the episode so far, seconds (0 where a stage did not run)."""
        return summarise(self._base.timings)

    def _last(self) -> dict[str, float]:
        return {stage: float(seconds) for stage, seconds in self._base.episode.outcomes[-1].timings.items()}


def summarise(timings: list[dict[str, float]]) -> dict[str, dict[str, float]]:
    """``median`` and ``p95`` in seconds of every stage over the tracked frames; stages that did not run count as 0."""
    frames = [frame for frame in timings if frame]
    stages = list(dict.fromkeys(stage for frame in frames for stage in frame))
    series = {stage: np.array([frame.get(stage, 0.0) for frame in frames]) for stage in stages}
    return {
        stage: {"median": float(np.median(values)), "p95": float(np.percentile(values, 95))}
        for stage, values in series.items()
    }


def slam_env_of(env: gym.Env[Any, Any], wrapper: str) -> SlamEnv:
    """The `SlamEnv` below the wrappers.

    Raises:
        SettingsError: It is another environment.
    """
    base = env.unwrapped
    if not isinstance(base, SlamEnv):
        raise SettingsError(f"{wrapper} wraps a SlamEnv, not a {type(base).__name__}")
    return base
