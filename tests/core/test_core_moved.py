"""Documented import paths of before the rebuild: each warns, and gives the same objects as the new one."""

import importlib
import sys

import pytest

from dynslam_bench import contracts
from dynslam_bench.core.moved import MOVED

DOCUMENTED = {
    "dynslam_bench.culling.filter": ("DynamicFilter", "FilterResult", "FilterState", "FrameBundle"),
    "dynslam_bench.features.keypoints": ("FeatureExtractor", "Keypoints"),
    "dynslam_bench.flow.estimator": ("FlowEstimator", "FlowResult"),
    "dynslam_bench.flow.spec": ("FlowSpec",),
    "dynslam_bench.segmentation.instances": ("Instances", "Segmenter"),
    "dynslam_bench.sequences.datasets": ("DatasetSpec",),
    "dynslam_bench.sequences.frame": ("Frame", "FrameMasks", "Sequence"),
    "dynslam_bench.slam.result": ("TrackResult",),
    "dynslam_bench.trackers.protocol": ("Tracker", "TrackerContext", "TrackerSpec"),
}
STILL_THERE = {
    "dynslam_bench.features.registry": ("FeatureSpec",),
    "dynslam_bench.flow.registry": ("FlowSpec",),
    "dynslam_bench.segmentation.build_segmenter": ("SegmenterContext", "SegmenterSpec"),
    "dynslam_bench.sequences": ("DatasetSpec", "Frame", "FrameMasks", "MaskSource", "Sequence"),
    "dynslam_bench.slam.map_files": ("KeyframeRecord", "MapOutputs"),
    "dynslam_bench.trackers": ("Tracker", "TrackerContext", "TrackerSpec"),
}


def test_every_moved_module_is_tested() -> None:
    assert set(DOCUMENTED) == set(MOVED)


@pytest.mark.parametrize("path", sorted(DOCUMENTED))
def test_an_old_path_warns_and_gives_the_same_objects(path: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delitem(sys.modules, path, raising=False)
    with pytest.warns(DeprecationWarning, match=rf"'{path}' has moved .* import from 'dynslam_bench\.contracts'"):
        old = importlib.import_module(path)
    monkeypatch.delitem(sys.modules, path)
    assert [name for name in DOCUMENTED[path] if getattr(old, name) is not getattr(contracts, name)] == []


@pytest.mark.parametrize("path", sorted(STILL_THERE))
def test_a_path_that_stays_gives_the_same_objects(path: str) -> None:
    room = importlib.import_module(path)
    assert [name for name in STILL_THERE[path] if getattr(room, name) is not getattr(contracts, name)] == []
