"""What agents learn with: windows, copies of an episode, fixed infos, costs, choices and further observations."""

import pickle
import sys
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from envs_toys import SPEC, TARGET, ToySequence, ToyTracker, write_folder
from gymnasium.utils.env_checker import check_env

from dynslam_bench.contracts.tracker import TrackResult
from dynslam_bench.core.errors import DynslamError, SequenceError, SettingsError, TrackerError
from dynslam_bench.envs import (
    GENERIC_ID,
    KEYPOINT_LAYOUT,
    PRIVILEGED_LAYOUT,
    REWARDS,
    AccuracyMinusCost,
    DiscreteActions,
    DropFrames,
    Episode,
    NegWindowError,
    SequenceSampler,
    SlamEnv,
)
from dynslam_bench.envs.episode import metric_names
from dynslam_bench.testing import CornerSequence

QUIET = {"noise.enabled": False}
PARTS = ["stats", "rgb", "depth", "gray", "keypoints", "privileged"]


def play(env: gym.Env, action: Any = None, **reset: Any) -> tuple[list[float], list[dict]]:
    """Rewards and infos of an episode."""
    rewards, infos, over = [], [env.reset(**reset)[1]], False
    while not over:
        asked = env.unwrapped.neutral_action if action is None else action
        _, reward, terminated, truncated, info = env.step(asked)
        rewards.append(float(reward))
        infos.append(info)
        over = terminated or truncated
    return rewards, infos


# Windows.


@pytest.mark.parametrize("sequence", [CornerSequence(14), "synthetic/sitting_xyz?frames=14"])
def test_a_window_is_the_episode_of_these_frames_alone(sequence: Any) -> None:
    rendered = isinstance(sequence, str)
    tracker, settings = ("mask-rcnn", {"segmentation.source": "oracle"}) if rendered else ("orb-slam2", {})
    env = SlamEnv(sequence, tracker, settings=settings)
    cut = SlamEnv(sequence, tracker, settings=settings, frames=(5, 11))
    env.reset(seed=1)
    rewards, infos = play(env, seed=3, options={"window": (5, 11)})
    assert rewards == play(cut, seed=3)[0] and len(rewards) == 5
    assert infos[0]["window"].tolist() == infos[-1]["window"].tolist() == [5, 11]
    assert infos[-1]["episode_metrics"]["frames"] == 6
    assert len(play(env, seed=3)[0]) == 13, "the next episode has all frames again"


def test_random_windows_have_their_length_and_follow_the_seed() -> None:
    def windows(seed: int) -> list[tuple[int, int]]:
        env = SlamEnv(ToySequence(30), TARGET, window=8)
        drawn = [env.reset(seed=seed if first else None)[1]["window"] for first in (True, *[False] * 20)]
        assert len(play(env)[0]) == 7
        return [(int(first), int(stop)) for first, stop in drawn]

    assert windows(1) == windows(1) != windows(2)
    assert {stop - first for first, stop in windows(1)} == {8} and len(set(windows(1))) > 8
    assert 0 <= min(windows(1))[0] and max(windows(1))[1] <= 30


@pytest.mark.parametrize("window", [(5, 13), "5:13", (3, 4), (12, 14), (4, 2)])
def test_a_window_that_is_no_part_of_the_sequence(window: Any) -> None:
    env = SlamEnv(ToySequence(12), TARGET)
    with pytest.raises(SequenceError, match=r"12 frames here|no range"):
        env.reset(options={"window": window})
    assert len(play(env)[0]) == 11


def test_a_window_longer_than_the_sequence() -> None:
    with pytest.raises(SettingsError, match=r"window of 50 frames is longer than 'toy/walk', which has 12.*window=12"):
        SlamEnv(ToySequence(12), TARGET, window=50)
    env = SlamEnv(ToySequence(12), TARGET, window=10)
    with pytest.raises(SettingsError, match="longer"):
        env.reset(options={"sequence": ToySequence(9)})
    assert len(play(env)[0]) == 9


# Copies of an episode.


