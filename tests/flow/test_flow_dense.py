"""Guided filter, superpixels and the dense flow."""

from __future__ import annotations

import numpy as np
import pytest
from pictures import moved, moved_points, picture

from dynslam_bench.flow.dense_flow import DenseDaisyFlow, consistent
from dynslam_bench.flow.dense_kernels import filter_patch, superpixels
from dynslam_bench.flow.settings import DenseFlowSettings


def guided_filter(guide, values, radius, epsilon):
    """`filter_patch` of a whole image."""
    guide, values = (np.ascontiguousarray(array, np.float32) for array in (guide, values))
    out, work = np.empty_like(guide), np.empty((6, guide.size), np.float32)
    size = guide.shape
    filter_patch(guide.ravel(), values.ravel(), *size, radius, np.float32(epsilon), work, out.reshape(-1))
    return out


def direct_guided_filter(guide, values, radius, epsilon):
    """He, Sun and Tang's definition, window by window."""
    height, width = guide.shape
    a, b = np.empty_like(values), np.empty_like(values)
    window = lambda z, y, x: z[max(y - radius, 0) : y + radius + 1, max(x - radius, 0) : x + radius + 1]  # noqa: E731
    for y in range(height):
        for x in range(width):
            i, p = window(guide, y, x), window(values, y, x)
            a[y, x] = ((i * p).mean() - i.mean() * p.mean()) / (i.var() + epsilon)
            b[y, x] = p.mean() - a[y, x] * i.mean()
    out = np.empty_like(values)
    for y in range(height):
        for x in range(width):
            out[y, x] = window(a, y, x).mean() * guide[y, x] + window(b, y, x).mean()
    return out


@pytest.mark.parametrize(("shape", "radius", "epsilon"), [((20, 27), 3, 0.01), ((9, 8), 4, 1e-3), ((3, 30), 5, 0.1)])
def test_guided_filter_equals_the_direct_reference(shape, radius, epsilon):
    rng = np.random.default_rng(0)
    guide, values = rng.uniform(0, 1, shape), rng.uniform(0, 4000, shape)
    expected = direct_guided_filter(guide, values, radius, epsilon)
    np.testing.assert_allclose(guided_filter(guide, values, radius, epsilon), expected, rtol=1e-3, atol=1.0)


def test_guided_filter_without_regularisation():
    values = np.random.default_rng(0).random((8, 9)).astype(np.float32)
    flat = guided_filter(np.full((8, 9), 0.5, np.float32), values, 3, 0.0)
    assert np.isfinite(flat).all() and flat.min() >= values.min() and flat.max() <= values.max()


def test_filtering_a_patch_with_twice_the_radius_around_equals_the_whole():
    rng = np.random.default_rng(1)
    guide, values = rng.uniform(0, 1, (60, 70)), rng.uniform(0, 100, (60, 70))
    whole = guided_filter(guide, values, 4, 0.01)
    part = guided_filter(guide[12:48, 15:55], values[12:48, 15:55], 4, 0.01)
    np.testing.assert_allclose(part[8:-8, 8:-8], whole[20:40, 23:47], rtol=1e-3, atol=0.05)


def test_superpixels_cover_the_image_and_follow_edges():
    image = np.full((60, 80), 40, np.uint8)
    image[:, 43:] = 200
    regions = superpixels(image, 10)
    count = len(regions.centres)
    assert count == 48 and regions.labels.min() >= 0 and regions.labels.max() < count
    assert sorted(regions.members.tolist()) == list(range(60 * 80)) and regions.starts[-1] == 60 * 80
    for k in range(count):
        members = regions.members[regions.starts[k] : regions.starts[k + 1]]
        assert (regions.labels.ravel()[members] == k).all()
        assert len(np.unique(image.ravel()[members])) <= 1  # no region straddles the edge


def test_consistency_check():
    forward = np.zeros((10, 12, 2), np.float32)
    forward[..., 0] = 3
    backward = -forward
    valid = consistent(forward, backward, 1.0)
    assert valid[:, :9].all() and not valid[:, 9:].any()
    backward[5, 6] = 2
    assert not consistent(forward, backward, 1.0)[5, 3]


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
    assert np.median(error) < 0.3 and (error > 3).mean() < 0.05
    assert results[0].valid[inner].mean() > 0.9
    assert np.isfinite(results[0].flow).all() and (results[0].cost <= 1).all()
