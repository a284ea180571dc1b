"""Small images for agents: what they show, and that stable-baselines3 has nothing to say about them."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
from envs_toys import TARGET, ToySequence

import dynslam_bench.envs  # noqa: F401
from dynslam_bench.core.errors import SettingsError
from dynslam_bench.envs import SlamEnv, SmallImages
from dynslam_bench.envs.spaces import MAX_DEPTH_M


def test_they_show_the_same_smaller() -> None:
    env = SmallImages(SlamEnv(ToySequence(4), TARGET, observation="rgbd"), width=40, height=36)
    seen, _ = env.reset(seed=0)
    assert seen in env.observation_space and seen["rgb"].shape == (36, 40, 3) and seen["depth"].shape == (36, 40, 1)
    whole = env.unwrapped.frame
    assert abs(float(seen["rgb"].mean()) - float(whole.rgb.mean())) < 3


def test_depth_keeps_missing_apart_and_is_right_to_half_a_step() -> None:
    env = SmallImages(SlamEnv(ToySequence(4), TARGET, observation="rgbd"))
    shown = {"rgb": np.zeros((60, 80, 3), np.uint8), "depth": np.linspace(0, MAX_DEPTH_M, 4800, dtype=np.float32)}
    shown["depth"] = shown["depth"].reshape(60, 80)
    steps = env.observation(shown)["depth"][..., 0].astype(float)
    assert (steps == 0).sum() == 1 and steps[0, 0] == 0 and steps[-1, -1] == 255
    metres = (steps - 1) * MAX_DEPTH_M / 254
    assert np.abs(metres - shown["depth"]).ravel()[1:].max() <= 0.5 * MAX_DEPTH_M / 254 + 1e-6


@pytest.mark.parametrize(("observation", "width"), [("stats", 80), ("rgbd", 0)])
def test_what_it_cannot_wrap_is_refused(observation: str, width: int) -> None:
    with pytest.raises(SettingsError):
        SmallImages(SlamEnv(ToySequence(4), TARGET, observation=observation), width=width)


def test_stable_baselines3_takes_it_without_a_word() -> None:
    checks = pytest.importorskip("stable_baselines3.common.env_checker", reason="the extra [rl] is not installed")
    env = SmallImages(
        SlamEnv(ToySequence(6), TARGET, observation="rgbd", control=["noise.level_m"]), width=40, height=36
    )
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        checks.check_env(env)
    with pytest.warns(UserWarning, match="unconventional shape"):
        checks.check_env(SlamEnv(ToySequence(6), TARGET, observation="rgbd", control=["noise.level_m"]))
