"""Settings of the back end; importing this loads neither OpenCV nor numba."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from pydantic import Field

from dynslam_bench.core.errors import SettingsError
from dynslam_bench.core.settings import Settings, names, tunable

ADJUSTED, FILTERED = {"enabled": [True]}, {"filter": [True]}


class TrackingSettings(Settings):
    """Finding the pose of a frame against the map."""

    radius_px: float = tunable(
        15.0,
        low=5.0,
        high=40.0,
        limits=(1.0, 300.0),
        unit="px",
        online=True,
        meaning="search window around the predicted position of a feature of the last frame, at octave 0",
    )
    map_radius_px: float = tunable(
        4.0,
        low=1.5,
        high=12.0,
        limits=(0.5, 100.0),
        unit="px",
        online=True,
        meaning="search window around the projection of a map point, at octave 0",
    )
    mapped_matches: int = tunable(
        100,
        low=20,
        high=400,
        limits=(1, 10000),
        online=True,
        meaning="so many matches with map points of the last frame make points from its depth alone unnecessary",
    )
    max_distance: int = tunable(
        90,
        low=40,
        high=120,
        limits=(1, 256),
        unit="bits",
        online=True,
        meaning="largest Hamming distance of a match by projection",
    )
    ratio: float = tunable(
        0.85,
        low=0.6,
        high=1.0,
        limits=(0.1, 1.0),
        online=True,
        meaning="nearest over second nearest descriptor distance allowed when map points are searched",
    )
    min_inliers: int = tunable(
        25, low=10, high=60, limits=(6, 1000), meaning="fewer inliers after the last optimisation mean lost"
    )
    local_map: Literal["all", "covisible"] = Field(
        "all",
        description="search all map points in view, or only those of covisible keyframes; not tunable: up to eighty "
        "keyframes are taken, so that it changes nothing before the map is larger than a study's blocks make it",
    )
    close_factor: float = tunable(
        40.0,
        low=20.0,
        high=80.0,
        limits=(1.0, 1000.0),
        unit="baselines",
        meaning="points nearer than this many stereo baselines are close: their depth is trusted at once",
    )
    right_sigma_px: float = tunable(
        1.5,
        low=0.3,
        high=3.0,
        limits=(0.05, 50.0),
        scale="log",
        unit="px",
        meaning="standard deviation of the right coordinate at octave 0, beside the depth sensor's noise",
    )
    depth_noise: float = tunable(
        0.0025,
        low=0.0005,
        high=0.02,
        limits=(0.0, 1.0),
        scale="log",
        unit="1/m",
        meaning="standard deviation of the depth over its square",
    )
    rolling_shutter: bool = Field(
        True,
        description="whether features are moved to where the middle row's camera would have seen them; takes a camera "
        "whose readout_s is known",
    )


class KeyframeSettings(Settings):
    """When a frame becomes a keyframe, and when a keyframe is redundant."""

    min_gap: int = tunable(
        0, low=0, high=10, limits=(0, 1000), unit="frames", meaning="frames between keyframes, at least"
    )
    max_gap: int = tunable(
        30,
        low=10,
        high=90,
        limits=(1, 100000),
        unit="frames",
        meaning="after so many frames a keyframe is made if it shows anything new",
    )
    tracked_share: float = tunable(
        0.75,
        low=0.4,
        high=0.95,
        limits=(0.0, 1.0),
        online=True,
        meaning="a keyframe is made when fewer points are tracked than this share of the reference keyframe's "
        "established ones, or of the most since the last keyframe if the view has moved",
    )
    established: int = tunable(
        3, low=1, high=5, limits=(1, 100), meaning="keyframes that observe an established point, at least"
    )
    view_share: float = tunable(
        0.9,
        low=0.5,
        high=0.98,
        limits=(0.0, 1.0),
        online=True,
        meaning="a keyframe is made when less than this share of the last keyframe's points lies in the image",
    )
    moved_share: float = tunable(
        0.97,
        low=0.8,
        high=1.0,
        limits=(0.0, 1.0),
        online=True,
        meaning="the view has moved when less than this share of the last keyframe's points lies in the image",
    )
    min_close: int = tunable(
        100, low=30, high=300, limits=(0, 10000), meaning="a keyframe is made when fewer close points are tracked"
    )
    new_close: int = tunable(
        70, low=20, high=200, limits=(0, 10000), meaning="and when at least so many close features are not in the map"
    )
    redundant_share: float = tunable(
        0.9,
        low=0.7,
        high=1.0,
        limits=(0.1, 1.0),
        meaning="a keyframe goes when three others see this share of its points, at most one octave coarser",
    )
    maximum: int = Field(600, ge=10, le=100000, description="keyframes kept at most; bounds memory and searches")
    depth_images: int = Field(8, ge=0, le=1000, description="newest keyframes that keep their depth image, for filters")


class MappingSettings(Settings):
    """Growing and cleaning the map at each keyframe."""

    neighbours: int = tunable(
        8, low=3, high=20, limits=(1, 100), meaning="covisible keyframes that new points are sought in and fused with"
    )
    triangulate_below: float = tunable(
        0.5,
        low=0.0,
        high=1.0,
        meaning="features without depth are triangulated where fewer than this share of all have a close depth; "
        "elsewhere they lie mostly on edges of occlusion and on mirrors and make bad points",
    )
    min_parallax_deg: float = tunable(
        1.0, low=0.2, high=3.0, limits=(0.01, 30.0), unit="deg", meaning="smallest parallax of a triangulated point"
    )
    min_parallax_sigmas: float = Field(
        0.0,
        ge=0,
        le=100,
        description="the same in standard deviations of a feature's place, which grow with its octave: with six "
        "depth is known to a quarter",
    )
    min_found_ratio: float = tunable(
        0.25,
        low=0.1,
        high=0.6,
        limits=(0.0, 1.0),
        meaning="a point goes when it is found in fewer than this share of the frames that should see it",
    )
    min_observations: int = tunable(
        2,
        low=1,
        high=4,
        limits=(1, 10),
        meaning="a point goes when, two keyframes after its creation, fewer keyframes observe it",
    )


class BundleAdjustmentSettings(Settings):
    """Local bundle adjustment at each keyframe; its work is bounded by counts, never by the clock."""

    enabled: bool = tunable(True, meaning="whether to refine keyframes and points at each keyframe")
    solver: Literal["schur", "gtsam"] = Field(
        "schur", description="own vectorised Schur complement; gtsam is the reference that it is compared with"
    )
    window: int = tunable(
        8,
        low=2,
        high=20,
        limits=(1, 100),
        when=ADJUSTED,
        meaning="keyframes that are refined: the newest and its covisible ones",
    )
    fixed: int = tunable(
        6,
        low=1,
        high=20,
        limits=(0, 100),
        when=ADJUSTED,
        meaning="further keyframes that see the same points and stay where they are",
    )
    observations: int = tunable(
        6000,
        low=1000,
        high=20000,
        limits=(100, 1000000),
        scale="log",
        when=ADJUSTED,
        meaning="observations used at most: the budget that bounds the keyframe's step",
    )
    iterations: int = tunable(
        3, low=1, high=10, limits=(1, 100), when=ADJUSTED, meaning="Levenberg-Marquardt iterations"
    )
    full: bool = Field(
        False,
        description="whether to refine all keyframes and points together after the last frame; moves the final "
        "trajectory alone",
    )
    full_iterations: int = Field(10, ge=1, le=1000, description="Levenberg-Marquardt iterations of that")


class RelocalisationSettings(Settings):
    """Finding the pose again after tracking was lost."""

    searched: int = Field(
        10,
        ge=1,
        le=100000,
        description="keyframes that are matched feature by feature: those that look most alike; bounds the time of a "
        "frame. Not tunable: no short run was seen to come out otherwise with three or with forty",
    )
    candidates: int = tunable(
        5, low=1, high=20, limits=(1, 1000), meaning="keyframes with the most descriptor matches that PnP is tried on"
    )
    iterations: int = tunable(
        150, low=30, high=1000, limits=(1, 100000), scale="log", meaning="RANSAC samples a candidate"
    )
    max_distance: int = tunable(
        60, low=30, high=90, limits=(1, 256), unit="bits", meaning="largest Hamming distance of a match by descriptor"
    )
    min_inliers: int = tunable(
        40, low=15, high=80, limits=(6, 1000), meaning="inliers that a recovered pose needs at least"
    )
    min_share: float = Field(
        0.4,
        ge=0,
        le=1,
        description="share of a keyframe's own points in view that a frame without prediction must show, too",
    )
    max_speed: float = Field(
        2.0,
        gt=0,
        le=1000,
        description="metres a second, at most, that the camera may have moved while it was lost, unless it was put "
        "elsewhere from one frame to the next: places farther away only look like the one that is recognised",
    )
    new_map_after: int = Field(
        10,
        ge=2,
        le=100000,
        description="with loop closing: so many frames in a row that show enough but are not recognised begin a map of "
        "their own; the one that tracking ends with counts, and is not looked for elsewhere; the map's frames count as "
        "lost where the camera is not found in the first one, too",
    )


class LoopClosingSettings(Settings):
    """Recognising a place that was left, and correcting the drift since."""

    enabled: bool = Field(False, description="whether to close loops")
    away: int = Field(
        20, ge=2, le=100000, description="keyframes at least between the newest and one that it closes a loop to"
    )
    candidates: int = Field(
        3, ge=1, le=100, description="keyframes that are matched feature by feature: those that look most alike"
    )
    min_matches: int = Field(20, ge=6, le=1000, description="descriptor matches that a candidate needs")
    min_inliers: int = Field(
        50, ge=10, le=1000, description="points around the candidate that must fit the newest keyframe's pose there"
    )
    min_share: float = Field(
        0.3, ge=0, le=1, description="share of the candidate's own points in view that must be among them"
    )
    merge_inliers: int = Field(
        100, ge=10, le=10000, description="the same where the first map's camera sees another, which no drift bounds"
    )
    merge_share: float = Field(0.5, ge=0, le=1, description="the same share where two maps would be joined")
    confirmations: int = Field(3, ge=1, le=20, description="keyframes in a row that must agree on the correction")
    drift_share: float = Field(
        0.03,
        gt=0,
        le=1,
        description="largest correction that is believed, as a share of the way since, of which a turn by a radian is "
        "three metres: places that only look the same are farther away than drift explains",
    )
    drift_deg: float = Field(
        0.5, gt=0, le=90, description="largest rotation that is believed, degrees a metre of that way"
    )


class MotionModelSettings(Settings):
    """White-noise acceleration as motion model: prediction and filter while tracking, smoother afterwards."""

    filter: bool = tunable(True, meaning="weigh the pose that the image gives against the motion model, causally")
    smooth: bool = Field(
        True,
        description="smooth the final trajectory; the online one (that of studies) is never touched afterwards",
    )
    acceleration: float = tunable(
        4.0,
        low=0.5,
        high=40.0,
        limits=(0.001, 10000.0),
        scale="log",
        unit="m/s^2",
        when=FILTERED,
        meaning="standard deviation of the camera's acceleration",
    )
    angular_acceleration: float = tunable(
        20.0,
        low=2.0,
        high=200.0,
        limits=(0.001, 100000.0),
        scale="log",
        unit="rad/s^2",
        when=FILTERED,
        meaning="standard deviation of the camera's angular acceleration",
    )
    inflation: float = tunable(
        100.0,
        low=1.0,
        high=300.0,
        limits=(0.01, 10000.0),
        scale="log",
        when=FILTERED,
        meaning="factor on the covariance of a measured pose, whose pixel errors are not independent",
    )
    max_gap_s: float = tunable(
        0.25,
        low=0.1,
        high=1.0,
        limits=(0.001, 1000.0),
        unit="s",
        when=FILTERED,
        meaning="after a longer gap between frames nothing is assumed of the motion",
    )


class StartMapSettings(Settings):
    """A map from which the run starts, made by an earlier one; where in it the camera is has to be recognised first."""

    file: str = names("", "file", meaning="map.npz of an earlier run (run --save-map); empty to begin without a map")
    localisation_only: bool = Field(
        False, description="whether that map stays as it is: no keyframes, no bundle adjustment, poses alone"
    )

    def verify(self) -> None:
        """Without a map there is nothing to localise in."""
        if self.localisation_only and not self.file:
            raise SettingsError(
                "localisation only needs a map, but backend.map.file is empty", "make one with: run --save-map"
            )
        if self.file and not Path(self.file).expanduser().is_file():
            raise SettingsError(f"backend.map.file names {self.file}, which is no file", "make one: run --save-map")


class BackendSettings(Settings):
    """All settings of the back end."""

    tracking: TrackingSettings = TrackingSettings()
    motion: MotionModelSettings = MotionModelSettings()
    keyframes: KeyframeSettings = KeyframeSettings()
    mapping: MappingSettings = MappingSettings()
    bundle_adjustment: BundleAdjustmentSettings = BundleAdjustmentSettings()
    relocalisation: RelocalisationSettings = RelocalisationSettings()
    loop_closing: LoopClosingSettings = LoopClosingSettings()
    map: StartMapSettings = StartMapSettings()


# Settings of the back end without depth; importing this loads neither OpenCV nor numba.

NO_DEPTH = "no effect: there is no depth"


class TwoViewSettings(Settings):
    """The first map, from two views."""

    radius_px: float = Field(
        100.0, ge=1, le=1000, description="search window around the place where a feature was seen last, pixels"
    )
    min_matches: int = Field(
        100, ge=20, le=10000, description="with fewer matches the newest frame becomes the first of the two views"
    )
    min_points: int = Field(50, ge=10, le=10000, description="points that the two views must give")
    min_parallax_deg: float = Field(
        1.0, gt=0, le=30, description="angle under which fifty of the points must be seen, or more, degrees"
    )


class MonocularTrackingSettings(TrackingSettings):
    """Finding the pose of a frame against the map, without depth."""

    close_factor: float = Field(40.0, description=NO_DEPTH)
    right_sigma_px: float = Field(1.5, description=NO_DEPTH)
    depth_noise: float = Field(0.0025, description=NO_DEPTH)


class MonocularKeyframeSettings(KeyframeSettings):
    """When a frame becomes a keyframe: earlier than with depth, since points come from keyframes alone."""

    tracked_share: float = tunable(
        0.9,
        low=0.4,
        high=0.98,
        limits=(0.0, 1.0),
        online=True,
        meaning="a keyframe is made when fewer points are tracked than this share of the reference keyframe's "
        "established ones, or of the most since the last keyframe if the view has moved",
    )
    max_gap: int = Field(30, description=NO_DEPTH)
    min_close: int = Field(100, description=NO_DEPTH)
    new_close: int = Field(70, description=NO_DEPTH)
    depth_images: Literal[0] = Field(0, description=NO_DEPTH)


class MonocularMappingSettings(MappingSettings):
    """Growing and cleaning the map at each keyframe: all points are triangulated."""

    neighbours: int = tunable(
        20, low=3, high=40, limits=(1, 100), meaning="covisible keyframes that new points are sought in and fused with"
    )
    min_parallax_sigmas: float = Field(
        6.0,
        ge=0,
        le=100,
        description="smallest parallax of a new point, in standard deviations of a feature's place, which grow with "
        "its octave: coarse features that hardly moved are believed too near, and lengths shrink with them",
    )
    triangulate_below: float = Field(
        1.0, ge=1, le=1, description="no effect: whatever has no point yet is triangulated"
    )


class MonocularLoopClosingSettings(LoopClosingSettings):
    """Recognising a place that was left, where scale drifts as well."""

    drift_share: float = Field(
        0.1,
        gt=0,
        le=1,
        description="largest correction that is believed, as a share of the way since, of which a turn by a radian is "
        "one unit of length; more than with depth, since scale drifts",
    )
    drift_deg: float = Field(
        0.5, gt=0, le=90, description="largest rotation that is believed, degrees a unit of length of that way"
    )


class MonocularBackendSettings(BackendSettings):
    """All settings of the back end without depth; its unit of length is the median depth of the first map."""

    two_views: TwoViewSettings = TwoViewSettings()
    tracking: MonocularTrackingSettings = MonocularTrackingSettings()
    keyframes: MonocularKeyframeSettings = MonocularKeyframeSettings()
    mapping: MonocularMappingSettings = MonocularMappingSettings()
    loop_closing: MonocularLoopClosingSettings = MonocularLoopClosingSettings()
