"""Settings of the building blocks; no heavy import, so that specs stay light."""

from __future__ import annotations

from typing import Literal

from dynslam_bench.core.settings import Settings, tunable


class GuardSettings(Settings):
    """The starvation guard: no filter may leave tracking without features (SG-SLAM restores below 10 %)."""

    min_features: int = tunable(
        60, low=10, high=200, limits=(0, 2000), online=True,
        meaning="fewest keypoints that culling must leave: as many as the back end needs to begin a map",
    )  # fmt: skip
    min_fraction: float = tunable(
        0.05, low=0.0, high=0.3, limits=(0.0, 1.0), meaning="smallest share of the keypoints that culling must leave"
    )


class EpipolarSettings(Settings):
    """The epipolar test (paper, Eq. 23-25) and its degeneracy guard."""

    estimator: Literal["ransac", "lmeds", "magsac"] = tunable(
        "ransac", meaning="robust estimator of the fundamental matrix"
    )
    threshold_px: float = tunable(
        1.0, low=0.2, high=5.0, scale="log", limits=(0.01, 50.0), unit="px", online=True,
        meaning="distance to the epipolar line above which a point is dynamic (Eq. 25)",
    )  # fmt: skip
    inlier_px: float = tunable(
        1.0, low=0.1, high=3.0, scale="log", limits=(0.01, 20.0), unit="px",
        meaning="inlier threshold of the fundamental matrix' estimator", when={"estimator": ["ransac", "magsac"]},
    )  # fmt: skip
    confidence: float = tunable(0.99, low=0.9, high=0.999, limits=(0.5, 0.99999), meaning="RANSAC confidence")
    min_parallax_px: float = tunable(
        1.0, low=0.0, high=5.0, limits=(0.0, 50.0), unit="px", online=True,
        meaning="median parallax (flow beyond a pure rotation) below which the test is skipped as degenerate",
    )  # fmt: skip
    parallax_share: float = tunable(
        0.05, low=0.0, high=0.2, limits=(0.0, 1.0),
        meaning="the same, as a share of the median flow: rolling shutter bends a fast rotation's flow",
    )  # fmt: skip
    homography_share: float = tunable(
        0.8, low=0.5, high=1.0, limits=(0.0, 1.0),
        meaning="share of the matches explained by one homography above which the test is skipped as degenerate",
    )  # fmt: skip
    max_contradiction: float = tunable(
        0.2, low=0.05, high=1.0, limits=(0.0, 1.0),
        meaning="share of the points moving as their depth and the camera's motion say, of which F may reject so many "
        "before it counts as that of something else that moves, and the test is skipped; 1 never asks",
    )  # fmt: skip
    min_share: float = tunable(
        0.4, low=0.0, high=0.8, limits=(0.0, 1.0), online=True, when={"mode": ["point"]},
        meaning="share of the tested points around a failing one that must fail too; 0 drops every failing point",
    )  # fmt: skip
    mode: Literal["point", "object"] = tunable(
        "point", meaning="drop the failing point, or vote on the object that it lies on (paper, step 3)"
    )
    vote_share: float = tunable(
        0.3, low=0.05, high=0.9, limits=(0.0, 1.0), online=True, when={"mode": ["object"]},
        meaning="share of an object's points that must fail the test for the object to count as moving",
    )  # fmt: skip


class MotionSettings(Settings):
    """The depth-consistency test: does the point move with the camera's rigid motion, in 3-D?

    It sees what the epipolar test cannot: motion along epipolar lines, and any motion while the camera only rotates
    or stands still. Not in the paper, an extension for RGB-D.
    """

    enabled: bool = tunable(True, meaning="whether the test runs")
    threshold_px: float = tunable(
        2.5, low=0.5, high=10.0, scale="log", limits=(0.05, 100.0), unit="px", online=True, when={"enabled": [True]},
        meaning="reprojection distance after the camera's motion above which a point is dynamic",
    )  # fmt: skip
    threshold_share: float = tunable(
        0.05, low=0.0, high=0.2, limits=(0.0, 1.0), when={"enabled": [True]},
        meaning="added to it, as a share of the flow that the camera's motion explains (rolling shutter)",
    )  # fmt: skip
    threshold_sigma: float = tunable(
        4.0, low=1.0, high=12.0, scale="log", limits=(0.1, 100.0), online=True, when={"enabled": [True]},
        meaning="depth difference, in standard deviations of the sensor, above which a point is dynamic",
    )  # fmt: skip
    min_share: float = tunable(
        0.4, low=0.0, high=0.8, limits=(0.0, 1.0), online=True, when={"enabled": [True]},
        meaning="share of the tested points around a failing one that must fail too; 0 takes every failure for motion",
    )  # fmt: skip
    memory: float = tunable(
        0.6, low=0.0, high=0.95, limits=(0.0, 0.99), when={"enabled": [True]},
        meaning="how much of a point's motion evidence is carried over from the previous frame",
    )  # fmt: skip


class FreeSpaceSettings(Settings):
    """The free-space test: a point where an earlier keyframe saw through is on something that moved there.

    Not in the paper, an extension for RGB-D; the reverse of DynaSLAM's multi-view test (block B4), which asks whether
    what a keyframe saw is gone.
    """

    enabled: bool = tunable(True, meaning="whether the test runs")
    keyframes: int = tunable(
        8, low=2, high=20, when={"enabled": [True]}, meaning="how many of the latest keyframes are asked"
    )
    threshold_m: float = tunable(
        0.15, low=0.05, high=0.6, scale="log", limits=(0.01, 5.0), unit="m", online=True, when={"enabled": [True]},
        meaning="least depth by which the keyframe must have seen past the point",
    )  # fmt: skip
    threshold_sigma: float = tunable(
        5.0, low=2.0, high=12.0, limits=(0.0, 100.0), online=True, when={"enabled": [True]},
        meaning="the same, in standard deviations of the sensor at that depth",
    )  # fmt: skip
    min_votes: int = tunable(
        2, low=1, high=5, online=True, when={"enabled": [True]}, meaning="keyframes that must have seen past the point"
    )
    min_share: float = tunable(
        0.4, low=0.0, high=0.8, limits=(0.0, 1.0), online=True, when={"enabled": [True]},
        meaning="share of the tested points around a failing one that must fail too; 0 takes every failure for motion",
    )  # fmt: skip
    max_age_s: float = tunable(
        10.0, low=2.0, high=60.0, scale="log", limits=(0.1, 1e4), unit="s", when={"enabled": [True]},
        meaning="keyframes older than this are not asked: what they saw may have been moved for good",
    )  # fmt: skip
