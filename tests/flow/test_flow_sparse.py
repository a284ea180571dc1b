"""Sparse flow: accuracy, budgets, determinism, and input that says nothing."""

import pickle
from copy import deepcopy
from functools import lru_cache

import cv2
import numpy as np
import pytest
from helpers.flow_pictures import grid, moved, moved_points, picture

from dynslam_bench.contracts.flow import FlowEstimator
from dynslam_bench.core.errors import PluginError
from dynslam_bench.core.settings import parameters
from dynslam_bench.flow.label_search import STRATEGIES, common_motions
from dynslam_bench.flow.opencv import LucasKanadeFlow
from dynslam_bench.flow.registry import FLOWS, build_flow
from dynslam_bench.flow.settings import DenseFlowSettings, FlowMethodSettings, FlowSettings
from dynslam_bench.flow.sparse import SparseDaisyFlow

SEARCHES = list(STRATEGIES)
DRAWING = [search for search in SEARCHES if search != "none+propagation"]
METHODS = ["daisy", "lucas-kanade", "dis"]


def pair_of(flow, image, target):
    return flow.pair(flow.prepare(image), flow.prepare(target))


def share_found(result, points, matrix):
    """Share of the points within 1.5 px of the truth."""
    return (np.hypot(*(result.xy - moved_points(points, matrix)).T) < 1.5).mean()


def track(settings, first, second, points, *, threads=1, **arguments):
    flow = build_flow(settings, threads=threads)
    return flow.track(flow.prepare(first), flow.prepare(second), points, **arguments)


@pytest.mark.parametrize(
    ("scale", "degrees", "tx", "ty"),
    [
        (1, 0, 3.4, -2.3),
        (1, 0, 45, -30),
        (1.5, 0, 5, 5),
        (0.7, 0, 0, 9),
        (1, 40, 4, 2),
        (1.25, -20, 12, 8),
    ],
)
def test_finds_similarities_to_a_fraction_of_a_pixel(scale, degrees, tx, ty):
    image = picture(1)
    target, matrix = moved(image, scale, degrees, tx, ty)
    points = grid(margin=70)
    truth = moved_points(points, matrix)
    result = track(FlowSettings(), image, target, points, seed=3)
    error = np.hypot(*(result.xy - truth).T)
    assert (error < 1.5).mean() > 0.9
    assert np.median(error) < 0.2
    assert (error[result.valid] < 1.5).mean() > 0.97
    assert result.valid.mean() > 0.85


@pytest.mark.parametrize("window", [5, 9, 17, 31, 41])
def test_refinement_windows_of_every_size_align_to_a_fraction_of_a_pixel(window):
    image = picture(15)
    target, matrix = moved(image, 1.03, 2, 2.6, -1.7)
    points = grid(margin=50)
    truth = moved_points(points, matrix)
    flow = SparseDaisyFlow(FlowSettings(refinement_window_px=window))
    labels = np.zeros((len(points), 4), np.float32)
    labels[:, :2] = truth - points + np.random.default_rng(0).uniform(-1.5, 1.5, points.shape)
    correlation = flow.refine(points, labels, pair_of(flow, image, target))
    error = np.hypot(*(points + labels[:, :2] - truth).T)
    assert np.median(error) < (0.25 if window == 5 else 0.1)
    assert (correlation > 0.9).mean() > 0.9
    assert correlation.max() <= 1 + 1e-5
    if window >= 17:
        assert np.median(abs(labels[:, 2] - np.log2(1.03))) < 0.02
        assert np.median(abs(labels[:, 3] - np.deg2rad(2))) < 0.01


