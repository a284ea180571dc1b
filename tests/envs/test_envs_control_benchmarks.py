"""The benchmarks of control: what they are made of, and that their scenes change within an episode."""

import copy
import dataclasses
import pickle
from collections import Counter
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from envs_play import checked, checked_by_stable_baselines3
from gymnasium.envs.registration import EnvSpec
from sequence_folders import SHARED, needs_shared

from dynslam_bench.core.errors import SettingsError
from dynslam_bench.envs import CONTROL_BENCHMARKS, FrameOutcome, control_benchmark
from dynslam_bench.geometry import se3
from dynslam_bench.sequences import open_sequence
from dynslam_bench.sequences.synthetic.families import Ramp

BENCHMARKS = sorted(CONTROL_BENCHMARKS)


def short(id: str) -> Any:
    """The benchmark with episodes of eight frames."""
    return dataclasses.replace(control_benchmark(id), frames=(0, 16))


def played(env: gym.Env, seed: int) -> list[float]:
    """Rewards of an episode of random actions."""
    env.action_space.seed(seed)
    env.reset(seed=seed)
    rewards = []
    while not env.unwrapped.episode.over:
        rewards.append(float(env.step(env.action_space.sample())[1]))
    return rewards


@pytest.mark.parametrize("id", BENCHMARKS)
def test_it_passes_the_checkers(id: str) -> None:
    def make() -> gym.Env:
        return gym.make(f"dynslam/{id}", split="test", index=0, frames=[0, 16], render_mode="rgb_array")

    checked(make())
    checked_by_stable_baselines3(make())


def test_every_episode_draws_a_sequence_and_repeats_to_the_bit() -> None:
    first, again, other = (short("features-v0").make("train", range(2)) for _ in range(3))
    assert played(first, 5) == played(again, 5) != played(other, 6)
    assert len(played(first, 5)) == 7


@pytest.mark.parametrize("id", BENCHMARKS)
def test_it_is_made_again_from_its_json(id: str) -> None:
    env = gym.make(f"dynslam/{id}", split="test", index=3, frames=[0, 16])
    duplicate = gym.make(EnvSpec.from_json(env.spec.to_json()))
    assert duplicate.unwrapped.sequence.id.startswith(control_benchmark(id).test[3])
    assert duplicate.action_space == env.action_space
    pickled, copied = pickle.loads(pickle.dumps(env)), copy.deepcopy(env)
    assert played(duplicate, 1) == played(env, 1) == played(pickled, 1) == played(copied, 1)


@pytest.mark.parametrize("id", BENCHMARKS)
def test_training_and_test_scenes_are_of_their_splits(id: str) -> None:
    benchmark = control_benchmark(id)
    for split, sequences in (("tune", benchmark.train), ("held-out", benchmark.test)):
        assert {open_sequence(name).split for name in sequences} == {split}
        parts = [name.split("?scene=") for name in sequences]
        counts = Counter((family, int(scene) % 2) for family, scene in parts)
        assert len(counts) % 2 == 0 and max(counts.values()) - min(counts.values()) <= 1, "as many changes either way"
    assert not set(benchmark.train) & set(benchmark.test)


def test_the_first_action_is_the_default() -> None:
    env = short("masks-v0").make("test", 0)
    assert np.array_equal(env.action(0), env.unwrapped.neutral_action)


def test_a_call_of_the_network_and_keypoints_cost_their_weight() -> None:
    cases = ("masks-v0", "segmented", 1.0), ("features-v0", "keypoints", 1000.0), ("budget-v0", "keypoints", 1000.0)
    for id, stat, unit in cases:
        benchmark = short(id)
        free = dataclasses.replace(benchmark, reward=dataclasses.replace(benchmark.reward, weight=0.0))
        rewards = [played(each.make("test", 0), 3) for each in (benchmark, free)]
        env = benchmark.make("test", 0)
        played(env, 3)
        costs = [outcome.stats[stat] / unit for outcome in env.unwrapped.episode.outcomes[1:]]
        weights = benchmark.reward.weight * (1 + benchmark.reward.growth * np.arange(1, 8))
        np.testing.assert_allclose(rewards[0], np.subtract(rewards[1], weights * np.array(costs)))
        assert max(costs) > 0


