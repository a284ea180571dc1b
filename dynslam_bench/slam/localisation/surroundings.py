"""Which part of the map a frame is looked for in.

Without loop closing that is all of it. With loop closing it ends where the map is connected with the camera's place no
more: what was left long ago is the loop closer's to recognise. If its points were found by projection, the pose would
jump there, and the way since would keep its drift.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..mapping.map import Map
from ..mapping.map_kernels import distinct
from ..settings import BackendSettings

Slots = NDArray[np.int64]

HELD = 15
"""Two keyframes that share so many points hold each other in place (the least that ORB-SLAM2 calls covisible)."""
LIMIT = 80
"""Keyframes at most whose points are looked for where the local map is the covisible one."""


class Surroundings:
    """Keyframes and points around the camera's place; looked up anew only after a keyframe, or at another place.

    Args:
        world: The map.
        settings: Of the back end.
    """

    def __init__(self, world: Map, settings: BackendSettings) -> None:
        self._world = world
        self.settings = settings
        self._at: tuple[int, int] | None = None
        self._keyframes: Slots = np.zeros(0, np.int64)
        self._points: Slots = np.zeros(0, np.int64)

    def keyframes(self, reference: int) -> Slots:
        """Slots of the keyframes around one, oldest first."""
        self._look_around(reference)
        return self._keyframes

    def points(self, reference: int, known: Slots) -> Slots:
        """Slots of the points to look for.

        Args:
            reference: Slot of the keyframe that shares most points with the camera's view.
            known: Slots of points that are known to be in view (-1 entries are skipped).
        """
        if self.settings.tracking.local_map == "covisible":
            near, _ = self._world.covisible_of(known)
            return _observed(self._world, near[:LIMIT])
        self._look_around(reference)
        return self._points

    def _look_around(self, reference: int) -> None:
        """Renew what is known of the place, unless neither map nor place have changed."""
        world = self._world
        if self._at == (reference, world.next_keyframe):
            return
        self._at = reference, world.next_keyframe
        self._keyframes, self._points = world.keyframes, world.points
        if self.settings.loop_closing.enabled:
            away = apart(world, reference, self.settings.loop_closing.away)
            if len(away):
                self._keyframes = self._keyframes[~np.isin(self._keyframes, away)]
                self._points = _observed(world, self._keyframes)


def apart(world: Map, keyframe: int, away: int) -> Slots:
    """Slots of the keyframes made `away` before or after one, or longer, and connected with it over no third.

    Those of other islands always are.
    """
    near, _ = world.covisible(keyframe)
    further, _ = world.covisible_of(_observed(world, near))
    return _long_ago(world, keyframe, away, np.concatenate([near, further]))


def not_held(world: Map, keyframe: int, away: int) -> Slots:
    """Slots of the keyframes made `away` before or after one, or longer, that nothing holds in place beside it.

    Two that share `HELD` points hold each other, and so does a third that shares as many with both. After a loop that
    was closed a little off, a second visit is connected with the first by fewer, and drifts beside it: such a place may
    be recognised anew. Keyframes of other islands always may.
    """
    near, shared = world.covisible(keyframe)
    near = near[shared >= HELD]
    further = [other[count >= HELD] for other, count in map(world.covisible, near.tolist())]
    return _long_ago(world, keyframe, away, np.concatenate([near, *further]))


def _long_ago(world: Map, keyframe: int, away: int, connected: Slots) -> Slots:
    here = np.zeros(world.kf_alive.size, bool)
    here[keyframe] = True
    here[connected] = True
    long_ago = (np.abs(world.kf_id - world.kf_id[keyframe]) >= away) & ~here
    return np.flatnonzero(world.kf_alive & (long_ago | (world.kf_island != world.kf_island[keyframe])))


def _observed(world: Map, keyframes: Slots) -> Slots:
    """Slots of the points that keyframes observe, ascending."""
    return distinct(world.kf_point[keyframes], world.alive.size)
