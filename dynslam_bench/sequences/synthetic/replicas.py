"""Families of rendered sequences in the office.

Replicas of TUM's fr3 dynamic sequences, a crowd, people who step in time with the camera, and conditions that sensors
dislike.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import TypeVar

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
    rotations,
)
from dynslam_bench.sequences.synthetic.parts import Parts, turn
from dynslam_bench.sequences.synthetic.people import (
    ChairKey,
    Key,
    Posture,
    chair_place,
    draw_person,
    posture,
    write_script,
)
from dynslam_bench.sequences.synthetic.rooms import (
    Plan,
    add_chair,
    add_floor,
    add_wall,
    build_room,
    office_bay,
    pick,
    plan_room,
)
from dynslam_bench.sequences.synthetic.scene import Actor, Array, Body, Optics, World
from dynslam_bench.sequences.synthetic.settings import DEFAULT_FRAMES

Value = TypeVar("Value", int, tuple[str, ...])


@dataclass(frozen=True)
class Family:
    """Rendered sequences of one kind, ``synthetic/<name>_<variant>``.

    Attributes:
        name: First part of the ids.
        variants: Second parts; empty for the name alone.
        build: Variant and scene number to the world that is filmed.
        tags: As in the catalogue: ``static``, ``low-dynamic``, ``high-dynamic``; of each variant, or of all.
        frames: Default length of each variant, or of all.
        versions: Raised whenever any pixel, pose or mask changes; of each variant, or of all.
    """

    name: str
    variants: tuple[str, ...]
    build: Callable[[str, int], World]
    tags: tuple[str, ...] | dict[str, tuple[str, ...]]
    frames: int | dict[str, int] = DEFAULT_FRAMES
    versions: int | dict[str, int] = 1

    def length(self, variant: str) -> int:
        """Default number of frames of a variant."""
        return _of(self.frames, variant)

    def version(self, variant: str) -> int:
        """Version of a variant."""
        return _of(self.versions, variant)

    def tags_of(self, variant: str) -> tuple[str, ...]:
        """How much moves in a variant."""
        return _of(self.tags, variant)

    def ids(self) -> list[str]:
        """All ids, for example ``synthetic/walking_xyz``."""
        return [f"synthetic/{self.name}" + (f"_{variant}" if variant else "") for variant in self.variants]


def _of(values: Value | dict[str, Value], variant: str) -> Value:
    return values[variant] if isinstance(values, dict) else values


# Replicas of TUM's fr3 dynamic sequences: two people who walk or sit in an office, four camera motions.


def build_replica(people: str, motion: str, scene: int) -> World:
    """The office with its two people and two chairs."""
    plan, script = plan_room(scene), write_script(people, scene)
    return World(
        static=build_room(scene, plan),
        camera=partial(camera_poses, motion, people, scene),
        window=window_of(plan),
        bodies=tuple(
            Body(3 + k, "chair", chair(plan, 3 + k, 1.0 if k == 0 else 0.8), partial(_roll, keys, script.period))
            for k, keys in enumerate(script.chairs)
        ),
        actors=tuple(
            Actor(draw_person(scene, k), partial(posture, keys, script.period)) for k, keys in enumerate(script.people)
        ),
    )


def chair(plan: Plan, instance: int, shade: float = 1.0) -> Parts:
    """An office chair in the plan's colours, facing -y about its own origin."""
    parts = Parts()
    add_chair(parts, instance, plan.tints["chair"] * shade, plan.tints["metal"])
    return parts


def window_of(plan: Plan) -> tuple[float, float, float]:
    """Beside the back wall, where glare comes from."""
    return plan.left_x * 0.55, plan.back_y, 2.15


def _roll(keys: tuple[ChairKey, ...], period: float, time: float) -> tuple[Array, Array]:
    x, y, facing = chair_place(keys, period, time)
    return turn(facing + 180.0), np.array([x, y, 0.0])


WALKING = Family("walking", MOTIONS, partial(build_replica, "walking"), ("high-dynamic",), versions=0)
SITTING = Family("sitting", MOTIONS, partial(build_replica, "sitting"), ("low-dynamic",), versions=0)


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
    rng = stream(scene, "synthetic", "crowd", number)
    reach, pause = pick(rng, scene, 1.0, 1.45), pick(rng, scene, 0.8, 2.0)
    stop, cross = pick(rng, scene, -0.5, 0.5), pick(rng, scene, 2.6, 3.4)
    side = 1.0 if number % 2 else -1.0
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
    return Actor(person, lambda time: replace(posture(keys, period, time + start), clock=time))


CROWD = Family("crowd", ("xyz", "static"), build_crowd, ("high-dynamic",))


# Two people who step from side to side in time with the camera: in its image they stand still.