def test_the_budget_of_a_frame_falls_to_a_fifth() -> None:
    reward = control_benchmark("budget-v0").reward
    outcome = FrameOutcome(0, 0.0, "ok", None, {"keypoints": 500.0}, {}, None)
    charges = [reward.charge(dataclasses.replace(outcome, index=index)) for index in range(120)]
    assert charges[0] == 0.0005 and charges[-1] == pytest.approx(0.0025) and np.mean(charges) == pytest.approx(0.0015)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: control_benchmark("mask-v0"), r"unknown control benchmark 'mask-v0'.*masks-v0, features-v0"),
        (lambda: gym.make("dynslam/masks-v0", split="tset"), "no split 'tset'.*train, test, recordings"),
        (lambda: control_benchmark("masks-v0").make("test", 12), "no sequence 12.*0 to 11"),
        (lambda: control_benchmark("masks-v0").make("test", []), "no sequence .*0 to 11"),
        (lambda: control_benchmark("masks-v0").make("test", "3"), "no sequence '3'.*0 to 11"),
    ],
)
def test_what_is_not_there(call: Any, words: str) -> None:
    with pytest.raises(SettingsError, match=words):
        call()


@needs_shared
@pytest.mark.parametrize(("id", "settings"), [("masks-v0", {"segmentation.source": "embedded"}), ("features-v0", {})])
def test_recordings_can_be_stepped(id: str, settings: dict[str, Any]) -> None:
    benchmark = short(id)
    for index in range(len(benchmark.recordings)):
        env = benchmark.make("recordings", index, data_root=SHARED / "data", settings=benchmark.settings | settings)
        assert np.isfinite(played(env, 0)).all()


# The scenes change.


@pytest.mark.parametrize("scene", [0, 1, 100, 101])
def test_people_come_in_even_scenes_and_leave_in_odd_ones(scene: int) -> None:
    sequence = open_sequence(f"synthetic/changing_crowd?scene={scene}")
    begin, end = (
        [float((sequence.masks[index].instances > 0).mean()) for index in frames]
        for frames in (range(0, 84, 12), range(192, 240, 12))
    )
    empty, full = (begin, end) if scene % 2 == 0 else (end[-1:], begin)
    assert max(empty) < 0.02 and max(full) > 0.2


@pytest.mark.parametrize("scene", [0, 1, 100, 101])
def test_the_camera_speeds_up_and_slows_down(scene: int) -> None:
    poses = open_sequence(f"synthetic/changing_tempo?scene={scene}").ground_truth.T_world_cam
    speed = np.linalg.norm(se3.log(se3.inverse(poses[:-1]) @ poses[1:])[:, :3], axis=1) * 30
    slow, fast = (np.median(part) for part in (speed[:85], speed[180:])[:: -1 if scene % 2 else 1])
    assert slow < 0.25 and fast > 3 * slow


@pytest.mark.parametrize("scene", [0, 1, 100, 101])
def test_the_light_fades_and_returns(scene: int) -> None:
    sequence = open_sequence(f"synthetic/changing_light?scene={scene}")
    bright, dark = (float(sequence[index].rgb.mean()) for index in (10, 230)[:: -1 if scene % 2 else 1])
    assert bright > 60 and dark < 0.2 * bright


def test_a_ramp_and_its_integral_agree() -> None:
    ramp = Ramp(3.2, 0.4, 2.0)
    times = np.linspace(0.0, 9.0, 90_001)
    levels = np.array([ramp.level(float(time)) for time in times])
    assert levels[0] == 0.4 and levels[-1] == 2.0 and (np.diff(levels) >= 0).all()
    middle = (levels[1:] + levels[:-1]) / 2 * 1e-4
    np.testing.assert_allclose(ramp.integral(times)[1:], np.cumsum(middle), atol=1e-8)
