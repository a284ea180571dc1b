"""Guided filter, superpixels and the dense flow."""

import numpy as np
import pytest
from helpers.exact_reference import binomial, quantised_maps
from helpers.flow_pictures import moved, moved_points, picture

from dynslam_bench.flow import layout
from dynslam_bench.flow.dense_flow import (
    DenseDaisyFlow,
    consistent,
    filter_patch,
    frame_patch,
    superpixels,
)
from dynslam_bench.flow.orientation_maps import orientation_maps
from dynslam_bench.flow.registry import build_flow
from dynslam_bench.flow.settings import DenseFlowSettings
from dynslam_bench.flow.workers import Workers


def guided_filter(guide, values, radius, epsilon):
    """`filter_patch` of a whole image."""
    framed = np.pad(np.asarray(values, np.float32), radius)
    patch = np.empty(framed.size, np.float32)
    work = np.empty((8, framed.size), np.float32)
    frame_patch(np.ascontiguousarray(guide, np.float32), 0, 0, *guide.shape, radius, patch, work)
    filter_patch(patch, framed.reshape(-1), framed.shape[1], radius, np.float32(epsilon), work)
    return framed[radius:-radius, radius:-radius]


def direct_guided_filter(guide, values, radius, epsilon):
    """He, Sun and Tang's definition, window by window."""
    height, width = guide.shape
    a = np.empty_like(values)
    b = np.empty_like(values)

    def window(z, y, x):
        return z[max(y - radius, 0) : y + radius + 1, max(x - radius, 0) : x + radius + 1]

    for y in range(height):
        for x in range(width):
            i = window(guide, y, x)
            p = window(values, y, x)
            a[y, x] = ((i * p).mean() - i.mean() * p.mean()) / (i.var() + epsilon)
            b[y, x] = p.mean() - a[y, x] * i.mean()
    out = np.empty_like(values)
    for y in range(height):
        for x in range(width):
            out[y, x] = window(a, y, x).mean() * guide[y, x] + window(b, y, x).mean()
    return out


@pytest.mark.parametrize(
    ("shape", "radius", "epsilon"), [((20, 27), 3, 0.01), ((9, 8), 4, 1e-3), ((3, 30), 5, 0.1)]
)
def test_guided_filter_equals_the_direct_reference(shape, radius, epsilon):
    rng = np.random.default_rng(0)
    guide = rng.uniform(0, 1, shape)
    values = rng.uniform(0, 4000, shape)
    expected = direct_guided_filter(guide, values, radius, epsilon)
    np.testing.assert_allclose(
        guided_filter(guide, values, radius, epsilon), expected, rtol=1e-3, atol=1.0
    )


def test_guided_filter_without_regularisation():
    values = np.random.default_rng(0).random((8, 9)).astype(np.float32)
    flat = guided_filter(np.full((8, 9), 0.5, np.float32), values, 3, 0.0)
    assert np.isfinite(flat).all()
    assert flat.min() >= values.min()
    assert flat.max() <= values.max()


def test_superpixels_cover_the_image_and_follow_edges():
    image = np.full((60, 80), 40, np.uint8)
    image[:, 43:] = 200
    regions = superpixels(image, 10)
    count = len(regions.centres)
    assert count == 48
    assert regions.labels.min() >= 0
    assert regions.labels.max() < count
    assert sorted(regions.members.tolist()) == list(range(60 * 80))
    assert regions.starts[-1] == 60 * 80
    for k in range(count):
        members = regions.members[regions.starts[k] : regions.starts[k + 1]]
        assert (regions.labels.ravel()[members] == k).all()
        assert len(np.unique(image.ravel()[members])) <= 1  # no region straddles the edge


def check(forward, backward, tolerance):
    """`consistent` of all rows."""
    valid = np.empty(forward.shape[:2], bool)
    consistent(0, len(valid), forward, backward, np.float32(tolerance), valid)
    return valid


def test_consistency_check():
    forward = np.zeros((10, 12, 2), np.float32)
    forward[..., 0] = 3
    backward = -forward
    valid = check(forward, backward, 1.0)
    assert valid[:, :9].all()
    assert not valid[:, 9:].any()
    backward[5, 6] = 2
    assert not check(forward, backward, 1.0)[5, 3]


