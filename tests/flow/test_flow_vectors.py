"""The vector instructions of the flow give the same bits as their plain forms."""

import numpy as np
import pytest

from dynslam_bench.core.compiled import kernel
from dynslam_bench.core.simd import load, load_uint16, plain_total, store_uint16, total
from dynslam_bench.core.simd import store as store_floats
from dynslam_bench.flow.descriptor_vectors import descriptor_sum, plain_descriptor_sum
from dynslam_bench.flow.histogram_vectors import (
    average,
    average_of_pairs,
    derivatives,
    plain_average,
    plain_average_of_pairs,
    plain_derivatives,
    plain_store_normalised,
    store_normalised,
)
from dynslam_bench.flow.sampling import (
    plain_sample,
    plain_square,
    plain_store_offsets,
    sample,
    square,
    store_offsets,
)

LARGEST_BIN = 16_320
"""Largest value of a rectified derivative along an axis: sums over 2 x 2 pixels differ by 1,020 at most."""


def numbers(rng, kind, shape, most=None):
    return rng.integers(0, np.iinfo(kind).max if most is None else most, shape, kind, endpoint=True)


@kernel
def vector_total(values):
    return total(load(values, 0))


@kernel
def vector_average(first, second, out):
    store_uint16(out, 0, average(load_uint16(first, 0), load_uint16(second, 0)))


@kernel
def vector_average_of_pairs(first, second, out):
    store_uint16(out, 0, average_of_pairs(load_uint16(first, 0), load_uint16(second, 0)))


@kernel
def vector_derivatives(sums, here, above, below, out):
    store_uint16(out, 0, derivatives(sums, here, above, below))


@kernel
def vector_normalised(out, index, histograms, floor):
    store_normalised(out, index, load_uint16(histograms, 0), floor)


@kernel
def vector_offsets(offsets, columns, rows, at, column, row, step_x, step_y, stride):
    store_offsets(offsets, columns, rows, at, column, row, step_x, step_y, stride)


@kernel
def vector_square(image, at, stride):
    return square(image, at, stride)


@kernel
def vector_sample(squares, columns, rows, at, column, row, step_x, step_y, out):
    store_floats(out, 0, sample(squares, columns, rows, at, column, row, step_x, step_y))


@kernel
def vector_descriptor_sum(image, samples, near_row, far_row, near, far, descriptor, at, truncation):
    return descriptor_sum(image, samples, near_row, far_row, near, far, descriptor, at, truncation)


@pytest.mark.parametrize("seed", range(3))
def test_the_sum_of_a_vector(seed):
    values = np.random.default_rng(seed).normal(size=16).astype(np.float32)
    assert np.float32(vector_total(values)) == plain_total(values)


@pytest.mark.parametrize(
    ("vector", "plain"),
    [(vector_average, plain_average), (vector_average_of_pairs, plain_average_of_pairs)],
)
def test_rounded_means(vector, plain):
    rng = np.random.default_rng(1)
    for _ in range(20):
        first = numbers(rng, np.uint16, 32)
        second = numbers(rng, np.uint16, 32)
        by_vector = np.zeros(32, np.uint16)
        by_number = np.zeros(32, np.uint16)
        vector(first, second, by_vector)
        plain(first, second, by_number)
        assert np.array_equal(by_vector, by_number)


def test_derivatives_of_four_pixels():
    rng = np.random.default_rng(2)
    for _ in range(20):
        sums = numbers(rng, np.uint16, 3 * 16, 1020)
        by_vector = np.zeros(32, np.uint16)
        by_number = np.zeros(32, np.uint16)
        vector_derivatives(sums, 20, 4, 36, by_vector)
        plain_derivatives(sums, 20, 4, 36, by_number)
        assert np.array_equal(by_vector, by_number)
        assert by_vector.any()


@pytest.mark.parametrize("most", [0, 3, 900, LARGEST_BIN])
def test_normalised_histograms(most):
    rng = np.random.default_rng(3)
    for _ in range(20):
        histograms = numbers(rng, np.uint16, 32, most)
        by_vector = np.zeros(40, np.uint8)
        by_number = np.zeros(40, np.uint8)
        vector_normalised(by_vector, 5, histograms, np.float32(652.8))
        plain_store_normalised(by_number, 5, histograms, np.float32(652.8))
        assert np.array_equal(by_vector, by_number)
        assert by_vector[5:37].any() == (most > 0)


def test_samples_of_a_rotated_grid():
    rng = np.random.default_rng(4)
    image = numbers(rng, np.uint8, 60 * 64)
    columns = np.arange(32, dtype=np.int32) % 8
    rows = np.arange(32, dtype=np.int32) // 8
    for angle in np.linspace(-2, 2, 9):
        steps = (np.int32(65536 * 1.3 * np.cos(angle)), np.int32(65536 * 1.3 * np.sin(angle)))
        grid = (columns, rows, 16, np.int32(30.3 * 65536), np.int32(28.7 * 65536), *steps)

        # where the pixels lie
        by_vector = np.zeros(32, np.int32)
        by_place = np.zeros(32, np.int32)
        vector_offsets(by_vector, *grid, np.int32(64))
        plain_store_offsets(by_place, *grid, 64)
        assert np.array_equal(by_vector, by_place)
        assert by_vector[16:].all()

        # the pixels, and the samples between them
        squares = np.zeros(32, np.int32)
        for k in range(16, 32):
            squares[k] = vector_square(image, by_vector[k], 64)
            assert int(squares[k]) & 0xFFFFFFFF == plain_square(image, by_vector[k], 64)
        samples = np.zeros(16, np.float32)
        plain_samples = np.zeros(16, np.float32)
        vector_sample(squares, *grid, samples)
        plain_sample(squares, *grid, plain_samples)
        assert samples.tobytes() == plain_samples.tobytes()


@pytest.mark.parametrize("truncation", [0, 225, 5000])
def test_the_distance_of_descriptors(truncation):
    rng = np.random.default_rng(5)
    image = numbers(rng, np.uint8, 4000)
    descriptor = numbers(rng, np.uint8, 200)
    samples = rng.integers(0, 1800, (6, 17), np.int32)
    for near_row, far_row in ((0, 5), (3, 2), (4, 4)):
        arguments = (image, samples, near_row, far_row, 40, 900, descriptor, 11, truncation)
        assert vector_descriptor_sum(*arguments) == plain_descriptor_sum(*arguments)
