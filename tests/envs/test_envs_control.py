"""Actions and the settings they stand for."""

from typing import Literal

import gymnasium as gym
import numpy as np
import pytest
from envs_toys import TARGET, ToySequence

from dynslam_bench.core.errors import SettingsError
from dynslam_bench.core.settings import Settings, online_parameters, tunable
from dynslam_bench.envs import ActionMap, SlamEnv
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
    actions = ActionMap(Root(), NAMES)
    rng = np.random.default_rng(0)
    for _ in range(100):
        settings = actions.settings(rng.uniform(-1, 1, 6))
        again = actions.settings(actions.encode(settings))
        assert again.group.model_dump(exclude={"linear", "log"}) == settings.group.model_dump(exclude={"linear", "log"})
        assert again.group.linear == pytest.approx(settings.group.linear, abs=1e-6)
        assert again.group.log == pytest.approx(settings.group.log, rel=1e-6)


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


def test_spaces() -> None:
    assert ActionMap(Root(), []).space() == gym.spaces.Discrete(1)
    assert ActionMap(Root(), NAMES).space() == gym.spaces.Box(-1, 1, (6,), np.float32)


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
