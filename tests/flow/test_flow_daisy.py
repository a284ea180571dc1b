"""DAISY: against its definition, against scikit-image, and its behaviour under rotation and scale."""

import numpy as np
import pytest
from helpers.flow_pictures import moved, moved_points, picture
from scipy.ndimage import gaussian_filter, map_coordinates

from dynslam_bench.core.compiled import kernel
from dynslam_bench.flow import layout, matching_cost
from dynslam_bench.flow.orientation_maps import orientation_maps

PARTIAL_FLOOR = 0.01


def describe(image, points):
    """DAISY descriptors ``[N, 17, 8]`` of points ``[N, 2]`` by their definition (Tola, Lepetit, Fua 2010).

    With DAISY Filter Flow's layout: rectified directional derivatives, blurred at full resolution
    with the Gaussian of each ring, sampled bilinearly, each histogram normalised on its own.
    Samples outside the image are zero.
    """
    gray = np.pad(image / 255.0, 1, mode="edge")
    gx = (gray[1:-1, 2:] - gray[1:-1, :-2]) / 2
    gy = (gray[2:, 1:-1] - gray[:-2, 1:-1]) / 2
    angle = np.arange(layout.BINS) * (2 * np.pi / layout.BINS)
    derivatives = np.maximum(
        gx * np.cos(angle)[:, None, None] + gy * np.sin(angle)[:, None, None], 0
    )
    x, y = np.moveaxis(np.asarray(points)[:, None] + layout.unit_pattern(), -1, 0)
    out = np.zeros((len(points), layout.HISTOGRAMS, layout.BINS))
    for sigma, ring in zip(layout.RING_SIGMAS, (slice(0, 9), slice(9, 17)), strict=True):
        for b, derivative in enumerate(derivatives):
            blurred = gaussian_filter(derivative, sigma, mode="nearest", truncate=2.5)
            out[:, ring, b] = map_coordinates(blurred, (y[:, ring], x[:, ring]), order=1)
    return out / (np.linalg.norm(out, axis=-1, keepdims=True) + PARTIAL_FLOOR)


def test_layout_is_the_official_one():
    assert (layout.HISTOGRAMS, layout.BINS, layout.LENGTH) == (17, 8, 136)
    pattern = layout.unit_pattern()
    np.testing.assert_allclose(np.hypot(*pattern.T), [0] + [8] * 8 + [16] * 8, atol=1e-12)
    offsets, _ = layout.sampling_table()
    assert np.abs(offsets).max() <= layout.MARGIN * layout.SUBPIXEL - layout.SUBPIXEL
    neutral = offsets[-layout.SCALE_LOW, -layout.ANGLE_LOW] / layout.SUBPIXEL
    np.testing.assert_allclose(neutral, pattern, atol=0.5 / layout.SUBPIXEL)


def test_resembles_scikit_image():
    feature = pytest.importorskip("skimage.feature")
    image = picture(2, (160, 200))
    theirs = feature.daisy(
        image / 255.0, step=1, radius=16, rings=2, histograms=8, orientations=8, normalization="daisy",
        sigmas=[4, 4, 8], ring_radii=[8, 16],
    )  # fmt: skip
    points = np.random.default_rng(0).integers(40, 120, (60, 2))
    # their bins start at -180 degrees
    expected = np.roll(theirs[points[:, 1] - 16, points[:, 0] - 16].reshape(60, 17, 8), 4, axis=2)
    descriptors = describe(image, points)

    def similarity(other):
        norm = np.linalg.norm(descriptors, axis=2) * np.linalg.norm(other, axis=2)
        return np.median((descriptors * other).sum(axis=2) / norm)

    # they weigh directions by a von Mises function, not by a rectified cosine
    assert similarity(expected) > 0.97
    assert similarity(expected[::-1]) < similarity(expected) - 0.03


@kernel
def label_costs(labels, matching, out):
    for i in range(len(labels)):
        u, v, s, theta = labels[i]
        out[i] = matching_cost.label_cost(i, (u, v, s, theta), matching, matching_cost.OUTSIDE)


