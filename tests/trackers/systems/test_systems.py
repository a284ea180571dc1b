"""Systems: their settings reach what they are for, masks are asked for, and their specs say what they do."""

from itertools import product
from pathlib import Path

import baseline_signatures as signatures
import cv2
import numpy as np
import pytest
from helpers.culling_scenes import ACROSS, BOX, SIDEWAYS, box_instance, on_rectangle, scene
from helpers.reports_fake_store import add_run
from helpers.steering_scene import SmallScene, construct, quick
from helpers.steering_scene import play as play_small

from dynslam_bench.contracts import Instances, TrackResult
from dynslam_bench.core import settings as core_settings
from dynslam_bench.core.errors import DynslamError, SettingsError
from dynslam_bench.core.settings import parameters, settings_table
from dynslam_bench.flow import dense_flow as dense
from dynslam_bench.flow.opencv import LEVELS
from dynslam_bench.flow.settings import PublishedFlowSettings
from dynslam_bench.runs import RunStore
from dynslam_bench.segmentation.settings import SegmentationSettings
from dynslam_bench.sequences.catalogue import open_sequence
from dynslam_bench.slam.pipeline import SlamPipeline
from dynslam_bench.trackers import TRACKERS, TrackerContext, TrackerSpec, build_tracker
from dynslam_bench.trackers.registry import all_specs, tracker_groups
from dynslam_bench.trackers.systems.composition import (
    SemanticSystemSettings,
    UnfilteredSystemSettings,
    describe_masks,
    describe_tracks,
)

FRAMES = 4
SYSTEMS = [spec for spec in all_specs() if issubclass(spec.settings, UnfilteredSystemSettings)]
MASKED = [
    spec
    for spec in SYSTEMS
    if issubclass(spec.settings, SemanticSystemSettings)
    and spec.settings().segmentation.source == "auto"
]


@pytest.fixture(scope="module")
def walking():
    return open_sequence(f"synthetic/walking_xyz?frames={FRAMES}")


def build(spec: TrackerSpec, sequence) -> SlamPipeline:
    settings = quick(spec.settings) | ({"segmentation.source": "oracle"} if spec in MASKED else {})
    return build_tracker(
        spec, settings, TrackerContext(sequence_id=sequence.id, masks=sequence.masks)
    )


def run(spec: TrackerSpec, sequence) -> list[TrackResult]:
    tracker = build(spec, sequence)
    tracker.reset(sequence.camera, rng=np.random.default_rng(0))
    return [tracker.track(sequence[index]) for index in range(FRAMES)]


@pytest.mark.parametrize("name", ["mask-rcnn", "dynaslam", "yolo-slam", "seg-slam", "emfoa-oft"])
def test_no_masks_where_a_system_needs_them_is_a_clear_error(name: str) -> None:
    with pytest.raises(SettingsError, match=r"needs masks.*none.*oracle.*onnx:PATH.*weights:PATH"):
        build_tracker(name, {"segmentation.source": "none"})


@pytest.mark.parametrize("spec", MASKED, ids=lambda spec: spec.id)
def test_online_segmentation_settings_reach_every_filter(spec: TrackerSpec, walking) -> None:
    tracker = build(spec, walking)
    tracker.configure(
        spec.settings.model_validate({"segmentation": {"source": "oracle", "confidence": 0.77}})
    )
    held = [(getattr(rule, "segmentation", None), rule.settings) for rule in tracker._filters]
    for settings in (
        settings for pair in held for settings in pair if isinstance(settings, SegmentationSettings)
    ):
        assert settings.confidence == 0.77


@pytest.mark.slow
@pytest.mark.parametrize("name", ["sof-slam", "seg-slam"])
def test_movable_things_reach_the_rule_that_judges_them(name: str, walking) -> None:
    assert any(
        result.stats["class_rule_on_movable"] > 0 for result in run(TRACKERS.get(name), walking)
    )


def test_a_networks_movable_things_pass_only_where_a_filter_wants_them(walking) -> None:
    class Network:
        def segment(self, frame):
            masks = np.zeros((2, *frame.rgb.shape[:2]), bool)
            masks[0, 100:200, 100:200] = masks[1, 250:300, 250:300] = True
            boxes = np.array([[100, 100, 200, 200], [250, 250, 300, 300]], np.float32)
            return Instances(masks, boxes, ("person", "chair"), np.ones(2, np.float32))

    for name, wanted in (("seg-slam", ("person", "chair")), ("mask-rcnn", ("person",))):
        tracker = build(TRACKERS.get(name), walking)
        tracker._mask_scheduler.segmenter.inner = Network()
        assert tracker._mask_scheduler.segmenter.segment(walking[0]).class_names == wanted


