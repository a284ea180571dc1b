"""Settings of the rejection rules, one class a rule; importing this module loads neither OpenCV nor torch."""

import math
from typing import Any, Literal

from pydantic import Field

from dynslam_bench.core.settings import Settings, tunable
from dynslam_bench.segmentation.settings import AT_640, ClassList

Unmatched = Literal["keep", "drop", "judge"]
"""A feature whose flow failed stays untested, is dropped, or is tested at the place where the flow lost it."""

MOVABLE = (
    "backpack,bed,book,bottle,bowl,cell phone,chair,couch,cup,dining table,handbag,keyboard,laptop,mouse,potted plant,"
    "sports ball,suitcase,teddy bear,tv,umbrella"
)
"""COCO classes of objects that people move (our assumption; no paper gives a list)."""


_MIN_SHARE: Any = Field(
    0.4,
    ge=0.0,
    le=1.0,
    description="share of the tested points around a failing point that must fail too; 0 drops every failing point",
)


class GuardSettings(Settings):
    """The starvation guard, which all filters share (SG-SLAM restores all features below 10 %)."""

    min_features: int = tunable(
        60,
        low=10,
        high=200,
        limits=(0, 2000),
        online=True,
        meaning="fewest keypoints that culling must leave: as many as the back end needs to initialise a map",
    )
    min_fraction: float = Field(
        0.05, ge=0.0, le=1.0, description="smallest share of the keypoints that culling must leave"
    )

    def needed(self, total: int) -> int:
        """Number of `total` keypoints that culling must leave."""
        return min(total, max(self.min_features, math.ceil(self.min_fraction * total)))


class EpipolarSettings(Settings):
    """The epipolar test (paper, Eq. 23-25) and its degeneracy guard."""

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
    min_parallax_px: float = tunable(
        1.0,
        low=0.0,
        high=5.0,
        limits=(0.0, 50.0),
        unit="px",
        online=True,
        meaning="median parallax (flow beyond a pure rotation) below which the test is skipped as degenerate",
    )
    parallax_share: float = Field(
        0.05,
        ge=0.0,
        le=1.0,
        description="the same limit as a share of the median flow: a rolling shutter bends the flow of fast rotations",
    )
    homography_share: float = Field(
        0.8,
        ge=0.0,
        le=1.0,
        description="share of matches on one homography above which the test is skipped",
    )
    max_contradiction: float = Field(
        0.2,
        ge=0.0,
        le=1.0,
        description="largest share of the points that fit the camera's motion in depth and that F may reject; "
        "above it the test is skipped; 1 disables this check",
    )
    min_share: float = _MIN_SHARE
    mode: Literal["point", "object"] = Field(
        "point",
        description="drop the failing points, or the objects of which enough points fail (paper, step 3)",
    )


