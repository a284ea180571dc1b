"""A covered lens and a kidnapped camera in a rendered room: what is lost, and nothing else, counts as lost."""

from dataclasses import replace

import numpy as np

from dynslam_bench.geometry import se3
from dynslam_bench.sequences import open_sequence
from dynslam_bench.trackers import build_tracker

ROOM = "synthetic/loop_room?frames=1800"
HERE, BETWEEN, ELSEWHERE = [0, 5], 3, 600


def test_black_frames_and_a_kidnapped_camera_cost_what_they_hide():
    sequence = open_sequence(ROOM)
    shown = {index: sequence[index] for index in {*HERE, BETWEEN, ELSEWHERE}}
    dark = replace(shown[0], rgb=np.zeros_like(shown[0].rgb), depth=np.zeros_like(shown[0].depth))
    way = [*HERE, *[None] * 20, BETWEEN, HERE[0], ELSEWHERE, ELSEWHERE, BETWEEN, HERE[1]]
    tracker = build_tracker("orb-slam2")
    tracker.reset(sequence.camera, rng=np.random.default_rng(0))
    states, errors = [], []
    for number, index in enumerate(way):
        frame = replace(dark if index is None else shown[index], index=number, timestamp=number / 30)
        result = tracker.track(frame)
        states.append(result.state)
        if result.state == "ok" and index is not None:
            truth = sequence.ground_truth.T_world_cam
            true = se3.inverse(truth[way[0]]) @ truth[index]
            errors.append(np.linalg.norm((se3.inverse(true) @ result.T_world_cam)[:3, 3]))
    assert states == ["ok"] * 2 + ["lost"] * 20 + ["ok"] * 2 + ["lost"] * 2 + ["ok"] * 2
    assert len(errors) == 6 and max(errors) < 0.02
