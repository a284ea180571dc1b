"""Every tunable setting acts, and an online one acts in mid-episode as it does from the beginning.

An episode that is configured before its first frame equals, bit for bit, that of a tracker built
with those settings. After `reset` the settings that the tracker was built with are in force again.
"""

import subprocess
import sys
from collections.abc import Callable, Iterator
from copy import copy
from dataclasses import replace
from itertools import islice
from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers.steering_scene import (
    FRAMES,
    SmallScene,
    construct,
    difference,
    play,
    quick,
    settings_for,
)

from dynslam_bench.contracts import Frame, TrackResult
from dynslam_bench.core.errors import (
    DynslamError,
    SegmentationError,
    SequenceError,
    SettingsError,
    TrackerError,
)
from dynslam_bench.core.settings import (
    OnlineSettings,
    Parameter,
    Settings,
    apply_overrides,
    flatten,
    online_parameters,
    tunable,
)
from dynslam_bench.core.stage_cache import StageCache
from dynslam_bench.features.registry import CachedExtractor, build_extractor
from dynslam_bench.features.settings import FeatureSettings
from dynslam_bench.sequences.synthetic import open_synthetic
from dynslam_bench.trackers import TRACKERS, TrackerContext, build_tracker
from dynslam_bench.trackers.registry import all_specs, resolve_settings
from dynslam_bench.trackers.systems.composition import UnfilteredSystemSettings
from dynslam_bench.tuning import SpaceSpec, search_space
from dynslam_bench.tuning.plan import source_of_masks

SYSTEMS = {
    spec.id: spec for spec in all_specs() if issubclass(spec.settings, UnfilteredSystemSettings)
}
SHORT = 3
"""Frames of the episodes in which all settings of a tracker change at once."""
IDENTITY = {"orb-slam2-mono", "orb-slam2"}
LATE = {"detect-slam", "ngd-slam"}
"""Cull with other settings than the default on so few frames."""
SLOW_STARTERS = {"dynaslam-g", "dai-slam"}
"""Need five keyframes, or a window of frames, before they judge."""


def offered() -> dict[str, tuple[str, Parameter]]:
    """Every setting that a study of some system draws on rendered sequences, with the first such system."""
    settings: dict[str, tuple[str, Parameter]] = {}
    for spec in SYSTEMS.values():
        tracker_settings = spec.settings()
        if hasattr(tracker_settings, "segmentation"):  # "auto" stands for a source of masks
            source = source_of_masks(tracker_settings, ["synthetic/walking_xyz"])
            tracker_settings = apply_overrides(tracker_settings, {"segmentation.source": source})
        for parameter in search_space(tracker_settings, SpaceSpec()):
            settings.setdefault(parameter.name, (spec.id, parameter))
    return settings


