"""DS-SLAM's vote."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from scenes import (
    BOX,
    CAMERA,
    SEGMENTATION,
    box_instance,
    moved_patch,
    scene,
)

from dynslam_bench.culling.moving_vote import MovingVoteFilter
from dynslam_bench.culling.settings import MovingVoteSettings


@pytest.mark.parametrize("shift", [0, 12])
def test_moving_vote_drops_all_people_or_nobody(shift: int) -> None:
    before, after = moved_patch(shift)
    made = scene(np.eye(4))
    made.frame.gray, made.state.previous.gray = np.roll(after, 3, axis=1), before  # the camera pans by 3 px
    made.frame.instances = box_instance(*BOX)
    verdict = MovingVoteFilter(MovingVoteSettings(threshold_px=1.0), SEGMENTATION).apply(made.frame, made.state)
    x, y = np.rint(made.frame.keypoints.xy).T
    on = (x >= BOX[0]) & (x < BOX[2]) & (y >= BOX[1]) & (y < BOX[3])
    np.testing.assert_array_equal(verdict.keep, ~on if shift else np.ones(len(on), bool))


def test_moving_vote_tracks_the_corners_that_the_authors_code_chooses(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(3)
    previous = cv2.resize(rng.integers(0, 255, (60, 80), dtype=np.uint8), (640, 480), interpolation=cv2.INTER_CUBIC)
    harris = cv2.goodFeaturesToTrack(
        previous, 1000, 0.01, 8, mask=None, blockSize=3, gradientSize=3, useHarrisDetector=True, k=0.04
    )
    given: list[np.ndarray] = []
    refine = cv2.cornerSubPix

    def watched(image: np.ndarray, corners: np.ndarray, *rest: object) -> np.ndarray:
        given.append(corners.copy())
        return refine(image, corners, *rest)

    monkeypatch.setattr(cv2, "cornerSubPix", watched)
    MovingVoteFilter(MovingVoteSettings(), SEGMENTATION)._moving_corners(previous, np.roll(previous, 3, 1), CAMERA)
    np.testing.assert_array_equal(given[0], harris)