@pytest.mark.parametrize("spec", all_specs(), ids=lambda spec: spec.id)
def test_specs_are_complete(spec: TrackerSpec) -> None:
    assert spec.label
    assert spec.summary
    assert spec.provenance
    assert all(parameter.meaning for parameter in parameters(spec.settings))
    assert settings_table(spec.settings).count("\n") >= 2
    if spec.provenance in ("inspired", "assumed"):
        assert not spec.ranked
        assert spec.assumptions
    if issubclass(spec.settings, UnfilteredSystemSettings):
        assert spec.citation
        assert "our back end" in spec.label or "ablation" in spec.label


def test_variants_are_listed_under_their_system_and_ablations_rank_never() -> None:
    groups = tracker_groups()
    names = {spec.id for group in groups.values() for family in group for spec in family}
    assert names == {tracker.spec.id for tracker in TRACKERS.all()}
    assert "never-move" in {f[0].id for f in groups["control"]}
    ours = next(family for family in groups["this project's"] if family[0].id == "emfoa-oft")
    paper = next(family for family in groups["published"] if family[0].id == "emfoa-oft-paper")
    assert len(ours) == 10
    assert len(paper) == 3
    assert ours[0].ranked
    assert paper[0].provenance == "faithful-paper"
    for spec in (*ours[1:], *paper[1:]):
        assert spec.provenance == "own"
        assert spec.ranked == (spec.id == "emfoa-oft?masks=none")
        assert spec.id.startswith(("emfoa-oft?", "emfoa-oft-paper?"))


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
    assert (
        TRACKERS.get("emfoa-oft").settings.model_fields.keys()
        - TRACKERS.get(name).settings.model_fields
        == missing
    )


def test_systems_with_a_compensation_of_their_own_bridge_longer() -> None:
    masked = [spec for spec in all_specs() if issubclass(spec.settings, SemanticSystemSettings)]
    longer = {spec.id: spec.settings().segmentation.compensate for spec in masked}
    shared = SegmentationSettings().compensate
    assert {name: frames for name, frames in longer.items() if frames != shared} == {
        "huai-slam": 5,
        "cfp-slam": 5,
    }


# People fill the view: they must not take the places of the few features that the camera's pose is
# found with.


@pytest.mark.slow
def test_a_crowd_in_front_of_the_camera_leaves_enough_features() -> None:
    """People cover 85 % of the features; with all of them counted the camera was lost from frame 14 on."""
    sequence = open_sequence("synthetic/walking_halfsphere?scene=102", frames=(0, 24))
    kept = {}
    states = {}
    for share in (0.0, 0.3):
        settings = {"segmentation.source": "oracle", "segmentation.outside_share": share}
        tracker = build_tracker(
            "mask-rcnn", settings, TrackerContext(sequence.id, masks=sequence.masks)
        )
        tracker.reset(sequence.camera, rng=np.random.default_rng(0))
        results = [tracker.track(sequence[index]) for index in range(len(sequence))]
        kept[share] = np.median([result.keypoints_keep.sum() for result in results])
        states[share] = [result.state for result in results]
    assert kept[0.0] < 200 < 400 < kept[0.3]
    assert "lost" in states[0.0]
    assert set(states[0.3]) == {"ok"}


# What published systems get from the shared stages is the same as their sources say, or stands in
# their specs.


@pytest.mark.parametrize("spec", SYSTEMS, ids=lambda spec: spec.id)
def test_specs_state_how_masks_and_flow_are_computed(spec) -> None:
    text = "; ".join(spec.assumptions)
    settings = spec.settings()
    if isinstance(settings, SemanticSystemSettings):
        assert describe_masks(settings.segmentation).partition("come from")[2] in text
    if (
        isinstance(getattr(settings, "flow", None), PublishedFlowSettings)
        and spec.provenance != "assumed"
    ):
        assert describe_tracks(settings.flow) in text


def test_no_published_system_has_a_check_on_its_flow_but_one_that_says_so() -> None:
    published = [
        spec
        for spec in SYSTEMS
        if not spec.id.startswith("emfoa-oft") and "flow" in spec.settings.model_fields
    ]
    checked = [spec.id for spec in published if spec.settings().flow.forward_backward_px > 0]
    assert len(published) > 8
    assert checked == ["dai-slam"]
    assert describe_tracks(TRACKERS.get("dai-slam").settings().flow) in "; ".join(
        TRACKERS.get("dai-slam").assumptions
    )


