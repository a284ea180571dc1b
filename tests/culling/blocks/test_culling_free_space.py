"""Free space that a keyframe saw."""

from __future__ import annotations

import numpy as np
from scenes import (
    CAMERA,
    SIDEWAYS,
    keyframe,
    scene,
)

from dynslam_bench.contracts.filter import FilterState
from dynslam_bench.culling.free_space import FreeSpaceFilter
from dynslam_bench.culling.settings import FreeSpaceSettings


def test_free_space_culls_what_stands_where_a_keyframe_saw_through() -> None:
    made = scene(SIDEWAYS)
    empty_room = np.full((CAMERA.height, CAMERA.width), 4.5, np.float32)
    static_room = made.state.previous.depth  # what is here now was there before
    settings = FreeSpaceSettings(min_votes=1, min_share=0.0)
    seen_through = FilterState(
        camera=CAMERA, keep=made.state.keep, T_world_pred=SIDEWAYS, keyframes=(keyframe(np.eye(4), empty_room, 0.5),)
    )
    verdict = FreeSpaceFilter(settings).apply(made.frame, seen_through)
    near = made.frame.z < 3.9
    assert not verdict.keep[near].any()
    unchanged = FilterState(
        camera=CAMERA, keep=made.state.keep, T_world_pred=SIDEWAYS, keyframes=(keyframe(np.eye(4), static_room, 0.5),)
    )
    assert FreeSpaceFilter(settings).apply(made.frame, unchanged).keep.all()
