"""DGS-SLAM's residual clusters."""

from __future__ import annotations

import numpy as np
from scenes import (
    BOX,
    CAMERA,
    SEGMENTATION,
    box_instance,
    bundle,
    moved_patch,
)

from dynslam_bench.contracts.filter import FilterState
from dynslam_bench.culling.residual_clusters import ResidualFilter
from dynslam_bench.culling.settings import ResidualSettings


def test_residual_clusters_find_the_part_that_the_camera_does_not_explain() -> None:
    before, after = moved_patch(12)
    rng = np.random.default_rng(4)
    xy = rng.uniform((30, 30), (610, 450), (300, 2))
    depth = np.full((480, 640), 3.0, np.float32)
    depth[BOX[1] : BOX[3], BOX[0] : BOX[2]] = 1.5
    frame = bundle(xy, np.full(300, 2.0), depth, 1.0)
    previous = bundle(xy, np.full(300, 2.0), depth, 0.9)
    frame.gray, previous.gray = after, before
    frame.instances = box_instance(*BOX)
    state = FilterState(
        camera=CAMERA, keep=np.ones(300, bool), previous=previous, T_world_prev=np.eye(4), T_world_pred=np.eye(4)
    )
    block = ResidualFilter(ResidualSettings(), SEGMENTATION)
    x, y = xy.T
    on = (x >= BOX[0]) & (x < BOX[2]) & (y >= BOX[1]) & (y < BOX[3])
    keep = block.apply(frame, state).keep
    assert keep[~on].mean() > 0.95 and keep[on].mean() < 0.05
    frame.gray, frame.instances = before, None
    assert block.apply(frame, state).keep.all()
