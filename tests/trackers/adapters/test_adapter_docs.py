"""The examples of plug-ins on the pages are run as they stand."""

import re
from pathlib import Path

import numpy as np
import pytest

from dynslam_bench.core.errors import SegmentationError, SequenceError, SettingsError
from dynslam_bench.core.plugins import ENVIRONMENT_VARIABLE, load_object
from dynslam_bench.flow.registry import FLOWS, build_flow
from dynslam_bench.flow.settings import FlowSettings
from dynslam_bench.segmentation.build_segmenter import SEGMENTERS
from dynslam_bench.sequences.catalogue import DATASETS, open_sequence
from dynslam_bench.testing import CornerSequence, check_filter, check_segmenter, check_sequence, check_tracker
from dynslam_bench.trackers import TRACKERS, TrackerContext, build_tracker
from dynslam_bench.trackers.systems.composition import SystemSettings, compose

DOCS = Path(__file__).resolve().parents[3] / "docs"
PAGES = ("reference/plugins.md", "how-to/dataset.md", "how-to/filter.md", "how-to/program.md", "how-to/segmenter.md")


@pytest.fixture
def example(tmp_path):
    """Writes a named example of the pages and gives its path."""
    text = "\n".join((DOCS / page).read_text(encoding="utf-8") for page in PAGES)
    blocks = re.findall(r"```python\n(# (\w+\.py)\n.*?)```", text, re.DOTALL)
    texts = {name: text for text, name in blocks}
    assert len(texts) == len(blocks) >= 7

    def write(name):
        path = tmp_path / name
        path.write_text(texts[name])
        return path

    return write


@pytest.fixture
def plugged(monkeypatch):
    """Names a plug-in in the environment, as the page's shell lines do."""

    def plug(kind, path, registry):
        monkeypatch.setenv(ENVIRONMENT_VARIABLE, f"{kind}={path}:SPEC")
        registry.refresh()
        assert not [failure for failure in registry.failures() if str(path) in failure.source]
        used.append(registry)

    used = []
    yield plug
    monkeypatch.delenv(ENVIRONMENT_VARIABLE, raising=False)
    for registry in used:
        registry.refresh()


def test_tracker(example):
    path = example("my_slam.py")
    check_tracker(f"{path}:SPEC", frames=3)
    tracker = build_tracker(f"{path}:SPEC", {"step_m": "0.02"})
    sequence = CornerSequence(4)
    tracker.reset(sequence.camera, rng=np.random.default_rng(0))
    assert [tracker.track(sequence[i]).T_world_cam[2, 3] for i in range(4)] == pytest.approx([0, 0.02, 0.04, 0.06])


def test_data_set(example, plugged, tmp_path):
    plugged("sequences", example("my_data.py"), DATASETS)
    sequence = open_sequence("grey/wall", data_root=tmp_path)
    check_sequence(sequence)
    assert len(sequence) == 20 and open_sequence("grey/wall", data_root=tmp_path, frames="5:8")[0].timestamp == 5 / 30
    with pytest.raises(SequenceError, match="known: grey/wall"):
        open_sequence("grey/door", data_root=tmp_path)


def test_segmenter(example, plugged):
    plugged("segmenters", example("my_segmenter.py"), SEGMENTERS)
    build = load_object(SEGMENTERS.get("near").entry_point)
    check_segmenter(lambda: build(None, None))
    tracker = build_tracker("mask-rcnn", {"segmentation.source": "plugin:near"})
    sequence = CornerSequence(3)
    tracker.reset(sequence.camera, rng=np.random.default_rng(0))
    assert tracker.track(sequence[0]).state == "ok"


def test_flow(example, plugged):
    plugged("flow", example("my_flow.py"), FLOWS)
    flow = build_flow(FlowSettings(plugin="no-motion"))
    points = np.array([[3.5, 4.5], [10, 20]], np.float32)
    guess = np.array([[np.nan, np.nan], [11, 21]], np.float32)
    image = np.zeros((48, 64), np.uint8)
    result = flow.track(flow.prepare(image), flow.prepare(image), points, guess=guess)
    assert result.xy.tolist() == [[3.5, 4.5], [11, 21]] and result.valid.all()


def test_filter_and_system(example):
    path = example("far_slam.py")
    check_filter(load_object(f"{path}:FarFilter"))
    assert TRACKERS.get(f"{path}:SPEC").id == "far-slam"
    check_tracker(f"{path}:SPEC", frames=3)


def test_filter_beside_masks(example):
    path = example("people_slam.py")
    carried, settings = load_object(f"{path}:CarriedFilter"), load_object(f"{path}:CarriedSettings")
    check_filter(lambda: carried(settings()))
    check_tracker(f"{path}:SPEC", frames=3, settings={"segmentation.source": "oracle"})
    with pytest.raises(SettingsError, match="needs masks"):
        TRACKERS.get(f"{path}:SPEC").settings(segmentation={"source": "none"}).verify()
    sequence = open_sequence("synthetic/walking_xyz", frames=(0, 2))
    context = TrackerContext(sequence_id=sequence.id, masks=sequence.masks)
    dropped = []
    for behind_m in (0.0, 0.5):
        chosen = {"segmentation.source": "oracle", "carried.behind_m": behind_m}
        tracker = build_tracker(f"{path}:SPEC", chosen, context)
        tracker.reset(sequence.camera, rng=np.random.default_rng(0))
        stats = tracker.track(sequence[0]).stats
        dropped.append(stats["carried_dropped"])
        assert stats["semantic_objects"] >= 1
    assert 0 <= dropped[0] < dropped[1], "its setting reaches it"


def test_a_filter_that_needs_masks_without_the_group_is_told_how_to_get_it(example):
    path = example("people_slam.py")
    carried = load_object(f"{path}:CarriedFilter")(load_object(f"{path}:CarriedSettings")())
    with pytest.raises(SegmentationError, match=r"'carried' needs masks.*SemanticSystemSettings"):
        compose(SystemSettings(), TrackerContext(), [carried])
