"""Descriptor matching against brute force in plain Python."""

import cv2
import numpy as np
import pytest

from dynslam_bench.features.matching import (
    CellGrid,
    Features,
    as_words,
    match_brute_force,
    rotation_consistent,
    search_in_radius,
)


def hamming(a, b):
    """Distances of descriptors in 64-bit words, by unpacked bits."""
    return np.unpackbits((a ^ b).view(np.uint8), axis=-1).sum(axis=-1, dtype=np.int64)


def descriptors(n, length=32, seed=0):
    return np.random.default_rng(seed).integers(0, 256, (n, length), dtype=np.uint8)


def test_words_keep_every_bit_and_pad_with_zeros():
    raw = descriptors(5, 33)
    words = as_words(raw)
    assert words.shape == (5, 5)
    assert np.array_equal(words.view(np.uint8)[:, :33], raw) and not words.view(np.uint8)[:, 33:].any()


def test_mutual_brute_force_agrees_with_opencv():
    a, b = descriptors(60), descriptors(80, seed=1)
    b[:40] = a[10:50]
    b[:40, 0] ^= 1
    ours = np.stack(match_brute_force(as_words(a), as_words(b), max_distance=256, ratio=2.0), axis=1)
    theirs = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True).match(a, b)
    assert {(i, i - 10) for i in range(10, 50)} <= set(map(tuple, ours.tolist()))
    near = hamming(as_words(a)[ours[:, 0]], as_words(b)[ours[:, 1]]) < 50
    assert [[m.queryIdx, m.trainIdx] for m in theirs if m.distance < 50] == ours[near].tolist()


def test_ratio_test_drops_ambiguous_matches():
    a = descriptors(1)
    b = np.repeat(a, 2, axis=0)
    b[1, 0] ^= 1
    assert len(match_brute_force(as_words(a), as_words(b), ratio=0.8)[0]) == 1  # 0 < 0.8 * 1
    b[0, 0] ^= 2
    assert len(match_brute_force(as_words(a), as_words(b), ratio=0.8)[0]) == 0  # 1 against 1


@pytest.mark.parametrize(("n", "m"), [(0, 0), (0, 5), (5, 0)])
def test_nothing_to_match_is_no_error(n, m):
    assert len(match_brute_force(as_words(descriptors(n)), as_words(descriptors(m)))[0]) == 0


def reference_search(xy, right, octave, words, free, target, target_right, radius, low, high, target_words, limit):
    """One target at a time, in order; a nearer later target takes a keypoint over."""
    owner, match, gap = {}, [-1] * len(target), [None] * len(target)
    for i in range(len(target)):
        ok = free & (np.abs(xy - target[i]).max(axis=1) <= radius[i]) & (octave >= low[i]) & (octave <= high[i])
        ok &= ~(np.abs(right - target_right[i]) > radius[i])
        if not ok.any():
            continue
        d = np.where(ok, hamming(words, target_words[i][None]), 999)
        j = int(d.argmin())
        if d[j] > limit or (j in owner and gap[owner[j]] <= d[j]):
            continue
        if j in owner:
            match[owner[j]] = -1
        owner[j], match[i], gap[i] = i, j, d[j]
    return match


def test_search_in_radius_against_plain_search():
    rng = np.random.default_rng(4)
    n, m = 300, 200
    xy = rng.uniform(-5, [645, 485], (n, 2))
    right = np.where(rng.random(n) < 0.3, np.nan, xy[:, 0] - rng.uniform(0, 40, n))
    octave = rng.integers(0, 8, n)
    words = as_words(descriptors(n, seed=2) & 3)  # few bits, so that distances are small
    target = xy[rng.integers(0, n, m)] + rng.normal(0, 6, (m, 2))
    target_right = np.where(rng.random(m) < 0.3, np.nan, target[:, 0] - 20)
    radius = rng.uniform(2, 60, m)
    low = rng.integers(0, 6, m)
    target_words = as_words(descriptors(m, seed=3) & 3)
    free = rng.random(n) < 0.8
    grid = CellGrid.of(xy, 640, 480)
    match = search_in_radius(
        Features(xy, right, octave, words, grid), free, (target, target_right, radius), low + 1, target_words,
        max_distance=30,
    )  # fmt: skip
    used = match[match >= 0]
    assert len(set(used.tolist())) == len(used) > 20
    expected = reference_search(
        xy, right, octave, words, free, target, target_right, radius, low, low + 2, target_words, 30
    )
    ties = hamming(words[np.maximum(match, 0)], target_words) == hamming(words[np.maximum(expected, 0)], target_words)
    assert ((match == expected) | ties).all()


def test_rotation_histogram_drops_the_odd_ones():
    rng = np.random.default_rng(0)
    a = rng.uniform(0, 360, 100)
    b = (a - 350) % 360
    b[:10] = (b[:10] + 90) % 360
    keep = rotation_consistent(a, b)
    assert keep[10:].all()
    assert rotation_consistent(np.zeros(0), np.zeros(0)).shape == (0,)
