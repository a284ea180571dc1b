"""Settings of the back end; importing this loads neither OpenCV nor numba.

Thresholds that few users need to change are constants beside the rule that uses them.
"""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from pydantic import Field

from dynslam_bench.core.errors import SettingsError
from dynslam_bench.core.settings import Settings, names, tunable

NO_DEPTH = "no effect: there is no depth"
"""Why a setting is not used by a system without depth."""


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
    max_distance: int = tunable(
        90,
        low=40,
        high=120,
        limits=(1, 256),
        unit="bits",
        online=True,
        meaning="largest Hamming distance of a match by projection",
    )
    min_inliers: int = tunable(
        25,
        low=10,
        high=60,
        limits=(6, 1000),
        meaning="fewer inliers after the last optimisation mean lost",
    )
    rolling_shutter: bool = Field(
        True,
        description="whether the motion of a rolling shutter is compensated; takes a camera whose readout_s is known",
    )


class KeyframeSettings(Settings):
    """Settings of when a frame becomes a keyframe, and when a keyframe is redundant."""

    schedule: Literal["rule", "every", "none"] = tunable(
        "rule", online=True, tuned=False, meaning="tracked frames that become keyframes"
    )
    max_gap: int = tunable(
        30,
        low=10,
        high=90,
        limits=(1, 100000),
        unit="frames",
        meaning="after so many frames a keyframe is made if it shows enough new close features",
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
    redundant_share: float = tunable(
        0.9,
        low=0.7,
        high=1.0,
        limits=(0.1, 1.0),
        meaning="a keyframe is culled when three others see this share of its points, at most one octave coarser",
    )
    maximum: int = Field(
        600, ge=10, le=100000, description="keyframes kept at most; bounds memory and searches"
    )


class MappingSettings(Settings):
    """Growing and cleaning the map at each keyframe."""

    min_found_ratio: float = tunable(
        0.25,
        low=0.1,
        high=0.6,
        limits=(0.0, 1.0),
        meaning="a point is culled when it is found in fewer than this share of the frames that should see it",
    )
    neighbours: int = Field(
        8,
        ge=1,
        le=100,
        description="covisible keyframes that new points are triangulated with and fused with",
    )
    triangulate_below: float = Field(
        0.5,
        ge=0,
        le=1,
        description="features without depth are triangulated where fewer than this share of all have a close depth; "
        "elsewhere they lie mostly on edges of occlusion and on mirrors and make bad points",
    )
    min_parallax_sigmas: float = Field(
        0.0,
        ge=0,
        le=100,
        description="smallest parallax of a new point in standard deviations of a feature's position, which grow with "
        "its octave: with six depth is known to a quarter",
    )


class BundleAdjustmentSettings(Settings):
    """Local bundle adjustment at each keyframe; its work is bounded by counts, never by the clock."""

    window: int = tunable(
        8,
        low=2,
        high=20,
        limits=(1, 100),
        meaning="keyframes that are refined: the newest and its covisible ones",
    )
    iterations: int = tunable(
        3, low=1, high=10, limits=(1, 100), meaning="Levenberg-Marquardt iterations"
    )
    full: bool = Field(
        False,
        description="whether to refine all keyframes and points together after the last frame; changes the final "
        "trajectory alone",
    )


class RelocalisationSettings(Settings):
    """Finding the pose again after tracking was lost."""

    min_inliers: int = tunable(
        40,
        low=15,
        high=80,
        limits=(6, 1000),
        meaning="inliers that a recovered pose needs at least",
    )
    min_share: float = Field(
        0.4,
        ge=0,
        le=1,
        description="share of a keyframe's points in view that a relocalised frame must show",
    )
    max_speed: float = Field(
        2.0,
        gt=0,
        le=1000,
        description="metres a second, at most, that the camera may have moved while it was lost, unless it was "
        "kidnapped: places farther away only look like the one that is recognised",
    )
    new_map_after: int = Field(
        10,
        ge=2,
        le=100000,
        description="with loop closing: so many frames in a row that show enough but are not recognised begin a "
        "submap; its frames count as lost where the camera is not found in the root map, too",
    )


class LoopClosingSettings(Settings):
    """Recognising a place that was left, and correcting the drift since."""

    enabled: bool = Field(False, description="whether to close loops and to merge submaps")
    min_inliers: int = Field(
        50,
        ge=10,
        le=1000,
        description="points around the candidate that must fit the newest keyframe's pose there",
    )
    confirmations: int = Field(
        3, ge=1, le=20, description="keyframes in a row that must agree on the correction"
    )
    drift_share: float = Field(
        0.03,
        gt=0,
        le=1,
        description="largest correction that is accepted, as a share of the path length since, of which a rotation by "
        "a radian is three metres: places that only look the same are farther away than drift explains",
    )


class MotionModelSettings(Settings):
    """White-noise acceleration as motion model: prediction and filter while tracking, smoother afterwards."""

    acceleration: float = tunable(
        4.0,
        low=0.5,
        high=40.0,
        limits=(0.001, 10000.0),
        scale="log",
        unit="m/s^2",
        meaning="standard deviation of the camera's acceleration",
    )
    angular_acceleration: float = tunable(
        20.0,
        low=2.0,
        high=200.0,
        limits=(0.001, 100000.0),
        scale="log",
        unit="rad/s^2",
        meaning="standard deviation of the camera's angular acceleration",
    )
    smooth: bool = Field(
        True,
        description="smooth the final trajectory; the online one (that of studies) is never changed afterwards",
    )


class StartMapSettings(Settings):
    """A map from which the run starts, made by an earlier run; the camera has to be relocalised in it first."""

    file: str = names(
        "",
        "file",
        meaning="map.npz of an earlier run (run --save-map); empty to begin without a map",
    )
    localisation_only: bool = Field(
        False,
        description="whether that map stays as it is: no keyframes, no bundle adjustment, poses alone",
    )

    def verify(self) -> None:
        """The file exists, and there is one if the run only localises."""
        if self.localisation_only and not self.file:
            raise SettingsError(
                "localisation only needs a map, but backend.map.file is empty",
                "make one with: run --save-map",
            )
        if self.file and not Path(self.file).expanduser().is_file():
            raise SettingsError(
                f"backend.map.file names {self.file}, which is no file", "make one: run --save-map"
            )


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


# Without depth


class TwoViewSettings(Settings):
    """The initial map, from two views."""

    radius_px: float = Field(
        100.0,
        ge=1,
        le=1000,
        description="search window around the last position of a feature, pixels of octave 0",
    )
    min_matches: int = Field(
        100,
        ge=20,
        le=10000,
        description="with fewer matches the newest frame becomes the first of the two views",
    )
    min_points: int = Field(50, ge=10, le=10000, description="points that the two views must give")
    min_parallax_deg: float = Field(
        1.0, gt=0, le=30, description="smallest parallax of at least fifty of the points, degrees"
    )


class MonocularKeyframeSettings(KeyframeSettings):
    """Settings of when a frame becomes a keyframe: earlier than with depth, since points come from keyframes alone."""

    max_gap: int = Field(30, description=NO_DEPTH)
    tracked_share: float = tunable(
        0.9,
        low=0.4,
        high=0.98,
        limits=(0.0, 1.0),
        online=True,
        meaning="a keyframe is made when fewer points are tracked than this share of the reference keyframe's "
        "established ones, or of the most since the last keyframe if the view has moved",
    )


class MonocularMappingSettings(MappingSettings):
    """Growing and cleaning the map at each keyframe: all points are triangulated."""

    neighbours: int = Field(
        20,
        ge=1,
        le=100,
        description="covisible keyframes that new points are triangulated with and fused with",
    )
    triangulate_below: float = Field(
        1.0, ge=1, le=1, description="every feature without a point is triangulated"
    )
    min_parallax_sigmas: float = Field(
        6.0,
        ge=0,
        le=100,
        description="smallest parallax of a new point in standard deviations of a feature's position, which grow with "
        "its octave: coarse features that hardly moved are believed too near, and lengths shrink with them",
    )


class MonocularLoopClosingSettings(LoopClosingSettings):
    """Recognising a place that was left, where scale drifts as well."""

    drift_share: float = Field(
        0.1,
        gt=0,
        le=1,
        description="largest correction that is accepted, as a share of the path length since, of which a rotation by "
        "a radian is one unit of length; more than with depth, since scale drifts",
    )


class MonocularBackendSettings(BackendSettings):
    """All settings of the back end without depth; its unit of length is the median depth of the initial map."""

    two_views: TwoViewSettings = TwoViewSettings()
    keyframes: MonocularKeyframeSettings = MonocularKeyframeSettings()
    mapping: MonocularMappingSettings = MonocularMappingSettings()
    loop_closing: MonocularLoopClosingSettings = MonocularLoopClosingSettings()