def test_dense_flow_of_a_similarity_and_its_thread_independence():
    image = picture(1, (120, 160))
    target, matrix = moved(image, 1.08, 6, 7, -5)
    results = []
    for threads in (1, 2):
        dense = DenseDaisyFlow(DenseFlowSettings(range_px=32), threads=threads)
        results.append(dense.flow(dense.prepare(image), dense.prepare(target), seed=3))
    np.testing.assert_array_equal(results[0].flow, results[1].flow)
    y, x = np.mgrid[:120, :160]
    truth = moved_points(np.stack([x, y], -1), matrix) - np.stack([x, y], -1)
    inner = np.s_[20:-20, 20:-20]
    error = np.linalg.norm(results[0].flow - truth, axis=2)[inner]
    assert np.median(error) < 0.3
    assert (error > 3).mean() < 0.05
    assert results[0].valid[inner].mean() > 0.9
    assert np.isfinite(results[0].flow).all()
    assert (results[0].cost <= 1).all()


# Orientation maps: exact against plain numpy code, their blurs, their threads, and reused memory.


def noise(shape, seed=0):
    return np.random.default_rng(seed).integers(0, 256, shape, dtype=np.uint8)


@pytest.mark.parametrize(
    "shape", [(120, 160), (97, 131), (33, 47), (9, 17), (7, 2), (2, 3), (1, 5), (1, 1)]
)
@pytest.mark.parametrize("kind", ["smooth", "noise", "extremes"])
def test_maps_equal_the_reference_exactly_with_any_number_of_threads(shape, kind):
    gray = noise(shape, 1)
    if kind == "smooth":
        gray = picture(1)[: shape[0], : shape[1]].copy()
    elif kind == "extremes":  # the largest derivatives there are
        gray = np.where(gray > 127, 255, 0).astype(np.uint8)
    expected = quantised_maps(gray)
    y, x = (np.minimum(np.arange(2 * max(1, n // 2)), n - 1) for n in shape)
    even = gray[np.ix_(y, x)].astype(int)
    half = (even[::2, ::2] + even[::2, 1::2] + even[1::2, ::2] + even[1::2, 1::2] + 2) >> 2
    for threads in (1, 2, 8):
        maps = orientation_maps(gray, Workers(threads))
        np.testing.assert_array_equal(maps.histograms, expected)
        np.testing.assert_array_equal(maps.framed, np.pad(gray, 48, mode="edge"))
        np.testing.assert_array_equal(maps.framed_half, np.pad(half, 48, mode="edge"))


def test_blurs_have_the_variances_of_their_gaussians():
    """An impulse through the cascade: each level's variance in full-image pixels, the mean of 2 x 2 included."""
    step = 2
    variance = 0.0
    x = np.arange(257) - 128
    line = (x == 0).astype(np.int64)[None, None] << 24
    for sigma, level_step, (taps, distance) in zip(
        layout.LEVEL_SIGMAS, layout.LEVEL_STEPS, layout.LEVEL_BLURS, strict=True
    ):
        if level_step != step:  # a mean of two, read at every second place
            variance = variance + 0.25 * step**2
            step = level_step
        weight = binomial(line, 2, taps, distance)[0, 0]
        variance += (weight * x**2).sum() / weight.sum() * step**2
        assert variance**0.5 == pytest.approx(sigma, rel=0.04)


def test_memory_is_reused_only_when_nothing_refers_to_it():
    flow = build_flow()
    images = [noise((60, 80), seed) for seed in range(8)]
    expected = [orientation_maps(image) for image in images]
    held = [flow.prepare(image) for image in images[:6]]
    for _ in range(6):
        flow.prepare(images[7])
    for maps, fresh in zip(
        [*held, flow.prepare(images[3])], [*expected[:6], expected[3]], strict=True
    ):
        for name in ("histograms", "framed", "framed_half"):
            np.testing.assert_array_equal(getattr(maps, name), getattr(fresh, name))


def test_the_memory_of_deleted_maps_is_used_again():
    buffers = []
    image = noise((60, 80))
    maps = orientation_maps(image, buffers=buffers)
    address = maps.histograms.ctypes.data
    assert orientation_maps(image, buffers=buffers).histograms.ctypes.data != address
    del maps
    assert orientation_maps(image, buffers=buffers).histograms.ctypes.data == address
    assert orientation_maps(image[:30], buffers=buffers).gray.shape == (30, 80)