def test_points_at_the_border_are_refined_without_reading_beyond_the_image():
    image = picture(16, (120, 160))
    target = np.ascontiguousarray(np.roll(image, 1, axis=1))
    y, x = np.mgrid[0:120:7, 0:160:9]
    edge = (x < 20) | (y < 20) | (x > 140) | (y > 100)
    points = np.stack([x[edge], y[edge]], 1).astype(np.float32)
    flow = SparseDaisyFlow(FlowSettings(refinement_window_px=41))
    labels = (
        np.random.default_rng(0).uniform(-1, 1, (len(points), 4)) * (200, 200, 1.2, 0.8)
    ).astype(np.float32)
    before = labels.copy()
    correlation = flow.refine(points, labels, pair_of(flow, image, target))
    assert np.isfinite(labels).all()
    assert (np.abs(correlation) <= 1 + 1e-5).all()
    outside = ((points + before[:, :2] < 0) | (points + before[:, :2] > (159, 119))).any(axis=1)
    assert outside.sum() > 50
    assert (correlation[outside] == -1).all()
    np.testing.assert_array_equal(labels[outside], before[outside])


def test_a_guess_reaches_beyond_the_range():
    image, points = picture(2, (240, 480)), grid((240, 330), margin=50)
    target, matrix = moved(image, tx=150)
    settings = FlowSettings(range_px=16.0)
    guess = (moved_points(points, matrix) + 6).astype(np.float32)
    guess[::3] = np.nan  # no guess: propagation from the neighbours
    assert share_found(track(settings, image, target, points, guess=guess), points, matrix) > 0.9
    assert share_found(track(settings, image, target, points), points, matrix) < 0.5


@pytest.mark.parametrize("search", DRAWING)
@pytest.mark.parametrize("budget", [8, 48, 96, 131])
def test_all_searches_that_draw_spend_exactly_the_budget(search, budget):
    image = picture(3)
    target, _ = moved(image, tx=4)
    points = grid()
    settings = FlowSettings(search=search, budget=budget, refinement="none")
    assert track(settings, image, target, points).stats["evaluations"] == budget * len(points)


@pytest.mark.parametrize(
    "search", ["random+propagation", "emfoa-literal+propagation", "emfoa+propagation", "patchmatch"]
)
def test_propagation_carries_what_one_point_finds(search):
    image, points = picture(14), grid()
    target, matrix = moved(image, 1.1, 8, 30, -20)
    assert (
        share_found(
            track(FlowSettings(search=search), image, target, points, seed=2), points, matrix
        )
        > 0.9
    )
    alone = FlowSettings(search=search, neighbours=0, similarity_seeds=False)
    assert share_found(track(alone, image, target, points, seed=2), points, matrix) < 0.6


def test_more_budget_lowers_the_cost_and_the_order_of_searches():
    image, points = picture(5), grid()
    target, _ = moved(image, 1.3, 20, 20, -15)

    def cost(search, budget):
        settings = FlowSettings(search=search, budget=budget, refinement="none")
        return track(settings, image, target, points, seed=1).cost.mean()

    costs = {
        search: np.array([cost(search, budget) for budget in (48, 192)]) for search in SEARCHES
    }
    assert all(few >= many for few, many in costs.values())
    # as printed is worse than random; neighbours matter more than the metaheuristic
    assert (costs["emfoa-literal"] > costs["random"] - 0.01).all()
    assert costs["emfoa"][1] < costs["random"][1]
    for search in ("random", "emfoa-literal", "emfoa"):
        assert (costs[f"{search}+propagation"] < costs[search]).all()
    assert (costs["patchmatch"] < costs["emfoa"]).all()


@pytest.mark.parametrize("search", SEARCHES)
def test_the_result_depends_on_the_seed_only(search):
    image = picture(6)
    target, _ = moved(image, 1.1, 5, 9, 3)
    points = grid()
    settings = FlowSettings(search=search)
    first = track(settings, image, target, points, seed=7)
    for threads in (1, 2, 3):
        again = track(settings, image, target, points, seed=7, threads=threads)
        np.testing.assert_array_equal(again.xy, first.xy)
        np.testing.assert_array_equal(again.valid, first.valid)
        np.testing.assert_array_equal(again.cost, first.cost)
    if search in DRAWING:
        assert (track(settings, image, target, points, seed=8).cost != first.cost).any()


