"""Each flow setting acts wherever it may be tuned, and does nothing where it may not."""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np
import pytest

from dynslam_bench.contracts.flow import FlowEstimator
from dynslam_bench.core.settings import Parameter, parameters
from dynslam_bench.flow.registry import build_flow
from dynslam_bench.flow.settings import FlowSettings

FLAVOURS = {
    "sparse": {"method": "daisy", "mode": "sparse"},
    "dense": {"method": "daisy", "mode": "dense", "dense_budget": 48, "dense_sweeps": 3},
    "lucas-kanade": {"method": "lucas-kanade"},
    "dis": {"method": "dis"},
}
WINDOW = ("refinement_window_px", "refinement_iterations")
"""The sparse mode's way back is aligned within the same window, whatever the refinement on the way there."""


@lru_cache(maxsize=1)
def pair() -> tuple[np.ndarray, np.ndarray]:
    """A turned, shrunk and darkened image with a thing in it that moves by itself, and noise in both."""
    rng = np.random.default_rng(3)
    shape = (96, 128)
    layers = [
        cv2.resize(rng.uniform(0, 1, (shape[0] // k, shape[1] // k)), shape[::-1], interpolation=cv2.INTER_CUBIC)
        for k in (3, 8, 20)
    ]
    image = np.clip(sum(layers) * 75, 0, 255)
    matrix = cv2.getRotationMatrix2D((64, 48), 14, 0.85)
    matrix[:, 2] += 9, -6
    target = cv2.warpAffine(image, matrix, shape[::-1], borderMode=cv2.BORDER_REFLECT)
    target[32:64, 48:80] = image[28:60, 64:96]
    noisy = [np.clip(each + rng.normal(0, 5, shape), 0, 255).astype(np.uint8) for each in (image, target - 12)]
    return noisy[0], noisy[1]


POINTS = np.stack(np.meshgrid(np.arange(12, 120, 9), np.arange(12, 88, 9)), -1).reshape(-1, 2).astype(np.float32)


@lru_cache(maxsize=512)
def output(settings: FlowSettings) -> bytes:
    flow = build_flow(settings)
    found = flow.track(*(flow.prepare(image) for image in pair()), POINTS, seed=5)
    return found.xy.tobytes() + found.valid.tobytes() + found.cost.tobytes()


def values(parameter: Parameter) -> list[object]:
    if parameter.choices:
        return list(parameter.choices)
    return [parameter.low, parameter.default, parameter.high]


def outputs(parameter: Parameter, context: dict[str, object]) -> set[bytes]:
    tried = [{**context, parameter.name: value} for value in values(parameter)]
    return {output(FlowSettings.model_validate(each)) for each in tried}


@pytest.mark.parametrize("flavour", FLAVOURS)
@pytest.mark.parametrize("parameter", parameters(FlowSettings), ids=lambda parameter: parameter.name)
def test_a_setting_acts_where_it_may_be_tuned_and_nowhere_else(parameter: Parameter, flavour: str) -> None:
    context: dict[str, object] = dict(FLAVOURS[flavour])
    conditions = dict(parameter.when)
    if any(context.get(name, allowed[0]) not in allowed for name, allowed in conditions.items()):
        assert len(outputs(parameter, context)) == 1, f"acts in {flavour}, but may not be tuned there"
        return
    others = {name: allowed for name, allowed in conditions.items() if name not in context}
    assert len(outputs(parameter, context | {name: allowed[0] for name, allowed in others.items()})) > 1
    described = {each.name: each for each in parameters(FlowSettings)}
    for name, allowed in others.items():
        for value in (value for value in described[name].choices if value not in allowed):
            switched = context | {other: choices[0] for other, choices in others.items()} | {name: value}
            if parameter.name in WINDOW:
                switched["forward_backward_px"] = 0.0
            assert len(outputs(parameter, switched)) == 1, f"acts with {name} = {value}, but may not be tuned then"


def test_the_dense_mode_reads_its_field_at_the_points() -> None:
    settings = FlowSettings.model_validate(FLAVOURS["dense"])
    flow = build_flow(settings)
    assert isinstance(flow, FlowEstimator)
    first, second = (flow.prepare(image) for image in pair())
    strange = np.array([[np.nan, 5], [-3, 5], [500, 5], [30.4, 30.4]], np.float32)
    result = flow.track(first, second, np.concatenate([POINTS, strange]), seed=5)
    assert result.xy.shape == (len(POINTS) + 4, 2) and result.xy.dtype == result.cost.dtype == np.float32
    assert not result.valid[-4:-1].any() and np.isfinite(result.xy[result.valid]).all()
    assert 0.3 < result.valid.mean() < 1 and result.stats["valid"] == result.valid.sum()
    matrix = cv2.getRotationMatrix2D((64, 48), 14, 0.85)
    matrix[:, 2] += 9, -6
    error = np.linalg.norm(result.xy[:-4] - (POINTS @ matrix[:, :2].T + matrix[:, 2]), axis=1)
    inside = (np.abs(result.xy[:-4] - (64, 48)) > 20).any(axis=1)  # not where the other thing came to lie
    assert np.median(error[result.valid[:-4] & inside]) < 0.5
    assert set(result.stats) == set(flow.track(first, first, POINTS).stats)
    assert not flow.track(first, first, POINTS).valid.any() and len(flow.track(first, second, POINTS[:0]).xy) == 0


def test_settings_of_the_dense_mode_come_into_force_at_once() -> None:
    settings = FlowSettings.model_validate(FLAVOURS["dense"])
    flow = build_flow(settings)
    first, second = (flow.prepare(image) for image in pair())
    before = flow.track(first, second, POINTS, seed=5)
    flow.settings = settings.model_copy(update={"forward_backward_px": 0.25})  # type: ignore[attr-defined]
    stricter = flow.track(first, second, POINTS, seed=5)
    assert stricter.valid.sum() < before.valid.sum()
    flow.configure(settings)  # type: ignore[attr-defined]
    np.testing.assert_array_equal(flow.track(first, second, POINTS, seed=5).valid, before.valid)
