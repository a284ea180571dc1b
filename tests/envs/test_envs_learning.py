"""What agents learn with: windows, copies of an episode, fixed infos, costs, choices and further observations."""

import copy
import pickle
import sys
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from helpers.envs_play import QUIET, checked, checked_by_stable_baselines3, play, rest, stepped
from helpers.envs_toys import (
    FIXED,
    SPEC,
    TARGET,
    FixedTracker,
    ToySequence,
    ToyTracker,
    images,
    write_folder,
)

import dynslam_bench.envs  # noqa: F401
from dynslam_bench.contracts import Frame, TrackResult
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

ORACLE = {"segmentation.source": "oracle"}
PARTS = ["stats", "rgb", "depth", "gray", "keypoints", "privileged"]


# Windows.


@pytest.mark.slow
@pytest.mark.parametrize("sequence", [CornerSequence(7), "synthetic/sitting_xyz?frames=7"])
def test_a_window_is_the_episode_of_these_frames_alone(sequence: Any) -> None:
    tracker, settings = ("mask-rcnn", ORACLE) if isinstance(sequence, str) else ("orb-slam2", {})
    env = SlamEnv(sequence, tracker, settings=settings)
    env.reset(seed=1)
    rewards, infos, _ = play(env, seed=3, options={"window": (2, 5)})
    assert rewards == play(SlamEnv(sequence, tracker, settings=settings, frames=(2, 5)), seed=3)[0]
    assert infos[0]["window"].tolist() == infos[-1]["window"].tolist() == [2, 5]
    assert infos[-1]["episode_metrics"]["frames"] == len(rewards) + 1 == 3
    assert len(play(env, seed=3)[0]) == 6, "the next episode has all frames again"


def test_random_windows_have_their_length_and_follow_the_seed() -> None:
    env = SlamEnv(ToySequence(30), TARGET, window=8)
    first, again, other = (
        [tuple(env.reset(seed=of)[1]["window"].tolist()) for of in (seed, *[None] * 20)]
        for seed in (1, 1, 2)
    )
    assert first == again != other
    assert len(set(first)) > 8
    assert len(play(env)[0]) == 7
    assert {stop - start for start, stop in first} == {8}
    assert 0 <= min(first)[0]
    assert max(first)[1] <= 30


@pytest.mark.parametrize("window", [(5, 13), "5:13", (3, 4), (12, 14), (4, 2), 5])
def test_a_window_that_is_no_part_of_the_sequence(window: Any) -> None:
    env = SlamEnv(ToySequence(12), TARGET)
    with pytest.raises(SequenceError, match=r"12 frames here|no range"):
        env.reset(options={"window": window})
    assert len(play(env)[0]) == 11


def test_a_window_longer_than_the_sequence() -> None:
    with pytest.raises(
        SettingsError,
        match=r"window of 50 frames is longer than 'toy/walk', which has 12.*window=12",
    ):
        SlamEnv(ToySequence(12), TARGET, window=50)
    env = SlamEnv(ToySequence(12), TARGET, window=10)
    with pytest.raises(SettingsError, match="longer"):
        env.reset(options={"sequence": ToySequence(9)})
    assert len(play(env)[0]) == 9


# Copies of an episode.


COPIED = "orb-slam2 emfoa-oft?masks=none never-move dynaslam-g opencv-odometry mask-rcnn mask-rcnn+async".split()


