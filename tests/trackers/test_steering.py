"""OnlineSettings acts as building with the same value does, ends with the episode, and is refused where nothing takes it.

An episode steered from before its first frame is the episode of a tracker built with those settings, bit for bit; one
after `reset` is that of a fresh tracker. All online settings of a tracker at once, and each by itself where it shows.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import islice

import pytest
from quick_dense import quick
from steering_scene import FRAMES, SmallScene, construct, difference, differing, play, settings_for

from dynslam_bench.contracts.tracker import TrackResult
from dynslam_bench.core.errors import SettingsError
from dynslam_bench.core.settings import OnlineSettings, Parameter, Settings, apply_overrides, online_parameters, tunable
from dynslam_bench.trackers.registry import all_specs
from dynslam_bench.trackers.systems.composition import SystemSettings

SYSTEMS = {spec.id: spec for spec in all_specs() if issubclass(spec.settings, SystemSettings)}
SHORT = 6
"""Frames of the episodes in which all settings of a tracker are steered at once."""
AFTER = 3
"""Frames that an episode goes on for after the first on which a setting has shown."""


def online() -> dict[str, tuple[str, Parameter]]:
    """Every online setting, with the first tracker in which it has an effect."""
    found: dict[str, tuple[str, Parameter]] = {}
    for spec in SYSTEMS.values():
        for parameter in online_parameters(spec.settings()):
            found.setdefault(parameter.name, (spec.id, parameter))
    return found


ONLINE = online()
KEYFRAMES = {"backend.keyframes.tracked_share": 1.0, "free_space.min_share": 0.0}
CASES: dict[str, tuple[str, dict[str, object]]] = {
    "backend.keyframes.view_share": ("orb-slam2", {
        "backend.keyframes.tracked_share": 0.4, "backend.keyframes.new_close": 400,
        "backend.keyframes.moved_share": 0.8,
    }),
    "backend.keyframes.moved_share": ("orb-slam2", {
        "backend.keyframes.tracked_share": 0.95, "backend.keyframes.new_close": 400,
        "backend.keyframes.established": 5, "backend.keyframes.view_share": 0.5,
    }),
    "epipolar.threshold_px": ("emfoa-oft?masks=vote&depth=none", {}),
    "epipolar.min_share": ("emfoa-oft-paper?masks=none", {}),
    "free_space.threshold_m": ("emfoa-oft?masks=none", {
        **KEYFRAMES, "free_space.min_votes": 1, "free_space.threshold_sigma": 0.0,
    }),
    "free_space.threshold_sigma": ("emfoa-oft?masks=none", {
        **KEYFRAMES, "free_space.min_votes": 1, "free_space.threshold_m": 0.01,
    }),
    "free_space.min_votes": ("emfoa-oft?masks=none", {
        **KEYFRAMES, "free_space.threshold_m": 0.01, "free_space.threshold_sigma": 0.0,
    }),
    "segmentation.min_area_px": ("mask-rcnn", {"segmentation.classes": "all"}),
    "multiview.tau_m": ("dynaslam-g", {
        "multiview.min_keyframes": 1, "multiview.max_variance": 1.0, "backend.keyframes.tracked_share": 1.0,
    }),
    "segmentation.max_carry": ("detect-slam", {
        "backend.keyframes.tracked_share": 0.4, "backend.keyframes.new_close": 1000, "probability.threshold": 0.99,
    }),
    "class_rule.depth_m": ("seg-slam", {"segmentation.classes": "chair", "class_rule.movable": "person"}),
}  # fmt: skip
"""Where a setting shows on the excerpt, if not in the first tracker that has it: the tracker and what else is set."""


@pytest.fixture(scope="module")
def scene() -> SmallScene:
    return SmallScene()


@pytest.fixture(scope="module")
def unsteered(scene: SmallScene) -> Callable[..., list[TrackResult]]:
    """The first frames of a tracker that nobody steers, played once for all that compare with them."""
    played: dict[object, tuple[list[TrackResult], Iterator[TrackResult]]] = {}

    def episode(name: str, frames: int, others: dict[str, object]) -> list[TrackResult]:
        key = (name, *others.items())
        if key not in played:
            played[key] = [], play(construct(SYSTEMS[name], scene, **others), scene)
        results, rest = played[key]
        results += islice(rest, max(0, frames - len(results)))
        return results[:frames]

    return episode


def at_first(tracker, settings: Settings):
    """Steers before the first frame."""
    return lambda number: tracker.configure(settings) if number == 0 else None


def until_it_shows(unsteered: list[TrackResult], episode: Iterator[TrackResult]) -> list[TrackResult]:
    """An episode's results to `AFTER` frames behind the first that is not as unsteered; none if none differs."""
    results = []
    for before, result in zip(unsteered, episode, strict=True):
        results.append(result)
        if differing(before, result):
            return results + list(islice(episode, AFTER))
    return []


