"""How far a camera may have gone while it was lost.

Buildings repeat themselves: the next door looks like the last one, and everything around agrees. What tells them apart
is that nobody gets from one to the other in a second.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..settings import RelocalisationSettings
from .tracking import Tracked

Array = NDArray[np.float64]

SLACK_M = 0.5
"""Metres that are believed in no time."""
SUDDEN = 100
"""A frame that shows so many map points, followed by one that shows none of them: the camera was put elsewhere."""


class Reach:
    """Bounds the way since the last tracked frame."""

    def __init__(self, *, anywhere: bool = False) -> None:
        self._sudden = anywhere

    def lost(self, last: Tracked, features: int, enough: int) -> None:
        """The first frame that is not tracked any more.

        Args:
            last: The last tracked frame.
            features: Features with depth of the new one.
            enough: So many show that it is no blank wall, and no covered lens.
        """
        self._sudden = bool(np.count_nonzero(last.point >= 0) >= SUDDEN and features >= enough)

    def metres(self, last: Tracked, timestamp: float, settings: RelocalisationSettings) -> float:
        """The way at most until a time, metres; infinite where the camera was put elsewhere.

        Args:
            last: The last tracked frame.
            timestamp: Seconds.
            settings: The largest speed.
        """
        return np.inf if self._sudden else SLACK_M + settings.max_speed * max(timestamp - last.timestamp, 0.0)
