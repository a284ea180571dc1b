"""What agents learn with: windows, copies of an episode, fixed infos, costs, choices and further observations."""

import copy
import pickle
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from envs_play import QUIET, checked, checked_by_stable_baselines3, play, rest, stepped
from envs_toys import FIXED, SPEC, TARGET, FixedTracker, ToySequence, ToyTracker, images, write_folder

import dynslam_bench.envs  # noqa: F401
from dynslam_bench.contracts.sequence import Frame
from dynslam_bench.contracts.tracker import TrackResult
from dynslam_bench.core.errors import DynslamError, SequenceError, SettingsError, TrackerError
from dynslam_bench.core.settings import online_parameters
from dynslam_bench.envs import (
    GENERIC_ID,
    KEYPOINT_LAYOUT,
    PRIVILEGED_LAYOUT,
    AccuracyMinusCost,
    Degradation,
    DegradeFrames,
    DiscreteActions,
    DropFrames,
    Episode,
    NegWindowError,
    RecordTimings,
    RecordTrajectory,
    SequenceSampler,
    SlamEnv,
    SmallImages,
)
from dynslam_bench.envs.episode import metric_names
from dynslam_bench.envs.spaces import MAX_DEPTH_M
from dynslam_bench.geometry.trajectory_files import read_tum
from dynslam_bench.testing import CornerSequence
from dynslam_bench.trackers.registry import TRACKERS, resolve_settings

PARTS = ["stats", "rgb", "depth", "gray", "keypoints", "privileged"]


def made(sequence: Any, tracker: str = TARGET, **arguments: Any) -> gym.Env:
    return gym.make(GENERIC_ID, sequence=sequence, tracker=tracker, render_mode="rgb_array", **arguments)


# Windows.


@pytest.mark.parametrize("sequence", [CornerSequence(14), "synthetic/sitting_xyz?frames=14"])
def test_a_window_is_the_episode_of_these_frames_alone(sequence: Any) -> None:
    rendered = isinstance(sequence, str)
    tracker, settings = ("mask-rcnn", {"segmentation.source": "oracle"}) if rendered else ("orb-slam2", {})
    env = SlamEnv(sequence, tracker, settings=settings)
    cut = SlamEnv(sequence, tracker, settings=settings, frames=(5, 11))
    env.reset(seed=1)
    rewards, infos, _ = play(env, seed=3, options={"window": (5, 11)})
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


@pytest.mark.parametrize("window", [(5, 13), "5:13", (3, 4), (12, 14), (4, 2), 5])
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


COPIED = "orb-slam2 emfoa-oft?masks=none never-move dynaslam-g opencv-odometry mask-rcnn mask-rcnn+async".split()


@pytest.mark.parametrize("tracker", COPIED)
def test_a_copied_and_a_restored_episode_go_on_to_the_bit(tracker: str) -> None:
    masked = tracker.startswith("mask-rcnn")
    sequence = "synthetic/walking_xyz?scene=0&frames=8" if masked else CornerSequence(8)
    tracker, _, beside = tracker.partition("+")
    settings = {"segmentation.source": "oracle"} if masked else {}
    settings |= {"segmentation.schedule": "async", "segmentation.latency_s": 0.06} if beside else {}
    env = stepped(SlamEnv(sequence, tracker, threads=2, settings=settings), 3)
    state, duplicate = env.clone_state(), copy.deepcopy(env)
    assert duplicate.sequence is env.sequence and duplicate.episode.next_index == 4
    first = rest(env)
    assert rest(duplicate) == first and len(first[0]) == 4
    finals = [each.final_trajectory() for each in (env, duplicate)]
    assert finals == [None, None] or np.array_equal(finals[0].T_world_cam, finals[1].T_world_cam)
    states = [state] if tracker == "opencv-odometry" else [state, pickle.loads(pickle.dumps(state))]
    for again in states:
        env.restore_state(again)
        assert env.episode.next_index == 4 and rest(env) == first
    following = env.reset()[0].tobytes()
    env.restore_state(state)
    assert rest(env) == first and env.reset()[0].tobytes() == following, "random numbers are restored, too"
    assert duplicate.reset()[0].tobytes() == following, "the seeds that follow are the same, too"