@pytest.mark.parametrize("name", SYSTEMS)
def test_all_settings_at_once_act_and_are_restored(name: str, scene: SmallScene, unsteered) -> None:
    spec = SYSTEMS[name]
    tracker = construct(spec, scene)
    settings = settings_for(spec)
    ends = {p.name: p.low if number % 2 else p.high for number, p in enumerate(online_parameters(settings))}
    ends |= {"features.fast_threshold": 12, "features.fast_threshold_min": 3}
    extreme = apply_overrides(settings, ends)
    frames = SHORT // 2 if quick(spec.settings) else SHORT  # dense flow costs ten times as much
    fresh = unsteered(name, frames, {})
    steered = list(play(tracker, scene, frames, before=at_first(tracker, extreme)))
    again = play(tracker, scene, frames)
    static = list(play(construct(spec, scene, **ends), scene, frames))
    assert difference(fresh, static), "the extremes change nothing at all"
    assert not difference(static, steered), "steered is not what building with the same values gives"
    assert not difference(fresh, again), "reset() leaves something of the steered episode"


@pytest.mark.parametrize("name", ONLINE)
def test_each_setting_acts_when_steered_where_it_acts_when_built_with(name: str, scene: SmallScene, unsteered) -> None:
    parameter = ONLINE[name][1]
    system, others = CASES.get(name, (ONLINE[name][0], {}))
    for value in (parameter.low, parameter.high):
        built = construct(SYSTEMS[system], scene, **others, **{name: value})
        if not (static := until_it_shows(unsteered(system, FRAMES, others), play(built, scene))):
            continue
        tracker = construct(SYSTEMS[system], scene, **others)
        changed = apply_overrides(settings_for(SYSTEMS[system], **others), {name: value})
        steered = play(tracker, scene, len(static), before=at_first(tracker, changed))
        assert not difference(static, steered), f"{system}: {name} = {value:g}"
        return
    pytest.fail(f"{name} changes nothing in {system}, at {parameter.low:g} and at {parameter.high:g}")


def test_a_setting_is_in_force_from_the_very_next_frame(scene: SmallScene) -> None:
    """Both ways, in mid-episode: what lies on people is judged by the confidence that was asked for."""
    tracker = construct(SYSTEMS["mask-rcnn"], scene, **{"segmentation.compensate": 0})
    settings = settings_for(SYSTEMS["mask-rcnn"], **{"segmentation.compensate": 0})
    sure, any_ = (apply_overrides(settings, {"segmentation.confidence": c}) for c in (0.9, 0.1))
    asked = [any_, any_, sure, any_, sure, sure, any_]
    results = list(play(tracker, scene, len(asked), before=lambda number: tracker.configure(asked[number])))
    always = {id(each): list(play(tracker, scene, len(asked), before=at_first(tracker, each))) for each in (sure, any_)}
    counts = [result.stats["semantic_objects"] for result in results]
    assert counts == [always[id(each)][number].stats["semantic_objects"] for number, each in enumerate(asked)]
    assert len({tuple(r.stats["semantic_objects"] for r in each) for each in always.values()}) == 2


def test_only_what_differs_is_handed_on() -> None:
    class Part(Settings):
        value: float = tunable(1.0, low=0.0, high=2.0, online=True, meaning="x")

    class Whole(Settings):
        one: Part = Part()
        two: Part = Part()

    given: list[tuple[str, float]] = []
    takers = [(name, lambda s, name=name: given.append((name, s.value))) for name in ("one", "two")]
    steering = OnlineSettings(Whole(), takers)
    steering.configure(Whole(two=Part(value=2.0)))
    steering.configure(Whole(two=Part(value=2.0)))
    assert given == [("two", 2.0)]
    steering.restore()
    assert given[1:] == [("one", 1.0), ("two", 1.0)]
    with pytest.raises(SettingsError, match=r"'two.value' of Whole is taken by no part .*configure\(settings\)"):
        OnlineSettings(Whole(), takers[:1])


def test_what_is_switched_off_needs_nobody_who_takes_it() -> None:
    names = {p.name.split(".")[0] for p in online_parameters(SYSTEMS["emfoa-oft?masks=none"].settings())}
    assert "segmentation" not in names and {"flow", "motion"} <= names
    names = {p.name.split(".")[0] for p in online_parameters(SYSTEMS["emfoa-oft?depth=none"].settings())}
    assert not {"motion", "free_space"} & names
