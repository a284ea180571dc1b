"""Copies of an environment in mid-episode: they go on alike, and apart."""

from __future__ import annotations

import copy
import sys
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from envs_toys import TARGET, ToySequence

from dynslam_bench.core.errors import TrackerError
from dynslam_bench.envs import DegradeFrames, SlamEnv
from dynslam_bench.testing import CornerSequence
from dynslam_bench.trackers import TRACKERS

STILL = "[1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]"
PROGRAM = f"""
import json, sys
for line in sys.stdin:
    request = json.loads(line)
    answer = {{"ok": True}} if request["op"] == "reset" else {{"state": "ok", "T_world_cam": {STILL}}}
    print(json.dumps(answer | {{key: request[key] for key in request if key == "index"}}), flush=True)
"""


def go_on(env: gym.Env[Any, Any], action: Any = None) -> tuple[list[float], np.ndarray, np.ndarray]:
    """Rewards of the steps that are left, the online poses, and the last observation."""
    inner = env.unwrapped
    assert isinstance(inner, SlamEnv)
    rewards = []
    while not inner.episode.over:
        observation, reward, *_ = env.step(inner.neutral_action if action is None else action)
        rewards.append(float(reward))
    return rewards, inner.online_trajectory().T_world_cam, observation


def started(env: gym.Env[Any, Any], steps: int) -> gym.Env[Any, Any]:
    env.reset(seed=3)
    for _ in range(steps):
        env.step(env.unwrapped.neutral_action)  # type: ignore[attr-defined]
    return env


def check_alike(env: gym.Env[Any, Any], duplicate: gym.Env[Any, Any]) -> None:
    first, second = go_on(env), go_on(duplicate)
    assert first[0] == second[0] and len(first[0]) > 1
    np.testing.assert_array_equal(first[1], second[1])
    np.testing.assert_array_equal(first[2], second[2])


def test_a_copy_goes_on_from_the_same_frame_to_the_bit() -> None:
    env = started(SlamEnv(ToySequence(12), TARGET, control=["noise.level_m"]), 4)
    duplicate = copy.deepcopy(env)
    assert isinstance(duplicate, SlamEnv) and duplicate.sequence is env.sequence and duplicate.episode.next_index == 5  # type: ignore[attr-defined]
    check_alike(env, duplicate)
    assert env.reset()[0] == pytest.approx(duplicate.reset()[0]), "the seeds that follow are the same, too"


def test_copies_go_their_own_ways() -> None:
    env = started(SlamEnv(ToySequence(12), TARGET, control=["noise.level_m"]), 4)
    loud, quiet = copy.deepcopy(env), copy.deepcopy(env)
    loud_poses, quiet_poses = go_on(loud, np.ones(1))[1], go_on(quiet, -np.ones(1))[1]
    assert np.abs(loud_poses[5:] - quiet_poses[5:]).max() > 0.01
    np.testing.assert_array_equal(loud_poses[:5], quiet_poses[:5])
    assert env.episode.next_index == 5  # type: ignore[attr-defined]
    loud.close()
    env.step(env.unwrapped.neutral_action)  # type: ignore[attr-defined]


def test_wrappers_are_copied_with_it() -> None:
    env = started(DegradeFrames(SlamEnv(ToySequence(10), TARGET, observation="rgbd"), noise=0.2), 2)
    duplicate = copy.deepcopy(env)
    transforms = duplicate.unwrapped.frame_transforms  # type: ignore[attr-defined]
    assert len(transforms) == 1 and duplicate.unwrapped is not env.unwrapped
    first, second = (each.step(0)[0]["rgb"] for each in (env, duplicate))
    np.testing.assert_array_equal(first, second)


def test_copies_before_and_after_an_episode() -> None:
    env = SlamEnv(ToySequence(4), TARGET)
    check_alike(started(env, 0), started(copy.deepcopy(env), 0))
    assert copy.deepcopy(env).episode_metrics() == env.episode_metrics()


@pytest.mark.parametrize(
    "tracker", ["orb-slam2", "emfoa-oft?masks=none", "never-move", "dynaslam-g", "opencv-odometry"]
)
def test_built_in_trackers_go_on_to_the_bit(tracker: str) -> None:
    if TRACKERS.get(tracker).missing():
        pytest.skip(f"{tracker} is not installed")
    env = started(SlamEnv(CornerSequence(6), tracker, threads=2), 3)
    duplicate = copy.deepcopy(env)
    check_alike(env, duplicate)
    finals = [each.unwrapped.final_trajectory() for each in (env, duplicate)]  # type: ignore[attr-defined]
    assert finals == [None, None] or np.array_equal(finals[0].T_world_cam, finals[1].T_world_cam)


def test_a_program_is_refused_and_stays_usable(tmp_path: Path) -> None:
    (tmp_path / "still.py").write_text(PROGRAM)
    env = started(SlamEnv(ToySequence(5), f"subprocess:{sys.executable} {tmp_path / 'still.py'}"), 1)
    with pytest.raises(TrackerError, match="cannot be copied"):
        copy.deepcopy(env)
    env.step(0)
    env.close()
