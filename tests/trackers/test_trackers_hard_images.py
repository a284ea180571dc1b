"""Images as bad cameras give them, through the whole tracker: an honest state on each frame, and recovery after it."""

from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np
import pytest

from dynslam_bench.contracts.sequence import Frame
from dynslam_bench.core.errors import SequenceError, TrackerError
from dynslam_bench.sequences.synthetic import open_synthetic
from dynslam_bench.trackers import TrackerContext, build_tracker

FRAMES = 44
BAD = range(6, 16)
"""The frames that a fault spoils."""
END = 20
"""Where the episodes with a fault end."""


@pytest.fixture(scope="module")
def sequence(tmp_path_factory: pytest.TempPathFactory):
    return open_synthetic(f"synthetic/sitting_xyz?scene=2&frames={FRAMES}", tmp_path_factory.mktemp("rendered"))


def started(sequence, name: str = "orb-slam2"):
    tracker = build_tracker(name, {}, TrackerContext(sequence_id=sequence.id))
    tracker.reset(sequence.camera, rng=np.random.default_rng(0))
    return tracker


def track(sequence, change: Callable[[Frame], Frame], bad: range = BAD):
    """States, and for the tracked frames the distance in metres from the true camera centre, first pose aligned."""
    tracker = started(sequence)
    states, error = [], {}
    truth = sequence.ground_truth.T_world_cam
    for index in range(END):
        frame = sequence[index]
        result = tracker.track(change(frame) if index in bad else frame)
        states.append(result.state)
        assert result.T_world_cam is None or np.isfinite(result.T_world_cam).all()
        if result.state == "ok":
            error[index] = float(np.linalg.norm((truth[0] @ result.T_world_cam - truth[index])[:3, 3]))
    assert max(error.values()) < 0.05
    return states


@pytest.mark.parametrize("value", [0, 127, 255], ids=["covered lens", "fog", "saturated"])
def test_frames_without_any_texture_are_lost_and_only_those(sequence, value: int) -> None:
    states = track(sequence, lambda frame: replace(frame, rgb=np.full_like(frame.rgb, value)))
    lost = [index for index, state in enumerate(states) if state == "lost"]
    assert lost[: len(BAD)] == list(BAD), "each covered frame counts as lost"
    assert len(lost) <= len(BAD) + 2, f"recovery within two frames, but lost: {lost}"


@pytest.mark.parametrize("gain", [0.35, 2.2], ids=["under-exposed", "over-exposed"])
def test_a_wrong_exposure_is_survived(sequence, gain: float) -> None:
    def exposed(frame: Frame) -> Frame:
        """As if exposed `gain` times as long, clipped by the sensor."""
        return replace(frame, rgb=np.clip(frame.rgb * gain, 0, 255).astype(np.uint8))

    assert track(sequence, exposed).count("ok") >= END - 3


def test_without_depth_for_a_while_it_tracks_on_or_says_lost(sequence) -> None:
    states = track(sequence, lambda frame: replace(frame, depth=np.zeros_like(frame.depth)))
    assert states[BAD.stop + 2 :].count("ok") == END - BAD.stop - 2


@pytest.mark.parametrize("degrees", [3, 5, 7])
def test_a_sudden_turn_is_no_translation(sequence, degrees: int) -> None:
    """From rest, one frame later turned: a chance agreement within the search window must not pass for the pose."""
    tracker = started(sequence)
    frame, matrix = sequence[5], sequence.camera.matrix
    for index in range(3):
        tracker.track(replace(frame, index=index, timestamp=index / 30))
    rotation = cv2.Rodrigues(np.array([0, np.deg2rad(degrees), 0]))[0]
    warp, size = matrix @ rotation @ np.linalg.inv(matrix), (sequence.camera.width, sequence.camera.height)
    turned = Frame(
        3,
        0.1,
        np.asarray(cv2.warpPerspective(frame.rgb, warp, size), np.uint8),
        np.asarray(cv2.warpPerspective(frame.depth, warp, size, flags=cv2.INTER_NEAREST), np.float32),
    )
    result = tracker.track(turned)
    assert result.state == "lost" or np.linalg.norm(result.T_world_cam[:3, 3]) < 0.02


def test_a_gap_of_a_second_is_bridged_or_said(sequence) -> None:
    tracker = started(sequence)
    truth = sequence.ground_truth.T_world_cam
    tracked = []
    for index in (*range(5), *range(36, 44)):
        result = tracker.track(sequence[index])
        if result.state == "ok":
            assert np.linalg.norm((truth[0] @ result.T_world_cam - truth[index])[:3, 3]) < 0.03
            tracked.append(index)
    assert tracked[:5] == [0, 1, 2, 3, 4]


def test_frames_of_another_kind_are_refused_in_one_line(sequence) -> None:
    tracker = build_tracker("emfoa-oft?masks=none", {}, TrackerContext(sequence_id=sequence.id))
    for method in (tracker.finalize, tracker.map_outputs):
        with pytest.raises(TrackerError, match=r"before reset\(\)"):
            method()
    tracker.reset(sequence.camera, rng=np.random.default_rng(0))
    frame = sequence[0]
    for wrong, text in (
        (replace(frame, rgb=frame.rgb / 255.0), r"colour of type float64 .*uint8"),
        (replace(frame, depth=(1000 * frame.depth).astype(np.uint16)), r"depth of type uint16 .*float32, in metres"),
        (replace(frame, depth=None), r"depth of type object"),
        (replace(frame, timestamp=float("inf")), r"timestamp inf"),
    ):
        with pytest.raises(SequenceError, match=text):
            tracker.track(wrong)


def test_missing_depth_is_missing_however_it_is_written_and_buffers_may_be_reused(sequence) -> None:
    def poses(missing: float, *, reuse: bool) -> bytes:
        tracker = started(sequence, "emfoa-oft?masks=none")
        found, buffer = [], np.empty_like(sequence[0].depth)
        for index in range(5):
            frame = sequence[index]
            depth = np.where(frame.depth > 0, frame.depth, missing).astype(np.float32)
            buffer[:] = depth
            found.append(tracker.track(replace(frame, depth=buffer if reuse else depth)).T_world_cam)
        return np.array(found).tobytes()

    zero = poses(0.0, reuse=False)
    assert poses(np.inf, reuse=False) == zero and poses(np.nan, reuse=False) == zero
    assert poses(0.0, reuse=True) == zero
