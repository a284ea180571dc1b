"""ORB features: spread, determinism, orientation and degenerate images."""

import cv2
import numpy as np
import pytest

from dynslam_bench.contracts.features import FeatureExtractor, MaskedExtractor
from dynslam_bench.core.compiled import kernel
from dynslam_bench.core.errors import PluginError, SettingsError
from dynslam_bench.core.simd import BYTE_LANES
from dynslam_bench.features.fast import (
    CIRCLE,
    fast_corners,
    plain_corner_scores,
    plain_maxima,
    store_corner_scores,
    store_maxima,
)
from dynslam_bench.features.matching import (
    CellGrid,
    Features,
    as_words,
    match_brute_force,
    rotation_consistent,
    search_in_radius,
)
from dynslam_bench.features.orb import EDGE, OrbExtractor, spread
from dynslam_bench.features.registry import FEATURES, build_extractor
from dynslam_bench.features.settings import FeatureSettings
from dynslam_bench.geometry.camera import inside


def texture(height=480, width=640, seed=0):
    rng = np.random.default_rng(seed)
    image = np.zeros((height, width), np.float64)
    for side in (4, 12, 40):  # structure at several scales, so that every level has corners
        noise = rng.normal(size=(-(-height // side), -(-width // side)))
        image += cv2.resize(noise, (width, height), interpolation=cv2.INTER_CUBIC) * np.log(side)
    return cv2.normalize(image, None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)


def test_extracts_the_number_of_features_from_all_levels():
    features = build_extractor(FeatureSettings(n_features=700)).extract(texture())
    assert len(features) == 700
    assert set(np.unique(features.octave)) == set(range(8))


def test_same_image_gives_same_bits_whatever_the_threads():
    image = texture(seed=3)
    before = cv2.getNumThreads()
    try:
        results = []
        for threads in (1, 4):
            cv2.setNumThreads(threads)
            results.append(OrbExtractor().extract(image))
    finally:
        cv2.setNumThreads(before)
    for name in ("xy", "octave", "angle", "response", "descriptors"):
        assert np.array_equal(getattr(results[0], name), getattr(results[1], name))


def test_features_cover_the_image_better_than_plain_orb():
    image = texture(seed=1)
    # weak half
    image[:, :320] = cv2.addWeighted(
        image[:, :320], 0.35, np.full((480, 320), 80, np.uint8), 0.65, 0
    )
    ours = OrbExtractor(FeatureSettings(n_features=500)).extract(image).xy
    plain = np.array([k.pt for k in cv2.ORB_create(500).detect(image)])
    weak = [np.count_nonzero(xy[:, 0] < 320) for xy in (ours, plain)]
    assert weak[0] > 30
    assert weak[0] > 5 * weak[1]


def test_weak_corners_count_only_in_cells_without_strong_ones():
    image = np.full((480, 640), 100, np.uint8)
    image[100:110, 100:110] = 200  # strong square
    image[112:116, 112:116] = 112  # weak square in the same cell
    image[300:310, 300:310] = 112  # weak square alone
    image = cv2.GaussianBlur(image, (3, 3), 0.8)
    settings = FeatureSettings(levels=1, fast_threshold=30, fast_threshold_min=5, cell_px=40)
    features = OrbExtractor(settings).extract(image)
    strong, weak = (
        features.response[np.abs(features.xy - centre).max(axis=1) < 9] for centre in (105, 305)
    )
    assert strong.min() >= 30 > weak.max()  # neither is empty


def test_orientation_turns_with_the_image():
    image = texture(481, 481, seed=5)
    # counter-clockwise on screen: angles fall by 90 degrees
    turned = np.ascontiguousarray(np.rot90(image))
    a = OrbExtractor(FeatureSettings(levels=1, n_features=800)).extract(image)
    b = OrbExtractor(FeatureSettings(levels=1, n_features=800)).extract(turned)
    where = {tuple(p): i for i, p in enumerate(np.rint(b.xy).astype(int).tolist())}
    places = enumerate(np.rint(a.xy).astype(int).tolist())
    pairs = [(i, where[y, 480 - x]) for i, (x, y) in places if (y, 480 - x) in where]
    assert len(pairs) > 200
    i, j = np.array(pairs).T
    assert np.abs((b.angle[j] - a.angle[i] + 90 + 180) % 360 - 180).max() < 0.01


@pytest.mark.slow
@pytest.mark.parametrize("shape", [(39, 39), (39, 640), (97, 103), (300, 401)])
@pytest.mark.parametrize("threshold", [1, 7, 40])
def test_the_corners_are_those_of_opencv(shape, threshold):
    noise = np.random.default_rng(0).integers(0, 256, shape).astype(np.uint8)
    for image in (noise, cv2.GaussianBlur(noise, (7, 7), 2)):
        at, score = fast_corners(image, threshold)
        theirs = cv2.FastFeatureDetector.create(threshold, True).detect(
            image[EDGE - 3 : 3 - EDGE, EDGE - 3 : 3 - EDGE]
        )
        ours = np.c_[at % shape[1] - EDGE + 3, at // shape[1] - EDGE + 3, score]
        assert ours.tolist() == [[*keypoint.pt, keypoint.response] for keypoint in theirs]


def test_the_descriptors_are_those_of_opencv():
    ours = OrbExtractor(FeatureSettings(levels=1)).extract(image := texture(seed=2))
    points = [
        cv2.KeyPoint(*map(float, (*xy, 31, angle)))
        for xy, angle in zip(ours.xy, ours.angle, strict=True)
    ]
    assert (
        cv2.ORB.create(nlevels=1, edgeThreshold=EDGE).compute(image, points)[1] == ours.descriptors
    ).all()


@pytest.mark.parametrize("shape", [(1, 1), (20, 30), (39, 640), (45, 45), (480, 640)])
def test_small_and_flat_images_are_no_error(shape):
    features = OrbExtractor().extract(
        np.random.default_rng(0).integers(0, 256, shape).astype(np.uint8)
    )
    assert ((features.xy >= 0) & (features.xy < shape[::-1])).all()
    flat = OrbExtractor().extract(np.full(shape, 128, np.uint8))
    assert len(flat) == 0
    assert flat.descriptors.shape == (0, 32)


def test_what_lies_on_a_mask_takes_no_place_of_what_lies_outside():
    image = texture()
    mask = np.zeros(image.shape, bool)
    mask[:, :576] = True  # nine tenths
    extractor = OrbExtractor(FeatureSettings(n_features=500))
    plain = extractor.extract(image)
    beside = extractor.extract_masked(image, mask, share=0.3)
    assert isinstance(extractor, MaskedExtractor)
    assert (
        np.count_nonzero(~inside(mask, plain.xy))
        < 100
        < 400
        < np.count_nonzero(~inside(mask, beside.xy))
        <= 500
    )
    assert np.array_equal(plain.xy[inside(mask, plain.xy)], beside.xy[inside(mask, beside.xy)])
    assert np.all(np.diff(beside.octave) >= 0)
    assert len(np.unique(np.c_[beside.xy, beside.octave], axis=0)) == len(beside)
    enough = extractor.extract_masked(image, mask, share=0.02)
    assert np.array_equal(enough.xy, plain.xy)
    assert np.array_equal(enough.descriptors, plain.descriptors)


def test_spread_takes_every_cells_best_first():
    cells = np.array([0, 0, 0, 1, 2, 2])
    response = np.array([9, 8, 7, 1, 5, 6], np.int16)
    allowed = np.ones(6, bool)
    assert [spread(cells, response, allowed, count).tolist() for count in (3, 4)] == [
        [0, 5, 3],
        [0, 5, 3, 1],
    ]
    allowed[0] = False
    assert spread(cells, response, allowed, 2).tolist() == [1, 5]


def test_refuses_thresholds_in_the_wrong_order_and_unknown_extractors():
    with pytest.raises(SettingsError, match="fast_threshold_min"):
        build_extractor(FeatureSettings(fast_threshold=10, fast_threshold_min=20))
    with pytest.raises(PluginError, match="orb"):
        build_extractor(FeatureSettings(extractor="orbb"))


def test_a_plugin_extractor_from_a_file(tmp_path, monkeypatch):
    (tmp_path / "mine.py").write_text(
        "import numpy as np\n"
        "from dynslam_bench.contracts.features import Keypoints\n"
        "from dynslam_bench.features.registry import FeatureSpec\n"
        "class Corner:\n"
        "    def __init__(self, settings): self.n = settings.options.get('n', 1)\n"
        "    def extract(self, gray):\n"
        "        n = self.n\n"
        "        return Keypoints(np.zeros((n, 2), np.float32), np.zeros(n, np.int32), np.zeros(n, np.float32),\n"
        "                         np.zeros(n, np.float32), np.zeros((n, 40), np.uint8))\n"
        f"SPEC = FeatureSpec('corner', r'{tmp_path}/mine.py:Corner', descriptor_bytes=40)\n"
    )
    monkeypatch.setenv("DYNSLAM_BENCH_PLUGINS", f"features={tmp_path}/mine.py:SPEC")
    FEATURES.refresh()
    try:
        extractor = build_extractor(FeatureSettings(extractor="corner", options={"n": 3}))
        assert isinstance(extractor, FeatureExtractor)
        assert extractor.extract(texture()).descriptors.shape == (3, 40)
    finally:
        monkeypatch.delenv("DYNSLAM_BENCH_PLUGINS")
        FEATURES.refresh()


# Descriptor matching against brute force in plain Python.


def hamming(a, b):
    """Distances of descriptors in 64-bit words, by unpacked bits."""
    return np.unpackbits((a ^ b).view(np.uint8), axis=-1).sum(axis=-1, dtype=np.int64)


def descriptors(n, length=32, seed=0):
    return np.random.default_rng(seed).integers(0, 256, (n, length), dtype=np.uint8)


def test_words_keep_every_bit_and_pad_with_zeros():
    raw = descriptors(5, 33)
    words = as_words(raw)
    assert words.shape == (5, 5)
    assert np.array_equal(words.view(np.uint8)[:, :33], raw)
    assert not words.view(np.uint8)[:, 33:].any()


def test_mutual_brute_force_agrees_with_opencv():
    a = descriptors(60)
    b = descriptors(80, seed=1)
    b[:40] = a[10:50]
    b[:40, 0] ^= 1
    ours = np.stack(
        match_brute_force(as_words(a), as_words(b), max_distance=256, ratio=2.0), axis=1
    )
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


def reference_search(
    xy, right, octave, words, free, target, target_right, radius, low, high, target_words, limit
):
    """One target at a time, in order; a nearer later target takes a keypoint over."""
    owner = {}
    match = [-1] * len(target)
    gap = [None] * len(target)
    for i in range(len(target)):
        ok = (
            free
            & (np.abs(xy - target[i]).max(axis=1) <= radius[i])
            & (octave >= low[i])
            & (octave <= high[i])
        )
        ok &= ~(np.abs(right - target_right[i]) > radius[i])
        if not ok.any():
            continue
        d = np.where(ok, hamming(words, target_words[i][None]), 999)
        j = int(d.argmin())
        if d[j] > limit or (j in owner and gap[owner[j]] <= d[j]):
            continue
        if j in owner:
            match[owner[j]] = -1
        gap[i] = d[j]
        owner[j] = i
        match[i] = j
    return match


def test_search_in_radius_against_plain_search():
    rng = np.random.default_rng(4)
    n = 300
    m = 200
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
    match = search_in_radius(
        Features(xy, right, octave, words, CellGrid.of(xy, 640, 480)), free, (target, target_right, radius), low + 1,
        target_words, max_distance=30,
    )  # fmt: skip
    used = match[match >= 0]
    assert len(set(used.tolist())) == len(used) > 20
    expected = reference_search(
        xy, right, octave, words, free, target, target_right, radius, low, low + 2, target_words, 30
    )
    ties = hamming(words[np.maximum(match, 0)], target_words) == hamming(
        words[np.maximum(expected, 0)], target_words
    )
    assert ((match == expected) | ties).all()


def test_rotation_histogram_drops_the_odd_ones():
    a = np.random.default_rng(0).uniform(0, 360, 100)
    b = (a - 350) % 360
    b[:10] = (b[:10] + 90) % 360
    assert rotation_consistent(a, b)[10:].all()
    assert rotation_consistent(np.zeros(0), np.zeros(0)).shape == (0,)


@kernel
def vector_scores_and_maxima(image, circle, first, last, width, least):
    scores = np.zeros(len(image), np.uint8)
    maxima = np.zeros(len(image), np.uint8)
    for at in range(first, last, BYTE_LANES):
        store_corner_scores(scores, image, at, circle)
    for at in range(first, last, BYTE_LANES):
        store_maxima(maxima, scores, at, width, least)
    return scores, maxima


@pytest.mark.parametrize("levels", [256, 4])  # few levels: many equal scores, and the extremes
def test_the_instructions_of_fast_are_equal_to_plain_code(levels):
    rng = np.random.default_rng(levels)
    width = 96
    image = (rng.integers(0, levels, 24 * width) * (255 // (levels - 1))).astype(np.uint8)
    image[8 * width : 12 * width] //= 2  # flat parts have corners too
    circle = CIRCLE[:, 0] + CIRCLE[:, 1] * width
    first = 4 * width
    last = first + 24 * BYTE_LANES
    scores, maxima = vector_scores_and_maxima(image, circle, first, last, width, 7)
    plain_scores = np.zeros_like(scores)
    plain = np.zeros_like(maxima)
    for at in range(first, last, BYTE_LANES):
        plain_corner_scores(plain_scores, image, at, circle)
    for at in range(first, last, BYTE_LANES):
        plain_maxima(plain, plain_scores, at, width, 7)
    assert np.array_equal(scores, plain_scores)
    assert np.array_equal(maxima, plain)
    assert np.count_nonzero(scores) > 100
    assert np.count_nonzero(maxima) > 10
