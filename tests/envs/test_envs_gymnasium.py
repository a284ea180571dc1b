"""The environment keeps Gymnasium's rules, for every registered id."""

from __future__ import annotations

import pickle
import warnings

import gymnasium as gym
import numpy as np
import pytest
from envs_toys import TARGET, ToySequence
from gymnasium.envs.registration import EnvSpec
from gymnasium.utils.env_checker import check_env

import dynslam_bench.envs
from dynslam_bench.envs import GENERIC_ID, SlamEnv, env_id, register_envs
from dynslam_bench.sequences.catalogue import sequence_ids
from dynslam_bench.sequences.synthetic.ids import SYNTHETIC_IDS

SYNTHETIC = SYNTHETIC_IDS[::4]
CONTROL = ["noise.level_m", "noise.clip", "noise.passes", "noise.enabled"]


def checked(env: gym.Env) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(env.unwrapped)
    env.close()


@pytest.mark.parametrize("name", SYNTHETIC)
def test_every_family_passes_the_checker_without_a_warning(name: str) -> None:
    checked(gym.make(env_id(name), tracker="constant-velocity", render_mode="rgb_array", frames=[0, 20]))


def test_the_default_tracker_passes_the_checker() -> None:
    checked(gym.make("dynslam/synthetic-sitting_xyz-v0", render_mode="rgb_array", frames=[0, 20]))


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
    makers = [lambda: gym.make("dynslam_bench.envs:dynslam/Sequence-v0", **kwargs) for _ in range(2)]
    vector = gym.vector.AsyncVectorEnv(makers, context="spawn")
    try:
        observations, infos = vector.reset(seed=[1, 1])
        assert observations.shape == (2, 24) and observations[0].tobytes() == observations[1].tobytes()
        for _ in range(5):
            observations, rewards, _, truncated, infos = vector.step(vector.action_space.sample())
        assert truncated.all() and rewards[0] == rewards[1] < 0
        assert infos["episode_metrics"]["ate_rmse_m"].shape == (2,)
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
