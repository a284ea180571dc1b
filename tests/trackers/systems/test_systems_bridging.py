"""A detector that misses a person: every masked system bridges it for as many frames as its settings promise."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from dynslam_bench.contracts.sequence import Frame
from dynslam_bench.geometry.camera import Camera
from dynslam_bench.segmentation.settings import SegmentationSettings
from dynslam_bench.trackers import TRACKERS, build_tracker
from dynslam_bench.trackers.registry import all_specs
from dynslam_bench.trackers.systems.composition import SemanticSystemSettings

SEEN = 2
"""Frames with a detection; then the detector is blind."""
FRAMES = SEEN + 5 + 2


CAMERA = Camera(320, 240, 267.7, 269.6, 160.0, 120.0)


@pytest.fixture(scope="module")
def frames() -> list[Frame]:
    """A wall with a texture, two metres away, that moves by two pixels a frame."""
    texture = np.random.default_rng(0).integers(0, 255, (60, 120), dtype=np.uint8)
    wall = cv2.resize(texture, (480, 240), interpolation=cv2.INTER_CUBIC)
    depth = np.full((240, 320), 2.0, np.float32)
    views = [wall[:, 2 * index : 2 * index + 320, None].repeat(3, 2) for index in range(FRAMES)]
    return [Frame(index, index / 30, np.ascontiguousarray(view), depth) for index, view in enumerate(views)]


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A person's mask on disk for the first frames; later images hold nobody."""
    folder = tmp_path_factory.mktemp("masks")
    for index in range(FRAMES):
        image = np.zeros((240, 320), np.uint8)
        image[60:180, 100:180] = 255 if index < SEEN else 0
        cv2.imwrite(str(folder / f"{index:06d}.png"), image)
    return folder


@pytest.mark.parametrize("name", ["mask-rcnn", "dynaslam-n", "emfoa-oft?flow=none"])
def test_a_missed_person_is_bridged_for_as_long_as_promised(name: str, frames: list[Frame], recorded: Path) -> None:
    """The systems that cull by masks alone."""
    promised = TRACKERS.get(name).settings().segmentation.compensate
    tracker = build_tracker(name, {"segmentation.source": f"recorded:{recorded}"})
    tracker.reset(CAMERA, rng=np.random.default_rng(0))
    culled = [tracker.track(frame).stats["culled"] > 0 for frame in frames]
    assert culled == [True] * (SEEN + promised) + [False] * (FRAMES - SEEN - promised)


def test_systems_with_a_compensation_of_their_own_bridge_longer() -> None:
    masked = [spec for spec in all_specs() if issubclass(spec.settings, SemanticSystemSettings)]
    longer = {spec.id: spec.settings().segmentation.compensate for spec in masked}
    shared = SegmentationSettings().compensate
    assert {name: frames for name, frames in longer.items() if frames != shared} == {"huai-slam": 5, "cfp-slam": 5}
