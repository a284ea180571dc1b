"""Actions, observations and pictures of an environment, and the benchmarks of control."""

import copy
import pickle
from collections import Counter
from dataclasses import replace
from typing import Any, Literal

import cv2
import gymnasium as gym
import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec
from helpers.envs_play import checked, checked_by_stable_baselines3
from helpers.envs_toys import CAMERA, TARGET, ToySequence, images
from helpers.sequence_folders import SHARED, needs_shared

from dynslam_bench.contracts import Frame, TrackResult
from dynslam_bench.core.errors import DynslamError, SettingsError
from dynslam_bench.core.settings import Settings, online_parameters, tunable
from dynslam_bench.envs import (
    CONTROL_BENCHMARKS,
    STATS_LAYOUT,
    ActionMap,
    FrameOutcome,
    SlamEnv,
    control_benchmark,
)
from dynslam_bench.envs.rendering import (
    ALIGN_FROM,
    CULLED,
    ESTIMATE,
    HEIGHT,
    KEPT,
    LEGEND,
    MASK,
    STRIP,
    TRUTH,
    VIEWS,
    align_to_truth,
    main_view,
    shortened,
)
from dynslam_bench.envs.spaces import MAX_DEPTH_M, stats_observation, stats_space
from dynslam_bench.evaluation.online import OnlineError
from dynslam_bench.geometry import se3
from dynslam_bench.sequences import open_sequence
from dynslam_bench.sequences.synthetic.families import Ramp
from dynslam_bench.trackers.registry import all_specs


class Group(Settings):
    linear: float = tunable(1.0, low=0.0, high=4.0, online=True, meaning="x")
    log: float = tunable(1.0, low=0.01, high=100.0, scale="log", online=True, meaning="x")
    count: int = tunable(3, low=1, high=5, online=True, meaning="x")
    log_count: int = tunable(8, low=1, high=64, scale="log", online=True, meaning="x")
    flag: bool = tunable(False, online=True, meaning="x")
    kind: Literal["a", "b", "c"] = tunable("b", online=True, meaning="x")


class Root(Settings):
    group: Group = Group()


NAMES = [f"group.{name}" for name in ("linear", "log", "count", "log_count", "flag", "kind")]


def test_ends_and_middle_of_every_axis() -> None:
    actions = ActionMap(Root(), NAMES)
    assert list(actions.values(-np.ones(6)).values()) == [0.0, 0.01, 1, 1, False, "a"]
    assert list(actions.values(np.zeros(6)).values()) == [2.0, pytest.approx(1.0), 3, 8, True, "b"]
    assert list(actions.values(np.ones(6)).values()) == [4.0, 100.0, 5, 64, True, "c"]
    assert list(actions.values(np.full(6, 9.0)).values()) == list(
        actions.values(np.ones(6)).values()
    )
    assert [type(value) for value in actions.values(np.full(6, 0.3)).values()] == [
        float,
        float,
        int,
        int,
        bool,
        str,
    ]


def test_encoding_is_the_inverse() -> None:
    actions = ActionMap(Root(), NAMES)
    rng = np.random.default_rng(0)
    for _ in range(100):
        settings = actions.settings(rng.uniform(-1, 1, 6)).group.model_dump()
        again = actions.settings(actions.encode(Root(group=settings))).group.model_dump()
        floats = [[values.pop(name) for name in ("linear", "log")] for values in (settings, again)]
        assert again == settings
        assert floats[1] == pytest.approx(floats[0], rel=1e-6, abs=1e-6)


