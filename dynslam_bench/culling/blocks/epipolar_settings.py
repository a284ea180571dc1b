"""Settings of the epipolar test: F, the limit, and when the test may judge at all."""

from __future__ import annotations

from typing import Literal

from dynslam_bench.core.settings import Settings, tunable

from ..tools.coherence_settings import coherent_share


class EpipolarSettings(Settings):
    """The epipolar test (paper, Eq. 23-25) and its degeneracy guard."""

    estimator: Literal["ransac", "lmeds", "magsac"] = tunable(
        "ransac", meaning="robust estimator of the fundamental matrix"
    )
    threshold_px: float = tunable(
        1.0,
        low=0.2,
        high=5.0,
        scale="log",
        limits=(0.01, 50.0),
        unit="px",
        online=True,
        meaning="distance to the epipolar line above which a point is dynamic (Eq. 25)",
    )
    inlier_px: float = tunable(
        1.0,
        low=0.1,
        high=3.0,
        scale="log",
        limits=(0.01, 20.0),
        unit="px",
        meaning="inlier threshold of the fundamental matrix' estimator",
        when={"estimator": ["ransac", "magsac"]},
    )
    confidence: float = tunable(0.99, low=0.9, high=0.999, limits=(0.5, 0.99999), meaning="RANSAC confidence")
    min_parallax_px: float = tunable(
        1.0,
        low=0.0,
        high=5.0,
        limits=(0.0, 50.0),
        unit="px",
        online=True,
        meaning="median parallax (flow beyond a pure rotation) below which the test is skipped as degenerate",
    )
    parallax_share: float = tunable(
        0.05,
        low=0.0,
        high=0.2,
        limits=(0.0, 1.0),
        meaning="the same, as a share of the median flow: rolling shutter bends a fast rotation's flow",
    )
    homography_share: float = tunable(
        0.8,
        low=0.5,
        high=1.0,
        limits=(0.0, 1.0),
        meaning="share of the matches explained by one homography above which the test is skipped as degenerate",
    )
    max_contradiction: float = tunable(
        0.2,
        low=0.05,
        high=1.0,
        limits=(0.0, 1.0),
        meaning="share of the points moving as their depth and the camera's motion say, of which F may reject so many "
        "before it counts as that of something else that moves, and the test is skipped; 1 never asks",
    )
    min_share: float = coherent_share({"mode": ["point"]})
    mode: Literal["point", "object"] = tunable(
        "point", meaning="drop the failing point, or vote on the object that it lies on (paper, step 3)"
    )
    vote_share: float = tunable(
        0.3,
        low=0.05,
        high=0.9,
        limits=(0.0, 1.0),
        online=True,
        when={"mode": ["object"]},
        meaning="share of an object's points that must fail the test for the object to count as moving",
    )
