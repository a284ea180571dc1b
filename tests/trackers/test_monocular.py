"""Systems without depth: they never read it, they are refused what takes it, and what they score says so."""

from dataclasses import replace

import numpy as np
import pytest
from steering_scene import SmallScene, construct, difference, play

from dynslam_bench.contracts.checks import check_sensors
from dynslam_bench.core.errors import TrackerError
from dynslam_bench.trackers import TRACKERS
from dynslam_bench.trackers.registry import all_specs
from dynslam_bench.trackers.systems.composition import UnfilteredSystemSettings

OURS = [
    spec.id for spec in all_specs() if spec.sensors == "rgb" and issubclass(spec.settings, UnfilteredSystemSettings)
]


@pytest.fixture(scope="module")
def scene():
    return SmallScene()


def with_depth(scene, depth_of):
    """The same scene with other depth images."""
    other = SmallScene.__new__(SmallScene)
    other.__dict__ |= scene.__dict__
    other.frames = [replace(frame, depth=depth_of(frame)) for frame in scene.frames]
    return other


@pytest.mark.parametrize("tracker", OURS)
def test_depth_is_never_read(scene, tracker):
    rng = np.random.default_rng(0)
    wild = with_depth(scene, lambda frame: rng.uniform(0.1, 9.0, frame.depth.shape).astype(np.float32))
    spec = TRACKERS.get(tracker)
    few = {"backend.two_views.min_matches": 40, "backend.two_views.min_points": 25}  # the images are small
    true = list(play(construct(spec, scene, **few), scene))
    if tracker == "orb-slam2-mono":  # masks that err leave the others too little of so small a room for a map
        assert sum(result.state == "ok" for result in true) >= len(true) // 2
    else:
        assert sum(result.stats["culled"] for result in true) > 100
    assert difference(true, play(construct(spec, wild, **few), wild)) == ""


def test_sequences_without_depth_are_for_monocular_trackers_alone(scene):
    scene.has_depth = False
    try:
        check_sensors(TRACKERS.get("emfoa-oft-mono"), scene)
        with pytest.raises(TrackerError, match=r"'emfoa-oft' needs depth, and .*walking_xyz\?scene=103.* colour"):
            check_sensors(TRACKERS.get("emfoa-oft"), scene)
    finally:
        del scene.has_depth
    check_sensors(TRACKERS.get("emfoa-oft"), scene)