OFFERED = offered()
KEYFRAMES = {"backend.keyframes.tracked_share": 1.0, "free_space.min_share": 0.0}
CASES: dict[str, tuple[str, dict[str, object]]] = {
    "backend.keyframes.view_share": ("orb-slam2", {
        "backend.keyframes.tracked_share": 0.4, "backend.keyframes.new_close": 400,
        "backend.keyframes.moved_share": 0.8,
    }),
    "backend.keyframes.moved_share": ("orb-slam2", {
        "backend.keyframes.tracked_share": 0.95, "backend.keyframes.new_close": 400,
        "backend.keyframes.established": 5, "backend.keyframes.view_share": 0.5,
    }),
    "epipolar.threshold_px": ("emfoa-oft?masks=vote&depth=none", {}),
    "epipolar.vote_share": ("emfoa-oft?masks=vote&depth=none", {}),
    "backend.relocalisation.min_inliers": ("emfoa-oft", {}),
    "epipolar.min_share": ("emfoa-oft-paper?masks=none", {}),
    "free_space.threshold_m": ("emfoa-oft?masks=none", {
        **KEYFRAMES, "backend.keyframes.schedule": "every", "free_space.min_votes": 1,
        "free_space.threshold_sigma": 0.0,
    }),
    "free_space.threshold_sigma": ("emfoa-oft?masks=none", {
        **KEYFRAMES, "free_space.min_votes": 1, "free_space.threshold_m": 0.01,
    }),
    "free_space.min_votes": ("emfoa-oft?masks=none", {
        **KEYFRAMES, "free_space.threshold_m": 0.01, "free_space.threshold_sigma": 0.0,
    }),
    "motion.enabled": ("emfoa-oft?masks=none", {}),
    "free_space.enabled": ("emfoa-oft?masks=none", {
        **KEYFRAMES, "free_space.min_votes": 1, "free_space.threshold_m": 0.01, "free_space.threshold_sigma": 0.0,
    }),
    "class_rule.depth_m": ("seg-slam", {
        "segmentation.classes": "chair", "class_rule.movable": "person", "class_rule.vote_share": 0.1,
    }),
}  # fmt: skip
"""The tracker in which a setting acts on the excerpt, if not in the first that has it, and what else is set."""
MANY = {
    "backend.keyframes.tracked_share": 0.95,
    "backend.keyframes.established": 1,
    "backend.keyframes.moved_share": 1.0,
    "backend.keyframes.view_share": 0.98,
}
"""A keyframe nearly every frame."""
JUDGED = (
    "emfoa-oft?masks=none&depth=none",
    {"epipolar.min_parallax_px": 0.0, "epipolar.parallax_share": 0.0},
)
"""F judges every frame."""
BRISK = {
    "multiview.min_keyframes": 1,
    "multiview.max_variance": 1.0,
    "backend.keyframes.tracked_share": 1.0,
}
"""Depth is compared with keyframes from the second one on."""
NETWORK = ("mask-rcnn", {"segmentation.source": "embedded"})
CASES |= {
    # a narrow image is enlarged: it has more corners than features, whatever the threshold
    "features.fast_threshold": ("orb-slam2", {"features.n_features": 3000}),
    "backend.mapping.neighbours": ("orb-slam2", MANY),
    "backend.bundle_adjustment.fixed": ("orb-slam2", {**MANY, "backend.bundle_adjustment.window": 2}),
    "backend.bundle_adjustment.observations": ("orb-slam2", MANY),
    "multiview.order": ("dynaslam-g", {**BRISK, "multiview.references": 1, "multiview.tau_m": 0.05}),
    **{f"multiview.{name}": ("dynaslam-g", BRISK) for name in ("references", "dilation_px", "border_px", "tau_m")},
    "segmentation.mask_threshold": NETWORK,
    "epipolar.parallax_share": (JUDGED[0], {"epipolar.min_parallax_px": 0.0}),
    **{f"epipolar.{name}": JUDGED for name in ("homography_share", "max_contradiction")},
    **{
        f"epipolar.{name}": ("emfoa-oft-paper?flow=sparse", {})
        for name in ("estimator", "confidence", "inlier_px", "mode")
    },
}  # fmt: skip
FROM_ABOVE = frozenset({
    "backend.tracking.min_inliers", "backend.relocalisation.min_inliers", "backend.mapping.min_found_ratio",
    "guard.min_features", "moving_vote.min_votes", "multiview.border_px", "box_depth.min_valid",
})  # fmt: skip
"""Settings whose upper end acts first."""
SHOWN_ALONE = frozenset({
    "epipolar.confidence", "free_space.max_age_s", "correlation.largest", "moving_vote.corners",
    "class_rule.vote_share", "box_depth.max_cover", "motion.threshold_share", "motion.memory",
    "multiview.max_parallax_deg", "depth_ransac.max_draws", "depth_ransac.confidence", "guard.min_fraction",
    "backend.keyframes.max_gap", "backend.keyframes.redundant_share", "backend.bundle_adjustment.window",
    *(f"backend.relocalisation.{name}" for name in ("candidates", "iterations", "max_distance")),
})  # fmt: skip
"""Settings that change nothing on these few frames: they act in long maps, at long ages, or when lost."""