def compiled_cost(first, second, points, labels, terms=1, support=1):
    """Costs ``[N]`` of one label a point, the tables, and the reference descriptors."""
    tables = matching_cost.cost_tables(first.shape, terms, support)
    here, there = (orientation_maps(image).arrays_with_gradients for image in (first, second))
    descriptors = np.empty(len(points) * support * 13 * 136, np.uint8)
    appearance = np.zeros((len(points), support, 2), np.int32)
    matching_cost.describe(0, len(points), points, here, tables, descriptors, appearance)
    out = np.empty(len(points), np.int64)
    reference = matching_cost.Reference(points, descriptors, appearance)
    label_costs(labels, matching_cost.MatchingCost(reference, there, tables), out)
    return out, tables, descriptors


def test_compiled_cost_follows_the_reference_descriptor():
    image = picture(4)
    rng = np.random.default_rng(1)
    points = rng.uniform((60, 60), (260, 180), (200, 2)).astype(np.float32)
    labels = np.zeros((200, 4), np.float32)
    labels[:, :2] = rng.uniform(-15, 15, (200, 2))
    cost, tables, _ = compiled_cost(image, image, points, labels)
    here = describe(image, points)
    there = describe(image, points + labels[:, :2])
    expected = np.minimum(np.abs(here - there).sum(2), 0.882).sum(1) * 255
    assert np.corrcoef(cost, expected)[0, 1] > 0.93
    assert (cost <= tables.ceiling).all()
    assert (compiled_cost(image, image, points, np.zeros_like(labels))[0] == 0).all()


def test_the_cost_over_a_support_is_the_sum_over_its_points():
    shape = (120, 160)
    rng = np.random.default_rng(0)
    first = picture(2, shape)
    second = picture(3, shape)
    points = rng.uniform((40, 40), (120, 80), (400, 2)).astype(np.float32)
    labels = (rng.uniform(-1, 1, (400, 4)) * (20, 20, 1.0, 0.7)).astype(np.float32)
    cost, tables, _ = compiled_cost(first, second, points, labels, support=5)
    a, b = np.exp2(labels[:, 2]) * (np.cos(labels[:, 3]), np.sin(labels[:, 3]))
    total = np.zeros_like(cost)
    for dx, dy in tables.support:
        shift = np.column_stack([a * dx - b * dy - dx, b * dx + a * dy - dy, *np.zeros((2, 400))])
        total += compiled_cost(
            first, second, points + np.float32((dx, dy)), labels + shift.astype(np.float32)
        )[0]
    assert (total == cost).mean() > 0.97  # rounded cosines may fall into neighbouring cells


def test_right_scale_and_rotation_cost_least():
    image = picture(5)
    warped, matrix = moved(image, 2**0.5, 22.5)
    points = np.random.default_rng(0).uniform((130, 95), (190, 145), (50, 2)).astype(np.float32)
    labels = np.zeros((50, 4), np.float32)
    labels[:, :2] = moved_points(points, matrix) - points
    costs = {}
    for octaves in (0.0, 0.5, 1.0):
        for degrees in (0.0, 22.5, 45.0):
            labels[:, 2:] = octaves, np.deg2rad(degrees)
            costs[octaves, degrees] = np.median(compiled_cost(image, warped, points, labels)[0])
    assert min(costs, key=costs.get) == (0.5, 22.5)


def test_appearance_terms_add_truncated_differences():
    flat = np.full((100, 120), 100, np.uint8)
    points = np.array([[50, 50]], np.float32)
    labels = np.zeros((1, 4), np.float32)
    for step, expected in ((0, 0), (3, 55 * 3 / 255), (7, 55 * 7 / 255), (60, 55 * 7 / 255)):
        cost, _, _ = compiled_cost(flat, flat + np.uint8(step), points, labels, terms=3)
        assert cost[0] == pytest.approx(255 * expected, abs=1)
    ramp = np.tile(np.arange(0, 240, 2, dtype=np.uint8), (100, 1))
    without, having = (compiled_cost(flat, ramp, points, labels, terms)[0] for terms in (1, 3))
    # the ramp has the level of the flat image there
    assert having[0] - without[0] == pytest.approx(190 * 2, abs=1)


def test_labels_outside_cost_more_than_any_inside():
    image = picture(6, (160, 200))
    points = np.array([[5, 5], [195, 155], [100, 80], [100, 80]], np.float32)
    labels = np.array([[-6, 0, 0, 0], [0, 9, 0, 0], [np.nan, 0, 0, 0], [1e30, 0, 0, 0]], np.float32)
    cost, tables, _ = compiled_cost(image, image, points, labels)
    assert (cost == matching_cost.OUTSIDE).all()
    assert tables.ceiling < matching_cost.OUTSIDE
