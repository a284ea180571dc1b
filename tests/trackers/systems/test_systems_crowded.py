"""People fill the view: they must not take the places of the few features that the camera's pose is found with."""

import numpy as np

from dynslam_bench.sequences import open_sequence
from dynslam_bench.trackers import TrackerContext, build_tracker

FRAMES = (0, 24)  # people cover 85 % of the features; with all of them counted the camera was lost from frame 14 on


def test_a_crowd_in_front_of_the_camera_leaves_enough_features() -> None:
    sequence = open_sequence("synthetic/walking_halfsphere?scene=102", frames=FRAMES)
    kept, states = {}, {}
    for share in (0.0, 0.3):
        settings = {"segmentation.source": "oracle", "segmentation.outside_share": share}
        tracker = build_tracker("mask-rcnn", settings, TrackerContext(sequence.id, masks=sequence.masks))
        tracker.reset(sequence.camera, rng=np.random.default_rng(0))
        results = [tracker.track(sequence[index]) for index in range(len(sequence))]
        kept[share] = np.median([result.keypoints_keep.sum() for result in results])
        states[share] = [result.state for result in results]
    assert kept[0.0] < 200 < 400 < kept[0.3]
    assert "lost" in states[0.0] and set(states[0.3]) == {"ok"}
