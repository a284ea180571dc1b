"""Orientation maps: exact against plain numpy code, their blurs, their threads, and reused memory."""

from __future__ import annotations

import numpy as np
import pytest
from exact_reference import binomial, quantised_maps
from pictures import picture

from dynslam_bench.flow import layout
from dynslam_bench.flow.orientation_maps import BufferPool, orientation_maps
from dynslam_bench.flow.registry import build_flow
from dynslam_bench.flow.workers import Workers


def noise(shape, seed=0):
    return np.random.default_rng(seed).integers(0, 256, shape, dtype=np.uint8)


@pytest.mark.parametrize("shape", [(120, 160), (97, 131), (33, 47), (9, 17), (7, 2), (2, 3), (1, 5), (1, 1)])
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
    step, variance = 2, 0.0
    x = np.arange(257) - 128
    line = (x == 0).astype(np.int64)[None, None] << 24
    for sigma, level_step, (taps, distance) in zip(
        layout.LEVEL_SIGMAS, layout.LEVEL_STEPS, layout.LEVEL_BLURS, strict=True
    ):
        if level_step != step:  # a mean of two, read at every second place
            variance, step = variance + 0.25 * step**2, level_step
        weight = binomial(line, 2, taps, distance)[0, 0]
        variance += (weight * x**2).sum() / weight.sum() * step**2
        assert variance**0.5 == pytest.approx(sigma, rel=0.04)


def test_memory_is_reused_only_when_nothing_refers_to_it():
    flow = build_flow()
    images = [noise((60, 80), seed) for seed in range(8)]
    expected = [orientation_maps(image) for image in images]
    held = [flow.prepare(image) for image in images[:6]]  # more than the pool stores
    view = flow.prepare(images[6]).histograms[:5]  # a view alone is held
    for _ in range(6):
        flow.prepare(images[7])
    np.testing.assert_array_equal(view, expected[6].histograms[:5])
    for maps, fresh in zip([*held, flow.prepare(images[3])], [*expected[:6], expected[3]], strict=True):
        for name in ("histograms", "framed", "framed_half"):
            np.testing.assert_array_equal(getattr(maps, name), getattr(fresh, name))


def test_pool_hands_out_what_was_released():
    pool = BufferPool()
    first = pool.take((3, 4), (5,))
    address = first[0].ctypes.data
    second = pool.take((3, 4), (5,))
    assert second[0].ctypes.data != address and not second[0].any()
    del first
    assert pool.take((3, 4), (5,))[0].ctypes.data == address
    assert pool.take((4, 3), (5,))[0].shape == (4, 3)
