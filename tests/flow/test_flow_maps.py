"""Orientation maps: their blurs, their independence of threads, and memory that is used again."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch

from dynslam_bench.flow import layout
from dynslam_bench.flow.orientation_maps import framed, half_image, orientation_maps
from dynslam_bench.flow.registry import build_flow
from dynslam_bench.flow.torch_flow import _binomial
from dynslam_bench.flow.workers import BufferPool


def noise(shape, seed=0):
    return np.random.default_rng(seed).integers(0, 256, shape, dtype=np.uint8)


@pytest.mark.parametrize("shape", [(48, 64), (97, 131), (33, 47), (9, 17), (7, 2), (1, 5)])
def test_maps_do_not_depend_on_the_number_of_threads(shape):
    gray = noise(shape)
    alone = orientation_maps(gray)
    with ThreadPoolExecutor(7) as pool:
        for threads in (2, 3, 8):
            again = orientation_maps(gray, threads=threads, pool=pool)
            np.testing.assert_array_equal(again.histograms, alone.histograms)
            np.testing.assert_array_equal(again.framed_half, alone.framed_half)


@pytest.mark.parametrize("shape", [(48, 64), (97, 131), (1, 5)])
def test_framed_images_repeat_their_edges(shape):
    gray = noise(shape)
    maps = orientation_maps(gray)
    np.testing.assert_array_equal(maps.framed, np.pad(gray, 48, mode="edge"))
    np.testing.assert_array_equal(maps.framed_half, framed(half_image(gray)))


def test_blurs_have_the_variances_of_their_gaussians():
    """An impulse through the cascade: each level's variance in full-image pixels, the mean of 2 x 2 included."""
    line = torch.zeros((1, 1, 257), dtype=torch.int32)
    line[..., 128] = 1 << 24
    step, variance = 2, 0.0
    for sigma, level_step, (taps, distance) in zip(
        layout.LEVEL_SIGMAS, layout.LEVEL_STEPS, layout.LEVEL_BLURS, strict=True
    ):
        if level_step != step:  # a mean of two, read at every second place
            variance, step = variance + 0.25 * step**2, level_step
            line = torch.zeros_like(line)
            line[..., 128] = 1 << 24
        before = spread_of(line)
        line = _binomial(line, 2, taps, distance)
        variance += (spread_of(line) - before) * step**2
        assert variance**0.5 == pytest.approx(sigma, rel=0.04)


def spread_of(line):
    weight = line[0, 0].double()
    x = torch.arange(len(weight), dtype=torch.float64)
    mean = (weight * x).sum() / weight.sum()
    return float((weight * (x - mean) ** 2).sum() / weight.sum())


def test_memory_is_used_again_only_when_nobody_holds_it():
    flow = build_flow()
    images = [noise((60, 80), seed) for seed in range(8)]
    fresh = [orientation_maps(image) for image in images]
    held = [flow.prepare(image) for image in images[:6]]  # more than the pool keeps
    view = flow.prepare(images[6]).histograms[:5]  # only a part is held
    kept = view.copy()
    for _ in range(6):
        flow.prepare(images[7])
    np.testing.assert_array_equal(view, kept)
    for ours, expected in zip(held, fresh, strict=False):
        np.testing.assert_array_equal(ours.histograms, expected.histograms)
        np.testing.assert_array_equal(ours.framed, expected.framed)
        np.testing.assert_array_equal(ours.framed_half, expected.framed_half)
    again = flow.prepare(images[3])
    np.testing.assert_array_equal(again.histograms, fresh[3].histograms)


def test_pool_hands_out_what_was_let_go():
    pool = BufferPool()
    first = pool.take((3, 4), (5,))
    address = first[0].ctypes.data
    second = pool.take((3, 4), (5,))
    assert second[0].ctypes.data != address and not second[0].any()
    del first
    assert pool.take((3, 4), (5,))[0].ctypes.data == address
    assert pool.take((4, 3), (5,))[0].shape == (4, 3)
