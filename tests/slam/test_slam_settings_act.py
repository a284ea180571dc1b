"""Settings of the back end that short episodes do not show: each changes what comes out where it is asked."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from dynslam_bench.contracts.filter import FrameBundle
from dynslam_bench.core.settings import apply_overrides, parameters
from dynslam_bench.slam.backend import RgbdBackend
from dynslam_bench.slam.settings import BackendSettings

MANY = {"keyframes.tracked_share": 0.95, "keyframes.established": 1, "keyframes.view_share": 0.98}
"""A keyframe nearly every frame."""
BELIEVING = {"relocalisation.min_share": 0.0, "relocalisation.max_speed": 1000.0}
"""A few features that agree make a place, wherever it is."""
LOST = {**MANY, **BELIEVING, "relocalisation.min_inliers": 15}
PARAMETERS = {each.name: each for each in parameters(BackendSettings)}
Story = Callable[[Any], Iterable[FrameBundle]]
"""Frames of the room of `conftest`."""


def resting(room: Any) -> Iterable[FrameBundle]:
    """A camera that rests before much that is new in every frame: only the time asks for a keyframe."""
    return [room.see(np.eye(4), index, limit=900, wrong=110) for index in range(14)]


def strolling(room: Any) -> Iterable[FrameBundle]:
    return [room.see(pose, index, limit=300) for index, pose in enumerate(room.path(24))]


def found_again(room: Any) -> Iterable[FrameBundle]:
    """Frames without features; then a place further on, few features, many wrong, with worn descriptors."""
    rng = np.random.default_rng(0)
    frames = []
    path = room.path(46)
    for index, pose in enumerate([*path[:24], *path[24:27], *path[40:]]):
        if 24 <= index < 27:
            frames.append(room.blind(index))
            continue
        frame = room.see(pose, index, limit=300, wrong=0 if index < 24 else 190)
        if index >= 27:
            bits = np.unpackbits(frame.keypoints.descriptors, axis=1)
            bits ^= (rng.random(bits.shape) < 0.1).astype(np.uint8)
            frame = replace(frame, keypoints=replace(frame.keypoints, descriptors=np.packbits(bits, axis=1)))
        frames.append(frame)
    return frames


CASES: dict[str, tuple[Story, dict[str, Any]]] = {
    "keyframes.max_gap": (resting, {}),
    "bundle_adjustment.window": (strolling, MANY),
    **{f"relocalisation.{name}": (found_again, LOST)
       for name in ("candidates", "iterations", "max_distance")},
}  # fmt: skip
"""Setting as the back end names it: the frames that show it, and what else is set."""


def told(settings: dict[str, Any], room: Any, frames: Iterable[FrameBundle], tracked: Any) -> list[tuple[object, ...]]:
    """State, whether it became a keyframe, and pose of every frame, bit for bit."""
    backend = RgbdBackend(apply_overrides(BackendSettings(), settings))
    backend.reset(room.camera, 0)
    results = tracked(backend, frames)
    return [
        (each.state, each.keyframe, None if each.T_world_cam is None else each.T_world_cam.tobytes())
        for each in results
    ]


@pytest.mark.parametrize("name", CASES)
def test_both_ends_of_the_range_come_out_otherwise(name: str, room: Any, tracked: Any) -> None:
    story, others = CASES[name]
    frames = list(story(room))
    parameter = PARAMETERS[name]
    first, *_, last = parameter.choices or (parameter.low, parameter.high)
    ends = [told({**others, name: value}, room, frames, tracked) for value in (first, last)]
    assert ends[0] != ends[1]