class Scene(SmallScene):
    """The small scene with black frames, after which a system has to relocalise."""

    def __init__(self) -> None:
        super().__init__(frames=FRAMES)
        for number in (8, 9):
            frame = self.frames[number]
            self.frames[number] = Frame(
                number, frame.timestamp, np.zeros_like(frame.rgb), np.zeros_like(frame.depth)
            )


@pytest.fixture(scope="module")
def scene() -> Scene:
    return Scene()


@pytest.fixture(scope="module")
def unsteered(scene: Scene) -> Callable[..., list[TrackResult]]:
    """The first frames of a tracker that nobody steers, played once for all that compare with them."""
    played: dict[object, tuple[list[TrackResult], Iterator[TrackResult]]] = {}

    def episode(name: str, frames: int, others: dict[str, object]) -> list[TrackResult]:
        key = (name, *others.items())
        if key not in played:
            played[key] = [], play(construct(SYSTEMS[name], scene, **others), scene)
        results, rest = played[key]
        results += islice(rest, max(0, frames - len(results)))
        return results[:frames]

    return episode


def at_first(tracker, settings: Settings):
    """Steers before the first frame."""
    return lambda number: tracker.configure(settings) if number == 0 else None


def until_it_acts(
    unsteered: list[TrackResult], episode: Iterator[TrackResult]
) -> list[TrackResult]:
    """An episode's results to the first that is not as unsteered; none if none differs."""
    results = []
    for before, result in zip(unsteered, episode, strict=True):
        results.append(result)
        if difference([before], [result]):
            return results
    return []


def check_honest(spec, results: list[TrackResult], culling: list[TrackResult]) -> None:
    """What a system says of its frames is so, and in the episode `culling` it culls where it should."""
    # until the camera has moved enough
    waiting = {"initialising"} if spec.sensors == "rgb" else set()
    assert {result.state for result in results} <= {"ok"} | waiting
    assert len({frozenset(result.stats) for result in results[1:]}) == 1, (
        "the same stats on every frame"
    )
    for result in results:
        assert np.isfinite(list(result.stats.values())).all()
        assert np.count_nonzero(~result.keypoints_keep) == result.stats["culled"]
    culled = sum(result.stats["culled"] for result in culling)
    if spec.id in IDENTITY:
        assert culled == 0
    elif spec.id not in SLOW_STARTERS:
        degenerate = [result.stats.get("epipolar_degenerate") for result in results[1:]]
        assert culled > 0 or set(degenerate) == {1.0}, (
            "it culls, or says that the camera shows too little parallax"
        )


@pytest.mark.slow
@pytest.mark.parametrize("name", SYSTEMS)
def test_every_system_is_honest_and_all_its_settings_act_and_are_restored(
    name: str, scene: Scene, unsteered
) -> None:
    spec = SYSTEMS[name]
    tracker = construct(spec, scene)
    settings = settings_for(spec)
    ranges = [p for p in online_parameters(settings) if not p.choices]
    ends = {p.name: p.low if number % 2 else p.high for number, p in enumerate(ranges)}
    ends |= {"features.fast_threshold": 12, "features.fast_threshold_min": 3}
    extreme = apply_overrides(settings, ends)
    fresh = unsteered(name, SHORT, {})
    steered = play(tracker, scene, SHORT, before=at_first(tracker, extreme))
    static = list(play(construct(spec, scene, **ends), scene, SHORT))
    check_honest(spec, fresh, static if name in LATE else fresh)
    assert difference(fresh[:1], static[:1]), "the extremes do not act from the first frame on"
    assert not difference(static, steered), (
        "steered is not what building with the same values gives"
    )
    assert not difference(fresh[:2], play(tracker, scene, 2)), (
        "reset() leaves something of the steered episode"
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", [name for name in OFFERED if name not in SHOWN_ALONE and "preprocessing" not in name]
)
def test_every_setting_that_a_study_may_draw_acts(name: str, scene: Scene, unsteered) -> None:
    system, parameter = OFFERED[name]
    system, others = CASES.get(name, (system, {}))
    # dense flow costs ten times as much
    frames = SHORT if quick(SYSTEMS[system].settings) else FRAMES
    ends = (
        (parameter.high, parameter.low) if name in FROM_ABOVE else (parameter.low, parameter.high)
    )
    for value in parameter.choices or ends:
        if value == parameter.default:
            continue
        try:
            built = construct(SYSTEMS[system], scene, **others, **{name: value})
        except DynslamError:
            continue  # the value does not go with the others
        expected = until_it_acts(unsteered(system, frames, others), play(built, scene, frames))
        if not expected:
            continue
        if parameter.online:
            tracker = construct(SYSTEMS[system], scene, **others)
            changed = apply_overrides(settings_for(SYSTEMS[system], **others), {name: value})
            steered = play(tracker, scene, len(expected), before=at_first(tracker, changed))
            assert not difference(expected, steered), f"{system}: {name} = {value}"
        return
    pytest.fail(f"{name} changes nothing in {system}, at any of {parameter.choices or ends}")


