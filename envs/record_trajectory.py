"""A wrapper that writes each episode's trajectory to a file."""

from __future__ import annotations

from pathlib import Path
from typing import Any, SupportsFloat

import gymnasium as gym
from gymnasium.utils import RecordConstructorArgs

from dynslam_bench.geometry.tum_file import write_tum

from .record_timings import slam_env_of


class RecordTrajectory(gym.Wrapper[Any, Any, Any, Any], RecordConstructorArgs):
    """Writes the online trajectory of every episode that ends, in TUM's format.

    Args:
        env: A `SlamEnv`, wrapped or not.
        path: Target file; ``{episode}`` in its name becomes the episode's number, from 0. Without it, a later episode
            replaces the file of an earlier one.
    """

    def __init__(self, env: gym.Env[Any, Any], path: str | Path) -> None:
        RecordConstructorArgs.__init__(self, path=str(path))
        gym.Wrapper.__init__(self, env)
        self._base = slam_env_of(env, "RecordTrajectory")
        self._pattern = str(path)
        self._episode = -1
        self.written: list[Path] = []
        """The files so far, in order."""

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Begin an episode."""
        self._episode += 1
        return self.env.reset(seed=seed, options=options)

    def step(self, action: Any) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        """Step; the last step of an episode writes its file.

        Raises:
            DynslamError: The file cannot be written.
        """
        outcome = self.env.step(action)
        if outcome[2] or outcome[3]:
            path = Path(self._pattern.replace("{episode}", str(self._episode)))
            comment = f"{self._base.tracker_spec.id} on {self._base.sequence.id}, online"
            write_tum(path, self._base.online_trajectory(), comment=comment)
            self.written.append(path)
        return outcome
