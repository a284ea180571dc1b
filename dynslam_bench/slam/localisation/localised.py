"""What the back end says of one frame."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.contracts.result import TrackingState
from dynslam_bench.geometry import se3

from ..mapping.map import Map

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Localised:
    """Where a frame was taken, and what finding that out did to the map.

    Attributes:
        T_world_cam: Camera-to-world pose ``[4, 4]``, after bundle adjustment if the frame became a keyframe; a
            prediction while `state` is ``lost``; None before the first keyframe.
        state: ``ok`` (tracked), ``lost`` or ``initialising``.
        matches: Features matched with points of the map or of the last frame.
        inliers: How many of them fit the pose and observe a map point.
        residual_px: Median reprojection error of the inliers in pixels of octave 0; 0 where there is no pose.
        relocalised: Whether the first pose came from keyframes' descriptors.
        keyframe: Whether the frame became a keyframe.
        map_points: Points in the map afterwards.
        keyframes: Keyframes in the map afterwards.
        maps: Maps that they are of: beside the first one those that began after a loss and have not met it.
        loops: Loops that were closed so far.
        timings: Seconds of ``tracking``, ``mapping``, ``bundle_adjustment`` and ``loop_closing``, where they worked.
    """

    T_world_cam: Array | None
    state: TrackingState
    matches: int
    inliers: int
    residual_px: float
    relocalised: bool
    keyframe: bool
    map_points: int
    keyframes: int
    maps: int
    loops: int
    timings: Mapping[str, float]

    @classmethod
    def of(
        cls, world: Map, state: TrackingState, T_cam_world: Array | None, loops: int, timings: Mapping[str, float]
    ) -> Localised:
        """A frame's outcome with the map as it is now, before its matches are counted.

        Args:
            world: The map.
            state: Of tracking.
            T_cam_world: World-to-camera pose ``[4, 4]``, if there is one.
            loops: How many were closed so far.
            timings: What a keyframe took, if the frame became one.
        """
        return cls(
            T_world_cam=None if T_cam_world is None else se3.inverse(T_cam_world),
            state=state,
            matches=0,
            inliers=0,
            residual_px=0.0,
            relocalised=False,
            keyframe=bool(timings),
            map_points=world.point_count,
            keyframes=world.keyframe_count,
            maps=world.map_count,
            loops=loops,
            timings=timings,
        )