# Systems that judge by boxes or by whole objects, and the one that grows its masks.
@pytest.mark.parametrize("name", [
    "ds-slam", "di-slam", "yolo-slam", "dynatm-slam", "ngd-slam", "sgc-slam", "detect-slam", "dgs-slam", "blitz-slam",
])  # fmt: skip
def test_masks_are_grown_and_repaired_only_where_the_system_does_it(name: str) -> None:
    settings = TRACKERS.get(name).settings
    assert ("segmentation.dilation_px" in {each.name for each in parameters(settings)}) == (
        name == "blitz-slam"
    )
    with pytest.raises(SettingsError):
        core_settings.build(settings, {"segmentation": {"repair": "depth"}})


# What `docs/explanation/paper.md` says of each equation: the trackers run what it says they run.


@pytest.mark.slow
@pytest.mark.parametrize(("name", "terms"), [("emfoa-oft", 1), ("emfoa-oft-paper", 3)])
def test_the_papers_tracker_runs_eq_1_to_3_and_ours_the_first_term(
    monkeypatch, name: str, terms: int
) -> None:
    calls: list[bool] = []
    chosen = dense.aggregate_and_choose

    def spy(*arguments) -> None:
        calls.append(bool(arguments[4].tables.appearance))
        chosen(*arguments)

    monkeypatch.setattr(dense, "aggregate_and_choose", spy)
    small = SmallScene(frames=2)
    rounds = {"flow.second_round": True} if terms == 3 else {}
    stats = list(play_small(construct(TRACKERS.get(name), small, **rounds), small))[1].stats
    assert stats["flow_valid"] > 100
    assert stats["epipolar_f_asked"] == 1
    assert terms == 1 or stats["epipolar_f_judged"] == 1, "the paper knows no guard"
    assert calls == [True] * (4 if terms == 3 else 0)  # there and back, two rounds


@pytest.mark.parametrize(
    ("ate", "coverage", "broken", "expected"),
    [
        (0.012, 1.0, False, "survives"),
        (0.031, 1.0, False, "between"),
        (0.15, 1.0, False, "fails"),
        (0.012, 0.79, False, "fails"),
        (0.012, 1.0, True, "fails"),
        (float("nan"), 1.0, False, "fails"),
    ],
)
def test_measured_classes(ate: float, coverage: float, broken: bool, expected: str) -> None:
    assert signatures.classify(ate, coverage, 0.3, 0.01, broken) == expected


@pytest.mark.parametrize(
    ("tracker", "sequence", "expected"),
    [
        ("orb-slam2", "walking_xyz", "fails"),  # 0.459 to 0.752 of 0.307 never-move
        ("dynaslam-g", "walking_rpy", "fails"),  # 0.251
        ("dynaslam-g", "walking_halfsphere", "survives"),  # 0.035 of 3 x 0.025
        ("ds-slam", "walking_rpy", "fails"),
        ("yolo-slam", "walking_rpy", "fails"),
        ("dai-slam", "walking_xyz", "between"),  # 0.087: neither
        ("dynaslam", "sitting_static", "survives"),
        ("di-slam", "walking_xyz", None),  # nothing published that could be read
    ],
)
def test_published_classes(tracker: str, sequence: str, expected: str | None) -> None:
    assert (
        signatures.published_class(tracker, signatures.recorded(f"synthetic/{sequence}?scene=3"))
        == expected
    )


@pytest.mark.slow
def test_table_of_a_store_of_computed_trajectories(tmp_path: Path) -> None:
    store = RunStore(tmp_path)
    for seed, (tracker, options) in product(
        (0, 1),
        {
            "mask-rcnn": {"error": 0.004, "overrides": {"segmentation.source": "oracle"}},
            "dynaslam-n": {"provenance": "faithful-code"},
            "orb-slam2": {"error": 0.5, "provenance": "faithful-code"},
            "yolo-slam": {},
            "cfp-slam": {"provenance": "inspired"},
            "dai-slam": {"lost": range(90)},
            "di-slam": {"provenance": "inspired"},
        }.items(),
    ):
        add_run(store, tracker, "synthetic/walking_rpy", seed, **{"error": 0.005} | options)
    text = signatures.report(tmp_path)
    verdicts = {
        line.split("|")[1].strip(): line.rsplit("|", 2)[1].strip()
        for line in text.splitlines()
        if line.startswith("| `")
    }
    assert verdicts == {
        "`dynaslam-n`": "match",
        "`orb-slam2`": "match",
        "`yolo-slam`": "**miss**",
        "`dai-slam`": "match",
        "`cfp-slam`": "match (not counted)",
    }
    assert "match: 3 of 4 (75 %; the bar is 75 %)" in text
    assert "yolo-slam on walking_rpy: survives" in text
    assert "published fails" in text


