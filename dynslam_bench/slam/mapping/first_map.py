"""The first map of a camera without depth: two keyframes and what both show, the median depth being one."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.contracts.filter import FrameBundle
from dynslam_bench.geometry import se3
from dynslam_bench.geometry.camera import Camera

from ..localisation.observation import Observations
from ..localisation.two_views import VIEWS, Later, Pair, TwoViews, believed, distinct, match_views, possible_motions
from ..monocular_settings import TwoViewSettings
from .map import Map

Array = NDArray[np.float64]

FEWEST = 3
"""So many views beside the first are needed at least: two alone take a turn for a step."""
CARRIED = 2
"""So many of the motions that one frame tells are asked about the next one, too."""


@dataclass(frozen=True, eq=False)
class View:
    """A frame, and its features as the back end uses them."""

    frame: FrameBundle
    seen: Observations


@dataclass(frozen=True, eq=False)
class FirstMap:
    """Two views and what they give together; lengths in units of the first view's median depth.

    Attributes:
        first: The first view.
        second: The second.
        T_cam_first: Pose ``[4, 4]`` from the first camera's frame to the second's.
        pair: Which features show a point.
        points: ``[M, 3]`` in the first camera's frame.
    """

    first: View
    second: View
    T_cam_first: Array
    pair: Pair
    points: Array


class FirstViews:
    """Keeps a first view and what came after, until all of it together tells how the camera moved.

    Attributes:
        later: Views since the first one, oldest first; thinned out where a camera that hardly moves waits for long.
    """

    def __init__(self) -> None:
        self._first: View | None = None
        self._expected: Array = np.zeros((0, 2))
        self.later: list[Later] = []
        self._motions: list[TwoViews] = []

    def take(self, view: View, camera: Camera, settings: TwoViewSettings) -> FirstMap | None:
        """Try the next frame with the first view; it takes that one's place where they have too little in common.

        Args:
            view: The next frame.
            camera: Intrinsics, without distortion.
            settings: What is asked of the two views.
        """
        first = self._first
        if first is None:
            self._begin(view, settings)
            return None
        pair = match_views(first.seen, view.seen, self._expected, settings.radius_px)
        if len(pair) < settings.min_matches:
            self._begin(view, settings)
            return None
        self._expected[pair.first] = view.seen.xy[pair.second]
        if len(self.later) >= 2 * VIEWS:
            del self.later[::2]
        self.later.append(Later(view.seen, pair))
        if len(self.later) < FEWEST:
            return None
        motions = possible_motions(first.seen, self.later, camera, settings, self._motions)
        self._motions = distinct(motions)[:CARRIED]
        found = believed(motions, settings)
        return None if found is None else _scaled(first, view, found)

    def _begin(self, view: View, settings: TwoViewSettings) -> None:
        self._first = view if len(view.seen) >= settings.min_matches else None
        self._expected = view.seen.xy.copy()
        self.later, self._motions = [], []


def _scaled(first: View, second: View, found: TwoViews) -> FirstMap:
    depth = float(np.median(found.points[:, 2]))
    pose = found.T_second_first.copy()
    pose[:3, 3] /= depth
    return FirstMap(first, second, pose, found.pair, found.points / depth)


def put(world: Map, start: FirstMap, T_first_world: Array, island: int) -> tuple[int, int]:
    """Put a first map into the map as an island that has nothing yet; the slots of its two keyframes.

    Args:
        world: The map.
        start: What the two views give.
        T_first_world: Pose ``[4, 4]`` of the first view in the island's world, world to camera.
        island: The island's number (`Map.kf_island`).
    """
    poses = T_first_world, start.T_cam_first @ T_first_world
    slots = [
        world.add_keyframe(view.seen, pose, view.frame.index, view.frame.timestamp, island)
        for view, pose in zip((start.first, start.second), poses, strict=True)
    ]
    position = se3.transform(se3.inverse(T_first_world), start.points)
    points = world.add_points(position, start.first.seen.rgb[start.pair.first], slots[0], start.pair.first)
    world.observe(slots[1], start.pair.second, points)
    world.refresh(points)
    return slots[0], slots[1]