def test_without_propagation_points_are_independent():
    image = picture(7)
    target, _ = moved(image, tx=9)
    points = grid()
    settings = FlowSettings(search="emfoa")
    everything = track(settings, image, target, points)
    first = track(settings, image, target, points[:10])
    np.testing.assert_array_equal(everything.xy[:10], first.xy)


def test_common_motions_finds_two_similarities_among_noise():
    rng = np.random.default_rng(0)
    points = rng.uniform(0, (640, 480), (400, 2)).astype(np.float32)
    labels = rng.uniform(-80, 80, (400, 4)).astype(np.float32)
    motions = np.array([[1.1, 0.2, 15, -40], [0.9, -0.1, -30, 60]])
    for k, part in enumerate((np.s_[:160], np.s_[160:260])):
        a, b, tx, ty = motions[k]
        moved_to = points[part] @ np.array([[a, b], [-b, a]]) + (tx, ty)
        labels[part, :2] = moved_to - points[part] + rng.normal(0, 0.5, moved_to.shape)
    costs = np.where(np.arange(400) < 260, rng.integers(0, 1000, 400), rng.integers(800, 3000, 400))
    np.testing.assert_allclose(
        common_motions(points, labels, costs, 1)[:, :2], motions[:, :2], atol=0.03
    )
    assert np.isnan(common_motions(points[:3], labels[:3], costs[:3], 1)).all()


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("kind", ["identical", "black", "textureless", "black target", "gradient"])
def test_degenerate_images_give_no_valid_points(method, kind):
    flat = np.full((240, 320), 100, np.uint8)
    image = picture(8)
    first, second = {
        "identical": (image, image.copy()),
        "black": (0 * flat, 0 * flat),
        "textureless": (flat, flat + np.uint8(40)),
        "black target": (image, 0 * flat),
        "gradient": (np.tile(np.linspace(0, 60, 320), (240, 1)).astype(np.uint8), flat),
    }[kind]
    result = track(FlowSettings(method=method), first, second, grid())
    assert result.xy.shape == grid().shape
    assert np.isfinite(result.xy).all()
    assert not result.valid.any()
    assert result.stats["degenerate"] == 1
    assert result.stats["valid"] == 0


@pytest.mark.parametrize("method", METHODS)
def test_unusable_points_and_guesses_are_not_valid_and_do_not_influence_others(method):
    good = grid(margin=40)
    image = picture(9)
    target, matrix = moved(image, tx=3, ty=2)
    bad = np.array(
        [[np.nan, 3], [-5, 10], [1e9, 1e9], [319.9, 50], [np.inf, 0], [100, 240]], np.float32
    )
    points = np.concatenate([bad, good])
    guess = np.full_like(points, np.nan)
    guess[-5:] = 1e20
    guess[-10:-5] = np.inf
    result = track(FlowSettings(method=method), image, target, points, guess=guess)
    assert not result.valid[: len(bad)].any()
    assert np.isfinite(result.xy[result.valid]).all()
    assert (np.hypot(*(result.xy[len(bad) :] - moved_points(good, matrix)).T) < 1.5)[
        :-10
    ].mean() > 0.95
    nothing = track(FlowSettings(method=method), image, target, bad[:2])
    assert not nothing.valid.any()
    assert nothing.stats["degenerate"] == 0


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize(
    ("shape", "count"),
    [((2, 3), 7), ((9, 17), 7), ((33, 47), 7), *(((240, 320), n) for n in (0, 1, 2, 5))],
)
def test_tiny_images_and_few_points(method, shape, count):
    first = picture(10)[: shape[0], : shape[1]].copy()
    points = grid()[:count] * (np.array(shape[::-1]) / (320, 240))
    result = track(FlowSettings(method=method), first, np.roll(first, 2, axis=1), points)
    assert result.xy.shape == (count, 2)
    assert result.valid.shape == result.cost.shape == (count,)
    assert np.isfinite(result.xy[result.valid]).all()
    assert result.stats["points"] == count


