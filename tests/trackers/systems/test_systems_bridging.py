"""A detector that misses a person: every masked system bridges it for as many frames as its settings promise."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from quick_dense import quick

from dynslam_bench.contracts.sequence import Frame
from dynslam_bench.geometry.camera import Camera
from dynslam_bench.segmentation.postprocess import select
from dynslam_bench.segmentation.settings import SegmentationSettings
from dynslam_bench.slam.pipeline import SlamPipeline
from dynslam_bench.trackers import TrackerContext, TrackerSpec, build_tracker
from dynslam_bench.trackers.registry import all_specs
from dynslam_bench.trackers.systems.composition import SemanticSystemSettings

SEEN = 2
"""Frames with a detection; then the detector is blind."""
FRAMES = SEEN + 5 + 2
MASKED = [
    spec
    for spec in all_specs()
    if issubclass(spec.settings, SemanticSystemSettings) and spec.settings().segmentation.source != "none"
]
OWN = {"huai-slam": 5, "cfp-slam": 5}
"""What the specs of systems with a compensation of their own promise; all others promise the shared default."""
ONLY_MASKS = {"mask-rcnn", "dynaslam-n", "emfoa-oft?flow=none"}


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


def seen_by_filters(tracker: SlamPipeline) -> list[int]:
    """A list that gains, on every frame, how many objects the rules of the tracker's masked filters are given."""
    counts: list[int] = []
    for each in tracker._filters:
        held = getattr(each, "segmentation", getattr(each, "settings", None))
        if not ({"masks", "boxes"} & each.needs) or not isinstance(held, SegmentationSettings):
            continue

        def watched(frame, state, apply=each.apply, held=held):
            counts.append(len(select(frame.instances, held)))
            return apply(frame, state)

        each.apply = watched
        return counts
    raise AssertionError("no filter with masks")


@pytest.mark.parametrize("spec", MASKED, ids=lambda spec: spec.id)
def test_a_missed_person_is_bridged_for_as_long_as_promised(
    spec: TrackerSpec, frames: list[Frame], recorded: Path
) -> None:
    promised = spec.settings().segmentation.compensate
    assert promised == OWN.get(spec.id, SegmentationSettings().compensate)
    settings = {"segmentation.source": f"recorded:{recorded}", "segmentation.schedule": "every"} | quick(spec.settings)
    tracker = build_tracker(spec, settings, TrackerContext())
    assert isinstance(tracker, SlamPipeline)
    tracker.reset(CAMERA, rng=np.random.default_rng(0))
    if not any({"masks", "boxes"} & each.needs for each in tracker._filters):  # the vote of objects has its own way
        stage = tracker._masks
        assert stage is not None
        own = spec.settings().segmentation
        found = [select(stage.masks_for(each, each.rgb[:, :, 0], keyframe=False), own) for each in frames]
        assert [len(each) for each in found] == [1] * (SEEN + promised) + [0] * (FRAMES - SEEN - promised)
        return
    counts = seen_by_filters(tracker)
    results = [tracker.track(frame) for frame in frames]
    assert counts == [1] * (SEEN + promised) + [0] * (FRAMES - SEEN - promised)
    if spec.id in ONLY_MASKS:
        culled = [result.stats["culled"] > 0 for result in results]
        assert culled == [True] * (SEEN + promised) + [False] * (FRAMES - SEEN - promised)
