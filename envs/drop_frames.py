"""A wrapper for the real-time mode: frames that arrive while the tracker is busy are dropped."""

from __future__ import annotations

from typing import Any, SupportsFloat

import gymnasium as gym
import numpy as np
from gymnasium.utils import RecordConstructorArgs

from dynslam_bench.core.errors import SettingsError
from dynslam_bench.core.seeding import stream

from .record_timings import slam_env_of

WARM_UP_FRAMES = 12
"""Tracked off the clock: enough for keyframes and bundle adjustment, so every kernel and network has run once."""


class DropFrames(gym.Wrapper[Any, Any, Any, Any], RecordConstructorArgs):
    """Feeds the tracker only the frames that a live camera would have left it, or drops frames at random.

    Real-time mode: frame i arrives at its stamp. When the tracker is done with a frame it takes the newest one that
    has arrived, or waits for the next; those in between are dropped. They count as not tracked (coverage) and cost
    what lost ones do, added to the reward of the step that dropped them. The last frame is never dropped. With
    measured times the episode depends on the machine; `frame_time_s` makes it reproducible.

    Compiling kernels and loading networks is no work of a frame: before the first measured episode the tracker tracks
    the first `WARM_UP_FRAMES` frames off the clock and is reset.

    Args:
        env: A `SlamEnv`, wrapped or not.
        speed: Playback speed; 2 halves the time between frames.
        frame_time_s: What the tracker's step counts as, seconds; None for the measured time.
        share: In place of the real-time mode, drop each frame with this probability.
        seed: Seed of the random drops.

    Raises:
        SettingsError: A value lies outside its range.
    """

    def __init__(
        self,
        env: gym.Env[Any, Any],
        *,
        speed: float = 1.0,
        frame_time_s: float | None = None,
        share: float | None = None,
        seed: int = 0,
    ) -> None:
        RecordConstructorArgs.__init__(self, speed=speed, frame_time_s=frame_time_s, share=share, seed=seed)
        gym.Wrapper.__init__(self, env)
        if not speed > 0:
            raise SettingsError(f"speed is {speed}, expected a number > 0")
        if frame_time_s is not None and not frame_time_s >= 0:
            raise SettingsError(f"frame_time_s is {frame_time_s}, expected seconds >= 0")
        if share is not None and not 0 <= share < 1:
            raise SettingsError(f"share is {share}, expected a probability in [0, 1)")
        self._base = slam_env_of(env, "DropFrames")
        self._speed, self._frame_time_s, self._share, self._seed = speed, frame_time_s, share, seed
        self._free_at = 0.0
        self._warm = share is not None or frame_time_s is not None

    @property
    def dropped(self) -> int:
        """Frames dropped in this episode so far."""
        return sum(outcome.state == "dropped" for outcome in self._base.episode.outcomes)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Begin an episode; the clock starts when frame 0 arrives, and the tracker is warm then."""
        if not self._warm:
            self._warm_up(options)
            self._warm = True
        outcome = self.env.reset(seed=seed, options=options)
        self._free_at = self._arrivals()[0] + self._busy_s()
        return outcome

    def step(self, action: Any) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        """Drop what the tracker missed, then track the next frame."""
        index = self._base.episode.next_index
        target = self._next_frame(index)
        charged = self._base.drop_frames(target - index)
        observation, reward, terminated, truncated, info = self.env.step(action)
        self._free_at = max(self._free_at, self._arrivals()[target]) + self._busy_s()
        return observation, float(reward) + charged, terminated, truncated, info

    def _warm_up(self, options: dict[str, Any] | None) -> None:
        """Track the first frames; the environment's random numbers are afterwards where they were."""
        base = self._base
        numbers = base.np_random
        base.reset(seed=0, options=options)
        while not base.episode.over and base.episode.next_index < WARM_UP_FRAMES:
            base.step(base.neutral_action)
        base.np_random = numbers

    def _next_frame(self, index: int) -> int:
        last = len(self._base.sequence) - 1
        if self._share is not None:
            target = index
            while target < last and stream(self._seed, "drop", target).random() < self._share:
                target += 1
            return target
        newest = int(np.searchsorted(self._arrivals(), self._free_at, side="right")) - 1
        return min(max(newest, index), last)

    def _arrivals(self) -> Any:
        return self._base.sequence.timestamps / self._speed

    def _busy_s(self) -> float:
        if self._frame_time_s is not None:
            return self._frame_time_s
        return float(self._base.episode.outcomes[-1].timings["total"])
