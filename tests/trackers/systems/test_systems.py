"""Every system on rendered walking: it runs, says what it culls, culls where it should, and refuses what it must."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from quick_dense import quick

from dynslam_bench.contracts.segmenter import Instances
from dynslam_bench.contracts.tracker import TrackResult
from dynslam_bench.core.errors import SettingsError
from dynslam_bench.core.settings import Parameter, parameters, settings_table
from dynslam_bench.segmentation.settings import SegmentationSettings
from dynslam_bench.sequences.catalogue import open_sequence
from dynslam_bench.slam.pipeline import SlamPipeline
from dynslam_bench.trackers import TRACKERS, TrackerContext, TrackerSpec, build_tracker
from dynslam_bench.trackers.registry import all_specs, tracker_groups
from dynslam_bench.trackers.systems.composition import SemanticSystemSettings, UnfilteredSystemSettings

FRAMES = 6
SYSTEMS = [spec for spec in all_specs() if issubclass(spec.settings, UnfilteredSystemSettings)]
IDENTITY = {"orb-slam2-mono", "orb-slam2"}
SLOW_STARTERS = {"dynaslam-g", "dai-slam"}
"""Need five keyframes, or a window of frames, before they judge."""


@pytest.fixture(scope="module")
def walking():
    return open_sequence(f"synthetic/walking_xyz?frames={FRAMES}")


def run(spec: TrackerSpec, sequence, seed: int = 0, **settings: object) -> list[TrackResult]:
    semantic = issubclass(spec.settings, SemanticSystemSettings)
    if semantic and spec.settings().segmentation.source == "auto":
        settings.setdefault("segmentation.source", "oracle")
    settings = quick(spec.settings) | settings
    tracker = build_tracker(spec, settings, TrackerContext(sequence_id=sequence.id, masks=sequence.masks))
    tracker.reset(sequence.camera, rng=np.random.default_rng(seed))
    return [tracker.track(sequence[index]) for index in range(FRAMES)]


@pytest.mark.parametrize("spec", SYSTEMS, ids=lambda spec: spec.id)
def test_every_system_tracks_and_says_what_it_culls(spec: TrackerSpec, walking) -> None:
    results = run(spec, walking)
    waiting = {"initialising"} if spec.sensors == "rgb" else set()  # until the camera has moved enough
    assert {result.state for result in results} <= {"ok"} | waiting and len(results) == FRAMES
    keys = [set(result.stats) for result in results[2:]]
    assert all(each == keys[0] for each in keys), "the same stats on every frame"
    assert all(np.isfinite(list(result.stats.values())).all() for result in results)
    culled = sum(result.stats["culled"] for result in results)
    if spec.id in IDENTITY:
        assert culled == 0
    elif spec.id not in SLOW_STARTERS:
        degenerate = [result.stats.get("epipolar_degenerate") for result in results[1:]]
        assert culled > 0 or set(degenerate) == {1.0}, "it culls, or says that the camera shows too little parallax"
    for result in results:
        assert np.count_nonzero(~result.keypoints_keep) == result.stats["culled"]


@pytest.mark.parametrize("name", ["emfoa-oft", "yolo-slam"])
def test_one_seed_gives_the_same_bits(name: str, walking) -> None:
    first, second = run(TRACKERS.get(name), walking), run(TRACKERS.get(name), walking)
    assert len(first) > 1
    for a, b in zip(first, second, strict=True):
        np.testing.assert_array_equal(a.T_world_cam, b.T_world_cam)
        assert a.stats == b.stats


@pytest.mark.parametrize("name", ["mask-rcnn", "dynaslam", "yolo-slam", "seg-slam", "emfoa-oft"])
def test_no_masks_where_a_system_needs_them_is_a_clear_error(name: str, walking) -> None:
    with pytest.raises(SettingsError, match=r"needs masks.*none.*oracle.*onnx:PATH.*weights:PATH"):
        run(TRACKERS.get(name), walking, **{"segmentation.source": "none"})


def test_online_segmentation_settings_reach_every_filter(walking) -> None:
    reached = []
    for spec in SYSTEMS:
        semantic = issubclass(spec.settings, SemanticSystemSettings)
        if not semantic or spec.settings().segmentation.source != "auto":
            continue
        tracker = build_tracker(
            spec, {"segmentation.source": "oracle"}, TrackerContext(sequence_id=walking.id, masks=walking.masks)
        )
        assert isinstance(tracker, SlamPipeline)
        changed = spec.settings.model_validate({"segmentation": {"source": "oracle", "confidence": 0.77}})
        tracker.configure(changed)
        for each in tracker._filters:
            for held in (getattr(each, "segmentation", None), getattr(each, "settings", None)):
                if isinstance(held, SegmentationSettings):
                    assert held.confidence == 0.77, f"{spec.id}: {each.name}"
                    reached.append(spec.id)
    assert len(set(reached)) > 1


@pytest.mark.parametrize("name", ["sof-slam", "seg-slam"])
def test_movable_things_reach_the_rule_that_judges_them(name: str, walking) -> None:
    assert any(result.stats["class_rule_on_movable"] > 0 for result in run(TRACKERS.get(name), walking))


def test_a_networks_movable_things_pass_only_where_a_filter_wants_them(walking) -> None:
    class Network:
        def segment(self, frame):
            masks = np.zeros((2, *frame.rgb.shape[:2]), bool)
            masks[0, 100:200, 100:200] = masks[1, 250:300, 250:300] = True
            boxes = np.array([[100, 100, 200, 200], [250, 250, 300, 300]], np.float32)
            return Instances(masks, boxes, ("person", "chair"), np.ones(2, np.float32))

    for name, wanted in (("seg-slam", ("person", "chair")), ("mask-rcnn", ("person",))):
        tracker = build_tracker(
            name, {"segmentation.source": "oracle"}, TrackerContext(sequence_id=walking.id, masks=walking.masks)
        )
        assert isinstance(tracker, SlamPipeline) and tracker._masks is not None
        tracker._masks.segmenter.inner = Network()
        assert tracker._masks.segmenter.segment(walking[0]).class_names == wanted


@pytest.mark.parametrize("spec", all_specs(), ids=lambda spec: spec.id)
def test_specs_are_complete(spec: TrackerSpec) -> None:
    assert spec.label and spec.summary and spec.provenance
    described = parameters(spec.settings)
    assert all(isinstance(each, Parameter) and each.meaning for each in described)
    assert settings_table(spec.settings).count("\n") >= 2
    if spec.provenance in ("inspired", "assumed"):
        assert not spec.ranked and spec.assumptions
    if issubclass(spec.settings, UnfilteredSystemSettings):
        assert spec.citation and ("our back end" in spec.label or "ablation" in spec.label)


def test_listing_trackers_loads_nothing_heavy() -> None:
    code = (
        "import sys; from dynslam_bench.trackers import TRACKERS; assert len(TRACKERS.all()) > 30; "
        "heavy = {'torch', 'cv2', 'gtsam', 'numba'} & set(sys.modules); assert not heavy, heavy"
    )
    subprocess.run([sys.executable, "-c", code], check=True, cwd=Path(__file__).resolve().parents[3])


def test_variants_are_listed_under_their_system_and_rank_never() -> None:
    groups = tracker_groups()
    names = {spec.id for group in groups.values() for family in group for spec in family}
    assert names == {tracker.spec.id for tracker in TRACKERS.all()} and "never-move" in {
        f[0].id for f in groups["control"]
    }
    ours = next(family for family in groups["this project's"] if family[0].id == "emfoa-oft")
    paper = next(family for family in groups["published"] if family[0].id == "emfoa-oft-paper")
    assert len(ours) == 10 and len(paper) == 3 and ours[0].ranked and paper[0].provenance == "faithful-paper"
    for spec in (*ours[1:], *paper[1:]):
        assert spec.provenance == "own" and not spec.ranked and spec.id.startswith(("emfoa-oft?", "emfoa-oft-paper?"))


@pytest.mark.parametrize(
    ("name", "missing"),
    [
        ("emfoa-oft?flow=none", {"flow", "epipolar", "motion", "free_space"}),
        ("emfoa-oft?masks=none", {"segmentation"}),
        ("emfoa-oft?depth=none", {"motion", "free_space"}),
        ("emfoa-oft?masks=none&depth=none", {"segmentation", "motion", "free_space"}),
        ("emfoa-oft-paper?masks=none", {"segmentation", "motion", "free_space"}),
    ],
)
def test_a_variant_lacks_the_settings_of_what_it_leaves_out(name: str, missing: set[str]) -> None:
    groups = set(TRACKERS.get("emfoa-oft").settings.model_fields)
    assert groups - set(TRACKERS.get(name).settings.model_fields) == missing