def test_what_fails_beside_tracking_on_the_last_frames_is_warned_of_when_the_environment_is_closed() -> None:
    class Broken:
        def segment(self, frame: Frame) -> None:
            raise ValueError(f"no masks of frame {frame.index}")

    settings = {"segmentation.source": "oracle", "segmentation.schedule": "async"}
    env = SlamEnv("synthetic/walking_xyz?scene=0&frames=3", "mask-rcnn", settings=settings)
    env.reset(seed=0)
    env._tracker._masks.segmenter = Broken()
    env.step(0)
    with pytest.warns(RuntimeWarning, match="no masks of frame 1"):
        env.close()


@pytest.mark.parametrize("tracker", ["emfoa-oft", "dynaslam", "ds-slam"])
def test_a_restored_tracker_takes_every_online_setting(tracker: str) -> None:
    settings = {"segmentation.source": "oracle"}
    online = online_parameters(resolve_settings(TRACKERS.get(tracker), settings))
    arguments = {"settings": settings, "control": [parameter.name for parameter in online]}
    env = SlamEnv("synthetic/walking_xyz?scene=0&frames=5", tracker, **arguments)
    env.reset(seed=0)
    state = env.clone_state()
    for value in (-1.0, 0.5):
        action = np.full(env.action_space.shape, value, np.float32)
        fresh = SlamEnv("synthetic/walking_xyz?scene=0&frames=5", tracker, **arguments)
        fresh.reset(seed=0)
        expected = rest(fresh, action)
        env.restore_state(state)
        assert rest(env, action) == expected
        env.reset(seed=0)
        assert rest(env, action) == expected


def test_networks_are_shared_by_copies() -> None:
    env = stepped(SlamEnv("synthetic/walking_xyz?scene=0&frames=4", "mask-rcnn"), 1)
    copied, own = (tracker._masks.segmenter.inner for tracker in (env.clone_state().parts["_tracker"], env._tracker))
    assert copied.network is own.network


def test_a_state_with_a_cached_network_can_be_pickled() -> None:
    env = stepped(SlamEnv("synthetic/walking_xyz?scene=0&frames=5", "mask-rcnn", cache=True), 2)
    state = pickle.loads(pickle.dumps(env.clone_state()))
    expected = rest(env)
    env.restore_state(state)
    assert rest(env) == expected


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


