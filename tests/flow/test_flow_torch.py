"""The torch path: equal to the compiled one where both compute the same, equal on all devices."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import torch

from dynslam_bench.core.errors import SettingsError
from dynslam_bench.flow import matching_cost as matching
from dynslam_bench.flow.label_search import STRATEGIES
from dynslam_bench.flow.orientation_maps import orientation_maps
from dynslam_bench.flow.registry import build_flow
from dynslam_bench.flow.settings import FlowSettings
from dynslam_bench.flow.torch_flow import (
    TorchSparseFlow,
    label_costs,
    quantised_maps,
    rotated_descriptors,
    torch_tables,
)

needs_gpu = pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU here")


def picture(seed=0, shape=(120, 160)):
    rng = np.random.default_rng(seed)
    noise = sum(
        cv2.resize(rng.uniform(0, 1, (shape[0] // k, shape[1] // k)), shape[::-1], interpolation=cv2.INTER_CUBIC)
        for k in (3, 8, 20)
    )
    return np.clip(noise * 85, 0, 255).astype(np.uint8)


def moved(image, scale=1.0, degrees=0.0, tx=0.0, ty=0.0):
    height, width = image.shape
    matrix = cv2.getRotationMatrix2D((width / 2, height / 2), -degrees, scale)
    matrix[:, 2] += tx, ty
    return cv2.warpAffine(image, matrix, (width, height), borderMode=cv2.BORDER_REFLECT), matrix


@pytest.mark.parametrize("shape", [(120, 160), (97, 131), (9, 17), (2, 3), (1, 1)])
@pytest.mark.parametrize("kind", ["smooth", "noise", "extremes"])
def test_maps_equal_the_kernels_exactly(shape, kind):
    rng = np.random.default_rng(1)
    gray = rng.integers(0, 256, shape, dtype=np.uint8)
    if kind == "smooth":
        gray = picture(1, (max(shape[0], 40), max(shape[1], 40)))[: shape[0], : shape[1]]
    elif kind == "extremes":  # the largest derivatives there are
        gray = np.where(gray > 127, 255, 0).astype(np.uint8)
    ours = orientation_maps(gray)
    theirs, geometry = quantised_maps(torch.from_numpy(gray.copy()))
    assert geometry.total == ours.geometry.total
    np.testing.assert_array_equal(theirs.numpy(), ours.histograms)


@pytest.mark.parametrize("support", [1, 5])
def test_costs_and_descriptors_equal_the_kernels_exactly(support):
    settings = FlowSettings(support=support)
    reference, target = orientation_maps(picture(2)), orientation_maps(picture(3))
    tables = matching.tables_for(reference.gray.shape, settings)
    rng = np.random.default_rng(0)
    points = rng.uniform(0, (159, 119), (40, 2)).astype(np.float32)
    labels = (rng.uniform(-1, 1, (40, 25, 4)) * (60, 60, 1.2, 0.8)).astype(np.float32)
    labels[0, 0, 1] = np.nan
    descriptors = np.empty(40 * support * 13 * 136, np.uint8)
    matching.describe(0, 40, points, matching.side(reference), tables, descriptors)
    described = matching.Reference(points, descriptors, np.zeros((40, support, 2), np.int32))
    expected = np.empty((40, 25), np.int64)
    for k in range(25):
        column = np.empty(40, np.int64)
        matching.label_costs(0, 40, labels[:, k].copy(), described, matching.side(target), tables, column)
        expected[:, k] = column
    device_tables = torch_tables(tables, reference.gray.shape, torch.device("cpu"))
    turned = rotated_descriptors(torch.from_numpy(reference.histograms), torch.from_numpy(points), device_tables)
    np.testing.assert_array_equal(turned.numpy().ravel(), descriptors)
    found = label_costs(
        torch.from_numpy(points), torch.from_numpy(labels), turned, torch.from_numpy(target.histograms), device_tables
    ).numpy()
    same = found == expected
    # beside the first support point, cos and sin of the two libraries may fall into neighbouring cells
    assert same.all() if support == 1 else same.mean() > 0.97
    assert (expected == matching.OUTSIDE).any() and (expected < matching.OUTSIDE).any()


@pytest.mark.parametrize("search", sorted(STRATEGIES))
def test_searches_spend_the_same_budget_and_find_the_motion(search):
    image = picture(4)
    target, matrix = moved(image, 1.1, 8, 5, -4)
    points = np.stack(np.meshgrid(np.arange(25, 140, 8), np.arange(25, 100, 8)), -1).reshape(-1, 2).astype(np.float32)
    settings = FlowSettings(search=search, budget=64, range_px=24, refinement="none")
    flow = TorchSparseFlow(settings)
    result = flow.track(flow.prepare(image), flow.prepare(target), points, seed=5)
    if search == "none+propagation":  # zero flow, then nothing but neighbours and common motions
        assert 17 * len(points) <= result.stats["evaluations"] <= 25 * len(points)
        kernels = build_flow(settings)
        same = kernels.track(kernels.prepare(image), kernels.prepare(target), points, seed=5)
        np.testing.assert_array_equal(result.xy, same.xy)  # nothing is drawn, so the two paths agree to the bit
        return
    assert result.stats["evaluations"] == 64 * len(points)
    error = np.hypot(*(result.xy - (points @ matrix[:, :2].T + matrix[:, 2])).T)
    if STRATEGIES[search].propagates:
        assert np.median(error) < 2.0


def test_finds_what_the_kernels_find():
    image = picture(5)
    target, matrix = moved(image, 1.15, -10, 6, 5)
    points = np.stack(np.meshgrid(np.arange(25, 140, 8), np.arange(25, 100, 8)), -1).reshape(-1, 2).astype(np.float32)
    truth = points @ matrix[:, :2].T + matrix[:, 2]
    shares = []
    for flow in (build_flow(), TorchSparseFlow()):
        result = flow.track(flow.prepare(image), flow.prepare(target), points, seed=1)
        shares.append((np.hypot(*(result.xy - truth).T) < 1.5).mean())
    assert min(shares) > 0.9 and abs(shares[0] - shares[1]) < 0.05


def test_says_which_device_is_missing():
    with pytest.raises(SettingsError, match="cannot be used"):
        build_flow(device="cuda:77")
    with pytest.raises(SettingsError, match=r"flow\.terms is 3"):
        TorchSparseFlow(FlowSettings(terms=3))


@needs_gpu
def test_processor_and_gpu_agree():
    image = picture(6)
    target, _ = moved(image, 1.1, 5, 4, -3)
    points = np.stack(np.meshgrid(np.arange(25, 140, 8), np.arange(25, 100, 8)), -1).reshape(-1, 2).astype(np.float32)
    on_cpu, on_gpu = TorchSparseFlow(), TorchSparseFlow(device="cuda:0")
    first = on_cpu.track(on_cpu.prepare(image), on_cpu.prepare(target), points, seed=2)
    second = on_gpu.track(on_gpu.prepare(image), on_gpu.prepare(target), points, seed=2)
    both = first.valid & second.valid
    assert both.mean() > 0.85 and (first.valid == second.valid).mean() > 0.95
    assert np.median(np.hypot(*(first.xy - second.xy)[both].T)) < 0.05