def test_only_what_differs_is_handed_on() -> None:
    class Part(Settings):
        value: float = tunable(1.0, low=0.0, high=2.0, online=True, meaning="x")

    class Whole(Settings):
        one: Part = Part()
        two: Part = Part()

    given: list[tuple[str, float]] = []
    takers = [(name, lambda s, name=name: given.append((name, s.value))) for name in ("one", "two")]
    steering = OnlineSettings(Whole(), takers)
    steering.configure(Whole(two=Part(value=2.0)))
    steering.configure(Whole(two=Part(value=2.0)))
    assert given == [("two", 2.0)]
    steering.restore()
    assert given[1:] == [("one", 1.0), ("two", 1.0)]
    with pytest.raises(
        SettingsError, match=r"'two.value' of Whole is taken by no part .*configure\(settings\)"
    ):
        OnlineSettings(Whole(), takers[:1])


# Systems without depth: they never read it, they are refused what takes it, and what they score
# says so.


@pytest.fixture(scope="module")
def plain_scene():
    return SmallScene("synthetic/walking_xyz?scene=105")


@pytest.mark.slow
@pytest.mark.parametrize(
    "tracker", [name for name, spec in SYSTEMS.items() if spec.sensors == "rgb"]
)
def test_depth_is_never_read(plain_scene, tracker):
    rng = np.random.default_rng(0)
    wild = copy(plain_scene)
    wild.frames = [
        replace(frame, depth=rng.uniform(0.1, 9.0, frame.depth.shape).astype(np.float32))
        for frame in wild.frames
    ]
    spec = TRACKERS.get(tracker)
    # the images are small
    few = {"backend.two_views.min_matches": 40, "backend.two_views.min_points": 25}
    true = list(play(construct(spec, plain_scene, **few), plain_scene))
    # masks that err leave the others too little of so small a room for a map
    if tracker == "orb-slam2-mono":
        assert sum(result.state == "ok" for result in true) >= len(true) // 2
    else:
        assert sum(result.stats["culled"] for result in true) > 100
    assert difference(true, play(construct(spec, wild, **few), wild)) == ""


CACHED = 4


@pytest.fixture(scope="module")
def rendered(tmp_path_factory: pytest.TempPathFactory):
    return open_synthetic(
        f"synthetic/walking_xyz?scene=5&frames={CACHED}", tmp_path_factory.mktemp("rendered")
    )


def run(rendered, cache: Path | None, **settings: object):
    """Poses ``[N, 4, 4]`` and the results of a run with the embedded network."""
    context = TrackerContext(sequence_id=rendered.id, cache=None if cache is None else str(cache))
    tracker = build_tracker("emfoa-oft", {"segmentation.source": "embedded", **settings}, context)
    tracker.reset(rendered.camera, rng=np.random.default_rng(0))
    results = [tracker.track(rendered[index]) for index in range(len(rendered))]
    return np.array([result.T_world_cam for result in results]), results