def test_a_state_of_another_sequence_tracker_settings_or_version_is_refused(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    state = stepped(SlamEnv(ToySequence(9), TARGET), 2).clone_state()
    for env, words in (
        (SlamEnv(ToySequence(10), TARGET), "of sequence 'toy/walk' .9 frames"),
        (SlamEnv(ToySequence(9), "never-move"), "of tracker 'toy'"),
        (SlamEnv(ToySequence(9), TARGET, control=["noise.clip"]), "of control"),
        (SlamEnv(ToySequence(9), TARGET, settings={"noise.passes": 3}), "of settings"),
        (SlamEnv(ToySequence(9), TARGET, reward="neg_pose_error"), "of reward neg_rpe"),
        (SlamEnv(ToySequence(9), TARGET, protocol="evo-as/v1"), "of protocol tum-rgbd/v1"),
        (SlamEnv(ToySequence(9), TARGET, lost_after=5), "of lost_after None"),
        (SlamEnv(ToySequence(18), TARGET, stride=2), "of sequence"),
        (SlamEnv(ToySequence(9), TARGET), "of version 0.0.1"),
    ):
        if "version" in words:
            state = replace(state, origin={**state.origin, "version": "0.0.1"})
        with pytest.raises(DynslamError, match=words):
            env.restore_state(state)
        assert len(play(env)[0]) >= 8
    with pytest.raises(DynslamError, match="before reset"):
        SlamEnv(ToySequence(9), TARGET).clone_state()


def test_external_programs_cannot_be_copied_and_stay_usable(tmp_path: Path) -> None:
    still = '{"state": "ok", "T_world_cam": [1,0,0,0,0,1,0,0,0,0,1,0,0,0,0,1]}'
    (tmp_path / "still.py").write_text(
        "import json, sys\n"
        "for line in sys.stdin:\n"
        "    request = json.loads(line)\n"
        f"    answer = {{'ok': True}} if request['op'] == 'reset' else json.loads('{still}')\n"
        "    print(json.dumps(answer | {key: request[key] for key in request if key == 'index'}), flush=True)\n"
    )
    env = stepped(SlamEnv(ToySequence(5), f"subprocess:{sys.executable} {tmp_path / 'still.py'}"), 1)
    for way in (env.clone_state, lambda: copy.deepcopy(env)):
        with pytest.raises(TrackerError, match="cannot be copied"):
            way()
    env.step(0)
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
        env = SlamEnv(sequence, TARGET, settings=settings, fixed_info=True)
        infos = play(env, seed=0)[1]
        plain = play(SlamEnv(sequence, TARGET, settings=settings), seed=0)[1]
        forms += [form(info) for info in infos]
        for info, usual in zip(infos, plain, strict=True):
            flags = {name: value for name, value in info.items() if name.startswith("has_")}
            assert len(flags) == 5 and all((name[4:] in usual) == value for name, value in flags.items())
            assert all(np.array_equal(info[name], usual[name]) for name in set(usual) - {"episode_metrics"})
            metrics = usual.get("episode_metrics", {})
            assert {name: info["episode_metrics"][name] for name in metrics} == metrics
            assert sum(info["episode_metrics"][f"has_{name}"] for name in metric_names(env.protocol)) == len(metrics)
    assert all(each == forms[0] for each in forms)


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
    name = random.reset(seed=0)[1]["sequence"]
    assert random.step(0)[4]["sequence"] == name, "Minari needs the same keys on every step"


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
    plain, infos, _ = play(SlamEnv(sequence, "mask-rcnn", settings=settings), seed=0)
    default, *_ = play(SlamEnv(sequence, "mask-rcnn", settings=settings, reward="accuracy_minus_cost"), seed=0)
    dear, *_ = play(SlamEnv(sequence, "mask-rcnn", settings=settings, reward=AccuracyMinusCost(weight=0.5)), seed=0)
    calls = np.array([info["stats"]["segmented"] for info in infos[1:]])
    assert calls.tolist() == [0, 0, 1, 0, 0, 1]
    np.testing.assert_allclose(default, plain - 0.001 * calls, atol=1e-15)
    np.testing.assert_allclose(dear, plain - 0.5 * calls, atol=1e-15)


def test_processor_time_is_the_other_cost() -> None:
    env = SlamEnv(ToySequence(6), TARGET, reward=AccuracyMinusCost(weight=2.0, cost="processor_s"))
    rewards, infos, _ = play(env)
    spent = [timing["processor"] for timing in env.timings[1:]]
    errors = [info["frame_error_trans_m"] for info in infos[1:]]
    np.testing.assert_allclose(rewards, -np.array(errors) - 2.0 * np.array(spent), atol=1e-15)


def test_the_windowed_error_is_the_relative_error_over_the_window() -> None:
    env = SlamEnv(ToySequence(12), TARGET, reward=NegWindowError(frames=4))
    rewards, *_ = play(env)
    estimate, true = env.online_trajectory().T_world_cam, env.sequence.ground_truth.T_world_cam
    for frame in range(1, 12):
        start = max(frame - 4, 0)
        moved, est = (np.linalg.inv(poses[start]) @ poses[frame] for poses in (true, estimate))
        error = np.linalg.norm((np.linalg.inv(moved) @ est)[:3, 3])
        assert rewards[frame - 1] == pytest.approx(-error, abs=1e-12)


def test_dropped_frames_do_not_end_a_row_of_lost_ones() -> None:
    env = DropFrames(SlamEnv(ToySequence(60), TARGET, settings={"mode": "lost", "at": 1}, lost_after=5), share=0.5)
    _, infos, ends = play(env)
    assert len(ends) == 5 and ends[-1] == (True, False) and infos[-1]["episode_metrics"]["coverage"] < 0.1


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
    rewards, *_ = play(SlamEnv(ToySequence(10), TARGET, settings=settings, reward=reward, lost_after=2))
    assert rewards == [0.5, 0.5, 0.5, -1.0, -1.0 - 4.0] and lengths == [*range(1, 11)]


# Choices.


@pytest.mark.parametrize(
    ("setting", "choices", "stat"),
    [
        ("segmentation.schedule", ("every_nth", "every"), "segmented"),
        ("backend.keyframes.schedule", ("none", "every"), "keyframe"),
    ],
)
def test_segment_now_and_keyframe_now_are_actions(setting: str, choices: tuple[str, str], stat: str) -> None:
    settings = {"segmentation.source": "oracle", "segmentation.n": 1000}
    inner = SlamEnv("synthetic/sitting_xyz?frames=9", "mask-rcnn", settings=settings, control=[setting])
    env = DiscreteActions(inner, [{setting: choice} for choice in choices])
    assert env.action_space == gym.spaces.Discrete(2)
    env.reset(seed=0)
    actions = [0, 1, 0, 0, 1, 1, 0, 0]
    assert [int(env.step(action)[4]["stats"][stat]) for action in actions] == actions


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
        ([], r"one an action, not \[\]"),
        ([None], r"one an action, not \[None\]"),
        ("ab", "one an action, not 'ab'"),
        ([{"noise.clip": 1.0}], "'noise.clip' is not in control"),
        ([{"noise.level_m": 7.0}], "noise.level_m"),
        ([{"noise.level_m": "x"}], "noise.level_m"),
    ],
)
def test_choices_that_are_none(actions: Any, words: str) -> None:
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
        checked(made(ToySequence(6), observation=parts))
    checked(made(ToySequence(6), TARGET.replace(":SPEC", ":FIXED"), observation=PARTS))


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


