"""Settings of culling rules that no short episode shows: each changes the verdict on a scene made for it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from scenes import ACROSS, BOX, CAMERA, SEGMENTATION, SIDEWAYS, box_instance, moved_patch, scene
from test_culling_multiview import in_front

from dynslam_bench.contracts.filter import FilterState
from dynslam_bench.core.settings import Settings, parameters
from dynslam_bench.culling.correlation_graph import CorrelationFilter
from dynslam_bench.culling.depth_regions import BoxDepthFilter, person_set
from dynslam_bench.culling.epipolar import ClassRuleFilter
from dynslam_bench.culling.moving_vote import MovingVoteFilter
from dynslam_bench.culling.multiview_depth import MultiViewFilter
from dynslam_bench.culling.settings import (
    BoxDepthSettings,
    ClassRuleSettings,
    CorrelationSettings,
    DepthRansacSettings,
    MovingVoteSettings,
    MultiViewSettings,
)


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
