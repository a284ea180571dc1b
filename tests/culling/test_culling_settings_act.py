"""Settings of culling rules that no short episode shows: each changes the verdict on a scene made for it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from scenes import (
    ACROSS,
    BOX,
    CAMERA,
    SEGMENTATION,
    SIDEWAYS,
    Scene,
    box_instance,
    bundle,
    keyframe,
    keypoints,
    moved_patch,
    scene,
)

from dynslam_bench.contracts.filter import DynamicFilter, FilterState, KeyframeView
from dynslam_bench.core.settings import Settings, parameters
from dynslam_bench.culling.box_depth import BoxDepthFilter
from dynslam_bench.culling.class_rule import ClassRuleFilter
from dynslam_bench.culling.correlation_graph import CorrelationFilter
from dynslam_bench.culling.depth_ransac import person_set
from dynslam_bench.culling.epipolar import EpipolarFilter
from dynslam_bench.culling.free_space import FreeSpaceFilter
from dynslam_bench.culling.guard import GuardSettings, restore_starved
from dynslam_bench.culling.moving_vote import MovingVoteFilter
from dynslam_bench.culling.multiview_depth import MultiViewFilter
from dynslam_bench.culling.rigid_motion import RigidMotionFilter
from dynslam_bench.culling.settings import (
    BoxDepthSettings,
    ClassRuleSettings,
    CorrelationSettings,
    DepthRansacSettings,
    EpipolarSettings,
    FreeSpaceSettings,
    MovingVoteSettings,
    MultiViewSettings,
    RigidMotionSettings,
)

Verdict = Callable[[Any], Any]


def kept(block: DynamicFilter, made: Scene) -> list[bool]:
    return block.apply(made.frame, made.state).keep.tolist()


def remembered(value: float) -> list[bool]:
    """What moved in one frame and rests in the next."""
    block = RigidMotionFilter(RigidMotionSettings(min_share=0.0, memory=value))
    kept(block, scene(np.eye(4), motion=ACROSS))
    return kept(block, scene(np.eye(4)))


def old_keyframe(value: float) -> list[bool]:
    """A keyframe that saw an empty room five seconds ago."""
    made = scene(SIDEWAYS)
    room = np.full((CAMERA.height, CAMERA.width), 4.5, np.float32)
    made.state.keyframes = (keyframe(np.eye(4), room, made.frame.timestamp - 5.0),)
    return kept(FreeSpaceFilter(FreeSpaceSettings(min_votes=1, min_share=0.0, max_age_s=value)), made)


def tracked_corners(value: int) -> float:
    before, after = moved_patch(12)
    made = scene(np.eye(4))
    made.frame.gray, made.state.previous.gray = np.roll(after, 3, axis=1), before
    made.frame.instances = box_instance(*BOX)
    return (
        MovingVoteFilter(MovingVoteSettings(corners=value), SEGMENTATION).apply(made.frame, made.state).stats["corners"]
    )


def chair_of_which_half_moves(value: float) -> list[bool]:
    made = scene(SIDEWAYS, n_static=900, n_moving=40, motion=ACROSS)
    made.frame.instances = box_instance(*BOX, name="chair")
    return kept(ClassRuleFilter(ClassRuleSettings(vote_share=value, depth_m=2.0), SEGMENTATION), made)


def near_person(value: float) -> list[bool]:
    """A person who fills half of the image."""
    made = scene(np.eye(4))
    made.frame.depth[:, :320], made.frame.depth[:, 320:] = 1.0, 3.0
    made.frame.instances = box_instance(0, 0, 320, 480)
    return kept(BoxDepthFilter(BoxDepthSettings(max_cover=value), SEGMENTATION), made)


def many_points_on_a_small_body(value: str) -> list[bool]:
    made = scene(SIDEWAYS, n_static=120, n_moving=250, motion=np.array([0.15, 0.1, 0.0]))
    block = CorrelationFilter(CorrelationSettings(window=1, pixel_sigma=0.5, largest=value))
    block.apply(made.state.previous, FilterState(CAMERA, made.state.keep, T_world_pred=np.eye(4)))
    return kept(block, made)


def seen_from_aside(value: float) -> float:
    """Somebody before a wall that keyframes saw from 1.2 m further left."""
    xy = np.stack(np.meshgrid(np.arange(30, 611, 10.0), np.arange(30, 451, 10.0)), axis=-1).reshape(-1, 2)
    wall = np.full((480, 640), 3.0, np.float32)
    now = wall.copy()
    now[100:380, 220:330] = 1.5
    aside = np.eye(4)
    aside[0, 3] = -1.2
    view = KeyframeView(aside, keypoints(xy), xy, np.full(len(xy), 3.0, np.float32), wall, 0.0)
    state = FilterState(CAMERA, np.ones(len(xy), bool), T_world_pred=np.eye(4), keyframes=(view,) * 5)
    block = MultiViewFilter(MultiViewSettings(max_parallax_deg=value))
    return block.apply(bundle(xy, now[xy[:, 1].astype(int), xy[:, 0].astype(int)], now, 1.0), state).stats["seeds"]


def drawn_set(value: int) -> list[bool]:
    """A box of many depths, so that more draws find a larger set of like ones."""
    z = np.random.default_rng(0).uniform(1.0, 6.0, 200)
    settings = DepthRansacSettings(max_draws=value, confidence=0.999, variance_m2=0.01)
    return person_set(z, settings, np.random.default_rng(1)).tolist()


def uncertain_f(value: float) -> list[list[bool]]:
    """Three scenes of which half moves: more samples find another F."""
    settings = EpipolarSettings(
        confidence=value, min_parallax_px=0.0, parallax_share=0.0, homography_share=1.0, min_share=0.0,
        max_contradiction=1.0,
    )  # fmt: skip
    drawn = [scene(SIDEWAYS, n_static=150, n_moving=150, motion=ACROSS, noise_px=0.6, seed=seed) for seed in range(3)]
    return [kept(EpipolarFilter(settings), made) for made in drawn]


def fast_camera(value: float) -> list[bool]:
    """Points that leave their place by a share of what the camera's motion explains."""
    made = scene(SIDEWAYS, motion=np.array([0.0, 0.013, 0.0]))
    return kept(RigidMotionFilter(RigidMotionSettings(min_share=0.0, threshold_share=value)), made)


