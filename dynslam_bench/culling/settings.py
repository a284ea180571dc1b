"""What becomes of a feature whose flow failed: a setting of every system that tests matches."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Annotated, Any, Literal

from pydantic import AfterValidator

from dynslam_bench.core.errors import DynslamError
from dynslam_bench.core.settings import Scalar, Settings, tunable
from dynslam_bench.segmentation.settings import expand_classes

Unmatched = Literal["keep", "drop", "judge"]
"""It stays unjudged, it goes, or it is judged by the place where it was lost."""


# Classes that are not dynamic by themselves: things that people move about.

MOVABLE = (
    "backpack,bed,book,bottle,bowl,cell phone,chair,couch,cup,dining table,handbag,keyboard,laptop,mouse,potted plant,"
    "sports ball,suitcase,teddy bear,tv,umbrella"
)
"""COCO classes that people move about (our assumption; no paper gives a list)."""


def _known_classes(value: str) -> str:
    try:
        expand_classes(value)
    except DynslamError as error:
        raise ValueError(str(error)) from None
    return value


MovableClasses = Annotated[str, AfterValidator(_known_classes)]
"""Comma-separated COCO names or presets, validated."""


# The setting of `coherent`, the same for every test that asks the neighbours of a failing point.


def coherent_share(when: Mapping[str, Sequence[Scalar]]) -> Any:
    """A field for the share of the tested neighbours that must fail too, tunable under conditions on its siblings."""
    return tunable(
        0.4, low=0.0, high=0.8, limits=(0.0, 1.0), online=True, when=when,
        meaning="share of the tested points around a failing one that must fail too; 0 takes every failure for motion",
    )  # fmt: skip


# Settings of the epipolar test: F, the limit, and when the test may judge at all.


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


# Settings of the test of rigid motion: limits in the image and in depth.

_ON = {"enabled": [True]}


class RigidMotionSettings(Settings):
    """The depth-consistency test: does the point move with the camera's rigid motion, in 3-D?

    It sees what the epipolar test cannot: motion along epipolar lines, and any motion while the camera only rotates
    or stands still. Not in the paper, an extension for RGB-D.
    """

    enabled: bool = tunable(True, meaning="whether the test runs")
    threshold_px: float = tunable(
        2.5,
        low=0.5,
        high=10.0,
        scale="log",
        limits=(0.05, 100.0),
        unit="px",
        online=True,
        when=_ON,
        meaning="reprojection distance after the camera's motion above which a point is dynamic",
    )
    threshold_share: float = tunable(
        0.05,
        low=0.0,
        high=0.2,
        limits=(0.0, 1.0),
        when=_ON,
        meaning="added to it, as a share of the flow that the camera's motion explains (rolling shutter)",
    )
    threshold_sigma: float = tunable(
        4.0,
        low=1.0,
        high=12.0,
        scale="log",
        limits=(0.1, 100.0),
        online=True,
        when=_ON,
        meaning="depth difference, in standard deviations of the sensor, above which a point is dynamic",
    )
    min_share: float = coherent_share(_ON)
    memory: float = tunable(
        0.6,
        low=0.0,
        high=0.95,
        limits=(0.0, 0.99),
        when=_ON,
        meaning="how much of a point's motion evidence is carried over from the previous frame",
    )


# Settings of the test of free space: which keyframes are asked, and by how much they must have seen past a point.


class FreeSpaceSettings(Settings):
    """The free-space test: a point where an earlier keyframe saw through is on something that moved there.

    Not in the paper, an extension for RGB-D; the reverse of DynaSLAM's multi-view test (block B4), which asks whether
    what a keyframe saw is gone.
    """

    enabled: bool = tunable(True, meaning="whether the test runs")
    keyframes: int = tunable(8, low=2, high=20, when=_ON, meaning="how many of the latest keyframes are asked")
    threshold_m: float = tunable(
        0.15,
        low=0.05,
        high=0.6,
        scale="log",
        limits=(0.01, 5.0),
        unit="m",
        online=True,
        when=_ON,
        meaning="least depth by which the keyframe must have seen past the point",
    )
    threshold_sigma: float = tunable(
        5.0,
        low=2.0,
        high=12.0,
        limits=(0.0, 100.0),
        online=True,
        when=_ON,
        meaning="the same, in standard deviations of the sensor at that depth",
    )
    min_votes: int = tunable(
        2, low=1, high=5, online=True, when=_ON, meaning="keyframes that must have seen past the point"
    )
    min_share: float = coherent_share(_ON)
    max_age_s: float = tunable(
        10.0,
        low=2.0,
        high=60.0,
        scale="log",
        limits=(0.1, 1e4),
        unit="s",
        when=_ON,
        meaning="keyframes older than this are not asked: what they saw may have been moved for good",
    )


# Settings of box removal: how far they are enlarged.


class BoxSettings(Settings):
    """B2, box removal (Crowd-SLAM, YOLO-SLAM's detection half)."""

    margin_px: int = tunable(
        0, low=0, high=30, limits=(0, 200), unit="px", online=True, meaning="how far boxes are enlarged on every side"
    )


# Settings of the masks cut out of boxes by depth: how a person is cut out of a box.


class BoxDepthSettings(Settings):
    """NGD-SLAM's masks: a person is what lies at the depth of the middle of the box."""

    depth_m: float = tunable(
        0.33, low=0.1, high=1.0, limits=(0.01, 10.0), unit="m", online=True, meaning="half the depth range of a person"
    )
    margin_px: int = tunable(30, low=0, high=60, limits=(0, 200), unit="px", meaning="how far the box is enlarged")
    core: float = tunable(
        0.7, low=0.3, high=1.0, limits=(0.1, 1.0), meaning="share of the box, around its middle, that gives the depth"
    )
    min_valid: float = tunable(
        0.7, low=0.0, high=0.95, limits=(0.0, 1.0), meaning="share of the core that must have depth"
    )
    max_cover: float = tunable(
        0.8, low=0.3, high=1.0, limits=(0.0, 1.0), meaning="a mask that covers more of the image is ignored"
    )
    dilation_px: int = tunable(3, low=0, high=20, limits=(0, 100), unit="px", meaning="radius by which masks are grown")


# Settings of the epipolar test with boxes: one limit inside the boxes, another outside.


class BoxEpipolarSettings(Settings):
    """B3 with different limits inside and outside the boxes (Blitz-SLAM, SGC-VSLAM, SG-SLAM)."""

    inside_px: float = tunable(
        0.5,
        low=0.1,
        high=3.0,
        scale="log",
        limits=(0.01, 50.0),
        unit="px",
        online=True,
        meaning="epipolar distance above which a point inside a dynamic box is dropped",
    )
    test_outside: bool = tunable(True, meaning="whether points outside all boxes are tested too")
    outside_px: float = tunable(
        1.0,
        low=0.2,
        high=10.0,
        scale="log",
        limits=(0.01, 1000.0),
        unit="px",
        online=True,
        when={"test_outside": [True]},
        meaning="epipolar distance above which a point outside all boxes is dropped",
    )
    inlier_px: float = tunable(
        1.0, low=0.1, high=3.0, scale="log", limits=(0.01, 20.0), unit="px", meaning="RANSAC's inlier threshold"
    )
    confidence: float = tunable(0.99, low=0.9, high=0.999, limits=(0.5, 0.99999), meaning="RANSAC confidence")
    fit: Literal["outside", "outside previous", "kept"] = tunable(
        "outside",
        meaning="matches that F is fitted to: outside the boxes, outside those of the previous frame (SG-SLAM), "
        "or all that earlier filters kept (those outside the masks)",
    )
    unmatched: Unmatched = tunable(
        "keep",
        meaning="a feature whose flow failed stays, goes, or is judged by the place where it was lost (SG-SLAM's code)",
    )


# Settings of the class rule: what is movable, and the three rules' limits.


class ClassRuleSettings(Settings):
    """B15, three rules: class, depth, epipolar line (SEG-SLAM; constants are our assumption)."""

    movable: MovableClasses = MOVABLE
    """Classes that move only at times: comma-separated COCO names."""
    threshold_px: float = tunable(
        1.0,
        low=0.2,
        high=5.0,
        scale="log",
        limits=(0.01, 50.0),
        unit="px",
        online=True,
        meaning="epipolar distance above which a point on a movable object is dropped",
    )
    depth_m: float = tunable(
        0.3,
        low=0.0,
        high=1.0,
        limits=(0.0, 10.0),
        unit="m",
        online=True,
        meaning="a point this near to the depth of a moving object goes with it",
    )
    vote_share: float = tunable(
        0.3, low=0.05, high=1.0, limits=(0.0, 1.0), meaning="share of an object's points that must fail"
    )
    unmatched: Unmatched = tunable(
        "keep", meaning="a feature on a movable object whose flow failed stays, goes, or is judged by where it was lost"
    )


# Settings of the correlation graph: window, noise and the cut.


class CorrelationSettings(Settings):
    """B7, Dai et al.'s point correlations on a Delaunay graph."""

    window: int = tunable(
        8, low=2, high=20, limits=(1, 60), unit="frames", meaning="largest age of the observation that is compared"
    )
    settled: int = tunable(
        4, low=1, high=10, limits=(1, 60), unit="frames", meaning="age from which a point's edges make up components"
    )
    quantile: float = tunable(
        0.95, low=0.8, high=0.999, limits=(0.5, 0.99999), online=True, meaning="chi-square quantile that cuts an edge"
    )
    pixel_sigma: float = tunable(
        1.0, low=0.3, high=3.0, scale="log", limits=(0.01, 20.0), unit="px", meaning="standard deviation of a keypoint"
    )
    largest: Literal["volume", "count"] = tunable(
        "volume", meaning="which component is static: the one with the largest volume, or with the most points"
    )


# Settings of the depth blocks: where a block ends and when all of it goes.


class DepthBlockSettings(Settings):
    """B9 as in Blitz-SLAM: masks completed by blocks of continuous depth."""

    edge_m: float = tunable(
        0.1,
        low=0.03,
        high=0.5,
        scale="log",
        limits=(0.001, 10.0),
        unit="m",
        online=True,
        meaning="depth range in a 2x2 block above which it is an edge between blocks (tau 1 and 2)",
    )
    min_share: float = tunable(
        0.25,
        low=0.05,
        high=0.9,
        limits=(0.0, 1.0),
        online=True,
        meaning="share of a block that must lie on the mask for all of it to be taken (tau 3)",
    )
    max_depth_m: float = tunable(
        6.0, low=3.0, high=10.0, limits=(0.1, 1000.0), unit="m", meaning="depth beyond this is not used"
    )
    movable: MovableClasses = MOVABLE
    """Classes that are dynamic while a person touches them: comma-separated COCO names."""


# Settings of the depth RANSAC: what counts as like depth.


class DepthRansacSettings(Settings):
    """B6, YOLO-SLAM's depth RANSAC inside boxes."""

    variance_m2: float = tunable(
        0.43,
        low=0.01,
        high=1.0,
        scale="log",
        limits=(1e-4, 100.0),
        unit="m^2",
        online=True,
        meaning="largest depth variance of the set that is taken for the person",
    )
    confidence: float = tunable(0.99, low=0.9, high=0.999, limits=(0.5, 0.9999), meaning="sets the number of draws")
    max_draws: int = tunable(50, low=10, high=200, limits=(1, 1000), meaning="most draws a box")


# Settings of the moving probability: how evidence is accumulated.


class ProbabilitySettings(Settings):
    """B8, moving probability of tracked features (RDS-SLAM's Bayes filter, Detect-SLAM's moving average)."""

    rule: Literal["bayes", "average"] = tunable("bayes", meaning="how evidence is accumulated")
    hit: float = tunable(
        0.9,
        low=0.6,
        high=0.99,
        limits=(0.5, 0.999),
        when={"rule": ["bayes"]},
        meaning="probability that a moving point lies on a mask, and a static one off it",
    )
    rate: float = tunable(
        0.3, low=0.05, high=0.9, limits=(0.01, 1.0), when={"rule": ["average"]}, meaning="weight of the new observation"
    )
    threshold: float = tunable(
        0.5, low=0.3, high=0.9, limits=(0.0, 1.0), online=True, meaning="probability above which a point is dropped"
    )
    soft: bool = tunable(False, meaning="weigh the kept points by their static probability (CFP-SLAM)")
    link_px: float = tunable(
        2.5,
        low=1.0,
        high=6.0,
        limits=(0.1, 50.0),
        unit="px",
        meaning="how near its flow must end to an earlier feature",
    )
    expand_px: float = tunable(
        0.0,
        low=0.0,
        high=60.0,
        limits=(0.0, 500.0),
        unit="px",
        meaning="reach of matching point expansion: new features take after near ones that are sure; 0 = off",
    )


# Settings of the moving vote: corners, F and the vote.


class MovingVoteSettings(Settings):
    """B3 and B11 as in DS-SLAM's code: one vote for all people."""

    corners: int = tunable(1000, low=200, high=2000, limits=(8, 10000), meaning="Harris corners that are tracked")
    sad_limit: int = tunable(2120, low=500, high=5000, limits=(1, 10**6), meaning="largest 3x3 sum of differences")
    inlier_px: float = tunable(
        0.1, low=0.05, high=1.0, scale="log", limits=(0.01, 10.0), unit="px", meaning="RANSAC's inlier threshold"
    )
    threshold_px: float = tunable(
        1.0,
        low=0.3,
        high=3.0,
        scale="log",
        limits=(0.01, 50.0),
        unit="px",
        online=True,
        meaning="epipolar distance above which a corner moves",
    )
    radius_px: int = tunable(
        15,
        low=0,
        high=30,
        limits=(0, 200),
        unit="px",
        meaning="a moving corner this near to a person makes people move",
    )
    min_votes: int = tunable(1, low=1, high=20, limits=(1, 1000), online=True, meaning="moving corners that it takes")


# Settings of multi-view depth: which keyframes are asked, and what counts as hidden.


class MultiViewSettings(Settings):
    """B4 and B5, DynaSLAM's multi-view geometry with region growing."""

    tau_m: float = tunable(
        0.4,
        low=0.1,
        high=1.0,
        scale="log",
        limits=(0.01, 10.0),
        unit="m",
        online=True,
        meaning="depth by which a keyframe's point must be hidden (paper 0.4, code 0.6)",
    )
    order: Literal["nearest", "farthest"] = tunable(
        "nearest", meaning="which keyframes are asked (the paper means nearest, the code takes farthest)"
    )
    references: int = tunable(5, low=1, high=10, limits=(1, 20), meaning="keyframes that are asked")
    min_keyframes: int = tunable(
        1,
        low=1,
        high=10,
        limits=(1, 20),
        meaning="keyframes before the test is active (not stated in the paper; the code waits for 5)",
    )
    max_parallax_deg: float = tunable(
        30.0, low=10.0, high=60.0, limits=(1.0, 180.0), unit="deg", meaning="largest angle between the two views"
    )
    max_variance: float = tunable(
        0.001,
        low=1e-4,
        high=0.1,
        scale="log",
        limits=(0.0, 100.0),
        unit="m^2",
        meaning="largest variance of the depth around the point (rejects depth edges)",
    )
    grow: bool = tunable(True, meaning="grow regions of equal depth from the points that were found (B5)")
    grow_m: float = tunable(
        0.2,
        low=0.05,
        high=0.5,
        limits=(0.0, 5.0),
        unit="m",
        when={"grow": [True]},
        meaning="largest depth difference to the seed within a region",
    )
    dilation_px: int = tunable(
        15, low=0, high=30, limits=(0, 100), unit="px", meaning="radius by which the result is grown"
    )
    border_px: int = tunable(
        0,
        low=0,
        high=30,
        limits=(0, 100),
        unit="px",
        meaning="further radius within which features at the result's border are dropped (15 in the code)",
    )


# Settings of re-seeding: the budget.


class ReseedingSettings(Settings):
    """B12, re-seeding (NGD-SLAM, Crowd-SLAM): how many of the features that culling left are used at most.

    The extractor has to seek more than these (`features.n_features`, 1.5 times as many in NGD-SLAM); where it does
    not, nothing is left out.
    """

    budget: int = tunable(
        1000,
        low=300,
        high=2000,
        limits=(1, 20000),
        scale="log",
        online=True,
        meaning="features used at most after culling; features.n_features must be larger",
    )


# Settings of the residual clusters: clusters, residual and prior.


class ResidualSettings(Settings):
    """B14, residuals of image clusters with a semantic prior (DGS-SLAM of Yan 2022; constants are our assumption)."""

    clusters: int = tunable(24, low=8, high=48, limits=(2, 200), meaning="clusters of image position and depth")
    depth_weight: float = tunable(
        2.0,
        low=0.2,
        high=10.0,
        scale="log",
        limits=(0.0, 100.0),
        meaning="weight of the relative depth residual beside the intensity residual",
    )
    prior: float = tunable(
        0.9, low=0.5, high=0.99, limits=(0.01, 0.999), meaning="prior probability that a person's cluster moves"
    )
    threshold: float = tunable(
        0.5, low=0.2, high=0.9, limits=(0.0, 1.0), online=True, meaning="posterior above which a cluster is dynamic"
    )


# Settings of template matching: patch, window and the least correlation.


class TemplateSettings(Settings):
    """B13, template matching over a sliding window inside boxes (DynaTM-SLAM; constants are our assumption)."""

    patch_px: int = tunable(11, low=5, high=21, limits=(3, 41), unit="px", meaning="side of the square patch")
    window: int = tunable(5, low=2, high=10, limits=(1, 30), unit="frames", meaning="earlier frames that are searched")
    zncc: float = tunable(
        0.8,
        low=0.5,
        high=0.95,
        limits=(-1.0, 1.0),
        online=True,
        meaning="median correlation below which a point is dropped",
    )