def test_stable_baselines3_takes_choices_and_parts() -> None:
    env = SlamEnv(
        ToySequence(8), TARGET, control=["noise.passes"], window=5, observation=["stats", "gray", "privileged"]
    )
    checked_by_stable_baselines3(DiscreteActions(env, [{}, {"noise.passes": 3}]))


def test_record_timings() -> None:
    env = RecordTimings(SlamEnv(ToySequence(6), TARGET))
    for info in (env.reset(seed=0)[1], *(env.step(0)[4] for _ in range(5))):
        assert info["timings"]["features"] == 0.001 and info["timings"]["total"] > 0
    assert env.summary()["features"] == {"median": 0.001, "p95": 0.001}


def test_record_trajectory(tmp_path) -> None:
    base = SlamEnv(ToySequence(6), TARGET, settings={"mode": "lost", "at": 2, "until": 4})
    env = RecordTrajectory(base, tmp_path / "run_{episode}.txt")
    for episode in range(2):
        play(env)
        written = read_tum(tmp_path / f"run_{episode}.txt")
        assert len(written) == 4
        assert np.allclose(written.T_world_cam, base.online_trajectory().T_world_cam, atol=1e-8)
    assert [path.name for path in env.written] == ["run_0.txt", "run_1.txt"]


@pytest.mark.parametrize(
    ("frame_time_s", "speed", "tracked"),
    [
        (0.9 / 30, 1.0, [*range(1, 11)]),
        (1.9 / 30, 1.0, [1, 3, 5, 7, 9, 10]),
        (0.9 / 30, 2.0, [1, 3, 5, 7, 9, 10]),
        (100.0, 1.0, [10]),  # slower than the whole sequence: it still gets the last frame
    ],
)
def test_a_busy_tracker_misses_frames(frame_time_s: float, speed: float, tracked: list[int]) -> None:
    env = DropFrames(SlamEnv(ToySequence(11), TARGET), frame_time_s=frame_time_s, speed=speed)
    _, infos, ends = play(env)
    assert [info["frame_index"] for info in infos[1:]] == tracked and env.dropped == 10 - len(tracked)
    assert ends[-1][1] and infos[-1]["episode_metrics"]["coverage"] == pytest.approx((1 + len(tracked)) / 11)


