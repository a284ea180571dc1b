"""DynaTM-SLAM's template matching."""

from __future__ import annotations

import numpy as np
import pytest
from scenes import (
    BOX,
    CAMERA,
    SEGMENTATION,
    box_instance,
    bundle,
    moved_patch,
)

from dynslam_bench.contracts.filter import FilterState
from dynslam_bench.culling.settings import TemplateSettings
from dynslam_bench.culling.template_matching import TemplateFilter


@pytest.mark.parametrize("shift", [0, 12])
def test_template_keeps_what_is_found_where_the_camera_predicts_it(shift: int) -> None:
    before, after = moved_patch(shift)
    rng = np.random.default_rng(3)
    xy = rng.uniform((30, 30), (610, 450), (300, 2))
    frame = bundle(xy, np.full(300, 2.0), np.full((480, 640), 2.0, np.float32), 1.0)
    previous = bundle(xy, np.full(300, 2.0), frame.depth, 0.9)
    frame.gray, previous.gray = after, before
    frame.instances = box_instance(*BOX)
    state = FilterState(
        camera=CAMERA, keep=np.ones(300, bool), previous=previous, T_world_prev=np.eye(4), T_world_pred=np.eye(4)
    )
    verdict = TemplateFilter(TemplateSettings(), SEGMENTATION).apply(frame, state)
    x, y = xy.T
    margin = 8 if shift else 0  # patches across the box's edge see both
    inside = (x >= BOX[0] + margin) & (x < BOX[2] - margin) & (y >= BOX[1] + margin) & (y < BOX[3] - margin)
    outside = ~((x >= BOX[0]) & (x < BOX[2]) & (y >= BOX[1]) & (y < BOX[3]))
    assert verdict.keep[outside].all()
    assert verdict.keep[inside].all() if shift == 0 else not verdict.keep[inside].any()
