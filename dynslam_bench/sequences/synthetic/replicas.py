"""Rendered sequences in the office.

Replicas of TUM's fr3 dynamic sequences, a crowd, people who step in time with the camera, and conditions that sensors
dislike.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from dynslam_bench.core.seeding import stream
from dynslam_bench.sequences.synthetic.arithmetic import product, sin
from dynslam_bench.sequences.synthetic.camera_paths import (
    EYE_HEIGHT_M,
    MOTIONS,
    TILT_RAD,
    camera_axes,
    camera_poses,
    hand,
    poses_of,
    rotations,
)
from dynslam_bench.sequences.synthetic.parts import Key, Parts, angle_between, between, ease, turn
from dynslam_bench.sequences.synthetic.people import Posture, draw_person, posture, write_script
from dynslam_bench.sequences.synthetic.rooms import (
    Plan,
    add_floor,
    add_wall,
    build_room,
    office_bay,
    office_chair,
    pick,
    plan_room,
)
from dynslam_bench.sequences.synthetic.scene import Actor, Array, Body, Optics, Variant, World

# Replicas of TUM's fr3 dynamic sequences: two people who walk or sit in an office, four camera motions.


def build_replica(people: str, motion: str, scene: int) -> World:
    """The office with its two people and two chairs."""
    plan, script = plan_room(scene), write_script(people, scene)
    return World(
        static=build_room(scene, plan),
        camera=partial(camera_poses, motion, people, scene),
        window=window_of(plan),
        bodies=tuple(
            Body(3 + k, "chair", office_chair(plan, 3 + k, (1.0, 0.8)[k]), partial(_roll, keys, script.period))
            for k, keys in enumerate(script.chairs)
        ),
        actors=tuple(
            (draw_person(scene, k), partial(posture, keys, script.period)) for k, keys in enumerate(script.people)
        ),
    )


def window_of(plan: Plan) -> tuple[float, float, float]:
    """Beside the back wall, where glare comes from."""
    return plan.left_x * 0.55, plan.back_y, 2.15


def _roll(keys: tuple[Key, ...], period: float, time: float) -> tuple[Array, Array]:
    a, b, share = between(keys, time % period)
    e = ease(share)
    place = np.array([a.x + e * (b.x - a.x), a.y + e * (b.y - a.y), 0.0])
    return turn(angle_between(a.facing, b.facing, e) + 180.0), place


REPLICAS = {
    f"{people}_{motion}": Variant(partial(build_replica, people, motion), tag, version=0)
    for people, tag in (("walking", "high-dynamic"), ("sitting", "low-dynamic"))
    for motion in MOTIONS
}


# Four people who walk past each other all the time and hide most of the view.

LANES_M = (1.0, 1.27, 1.54, 1.8)
"""Distance of each person's path from the camera's plumb line: no two people cross."""


def build_crowd(motion: str, scene: int) -> World:
    """The office, and people on lanes."""
    plan = plan_room(scene)
    actors = tuple(_walker(scene, k, lane) for k, lane in enumerate(LANES_M))
    camera = partial(camera_poses, motion, "crowd", scene)
    return World(build_room(scene, plan), camera, window_of(plan), actors=actors)


def _walker(scene: int, number: int, lane: float) -> Actor:
    """To and fro on a lane, with a stop in the middle where the person turns to the camera and talks."""
    rng, side = stream(scene, "synthetic", "crowd", number), 1.0 if number % 2 else -1.0
    reach, pause = pick(rng, scene, 1.0, 1.45), pick(rng, scene, 0.8, 2.0)
    stop, cross = pick(rng, scene, -0.5, 0.5), pick(rng, scene, 2.6, 3.4)
    stations = [(0.0, -side * reach, side, 0.0), (cross * 0.5, side * stop, side, 0.0), (pause, side * stop, 0, 1.0)]
    stations += [(cross * 0.5, side * reach, side, 0.0), (0.7, side * reach, -side, 0.0)]
    stations += [(cross, -side * reach, -side, 0.0), (0.6, -side * reach, side, 0.0)]
    times = itertools.accumulate(station[0] for station in stations)
    keys = tuple(
        Key(t, x, lane, 180.0 - 90.0 * direction if direction else 180.0, 0, talk)
        for t, (_, x, direction, talk) in zip(times, stations, strict=True)
    )
    period = keys[-1].t
    start = pick(rng, scene, 0.0, period)
    person = replace(draw_person(scene, number), instance=number + 1)
    return person, lambda time: replace(posture(keys, period, time + start), clock=time)


CROWDS = {f"crowd_{motion}": Variant(partial(build_crowd, motion), "high-dynamic") for motion in ("xyz", "static")}


# Two people who step from side to side in time with the camera: in its image they stand still.


@dataclass(frozen=True)
class Step:
    """The common motion: along x, metres, with rests at both ends."""

    reach: float
    period: float
    phase: float

    def at(self, times: Array) -> Array:
        """Offset along x at times (seconds)."""
        swing = sin(2 * math.pi * (times / self.period + self.phase))
        return np.asarray(self.reach * swing * (1.5 - 0.5 * swing * swing))


def build_synchronous(scene: int) -> World:
    """The office, two people side by side, and a camera that moves with them."""
    plan, rng = plan_room(scene), stream(scene, "synthetic", "synchronous")
    step = Step(pick(rng, scene, 0.5, 0.6), pick(rng, scene, 4.4, 5.2), pick(rng, scene, 0.0, 1.0))
    places = ((-pick(rng, scene, 0.3, 0.36), pick(rng, scene, 1.2, 1.3)), (pick(rng, scene, 0.28, 0.34), 1.35))
    actors = tuple((draw_person(scene, k), partial(_stepping, step, place)) for k, place in enumerate(places))
    return World(build_room(scene, plan), partial(_camera, step, scene), window_of(plan), actors=actors)


def _stepping(step: Step, place: tuple[float, float], time: float) -> Posture:
    x, ahead = step.at(np.array([time, time + 0.05]))
    gait = min(abs(ahead - x) / 0.05 / 0.9, 1.0)
    return Posture(place[0] + x, place[1], 180.0, 2 * x * 2 * math.pi / 1.35, 0.4 * gait, 0.0, 0.1, time)


def _camera(step: Step, scene: int, times: Array) -> Array:
    rng = stream(scene, "synthetic", "camera", "synchronous")
    rotation = product(camera_axes(TILT_RAD), rotations(hand(rng, times, math.radians(0.5), 3)))
    place = hand(rng, times, 0.004, 3) + np.array([0.0, 0.0, EYE_HEIGHT_M])
    place[:, 0] += step.at(times)
    return poses_of(rotation, place)


SYNCHRONOUS = {"synchronous": Variant(build_synchronous, "high-dynamic")}


# What the sensors dislike: little light, little texture, little depth, depth as in sunlight.

Change = Callable[[World, int], World]
DARK = Optics(gain=0.13, color={"read_noise": 2.4, "shot_noise": 0.12, "shutter": 0.8})
SUNLIGHT = Optics(gain=1.25, depth={"disparity_noise_px": 0.25, "far_m": 4.0, "dark": 0.1, "edge_px": 4})


def build_condition(change: Change, people: bool, scene: int) -> World:
    """The replica of a walking sequence under a condition, with a camera path of its own."""
    world = change(build_replica("walking", "xyz", scene), scene)
    world = replace(world, camera=partial(camera_poses, "halfsphere", "conditions", scene))
    return world if people else replace(world, actors=(), bodies=())


def _plain(world: World, scene: int) -> World:
    """The same things without a pattern."""
    return replace(world, static=Parts(replace(part, texture=("plain",) * 6) for part in world.static))


def _hall(world: World, scene: int) -> World:
    """A hall whose walls and furniture stand beyond the depth sensor's reach."""
    plan, hall, x, front, back = plan_room(scene, 0), Parts(), 7.0, -3.0, 8.6
    add_floor(hall, (-x, front), (x, back), plan)
    for start, end in (((-x, front), (x, front)), ((x, front), (x, back)), ((x, back), (-x, back)),
                       ((-x, back), (-x, front))):  # fmt: skip
        add_wall(hall, start, end, plan)
    places = [(0.0, ((k - 1) * 4.3, back - 0.05, 0.0)) for k in range(3)]
    places += [(-90.0 * side, (side * (x - 0.05), 5.0, 0.0)) for side in (-1, 1)]
    for k, (yaw, at) in enumerate(places):
        hall.add_copies(office_bay(scene, k), yaw, at, f"/{k}")
    return replace(world, static=hall, window=(0.0, back, 2.15))


_CHANGES: dict[str, Change] = {
    "dark": lambda world, _: replace(world, optics=DARK),
    "blank": _plain,
    "far": _hall,
    "outdoor": lambda world, _: replace(world, optics=SUNLIGHT),
}
CONDITIONS = {
    f"{name}_{kind}": Variant(partial(build_condition, change, kind == "walking"), tag)
    for name, change in _CHANGES.items()
    for kind, tag in (("empty", "static"), ("walking", "high-dynamic"))
}