def test_the_neutral_action_is_the_settings_bit_for_bit() -> None:
    rng = np.random.default_rng(0)
    for _ in range(300):
        settings = Root(
            group=Group(
                linear=rng.uniform(0, 4), log=10 ** rng.uniform(-2, 2), count=int(rng.integers(1, 6)),
                log_count=int(rng.integers(1, 65)), flag=bool(rng.integers(2)), kind=rng.choice(list("abc")).item(),
            )
        )  # fmt: skip
        actions = ActionMap(settings, NAMES)
        assert actions.settings(actions.neutral) == settings
        assert actions.settings(actions.neutral.astype(np.float64)) == settings
        moved = actions.neutral
        # one coordinate: the others stay exactly as they are
        moved[0] = 1.0 if moved[0] < 0 else -1.0
        changed = actions.settings(moved)
        assert changed.group.linear in (0.0, 4.0)
        assert changed.group.model_copy(update={"linear": settings.group.linear}) == settings.group


def test_every_neutral_action_of_every_tracker_is_its_default() -> None:
    count = 0
    for spec in all_specs():
        names = [parameter.name for parameter in online_parameters(spec.settings())]
        actions = ActionMap(spec.settings(), names)
        assert (
            actions.settings(actions.neutral) == spec.settings()
            if names
            else not actions.parameters
        )
        count += len(names)
    assert count > 500


class Wide(Settings):
    enabled: bool = tunable(True, meaning="x")
    value: float = tunable(1.0, low=0.2, high=10.0, limits=(0.0, 1e4), online=True, meaning="x")


def test_what_an_action_could_not_keep_or_would_not_change_is_refused() -> None:
    with pytest.raises(SettingsError, match=r"'value' in control is 1000, actions span 0.2 to 10"):
        ActionMap(Wide(value=1000.0), ["value"])
    with pytest.raises(
        SettingsError, match="'value' in control has no effect: Wide is not enabled"
    ):
        ActionMap(Wide(enabled=False), ["value"])


def test_every_choice_has_an_equal_share() -> None:
    actions = ActionMap(Root(), ["group.kind"])
    chosen = [actions.values([a])["group.kind"] for a in np.linspace(-1, 1, 3001)]
    assert all(abs(chosen.count(kind) - 1000) <= 2 for kind in "abc")


@pytest.mark.slow
def test_an_action_is_in_force_from_its_frame_on_and_reset_undoes_it() -> None:
    env = SlamEnv(ToySequence(12), TARGET, control=["noise.enabled", "noise.level_m"])
    off = np.array([-1.0, 0.0])
    loud = np.array([1.0, 1.0])
    env.reset(seed=0)
    errors = [env.step(action)[4]["frame_error_trans_m"] for action in (off, off, loud, off, off)]
    assert errors[0] < 0.01
    assert min(errors[2:4]) > 0.02
    assert [errors[1], errors[4]] == pytest.approx([0, 0], abs=1e-12)
    first, _ = env.reset(seed=0)
    fresh, _ = SlamEnv(ToySequence(12), TARGET, control=["noise.enabled", "noise.level_m"]).reset(
        seed=0
    )
    assert first.tobytes() == fresh.tobytes()


@pytest.mark.parametrize(
    ("control", "action"),
    [((), action) for action in ("x", None, 1, -1, 0.0, [0], np.array([0]), {})]
    + [
        (("noise.level_m",), action)
        for action in ("x", None, [None], {}, ["a"], object(), [0, 0], [np.nan])
    ],
)
def test_what_is_no_action_is_refused_and_nothing_is_tracked(
    control: tuple[str, ...], action: object
) -> None:
    env = SlamEnv(ToySequence(4), TARGET, control=control)
    env.reset(seed=0)
    with pytest.raises(SettingsError, match="action"):
        env.step(action)
    assert env.episode.next_index == 1
    env.step(env.neutral_action)
    assert env.episode.next_index == 2


FRAME = Frame(3, 1.0, *images(3))


def observe(
    result: TrackResult, frame: Frame = FRAME, motion: np.ndarray | None = None
) -> dict[str, float]:
    twist = np.zeros(6) if motion is None else se3.log(motion)
    vector = stats_observation(frame, result, progress=0.5, lost_streak=0, motion=twist)
    assert vector in stats_space()
    assert np.isfinite(vector).all()
    return dict(zip((name for name, _ in STATS_LAYOUT), vector.tolist(), strict=True))


