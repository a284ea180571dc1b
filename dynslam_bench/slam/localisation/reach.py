"""Where a camera may have got to while it was lost.

Buildings repeat themselves: the next door looks like the last one, and everything around agrees. What tells them apart
is that nobody gets from one to the other in a second, and that the images tell which way the camera has turned.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.geometry import se3
from dynslam_bench.geometry.camera import Camera

from ..mapping.islands import Islands
from ..settings import RelocalisationSettings
from .observation import Observations
from .tracking import Tracked
from .turn import Turn

Array = NDArray[np.float64]

SLACK_M = 0.5
"""Metres that are believed in no time."""
SUDDEN = 60
"""A frame that shows so many map points, as many as a map begins with, followed by one that shows nothing of it: the
camera was put elsewhere."""


@dataclass(frozen=True, eq=False)
class Lost:
    """What is known of a camera that was lost.

    Attributes:
        island: The island, or 0, where it was tracked last.
        reach_m: How far it may have gone since.
        turn: How it has turned since; None if that is unknown.
    """

    island: int
    reach_m: float
    turn: Turn | None

    def may_be(self, islands: Islands, T_last_world: Array, island: int, T_cam_world: Array) -> bool:
        """Whether it can have got to a pose.

        Args:
            islands: Where they may lie, and how they may be turned.
            T_last_world: World-to-camera pose ``[4, 4]`` where it was tracked last.
            island: The island, or 0, of the pose.
            T_cam_world: The pose in that island's world.
        """
        turned = islands.slack(self.island, island)
        if self.turn is not None and not self.turn.allows(T_last_world, T_cam_world, turned):
            return False
        last, now = (se3.inverse(pose)[:3, 3] for pose in (T_last_world, T_cam_world))
        return islands.within(self.island, island, last, now, self.reach_m)


class Reach:
    """Bounds the way, and the turn, since the last tracked frame.

    Attributes:
        turn: The turn; None where the images are not connected.
    """

    def __init__(self, camera: Camera, *, anywhere: bool = False) -> None:
        self._camera = camera
        self._sudden = anywhere
        self.turn: Turn | None = None

    def lost(self, last: Tracked, seen: Observations, settings: RelocalisationSettings, *, shows: bool) -> None:
        """The first frame that is not tracked any more.

        Args:
            last: The last tracked frame.
            seen: The new one's features.
            settings: Largest distance of descriptors.
            shows: Whether it is no blank wall, and no covered lens.
        """
        self.left(last)
        self._follow(seen, settings)
        self._sudden = self.turn is None and shows and bool(np.count_nonzero(last.point >= 0) >= SUDDEN)

    def left(self, last: Tracked) -> None:
        """The camera is taken for lost from the next frame on; this one was tracked last."""
        self.turn, self._sudden = Turn(last.seen, np.eye(3)), False

    def since(
        self, last: Tracked, seen: Observations, timestamp: float, island: int, settings: RelocalisationSettings
    ) -> Lost:
        """The next frame of a lost camera has come: what is known of the time since the last tracked one.

        Args:
            last: That one.
            seen: The next frame's features.
            timestamp: Its stamp, seconds.
            island: The island, or 0, where the camera was tracked last.
            settings: The largest speed, and distance of descriptors.
        """
        self._follow(seen, settings)
        return Lost(island, self.metres(last, timestamp, settings), self.turn)

    def at_most(
        self,
        last: Tracked,
        seen: Observations,
        timestamp: float,
        island: int,
        settings: RelocalisationSettings,
        prediction: Array,
    ) -> Lost:
        """What is known of the time since the frame before, in which the camera was tracked; arguments as `since`.

        A camera that moves fast, as on a car, may go on as the motion model has it: world-to-camera `prediction`.
        """
        turn = Turn(last.seen, np.eye(3)).on(seen, self._camera, settings.max_distance)
        centres = [se3.inverse(pose)[:3, 3] for pose in (last.T_cam_world, prediction)]
        step = float(np.linalg.norm(centres[1] - centres[0]))
        return Lost(island, step + _way(last, timestamp, settings), turn)

    def _follow(self, seen: Observations, settings: RelocalisationSettings) -> None:
        if self.turn is not None:
            self.turn = self.turn.on(seen, self._camera, settings.max_distance)

    @property
    def slack(self) -> float:
        """How far the turn may be off, radians."""
        return np.pi if self.turn is None else self.turn.slack

    def turned(self, last: Tracked) -> Array:
        """World-to-camera pose ``[4, 4]`` of a camera that has turned but has not moved."""
        return last.T_cam_world if self.turn is None else self.turn.after(last.T_cam_world)

    def metres(self, last: Tracked, timestamp: float, settings: RelocalisationSettings) -> float:
        """The way at most until a time, metres; infinite where the camera was put elsewhere.

        Args:
            last: The last tracked frame.
            timestamp: Seconds.
            settings: The largest speed.
        """
        return np.inf if self._sudden else _way(last, timestamp, settings)


def _way(last: Tracked, timestamp: float, settings: RelocalisationSettings) -> float:
    return SLACK_M + settings.max_speed * max(timestamp - last.timestamp, 0.0)