@pytest.mark.slow
@pytest.mark.parametrize("tracker", COPIED)
def test_a_copied_and_a_restored_episode_go_on_to_the_bit(tracker: str) -> None:
    masked = tracker.startswith("mask-rcnn")
    tracker, _, beside = tracker.partition("+")
    settings = (ORACLE if masked else {}) | (
        {"segmentation.schedule": "async", "segmentation.latency_s": 0.06} if beside else {}
    )
    arguments = {
        "sequence": "synthetic/walking_xyz?scene=0&frames=5" if masked else CornerSequence(5), "tracker": tracker,
        "threads": 2, "settings": settings,
    }  # fmt: skip
    env = stepped(SlamEnv(**arguments), 2)
    state = env.clone_state()
    duplicate = copy.deepcopy(env)
    assert duplicate.sequence is env.sequence
    assert duplicate.episode.next_index == 3
    first = rest(env)
    assert rest(duplicate) == first
    assert len(first[0]) == 2
    finals = [one.final_trajectory() for one in (env, duplicate)]
    assert finals == [None, None] or np.array_equal(finals[0].T_world_cam, finals[1].T_world_cam)
    following = env.reset()[0].tobytes()
    env.restore_state(state)
    assert env.episode.next_index == 3
    assert rest(env) == first
    assert env.reset()[0].tobytes() == following, "random numbers are restored, too"
    assert duplicate.reset()[0].tobytes() == following, "the seeds that follow are the same, too"
    if tracker != "opencv-odometry":
        alike = SlamEnv(**arguments)
        alike.restore_state(pickle.loads(pickle.dumps(state)))
        assert rest(alike) == first


def test_what_fails_beside_tracking_on_the_last_frames_is_warned_of_when_the_environment_is_closed() -> (
    None
):
    def no_masks(frame: Frame) -> None:
        raise ValueError(f"no masks of frame {frame.index}")

    settings = ORACLE | {"segmentation.schedule": "async"}
    env = stepped(
        SlamEnv("synthetic/walking_xyz?scene=0&frames=3", "mask-rcnn", settings=settings), 0
    )
    env._tracker._mask_scheduler.segmenter = SimpleNamespace(segment=no_masks)
    env.step(0)
    with pytest.warns(RuntimeWarning, match="no masks of frame 1"):
        env.close()


@pytest.mark.slow
@pytest.mark.parametrize("tracker", ["emfoa-oft", "dynaslam", "ds-slam"])
def test_a_restored_tracker_takes_every_online_setting(tracker: str) -> None:
    online = online_parameters(resolve_settings(TRACKERS.get(tracker), ORACLE))
    arguments = {"settings": ORACLE, "control": [parameter.name for parameter in online]}
    env, fresh = (
        SlamEnv("synthetic/walking_xyz?scene=0&frames=4", tracker, **arguments) for _ in range(2)
    )
    env.reset(seed=0)
    state = env.clone_state()
    action = np.full(env.action_space.shape, -1.0, np.float32)
    fresh.reset(seed=0)
    expected = rest(fresh, action)
    env.restore_state(state)
    assert rest(env, action) == expected
    env.reset(seed=0)
    assert rest(env, action) == expected


@pytest.mark.slow
def test_a_state_with_a_cached_network_can_be_pickled_and_copies_share_the_network() -> None:
    env = stepped(SlamEnv("synthetic/walking_xyz?scene=0&frames=3", "mask-rcnn", cache=True), 1)
    state = env.clone_state()
    copied, own = (
        tracker._mask_scheduler.segmenter.inner
        for tracker in (state.parts["_tracker"], env._tracker)
    )
    assert copied.network is own.network
    expected = rest(env)
    env.restore_state(pickle.loads(pickle.dumps(state)))
    assert rest(env) == expected


def test_counterfactual_actions_differ_and_windows_come_back() -> None:
    env = SlamEnv(ToySequence(30), TARGET, control=["noise.level_m"], window=10)
    stepped(env, 3)
    state = env.clone_state()
    window = env.window
    loud = rest(env, np.ones(1))
    while env.window == window:
        env.reset()
    env.restore_state(state)
    quiet = rest(env, -np.ones(1))
    assert env.window == window
    assert len(loud[0]) == len(quiet[0]) == 6
    assert sum(quiet[0]) > sum(loud[0]) + 0.1


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