@pytest.mark.slow
def test_cached_runs_have_the_same_bits_and_load_no_network(
    rendered, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plain, _ = run(rendered, None)
    cold, filled = run(rendered, tmp_path)
    assert [result.stats["cached_stages"] for result in filled] == [0.0] * CACHED

    def refuse(*_: object) -> None:
        raise AssertionError("a network was loaded although all masks are stored")

    monkeypatch.setattr(
        "dynslam_bench.segmentation.networks.mask_rcnn_segmenter.build_embedded", refuse
    )
    warm, found = run(
        rendered, tmp_path, **{"epipolar.threshold_px": 2.0, "segmentation.confidence": 0.35}
    )
    again, _ = run(rendered, tmp_path)
    assert [result.stats["cached_stages"] for result in found] == [2.0] * CACHED
    assert np.array_equal(plain, cold)
    assert np.array_equal(plain, again)
    assert warm.shape == plain.shape
    for before, after in zip(filled, found, strict=True):
        cost = before.timings["segmentation"]
        assert after.timings["segmentation"] == pytest.approx(cost, rel=0.5), (
            "told as what it costs, not the look-up"
        )


EXTRACTOR = """
import numpy as np
from dynslam_bench.contracts import FeatureSpec, Keypoints

class Mine:
    def extract(self, gray):
        n = COUNT
        return Keypoints(np.full((n, 2), 30, np.float32), np.zeros(n, np.int32), np.zeros(n, np.float32),
                         np.ones(n, np.float32), np.zeros((n, 32), np.uint8))

def build(settings):
    return Mine()

SPEC = FeatureSpec("mine", f"{__file__}:build")
"""
ASK = """
import sys
from pathlib import Path
import numpy as np
from dynslam_bench.core.stage_cache import StageCache, record_reads
from dynslam_bench.features.registry import build_extractor, cached_extractor
from dynslam_bench.features.settings import FeatureSettings

plugin = Path(sys.argv[1].rpartition(":")[0])
settings = FeatureSettings(extractor=sys.argv[1], options={"weights": sys.argv[3]})
cache = StageCache(Path(sys.argv[2]))
if cached_extractor(build_extractor(settings), settings, cache, 1) is not None:
    print("a plug-in is cached although nothing records what it reads")
record_reads(plugin.read_text)  # in a run its recorder gives a digest of all that was read
for content in sys.argv[4:]:
    Path(sys.argv[3]).write_text(content)
    cached = cached_extractor(build_extractor(settings), settings, cache, 1)
    print(len(cached.extract(np.zeros((60, 60), np.uint8)).xy), cached.hit)
"""


@pytest.mark.slow
def test_an_edited_extractor_or_other_weights_get_no_old_keypoints(tmp_path: Path) -> None:
    plugin = tmp_path / "mine.py"
    weights = tmp_path / "net.bin"

    def ask(count: int, *contents: str) -> list[str]:
        plugin.write_text(EXTRACTOR.replace("COUNT", str(count)))
        command = [
            sys.executable,
            "-c",
            ASK,
            f"{plugin}:SPEC",
            str(tmp_path / "cache"),
            str(weights),
            *contents,
        ]
        return subprocess.run(
            command, capture_output=True, text=True, check=True
        ).stdout.splitlines()

    assert ask(3, "one", "one") == ["3 False", "3 True"]
    assert ask(5, "one", "three") == ["5 False", "5 False"]


def test_a_result_during_which_a_plug_in_reads_something_is_not_stored(tmp_path: Path) -> None:
    settings = FeatureSettings()
    digests = iter(["before", "after the weights were read", "after", "after"])
    cached = CachedExtractor(
        build_extractor(settings), settings, StageCache(tmp_path), 1, lambda: next(digests)
    )
    image = np.zeros((60, 60), np.uint8)
    cached.extract(image)
    assert not list(tmp_path.rglob("*.npz"))
    cached.extract(image)
    assert len(list(tmp_path.rglob("*.npz"))) == 1


def test_a_missing_file_is_an_error_at_once_with_the_cache_too(rendered, tmp_path: Path) -> None:
    with pytest.raises(SegmentationError, match=r"nowhere\.onnx"):
        run(rendered, tmp_path, **{"segmentation.source": f"onnx:{tmp_path / 'nowhere.onnx'}"})


# The presets that ship: they fit, change something and act in a run.


@pytest.mark.parametrize(
    ("tracker", "name"), [(t.spec.id, name) for t in TRACKERS.all() for name in t.spec.presets]
)
def test_each_sets_something_else_than_the_default(tracker, name):
    spec = TRACKERS.get(tracker)
    default = flatten(spec.settings())
    chosen = flatten(resolve_settings(spec, spec.presets[name]))
    changed = {key for key in chosen if chosen[key] != default[key]}
    assert changed
    assert changed <= set(spec.presets[name])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("more", "asked"), [({}, [1, 0, 1, 0, 1, 0, 1]), ({"crowded_share": 0.1}, [1] * 7)]
)
def test_fast_asks_the_network_on_every_second_frame_but_where_people_cover_the_view(
    sitting, more, asked
):
    settings = {"segmentation.source": "oracle", **TRACKERS.get("mask-rcnn").presets["fast"]}
    settings |= {f"segmentation.{name}": value for name, value in more.items()}
    tracker = build_tracker("mask-rcnn", settings, TrackerContext(sitting.id, masks=sitting.masks))
    tracker.reset(sitting.camera, rng=np.random.default_rng(0))
    assert [
        tracker.track(sitting[index]).stats["segmented"] for index in range(len(asked))
    ] == asked