def test_dropped_frames_cost_the_error_of_not_moving() -> None:
    whole, *_ = play(SlamEnv(ToySequence(11), TARGET, settings=QUIET))
    dropping, *_ = play(DropFrames(SlamEnv(ToySequence(11), TARGET, settings=QUIET), frame_time_s=1.9 / 30))
    motion = np.hypot(0.01, 0.002)
    assert sum(whole) == pytest.approx(0, abs=1e-9)
    assert sum(dropping) == pytest.approx(-8 * motion, abs=1e-6)  # 4 dropped, 4 ways back


def test_random_drops_are_seeded_and_near_their_share() -> None:
    def seen(seed: int) -> list[int]:
        env = DropFrames(SlamEnv(ToySequence(200), TARGET), share=0.3, seed=seed)
        return [info["frame_index"] for info in play(env)[1][1:]]

    assert seen(1) == seen(1) != seen(2)
    assert 120 < len(seen(1)) < 160 and seen(1)[-1] == 199


def test_dropping_more_than_is_left() -> None:
    env = SlamEnv(ToySequence(5), TARGET)
    env.reset(seed=0)
    with pytest.raises(DynslamError, match="cannot drop 4 frames, 3 are left"):
        env.drop_frames(4)


@pytest.mark.parametrize("kind", ["lighting", "glare", "shadow", "blur", "noise"])
def test_degradation_grows_with_its_strength_and_repeats(kind: str) -> None:
    frame = Frame(7, 1.0, *images(7))
    changes = []
    for strength in (0.0, 0.3, 1.0):
        degraded = Degradation(**{kind: strength}, seed=3)(frame)
        assert degraded.rgb.dtype == np.uint8 and degraded.rgb.shape == frame.rgb.shape
        assert (Degradation(**{kind: strength}, seed=3)(frame).rgb == degraded.rgb).all()
        assert (degraded.depth == frame.depth).all()
        changes.append(float(np.abs(degraded.rgb.astype(float) - frame.rgb).mean()))
    assert changes[0] == 0 and 0 < changes[1] < changes[2]
    assert (Degradation(**{kind: 1.0}, seed=4)(frame).rgb != Degradation(**{kind: 1.0}, seed=3)(frame).rgb).any()


def test_what_each_degradation_does() -> None:
    gray = Frame(20, 1.0, np.full((120, 160, 3), 120, np.uint8), np.full((120, 160), 2.0, np.float32))
    dark = Degradation(lighting=1.0)(gray).rgb
    assert dark.mean() < 120
    shadow = Degradation(shadow=1.0)(gray).rgb[..., 0]
    assert shadow.min() == pytest.approx(0.15 * 120, abs=2) and shadow.max() == pytest.approx(120, abs=2)
    glare = Degradation(glare=1.0)(gray).rgb[..., 0]
    assert (glare == 255).any() and glare.min() >= 120
    noise = Degradation(noise=0.5)(gray).rgb.astype(float)
    assert noise.std() == pytest.approx(20, rel=0.05) and noise.mean() == pytest.approx(120, abs=0.5)
    depth = Degradation(depth_noise=1.0)(gray).depth
    assert (depth == 0).mean() == pytest.approx(0.3, abs=0.02)
    assert depth[depth > 0].std() == pytest.approx(0.08, rel=0.05)
    edge = Frame(20, 1.0, np.repeat(np.uint8([[[0]] * 80 + [[200]] * 80] * 120), 3, axis=2), gray.depth)
    blurred = Degradation(blur=1.0)(edge).rgb[60, :, 0].astype(int)
    assert ((blurred > 5) & (blurred < 195)).sum() > 3 and blurred[0] == 0 and blurred[-1] == 200