def stepped(env: gym.Env, steps: int, seed: int = 3) -> gym.Env:
    env.reset(seed=seed)
    for _ in range(steps):
        env.step(env.unwrapped.neutral_action)
    return env


def rest(env: SlamEnv, action: Any = None) -> tuple[list[float], bytes, bytes]:
    """Rewards of the steps that are left, the online poses and the last observation."""
    rewards = []
    while not env.episode.over:
        observation, reward, *_ = env.step(env.neutral_action if action is None else action)
        rewards.append(float(reward))
    return rewards, env.online_trajectory().T_world_cam.tobytes(), observation.tobytes()


@pytest.mark.parametrize("tracker", ["orb-slam2", "emfoa-oft?masks=none", "opencv-odometry", "mask-rcnn"])
def test_a_restored_episode_goes_on_to_the_bit(tracker: str) -> None:
    sequence = "synthetic/walking_xyz?scene=0&frames=8" if tracker == "mask-rcnn" else CornerSequence(8)
    env = stepped(SlamEnv(sequence, tracker), 3)
    state = env.clone_state()
    first = rest(env)
    for _ in range(2):
        env.restore_state(state)
        assert env.episode.next_index == 4 and rest(env) == first
    following = env.reset()[0].tobytes()
    env.restore_state(state)
    assert rest(env) == first and env.reset()[0].tobytes() == following, "random numbers are restored, too"


def test_networks_are_shared_by_copies() -> None:
    env = stepped(SlamEnv("synthetic/walking_xyz?scene=0&frames=4", "mask-rcnn"), 1)
    copied, own = (tracker._masks.segmenter.inner for tracker in (env.clone_state().parts["_tracker"], env._tracker))
    assert copied.network is own.network


def test_counterfactual_actions_differ_and_windows_come_back() -> None:
    env = SlamEnv(ToySequence(30), TARGET, control=["noise.level_m"], window=10)
    stepped(env, 3)
    state, window = env.clone_state(), env.window
    loud = rest(env, np.ones(1))
    while env.window == window:
        env.reset()
    env.restore_state(state)
    quiet = rest(env, -np.ones(1))
    assert env.window == window and len(loud[0]) == len(quiet[0]) == 6 and sum(quiet[0]) > sum(loud[0]) + 0.1


def test_a_state_goes_to_another_environment_that_is_made_alike(tmp_path: Path) -> None:
    folder = str(write_folder(tmp_path / "toy", 10))
    env = stepped(SlamEnv(folder, TARGET), 4)
    state = pickle.loads(pickle.dumps(env.clone_state()))
    other = SlamEnv(folder, TARGET)
    other.restore_state(state)
    assert rest(other) == rest(env)


def test_a_state_of_another_sequence_tracker_control_or_version_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    state = stepped(SlamEnv(ToySequence(9), TARGET), 2).clone_state()
    for env, words in (
        (SlamEnv(ToySequence(10), TARGET), "of sequence 'toy/walk' .9 frames"),
        (SlamEnv(ToySequence(9), "never-move"), "of tracker 'toy'"),
        (SlamEnv(ToySequence(9), TARGET, control=["noise.clip"]), "of control"),
        (SlamEnv(ToySequence(9), TARGET), "of version 0.0.1"),
    ):
        if "version" in words:
            state = replace(state, origin={**state.origin, "version": "0.0.1"})
        with pytest.raises(DynslamError, match=words) as caught:
            env.restore_state(state)
        assert "\n" not in str(caught.value)
        assert len(play(env)[0]) >= 8
    with pytest.raises(DynslamError, match="before reset"):
        SlamEnv(ToySequence(9), TARGET).clone_state()