def test_every_entry_means_what_is_documented() -> None:
    stats = {
        "keypoints": 1000.0, "culled": 250.0, "matches": 300.0, "inliers": 150.0, "residual_px": 1.0,
        "mask_fraction": 0.25, "map_points": 5000.0, "keyframes": 100.0, "keyframe": 1.0,
    }  # fmt: skip
    entries = observe(
        TrackResult(np.eye(4), "ok", stats), motion=se3.exp(np.array([0.1, 0, -0.1, 0, 0.1, 0]))
    )
    brightness, contrast, motion_rx = (
        entries.pop(name) for name in ("brightness", "contrast", "motion_rx")
    )
    assert brightness == pytest.approx(FRAME.rgb.mean() / 255, abs=0.03)
    assert contrast > 0
    expected = dict.fromkeys(entries, 0.0) | {
        "ok": 1, "progress": 0.5, "keypoints": 0.5, "culled": 0.25, "matches": 0.4, "inliers": 0.5, "residual": 0.5,
        "mask_fraction": 0.25, "map_points": 0.5, "keyframes": 0.5, "keyframe": 1, "motion_x": np.tanh(1),
        "motion_z": -np.tanh(1), "motion_ry": np.tanh(1), "depth_valid": 1, "depth_median": 1.3 / 4.3,
    }  # fmt: skip
    assert entries == pytest.approx(expected, abs=1e-6)
    assert motion_rx == pytest.approx(0, abs=1e-9)


def test_nothing_reported_and_nonsense_reported_stay_in_bounds() -> None:
    assert observe(TrackResult(None, "lost"))["lost"] == 1
    wild = {
        "keypoints": np.inf,
        "culled": -5.0,
        "matches": 1e30,
        "inliers": np.nan,
        "mask_fraction": 7.0,
    }
    observe(TrackResult(np.eye(4), "ok", wild), motion=se3.exp(np.array([1e6, 0, 0, 3, 0, 0])))
    black = replace(FRAME, rgb=np.zeros_like(FRAME.rgb), depth=np.zeros_like(FRAME.depth))
    entries = observe(TrackResult(None, "initialising"), black)
    assert (
        entries["brightness"]
        == entries["contrast"]
        == entries["depth_valid"]
        == entries["depth_median"]
        == 0
    )


def test_rgbd_holds_copies_of_the_images() -> None:
    env = SlamEnv(ToySequence(4), TARGET, observation="rgbd")
    seen, _ = env.reset(seed=0)
    assert seen["rgb"].shape == (CAMERA.height, CAMERA.width, 3)
    assert seen["depth"].shape == seen["rgb"].shape[:2]
    assert (seen["rgb"] == images(0)[0]).all()
    assert (seen["depth"] == images(0)[1]).all()
    assert not np.shares_memory(seen["rgb"], env.frame.rgb)
    assert not np.shares_memory(seen["depth"], env.frame.depth)
    assert seen in env.observation_space
    assert env.observation_space["depth"].high.max() == MAX_DEPTH_M


# The paper's preprocessing is a group of the tracker's settings; the environment's frames follow
# it.


SEQUENCE = "synthetic/sitting_xyz?frames=4"


def test_frames_are_resized_and_the_intrinsics_with_them() -> None:
    env = SlamEnv(
        SEQUENCE, "orb-slam2", settings={"preprocessing.width": 320, "preprocessing.height": 240}
    )
    assert (env.sequence.camera.width, env.sequence.camera.height, env.sequence.camera.fx) == (
        320,
        240,
        535.4 / 2,
    )
    env.reset(seed=0)
    info = [env.step(0)[4] for _ in range(3)][-1]
    assert info["tracking_state"] == "ok"
    assert info["pose_error_trans_m"] < 0.05