class RigidMotionSettings(Settings):
    """The rigid-motion test: does a point move in 3-D as the camera's motion predicts?

    It detects motion along epipolar lines, and any motion while the camera only rotates or stands
    still. It is not in the paper; it is an extension for RGB-D.
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
        meaning="reprojection distance after the camera's motion above which a point is dynamic",
    )
    threshold_sigma: float = tunable(
        4.0,
        low=1.0,
        high=12.0,
        scale="log",
        limits=(0.1, 100.0),
        online=True,
        meaning="depth difference, in standard deviations of the sensor, above which a point is dynamic",
    )
    min_share: float = _MIN_SHARE


class FreeSpaceSettings(Settings):
    """The free-space test: a point lies where earlier keyframes measured free space.

    It is not in the paper; it is an extension for RGB-D. DynaSLAM's multi-view test (B4) asks the
    reverse: whether something now hides what a keyframe observed.
    """

    enabled: bool = tunable(True, meaning="whether the test runs")
    threshold_m: float = tunable(
        0.15,
        low=0.05,
        high=0.6,
        scale="log",
        limits=(0.01, 5.0),
        unit="m",
        online=True,
        meaning="least depth by which a keyframe must have measured beyond the point",
    )
    threshold_sigma: float = Field(
        5.0,
        ge=0.0,
        le=100.0,
        description="the same limit in standard deviations of the sensor at that depth",
    )
    min_votes: int = tunable(
        2, low=1, high=5, online=True, meaning="keyframes that must have measured beyond the point"
    )
    min_share: float = _MIN_SHARE


class BoxDepthSettings(Settings):
    """NGD-SLAM's masks: a person is the region at the depth of the box's middle."""

    depth_m: float = tunable(
        0.33,
        low=0.1,
        high=1.0,
        limits=(0.01, 10.0),
        unit="m",
        online=True,
        meaning="half the depth range of a person",
    )
    margin_px: int = tunable(
        30, low=0, high=60, limits=(0, 200), unit=AT_640, meaning="how far the box is enlarged"
    )
    core: float = tunable(
        0.7,
        low=0.3,
        high=1.0,
        limits=(0.1, 1.0),
        meaning="share of the box, around its middle, that gives the depth",
    )
    min_valid: float = tunable(
        0.7, low=0.0, high=0.95, limits=(0.0, 1.0), meaning="share of the core that must have depth"
    )
    max_cover: float = tunable(
        0.8,
        low=0.3,
        high=1.0,
        limits=(0.0, 1.0),
        meaning="a mask that covers more of the image is ignored",
    )
    dilation_px: int = tunable(
        3, low=0, high=20, limits=(0, 100), unit=AT_640, meaning="radius by which masks are grown"
    )


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
    outside_px: float = Field(
        1.0,
        ge=0.01,
        le=1000.0,
        description="epipolar distance in pixels above which a point outside all boxes is dropped",
    )
    test_outside: bool = Field(True, description="whether points outside all boxes are tested too")
    inlier_px: float = tunable(
        1.0,
        low=0.1,
        high=3.0,
        scale="log",
        limits=(0.01, 20.0),
        unit="px",
        meaning="RANSAC's inlier threshold",
    )
    fit: Literal["outside", "outside previous", "kept"] = Field(
        "outside",
        description="matches that F is fitted to: outside the boxes, outside those of the previous frame (SG-SLAM), "
        "or all that earlier filters kept",
    )
    unmatched: Unmatched = Field(
        "keep", description="what happens to a feature whose flow failed (SG-SLAM: judge)"
    )


class ClassRuleSettings(Settings):
    """B15, three rules: class, depth, epipolar line (SEG-SLAM; constants are our assumption)."""

    movable: ClassList = Field(
        MOVABLE, description="classes that move only at times: comma-separated COCO names"
    )
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
        meaning="points within this distance of the depth of a moving object are dropped with it",
    )
    vote_share: float = tunable(
        0.3,
        low=0.05,
        high=1.0,
        limits=(0.0, 1.0),
        meaning="share of an object's points that must fail",
    )
    unmatched: Unmatched = Field(
        "keep", description="what happens to a feature of a movable object whose flow failed"
    )


class CorrelationSettings(Settings):
    """B7, Dai et al.'s point correlations on a Delaunay graph."""

    window: int = tunable(
        8,
        low=2,
        high=20,
        limits=(1, 60),
        unit="frames",
        meaning="largest age of the observation that is compared",
    )
    settled: int = tunable(
        4,
        low=1,
        high=10,
        limits=(1, 60),
        unit="frames",
        meaning="age from which a point's edges form components",
    )
    quantile: float = tunable(
        0.95,
        low=0.8,
        high=0.999,
        limits=(0.5, 0.99999),
        online=True,
        meaning="chi-square quantile that cuts an edge",
    )
    pixel_sigma: float = tunable(
        1.0,
        low=0.3,
        high=3.0,
        scale="log",
        limits=(0.01, 20.0),
        unit="px",
        meaning="standard deviation of a keypoint",
    )
    largest: Literal["volume", "count"] = tunable(
        "volume",
        meaning="which component is static: the one with the largest volume, or with the most points",
    )


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
        6.0,
        low=3.0,
        high=10.0,
        limits=(0.1, 1000.0),
        unit="m",
        meaning="depth beyond this is not used",
    )
    movable: ClassList = Field(
        MOVABLE,
        description="classes that are dynamic while a person touches them: comma-separated COCO names",
    )


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
    confidence: float = tunable(
        0.99, low=0.9, high=0.999, limits=(0.5, 0.9999), meaning="sets the number of draws"
    )
    max_draws: int = tunable(50, low=10, high=200, limits=(1, 1000), meaning="most draws a box")