def test_external_programs_cannot_be_cloned(tmp_path: Path) -> None:
    still = '{"state": "ok", "T_world_cam": [1,0,0,0,0,1,0,0,0,0,1,0,0,0,0,1]}'
    (tmp_path / "still.py").write_text(
        "import json, sys\n"
        "for line in sys.stdin:\n"
        "    request = json.loads(line)\n"
        f"    answer = {{'ok': True}} if request['op'] == 'reset' else json.loads('{still}')\n"
        "    print(json.dumps(answer | {key: request[key] for key in request if key == 'index'}), flush=True)\n"
    )
    env = stepped(SlamEnv(ToySequence(5), f"subprocess:{sys.executable} {tmp_path / 'still.py'}"), 1)
    with pytest.raises(TrackerError, match="cannot be copied"):
        env.clone_state()
    env.close()


def test_the_clock_of_a_live_camera_is_part_of_the_state() -> None:
    env = DropFrames(SlamEnv(ToySequence(20), TARGET), frame_time_s=2.4 / 30)
    stepped(env, 2)
    state = env.unwrapped.clone_state()

    def left() -> list[int]:
        frames = []
        while not env.unwrapped.episode.over:
            frames.append(env.step(0)[4]["frame_index"])
        return frames

    first = left()
    env.unwrapped.restore_state(state)
    assert left() == first


# Infos of fixed form.


def form(info: dict[str, Any]) -> dict[str, Any]:
    return {k: form(v) if isinstance(v, dict) else (type(v), np.shape(v)) for k, v in sorted(info.items())}


def test_fixed_infos_have_one_form_and_say_what_is_there() -> None:
    forms = []
    for sequence in (ToySequence(9), ToySequence(9, has_truth=False), ToySequence(9, hole=(0, 4))):
        settings = {"mode": "lost", "at": 5, "until": 7}
        infos = play(SlamEnv(sequence, TARGET, settings=settings, fixed_info=True), seed=0)[1]
        plain = play(SlamEnv(sequence, TARGET, settings=settings), seed=0)[1]
        forms += [form(info) for info in infos]
        for info, usual in zip(infos, plain, strict=True):
            flags = {name: value for name, value in info.items() if name.startswith("has_")}
            assert len(flags) == 5 and all((name[4:] in usual) == value for name, value in flags.items())
            assert all(np.array_equal(info[name], usual[name]) for name in set(usual) - {"episode_metrics"})
            metrics = usual.get("episode_metrics", {})
            assert {name: info["episode_metrics"][name] for name in metrics} == metrics
            assert sum(info["episode_metrics"][f"has_{name}"] for name in metric_names(infos_protocol())) == len(
                metrics
            )
    assert all(each == forms[0] for each in forms)


def infos_protocol() -> Any:
    return SlamEnv(ToySequence(2), TARGET).protocol


