"""Actions and the settings they stand for."""

from dataclasses import replace
from typing import Literal

import numpy as np
import pytest
from envs_toys import CAMERA, TARGET, ToySequence, images

from dynslam_bench.contracts import Frame, TrackResult
from dynslam_bench.core.errors import DynslamError, SettingsError
from dynslam_bench.core.settings import Settings, online_parameters, tunable
from dynslam_bench.envs import STATS_LAYOUT, ActionMap, SlamEnv
from dynslam_bench.envs.rendering import (
    ALIGN_FROM,
    CULLED,
    ESTIMATE,
    HEIGHT,
    KEPT,
    MASK,
    STRIP,
    TRUTH,
    VIEWS,
    align_to_truth,
    main_view,
)
from dynslam_bench.envs.spaces import MAX_DEPTH_M, stats_observation, stats_space
from dynslam_bench.evaluation.online import OnlineError
from dynslam_bench.geometry import se3
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
    assert list(actions.values(np.full(6, 9.0)).values()) == list(actions.values(np.ones(6)).values())
    assert [type(value) for value in actions.values(np.full(6, 0.3)).values()] == [float, float, int, int, bool, str]


def test_encoding_is_the_inverse() -> None:
    actions, rng = ActionMap(Root(), NAMES), np.random.default_rng(0)
    for _ in range(100):
        settings = actions.settings(rng.uniform(-1, 1, 6)).group.model_dump()
        again = actions.settings(actions.encode(Root(group=settings))).group.model_dump()
        floats = [[values.pop(name) for name in ("linear", "log")] for values in (settings, again)]
        assert again == settings and floats[1] == pytest.approx(floats[0], rel=1e-6, abs=1e-6)


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
        moved[0] = 1.0 if moved[0] < 0 else -1.0  # one coordinate: the others stay exactly as they are
        changed = actions.settings(moved)
        assert changed.group.linear in (0.0, 4.0)
        assert changed.group.model_copy(update={"linear": settings.group.linear}) == settings.group


def test_every_neutral_action_of_every_tracker_is_its_default() -> None:
    count = 0
    for spec in all_specs():
        names = [parameter.name for parameter in online_parameters(spec.settings())]
        actions = ActionMap(spec.settings(), names)
        assert actions.settings(actions.neutral) == spec.settings() if names else not actions.parameters
        count += len(names)
    assert count > 500


class Wide(Settings):
    enabled: bool = tunable(True, meaning="x")
    value: float = tunable(1.0, low=0.2, high=10.0, limits=(0.0, 1e4), online=True, meaning="x")


def test_what_an_action_could_not_keep_or_would_not_change_is_refused() -> None:
    with pytest.raises(SettingsError, match=r"'value' in control is 1000, actions span 0.2 to 10"):
        ActionMap(Wide(value=1000.0), ["value"])
    with pytest.raises(SettingsError, match="'value' in control has no effect: Wide is not enabled"):
        ActionMap(Wide(enabled=False), ["value"])


def test_every_choice_has_an_equal_share() -> None:
    actions = ActionMap(Root(), ["group.kind"])
    chosen = [actions.values([a])["group.kind"] for a in np.linspace(-1, 1, 3001)]
    assert all(abs(chosen.count(kind) - 1000) <= 2 for kind in "abc")


def test_an_action_is_in_force_from_its_frame_on_and_reset_undoes_it() -> None:
    env = SlamEnv(ToySequence(12), TARGET, control=["noise.enabled", "noise.level_m"])
    off, loud = np.array([-1.0, 0.0]), np.array([1.0, 1.0])
    env.reset(seed=0)
    errors = [env.step(action)[4]["frame_error_trans_m"] for action in (off, off, loud, off, off)]
    assert errors[0] < 0.01 and errors[1] == pytest.approx(0, abs=1e-12)
    assert errors[2] > 0.02 and errors[3] > 0.02
    assert errors[4] == pytest.approx(0, abs=1e-12)
    first, _ = env.reset(seed=0)
    fresh, _ = SlamEnv(ToySequence(12), TARGET, control=["noise.enabled", "noise.level_m"]).reset(seed=0)
    assert first.tobytes() == fresh.tobytes()