@pytest.mark.parametrize("method", METHODS)
def test_images_of_two_sizes_are_refused(method):
    flow = build_flow(FlowMethodSettings(method=method))
    image = picture(11)
    with pytest.raises(ValueError, match="size"):
        flow.track(flow.prepare(image), flow.prepare(image[:120]), grid())


def test_the_forward_backward_check_rejects_what_is_covered():
    cover = picture(13)
    image = picture(12)
    target, _ = moved(image, tx=5)
    target[80:160, 100:220] = cover[80:160, 100:220]
    points = grid(margin=20)
    hidden = ((points > (112, 92)) & (points < (200, 148))).all(axis=1)
    seen = ((points < (65, 50)) | (points > (245, 190))).any(axis=1)  # no window touches the cover
    for method in ("daisy", "lucas-kanade"):
        result = track(FlowSettings(method=method), image, target, points)
        assert result.valid[hidden].mean() < 0.2 < 0.8 < result.valid[seen].mean()


@pytest.mark.slow
def test_plugins(tmp_path):
    path = tmp_path / "my_flow.py"
    path.write_text(
        "from dynslam_bench.flow.registry import FlowSpec\n"
        "from dynslam_bench.flow.opencv import LucasKanadeFlow\n"
        f"SPEC = FlowSpec('mine', {str(path)!r} + ':make')\n"
        f"BROKEN = FlowSpec('broken', {str(path)!r} + ':boom')\n"
        f"WRONG = FlowSpec('wrong', {str(path)!r} + ':wrong')\n"
        "def make(settings, *, device, threads):\n    return LucasKanadeFlow(settings)\n"
        "def boom(settings, *, device, threads):\n    raise RuntimeError('no')\n"
        "def wrong(settings, *, device, threads):\n    return 3\n"
    )
    assert {found.spec.id for found in FLOWS.all()} >= {"daisy", "lucas-kanade", "dis"}
    assert isinstance(build_flow(FlowSettings(plugin=f"{path}:SPEC")), LucasKanadeFlow)
    for name in ("BROKEN", "WRONG"):
        with pytest.raises(PluginError):
            build_flow(FlowSettings(plugin=f"{path}:{name}"))
    with pytest.raises(PluginError, match="unknown flow"):
        build_flow(FlowSettings(plugin="raft"))


# Each flow setting acts in the flow that it belongs to.


DENSE = DenseFlowSettings(budget=48, sweeps=3)
BASES = {
    "sparse": FlowSettings(),
    "dense": DENSE,
    "lucas-kanade": FlowMethodSettings(method="lucas-kanade"),
    "dis": FlowMethodSettings(method="dis"),
}
FIXED = {
    "sparse": {
        "neighbours": 0, "similarity_seeds": False, "scale_range_octaves": 0.1, "rotation_range_deg": 5.0,
        "support": 5, "terms": 3, "refinement": "none", "refinement_window_px": 9,
    },
    "dense": {
        "terms": 3, "refinement": "none", "superpixel_px": 20, "candidates": 3, "filter_radius_px": 12,
        "filter_epsilon": 0.1, "consistency_px": 0.5, "second_round": False,
    },
    "lucas-kanade": {"window_px": 9},
    "dis": {"dis_preset": "ultrafast"},
}  # fmt: skip
"""Settings that studies do not tune, with a value other than the default."""
MATRIX = cv2.getRotationMatrix2D((64, 48), 14, 0.85)
MATRIX[:, 2] += 9, -6
POINTS = (
    np.stack(np.meshgrid(np.arange(12, 120, 9), np.arange(12, 88, 9)), -1)
    .reshape(-1, 2)
    .astype(np.float32)
)