def test_minari_records_fixed_infos(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    minari = pytest.importorskip("minari", reason="Minari is not installed")
    pytest.importorskip("jax")
    pytest.importorskip("h5py")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    folder = str(write_folder(tmp_path / "toy", 9))
    arguments = {"sequence": folder, "tracker": TARGET, "control": ["noise.level_m"], "window": 6}
    env = gym.make("dynslam/Sequence-v0", observation=["stats", "keypoints"], fixed_info=True, **arguments)
    collector = minari.DataCollector(env, record_infos=True)
    for seed in range(2):
        play(collector, seed=seed)
    collector.create_dataset(dataset_id="dynslam/toy-v0", algorithm_name="default", requirements=[])
    episodes = list(minari.load_dataset("dynslam/toy-v0"))
    assert [len(episode.rewards) for episode in episodes] == [5, 5]
    assert episodes[0].infos["has_pose"].all() and episodes[0].infos["episode_metrics"]["has_ate_rmse_m"][-1]


# Vector environments.


def test_sub_environments_run_other_sequences(tmp_path: Path) -> None:
    folders = [str(write_folder(tmp_path / f"toy{length}", length)) for length in (5, 6, 7)]
    make = lambda: SequenceSampler(SlamEnv(folders[0], TARGET), folders)  # noqa: E731
    vector = gym.vector.SyncVectorEnv([make] * 3)
    orders = [vector.reset(seed=4 if first else None)[1]["sequence"].tolist() for first in (True, False, False)]
    assert all(sorted(order) == sorted(folders) for order in orders) and len({tuple(order) for order in orders}) == 3
    random = SequenceSampler(SlamEnv(folders[0], TARGET, window=4), folders, mode="random")
    drawn = [[random.reset(seed=seed if n == 0 else None)[1]["sequence"] for n in range(6)] for seed in (1, 2, 3)]
    assert drawn[0] != drawn[1] != drawn[2]


@pytest.mark.parametrize("fixed", [False, True])
def test_vector_environments_take_every_part(tmp_path: Path, fixed: bool) -> None:
    folder = str(write_folder(tmp_path / "toy", 8))
    make = lambda: SlamEnv(  # noqa: E731
        folder,
        TARGET,
        observation=PARTS,
        window=5,
        control=["noise.clip"],
        reward="accuracy_minus_cost",
        fixed_info=fixed,
    )
    vector = gym.vector.SyncVectorEnv([make] * 2)
    observed, infos = vector.reset(seed=3)
    assert observed in vector.observation_space and not (infos["window"][0] == infos["window"][1]).all()
    for _ in range(4):
        observed, rewards, *_ = vector.step(vector.action_space.sample())
        assert observed in vector.observation_space and (rewards < 0).all()


# Rewards.


def test_a_network_call_costs_its_weight() -> None:
    sequence = "synthetic/sitting_xyz?frames=7"
    settings = {"segmentation.source": "oracle", "segmentation.schedule": "every_nth", "segmentation.n": 3}
    plain, infos = play(SlamEnv(sequence, "mask-rcnn", settings=settings), seed=0)
    default, _ = play(SlamEnv(sequence, "mask-rcnn", settings=settings, reward="accuracy_minus_cost"), seed=0)
    dear, _ = play(SlamEnv(sequence, "mask-rcnn", settings=settings, reward=AccuracyMinusCost(weight=0.5)), seed=0)
    calls = np.array([info["stats"]["segmented"] for info in infos[1:]])
    assert calls.tolist() == [0, 0, 1, 0, 0, 1]
    np.testing.assert_allclose(default, plain - 0.001 * calls, atol=1e-15)
    np.testing.assert_allclose(dear, plain - 0.5 * calls, atol=1e-15)


def test_processor_time_is_the_other_cost() -> None:
    env = SlamEnv(ToySequence(6), TARGET, reward=AccuracyMinusCost(weight=2.0, cost="processor_s"))
    rewards, infos = play(env)
    spent = [timing["processor"] for timing in env.timings[1:]]
    errors = [info["frame_error_trans_m"] for info in infos[1:]]
    np.testing.assert_allclose(rewards, -np.array(errors) - 2.0 * np.array(spent), atol=1e-15)


def test_the_windowed_error_is_the_relative_error_over_the_window() -> None:
    env = SlamEnv(ToySequence(12), TARGET, reward=NegWindowError(frames=4))
    rewards, _ = play(env)
    estimate, true = env.online_trajectory().T_world_cam, env.sequence.ground_truth.T_world_cam
    for frame in range(1, 12):
        start = max(frame - 4, 0)
        moved, est = (np.linalg.inv(poses[start]) @ poses[frame] for poses in (true, estimate))
        error = np.linalg.norm((np.linalg.inv(moved) @ est)[:3, 3])
        assert rewards[frame - 1] == pytest.approx(-error, abs=1e-12)


@pytest.mark.parametrize("lost_after", [None, 3])
def test_under_the_windowed_error_a_loss_earns_what_standing_still_does(lost_after: int | None) -> None:
    settings = QUIET | {"mode": "lost", "at": 4}
    lost = play(SlamEnv(ToySequence(14), TARGET, settings=settings, reward="neg_window_error", lost_after=lost_after))[
        0
    ]

    class Still(ToyTracker):
        def track(self, frame: Any) -> TrackResult:
            result = super().track(frame)
            self.kept = result.T_world_cam if frame.index < 4 else self.kept
            return TrackResult(self.kept, "ok")

    sys.modules[__name__].Still = Still  # type: ignore[attr-defined]
    spec = replace(SPEC, entry_point=f"{__name__}:Still")
    still = play(SlamEnv(ToySequence(14), spec, settings=QUIET, reward="neg_window_error"))[0]
    assert sum(lost) == pytest.approx(sum(still), abs=1e-12) and sum(lost) < -0.1


def test_a_callable_earns_what_it_returns_and_sees_the_episode() -> None:
    lengths: list[int] = []

    def reward(episode: Episode) -> float:
        lengths.append(len(episode.outcomes))
        return 0.5 if episode.outcomes[-1].state == "ok" else -1.0

    settings = {"mode": "lost", "at": 4}
    rewards, _ = play(SlamEnv(ToySequence(10), TARGET, settings=settings, reward=reward, lost_after=2))
    assert rewards == [0.5, 0.5, 0.5, -1.0, -1.0 - 4.0] and lengths == [*range(1, 11)]
    with pytest.raises(SettingsError, match="unknown reward 'neg_ate'"):
        SlamEnv(ToySequence(10), TARGET, reward="neg_ate")


@pytest.mark.parametrize("reward", [*REWARDS, AccuracyMinusCost(weight=0.1)])
def test_every_reward_passes_the_checker(reward: Any) -> None:
    for sequence in (ToySequence(9), ToySequence(9, has_truth=False), ToySequence(9, hole=(0, 4))):
        checked(sequence, reward=reward, lost_after=3, window=6)


def checked(sequence: Any, tracker: str = TARGET, **kwargs: Any) -> None:
    env = gym.make(GENERIC_ID, sequence=sequence, tracker=tracker, render_mode="rgb_array", **kwargs)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(env.unwrapped)
    env.close()


# Choices.


def test_segment_now_or_not_is_an_action() -> None:
    env = DiscreteActions(
        SlamEnv(
            "synthetic/sitting_xyz?frames=9",
            "mask-rcnn",
            settings={"segmentation.source": "oracle", "segmentation.n": 1000},
            control=["segmentation.schedule"],
        ),
        [{"segmentation.schedule": "every_nth"}, {"segmentation.schedule": "every"}],
    )
    assert env.action_space == gym.spaces.Discrete(2)
    env.reset(seed=0)
    actions = [0, 1, 0, 0, 1, 1, 0, 0]
    assert [int(env.step(action)[4]["stats"]["segmented"]) for action in actions] == actions


def test_a_choice_leaves_what_it_does_not_name() -> None:
    base = SlamEnv(
        ToySequence(6), TARGET, control=["noise.level_m", "noise.passes"], settings={"noise.level_m": 0.0123}
    )
    env = DiscreteActions(base, [{}, {"noise.passes": 4}])
    assert env.action(0).tobytes() == base.neutral_action.tobytes()
    assert base._actions.values(env.action(1)) == {"noise.level_m": 0.0123, "noise.passes": 4}


@pytest.mark.parametrize(
    ("actions", "words"),
    [
        ([], "no actions"),
        ([{"noise.clip": 1.0}], "'noise.clip' is not in control"),
        ([{"noise.level_m": 7.0}], "noise.level_m"),
        ([{"noise.level_m": "x"}], "noise.level_m"),
    ],
)
def test_choices_that_are_none(actions: list[dict[str, Any]], words: str) -> None:
    with pytest.raises(SettingsError, match=words):
        DiscreteActions(SlamEnv(ToySequence(6), TARGET, control=["noise.level_m"]), actions)


def test_no_other_choice_is_taken() -> None:
    env = DiscreteActions(SlamEnv(ToySequence(6), TARGET, control=["noise.passes"]), [{}, {"noise.passes": 4}])
    env.reset(seed=0)
    for action in (2, -1, 0.5, None):
        with pytest.raises(SettingsError, match="action"):
            env.step(action)


# Observations.


def test_every_part_passes_the_checker_alone_and_together() -> None:
    for parts in (*([part] for part in PARTS), PARTS):
        checked(ToySequence(6), observation=parts)
    checked(ToySequence(6), TARGET.replace(":SPEC", ":FIXED"), observation=PARTS)


def test_keypoints_are_padded_and_thinned_and_say_what_they_are(monkeypatch: pytest.MonkeyPatch) -> None:
    env = SlamEnv(ToySequence(4), TARGET, observation=["keypoints"])
    seen, _ = env.reset(seed=0)
    names = [name for name, _ in KEYPOINT_LAYOUT]
    tokens = dict(zip(names, seen["keypoints"].T, strict=True))
    xy, keep = env.result.keypoints_xy, env.result.keypoints_keep
    assert seen["keypoints_mask"].sum() == 100 and not seen["keypoints"][100:].any()
    np.testing.assert_allclose(tokens["x"][:100], xy[:, 0] / 160, atol=1e-6)
    np.testing.assert_allclose(tokens["y"][:100], xy[:, 1] / 120, atol=1e-6)
    np.testing.assert_allclose(tokens["depth"][:100], 1.3 / 4.3, atol=1e-6)
    assert (tokens["static"][:100] == keep).all() and 0 < tokens["masked"].sum() < 40
    many = np.random.default_rng(0).uniform(0, 119, (1000, 2)).astype(np.float32)
    track = ToyTracker.track
    monkeypatch.setattr(
        ToyTracker, "track", lambda self, frame: replace(track(self, frame), keypoints_xy=many, keypoints_keep=None)
    )
    env = SlamEnv(ToySequence(4), replace(SPEC, entry_point="envs_toys:ToyTracker"), observation=["keypoints"])
    seen, _ = env.reset(seed=0)
    assert seen["keypoints_mask"].all()
    np.testing.assert_allclose(seen["keypoints"][[0, -1], 0], many[[0, -1], 0] / 160, atol=1e-6)


def test_the_gray_image_is_that_of_the_frame() -> None:
    env = SlamEnv(ToySequence(4), TARGET, observation=["gray"])
    seen, _ = env.reset(seed=0)
    assert seen["gray"].shape == (60, 80, 1) and seen["gray"].dtype == np.uint8
    weights = np.array([0.299, 0.587, 0.114])
    blocks = (env.frame.rgb @ weights).reshape(60, 2, 80, 2).mean(axis=(1, 3))
    assert np.abs(seen["gray"][..., 0] - blocks).max() <= 1.5


def test_the_truth_is_in_its_own_key_alone() -> None:
    envs = [SlamEnv(ToySequence(8, has_truth=truth), TARGET, observation=PARTS) for truth in (True, False)]
    seen = [env.reset(seed=4)[0] for env in envs]
    names = [name for name, _ in PRIVILEGED_LAYOUT]
    for _ in range(7):
        for key in set(seen[0]) - {"privileged"}:
            assert seen[0][key].tobytes() == seen[1][key].tobytes()
        steps = [env.step(0) for env in envs]
        seen, info = [step[0] for step in steps], steps[0][4]
        assert not seen[1]["privileged"].any()
        told = dict(zip(names, seen[0]["privileged"].tolist(), strict=True))
        error = info["pose_error_trans_m"]
        assert told["known"] == 1 and told["pose_error_trans"] == pytest.approx(error / (1 + error), abs=1e-6)
        assert told["frame_error_trans"] == pytest.approx(np.tanh(info["frame_error_trans_m"] / 0.1), abs=1e-6)
        assert told["motion_x"] == pytest.approx(np.tanh(0.1), abs=1e-3)


def test_unknown_parts_are_named() -> None:
    with pytest.raises(SettingsError, match=r"unknown observation 'colour'.*keypoints"):
        SlamEnv(ToySequence(8), TARGET, observation=["stats", "colour"])


def test_stable_baselines3_takes_choices_and_parts() -> None:
    checks = pytest.importorskip("stable_baselines3.common.env_checker", reason="the extra [rl] is not installed")
    env = SlamEnv(
        ToySequence(8), TARGET, control=["noise.passes"], window=5, observation=["stats", "gray", "privileged"]
    )
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        checks.check_env(DiscreteActions(env, [{}, {"noise.passes": 3}]))
