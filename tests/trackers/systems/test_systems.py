"""Every system on rendered walking: it runs, says what it culls, culls where it should, and refuses what it must."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from quick_dense import quick

from dynslam_bench.contracts.segmenter import Instances
from dynslam_bench.contracts.tracker import TrackResult
from dynslam_bench.core.errors import SettingsError
from dynslam_bench.core.settings import Parameter, Settings, parameters, settings_table
from dynslam_bench.segmentation.settings import SegmentationSettings
from dynslam_bench.sequences.catalogue import open_sequence
from dynslam_bench.slam.pipeline import SlamPipeline
from dynslam_bench.trackers import TRACKERS, TrackerContext, TrackerSpec, build_tracker
from dynslam_bench.trackers.registry import all_specs, epipolar_skipped
from dynslam_bench.trackers.systems.composition import SemanticSystemSettings, SystemSettings

FRAMES = 6
SYSTEMS = [spec for spec in all_specs() if issubclass(spec.settings, SystemSettings)]
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


@contextmanager
def fields_read() -> Iterator[set[tuple[type, str]]]:
    """Which fields of which settings classes anything reads meanwhile."""
    read: set[tuple[type, str]] = set()

    def spy(self: Settings, name: str) -> object:
        if not name.startswith(("_", "model_")) and name in type(self).model_fields:
            read.add((type(self), name))
        return object.__getattribute__(self, name)

    Settings.__getattribute__ = spy  # type: ignore[assignment]
    try:
        yield read
    finally:
        del Settings.__getattribute__


def unread_groups(settings: type[Settings], read: set[tuple[type, str]]) -> list[str]:
    """The groups of which nobody read a single tunable setting."""
    seen = dict.fromkeys(settings.model_fields, False)
    for parameter in parameters(settings):
        node: object = settings()
        *groups, leaf = parameter.name.split(".")
        for group in groups:
            node = getattr(node, group)
        seen[groups[0]] |= (type(node), leaf) in read
    return [group for group, acts in seen.items() if not acts]


@pytest.mark.parametrize("spec", SYSTEMS, ids=lambda spec: spec.id)
def test_every_system_tracks_and_says_what_it_culls(spec: TrackerSpec, walking) -> None:
    with fields_read() as read:
        results = run(spec, walking)
    # images are prepared before a tracker sees them, by the environment
    assert unread_groups(spec.settings, read) in ([], ["preprocessing"]), "groups of settings that nothing consumes"
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


def test_masks_cull_the_people_and_little_else(walking) -> None:
    result = run(TRACKERS.get("mask-rcnn"), walking, **{"segmentation.dilation_px": 0})[-1]
    masks = walking.masks[FRAMES - 1]
    people = np.isin(masks.instances, [k for k, name in masks.class_names.items() if name == "person"])
    column, row = np.rint(result.keypoints_xy).astype(int).T
    on_person = people[row.clip(0, 479), column.clip(0, 639)]
    assert not result.keypoints_keep[on_person].any()
    moving = np.isin(masks.instances, list(masks.moving))[row.clip(0, 479), column.clip(0, 639)]
    np.testing.assert_array_equal(~result.keypoints_keep, on_person | moving)


@pytest.mark.parametrize("name", ["mask-rcnn", "dynaslam", "yolo-slam", "seg-slam", "emfoa-oft"])
def test_no_masks_where_a_system_needs_them_is_a_clear_error(name: str, walking) -> None:
    with pytest.raises(SettingsError, match=r"needs masks.*none.*oracle.*onnx:PATH.*weights:PATH"):
        run(TRACKERS.get(name), walking, **{"segmentation.source": "none"})


def test_online_settings_come_into_force_at_once(walking) -> None:
    spec = TRACKERS.get("mask-rcnn")
    tracker = build_tracker(
        spec, {"segmentation.source": "oracle"}, TrackerContext(sequence_id=walking.id, masks=walking.masks)
    )
    assert isinstance(tracker, SlamPipeline)
    tracker.reset(walking.camera, rng=np.random.default_rng(0))
    before = tracker.track(walking[0]).stats["mask_fraction"]
    wider = spec.settings.model_validate({"segmentation": {"source": "oracle", "dilation_px": 60}})
    tracker.configure(wider)
    assert tracker.track(walking[1]).stats["mask_fraction"] > 1.2 * before


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


def test_of_every_system_with_a_fundamental_matrix_it_was_measured_how_often_that_judges(walking) -> None:
    asking = set()
    ranked_together = [spec for spec in SYSTEMS if spec.sensors == "rgbd"]
    for spec in ranked_together:
        masked = issubclass(spec.settings, SemanticSystemSettings) and spec.settings().segmentation.source == "auto"
        settings = {"segmentation.source": "oracle"} if masked else {}
        tracker = build_tracker(spec, settings, TrackerContext(sequence_id=walking.id, masks=walking.masks))
        if any("f_asked" in each.stats_names for each in tracker._filters):
            asking.add(spec.id)
    assert len(asking) > 15
    assert asking == {spec.id for spec in ranked_together if epipolar_skipped(spec.id)}
    shares = [share for name in asking for share in epipolar_skipped(name).values()]
    assert min(shares) >= 0 and max(shares) <= 1


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
    if issubclass(spec.settings, SystemSettings):
        assert spec.citation and ("our back end" in spec.label or "ablation" in spec.label)


def test_the_paper_is_ranked_as_the_paper_and_ours_as_ours() -> None:
    paper, ours, back_end = (TRACKERS.get(name) for name in ("emfoa-oft-paper", "emfoa-oft", "orb-slam2"))
    assert (paper.provenance, paper.ranked, paper.published_as) == ("faithful-paper", True, ("EMFOA-OFT-SLAM",))
    assert (ours.provenance, ours.ranked, ours.published_as) == ("own", True, ()) and "own" in ours.label
    assert back_end.provenance == "own" and "no loop closing" in back_end.assumptions[0]
    flow = paper.settings().flow
    assert flow.mode == "dense" and flow.terms == 3 and flow.intensity_weight > 0 < flow.gradient_weight
    wanted = (
        "emfoa-oft",
        "emfoa-oft?flow=none",
        "emfoa-oft?masks=none",
        "emfoa-oft?depth=none",
        "emfoa-oft?masks=vote&depth=none",
    )
    names = {name: {each.name for each in parameters(TRACKERS.get(name).settings)} for name in wanted}
    groups = {name: {each.split(".")[0] for each in found} for name, found in names.items()}
    assert not groups["emfoa-oft?flow=none"] & {"flow", "epipolar", "motion", "free_space"}
    assert "segmentation" not in groups["emfoa-oft?masks=none"]
    assert not groups["emfoa-oft?depth=none"] & {"motion", "free_space"}
    assert "segmentation.dilation_px" in names["emfoa-oft"] - names["emfoa-oft?masks=vote&depth=none"]
    for spec in all_specs():
        assert spec.id == paper.id or "EMFOA-OFT-SLAM" not in spec.published_as
        if spec.id.startswith("emfoa-oft-") and spec.id != paper.id and spec.sensors == "rgbd":
            assert spec.provenance == "own" and not spec.ranked


def test_listing_trackers_loads_nothing_heavy() -> None:
    code = (
        "import sys; from dynslam_bench.trackers import TRACKERS; assert len(TRACKERS.all()) > 30; "
        "heavy = {'torch', 'cv2', 'gtsam', 'numba'} & set(sys.modules); assert not heavy, heavy"
    )
    subprocess.run([sys.executable, "-c", code], check=True, cwd=Path(__file__).resolve().parents[3])


def test_the_page_of_baselines_lists_every_tracker_as_its_spec_says() -> None:
    page = (Path(__file__).resolve().parents[3] / "docs" / "baselines.md").read_text(encoding="utf-8")
    specs = tuple(all_specs())
    assert specs
    for spec in specs:
        told = "; ".join(spec.assumptions) + (f" ({spec.remarks})" if spec.remarks else "")
        row = f"| `{spec.id}` | {spec.provenance} | {spec.summary} | {told.strip()} |"
        assert row in page, f"docs/baselines.md lacks this row:\n{row}"
