"""Everything that comes with the package passes its own conformance checks."""

import importlib
import inspect
import pkgutil
import typing
from pathlib import Path

import numpy as np
import pytest

import dynslam_bench.culling
from dynslam_bench.contracts.filter import DynamicFilter
from dynslam_bench.core.settings import Settings
from dynslam_bench.geometry import se3
from dynslam_bench.segmentation.build_segmenter import build_segmenter
from dynslam_bench.segmentation.settings import SegmentationSettings
from dynslam_bench.sequences import open_sequence
from dynslam_bench.testing import (
    CornerSequence,
    check_filter,
    check_segmenter,
    check_sequence,
    check_tracker,
    filter_scene,
)

SHARED = Path(__file__).resolve().parents[3] / "shared"


def filters():
    """Every filter class of the package `culling`."""
    found = {}
    for module in pkgutil.iter_modules(dynslam_bench.culling.__path__):
        loaded = importlib.import_module(f"dynslam_bench.culling.{module.name}")
        for name, value in vars(loaded).items():
            if inspect.isclass(value) and value.__module__ == loaded.__name__ and DynamicFilter in value.__mro__[1:]:
                found[name] = value
    return found


def construct(filter_class):
    """A filter with default settings, by the types of its parameters."""
    hints = typing.get_type_hints(filter_class.__init__)
    parameters = list(inspect.signature(filter_class).parameters.values())
    bound = typing.get_args(getattr(filter_class, "__orig_bases__", [None])[0])  # the settings of a `Rule[...]`
    needed = [hints[p.name] for p in parameters if p.default is p.empty]
    needed = [bound[0] if isinstance(kind, typing.TypeVar) else kind for kind in needed]
    assert all(issubclass(kind, Settings) for kind in needed), needed
    return filter_class(*[kind() for kind in needed])


@pytest.mark.parametrize("name", sorted(filters()))
def test_filters(name):
    check_filter(lambda: construct(filters()[name]))


def test_the_filter_scene_is_exact():
    """Undoing the flow of static points by the true motion leaves nothing; the panel's points move."""
    (before, _), (frame, state) = filter_scene(3)[1:3]
    moving = frame.instances.masks[0][tuple(np.rint(frame.xy).astype(int).T[::-1])]
    world = se3.transform(state.T_world_pred, state.camera.unproject(frame.xy, frame.z))
    expected = state.camera.project(se3.transform(se3.inverse(state.T_world_prev), world))
    error = np.linalg.norm(expected - state.flow.xy, axis=1)
    assert error[~moving & state.flow.valid].max() < 1e-3
    assert error[moving].min() > 5 and moving.sum() > 10
    column, row = np.rint(state.flow.xy).astype(int).T
    patch = frame.gray[np.rint(frame.xy[:, 1]).astype(int), np.rint(frame.xy[:, 0]).astype(int)].astype(int)
    same = np.abs(before.gray[row.clip(0, 479), column.clip(0, 639)].astype(int) - patch)[state.flow.valid]
    assert (same < 25).mean() > 0.8  # the images agree with the flow


@pytest.mark.parametrize("name", ["never-move", "constant-velocity", "orb-slam2", "mask-rcnn"])
def test_trackers(name):
    check_tracker(name, frames=4, settings={"segmentation.source": "oracle"} if name == "mask-rcnn" else None)


@pytest.mark.parametrize("sequence", [CornerSequence(3), CornerSequence(1), "synthetic/sitting_rpy?scene=2&frames=5"])
def test_sequences(sequence):
    check_sequence(sequence)


@pytest.mark.skipif(not (SHARED / "data").is_dir(), reason="needs the excerpts in ../shared/data")
@pytest.mark.parametrize("name", ["bonn/crowd", "tum/fr1/xyz", "tum/fr1/rpy"])
def test_real_sequences(name):
    check_sequence(open_sequence(name, data_root=SHARED / "data", frames="3:", stride=2))


def test_segmenters():
    scene = CornerSequence(2)
    settings = SegmentationSettings(source="oracle")
    check_segmenter(lambda: build_segmenter(settings, sequence_id=scene.id, masks=scene.masks))
