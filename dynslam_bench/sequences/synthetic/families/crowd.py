"""Four people who walk past each other all the time and hide most of the view."""

from __future__ import annotations

import itertools
from dataclasses import replace
from functools import partial

from dynslam_bench.core.seeding import stream

from ..people.bodies import draw_person
from ..people.script import Key, posture
from ..scenes.camera_paths import camera_poses
from ..scenes.plan import pick, plan_room
from ..scenes.room import build_room
from ..scenes.world import Actor, World
from .family import Family
from .twins import window_of

LANES_M = (1.0, 1.27, 1.54, 1.8)
"""Distance of each person's way from the camera's plumb line: nobody walks through another."""


def build_crowd(motion: str, instance: int) -> World:
    """The office, and people on lanes."""
    plan = plan_room(instance)
    actors = tuple(_walker(instance, k, lane) for k, lane in enumerate(LANES_M))
    camera = partial(camera_poses, motion, "crowd", instance)
    return World(build_room(instance, plan), camera, window_of(plan), actors=actors)


def _walker(instance: int, number: int, lane: float) -> Actor:
    """To and fro on a lane, with a stop in the middle where the person turns to the camera and talks."""
    rng = stream(instance, "synthetic", "crowd", number)
    reach, pause = pick(rng, instance, 1.0, 1.45), pick(rng, instance, 0.8, 2.0)
    stop, cross = pick(rng, instance, -0.5, 0.5), pick(rng, instance, 2.6, 3.4)
    side = 1.0 if number % 2 else -1.0
    stations = [(0.0, -side * reach, side, 0.0), (cross * 0.5, side * stop, side, 0.0), (pause, side * stop, 0, 1.0)]
    stations += [(cross * 0.5, side * reach, side, 0.0), (0.7, side * reach, -side, 0.0)]
    stations += [(cross, -side * reach, -side, 0.0), (0.6, -side * reach, side, 0.0)]
    times = itertools.accumulate(station[0] for station in stations)
    keys = tuple(
        Key(t, x, lane, 180.0 - 90.0 * way if way else 180.0, 0, talk)
        for t, (_, x, way, talk) in zip(times, stations, strict=True)
    )
    period = keys[-1].t
    start = pick(rng, instance, 0.0, period)
    person = replace(draw_person(instance, number), instance=number + 1)
    return Actor(person, lambda time: replace(posture(keys, period, time + start), clock=time))


CROWD = Family("crowd", ("xyz", "static"), build_crowd, ("high-dynamic",))
