"""Each flow setting acts in the flow that it belongs to."""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np
import pytest
from pictures import moved_points, picture

from dynslam_bench.contracts.flow import FlowEstimator
from dynslam_bench.core.settings import parameters
from dynslam_bench.flow.registry import build_flow
from dynslam_bench.flow.settings import DenseFlowSettings, FlowMethodSettings, FlowSettings

DENSE = DenseFlowSettings(budget=48, sweeps=3)
BASES = {
    "sparse": FlowSettings(),
    "dense": DENSE,
    "lucas-kanade": FlowMethodSettings(method="lucas-kanade"),
    "dis": FlowMethodSettings(method="dis"),
}
FIXED = {
    "sparse": {
        "neighbours": 0, "similarity_seeds": False, "scale_range_octaves": 0.1, "rotation_range_deg": 5.0,
        "support": 5, "terms": 3, "refinement": "none", "refinement_window_px": 9,
    },
    "dense": {
        "terms": 3, "refinement": "none", "superpixel_px": 20, "candidates": 2, "filter_radius_px": 12,
        "filter_epsilon": 0.1, "consistency_px": 0.5, "second_round": False,
    },
    "lucas-kanade": {"window_px": 9},
    "dis": {"dis_preset": "ultrafast"},
}  # fmt: skip
"""Settings that studies do not tune, with a value other than the default."""
MATRIX = cv2.getRotationMatrix2D((64, 48), 14, 0.85)
MATRIX[:, 2] += 9, -6
POINTS = np.stack(np.meshgrid(np.arange(12, 120, 9), np.arange(12, 88, 9)), -1).reshape(-1, 2).astype(np.float32)


@lru_cache(maxsize=1)
def pair() -> tuple[np.ndarray, np.ndarray]:
    """A rotated, shrunk and darkened image with an object in it that moves by itself, and noise in both."""
    rng, image = np.random.default_rng(3), picture(3, (96, 128)).astype(float)
    target = cv2.warpAffine(image, MATRIX, (128, 96), borderMode=cv2.BORDER_REFLECT)
    target[32:64, 48:80] = image[28:60, 64:96]
    first, second = (np.clip(i + rng.normal(0, 5, i.shape), 0, 255).astype(np.uint8) for i in (image, target - 12))
    return first, second


@lru_cache(maxsize=512)
def output(settings: FlowMethodSettings) -> bytes:
    flow = build_flow(settings)
    result = flow.track(*(flow.prepare(image) for image in pair()), POINTS, seed=5)
    return result.xy.tobytes() + result.valid.tobytes() + result.cost.tobytes()


def cases() -> list[tuple[str, str, tuple[object, ...]]]:
    tuned = [(kind, p.name, p.choices or (p.low, p.high)) for kind in BASES for p in parameters(type(BASES[kind]))]
    return tuned + [(kind, name, (value,)) for kind, values in FIXED.items() for name, value in values.items()]


@pytest.mark.parametrize(("kind", "name", "values"), cases())
def test_a_setting_acts_in_its_flow(kind: str, name: str, values: tuple[object, ...]) -> None:
    tried = {output(BASES[kind].model_copy(update={name: value})) for value in values}
    assert tried | {output(BASES[kind])} != {output(BASES[kind])}


def test_the_dense_flow_reads_its_field_at_the_points() -> None:
    flow = build_flow(DENSE)
    assert isinstance(flow, FlowEstimator)
    first, second = (flow.prepare(image) for image in pair())
    unusable = np.array([[np.nan, 5], [-3, 5], [500, 5]], np.float32)
    result = flow.track(first, second, np.concatenate([POINTS, unusable]), seed=5)
    assert result.xy.dtype == result.cost.dtype == np.float32 and not result.valid[-3:].any()
    assert 0.3 < result.valid.mean() < 1 and result.stats["valid"] == result.valid.sum()
    xy, valid = result.xy[:-3], result.valid[:-3]
    elsewhere = (np.abs(xy - (64, 48)) > 20).any(axis=1)  # not on the other object
    assert np.median(np.linalg.norm(xy - moved_points(POINTS, MATRIX), axis=1)[valid & elsewhere]) < 0.7
    degenerate = flow.track(first, first, POINTS)
    assert set(degenerate.stats) == set(result.stats) and not degenerate.valid.any()
    assert len(flow.track(first, second, POINTS[:0]).xy) == 0


def test_settings_of_the_dense_flow_take_effect_at_once() -> None:
    flow = build_flow(DENSE)
    first, second = (flow.prepare(image) for image in pair())
    before = flow.track(first, second, POINTS, seed=5)
    flow.configure(DENSE.model_copy(update={"forward_backward_px": 0.25}))
    assert flow.track(first, second, POINTS, seed=5).valid.sum() < before.valid.sum()
    flow.configure(DENSE)
    np.testing.assert_array_equal(flow.track(first, second, POINTS, seed=5).valid, before.valid)