def starved(value: float) -> list[bool]:
    """A filter that leaves 120 of 1000 points."""
    verdict = np.arange(1000) < 120
    return restore_starved([verdict], GuardSettings(min_fraction=value))[0].tolist()


CASES: dict[str, tuple[type[Settings], Verdict]] = {
    "motion.memory": (RigidMotionSettings, remembered),
    "motion.threshold_share": (RigidMotionSettings, fast_camera),
    "free_space.max_age_s": (FreeSpaceSettings, old_keyframe),
    "moving_vote.corners": (MovingVoteSettings, tracked_corners),
    "class_rule.vote_share": (ClassRuleSettings, chair_of_which_half_moves),
    "box_depth.max_cover": (BoxDepthSettings, near_person),
    "correlation.largest": (CorrelationSettings, many_points_on_a_small_body),
    "multiview.max_parallax_deg": (MultiViewSettings, seen_from_aside),
    "depth_ransac.max_draws": (DepthRansacSettings, drawn_set),
    "epipolar.confidence": (EpipolarSettings, uncertain_f),
    "guard.min_fraction": (GuardSettings, starved),
}
"""Setting as studies name it: its group, and what comes out at a value of it."""


@pytest.mark.parametrize("name", CASES)
def test_both_ends_of_the_range_give_other_verdicts(name: str) -> None:
    group, verdict = CASES[name]
    parameter = next(each for each in parameters(group) if each.name == name.partition(".")[2])
    first, *_, last = parameter.choices or (parameter.low, parameter.high)
    assert verdict(first) == verdict(first) != verdict(last)
