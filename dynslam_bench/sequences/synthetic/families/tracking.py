"""The camera follows a person around a room, as in Bonn's person tracking."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial

import numpy as np

from dynslam_bench.core.seeding import stream

from ..arithmetic import atan2
from ..people.bodies import Posture, draw_person
from ..scenes.plan import pick
from ..scenes.walks import Walk, walking_camera
from ..scenes.world import Actor, World
from .family import Family
from .loop import build_loop


def build_tracking(variant: str, instance: int) -> World:
    """The hall of the loops, walked by a person and, two metres behind, the camera."""
    hall, rng = build_loop("room", instance), stream(instance, "synthetic", "tracking")
    walk: Walk = hall.camera.args[0]  # type: ignore[attr-defined]  # a partial of `walking_camera`
    lead_s = pick(rng, instance, 1.7, 2.0) / 0.45
    person = draw_person(instance, 0)
    actor = Actor(replace(person, instance=len(hall.bodies) + 1), partial(_walking, walk, lead_s))
    camera = partial(walking_camera, walk, instance, "tracking", 6.0)
    return World(hall.room, camera, hall.window, hall.bodies, (actor,))


def _walking(walk: Walk, lead_s: float, time: float) -> Posture:
    place, ahead = walk.at(np.array([time + lead_s, time + lead_s + 0.3]))
    way = ahead - place
    facing = math.degrees(atan2(way[1], way[0])) - 90.0
    stride = 0.45 * (time + lead_s) * 2 * math.pi / 1.0
    return Posture(float(place[0]), float(place[1]), facing, stride, 0.6, 0.0, 0.0, time)


TRACKING = Family("tracking", ("",), build_tracking, ("high-dynamic",), 1200)
