"""Whether what a frame shows is found in more than one place: then it does not tell where it was taken.

Floors, rooms and stretches of wall repeat themselves. A place that something else looks like, too, is no evidence for
a long way: for where a camera was carried, or for where a map of its own lies (perceptual aliasing).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.core.seeding import stream
from dynslam_bench.geometry import se3

from ..mapping.map import Map
from ..places import most_alike
from ..settings import BackendSettings
from .observation import Observations
from .recognition import Recognised, recognise
from .relocalisation import match_keyframe, ransac_pose

Array = NDArray[np.float64]
Slots = NDArray[np.int64]

LOOKED_AT = 12
"""Keyframes of each island, those most alike, that are looked at."""
RIVAL = 0.33
"""What another place has to show, as a share of what the first one does. Where nothing repeats itself it is 0.15 at
most, where walls do 0.4 to 1 (rendered rooms, `docs/backend.md`)."""
APART_DEPTHS = 0.3
APART = np.radians(15.0)
"""Poses that far apart, in median depths of what is seen, or turned, are two places."""
FEWEST = 30
"""Points that a place shows at least."""


@dataclass(frozen=True, eq=False)
class Sight:
    """A frame's pose by a place.

    Attributes:
        T_cam_world: World to camera, ``[4, 4]``.
        share: How much of what should be in view is, of one.
        depth: Median depth of what is seen.
    """

    T_cam_world: Array
    share: float
    depth: float

    def contradicts(self, other: Sight) -> bool:
        """Whether the frame cannot have been taken in both places."""
        between = self.T_cam_world @ se3.inverse(other.T_cam_world)
        far = np.linalg.norm(between[:3, 3]) > APART_DEPTHS * max(self.depth, other.depth)
        return bool(far or se3.rotation_angle(between) > APART)


def sight(place: Recognised) -> Sight:
    """What a place that was recognised gives."""
    return Sight(place.T_cam_world, place.share, place.depth)


def ambiguous(
    world: Map,
    seen: Observations,
    known: dict[int, Sight],
    among: Slots,
    settings: BackendSettings,
    seed: int,
    possible: Callable[[int, Array], bool] = lambda _, __: True,
) -> bool:
    """Whether a frame's features are found in two places of one island.

    Args:
        world: The map.
        seen: The features.
        known: What is known of the frame's pose, by island.
        among: Slots of the keyframes whose places may be others.
        settings: Of tracking and relocalisation.
        seed: Founds RANSAC's draws.
        possible: Whether the frame can have been taken on an island of this number with this world-to-camera pose.
    """
    enough = RIVAL * max(each.share for each in known.values())
    for island in np.unique(world.kf_island[among]).tolist():
        sights = [known[island]] if island in known else []
        slots = among[world.kf_island[among] == island]
        for slot in most_alike(world, slots, seen, LOOKED_AT):
            other = _seen_from(world, slot, seen, settings, seed)
            if other is None or other.share < enough or not possible(island, other.T_cam_world):
                continue
            if any(each.contradicts(other) for each in sights):
                return True
            sights.append(other)
    return False


def _seen_from(world: Map, slot: int, seen: Observations, settings: BackendSettings, seed: int) -> Sight | None:
    """The pose by a keyframe's surroundings, if it shows enough of them."""
    matches = match_keyframe(world, slot, seen, settings.relocalisation.max_distance)
    if len(matches) < FEWEST // 2:
        return None
    f, rng = matches.feature, stream(seed, "lookalikes", int(world.kf_id[slot]))
    found = ransac_pose(
        matches.position, seen.xy[f], seen.info[f], world.camera, settings.relocalisation.iterations, rng
    )
    if found is None or np.count_nonzero(found[1]) < FEWEST // 3:
        return None
    place = recognise(world, slot, seen, matches.select(found[1]), found[0], settings.tracking)
    return sight(place) if len(place.matches) >= FEWEST else None
