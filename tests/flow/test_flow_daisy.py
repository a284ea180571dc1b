"""DAISY: against a slow reference, against scikit-image, and its behaviour under rotation and scale."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import torch
from daisy_reference import describe, gaussian_weights
from scipy import ndimage

from dynslam_bench.flow import layout
from dynslam_bench.flow import matching_cost as matching
from dynslam_bench.flow.orientation_maps import orientation_maps
from dynslam_bench.flow.settings import FlowSettings


def picture(seed=0, shape=(160, 200)):
    rng = np.random.default_rng(seed)
    layers = [
        cv2.resize(rng.uniform(0, 1, (shape[0] // k, shape[1] // k)), shape[::-1], interpolation=cv2.INTER_CUBIC)
        for k in (4, 10, 25)
    ]
    return np.clip(sum(layers) / 3, 0, 1).astype(np.float64)


def ours(image, points, scale=1.0, rotation=0.0):
    points = torch.as_tensor(np.atleast_2d(points), dtype=torch.float64)[None]
    shape = points.shape[:2]
    return describe(
        torch.as_tensor(image)[None],
        points,
        torch.full(shape, scale, dtype=torch.float64),
        torch.full(shape, rotation, dtype=torch.float64),
    )[0].numpy()


def slow(image, x, y):
    """The definition, point by point, with scipy's filters."""
    padded = np.pad(image, 1, mode="edge")
    gx, gy = (padded[1:-1, 2:] - padded[1:-1, :-2]) / 2, (padded[2:, 1:-1] - padded[:-2, 1:-1]) / 2
    out = []
    rings = [(r * np.cos(a), r * np.sin(a)) for r in (8, 16) for a in np.arange(8) * np.pi / 4]
    for k, (dx, dy) in enumerate([(0, 0), *rings]):
        sigma = 4 if k < 9 else 8
        weights = gaussian_weights(sigma).astype(float)
        kernel = np.concatenate([weights[:0:-1], weights])
        histogram = []
        for b in range(8):
            layer = np.maximum(gx * np.cos(b * np.pi / 4) + gy * np.sin(b * np.pi / 4), 0)
            for axis in (0, 1):
                layer = ndimage.correlate1d(layer, kernel, axis=axis, mode="nearest")
            histogram.append(ndimage.map_coordinates(layer, [[y + dy], [x + dx]], order=1)[0])
        histogram = np.array(histogram)
        out.append(histogram / (np.linalg.norm(histogram) + 0.01))
    return np.array(out)


def test_layout_is_the_official_one():
    assert (layout.HISTOGRAMS, layout.BINS, layout.LENGTH) == (17, 8, 136)
    pattern = layout.unit_pattern()
    np.testing.assert_allclose(np.hypot(*pattern.T), [0] + [8] * 8 + [16] * 8, atol=1e-12)
    table = layout.sampling_table()
    assert np.abs(table.offsets).max() <= layout.MARGIN * layout.SUBPIXEL - layout.SUBPIXEL
    neutral = table.offsets[-layout.SCALE_LOW, -layout.ANGLE_LOW] / layout.SUBPIXEL
    np.testing.assert_allclose(neutral, pattern, atol=0.5 / layout.SUBPIXEL)


def test_equals_a_slow_reference():
    image = picture(1)
    for x, y in ((70, 60), (101.3, 88.7)):
        np.testing.assert_allclose(ours(image, (x, y))[0], slow(image, x, y), atol=1e-6)


def test_resembles_scikit_image():
    feature = pytest.importorskip("skimage.feature")
    image = picture(2)
    theirs = feature.daisy(
        image, step=1, radius=16, rings=2, histograms=8, orientations=8, normalization="daisy", sigmas=[4, 4, 8],
        ring_radii=[8, 16],
    )  # fmt: skip
    points = np.random.default_rng(0).integers(40, 120, (60, 2))
    found = ours(image, points)
    expected = theirs[points[:, 1] - 16, points[:, 0] - 16].reshape(60, 17, 8)
    expected = np.roll(expected, 4, axis=2)  # their bins start at -180 degrees
    norm = np.linalg.norm(found, axis=2) * np.linalg.norm(expected, axis=2)
    similarity = (found * expected).sum(axis=2) / norm
    assert np.median(similarity) > 0.97  # they weigh directions by a von Mises function, not by a rectified cosine
    wrong = (found * expected[::-1]).sum(axis=2) / (
        np.linalg.norm(found, axis=2) * np.linalg.norm(expected[::-1], axis=2)
    )
    assert np.median(wrong) < np.median(similarity) - 0.05