class ProbabilitySettings(Settings):
    """B8, moving probability of tracked features (RDS-SLAM's Bayes filter, Detect-SLAM's moving average)."""

    rule: Literal["bayes", "average"] = Field("bayes", description="how evidence is accumulated")
    threshold: float = tunable(
        0.5,
        low=0.3,
        high=0.9,
        limits=(0.0, 1.0),
        online=True,
        meaning="probability above which a point is dropped",
    )
    soft: bool = Field(
        False, description="weight the kept points by their static probability (CFP-SLAM)"
    )
    link_px: float = tunable(
        2.5,
        low=1.0,
        high=6.0,
        limits=(0.1, 50.0),
        unit="px",
        meaning="largest distance between the end of a feature's flow and the earlier feature that it continues",
    )
    expand_px: float = Field(
        0.0,
        ge=0.0,
        le=500.0,
        description="radius of Detect-SLAM's matching point expansion, pixels at an image width of 640; 0 disables it",
    )


class MovingVoteSettings(Settings):
    """B3 and B11 as in DS-SLAM's code: one vote for all people."""

    corners: int = tunable(
        1000, low=200, high=2000, limits=(8, 10000), meaning="Harris corners that are tracked"
    )
    sad_limit: int = tunable(
        2120, low=500, high=5000, limits=(1, 10**6), meaning="largest 3x3 sum of differences"
    )
    inlier_px: float = tunable(
        0.1,
        low=0.05,
        high=1.0,
        scale="log",
        limits=(0.01, 10.0),
        unit="px",
        meaning="RANSAC's inlier threshold",
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
        unit=AT_640,
        meaning="distance to a person within which a moving corner votes",
    )
    min_votes: int = tunable(
        1, low=1, high=20, limits=(1, 1000), online=True, meaning="moving corners required"
    )


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
        "nearest",
        meaning="which keyframes are compared (the paper means nearest, the code takes farthest)",
    )
    references: int = tunable(
        5, low=1, high=10, limits=(1, 20), meaning="keyframes that are compared"
    )
    min_keyframes: int = tunable(
        1,
        low=1,
        high=10,
        limits=(1, 20),
        meaning="keyframes before the test is active (not stated in the paper; the code waits for 5)",
    )
    max_parallax_deg: float = tunable(
        30.0,
        low=10.0,
        high=60.0,
        limits=(1.0, 180.0),
        unit="deg",
        meaning="largest angle between the two views",
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
    grow: bool = Field(True, description="grow regions of equal depth from the hidden points (B5)")
    dilation_px: int = tunable(
        15,
        low=0,
        high=30,
        limits=(0, 100),
        unit=AT_640,
        meaning="radius by which the result is grown",
    )
    border_px: int = tunable(
        0,
        low=0,
        high=30,
        limits=(0, 100),
        unit=AT_640,
        meaning="further radius within which features at the result's border are dropped (15 in the code)",
    )


class ReseedingSettings(Settings):
    """B12, re-seeding (NGD-SLAM, Crowd-SLAM): how many of the features that culling left are used at most.

    The extractor must find more than these (`features.n_features`, 1.5 times as many in NGD-SLAM).
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


class ResidualSettings(Settings):
    """B14, residuals of image clusters with a semantic prior (DGS-SLAM of Yan 2022; constants are our assumption)."""

    clusters: int = tunable(
        24, low=8, high=48, limits=(2, 200), meaning="clusters of image position and depth"
    )
    depth_weight: float = tunable(
        2.0,
        low=0.2,
        high=10.0,
        scale="log",
        limits=(0.0, 100.0),
        meaning="weight of the relative depth residual beside the intensity residual",
    )
    prior: float = tunable(
        0.9,
        low=0.5,
        high=0.99,
        limits=(0.01, 0.999),
        meaning="prior probability that a person's cluster moves",
    )
    threshold: float = tunable(
        0.5,
        low=0.2,
        high=0.9,
        limits=(0.0, 1.0),
        online=True,
        meaning="posterior above which a cluster is dynamic",
    )


class TemplateSettings(Settings):
    """B13, template matching over a sliding window inside boxes (DynaTM-SLAM; constants are our assumption)."""

    patch_px: int = tunable(
        11, low=5, high=21, limits=(3, 41), unit="px", meaning="side of the square patch"
    )
    window: int = tunable(
        5, low=2, high=10, limits=(1, 30), unit="frames", meaning="earlier frames that are searched"
    )
    zncc: float = tunable(
        0.8,
        low=0.5,
        high=0.95,
        limits=(-1.0, 1.0),
        online=True,
        meaning="median correlation below which a point is dropped",
    )
