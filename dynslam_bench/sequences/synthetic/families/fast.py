"""The tempo of TUM's fr1: turns of 1-3 rad/s, motion blur, a rolling shutter and automatic exposure."""

from __future__ import annotations

import math
from functools import partial

import numpy as np

from dynslam_bench.core.seeding import stream

from ..arithmetic import product, sin
from ..scenes.camera_paths import EYE_HEIGHT_M, TILT_RAD, camera_axes, hand, rotations
from ..scenes.plan import pick, plan_room
from ..scenes.room import build_room
from ..scenes.world import Array, Optics, World
from .family import Family
from .loop import build_loop
from .twins import build_twin, window_of

OPTICS = Optics(readout_s=0.026, auto_exposure=0.7, color={"shutter": 0.3})
"""26 ms from the first row to the last, as in the first Kinect."""

SWINGS: dict[str, tuple[tuple[float, ...], tuple[float, ...]]] = {
    "desk": ((0.17, 0.12, 0.14), (0.26, 0.46, 0.26)),
    "rpy": ((0.03, 0.03, 0.03), (0.3, 0.52, 0.38)),
    "spin": ((0.14, 0.08, 0.14), (0.12, 0.25, 0.12)),
    "walking": ((0.15, 0.1, 0.1), (0.24, 0.44, 0.26)),
}
"""Amplitudes of each variant: right, down, forward in metres; pitch, yaw, roll in radians."""


def build_fast(variant: str, instance: int) -> World:
    """The office, with nobody or the walking people, or the hall of the loops."""
    camera = partial(fast_camera, variant, instance)
    if variant == "walking":
        twin = build_twin("walking", "xyz", instance)
        return World(twin.room, camera, twin.window, twin.bodies, twin.actors, OPTICS)
    if variant == "spin":
        hall = build_loop("room", instance)
        return World(hall.room, camera, hall.window, hall.bodies, optics=OPTICS)
    plan = plan_room(instance)
    return World(build_room(instance, plan), camera, window_of(plan), optics=OPTICS)


def fast_camera(variant: str, instance: int, times: Array) -> Array:
    """Poses ``[N, 4, 4]``: sines of several frequencies along and about all axes; `spin` also turns round and round."""
    rng, t = stream(instance, "synthetic", "camera", "fast", variant), np.asarray(times, dtype=np.float64)
    shifts, turns = SWINGS[variant]
    offset, angles = hand(rng, t, 0.006, 3), hand(rng, t, math.radians(0.8), 3)
    for amplitudes, values in ((shifts, offset), (turns, angles)):
        for axis, amplitude in enumerate(amplitudes):
            main, second = pick(rng, instance, 0.45, 0.7), pick(rng, instance, 0.8, 1.1)
            values[:, axis] += 0.75 * amplitude * sin(2 * math.pi * (main * t + rng.random()))
            values[:, axis] += 0.4 * amplitude * sin(2 * math.pi * (second * t + rng.random()))
    yaw, place = np.zeros((len(t), 3)), np.array([0.0, 0.0, EYE_HEIGHT_M])
    if variant == "spin":
        yaw[:, 2] = pick(rng, instance, 1.3, 1.6) * t
        place = np.array([2.7, 0.2, EYE_HEIGHT_M])
    poses = np.tile(np.eye(4), (len(t), 1, 1))
    base = product(rotations(yaw), camera_axes(TILT_RAD))
    poses[:, :3, :3] = product(base, rotations(angles))
    poses[:, :3, 3] = place + product(base, offset[..., None])[..., 0]
    return poses


FAST = Family(
    "fast", tuple(SWINGS), build_fast, {name: ("high-dynamic" if name == "walking" else "static",) for name in SWINGS}
)
