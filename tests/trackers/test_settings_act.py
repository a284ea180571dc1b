"""No study samples a dead setting: each that a system's space offers changes something, on frames that show it."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest
from steering_scene import SmallScene, construct, difference

from dynslam_bench.contracts.sequence import Frame
from dynslam_bench.core.errors import DynslamError
from dynslam_bench.core.settings import Parameter
from dynslam_bench.sequences.preprocessing import normalise
from dynslam_bench.sequences.settings import PreprocessingSettings
from dynslam_bench.trackers.registry import all_specs
from dynslam_bench.trackers.systems.composition import SystemSettings
from dynslam_bench.tuning import SpaceSpec, search_space

SYSTEMS = {spec.id: spec for spec in all_specs() if issubclass(spec.settings, SystemSettings)}
DENSE = "emfoa-oft-paper-no-masks"
FRAMES, FEW = 14, 3


def offered() -> dict[str, tuple[str, Parameter]]:
    """Every setting that a study of some system draws on rendered sequences, with the first such system.

    What changes in mid-episode is left to `test_steering`, which asks the same of it.
    """
    found: dict[str, tuple[str, Parameter]] = {}
    for spec in SYSTEMS.values():
        for parameter in search_space(spec.settings, SpaceSpec(), ["synthetic/walking_xyz"]):
            if not parameter.online:
                found.setdefault(parameter.name, (spec.id, parameter))
    return found


OFFERED = offered()
MANY = {
    "backend.keyframes.tracked_share": 0.95,
    "backend.keyframes.established": 1,
    "backend.keyframes.moved_share": 1.0,
    "backend.keyframes.view_share": 0.98,
}
"""A keyframe nearly every frame."""
NETWORK = ("mask-rcnn", {"segmentation.source": "embedded"})
CASES: dict[str, tuple[str, dict[str, object]]] = {
    "backend.keyframes.redundant_share": ("orb-slam2", MANY),
    "backend.mapping.neighbours": ("orb-slam2", MANY),
    "backend.bundle_adjustment.fixed": ("orb-slam2", {**MANY, "backend.bundle_adjustment.window": 2}),
    "backend.bundle_adjustment.observations": ("orb-slam2", MANY),
    "multiview.order": ("dynaslam-g", {
        "multiview.min_keyframes": 1, "multiview.max_variance": 1.0, "backend.keyframes.tracked_share": 1.0,
    }),
    "segmentation.mask_threshold": NETWORK,
    "segmentation.nms_iou": NETWORK,
}  # fmt: skip
"""Where a setting shows, if not in the first system that has it as it is: the system, and what else is set."""
SHOWN_ALONE = frozenset({
    "correlation.largest", "moving_vote.corners", "class_rule.vote_share", "box_depth.max_cover",
    "multiview.max_parallax_deg", "depth_ransac.max_draws",
    "backend.keyframes.max_gap", "backend.bundle_adjustment.window",
    *(f"backend.relocalisation.{name}" for name in ("candidates", "iterations", "max_distance")),
})  # fmt: skip
"""Settings that change nothing on these few frames: most ask for long maps, for long ages, or for being lost.

`test_culling_settings_act` and `test_slam_settings_act` show each of them on a scene made for it.
"""


class Scene(SmallScene):
    """The small scene with frames that show nothing, after which a system has to find itself again."""

    def __init__(self) -> None:
        super().__init__(frames=FRAMES)
        for number in (8, 9):
            seen = self.frames[number]
            self.frames[number] = Frame(number, seen.timestamp, np.zeros_like(seen.rgb), np.zeros_like(seen.depth))


@pytest.fixture(scope="module")
def scene() -> Scene:
    return Scene()


@lru_cache(maxsize=64)
def _usual(system: str, others: tuple[tuple[str, object], ...], scene: Scene) -> tuple[object, list[object]]:
    tracker = construct(SYSTEMS[system], scene, **dict(others))
    tracker.reset(scene.camera, rng=np.random.default_rng(0))
    return tracker, []


def usual(system: str, others: dict[str, object], scene: Scene, number: int) -> object:
    """What the system does on a frame without the change; tracked as far as somebody asked."""
    tracker, results = _usual(system, tuple(sorted(others.items())), scene)
    while len(results) <= number:
        results.append(tracker.track(scene.frames[len(results)]))
    return results[number]


def acts(system: str, others: dict[str, object], name: str, value: object, scene: Scene) -> bool:
    """Whether a value makes any frame come out otherwise."""
    tracker = construct(SYSTEMS[system], scene, **{**others, name: value})
    tracker.reset(scene.camera, rng=np.random.default_rng(0))
    return any(
        difference([usual(system, others, scene, number)], [tracker.track(frame)])
        for number, frame in enumerate(scene.frames[: FEW if system == DENSE else FRAMES])
    )


def others_of(parameter: Parameter) -> dict[str, object]:
    """What must be set for the parameter's conditions to hold."""
    return {name: allowed[0] for name, allowed in parameter.when}


def values_of(parameter: Parameter) -> tuple[object, ...]:
    return parameter.choices or (parameter.low, parameter.high)


def test_normalisation_changes_the_images_that_trackers_see(scene: Scene) -> None:
    settings, rgb = PreprocessingSettings(), scene.frames[0].rgb
    names = [name for name in OFFERED if name.startswith("preprocessing.")]
    assert len(names) == 5
    for name in names:
        parameter = OFFERED[name][1]
        base = settings.model_copy(update={key.split(".")[1]: value for key, value in others_of(parameter).items()})
        seen = {
            normalise(rgb, base.model_copy(update={name.split(".")[1]: value})).tobytes()
            for value in values_of(parameter)
        }
        assert len(seen) == len(values_of(parameter)), name


def test_what_is_not_seen_here_is_offered_and_shown_elsewhere() -> None:
    assert SHOWN_ALONE <= set(OFFERED)
    folder = Path(__file__).parents[1]
    shown = (folder / "culling/test_culling_settings_act.py", folder / "slam/test_slam_settings_act.py")
    text = "".join(path.read_text() for path in shown)
    for name in SHOWN_ALONE:
        assert name.removeprefix("backend.").rpartition(".")[2] in text, name


@pytest.mark.parametrize("name", [name for name in OFFERED if name not in SHOWN_ALONE and "preprocessing" not in name])
def test_every_setting_that_a_study_may_draw_changes_something(name: str, scene: Scene) -> None:
    system, parameter = OFFERED[name]
    system, others = CASES.get(name, (system, {}))
    base = SYSTEMS[system].settings()
    wanted = {
        key: value for key, value in others_of(parameter).items() if _value(base, key) not in dict(parameter.when)[key]
    }
    shown = False
    for value in values_of(parameter):
        if shown or value == _value(base, name):
            continue
        try:
            shown = acts(system, wanted | others, name, value, scene)
        except DynslamError:
            continue  # the value does not go with the others
    assert shown, f"{name} changes nothing in {system}, at any of {values_of(parameter)}"


def _value(settings: object, name: str) -> object:
    for part in name.split("."):
        settings = getattr(settings, part)
    return settings
