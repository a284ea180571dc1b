"""Images as bad cameras give them, through the whole tracker: an honest state on each frame, and recovery after it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dynslam_bench.sequences.frame import Frame
from dynslam_bench.sequences.synthetic import open_synthetic
from dynslam_bench.trackers import TrackerContext, build_tracker

FRAMES = 44
BAD = range(18, 38)
"""The frames that a fault spoils: twenty of them."""


@pytest.fixture(scope="module")
def sequence(tmp_path_factory: pytest.TempPathFactory):
    return open_synthetic(f"synthetic/sitting_xyz@2?frames={FRAMES}", tmp_path_factory.mktemp("rendered"))


def track(sequence, change: Callable[[Frame], Frame], bad: range = BAD):
    """States, and for the tracked frames the distance in metres from the true camera centre, first pose aligned."""
    tracker = build_tracker("orb-slam2", {}, TrackerContext(sequence_id=sequence.id))
    tracker.reset(sequence.camera, rng=np.random.default_rng(0))
    states, error = [], {}
    truth = sequence.ground_truth.T_world_cam
    for index in range(len(sequence)):
        frame = sequence[index]
        result = tracker.track(change(frame) if index in bad else frame)
        states.append(result.state)
        if result.state == "ok":
            assert np.isfinite(result.T_world_cam).all()
            estimate = truth[0] @ result.T_world_cam
            error[index] = float(np.linalg.norm(estimate[:3, 3] - truth[index][:3, 3]))
        else:
            assert result.T_world_cam is None or np.isfinite(result.T_world_cam).all()
    return states, error


def painted(value: int) -> Callable[[Frame], Frame]:
    return lambda frame: replace(frame, rgb=np.full_like(frame.rgb, value))


def exposed(gain: float) -> Callable[[Frame], Frame]:
    """As if exposed `gain` times as long, clipped by the sensor."""
    return lambda frame: replace(frame, rgb=np.clip(frame.rgb * gain, 0, 255).astype(np.uint8))


@pytest.mark.parametrize("value", [0, 127, 255], ids=["covered lens", "fog", "saturated"])
def test_frames_without_any_texture_are_lost_and_only_those(sequence, value: int) -> None:
    states, error = track(sequence, painted(value))
    lost = [index for index, state in enumerate(states) if state == "lost"]
    assert lost[: len(BAD)] == list(BAD), "each covered frame counts as lost"
    assert len(lost) <= len(BAD) + 2, f"recovery within two frames, but lost: {lost}"
    assert max(error.values()) < 0.05


@pytest.mark.parametrize("gain", [0.35, 2.2], ids=["under-exposed", "over-exposed"])
def test_a_wrong_exposure_is_survived(sequence, gain: float) -> None:
    states, error = track(sequence, exposed(gain))
    assert states.count("ok") >= FRAMES - 3
    assert max(error.values()) < 0.05


def test_without_depth_for_a_while_it_tracks_on_or_says_lost(sequence) -> None:
    states, error = track(sequence, lambda frame: replace(frame, depth=np.zeros_like(frame.depth)))
    assert states[BAD.stop + 2 :].count("ok") == FRAMES - BAD.stop - 2
    assert max(error.values()) < 0.05


def test_a_gap_of_a_second(sequence) -> None:
    tracker = build_tracker("orb-slam2", {}, TrackerContext(sequence_id=sequence.id))
    tracker.reset(sequence.camera, rng=np.random.default_rng(0))
    kept = [*range(10), *range(40, FRAMES)]
    states = [tracker.track(sequence[index]).state for index in kept]
    assert states[:10] == ["ok"] * 10
    assert "ok" in states[10:12], "the scene after the gap is in the map"


def test_black_from_the_beginning_never_initialises_and_raises_nothing(sequence, tmp_path: Path) -> None:
    states, _ = track(sequence, painted(0), bad=range(FRAMES))
    assert "ok" not in states
