"""What every block must survive: nothing, one point, no past."""

from __future__ import annotations

import numpy as np
import pytest
from scenes import (
    CAMERA,
    SEGMENTATION,
    box_instance,
    bundle,
    keypoints,
    scene,
)

from dynslam_bench.contracts.filter import DynamicFilter, FilterState
from dynslam_bench.culling.box_epipolar import BoxEpipolarFilter
from dynslam_bench.culling.class_rule import ClassRuleFilter
from dynslam_bench.culling.correlation_graph import CorrelationFilter
from dynslam_bench.culling.depth_blocks import DepthBlockFilter
from dynslam_bench.culling.depth_ransac import DepthRansacFilter
from dynslam_bench.culling.epipolar import EpipolarFilter
from dynslam_bench.culling.free_space import FreeSpaceFilter
from dynslam_bench.culling.moving_probability import ProbabilityFilter
from dynslam_bench.culling.moving_vote import MovingVoteFilter
from dynslam_bench.culling.multiview_depth import MultiViewFilter
from dynslam_bench.culling.reseeding import ReseedingFilter
from dynslam_bench.culling.residual_clusters import ResidualFilter
from dynslam_bench.culling.rigid_motion import RigidMotionFilter
from dynslam_bench.culling.semantic import BoxFilter, SemanticFilter
from dynslam_bench.culling.settings import (
    BoxEpipolarSettings,
    BoxSettings,
    ClassRuleSettings,
    CorrelationSettings,
    DepthBlockSettings,
    DepthRansacSettings,
    EpipolarSettings,
    FreeSpaceSettings,
    MovingVoteSettings,
    MultiViewSettings,
    ProbabilitySettings,
    ReseedingSettings,
    ResidualSettings,
    RigidMotionSettings,
    TemplateSettings,
)
from dynslam_bench.culling.template_matching import TemplateFilter
from dynslam_bench.features.settings import FeatureSettings
from dynslam_bench.segmentation.settings import SegmentationSettings

FILTERS = [
    EpipolarFilter(EpipolarSettings()),
    EpipolarFilter(EpipolarSettings(estimator="magsac")),
    RigidMotionFilter(RigidMotionSettings()),
    FreeSpaceFilter(FreeSpaceSettings()),
    SemanticFilter(SegmentationSettings()),
]


@pytest.mark.parametrize("block", FILTERS, ids=lambda block: block.name)
@pytest.mark.parametrize(
    "case", ["first frame", "no points", "seven matches", "nan depth", "identical", "invalid flow"]
)
def test_degenerate_input_culls_nothing_and_never_raises(block: DynamicFilter, case: str) -> None:
    made = scene(np.eye(4), noise_px=0.0)
    frame, state = made.frame, made.state
    if case == "first frame":
        state = FilterState(camera=CAMERA, keep=state.keep)
    elif case == "no points":
        frame = bundle(np.zeros((0, 2)), np.zeros(0), frame.depth, 1.0)
        state = FilterState(camera=CAMERA, keep=np.zeros(0, bool), previous=made.state.previous)
    elif case == "seven matches":
        state.flow.valid[7:] = False
    elif case == "nan depth":
        frame.depth[:] = np.nan
        frame.z[:] = 0
    elif case == "invalid flow":
        state.flow.valid[:] = False
        state.flow.xy[:] = np.nan
    block.reset(CAMERA)
    verdict = block.apply(frame, state)
    assert verdict.keep.shape == (len(frame),) and verdict.keep.all()
    assert all(np.isfinite(value) for value in verdict.stats.values())


BLOCKS = [
    BoxFilter(BoxSettings(), SEGMENTATION),
    BoxEpipolarFilter(BoxEpipolarSettings(), SEGMENTATION),
    MovingVoteFilter(MovingVoteSettings(), SEGMENTATION),
    MultiViewFilter(MultiViewSettings()),
    DepthRansacFilter(DepthRansacSettings(), SEGMENTATION),
    CorrelationFilter(CorrelationSettings()),
    ProbabilityFilter(ProbabilitySettings(), SEGMENTATION),
    TemplateFilter(TemplateSettings(), SEGMENTATION),
    ResidualFilter(ResidualSettings(), SEGMENTATION),
    ClassRuleFilter(ClassRuleSettings(), SEGMENTATION),
]


@pytest.mark.parametrize("block", BLOCKS, ids=lambda block: block.name)
@pytest.mark.parametrize("case", ["first frame", "no points", "no depth", "no objects", "black", "invalid flow"])
def test_degenerate_input_is_survived(block: DynamicFilter, case: str) -> None:
    made = scene(np.eye(4), noise_px=0.0)
    frame, state = made.frame, made.state
    block.reset(CAMERA)
    if case == "first frame":
        state = FilterState(camera=CAMERA, keep=state.keep)
    elif case == "no points":
        frame = bundle(np.zeros((0, 2)), np.zeros(0), frame.depth, 1.0)
        state = FilterState(camera=CAMERA, keep=np.zeros(0, bool), previous=made.state.previous)
    elif case == "no depth":
        frame.depth[:] = 0
        frame.z[:] = 0
    elif case == "no objects":
        frame.instances = box_instance(0, 0, 10, 10).of_classes(())
    elif case == "invalid flow":
        state.flow.valid[:] = False
        state.flow.xy[:] = np.nan
    verdict = block.apply(frame, state)
    assert verdict.keep.shape == (len(frame),) and verdict.keep.all()
    assert all(np.isfinite(value) for value in verdict.stats.values())


def test_blocks_survive_frames_without_anything() -> None:
    empty = bundle(np.zeros((0, 2)), np.zeros(0), np.zeros((480, 640), np.float32), 1.0)
    empty.instances = box_instance(0, 0, 10, 10)
    state = FilterState(camera=CAMERA, keep=np.zeros(0, bool))
    assert empty.keypoints.xy.shape == keypoints(np.zeros((0, 2))).xy.shape
    for block in (
        ReseedingFilter(ReseedingSettings(), FeatureSettings()),
        DepthBlockFilter(DepthBlockSettings(), SEGMENTATION),
    ):
        verdict = block.apply(empty, state)
        assert len(verdict.keep) == 0 and all(np.isfinite(list(verdict.stats.values())))
