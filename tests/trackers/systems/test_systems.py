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
from dynslam_bench.core.settings import parameters, settings_table
from dynslam_bench.segmentation.settings import SegmentationSettings
from dynslam_bench.sequences.catalogue import open_sequence
from dynslam_bench.slam.pipeline import SlamPipeline
from dynslam_bench.testing.tracker import first_difference
from dynslam_bench.trackers import TRACKERS, TrackerContext, TrackerSpec, build_tracker
from dynslam_bench.trackers.registry import all_specs, tracker_groups
from dynslam_bench.trackers.systems.composition import SemanticSystemSettings, UnfilteredSystemSettings

FRAMES = 6
SYSTEMS = [spec for spec in all_specs() if issubclass(spec.settings, UnfilteredSystemSettings)]
MASKED = [
    spec
    for spec in SYSTEMS
    if issubclass(spec.settings, SemanticSystemSettings) and spec.settings().segmentation.source == "auto"
]
IDENTITY = {"orb-slam2-mono", "orb-slam2"}
SLOW_STARTERS = {"dynaslam-g", "dai-slam"}
"""Need five keyframes, or a window of frames, before they judge."""


@pytest.fixture(scope="module")
def walking():
    return open_sequence(f"synthetic/walking_xyz?frames={FRAMES}")


def build(spec: TrackerSpec, sequence) -> SlamPipeline:
    settings = quick(spec.settings) | ({"segmentation.source": "oracle"} if spec in MASKED else {})
    return build_tracker(spec, settings, TrackerContext(sequence_id=sequence.id, masks=sequence.masks))


def run(spec: TrackerSpec, sequence) -> list[TrackResult]:
    tracker = build(spec, sequence)
    tracker.reset(sequence.camera, rng=np.random.default_rng(0))
    return [tracker.track(sequence[index]) for index in range(FRAMES)]


@pytest.mark.parametrize("spec", SYSTEMS, ids=lambda spec: spec.id)
def test_every_system_tracks_and_says_what_it_culls(spec: TrackerSpec, walking) -> None:
    results = run(spec, walking)
    waiting = {"initialising"} if spec.sensors == "rgb" else set()  # until the camera has moved enough
    assert {result.state for result in results} <= {"ok"} | waiting and len(results) == FRAMES
    keys = [set(result.stats) for result in results[2:]]
    assert all(names == keys[0] for names in keys), "the same stats on every frame"
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
    assert not first_difference(*(run(TRACKERS.get(name), walking) for _ in range(2)))


@pytest.mark.parametrize("name", ["mask-rcnn", "dynaslam", "yolo-slam", "seg-slam", "emfoa-oft"])
def test_no_masks_where_a_system_needs_them_is_a_clear_error(name: str) -> None:
    with pytest.raises(SettingsError, match=r"needs masks.*none.*oracle.*onnx:PATH.*weights:PATH"):
        build_tracker(name, {"segmentation.source": "none"})


@pytest.mark.parametrize("spec", MASKED, ids=lambda spec: spec.id)
def test_online_segmentation_settings_reach_every_filter(spec: TrackerSpec, walking) -> None:
    tracker = build(spec, walking)
    tracker.configure(spec.settings.model_validate({"segmentation": {"source": "oracle", "confidence": 0.77}}))
    held = [(getattr(rule, "segmentation", None), rule.settings) for rule in tracker._filters]
    for settings in (settings for pair in held for settings in pair if isinstance(settings, SegmentationSettings)):
        assert settings.confidence == 0.77


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
        tracker = build(TRACKERS.get(name), walking)
        tracker._masks.segmenter.inner = Network()
        assert tracker._masks.segmenter.segment(walking[0]).class_names == wanted


@pytest.mark.parametrize("spec", all_specs(), ids=lambda spec: spec.id)
def test_specs_are_complete(spec: TrackerSpec) -> None:
    assert spec.label and spec.summary and spec.provenance
    assert all(parameter.meaning for parameter in parameters(spec.settings))
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