@pytest.mark.parametrize(("scale", "degrees"), [(1.0, 30.0), (1.0, -45.0), (1.6, 0.0), (0.7, 0.0), (1.4, 20.0)])
def test_scaled_and_rotated_sampling_undoes_a_similarity(scale, degrees):
    image = picture(3, (240, 300))
    centre = np.array([150.0, 120.0])
    c, s = scale * np.cos(np.deg2rad(degrees)), scale * np.sin(np.deg2rad(degrees))
    matrix = np.array([[c, -s, 0], [s, c, 0]])
    matrix[:, 2] = centre - matrix[:, :2] @ centre
    warped = cv2.warpAffine(image, matrix, (300, 240), flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
    points = centre + np.random.default_rng(0).uniform(-25, 25, (20, 2))
    there = points @ matrix[:, :2].T + matrix[:, 2]
    reference = ours(image, points)
    matched = np.abs(ours(warped, there, scale, np.deg2rad(degrees)) - reference).sum((1, 2))
    ignored = np.abs(ours(warped, there) - reference).sum((1, 2))
    assert np.median(matched) < 0.5 * np.median(ignored)


def compiled_cost(first, second, points, labels, **settings):
    reference, target = orientation_maps(first), orientation_maps(second)
    tables = matching.tables_for(first.shape, FlowSettings(**settings))
    supports = len(tables.support)
    descriptors = np.empty(len(points) * supports * 13 * 136, np.uint8)
    matching.describe(0, len(points), points, matching.side(reference), tables, descriptors)
    appearance = np.zeros((len(points), supports, 2), np.int32)
    matching.reference_appearance(points, matching.side(reference), tables, appearance)
    out = np.empty(len(points), np.int64)
    described = matching.Reference(points, descriptors, appearance)
    matching.label_costs(0, len(points), labels, described, matching.side(target), tables, out)
    return out, tables


def test_compiled_cost_follows_the_reference_descriptor():
    image = (picture(4, (240, 320)) * 255).astype(np.uint8)
    rng = np.random.default_rng(1)
    points = rng.uniform((60, 60), (260, 180), (200, 2)).astype(np.float32)
    labels = np.zeros((200, 4), np.float32)
    labels[:, :2] = rng.uniform(-15, 15, (200, 2))
    cost, tables = compiled_cost(image, image, points, labels)
    here, there = ours(image / 255.0, points), ours(image / 255.0, points + labels[:, :2])
    expected = np.minimum(np.abs(here - there).sum(2), 0.882).sum(1) * 255
    assert np.corrcoef(cost, expected)[0, 1] > 0.95
    assert (cost <= tables.ceiling).all()
    zero, _ = compiled_cost(image, image, points, np.zeros_like(labels))
    assert (zero == 0).all()


def test_right_scale_and_rotation_cost_least():
    image = (picture(5, (240, 320)) * 255).astype(np.uint8)
    c, s = 2**0.5 * np.cos(np.deg2rad(22.5)), 2**0.5 * np.sin(np.deg2rad(22.5))
    matrix = np.array([[c, -s, 0], [s, c, 0]])
    matrix[:, 2] = np.array([160, 120]) - matrix[:, :2] @ (160, 120)
    warped = cv2.warpAffine(image, matrix, (320, 240), borderMode=cv2.BORDER_REFLECT)
    points = np.random.default_rng(0).uniform((130, 95), (190, 145), (50, 2)).astype(np.float32)
    labels = np.zeros((50, 4), np.float32)
    labels[:, :2] = points @ matrix[:, :2].T + matrix[:, 2] - points
    costs = {}
    for octaves in (0.0, 0.5, 1.0):
        for degrees in (0.0, 22.5, 45.0):
            labels[:, 2:] = octaves, np.deg2rad(degrees)
            costs[octaves, degrees] = np.median(compiled_cost(image, warped, points, labels)[0])
    assert min(costs, key=costs.get) == (0.5, 22.5)


def test_appearance_terms_add_truncated_differences():
    flat = np.full((100, 120), 100, np.uint8)
    points, labels = np.array([[50, 50]], np.float32), np.zeros((1, 4), np.float32)
    weights = {"terms": 3, "gradient_weight": 0.0, "intensity_weight": 55.0, "intensity_limit": 7 / 255}
    for step, expected in ((0, 0), (3, 55 * 3 / 255), (7, 55 * 7 / 255), (60, 55 * 7 / 255)):
        cost, _ = compiled_cost(flat, flat + np.uint8(step), points, labels, **weights)
        assert cost[0] == pytest.approx(255 * expected, abs=1)
    ramp = np.tile(np.arange(0, 240, 2, dtype=np.uint8), (100, 1))
    without, _ = compiled_cost(flat, ramp, points, labels)
    having, _ = compiled_cost(flat, ramp, points, labels, terms=3, intensity_weight=0.0)
    assert having[0] - without[0] == pytest.approx(255 * 190 * 2 / 255, abs=1)


def test_labels_outside_cost_more_than_any_inside():
    image = (picture(6) * 255).astype(np.uint8)
    points = np.array([[5, 5], [195, 155], [100, 80], [100, 80]], np.float32)
    labels = np.array([[-6, 0, 0, 0], [0, 9, 0, 0], [np.nan, 0, 0, 0], [1e30, 0, 0, 0]], np.float32)
    cost, tables = compiled_cost(image, image, points, labels)
    assert (cost == matching.OUTSIDE).all() and tables.ceiling < matching.OUTSIDE