@pytest.mark.parametrize(
    ("control", "action"),
    [((), action) for action in ("x", None, 1, -1, 0.0, [0], np.array([0]), {})]
    + [(("noise.level_m",), action) for action in ("x", None, [None], {}, ["a"], object(), [0, 0], [np.nan])],
)
def test_what_is_no_action_is_refused_and_nothing_is_tracked(control: tuple[str, ...], action: object) -> None:
    env = SlamEnv(ToySequence(4), TARGET, control=control)
    env.reset(seed=0)
    with pytest.raises(SettingsError, match="action"):
        env.step(action)
    assert env.episode.next_index == 1
    env.step(env.neutral_action)
    assert env.episode.next_index == 2


FRAME = Frame(3, 1.0, *images(3))


def observe(result: TrackResult, frame: Frame = FRAME, motion: np.ndarray | None = None) -> dict[str, float]:
    twist = np.zeros(6) if motion is None else se3.log(motion)
    vector = stats_observation(frame, result, progress=0.5, lost_streak=0, motion=twist)
    assert vector in stats_space() and np.isfinite(vector).all()
    return dict(zip((name for name, _ in STATS_LAYOUT), vector.tolist(), strict=True))


def test_every_entry_means_what_is_documented() -> None:
    stats = {
        "keypoints": 1000.0, "culled": 250.0, "matches": 300.0, "inliers": 150.0, "residual_px": 1.0,
        "mask_fraction": 0.25, "map_points": 5000.0, "keyframes": 100.0, "keyframe": 1.0,
    }  # fmt: skip
    motion = se3.exp(np.array([0.1, 0, -0.1, 0, 0.1, 0]))
    entries = observe(TrackResult(np.eye(4), "ok", stats), motion=motion)
    brightness, contrast, motion_rx = (entries.pop(name) for name in ("brightness", "contrast", "motion_rx"))
    assert brightness == pytest.approx(FRAME.rgb.mean() / 255, abs=0.03) and contrast > 0
    expected = dict.fromkeys(entries, 0.0) | {
        "ok": 1, "progress": 0.5, "keypoints": 0.5, "culled": 0.25, "matches": 0.4, "inliers": 0.5, "residual": 0.5,
        "mask_fraction": 0.25, "map_points": 0.5, "keyframes": 0.5, "keyframe": 1, "motion_x": np.tanh(1),
        "motion_z": -np.tanh(1), "motion_ry": np.tanh(1), "depth_valid": 1, "depth_median": 1.3 / 4.3,
    }  # fmt: skip
    assert entries == pytest.approx(expected, abs=1e-6) and motion_rx == pytest.approx(0, abs=1e-9)


def test_nothing_reported_and_nonsense_reported_stay_in_bounds() -> None:
    assert observe(TrackResult(None, "lost"))["lost"] == 1
    wild = {"keypoints": np.inf, "culled": -5.0, "matches": 1e30, "inliers": np.nan, "mask_fraction": 7.0}
    observe(TrackResult(np.eye(4), "ok", wild), motion=se3.exp(np.array([1e6, 0, 0, 3, 0, 0])))
    black = replace(FRAME, rgb=np.zeros_like(FRAME.rgb), depth=np.zeros_like(FRAME.depth))
    entries = observe(TrackResult(None, "initialising"), black)
    assert entries["brightness"] == entries["contrast"] == entries["depth_valid"] == entries["depth_median"] == 0


def test_rgbd_holds_copies_of_the_images() -> None:
    env = SlamEnv(ToySequence(4), TARGET, observation="rgbd")
    seen, _ = env.reset(seed=0)
    assert seen["rgb"].shape == (CAMERA.height, CAMERA.width, 3) and seen["depth"].shape == seen["rgb"].shape[:2]
    assert (seen["rgb"] == images(0)[0]).all() and (seen["depth"] == images(0)[1]).all()
    assert not np.shares_memory(seen["rgb"], env.frame.rgb) and not np.shares_memory(seen["depth"], env.frame.depth)
    assert seen in env.observation_space
    assert env.observation_space["depth"].high.max() == MAX_DEPTH_M