def test_a_reset_may_change_it() -> None:
    env = SlamEnv(SEQUENCE, "orb-slam2")
    plain = env.sequence[1].rgb
    env.reset(seed=0, options={"settings": {"preprocessing.normalisation": "equalise"}})
    assert np.abs(env.sequence[1].rgb.astype(int) - plain).mean() > 2


# The rendered picture.


def pixels(image: np.ndarray, colour: tuple[int, int, int]) -> int:
    return int((image == np.array(colour, np.uint8)).all(axis=2).sum())


def rendered(steps: int = 11, **kwargs) -> np.ndarray:
    env = SlamEnv(
        kwargs.pop("sequence", ToySequence(12)), TARGET, render_mode="rgb_array", **kwargs
    )
    env.reset(seed=0)
    for _ in range(steps):
        env.step(0)
    image = env.render()
    assert image is not None
    assert image.dtype == np.uint8
    return image


def test_size_is_even_and_the_same_for_every_frame() -> None:
    assert {rendered(steps).shape for steps in (0, 1, 11)} == {(HEIGHT + STRIP, 640 + HEIGHT, 3)}
    assert (HEIGHT + STRIP) % 2 == 0


def test_kept_and_culled_features_and_the_mask_are_drawn_in_their_colours() -> None:
    picture = rendered()[:HEIGHT, :640]
    assert pixels(picture, KEPT) > pixels(picture, CULLED) > 50
    orange = np.abs(picture[240, 160:200].astype(float).mean(axis=0) - MASK)
    assert orange.sum() < np.abs(picture[240, 500:600].astype(float).mean(axis=0) - MASK).sum()


def test_estimate_and_truth_are_drawn_from_above() -> None:
    plot = rendered()[:HEIGHT, 640:]
    assert pixels(plot, ESTIMATE) > 200
    assert pixels(plot, TRUTH) > 20
    columns = np.argwhere((plot == np.array(ESTIMATE, np.uint8)).all(axis=2))[:, 1]
    # the toy camera walks to the right, which fills the plot
    assert columns.max() - columns.min() > 300


def test_no_ground_truth_and_lost_frames_are_no_trouble() -> None:
    rendered(sequence=ToySequence(12, has_truth=False))
    rendered(settings={"mode": "lost", "at": 3, "until": 6})
    rendered(settings={"mode": "initialising", "at": 0})


def test_the_path_is_seen_in_the_view_in_which_it_spreads_most() -> None:
    along = np.linspace(0, 1, 50)[:, None]
    flat = {
        (1, 0.1, 0.5): "from above",
        (1, 0.5, 0.1): "from behind",
        (0.1, 0.5, 1): "from the side",
    }
    for spread, name in flat.items():
        assert main_view(np.sin(along * [5, 9, 13]) * spread).startswith(name)
    assert main_view(np.zeros((0, 3))) == main_view(along * [1, 0, 0]) == next(iter(VIEWS))
    assert (VIEWS[main_view(np.zeros((1, 3)))] @ [1.0, 2.0, 3.0]).tolist() == [1.0, 3.0]


def test_the_error_in_the_picture_is_the_protocols() -> None:
    env = SlamEnv(ToySequence(45), TARGET, render_mode="rgb_array")
    env.reset(seed=0)
    online = OnlineError(env.sequence.ground_truth)
    stamps = env.sequence.timestamps
    truth = {index: online.truth_at(float(stamp)) for index, stamp in enumerate(stamps)}
    for index in range(45):
        if index:
            env.step(0)
        ate_m = align_to_truth(env.episode, truth)[2]
        assert (ate_m is None) == (index + 1 < ALIGN_FROM)
    assert ate_m == pytest.approx(env.episode_metrics()["ate_rmse_m"], rel=1e-6)


def test_render_without_reset_or_mode() -> None:
    with pytest.raises(DynslamError):
        SlamEnv(ToySequence(12), TARGET, render_mode="rgb_array").render()
    env = SlamEnv(ToySequence(12), TARGET)
    with pytest.warns(UserWarning, match="without a render mode"):
        assert env.render() is None


