"""The back end without depth: the same tracking and mapping, begun by two views instead of one."""

from __future__ import annotations

from dataclasses import replace
from time import perf_counter

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.contracts.filter import FrameBundle
from dynslam_bench.geometry.camera import Camera

from .backend import RgbdBackend
from .localisation.localised import Localised
from .localisation.observation import Observations
from .localisation.tracking import Tracked
from .mapping.first_map import FirstMap, FirstViews, View, put
from .monocular_settings import MonocularBackendSettings

Array = NDArray[np.float64]


class MonocularBackend(RgbdBackend):
    """Tracks frames against a map whose points are triangulated; lengths are in units of its first median depth.

    No feature it is given has a depth. The scale of bundle adjustment is free but for the keyframes that stay.

    Args:
        settings: Of tracking, mapping, bundle adjustment, keyframes, relocalisation and the first two views.
        scale_factor: Ratio of consecutive pyramid levels of the features that will come.
        levels: Number of pyramid levels of the features that will come.
        extractor: Who finds them.
    """

    uses_depth = False
    settings: MonocularBackendSettings

    def __init__(
        self,
        settings: MonocularBackendSettings | None = None,
        *,
        scale_factor: float = 1.2,
        levels: int = 8,
        extractor: str = "orb",
    ) -> None:
        own = settings or MonocularBackendSettings()
        super().__init__(own, scale_factor=scale_factor, levels=levels, extractor=extractor)

    def reset(self, camera: Camera, seed: int) -> None:
        """Forget everything: a new sequence begins."""
        super().reset(camera, seed)
        self._views_so_far = FirstViews()

    def _initialise(self, frame: FrameBundle, seen: Observations) -> Localised:
        """Frames are ``initialising`` until one shows, together with an earlier one, how the camera moved."""
        begin = perf_counter()
        start = self._views_so_far.take(View(frame, seen), self.camera, self.settings.two_views)
        if start is None:
            return self._localised(None)
        spent = {"mapping": perf_counter() - begin}
        return self._begin_from_two(start, np.eye(4), spent)

    def _usable(self, seen: Observations) -> int:
        """How many features a map could begin with: depth is none's."""
        return len(seen)

    def _begin_island(self, frame: FrameBundle, seen: Observations, last: Tracked) -> Localised | None:
        """A map of its own begins as the first one did; its unit of length is the median depth of its own views."""
        begin = perf_counter()
        if self._unrecognised == self.settings.relocalisation.new_map_after:
            self._views_so_far = FirstViews()
        start = self._views_so_far.take(View(frame, seen), self.camera, self.settings.two_views)
        if start is None:
            return None
        spent = {"mapping": perf_counter() - begin}
        self._note_island(last, start.first.frame.timestamp)
        T_first_world = last.T_cam_world.copy()
        T_first_world[:3] = start.T_cam_first[:3, :3].T @ self._reach.turned(last)[:3]
        return self._begin_from_two(start, T_first_world, spent)

    def _begin_from_two(self, start: FirstMap, T_first_world: Array, spent: dict[str, float]) -> Localised:
        """The two views become keyframes; the second, which is the frame at hand, is tracked."""
        first, second = put(self.world, start, T_first_world, self._island)
        frame, seen, pose = start.second.frame, start.second.seen, self.world.kf_pose[second].copy()
        self._views_so_far = FirstViews()
        self._tracked = True
        point = self.world.kf_point[second, : len(seen)].astype(np.int64)
        self._last = Tracked(seen, point, pose, frame.timestamp)
        self._reference = second
        self._keyframes.made(frame.index)
        for slot, view in ((first, start.first), (second, start.second)):
            self._views.renew(slot, view.frame.depth, [], self.settings.keyframes.depth_images)
        self.state = self._state()
        self.history.append(frame.timestamp, second, np.eye(4), 1e6 * np.eye(6))
        count = len(start.points)
        return replace(self._localised(pose, spent), matches=count, inliers=count)