@pytest.mark.slow
def test_external_programs_cannot_be_copied_and_stay_usable(tmp_path: Path) -> None:
    still = '{"state": "ok", "T_world_cam": [1,0,0,0,0,1,0,0,0,0,1,0,0,0,0,1]}'
    (tmp_path / "still.py").write_text(
        "import json, sys\n"
        "for line in sys.stdin:\n"
        "    request = json.loads(line)\n"
        f"    answer = {{'ok': True}} if request['op'] == 'reset' else json.loads('{still}')\n"
        "    print(json.dumps(answer | {key: request[key] for key in request if key == 'index'}), flush=True)\n"
    )
    env = stepped(
        SlamEnv(ToySequence(5), f"subprocess:{sys.executable} {tmp_path / 'still.py'}"), 1
    )
    for way in (SlamEnv.clone_state, copy.deepcopy):
        with pytest.raises(TrackerError, match="cannot be copied"):
            way(env)
    env.step(0)
    env.close()


def test_the_clock_of_a_live_camera_is_part_of_the_state() -> None:
    env = stepped(DropFrames(SlamEnv(ToySequence(20), TARGET), frame_time_s=2.4 / 30), 2)
    state = env.unwrapped.clone_state()
    first = rest(env)
    env.unwrapped.restore_state(state)
    assert rest(env) == first
    assert 4 < len(first[0]) < 10


# Infos of fixed form.


def form(info: dict[str, Any]) -> dict[str, Any]:
    return {
        k: form(v) if isinstance(v, dict) else (type(v), np.shape(v))
        for k, v in sorted(info.items())
    }


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
            assert len(flags) == 5
            assert all((name[4:] in usual) == value for name, value in flags.items())
            assert all(
                np.array_equal(info[name], usual[name]) for name in set(usual) - {"episode_metrics"}
            )
            metrics = usual.get("episode_metrics", {})
            assert {name: info["episode_metrics"][name] for name in metrics} == metrics
            assert sum(
                info["episode_metrics"][f"has_{name}"] for name in metric_names(env.protocol)
            ) == len(metrics)
    assert all(one == forms[0] for one in forms)


# Vector environments.


def test_sub_environments_run_other_sequences(tmp_path: Path) -> None:
    folders = [str(write_folder(tmp_path / f"toy{length}", length)) for length in (5, 6, 7)]
    vector = gym.vector.SyncVectorEnv(
        [lambda: SequenceSampler(SlamEnv(folders[0], TARGET), folders)] * 3
    )
    orders = [vector.reset(seed=seed)[1]["sequence"].tolist() for seed in (4, None, None)]
    assert all(sorted(order) == sorted(folders) for order in orders)
    assert len({tuple(order) for order in orders}) == 3


@pytest.mark.slow
@pytest.mark.parametrize(("mode", "seeds"), [("round_robin", (0, 0, 1)), ("random", (5, 5, 6))])
def test_sequence_sampler(mode: str, seeds: tuple[int, ...], tmp_path: Path) -> None:
    folders = [str(write_folder(tmp_path / f"toy{length}", length)) for length in (5, 6)]
    env = SequenceSampler(SlamEnv(folders[0], TARGET), folders, mode=mode)
    first, again, other = (
        [env.reset(seed=of)[1]["sequence"] for of in (seed, *[None] * 7)] for seed in seeds
    )
    assert first == again != other
    assert set(first) == set(folders)
    assert mode == "random" or first == folders * 4
    assert env.step(0)[4]["sequence"] == other[-1], "Minari needs the same keys on every step"


@pytest.mark.parametrize("fixed", [False, True])
def test_vector_environments_take_every_part(fixed: bool) -> None:
    arguments = {
        "observation": PARTS,
        "window": 5,
        "control": ["noise.clip"],
        "reward": "accuracy_minus_cost",
    }
    vector = gym.vector.SyncVectorEnv(
        [lambda: SlamEnv(ToySequence(8), TARGET, fixed_info=fixed, **arguments)] * 2
    )
    observed, infos = vector.reset(seed=3)
    assert observed in vector.observation_space
    assert not (infos["window"][0] == infos["window"][1]).all()
    for _ in range(4):
        observed, rewards, *_ = vector.step(vector.action_space.sample())
        assert observed in vector.observation_space
        assert (rewards < 0).all()