BAD = range(4, 9)
"""The frames that a fault spoils."""
END = 13
"""Where the episodes with a fault end."""


@pytest.fixture(scope="module")
def sitting(tmp_path_factory: pytest.TempPathFactory):
    return open_synthetic(
        "synthetic/sitting_xyz?scene=2&frames=44", tmp_path_factory.mktemp("rendered")
    )


def started(sitting, name: str = "orb-slam2"):
    tracker = build_tracker(name, {}, TrackerContext(sequence_id=sitting.id))
    tracker.reset(sitting.camera, rng=np.random.default_rng(0))
    return tracker


def track(sitting, change: Callable[[Frame], Frame], bad: range = BAD):
    """States, and for the tracked frames the distance in metres from the true camera centre, first pose aligned."""
    tracker = started(sitting)
    states = []
    error = {}
    truth = sitting.ground_truth.T_world_cam
    for index in range(END):
        frame = sitting[index]
        result = tracker.track(change(frame) if index in bad else frame)
        states.append(result.state)
        assert result.T_world_cam is None or np.isfinite(result.T_world_cam).all()
        if result.state == "ok":
            error[index] = float(
                np.linalg.norm((truth[0] @ result.T_world_cam - truth[index])[:3, 3])
            )
    assert max(error.values()) < 0.05
    return states


@pytest.mark.slow
@pytest.mark.parametrize("value", [0, 127], ids=["covered lens", "fog"])
def test_frames_without_any_texture_are_lost_and_only_those(sitting, value: int) -> None:
    states = track(sitting, lambda frame: replace(frame, rgb=np.full_like(frame.rgb, value)))
    lost = [index for index, state in enumerate(states) if state == "lost"]
    assert lost[: len(BAD)] == list(BAD), "each covered frame counts as lost"
    assert len(lost) <= len(BAD) + 2, f"recovery within two frames, but lost: {lost}"


@pytest.mark.slow
@pytest.mark.parametrize("gain", [0.35, 2.2], ids=["under-exposed", "over-exposed"])
def test_a_wrong_exposure_is_survived(sitting, gain: float) -> None:
    def exposed(frame: Frame) -> Frame:
        """As if exposed `gain` times as long, clipped by the sensor."""
        return replace(frame, rgb=np.clip(frame.rgb * gain, 0, 255).astype(np.uint8))

    assert track(sitting, exposed).count("ok") >= END - 3


