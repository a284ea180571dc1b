"""A wrapper that takes another sequence for every episode."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

import gymnasium as gym
from gymnasium.utils import RecordConstructorArgs

from dynslam_bench.core.errors import SettingsError

from .record_timings import slam_env_of


class SequenceSampler(gym.Wrapper[Any, Any, Any, Any], RecordConstructorArgs):
    """Begins every episode on another sequence of a list, for training agents and for evaluation.

    Args:
        env: A `SlamEnv`, wrapped or not.
        sequences: Ids or folders; with ``rgbd`` observations all must have the same image size.
        mode: ``round_robin`` takes them in order; ``random`` draws from the wrapper's own generator, which a `reset`
            with a seed founds anew.

    Raises:
        SettingsError: No sequences, or an unknown mode.
    """

    def __init__(
        self,
        env: gym.Env[Any, Any],
        sequences: Sequence[str],
        mode: Literal["round_robin", "random"] = "round_robin",
    ) -> None:
        RecordConstructorArgs.__init__(self, sequences=list(sequences), mode=mode)
        gym.Wrapper.__init__(self, env)
        slam_env_of(env, "SequenceSampler")
        if not sequences:
            raise SettingsError("SequenceSampler got no sequences")
        if mode not in ("round_robin", "random"):
            raise SettingsError(f"unknown mode '{mode}'", "known: round_robin, random")
        self._sequences = tuple(sequences)
        self._mode = mode
        self._next = 0
        self._rng = gym.utils.seeding.np_random(None)[0]

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Begin an episode on the next sequence; ``options["sequence"]`` wins over the sampler.

        A seed also sets the sampler back: to the first sequence, or to the seed's first draw.
        """
        if seed is not None:
            self._next = 0
            self._rng = gym.utils.seeding.np_random(seed)[0]
        chosen = self._draw()
        options = {"sequence": chosen} | (options or {})
        observation, info = self.env.reset(seed=seed, options=options)
        return observation, info | {"sequence": str(options["sequence"])}

    def _draw(self) -> str:
        if self._mode == "random":
            return self._sequences[int(self._rng.integers(len(self._sequences)))]
        chosen = self._sequences[self._next % len(self._sequences)]
        self._next += 1
        return chosen
