"""Settings of the back end without depth; importing this loads neither OpenCV nor numba."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from dynslam_bench.core.settings import Settings, tunable

from .settings import (
    BackendSettings,
    KeyframeSettings,
    LoopClosingSettings,
    MappingSettings,
    TrackingSettings,
)

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