# Rewards.


@pytest.mark.slow
def test_a_network_call_costs_its_weight() -> None:
    settings = ORACLE | {"segmentation.schedule": "every_nth", "segmentation.n": 2}
    (plain, infos, _), (default, *_), (dear, *_) = (
        play(
            SlamEnv("synthetic/sitting_xyz?frames=3", "mask-rcnn", settings=settings, reward=reward)
        )
        for reward in ("neg_rpe", "accuracy_minus_cost", AccuracyMinusCost(weight=0.5))
    )
    calls = np.array([info["stats"]["segmented"] for info in infos[1:]])
    assert calls.tolist() == [0, 1]
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
    estimate = env.online_trajectory().T_world_cam
    true = env.sequence.ground_truth.T_world_cam
    for frame in range(1, 12):
        start = max(frame - 4, 0)
        moved, est = (np.linalg.inv(poses[start]) @ poses[frame] for poses in (true, estimate))
        assert rewards[frame - 1] == pytest.approx(
            -np.linalg.norm((np.linalg.inv(moved) @ est)[:3, 3]), abs=1e-12
        )


def test_dropped_frames_do_not_end_a_row_of_lost_ones() -> None:
    env = DropFrames(
        SlamEnv(ToySequence(60), TARGET, settings={"mode": "lost", "at": 1}, lost_after=5),
        share=0.5,
    )
    _, infos, ends = play(env)
    assert len(ends) == 5
    assert ends[-1] == (True, False)
    assert infos[-1]["episode_metrics"]["coverage"] < 0.1


class Still(ToyTracker):
    """Repeats its pose from frame 4 on."""

    def track(self, frame: Frame) -> TrackResult:
        result = super().track(frame)
        self.kept = result.T_world_cam if frame.index < 4 else self.kept
        return TrackResult(self.kept, "ok")


@pytest.mark.parametrize("lost_after", [None, 3])
def test_under_the_windowed_error_a_loss_earns_what_standing_still_does(
    lost_after: int | None,
) -> None:
    arguments = {"settings": QUIET | {"mode": "lost", "at": 4}, "reward": "neg_window_error"}
    lost = play(SlamEnv(ToySequence(14), TARGET, lost_after=lost_after, **arguments))[0]
    spec = replace(SPEC, entry_point=f"{__name__}:Still")
    still = play(SlamEnv(ToySequence(14), spec, settings=QUIET, reward="neg_window_error"))[0]
    assert sum(lost) == pytest.approx(sum(still), abs=1e-12)
    assert sum(lost) < -0.1


def test_a_callable_earns_what_it_returns_and_sees_the_episode() -> None:
    lengths: list[int] = []

    def reward(episode: Episode) -> float:
        lengths.append(len(episode.outcomes))
        return 0.5 if episode.outcomes[-1].state == "ok" else -1.0

    settings = {"mode": "lost", "at": 4}
    rewards, *_ = play(
        SlamEnv(ToySequence(10), TARGET, settings=settings, reward=reward, lost_after=2)
    )
    assert rewards == [0.5, 0.5, 0.5, -1.0, -1.0 - 4.0]
    assert lengths == [*range(1, 11)]


# Choices.


@pytest.mark.parametrize(
    ("setting", "choices", "stat"),
    [
        ("segmentation.schedule", ("every_nth", "every"), "segmented"),
        ("backend.keyframes.schedule", ("none", "every"), "keyframe"),
    ],
)
def test_segment_now_and_keyframe_now_are_actions(
    setting: str, choices: tuple[str, str], stat: str
) -> None:
    settings = ORACLE | {"segmentation.n": 1000}
    actions = [0, 1, 1, 0, 1]
    inner = SlamEnv(
        "synthetic/sitting_xyz?frames=6", "mask-rcnn", settings=settings, control=[setting]
    )
    env = DiscreteActions(inner, [{setting: choice} for choice in choices])
    env.reset(seed=0)
    assert [int(env.step(action)[4]["stats"][stat]) for action in actions] == actions