@lru_cache(maxsize=1)
def pair() -> tuple[np.ndarray, np.ndarray]:
    """A rotated, shrunk and darkened image with an object in it that moves by itself, and noise in both."""
    rng = np.random.default_rng(3)
    image = picture(3, (96, 128)).astype(float)
    target = cv2.warpAffine(image, MATRIX, (128, 96), borderMode=cv2.BORDER_REFLECT)
    target[32:64, 48:80] = image[28:60, 64:96]
    first, second = (
        np.clip(i + rng.normal(0, 5, i.shape), 0, 255).astype(np.uint8)
        for i in (image, target - 12)
    )
    return first, second


@lru_cache(maxsize=512)
def output(settings: FlowMethodSettings) -> bytes:
    flow = build_flow(settings)
    result = flow.track(*(flow.prepare(image) for image in pair()), POINTS, seed=5)
    return result.xy.tobytes() + result.valid.tobytes() + result.cost.tobytes()


def cases() -> list[tuple[str, str, tuple[object, ...]]]:
    tuned = [
        (kind, p.name, p.choices or (p.low, p.high))
        for kind in BASES
        for p in parameters(type(BASES[kind]))
    ]
    return tuned + [
        (kind, name, (value,)) for kind, values in FIXED.items() for name, value in values.items()
    ]


@pytest.mark.parametrize(("kind", "name", "values"), cases())
def test_a_setting_acts_in_its_flow(kind: str, name: str, values: tuple[object, ...]) -> None:
    tried = {output(BASES[kind].model_copy(update={name: value})) for value in values}
    assert tried | {output(BASES[kind])} != {output(BASES[kind])}


@pytest.mark.parametrize("settings", BASES.values(), ids=BASES)
def test_copied_and_pickled_flows_find_the_same(settings) -> None:
    flow = build_flow(settings, threads=2)
    images = [flow.prepare(image) for image in pair()]
    found = [
        each.track(*images, POINTS, seed=5).xy
        for each in (flow, deepcopy(flow), pickle.loads(pickle.dumps(flow)))
    ]
    np.testing.assert_array_equal(found[1:], [found[0]] * 2)


def test_the_dense_flow_reads_its_field_at_the_points() -> None:
    flow = build_flow(DENSE)
    assert isinstance(flow, FlowEstimator)
    first, second = (flow.prepare(image) for image in pair())
    unusable = np.array([[np.nan, 5], [-3, 5], [500, 5]], np.float32)
    result = flow.track(first, second, np.concatenate([POINTS, unusable]), seed=5)
    assert result.xy.dtype == result.cost.dtype == np.float32
    assert not result.valid[-3:].any()
    assert 0.3 < result.valid.mean() < 1
    assert result.stats["valid"] == result.valid.sum()
    xy = result.xy[:-3]
    valid = result.valid[:-3]
    elsewhere = (np.abs(xy - (64, 48)) > 20).any(axis=1)  # not on the other object
    assert (
        np.median(np.linalg.norm(xy - moved_points(POINTS, MATRIX), axis=1)[valid & elsewhere])
        < 0.7
    )
    degenerate = flow.track(first, first, POINTS)
    assert set(degenerate.stats) == set(result.stats)
    assert not degenerate.valid.any()
    assert len(flow.track(first, second, POINTS[:0]).xy) == 0


def test_settings_of_the_dense_flow_take_effect_at_once() -> None:
    flow = build_flow(DENSE)
    first, second = (flow.prepare(image) for image in pair())
    before = flow.track(first, second, POINTS, seed=5)
    flow.configure(DENSE.model_copy(update={"forward_backward_px": 0.25}))
    assert flow.track(first, second, POINTS, seed=5).valid.sum() < before.valid.sum()
    flow.configure(DENSE)
    np.testing.assert_array_equal(flow.track(first, second, POINTS, seed=5).valid, before.valid)