def test_a_store_without_the_reference_system_is_a_clear_error(tmp_path: Path) -> None:
    add_run(RunStore(tmp_path), "orb-slam2", "synthetic/walking_xyz", 0)
    with pytest.raises(
        DynslamError, match=r"exact masks on synthetic/walking_xyz.*suite 'dynamic'"
    ):
        signatures.report(tmp_path)


TESTED = {
    "sgc-slam", "di-slam", "blitz-slam", "chen-slam", "chen-slam-mono", "mor-slam", "sof-slam", "seg-slam", "opf-slam",
}  # fmt: skip
"""Systems that test matches; a feature without one stays."""
FOLLOWED = {"detect-slam", "huai-slam", "cfp-slam"}
"""Systems that follow features from frame to frame."""


def system(name: str, **settings: object) -> SlamPipeline:
    """A tracker that needs no network: its masks are set by the tests."""
    if "segmentation" in TRACKERS.get(name).settings.model_fields:
        settings["segmentation.source"] = "oracle"
    return build_tracker(name, settings, TrackerContext(masks=[]))


def test_every_published_flow_is_covered() -> None:
    with_flow = {spec.id for spec in all_specs() if "flow" in spec.settings.model_fields}
    # the tracks of dai-slam are judged over a window: `correlation_graph.py`
    assert {name for name in with_flow if not name.startswith("emfoa-oft")} == TESTED | FOLLOWED | {
        "dai-slam"
    }


@pytest.mark.parametrize("rule", ["keep", "drop", "judge"])
@pytest.mark.parametrize("name", sorted(TESTED - {"opf-slam"}))
def test_a_moving_region_whose_flow_fails_goes_by_the_named_rule(name: str, rule: str) -> None:
    block = next(block for block in system(name)._filters if "flow" in block.needs)
    assert block.settings.unmatched == "keep"
    block.settings = block.settings.model_copy(update={"unmatched": rule})
    movable = name in ("sof-slam", "seg-slam")
    thing = box_instance(*BOX, name="chair" if movable else "person")
    made = scene(SIDEWAYS, n_moving=80, motion=ACROSS, instances=thing)
    made.state.previous.instances = thing
    # the flow of every second of its features fails
    lost = made.moving & (np.arange(len(made.frame)) % 2 == 1)
    made.state.flow.valid[lost] = False
    # the depth of a moving thing takes its unmatched features along: not what is tested here
    if movable:
        block.settings = block.settings.model_copy(update={"depth_m": 0.0})
    keep = block.apply(made.frame, made.state).keep
    assert keep[~on_rectangle(made, *BOX)].mean() > 0.99
    assert not keep[made.moving & ~lost].any()
    assert keep[lost].all() if rule == "keep" else not keep[lost].any()


@pytest.mark.parametrize("name", sorted(TESTED | FOLLOWED))
def test_published_flows_are_lucas_kanade_without_a_check_of_ours(name: str) -> None:
    """What the flow of a system finds is what OpenCV's tracker finds, though a way back would contradict some of it."""
    texture = cv2.GaussianBlur(
        np.random.default_rng(0).integers(0, 255, (240, 320), dtype=np.uint8), (0, 0), 2.0
    )
    first = cv2.normalize(texture, None, 0, 255, cv2.NORM_MINMAX)
    second = np.roll(first, (3, 9), (0, 1))
    # something else came in
    second[60:180, 80:240] = cv2.GaussianBlur(second[60:180, 240:80:-1], (0, 0), 4.0)
    grid = np.mgrid[20:300:12, 20:220:12].reshape(2, -1).T.astype(np.float32)
    flow = system(name)._flow
    found = flow.track(flow.prepare(first), flow.prepare(second), grid)
    settings = TRACKERS.get(name).settings().flow
    there, status, _ = cv2.calcOpticalFlowPyrLK(
        first,
        second,
        grid,
        grid.copy(),
        winSize=(settings.window_px,) * 2,
        maxLevel=LEVELS - 1,
        criteria=(cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 30, 0.01),
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
        minEigThreshold=1e-4,
    )
    in_image = ((there >= 0) & (there <= (319, 239))).all(axis=1)
    np.testing.assert_array_equal(found.valid, (status.ravel() > 0) & in_image)
    checked = system(name, **{"flow.forward_backward_px": 1.5})._flow
    kept = checked.track(checked.prepare(first), checked.prepare(second), grid).valid
    assert np.count_nonzero(kept) < 0.9 * np.count_nonzero(found.valid), (
        "the check would have changed the verdicts"
    )
