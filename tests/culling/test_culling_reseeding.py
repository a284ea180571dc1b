"""Re-seeding: static features elsewhere replace what fell to a mask."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from scenes import (
    CAMERA,
)

from dynslam_bench.contracts.filter import FilterState, FrameBundle
from dynslam_bench.culling.reseeding import ReseedingFilter
from dynslam_bench.culling.settings import ReseedingSettings
from dynslam_bench.features.orb import OrbExtractor
from dynslam_bench.features.settings import FeatureSettings


def textured(n_features: int) -> FrameBundle:
    """A frame full of corners, with the features that the extractor finds in it."""
    noise = np.random.default_rng(0).integers(0, 255, (480, 640), dtype=np.uint8)
    gray = cv2.normalize(cv2.GaussianBlur(noise, (0, 0), 1.5), None, 0, 255, cv2.NORM_MINMAX)
    features = OrbExtractor(FeatureSettings(n_features=n_features)).extract(gray)
    xy = features.xy.astype(np.float64)
    depth = np.full(gray.shape, 2.0, np.float32)
    return FrameBundle(
        0, 0.0, np.zeros((480, 640, 3), np.uint8), gray, depth, features, xy, np.full(len(xy), 2.0, "f4")
    )


def ids(frame: FrameBundle, rows: np.ndarray) -> set[tuple[float, float, int]]:
    places, octaves = frame.keypoints.xy[rows].tolist(), frame.keypoints.octave[rows].tolist()
    return {(x, y, octave) for (x, y), octave in zip(places, octaves, strict=True)}


def test_reseeding_replaces_what_fell_to_a_mask_with_static_features_elsewhere() -> None:
    frame = textured(900)
    block = ReseedingFilter(ReseedingSettings(budget=600), FeatureSettings(n_features=900))
    on_person = (frame.keypoints.xy[:, 0] > 420) & (frame.keypoints.xy[:, 1] > 60)
    assert on_person.sum() > 200
    verdict = block.apply(frame, FilterState(camera=CAMERA, keep=~on_person))
    used = verdict.keep & ~on_person
    assert used.sum() == min(600, (~on_person).sum())
    plain = block.apply(frame, FilterState(camera=CAMERA, keep=np.ones(len(frame), bool))).keep & ~on_person
    assert used.sum() > 1.2 * plain.sum(), "the static background has more features than without re-seeding"
    assert plain[used].sum() >= 0.95 * plain.sum(), "those that were there stay"
    assert verdict.stats["reseeded"] == np.count_nonzero(used & ~plain) > 100
    assert verdict.stats["static"] == np.count_nonzero(~on_person)
    assert verdict.keep[on_person].all(), "what earlier filters dropped is not judged again"


def test_reseeding_changes_nothing_where_nothing_is_dynamic() -> None:
    frame, usual = textured(900), textured(600)
    block = ReseedingFilter(ReseedingSettings(budget=600), FeatureSettings(n_features=900))
    verdict = block.apply(frame, FilterState(camera=CAMERA, keep=np.ones(len(frame), bool)))
    assert verdict.stats["reseeded"] == 0 and verdict.stats["missing"] == 0
    assert ids(frame, verdict.keep) == ids(usual, np.ones(len(usual), bool)), "the features that other systems get"


@pytest.mark.parametrize("left", [0, 1, 400])
def test_reseeding_leaves_all_that_there_is_where_it_is_less_than_the_budget(left: int) -> None:
    frame = textured(900)
    keep = np.arange(len(frame)) < left
    block = ReseedingFilter(ReseedingSettings(budget=600), FeatureSettings(n_features=900))
    verdict = block.apply(frame, FilterState(camera=CAMERA, keep=keep))
    assert verdict.keep.all() and verdict.stats["missing"] == 600 - left
