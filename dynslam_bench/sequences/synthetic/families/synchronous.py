"""Two people who step from side to side in time with the camera: in its image they stand still."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial

import numpy as np

from dynslam_bench.core.seeding import stream

from ..arithmetic import product, sin
from ..people.bodies import Posture, draw_person
from ..scenes.camera_paths import EYE_HEIGHT_M, TILT_RAD, camera_axes, hand, rotations
from ..scenes.plan import pick, plan_room
from ..scenes.room import build_room
from ..scenes.world import Actor, Array, World
from .family import Family
from .twins import window_of


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


def build_synchronous(variant: str, instance: int) -> World:
    """The office, two people side by side, and a camera that goes with them."""
    plan, rng = plan_room(instance), stream(instance, "synthetic", "synchronous")
    step = Step(pick(rng, instance, 0.5, 0.6), pick(rng, instance, 4.4, 5.2), pick(rng, instance, 0.0, 1.0))
    places = ((-pick(rng, instance, 0.3, 0.36), pick(rng, instance, 1.2, 1.3)), (pick(rng, instance, 0.28, 0.34), 1.35))
    actors = tuple(Actor(draw_person(instance, k), partial(_stepping, step, place)) for k, place in enumerate(places))
    return World(build_room(instance, plan), partial(_camera, step, instance), window_of(plan), actors=actors)


def _stepping(step: Step, place: tuple[float, float], time: float) -> Posture:
    x, ahead = step.at(np.array([time, time + 0.05]))
    gait = min(abs(ahead - x) / 0.05 / 0.9, 1.0)
    return Posture(place[0] + x, place[1], 180.0, 2 * x * 2 * math.pi / 1.35, 0.4 * gait, 0.0, 0.1, time)


def _camera(step: Step, instance: int, times: Array) -> Array:
    rng, t = stream(instance, "synthetic", "camera", "synchronous"), np.asarray(times, dtype=np.float64)
    poses = np.tile(np.eye(4), (len(t), 1, 1))
    poses[:, :3, :3] = product(camera_axes(TILT_RAD), rotations(hand(rng, t, math.radians(0.5), 3)))
    poses[:, :3, 3] = hand(rng, t, 0.004, 3) + np.array([0.0, 0.0, EYE_HEIGHT_M])
    poses[:, 0, 3] += step.at(t)
    return poses


SYNCHRONOUS = Family("synchronous", ("",), build_synchronous, ("high-dynamic",))