def test_degraded_frames_reach_the_tracker_and_the_observation() -> None:
    env = DegradeFrames(SlamEnv(ToySequence(5), TARGET, observation="rgbd"), noise=0.5, seed=1)
    seen, _ = env.reset(seed=0)
    assert (seen["rgb"] != images(0)[0]).mean() > 0.9
    assert (seen["rgb"] == env.unwrapped.frame.rgb).all()


@pytest.mark.parametrize(
    ("wrapper", "observation", "arguments"),
    [(DegradeFrames, "stats", {"blur": 1.5}), (DegradeFrames, "stats", {"noise": -0.1})]
    + [(DropFrames, "stats", arguments) for arguments in ({"speed": 0}, {"frame_time_s": -1}, {"share": 1.0})]
    + [(SequenceSampler, "stats", {"sequences": []})]
    + [(SmallImages, "stats", {"width": 80}), (SmallImages, "rgbd", {"width": 0})],
)
def test_arguments_outside_their_range_and_what_cannot_be_wrapped(
    wrapper: type, observation: str, arguments: dict
) -> None:
    with pytest.raises(SettingsError):
        wrapper(SlamEnv(ToySequence(5), TARGET, observation=observation), **arguments)


def test_sequence_sampler(toy_folder: str, tmp_path) -> None:
    other = str(write_folder(tmp_path / "other", 8))

    def drawn(mode: str, seed: int) -> list[str]:
        env = SequenceSampler(SlamEnv(toy_folder, TARGET), [toy_folder, other], mode=mode)
        return [env.reset(seed=seed if first else None)[1]["sequence"] for first in (True, *[False] * 7)]

    assert drawn("round_robin", 0) == [toy_folder, other] * 4
    assert drawn("random", 5) == drawn("random", 5) != drawn("random", 6) and set(drawn("random", 5)) == {
        toy_folder,
        other,
    }


class Compiles(FixedTracker):
    """Takes long over the first frames that it ever sees, as what compiles its kernels does."""

    slow_frames = 0
    resets = 0

    def reset(self, camera, *, rng):
        super().reset(camera, rng=rng)
        type(self).resets += 1
        self.drawn = rng.random()

    def track(self, frame):
        if type(self).slow_frames < 3:
            type(self).slow_frames += 1
            time.sleep(0.4)
        return super().track(frame)


def test_compiling_is_no_work_of_a_frame(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Compiles, "slow_frames", 0)
    monkeypatch.setattr(Compiles, "resets", 0)
    spec = replace(FIXED, entry_point=f"{__name__}:Compiles")
    env = DropFrames(SlamEnv(ToySequence(20), spec), speed=0.5)
    play(env)
    assert Compiles.slow_frames == 3 and env.dropped == 0 and Compiles.resets == 2
    play(env)
    assert Compiles.resets == 3  # it is warm


def test_a_live_episode_takes_as_long_as_the_recording() -> None:
    env = DropFrames(SlamEnv(ToySequence(12), TARGET))
    env.reset(seed=0)
    start = time.perf_counter()
    for _ in range(11):
        env.step(0)
    assert time.perf_counter() - start > 10 / 30 and env.dropped == 0


def test_warming_up_leaves_the_random_numbers_where_they_are() -> None:
    def drawn(env) -> list[float]:
        found = []
        for seed in (3, None, None):
            env.reset(seed=seed)
            found.append(env.unwrapped._tracker.drawn)  # the tracker's first random number has no public name
        return found

    def make() -> SlamEnv:
        return SlamEnv(ToySequence(4), replace(FIXED, entry_point=f"{__name__}:Compiles"))

    assert drawn(DropFrames(make())) == drawn(make())


# Small images for agents: what they show, and that stable-baselines3 has nothing to say about them.


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


def test_stable_baselines3_takes_it_without_a_word() -> None:
    env = SlamEnv(ToySequence(6), TARGET, observation="rgbd", control=["noise.level_m"])
    checked_by_stable_baselines3(SmallImages(env, width=40, height=36))
