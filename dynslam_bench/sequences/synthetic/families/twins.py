"""The twins of TUM's fr3 dynamic sequences: two people who walk, or sit, in an office, four motions of the camera."""

from __future__ import annotations

from functools import partial

import numpy as np

from ..people.bodies import draw_person
from ..people.script import ChairKey, chair_place, posture, write_script
from ..scenes.camera_paths import MOTIONS, camera_poses
from ..scenes.furniture import add_chair
from ..scenes.parts import Parts, turn
from ..scenes.plan import Plan, plan_room
from ..scenes.room import build_room
from ..scenes.world import Actor, Array, Body, World
from .family import Family


def build_twin(people: str, motion: str, instance: int) -> World:
    """The office with its two people and two chairs."""
    plan, script = plan_room(instance), write_script(people, instance)
    return World(
        room=build_room(instance, plan),
        camera=partial(camera_poses, motion, people, instance),
        window=window_of(plan),
        bodies=tuple(
            Body(3 + k, "chair", chair(plan, 3 + k, 1.0 if k == 0 else 0.8), partial(_roll, keys, script.period))
            for k, keys in enumerate(script.chairs)
        ),
        actors=tuple(
            Actor(draw_person(instance, k), partial(posture, keys, script.period))
            for k, keys in enumerate(script.people)
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


WALKING = Family("walking", MOTIONS, partial(build_twin, "walking"), ("high-dynamic",), versions=0)
SITTING = Family("sitting", MOTIONS, partial(build_twin, "sitting"), ("low-dynamic",), versions=0)
