"""What every rule must survive, the starvation guard, and settings that no short episode shows."""

from __future__ import annotations

import importlib
import pkgutil
from typing import get_args

import numpy as np
import pytest
from scenes import CAMERA, SEGMENTATION, box_instance, bundle, scene

import dynslam_bench.culling as culling
from dynslam_bench.contracts.filter import DynamicFilter, FilterState
from dynslam_bench.culling.reseeding import ReseedingFilter
from dynslam_bench.culling.settings import GuardSettings
from dynslam_bench.features.settings import FeatureSettings
from dynslam_bench.slam.pipeline import restore_starved


def rules() -> list[DynamicFilter]:
    """Every rule of the package with its default settings."""
    for module in pkgutil.iter_modules(culling.__path__):
        importlib.import_module(f"{culling.__name__}.{module.name}")
    built = []
    for kind in {*culling.Rule.__subclasses__(), *culling.ObjectRule.__subclasses__()} - {culling.ObjectRule}:
        more = {ReseedingFilter: [FeatureSettings()]}.get(kind, [SEGMENTATION] * issubclass(kind, culling.ObjectRule))
        built.append(kind(get_args(kind.__orig_bases__[0])[0](), *more))
    assert len(built) == 16
    return sorted(built, key=lambda rule: rule.name)


@pytest.mark.parametrize("rule", rules(), ids=lambda rule: rule.name)
@pytest.mark.parametrize(
    "case",
    ["first frame", "no points", "few matches", "no depth", "nan depth", "no objects", "identical", "invalid flow"],
)
def test_degenerate_input_culls_nothing_and_never_raises(rule: DynamicFilter, case: str) -> None:
    made = scene(np.eye(4), noise_px=0.0)
    frame, state = made.frame, made.state
    if case == "first frame":
        state = FilterState(camera=CAMERA, keep=state.keep)
    elif case == "no points":
        frame = bundle(np.zeros((0, 2)), np.zeros(0), frame.depth, 1.0)
        frame.instances = box_instance(0, 0, 10, 10)
        state = FilterState(camera=CAMERA, keep=np.zeros(0, bool), previous=made.state.previous)
    elif case == "few matches":
        state.flow.valid[7:] = False
    elif case.endswith("depth"):
        frame.depth[:] = np.nan if case == "nan depth" else 0
        frame.z[:] = 0
    elif case == "no objects":
        frame.instances = box_instance(0, 0, 10, 10).of_classes(())
    elif case == "invalid flow":
        state.flow.valid[:] = False
        state.flow.xy[:] = np.nan
    rule.reset(CAMERA)
    verdict = rule.apply(frame, state)
    assert verdict.keep.shape == (len(frame),) and verdict.keep.all()
    assert set(verdict.stats) == set(rule.stats_names) and np.isfinite(list(verdict.stats.values())).all()


def test_guard_undoes_the_least_reliable_verdict_first() -> None:
    semantic, nothing = np.arange(100) >= 30, np.zeros(100, bool)
    settings = GuardSettings(min_features=40)
    for verdicts, expected, undone in (
        ([semantic, nothing], semantic, 1),
        ([nothing, nothing], ~nothing, 2),
        ([semantic], semantic, 0),
    ):
        keep, count = restore_starved(verdicts, settings, 100)
        assert count == undone
        np.testing.assert_array_equal(keep, expected)
    assert restore_starved([semantic], GuardSettings(min_features=0, min_fraction=0.8), 100)[1] == 1