@dataclass(frozen=True)
class Step:
    """The common motion: along x, metres, with rests at both ends."""

    reach: float
    period: float
    phase: float

    def at(self, times: Array) -> Array:
        """Offset along x at times (seconds)."""
        swing = sin(2 * math.pi * (np.asarray(times) / self.period + self.phase))
        return np.asarray(self.reach * swing * (1.5 - 0.5 * swing * swing))


def build_synchronous(variant: str, scene: int) -> World:
    """The office, two people side by side, and a camera that moves with them."""
    plan, rng = plan_room(scene), stream(scene, "synthetic", "synchronous")
    step = Step(pick(rng, scene, 0.5, 0.6), pick(rng, scene, 4.4, 5.2), pick(rng, scene, 0.0, 1.0))
    places = ((-pick(rng, scene, 0.3, 0.36), pick(rng, scene, 1.2, 1.3)), (pick(rng, scene, 0.28, 0.34), 1.35))
    actors = tuple(Actor(draw_person(scene, k), partial(_stepping, step, place)) for k, place in enumerate(places))
    return World(build_room(scene, plan), partial(_camera, step, scene), window_of(plan), actors=actors)


def _stepping(step: Step, place: tuple[float, float], time: float) -> Posture:
    x, ahead = step.at(np.array([time, time + 0.05]))
    gait = min(abs(ahead - x) / 0.05 / 0.9, 1.0)
    return Posture(place[0] + x, place[1], 180.0, 2 * x * 2 * math.pi / 1.35, 0.4 * gait, 0.0, 0.1, time)


def _camera(step: Step, scene: int, times: Array) -> Array:
    rng, t = stream(scene, "synthetic", "camera", "synchronous"), np.asarray(times, dtype=np.float64)
    poses = np.tile(np.eye(4), (len(t), 1, 1))
    poses[:, :3, :3] = product(camera_axes(TILT_RAD), rotations(hand(rng, t, math.radians(0.5), 3)))
    poses[:, :3, 3] = hand(rng, t, 0.004, 3) + np.array([0.0, 0.0, EYE_HEIGHT_M])
    poses[:, 0, 3] += step.at(t)
    return poses


SYNCHRONOUS = Family("synchronous", ("",), build_synchronous, ("high-dynamic",))


# What the sensors dislike: little light, little texture, little depth, depth as in sunlight.

DARK = Optics(gain=0.13, color={"read_noise": 2.4, "shot_noise": 0.12, "shutter": 0.8})
SUNLIGHT = Optics(gain=1.25, depth={"disparity_noise_px": 0.25, "far_m": 4.0, "dark": 0.1, "edge_px": 4})


def build_condition(alter: Callable[[World, int], World], variant: str, scene: int) -> World:
    """The replica of a walking sequence under a condition, with a camera path of its own."""
    world = alter(build_replica("walking", "xyz", scene), scene)
    camera = partial(camera_poses, "halfsphere", "conditions", scene)
    if variant == "walking":
        return replace(world, camera=camera)
    return replace(world, camera=camera, actors=(), bodies=())


def _plain(world: World, scene: int) -> World:
    """The same things without a pattern."""
    room = Parts()
    room.extend(world.static)
    room.texture = [tuple("plain" for _ in row) for row in room.texture]
    return replace(world, static=room)


def _hall(world: World, scene: int) -> World:
    """A hall whose walls and furniture stand beyond the depth sensor's reach."""
    plan, room, x, front, back = plan_room(scene, 0), Parts(), 7.0, -3.0, 8.6
    add_floor(room, (-x, front), (x, back), plan)
    for start, end in (((-x, front), (x, front)), ((x, front), (x, back)), ((x, back), (-x, back)),
                       ((-x, back), (-x, front))):  # fmt: skip
        add_wall(room, start, end, plan)
    for k in range(3):
        room.extend(office_bay(scene, k), 0.0, ((k - 1) * 4.3, back - 0.05, 0.0), f"/{k}")
    for k, side in enumerate((-1, 1)):
        room.extend(office_bay(scene, 3 + k), -90.0 * side, (side * (x - 0.05), 5.0, 0.0), f"/{3 + k}")
    return replace(world, static=room, window=(0.0, back, 2.15))


def _seen_by(optics: Optics) -> Callable[[World, int], World]:
    return lambda world, _: replace(world, optics=optics)


_TAGS: dict[str, tuple[str, ...]] = {"empty": ("static",), "walking": ("high-dynamic",)}

CONDITIONS = tuple(
    Family(name, tuple(_TAGS), partial(build_condition, alter), _TAGS)
    for name, alter in (("dark", _seen_by(DARK)), ("blank", _plain), ("far", _hall), ("outdoor", _seen_by(SUNLIGHT)))
)
