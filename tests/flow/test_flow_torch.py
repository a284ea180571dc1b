"""The torch path: equal to the kernels where both compute the same, equal on all devices."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from pictures import grid, moved, moved_points, picture
from test_flow_daisy import compiled_cost
from torch_reference import rotated_descriptors

from dynslam_bench.core.errors import SettingsError
from dynslam_bench.flow import matching_cost
from dynslam_bench.flow.label_search import STRATEGIES
from dynslam_bench.flow.orientation_maps import orientation_maps
from dynslam_bench.flow.registry import build_flow
from dynslam_bench.flow.settings import FlowSettings
from dynslam_bench.flow.torch_flow import TorchSparseFlow, label_costs, torch_tables

SHAPE = (120, 160)
POINTS = grid(SHAPE, margin=25, step=8)


@pytest.mark.parametrize("support", [1, 5])
def test_costs_and_descriptors_equal_the_kernels_exactly(support):
    first, second = picture(2, SHAPE), picture(3, SHAPE)
    rng = np.random.default_rng(0)
    points = rng.uniform(0, (159, 119), (40, 2)).astype(np.float32)
    labels = (rng.uniform(-1, 1, (40, 25, 4)) * (60, 60, 1.2, 0.8)).astype(np.float32)
    labels[0, 0, 1] = np.nan
    columns = [compiled_cost(first, second, points, labels[:, k].copy(), support=support) for k in range(25)]
    expected, (_, tables, descriptors) = np.stack([cost for cost, _, _ in columns], axis=1), columns[0]
    device_tables = torch_tables(tables, SHAPE, torch.device("cpu"))
    histograms = [torch.from_numpy(orientation_maps(image).histograms) for image in (first, second)]
    turned = rotated_descriptors(histograms[0], torch.from_numpy(points), device_tables)
    np.testing.assert_array_equal(turned.numpy().ravel(), descriptors)
    args = torch.from_numpy(points), torch.from_numpy(labels), turned, histograms[1], device_tables
    same = label_costs(*args).numpy() == expected
    # beside the first support point, cos and sin of the two libraries may fall into neighbouring cells
    assert same.all() if support == 1 else same.mean() > 0.97
    assert (expected == matching_cost.OUTSIDE).any() and (expected < matching_cost.OUTSIDE).any()


@pytest.mark.parametrize("search", sorted(STRATEGIES))
def test_searches_spend_the_same_budget_and_find_the_motion(search):
    image = picture(4, SHAPE)
    target, matrix = moved(image, 1.1, 8, 5, -4)
    settings = FlowSettings(search=search, budget=64, range_px=24, refinement="none")
    flow = TorchSparseFlow(settings)
    result = flow.track(flow.prepare(image), flow.prepare(target), POINTS, seed=5)
    if search == "none+propagation":  # nothing is drawn, so the two paths agree to the bit
        kernels = build_flow(settings)
        same = kernels.track(kernels.prepare(image), kernels.prepare(target), POINTS, seed=5)
        np.testing.assert_array_equal(result.xy, same.xy)
        assert 17 * len(POINTS) <= result.stats["evaluations"] <= 25 * len(POINTS)
        return
    assert result.stats["evaluations"] == 64 * len(POINTS)
    if STRATEGIES[search].propagates:
        assert np.median(np.hypot(*(result.xy - moved_points(POINTS, matrix)).T)) < 2.0


def test_finds_what_the_kernels_find():
    image = picture(5, SHAPE)
    target, matrix = moved(image, 1.15, -10, 6, 5)
    shares = []
    for flow in (build_flow(), TorchSparseFlow()):
        result = flow.track(flow.prepare(image), flow.prepare(target), POINTS, seed=1)
        shares.append((np.hypot(*(result.xy - moved_points(POINTS, matrix)).T) < 1.5).mean())
    assert min(shares) > 0.9 and abs(shares[0] - shares[1]) < 0.05


def test_refuses_missing_devices_and_appearance_terms():
    with pytest.raises(SettingsError, match="cuda:77"):
        build_flow(device="cuda:77")
    with pytest.raises(SettingsError, match=r"flow\.terms"):
        TorchSparseFlow(FlowSettings(terms=3))


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU here")
def test_processor_and_gpu_agree():
    image = picture(6, SHAPE)
    target, _ = moved(image, 1.1, 5, 4, -3)
    results = []
    for flow in (TorchSparseFlow(), TorchSparseFlow(device="cuda:0")):
        results.append(flow.track(flow.prepare(image), flow.prepare(target), POINTS, seed=2))
    first, second = results
    both = first.valid & second.valid
    assert both.mean() > 0.85 and (first.valid == second.valid).mean() > 0.95
    assert np.median(np.hypot(*(first.xy - second.xy)[both].T)) < 0.05