# The benchmarks of control: what they are made of, and that their scenes change within an episode.

BENCHMARKS = sorted(CONTROL_BENCHMARKS)


def short(id: str) -> Any:
    """The benchmark with episodes of eight frames."""
    return replace(control_benchmark(id), frames=(0, 16))


def played(env: gym.Env, seed: int) -> list[float]:
    """Rewards of an episode of random actions."""
    env.action_space.seed(seed)
    env.reset(seed=seed)
    rewards = []
    while not env.unwrapped.episode.over:
        rewards.append(float(env.step(env.action_space.sample())[1]))
    return rewards


@pytest.mark.slow
@pytest.mark.parametrize("id", BENCHMARKS)
def test_it_passes_the_checkers(id: str) -> None:
    def make() -> gym.Env:
        return gym.make(
            f"dynslam/{id}", split="test", index=0, frames=[0, 16], render_mode="rgb_array"
        )

    checked(make())
    checked_by_stable_baselines3(make())


@pytest.mark.slow
def test_every_episode_draws_a_sequence_and_repeats_to_the_bit() -> None:
    first, again, other = (short("features-v0").make("train", range(2)) for _ in range(3))
    assert played(first, 5) == played(again, 5) != played(other, 6)
    assert len(played(first, 5)) == 7


@pytest.mark.slow
@pytest.mark.parametrize("id", BENCHMARKS)
def test_it_is_made_again_from_its_json(id: str) -> None:
    env = gym.make(f"dynslam/{id}", split="test", index=3, frames=[0, 16])
    duplicate = gym.make(EnvSpec.from_json(env.spec.to_json()))
    assert duplicate.unwrapped.sequence.id.startswith(control_benchmark(id).test[3])
    assert duplicate.action_space == env.action_space
    pickled = pickle.loads(pickle.dumps(env))
    copied = copy.deepcopy(env)
    assert played(duplicate, 1) == played(env, 1) == played(pickled, 1) == played(copied, 1)


@pytest.mark.parametrize("id", BENCHMARKS)
def test_training_and_test_scenes_are_of_their_splits(id: str) -> None:
    benchmark = control_benchmark(id)
    for split, sequences in (("tune", benchmark.train), ("held-out", benchmark.test)):
        assert {open_sequence(name).split for name in sequences} == {split}
        parts = [name.split("?scene=") for name in sequences]
        counts = Counter((family, int(scene) % 2) for family, scene in parts)
        assert len(counts) % 2 == 0, "as many changes either way"
        assert max(counts.values()) - min(counts.values()) <= 1, "as many changes either way"
    assert not set(benchmark.train) & set(benchmark.test)


def test_the_first_action_is_the_default() -> None:
    env = short("masks-v0").make("test", 0)
    assert np.array_equal(env.action(0), env.unwrapped.neutral_action)


@pytest.mark.slow
def test_a_call_of_the_network_and_keypoints_cost_their_weight() -> None:
    cases = (
        ("masks-v0", "segmented", 1.0),
        ("features-v0", "keypoints", 1000.0),
        ("budget-v0", "keypoints", 1000.0),
    )
    for id, stat, unit in cases:
        benchmark = short(id)
        free = replace(benchmark, reward=replace(benchmark.reward, weight=0.0))
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
    charges = [reward.charge(replace(outcome, index=index)) for index in range(120)]
    assert charges[0] == 0.0005
    assert charges[-1] == pytest.approx(0.0025)
    assert np.mean(charges) == pytest.approx(0.0015)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (
            lambda: control_benchmark("mask-v0"),
            r"unknown control benchmark 'mask-v0'.*masks-v0, features-v0",
        ),
        (
            lambda: gym.make("dynslam/masks-v0", split="tset"),
            "no split 'tset'.*train, test, recordings",
        ),
        (lambda: control_benchmark("masks-v0").make("test", 12), "no sequence 12.*0 to 11"),
        (lambda: control_benchmark("masks-v0").make("test", []), "no sequence .*0 to 11"),
        (lambda: control_benchmark("masks-v0").make("test", "3"), "no sequence '3'.*0 to 11"),
    ],
)
def test_what_is_not_there(call: Any, words: str) -> None:
    with pytest.raises(SettingsError, match=words):
        call()