def test_without_depth_for_a_while_it_tracks_on_or_says_lost(sitting) -> None:
    states = track(sitting, lambda frame: replace(frame, depth=np.zeros_like(frame.depth)))
    assert states[BAD.stop + 2 :].count("ok") == END - BAD.stop - 2


@pytest.mark.parametrize("degrees", [3, 5, 7])
def test_a_sudden_turn_is_no_translation(sitting, degrees: int) -> None:
    """From rest, one frame later turned: a chance agreement within the search window must not pass for the pose."""
    tracker = started(sitting)
    frame = sitting[5]
    matrix = sitting.camera.matrix
    for index in range(3):
        tracker.track(replace(frame, index=index, timestamp=index / 30))
    rotation = cv2.Rodrigues(np.array([0, np.deg2rad(degrees), 0]))[0]
    warp = matrix @ rotation @ np.linalg.inv(matrix)
    size = (sitting.camera.width, sitting.camera.height)
    turned = Frame(
        3,
        0.1,
        np.asarray(cv2.warpPerspective(frame.rgb, warp, size), np.uint8),
        np.asarray(
            cv2.warpPerspective(frame.depth, warp, size, flags=cv2.INTER_NEAREST), np.float32
        ),
    )
    result = tracker.track(turned)
    assert result.state == "lost" or np.linalg.norm(result.T_world_cam[:3, 3]) < 0.02


@pytest.mark.slow
def test_a_gap_of_a_second_is_bridged_or_said(sitting) -> None:
    tracker = started(sitting)
    truth = sitting.ground_truth.T_world_cam
    tracked = []
    for index in (*range(5), *range(36, 44)):
        result = tracker.track(sitting[index])
        if result.state == "ok":
            assert np.linalg.norm((truth[0] @ result.T_world_cam - truth[index])[:3, 3]) < 0.03
            tracked.append(index)
    assert tracked[:5] == [0, 1, 2, 3, 4]


def test_frames_of_another_kind_are_refused_in_one_line(sitting) -> None:
    tracker = build_tracker("emfoa-oft?masks=none", {}, TrackerContext(sequence_id=sitting.id))
    for method in (tracker.finalize, tracker.map_outputs):
        with pytest.raises(TrackerError, match=r"before reset\(\)"):
            method()
    tracker.reset(sitting.camera, rng=np.random.default_rng(0))
    frame = sitting[0]
    for wrong, text in (
        (replace(frame, rgb=frame.rgb / 255.0), r"colour of type float64 .*uint8"),
        (
            replace(frame, depth=(1000 * frame.depth).astype(np.uint16)),
            r"depth of type uint16 .*float32, in metres",
        ),
        (replace(frame, depth=None), r"depth of type object"),
        (replace(frame, timestamp=float("inf")), r"timestamp inf"),
    ):
        with pytest.raises(SequenceError, match=text):
            tracker.track(wrong)


@pytest.mark.slow
def test_missing_depth_is_missing_however_it_is_written_and_buffers_may_be_reused(sitting) -> None:
    def poses(missing: float, *, reuse: bool) -> bytes:
        tracker = started(sitting, "emfoa-oft?masks=none")
        buffer = np.empty_like(sitting[0].depth)
        found = []
        for index in range(5):
            frame = sitting[index]
            depth = np.where(frame.depth > 0, frame.depth, missing).astype(np.float32)
            buffer[:] = depth
            found.append(
                tracker.track(replace(frame, depth=buffer if reuse else depth)).T_world_cam
            )
        return np.array(found).tobytes()

    assert (
        poses(0.0, reuse=False)
        == poses(np.inf, reuse=False)
        == poses(np.nan, reuse=False)
        == poses(0.0, reuse=True)
    )
