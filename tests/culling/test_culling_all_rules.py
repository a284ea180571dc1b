"""What every rule must survive, the starvation guard, and settings that no short episode shows."""

import importlib
import pkgutil
from collections.abc import Callable
from typing import Any, get_args

import numpy as np
import pytest
from scenes import ACROSS, BOX, CAMERA, SEGMENTATION, SIDEWAYS, box_instance, bundle, moved_patch, scene
from test_culling_geometry import in_front

import dynslam_bench.culling as culling
from dynslam_bench.contracts.filter import DynamicFilter, FilterState
from dynslam_bench.core.settings import Settings, parameters
from dynslam_bench.culling.correlation_graph import CorrelationFilter
from dynslam_bench.culling.depth_regions import BoxDepthFilter, person_set
from dynslam_bench.culling.epipolar import ClassRuleFilter, MovingVoteFilter
from dynslam_bench.culling.multiview_depth import MultiViewFilter
from dynslam_bench.culling.reseeding import ReseedingFilter
from dynslam_bench.culling.settings import (
    BoxDepthSettings,
    ClassRuleSettings,
    CorrelationSettings,
    DepthRansacSettings,
    GuardSettings,
    MovingVoteSettings,
    MultiViewSettings,
)
from dynslam_bench.features.settings import FeatureSettings
from dynslam_bench.slam.pipeline import restore_starved


def rules() -> list[DynamicFilter]:
    """Every rule of the package with its default settings."""
    for module in pkgutil.iter_modules(culling.__path__):
        importlib.import_module(f"{culling.__name__}.{module.name}")
    built = []
    for kind in {*culling.Rule.__subclasses__(), *culling.ObjectRule.__subclasses__()} - {culling.ObjectRule}:
        more = {ReseedingFilter: [FeatureSettings()]}.get(kind, [SEGMENTATION] * issubclass(kind, culling.ObjectRule))
        built.append(kind(get_args(kind.__orig_bases__[0])[0](), *more))
    assert len(built) == 16
    return sorted(built, key=lambda rule: rule.name)


@pytest.mark.parametrize("rule", rules(), ids=lambda rule: rule.name)
@pytest.mark.parametrize(
    "case",
    ["first frame", "no points", "few matches", "no depth", "nan depth", "no objects", "identical", "invalid flow"],
)
def test_degenerate_input_culls_nothing_and_never_raises(rule: DynamicFilter, case: str) -> None:
    made = scene(np.eye(4), noise_px=0.0)
    frame, state = made.frame, made.state
    if case == "first frame":
        state = FilterState(camera=CAMERA, keep=state.keep)
    elif case == "no points":
        frame = bundle(np.zeros((0, 2)), np.zeros(0), frame.depth, 1.0)
        frame.instances = box_instance(0, 0, 10, 10)
        state = FilterState(camera=CAMERA, keep=np.zeros(0, bool), previous=made.state.previous)
    elif case == "few matches":
        state.flow.valid[7:] = False
    elif case.endswith("depth"):
        frame.depth[:] = np.nan if case == "nan depth" else 0
        frame.z[:] = 0
    elif case == "no objects":
        frame.instances = box_instance(0, 0, 10, 10).of_classes(())
    elif case == "invalid flow":
        state.flow.valid[:] = False
        state.flow.xy[:] = np.nan
    rule.reset(CAMERA)
    verdict = rule.apply(frame, state)
    assert verdict.keep.shape == (len(frame),) and verdict.keep.all()
    assert set(verdict.stats) == set(rule.stats_names) and np.isfinite(list(verdict.stats.values())).all()


def test_guard_undoes_the_least_reliable_verdict_first() -> None:
    semantic, nothing = np.arange(100) >= 30, np.zeros(100, bool)
    settings = GuardSettings(min_features=40)
    for verdicts, expected, undone in (
        ([semantic, nothing], semantic, 1),
        ([nothing, nothing], ~nothing, 2),
        ([semantic], semantic, 0),
    ):
        keep, count = restore_starved(verdicts, settings, 100)
        assert count == undone
        np.testing.assert_array_equal(keep, expected)
    assert restore_starved([semantic], GuardSettings(min_features=0, min_fraction=0.8), 100)[1] == 1


# Settings of culling rules that no short episode shows: each changes the verdict on a scene made for it.


def tracked_corners(value: int) -> float:
    before, after = moved_patch(12)
    made = scene(np.eye(4))
    made.frame.gray, made.state.previous.gray = np.roll(after, 3, axis=1), before
    made.frame.instances = box_instance(*BOX)
    rule = MovingVoteFilter(MovingVoteSettings(corners=value), SEGMENTATION)
    return rule.apply(made.frame, made.state).stats["corners"]


def chair_of_which_half_moves(value: float) -> list[bool]:
    made = scene(SIDEWAYS, n_static=900, n_moving=40, motion=ACROSS)
    made.frame.instances = box_instance(*BOX, name="chair")
    rule = ClassRuleFilter(ClassRuleSettings(vote_share=value, depth_m=2.0), SEGMENTATION)
    return rule.apply(made.frame, made.state).keep.tolist()


def near_person(value: float) -> list[bool]:
    """A person who fills half of the image."""
    made = scene(np.eye(4))
    made.frame.depth[:, :320], made.frame.depth[:, 320:] = 1.0, 3.0
    made.frame.instances = box_instance(0, 0, 320, 480)
    rule = BoxDepthFilter(BoxDepthSettings(max_cover=value), SEGMENTATION)
    return rule.apply(made.frame, made.state).keep.tolist()


def many_points_on_a_small_body(value: str) -> list[bool]:
    made = scene(SIDEWAYS, n_static=120, n_moving=250, motion=np.array([0.15, 0.1, 0.0]))
    rule = CorrelationFilter(CorrelationSettings(window=1, pixel_sigma=0.5, largest=value))
    rule.apply(made.state.previous, FilterState(CAMERA, made.state.keep, T_world_pred=np.eye(4)))
    return rule.apply(made.frame, made.state).keep.tolist()


def observed_from_aside(value: float) -> float:
    """Somebody before a wall that keyframes observed from 1.2 m further left."""
    return MultiViewFilter(MultiViewSettings(max_parallax_deg=value)).apply(*in_front(aside_m=1.2)).stats["seeds"]


def drawn_set(value: int) -> list[bool]:
    """A box of many depths, so that more draws find a larger set of similar ones."""
    z = np.random.default_rng(0).uniform(1.0, 6.0, 200)
    settings = DepthRansacSettings(max_draws=value, confidence=0.999, variance_m2=0.01)
    return person_set(z, settings, np.random.default_rng(1)).tolist()


CASES: dict[str, tuple[type[Settings], Callable[[Any], Any]]] = {
    "moving_vote.corners": (MovingVoteSettings, tracked_corners),
    "class_rule.vote_share": (ClassRuleSettings, chair_of_which_half_moves),
    "box_depth.max_cover": (BoxDepthSettings, near_person),
    "correlation.largest": (CorrelationSettings, many_points_on_a_small_body),
    "multiview.max_parallax_deg": (MultiViewSettings, observed_from_aside),
    "depth_ransac.max_draws": (DepthRansacSettings, drawn_set),
}
"""Setting as studies name it: its group, and the verdict at a value of it."""


@pytest.mark.parametrize("name", CASES)
def test_both_ends_of_the_range_give_other_verdicts(name: str) -> None:
    group, verdict = CASES[name]
    parameter = next(p for p in parameters(group) if p.name == name.partition(".")[2])
    first, *_, last = parameter.choices or (parameter.low, parameter.high)
    assert verdict(first) == verdict(first) != verdict(last)
