"""Maps of their own, begun after the camera was lost where nothing was recognised: where they may lie."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.geometry import se3

Array = NDArray[np.float64]

UNIT_MAY_DIFFER = 10.0
"""Without depth the unit of length is the median depth of the first views: so many times another's it may be."""


@dataclass(frozen=True, eq=False)
class Island:
    """A map that is connected with the first one by nothing.

    Attributes:
        start: Camera centre of its first frame in its own world ``[3]``, metres.
        anchor: Camera centre where the first map was left ``[3]``, in that map's world, metres.
        reach_m: How far from there it began, at most.
        slack: How far its world may be turned against the first map's, radians; any angle if it comes from a file.
    """

    start: Array
    anchor: Array
    reach_m: float
    slack: float = np.pi


class Islands:
    """All islands so far, by number (`Map.kf_island`).

    Args:
        known: Those of a loaded map, from number 1 on.
        stretch: How many times longer a way on an island may be than it looks: without depth each has its own unit.
    """

    def __init__(self, known: Iterable[Island] = (), *, stretch: float = 1.0) -> None:
        self._islands = dict(enumerate(known, 1))
        self._stretch = stretch

    def all(self) -> list[Island]:
        """All of them in the order of their numbers."""
        return [*self._islands.values()]

    def begin(self, left: int, start: Array, reach_m: float, slack: float = np.pi) -> int:
        """A new island begins where the camera was lost, as far as anybody knows.

        Args:
            left: The island, or 0, in which the camera was tracked last.
            start: Camera centre there ``[3]``; the new island takes it for that of its own first frame.
            reach_m: How far the camera may have gone since.
            slack: How far the directions that it has there may be turned against those of the island left, radians.

        Returns:
            Its number.
        """
        number = 1 + len(self._islands)
        turned = min(slack + self.slack(left, 0), np.pi)
        self._islands[number] = Island(start.copy(), *self._from_first(left, start, reach_m), turned)
        return number

    def carried(self, number: int, before: Array, after: Array, scales: Array) -> None:
        """Keyframes of an island, or 0, were moved: so was what is known of places in its world, with the nearest.

        Args:
            number: The island.
            before: World-to-camera poses ``[K, 4, 4]`` of its keyframes until now.
            after: Those from now on.
            scales: What lengths around each were multiplied by ``[K]``.
        """
        centres = se3.inverse(before)[:, :3, 3]
        for each, island in self._islands.items():
            if number not in (0, each):
                continue
            place = island.start if number else island.anchor
            nearest = int(np.linalg.norm(centres - place, axis=1).argmin())
            local = scales[nearest] * se3.transform(before[nearest], place)
            now, scale = se3.transform(se3.inverse(after[nearest]), local), float(scales[nearest])
            turned = float(se3.rotation_angle(se3.inverse(after[nearest]) @ before[nearest]))
            slack = min(island.slack + turned, np.pi)
            self._islands[each] = (
                replace(island, start=now, slack=slack)
                if number
                else replace(island, anchor=now, reach_m=scale * island.reach_m, slack=slack)
            )

    def slack(self, one: int, other: int) -> float:
        """How far the worlds of two islands, or 0, may be turned against each other, radians."""
        if one == other:
            return 0.0
        return float(sum(self._islands[each].slack for each in (one, other) if each in self._islands))

    def within(self, left: int, there: int, last: Array, now: Array, reach_m: float) -> bool:
        """Whether a camera can have got from one place to another.

        Args:
            left: The island, or 0, in which it was tracked last.
            there: The island, or 0, of the place where it may be now; of others nothing is known.
            last: Its centre then ``[3]``.
            now: Its centre now.
            reach_m: How far it may have gone.
        """
        anchor, most = (last, reach_m) if there == left else self._from_first(left, last, reach_m)
        return there in (left, 0) and bool(np.linalg.norm(now - anchor) <= most)

    def may_lie(self, number: int, moved: Callable[[Array], Array], drift_m: float = 0.0) -> bool:
        """Whether an island can have begun where it would come to lie in the first map's world.

        Args:
            number: The island.
            moved: Where in the first map's world a place ``[3]`` of the island's would come to lie, ``[3]``.
            drift_m: By how much drift may have put it too far away.
        """
        island = self._islands[number]
        return bool(np.linalg.norm(moved(island.start) - island.anchor) <= island.reach_m + drift_m)

    def _from_first(self, left: int, last: Array, reach_m: float) -> tuple[Array, float]:
        """Where the first map was left, and how far from there the camera can be now."""
        island = self._islands.get(left)
        if island is None:
            return last.copy(), reach_m
        way = self._stretch * float(np.linalg.norm(last - island.start))
        return island.anchor, island.reach_m + way + reach_m
