"""The environment keeps Gymnasium's rules, for every registered id."""

import copy
import pickle
import sys
import warnings
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from envs_toys import TARGET, ToySequence
from gymnasium.envs.registration import EnvSpec
from gymnasium.utils.env_checker import check_env

import dynslam_bench.envs
from dynslam_bench.core.errors import TrackerError
from dynslam_bench.envs import GENERIC_ID, DegradeFrames, SlamEnv, env_id, register_envs
from dynslam_bench.sequences.catalogue import sequence_ids
from dynslam_bench.sequences.synthetic.ids import SYNTHETIC_IDS
from dynslam_bench.testing import CornerSequence
from dynslam_bench.trackers import TRACKERS

SYNTHETIC = SYNTHETIC_IDS[::4]
CONTROL = ["noise.level_m", "noise.clip", "noise.passes", "noise.enabled"]


def checked(env: gym.Env) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(env.unwrapped)
    env.close()


@pytest.mark.parametrize("name", SYNTHETIC)
def test_every_family_passes_the_checker_without_a_warning(name: str) -> None:
    checked(gym.make(env_id(name), tracker="constant-velocity", render_mode="rgb_array", frames=[0, 8]))


def test_the_default_tracker_passes_the_checker() -> None:
    checked(gym.make("dynslam/synthetic-sitting_xyz-v0", render_mode="rgb_array", frames=[0, 8]))


@pytest.mark.parametrize(
    "kwargs", [{}, {"observation": "rgbd"}, {"control": CONTROL}, {"reward": "neg_pose_error", "lost_after": 3}]
)
def test_every_kind_of_environment_passes_the_checker(kwargs: dict) -> None:
    for sequence in (ToySequence(12), ToySequence(12, has_truth=False), ToySequence(12, hole=(0, 4))):
        checked(gym.make(GENERIC_ID, sequence=sequence, tracker=TARGET, render_mode="rgb_array", **kwargs))


def test_all_listed_sequences_are_registered_and_registering_again_changes_nothing() -> None:
    before = dict(gym.registry)
    ids = register_envs()
    assert dict(gym.registry) == before
    assert ids[0] == "dynslam/Sequence-v0"
    assert {"dynslam/tum-fr3-walking_xyz-v0", "dynslam/synthetic-walking_xyz-v0", "dynslam/bonn-crowd-v0"} <= set(ids)
    assert len(ids) == len(set(ids)) == 1 + len(sequence_ids())
    assert all(gym.spec(name).max_episode_steps is None for name in ids)


def test_made_environment_is_made_again_from_its_json(toy_folder: str) -> None:
    env = gym.make(GENERIC_ID, sequence=toy_folder, tracker=TARGET, frames=[3, 20], control=CONTROL)
    env = dynslam_bench.envs.DropFrames(dynslam_bench.envs.RecordTimings(env), frame_time_s=0.05)
    assert env.spec is not None
    duplicate = gym.make(EnvSpec.from_json(env.spec.to_json()))
    assert isinstance(duplicate, dynslam_bench.envs.DropFrames)
    first, _ = env.reset(seed=3)
    second, _ = duplicate.reset(seed=3)
    assert first.tobytes() == second.tobytes()
    assert duplicate.action_space == env.action_space


def test_one_seed_gives_identical_bytes(toy_folder: str) -> None:
    env = SlamEnv(toy_folder, TARGET, control=CONTROL)
    first = rollout(env, 20, 5)
    assert first == rollout(env, 20, 5) == rollout(SlamEnv(toy_folder, TARGET, control=CONTROL), 20, 5)
    assert first != rollout(env, 20, 6)


def test_pickle_gives_an_equal_environment(toy_folder: str) -> None:
    env = SlamEnv(toy_folder, TARGET, control=CONTROL, settings={"noise.level_m": 0.002})
    env.reset(seed=1)
    duplicate = pickle.loads(pickle.dumps(env))
    assert duplicate.settings == env.settings and duplicate.action_space == env.action_space
    assert rollout(duplicate, 10, 2) == rollout(env, 10, 2)


def test_async_vector_env(toy_folder: str) -> None:
    kwargs = {"sequence": toy_folder, "tracker": TARGET, "frames": [0, 6]}
    make = lambda: gym.make("dynslam_bench.envs:dynslam/Sequence-v0", **kwargs)  # noqa: E731
    alone = make()
    vector = gym.vector.AsyncVectorEnv([make], context="spawn")
    try:
        observations, infos = vector.reset(seed=[1])
        assert observations.shape == (1, 24) and observations[0].tobytes() == alone.reset(seed=1)[0].tobytes()
        for _ in range(5):
            observations, rewards, _, truncated, infos = vector.step(vector.action_space.sample())
            reward = alone.step(0)[1]
        assert truncated.all() and rewards[0] == reward < 0
        assert infos["episode_metrics"]["ate_rmse_m"].shape == (1,)
    finally:
        vector.close()


def rollout(env: SlamEnv, steps: int, seed: int) -> bytes:
    """Everything that an episode gives, as bytes; actions are drawn from the seed."""
    env.action_space.seed(seed)
    observation, info = env.reset(seed=seed)
    parts = [observation.tobytes(), repr(sorted(info.items(), key=str)).encode()]
    for _ in range(steps):
        observation, reward, terminated, truncated, info = env.step(env.action_space.sample())
        pose = np.asarray(info.get("pose", ())).tobytes()
        rest = sorted((key, value) for key, value in info.items() if key != "pose")
        parts += [observation.tobytes(), np.float64(reward).tobytes(), pose, repr(rest).encode()]
        assert not terminated and not truncated
    env.close()
    return b"".join(parts)


# Copies of an environment in mid-episode: they go on alike, and apart.


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