@pytest.mark.slow
@needs_shared
@pytest.mark.parametrize(
    ("id", "settings"), [("masks-v0", {"segmentation.source": "embedded"}), ("features-v0", {})]
)
def test_recordings_can_be_stepped(id: str, settings: dict[str, Any]) -> None:
    benchmark = short(id)
    for index in range(len(benchmark.recordings)):
        env = benchmark.make(
            "recordings", index, data_root=SHARED / "data", settings=benchmark.settings | settings
        )
        assert np.isfinite(played(env, 0)).all()


# The scenes change.


@pytest.mark.slow
@pytest.mark.parametrize("scene", [0, 1, 100, 101])
def test_people_come_in_even_scenes_and_leave_in_odd_ones(scene: int) -> None:
    sequence = open_sequence(f"synthetic/changing_crowd?scene={scene}")
    begin, end = (
        [float((sequence.masks[index].instances > 0).mean()) for index in frames]
        for frames in (range(0, 84, 12), range(192, 240, 12))
    )
    empty, full = (begin, end) if scene % 2 == 0 else (end[-1:], begin)
    assert max(empty) < 0.02
    assert max(full) > 0.2


@pytest.mark.parametrize("scene", [0, 1, 100, 101])
def test_the_camera_speeds_up_and_slows_down(scene: int) -> None:
    poses = open_sequence(f"synthetic/changing_tempo?scene={scene}").ground_truth.T_world_cam
    speed = np.linalg.norm(se3.log(se3.inverse(poses[:-1]) @ poses[1:])[:, :3], axis=1) * 30
    slow, fast = (np.median(part) for part in (speed[:85], speed[180:])[:: -1 if scene % 2 else 1])
    assert slow < 0.25
    assert fast > 3 * slow


@pytest.mark.slow
@pytest.mark.parametrize("scene", [0, 1, 100, 101])
def test_the_light_fades_and_returns(scene: int) -> None:
    sequence = open_sequence(f"synthetic/changing_light?scene={scene}")
    bright, dark = (
        float(sequence[index].rgb.mean()) for index in (10, 230)[:: -1 if scene % 2 else 1]
    )
    assert bright > 60
    assert dark < 0.2 * bright


def test_a_ramp_and_its_integral_agree() -> None:
    ramp = Ramp(3.2, 0.4, 2.0)
    times = np.linspace(0.0, 9.0, 90_001)
    levels = np.array([ramp.level(float(time)) for time in times])
    assert levels[0] == 0.4
    assert levels[-1] == 2.0
    assert (np.diff(levels) >= 0).all()
    np.testing.assert_allclose(
        ramp.integral(times)[1:], np.cumsum((levels[1:] + levels[:-1]) / 2 * 1e-4), atol=1e-8
    )


@pytest.mark.parametrize(
    "label", ["orb-slam2", "emfoa-oft-paper?flow=sparse&masks=none&depth=none" * 2]
)
@pytest.mark.parametrize("width", [320, 640, 960])
def test_a_title_never_reaches_the_legend(label, width):
    text = f"{label}  |  synthetic/walking_halfsphere?scene=100&frames=600&noise=3"
    room = width + HEIGHT - LEGEND - 20
    short = shortened(text, room, 0.5)
    assert cv2.getTextSize(short, cv2.FONT_HERSHEY_SIMPLEX, 0.5, 1)[0][0] <= room
    if short != text:
        start, end = short.split("...")
        assert text.startswith(start)
        assert text.endswith(end)