def test_a_choice_leaves_what_it_does_not_name_and_no_other_is_taken() -> None:
    settings = {"noise.level_m": 0.0123}
    control = ["noise.level_m", "noise.passes"]
    base = SlamEnv(ToySequence(6), TARGET, control=control, settings=settings)
    env = DiscreteActions(base, [{}, {"noise.passes": 4}])
    assert env.action(0).tobytes() == base.neutral_action.tobytes()
    assert base._actions.values(env.action(1)) == {"noise.level_m": 0.0123, "noise.passes": 4}
    env.reset(seed=0)
    for action in (2, -1, 0.5, None):
        with pytest.raises(SettingsError, match="action"):
            env.step(action)


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


# Observations.


@pytest.mark.parametrize("parts", [*([part] for part in PARTS), PARTS])
def test_every_part_passes_the_checker_alone_and_together(parts: list[str]) -> None:
    for tracker in (TARGET, TARGET.replace(":SPEC", ":FIXED")):
        checked(
            gym.make(
                GENERIC_ID,
                sequence=ToySequence(6),
                tracker=tracker,
                observation=parts,
                render_mode="rgb_array",
            )
        )


def test_keypoints_are_padded_and_thinned_and_say_what_they_are(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    env = SlamEnv(ToySequence(4), TARGET, observation=["keypoints"])
    seen, _ = env.reset(seed=0)
    tokens = seen["keypoints"][:100]
    xy = env.result.keypoints_xy
    assert [name for name, _ in KEYPOINT_LAYOUT] == ["x", "y", "depth", "static", "masked"]
    assert seen["keypoints_mask"].sum() == 100
    assert not seen["keypoints"][100:].any()
    expected = np.column_stack(
        [xy / [160, 120], np.full(100, 1.3 / 4.3), env.result.keypoints_keep]
    )
    np.testing.assert_allclose(tokens[:, :4], expected, atol=1e-6)
    assert 0 < tokens[:, 4].sum() < 40
    many = np.random.default_rng(0).uniform(0, 119, (1000, 2)).astype(np.float32)
    track = ToyTracker.track
    monkeypatch.setattr(
        ToyTracker,
        "track",
        lambda self, frame: replace(track(self, frame), keypoints_xy=many, keypoints_keep=None),
    )
    env = SlamEnv(
        ToySequence(4),
        replace(SPEC, entry_point="helpers.envs_toys:ToyTracker"),
        observation=["keypoints"],
    )
    seen, _ = env.reset(seed=0)
    assert seen["keypoints_mask"].all()
    np.testing.assert_allclose(seen["keypoints"][[0, -1], 0], many[[0, -1], 0] / 160, atol=1e-6)


def test_the_gray_image_is_that_of_the_frame() -> None:
    env = SlamEnv(ToySequence(4), TARGET, observation=["gray"])
    seen, _ = env.reset(seed=0)
    assert seen["gray"].shape == (60, 80, 1)
    assert seen["gray"].dtype == np.uint8
    blocks = (
        (env.frame.rgb @ np.array([0.299, 0.587, 0.114])).reshape(60, 2, 80, 2).mean(axis=(1, 3))
    )
    assert np.abs(seen["gray"][..., 0] - blocks).max() <= 1.5


def test_the_truth_is_in_its_own_key_alone() -> None:
    envs = [
        SlamEnv(ToySequence(8, has_truth=truth), TARGET, observation=PARTS)
        for truth in (True, False)
    ]
    outcomes = [[env.reset(seed=4), *(env.step(0) for _ in range(7))] for env in envs]
    for number, ((seen, *_, info), (blind, *_)) in enumerate(zip(*outcomes, strict=True)):
        assert all(
            seen[key].tobytes() == blind[key].tobytes() for key in set(seen) - {"privileged"}
        )
        assert not blind["privileged"].any()
        names = (name for name, _ in PRIVILEGED_LAYOUT)
        error = info["pose_error_trans_m"]
        truth = dict(zip(names, seen["privileged"].tolist(), strict=True))
        assert truth["known"] == 1
        assert truth["pose_error_trans"] == pytest.approx(error / (1 + error), abs=1e-6)
        if number:
            assert truth["frame_error_trans"] == pytest.approx(
                np.tanh(info["frame_error_trans_m"] / 0.1), abs=1e-6
            )
            assert truth["motion_x"] == pytest.approx(np.tanh(0.1), abs=1e-3)


def test_stable_baselines3_takes_choices_parts_and_small_images_without_a_word() -> None:
    arguments = {"control": ["noise.passes"], "observation": ["stats", "gray", "privileged"]}
    parts = SlamEnv(ToySequence(8), TARGET, window=5, **arguments)
    checked_by_stable_baselines3(DiscreteActions(parts, [{}, {"noise.passes": 3}]))
    images = SlamEnv(ToySequence(6), TARGET, observation="rgbd", control=["noise.level_m"])
    checked_by_stable_baselines3(SmallImages(images, width=40, height=36))


def test_record_timings() -> None:
    env = RecordTimings(SlamEnv(ToySequence(6), TARGET))
    for info in (env.reset(seed=0)[1], *(env.step(0)[4] for _ in range(5))):
        assert info["timings"]["features"] == 0.001
        assert info["timings"]["total"] > 0
    assert env.summary()["features"] == {"median": 0.001, "p95": 0.001}


def test_record_trajectory(tmp_path: Path) -> None:
    base = SlamEnv(ToySequence(6), TARGET, settings={"mode": "lost", "at": 2, "until": 4})
    env = RecordTrajectory(base, tmp_path / "run_{episode}.txt")
    for episode in range(2):
        play(env)
        assert env.written[episode] == tmp_path / f"run_{episode}.txt"
        written = read_tum(env.written[episode])
        online = base.online_trajectory()
        assert len(written) == 4
        assert np.allclose(written.T_world_cam, online.T_world_cam, atol=1e-8)


@pytest.mark.parametrize(
    ("frame_time_s", "speed", "tracked"),
    [
        (0.9 / 30, 1.0, [*range(1, 11)]),
        (1.9 / 30, 1.0, [1, 3, 5, 7, 9, 10]),
        (0.9 / 30, 2.0, [1, 3, 5, 7, 9, 10]),
        (100.0, 1.0, [10]),  # slower than the whole sequence: it still gets the last frame
    ],
)
def test_a_busy_tracker_misses_frames(
    frame_time_s: float, speed: float, tracked: list[int]
) -> None:
    env = DropFrames(SlamEnv(ToySequence(11), TARGET), frame_time_s=frame_time_s, speed=speed)
    _, infos, ends = play(env)
    assert [info["frame_index"] for info in infos[1:]] == tracked
    assert env.dropped == 10 - len(tracked)
    assert ends[-1][1]
    assert infos[-1]["episode_metrics"]["coverage"] == pytest.approx((1 + len(tracked)) / 11)


def test_dropped_frames_cost_the_error_of_not_moving() -> None:
    whole, *_ = play(SlamEnv(ToySequence(11), TARGET, settings=QUIET))
    dropping, *_ = play(
        DropFrames(SlamEnv(ToySequence(11), TARGET, settings=QUIET), frame_time_s=1.9 / 30)
    )
    assert sum(whole) == pytest.approx(0, abs=1e-9)
    # 4 dropped, 4 ways back
    assert sum(dropping) == pytest.approx(-8 * np.hypot(0.01, 0.002), abs=1e-6)


def test_random_drops_are_seeded_and_near_their_share() -> None:
    first, again, other = (
        [
            info["frame_index"]
            for info in play(DropFrames(SlamEnv(ToySequence(100), TARGET), share=0.3, seed=seed))[1]
        ]
        for seed in (1, 1, 2)
    )
    assert first == again != other
    assert 58 < len(first) < 83
    assert first[-1] == 99


def test_dropping_more_than_is_left() -> None:
    env = SlamEnv(ToySequence(5), TARGET)
    env.reset(seed=0)
    with pytest.raises(DynslamError, match="cannot drop 4 frames, 3 are left"):
        env.drop_frames(4)


@pytest.mark.parametrize("kind", ["lighting", "glare", "shadow", "blur", "noise"])
def test_degradation_grows_with_its_strength_and_repeats(kind: str) -> None:
    frame = Frame(7, 1.0, *images(7))
    none, some, most, again, other = (
        Degradation(**{kind: strength}, seed=seed)(frame)
        for strength, seed in ((0.0, 3), (0.3, 3), (1.0, 3), (1.0, 3), (1.0, 4))
    )
    assert most.rgb.dtype == np.uint8
    assert (again.rgb == most.rgb).all()
    assert (other.rgb != most.rgb).any()
    assert (most.depth == frame.depth).all()
    assert (none.rgb == frame.rgb).all()
    less, more = (
        np.abs(degraded.rgb.astype(float) - frame.rgb).mean() for degraded in (some, most)
    )
    assert 0 < less < more


def test_what_each_degradation_does() -> None:
    gray = Frame(
        20, 1.0, np.full((120, 160, 3), 120, np.uint8), np.full((120, 160), 2.0, np.float32)
    )
    shadow, glare = (Degradation(**{kind: 1.0})(gray).rgb[..., 0] for kind in ("shadow", "glare"))
    assert Degradation(lighting=1.0)(gray).rgb.mean() < 120
    assert shadow.min() == pytest.approx(0.15 * 120, abs=2)
    assert shadow.max() == pytest.approx(120, abs=2)
    assert (glare == 255).any()
    assert glare.min() >= 120
    noise = Degradation(noise=0.5)(gray).rgb.astype(float)
    depth = Degradation(depth_noise=1.0)(gray).depth
    assert noise.std() == pytest.approx(20, rel=0.05)
    assert noise.mean() == pytest.approx(120, abs=0.5)
    assert (depth == 0).mean() == pytest.approx(0.3, abs=0.02)
    assert depth[depth > 0].std() == pytest.approx(0.08, rel=0.05)
    edge = Frame(
        20, 1.0, np.repeat(np.uint8([[[0]] * 80 + [[200]] * 80] * 120), 3, axis=2), gray.depth
    )
    blurred = Degradation(blur=1.0)(edge).rgb[60, :, 0].astype(int)
    assert ((blurred > 5) & (blurred < 195)).sum() > 3
    assert blurred[0] == 0
    assert blurred[-1] == 200


def test_degraded_frames_reach_the_tracker_and_the_observation() -> None:
    env = DegradeFrames(SlamEnv(ToySequence(5), TARGET, observation="rgbd"), noise=0.5, seed=1)
    seen, _ = env.reset(seed=0)
    assert (seen["rgb"] != images(0)[0]).mean() > 0.9
    assert (seen["rgb"] == env.unwrapped.frame.rgb).all()


@pytest.mark.parametrize(
    ("wrapper", "observation", "arguments"),
    [(DegradeFrames, "stats", {"blur": 1.5}), (DegradeFrames, "stats", {"noise": -0.1})]
    + [
        (DropFrames, "stats", arguments)
        for arguments in ({"speed": 0}, {"frame_time_s": -1}, {"share": 1.0})
    ]
    + [(SequenceSampler, "stats", {"sequences": []})]
    + [(SmallImages, "stats", {"width": 80}), (SmallImages, "rgbd", {"width": 0})],
)
def test_arguments_outside_their_range_and_what_cannot_be_wrapped(
    wrapper: type, observation: str, arguments: dict
) -> None:
    with pytest.raises(SettingsError):
        wrapper(SlamEnv(ToySequence(5), TARGET, observation=observation), **arguments)


class Stopwatch:
    """Tells environments how long tracking took, whatever else the machine does."""

    now_s = 0.0


@pytest.fixture
def stopwatch(monkeypatch: pytest.MonkeyPatch) -> None:
    """Trackers take the time by which they set the stopwatch forward."""
    clock = SimpleNamespace(perf_counter=lambda: Stopwatch.now_s, process_time=lambda: 0.0)
    monkeypatch.setattr("dynslam_bench.envs.slam_env.time", clock)


class Compiles(FixedTracker):
    """Takes long over the first frames that it ever sees, as what compiles its kernels does."""

    slow_frames = resets = 0

    def reset(self, camera, *, rng):
        super().reset(camera, rng=rng)
        type(self).resets += 1
        self.drawn = rng.random()

    def track(self, frame):
        if type(self).slow_frames < 3:
            type(self).slow_frames += 1
            Stopwatch.now_s += 0.2
        return super().track(frame)


COMPILES = replace(FIXED, entry_point=f"{__name__}:Compiles")


@pytest.mark.usefixtures("stopwatch")
def test_compiling_is_no_work_of_a_frame(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Compiles, "slow_frames", 0)
    monkeypatch.setattr(Compiles, "resets", 0)
    env = DropFrames(SlamEnv(ToySequence(7), COMPILES), speed=0.5)
    play(env)
    assert Compiles.slow_frames == 3
    assert env.dropped == 0
    assert Compiles.resets == 2
    play(env)
    assert Compiles.resets == 3  # it is warm


@pytest.mark.usefixtures("stopwatch")
def test_a_live_episode_takes_as_long_as_the_recording() -> None:
    env = DropFrames(SlamEnv(ToySequence(12), TARGET))
    env.reset(seed=0)
    start = time.perf_counter()
    assert len(rest(env)[0]) == 11
    assert time.perf_counter() - start > 10 / 30
    assert env.dropped == 0


def test_warming_up_leaves_the_random_numbers_where_they_are() -> None:
    drawn = []
    for env in (SlamEnv(ToySequence(4), COMPILES), DropFrames(SlamEnv(ToySequence(4), COMPILES))):
        for seed in (3, None, None):
            env.reset(seed=seed)
            # the tracker's first random number has no public name
            drawn.append(env.unwrapped._tracker.drawn)
    assert drawn[:3] == drawn[3:]


# Small images for agents.


def test_small_images_show_the_same_smaller() -> None:
    env = SmallImages(SlamEnv(ToySequence(4), TARGET, observation="rgbd"), width=40, height=36)
    seen, _ = env.reset(seed=0)
    assert seen in env.observation_space
    assert seen["rgb"].shape == (36, 40, 3)
    assert seen["depth"].shape == (36, 40, 1)
    assert abs(float(seen["rgb"].mean()) - float(env.unwrapped.frame.rgb.mean())) < 3


def test_depth_keeps_missing_apart_and_is_right_to_half_a_step() -> None:
    env = SmallImages(SlamEnv(ToySequence(4), TARGET, observation="rgbd"))
    depth = np.linspace(0, MAX_DEPTH_M, 4800, dtype=np.float32).reshape(60, 80)
    steps = env.observation({"rgb": np.zeros((60, 80, 3), np.uint8), "depth": depth})["depth"][
        ..., 0
    ].astype(float)
    assert (steps == 0).sum() == 1
    assert steps[0, 0] == 0
    assert steps[-1, -1] == 255
    metres = (steps - 1) * MAX_DEPTH_M / 254
    assert np.abs(metres - depth).ravel()[1:].max() <= 0.5 * MAX_DEPTH_M / 254 + 1e-6