# The paper's preprocessing is a group of the tracker's settings; the environment's frames follow it.


SEQUENCE = "synthetic/sitting_xyz?frames=4"
HALF = {"preprocessing.width": 320, "preprocessing.height": 240}


def test_frames_are_resized_and_the_intrinsics_with_them() -> None:
    env = SlamEnv(SEQUENCE, "orb-slam2", settings=HALF)
    assert (env.sequence.camera.width, env.sequence.camera.height, env.sequence.camera.fx) == (320, 240, 535.4 / 2)
    env.reset(seed=0)
    info = [env.step(0)[4] for _ in range(3)][-1]
    assert info["tracking_state"] == "ok" and info["pose_error_trans_m"] < 0.05


def test_a_reset_may_change_it() -> None:
    env = SlamEnv(SEQUENCE, "orb-slam2")
    plain = env.sequence[1].rgb
    env.reset(seed=0, options={"settings": {"preprocessing.normalisation": "equalise"}})
    assert np.abs(env.sequence[1].rgb.astype(int) - plain).mean() > 2


# The rendered picture.


def pixels(image: np.ndarray, colour: tuple[int, int, int]) -> int:
    return int((image == np.array(colour, np.uint8)).all(axis=2).sum())


def rendered(steps: int = 11, **kwargs) -> np.ndarray:
    sequence = kwargs.pop("sequence", ToySequence(12))
    env = SlamEnv(sequence, TARGET, render_mode="rgb_array", **kwargs)
    env.reset(seed=0)
    for _ in range(steps):
        env.step(0)
    image = env.render()
    assert image is not None and image.dtype == np.uint8
    return image


def test_size_is_even_and_the_same_for_every_frame() -> None:
    shapes = {rendered(steps).shape for steps in (0, 1, 11)}
    assert shapes == {(HEIGHT + STRIP, 640 + HEIGHT, 3)}
    assert (HEIGHT + STRIP) % 2 == 0


def test_kept_and_culled_features_and_the_mask_are_drawn_in_their_colours() -> None:
    picture = rendered()[:HEIGHT, :640]
    assert pixels(picture, KEPT) > pixels(picture, CULLED) > 50
    orange = np.abs(picture[240, 160:200].astype(float).mean(axis=0) - MASK)
    plain = np.abs(picture[240, 500:600].astype(float).mean(axis=0) - MASK)
    assert orange.sum() < plain.sum()


def test_estimate_and_truth_are_drawn_from_above() -> None:
    plot = rendered()[:HEIGHT, 640:]
    assert pixels(plot, ESTIMATE) > 200 and pixels(plot, TRUTH) > 20
    columns = np.argwhere((plot == np.array(ESTIMATE, np.uint8)).all(axis=2))[:, 1]
    assert columns.max() - columns.min() > 300  # the toy camera walks to the right, which fills the plot


def test_no_ground_truth_and_lost_frames_are_no_trouble() -> None:
    rendered(sequence=ToySequence(12, has_truth=False))
    rendered(settings={"mode": "lost", "at": 3, "until": 6})
    rendered(settings={"mode": "initialising", "at": 0})


def test_the_path_is_seen_in_the_view_in_which_it_spreads_most() -> None:
    along = np.linspace(0, 1, 50)[:, None]
    flat = {(1, 0.1, 0.5): "from above", (1, 0.5, 0.1): "from behind", (0.1, 0.5, 1): "from the side"}
    for spread, name in flat.items():
        assert main_view(np.sin(along * [5, 9, 13]) * spread).startswith(name)
    assert main_view(np.zeros((0, 3))) == main_view(along * [1, 0, 0]) == next(iter(VIEWS))
    assert (VIEWS[main_view(np.zeros((1, 3)))] @ [1.0, 2.0, 3.0]).tolist() == [1.0, 3.0]


def test_the_error_in_the_picture_is_the_protocols() -> None:
    env = SlamEnv(ToySequence(45), TARGET, render_mode="rgb_array")
    env.reset(seed=0)
    online, stamps = OnlineError(env.sequence.ground_truth), env.sequence.timestamps
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
