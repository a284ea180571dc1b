"""The moth-flame equations: against loops that follow the paper, and against stored results."""

import hashlib

import numpy as np
import pytest

from dynslam_bench.flow import moth_flame as rules
from dynslam_bench.flow.label_search import (
    SearchRules,
    advance,
    move_moths,
    nearest,
    scrambled,
    search_labels,
)
from dynslam_bench.flow.settings import FlowSettings
from dynslam_bench.flow.sparse import SparseDaisyFlow

FAMILY = {"emfoa": rules.EMFOA, "mfo": rules.MFO, "printed": rules.EMFOA_LITERAL}
POPULATION = 6
ITERATIONS = 10


def picture(seed=0, shape=(144, 192)):
    """Blocks of three sizes; whole numbers only, so that every machine sees the same."""
    rng = np.random.default_rng(seed)
    layers = [
        np.kron(rng.integers(0, 256, (shape[0] // k, shape[1] // k)), np.ones((k, k), np.int64))
        for k in (3, 8, 24)
    ]
    return (sum(layers) // 3).astype(np.uint8)


def by_hand(moths, flames, iteration, family, uniform, jumps, scale):
    """Eq. 8-18 for one population, a number at a time; flames best first."""
    position = np.empty_like(moths)
    progress = iteration / ITERATIONS
    left = rules.flame_counts(POPULATION, ITERATIONS, family)[iteration - 1]
    for i in range(POPULATION):
        for j in range(4):
            r = 1 + progress if family.as_printed else -1 - progress
            t = (r - 1) * uniform[i, j] + 1
            goal = flames[min(i, left - 1), j]
            if family.best_flame and iteration > ITERATIONS / 2:
                a = 0.6 - 0.4 * progress
                goal = (a * goal + (1 - a) * flames[0, j]) / (2 if family.half else 1)
            position[i, j] = (
                abs(flames[i, j] - moths[i, j]) * np.exp(t) * np.cos(2 * np.pi * t) + goal
            )
            if family.cauchy and iteration <= ITERATIONS / 2:
                position[i, j] += np.tan(np.pi * (jumps[i, j] - 0.5)) * scale[j]
    return position


def drawn(seed, stepping):
    """A population, its flames, and the numbers that the compiled search would draw for them."""
    moths, flames = (
        np.random.default_rng(seed).uniform(-40, 40, (2, POPULATION, 4)).astype(np.float32)
    )
    state = np.uint64(seed + 77)
    uniform = np.empty((POPULATION, 4))
    jumps = np.full((POPULATION, 4), 0.5)
    for i in range(POPULATION):
        for numbers, levels in ((uniform, 65536), (jumps, 4096))[: 1 + stepping]:
            state = np.uint64(advance(state))
            bits = int(scrambled(state))
            half = 0.5 if levels == 4096 else 0.0
            numbers[i] = [((bits >> 16 * j & 65535) % levels + half) / levels for j in range(4)]
    return moths, flames, uniform, jumps


@pytest.mark.slow
@pytest.mark.parametrize("iteration", [1, 5, 6, 10])
@pytest.mark.parametrize("family", FAMILY.values(), ids=FAMILY)
def test_numpy_and_the_kernel_follow_the_equations(family, iteration):
    now = rules.flight(iteration / ITERATIONS, family)
    moths, flames, uniform, jumps = drawn(iteration, now.stepping)
    scale = np.array([2.0, 2.0, 0.1, 0.087])
    expected = by_hand(
        moths.astype(np.float64),
        flames.astype(np.float64),
        iteration,
        family,
        uniform,
        jumps,
        scale,
    )
    left = rules.flame_counts(POPULATION, ITERATIONS, family)[iteration - 1]
    around = flames[np.minimum(np.arange(POPULATION), left - 1)]
    numbers = iter((uniform, jumps))
    positions = rules.moth_positions(
        moths, flames, around, flames[:1], now, scale, lambda _: next(numbers)
    )
    np.testing.assert_allclose(positions, expected, rtol=1e-5, atol=1e-4)
    table = rules.flight_table(POPULATION, ITERATIONS, family)
    box = np.full(4, 1e9, np.float32)
    flying = moths.copy()
    tried = np.empty_like(moths)
    steps = scale.astype(np.float32)
    search = SearchRules(
        table, rules.spiral_table(), rules.cauchy_table(), steps, True, np.float32(0.5)
    )
    random = np.uint64(iteration + 77)
    move_moths(flying, flames, -box, box, iteration - 1, search, tried, random)
    # the spiral is looked up in steps of 1/1024: its slope is at most 2 pi e^2 outside, 2 pi e
    # inside t <= 1
    looked_up = (
        abs(flames - moths) * 2 * np.pi * np.exp(2 if family.as_printed else 1) / 1024 + 1e-3
    )
    assert (abs(flying - expected) <= looked_up + 1e-4 * abs(expected)).all()
    assert np.array_equal(tried, flying)


def test_opposites_keep_to_their_bounds():
    members = np.random.default_rng(0).uniform(-3, 3, (5, 7, 4))
    least = members.min(1, keepdims=True)
    greatest = members.max(1, keepdims=True)
    numbers = [
        np.random.default_rng(1).random((5, 7, 1)),
        np.random.default_rng(2).random((5, 7, 4)),
    ]
    draws = iter(numbers)
    opposite = rules.opposites(
        members, least, greatest, np.full(4, -2.0), np.full(4, 2.5), lambda _: next(draws)
    )
    mirrored = numbers[0] * (least + greatest) - members
    kept = (mirrored >= -2) & (mirrored <= 2.5)
    np.testing.assert_allclose(opposite[kept], mirrored[kept])
    assert 0.3 < kept.mean() < 1
    assert (opposite >= -2).all()
    assert (opposite <= 2.5).all()


def searched(search):
    """The state of a label search with a guess for every second point."""
    image = picture()
    target = np.roll(image, (4, -7), axis=(0, 1))
    points = (
        np.stack(np.meshgrid(np.arange(40, 150, 10), np.arange(40, 100, 10)), -1)
        .reshape(-1, 2)
        .astype(np.float32)
    )
    guess = points + np.float32(3)
    guess[::2] = np.nan
    flow = SparseDaisyFlow(FlowSettings(search=search))
    pair = flow.pair(flow.prepare(image), flow.prepare(target))
    run = flow.workers.run
    matching = flow.matching(pair, points)
    return search_labels(flow.settings, run, matching, nearest(points, run), guess, 9)


STORED = {
    "emfoa": "84f2c5ef451801d3",
    "emfoa+propagation": "7d04e1d07384dd66",
    "emfoa-literal": "2b9e1164b663a30e",
    "emfoa-literal+propagation": "6aaf08bc9b17f31c",
    "mfo": "a2001c99c423c5b4",
    "mfo+propagation": "e7c981cc3462865c",
    "none+propagation": "87beb52c40e16d5a",
    "patchmatch": "9977d4603dd9c019",
    "random": "5f5d2d8eb5727325",
    "random+propagation": "bc28e3cc59481560",
}
"""Digests of flames, costs and evaluations."""


@pytest.mark.parametrize("search", sorted(STORED))
def test_label_searches_are_as_before_to_the_bit(search):
    state = searched(search)
    content = b"".join(
        np.ascontiguousarray(array).tobytes() for array in (state.flames, state.costs, state.used)
    )
    assert hashlib.sha256(content).hexdigest()[:16] == STORED[search]


def test_flame_counts_follow_equation_11():
    assert rules.flame_counts(30, 100, rules.MFO)[[0, 49, 99]].tolist() == [30, 16, 1]
    printed = rules.flame_counts(30, 100, rules.EMFOA_LITERAL)
    # collapses: taken from the last count instead of N
    assert printed[19] <= 6
    assert printed[-1] == 1
    assert (np.diff(rules.flame_counts(12, 30, rules.EMFOA)) <= 0).all()
