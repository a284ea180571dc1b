"""Which part of the map a frame is looked for in.

Without loop closing that is all of it. With loop closing it ends where the map is connected with the camera's place no
more: what was left long ago is the loop closer's to recognise. If its points were found by projection, the pose would
jump there, and the way since would keep its drift.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..mapping.map import Map
from ..settings import BackendSettings

Slots = NDArray[np.int64]

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
    connected = np.zeros(world.kf_alive.size, bool)
    connected[keyframe] = True
    connected[near] = True
    table = world.kf_point[near]
    further, _ = world.covisible_of(np.unique(table[table >= 0]))
    connected[further] = True
    long_ago = (np.abs(world.kf_id - world.kf_id[keyframe]) >= away) & ~connected
    return np.flatnonzero(world.kf_alive & (long_ago | (world.kf_island != world.kf_island[keyframe])))


def _observed(world: Map, keyframes: Slots) -> Slots:
    """Slots of the points that keyframes observe, ascending."""
    points = np.unique(world.kf_point[keyframes])
    return points[points >= 0].astype(np.int64)
