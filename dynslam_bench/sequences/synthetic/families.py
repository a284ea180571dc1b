"""The rendered sequences, family by family: what stands and moves in each, and how its camera moves.

Here are replicas of TUM's fr3 dynamic sequences, a crowd, people who step in time with the camera,
conditions that sensors dislike, scenes that change, a followed person, and the tempo of TUM's fr1.
Moving objects after Bonn's are in `moving_objects`, long paths that return in `buildings`.
"""

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from dynslam_bench.core.seeding import stream
from dynslam_bench.geometry import se3
from dynslam_bench.sequences.synthetic.arithmetic import Array, atan2, product, sin
from dynslam_bench.sequences.synthetic.buildings import HALL_SPEED, build_loop, build_walk
from dynslam_bench.sequences.synthetic.camera_paths import (
    EYE_HEIGHT_M,
    MOTIONS,
    TILT_RAD,
    Walk,
    camera_axes,
    camera_poses,
    hand,
    rotations,
    walking_camera,
)
from dynslam_bench.sequences.synthetic.parts import (
    Key,
    angle_between,
    between,
    copies,
    ease,
    rotation_about_z,
)
from dynslam_bench.sequences.synthetic.people import (
    FULL_GAIT_M_S,
    STRIDE_M,
    Person,
    Posture,
    draw_person,
    posture,
    write_script,
)
from dynslam_bench.sequences.synthetic.rooms import (
    build_room,
    floor,
    glare_window,
    office_bay,
    office_chair,
    partition,
    pick,
    plan_room,
)
from dynslam_bench.sequences.synthetic.scene import Actor, Body, Optics, Variant, World
from dynslam_bench.sequences.tags import Tag

# Replicas of TUM's fr3 dynamic sequences: two people who walk or sit in an office, four camera
# motions.


def build_replica(people: str, motion: str, scene: int) -> World:
    """The office with its two people and two chairs."""
    plan = plan_room(scene)
    script = write_script(people, scene)
    chairs = []
    for k, keys in enumerate(script.chairs):
        parts = office_chair(plan, 3 + k, (1.0, 0.8)[k])
        chairs.append(Body(3 + k, "chair", parts, partial(_roll, keys, script.period)))
    actors = [
        (draw_person(scene, k), partial(posture, keys, script.period))
        for k, keys in enumerate(script.people)
    ]
    return World(
        static=build_room(scene, plan),
        camera=partial(camera_poses, motion, people, scene),
        window=glare_window(plan),
        bodies=tuple(chairs),
        actors=tuple(actors),
    )


def _roll(keys: tuple[Key, ...], period: float, time: float) -> tuple[Array, Array]:
    """Rotation and origin of a chair at a time."""
    a, b, share = between(keys, time % period)
    e = ease(share)
    place = np.array([a.x + e * (b.x - a.x), a.y + e * (b.y - a.y), 0.0])
    return rotation_about_z(angle_between(a.facing, b.facing, e) + 180.0), place


REPLICAS = {
    f"{people}_{motion}": Variant(
        partial(build_replica, people, motion),
        "high-dynamic" if people == "walking" else "low-dynamic",
        version=0,
    )
    for people in ("walking", "sitting")
    for motion in MOTIONS
}
"""Replicas of TUM's fr3 sequences."""


# Four people who walk past each other all the time and hide most of the view.

LANES_M = (1.0, 1.27, 1.54, 1.8)
"""Distance of each person's path from the camera's plumb line: no two people cross."""


def build_crowd(motion: str, scene: int) -> World:
    """The office, and people on lanes."""
    plan = plan_room(scene)
    actors = tuple(_walker(scene, k, lane) for k, lane in enumerate(LANES_M))
    camera = partial(camera_poses, motion, "crowd", scene)
    return World(build_room(scene, plan), camera, glare_window(plan), actors=actors)


def _walker(scene: int, number: int, lane: float) -> Actor:
    """A person on a lane, at a drawn place from the start."""
    rng, person, keys = _lane_keys(scene, number, lane)
    start = pick(rng, scene, 0.0, keys[-1].t)
    return person, lambda time: replace(posture(keys, keys[-1].t, time + start), clock=time)


def _lane_keys(
    scene: int, number: int, lane: float
) -> tuple[np.random.Generator, Person, tuple[Key, ...]]:
    """To and fro on a lane, with a stop in the middle where the person turns to the camera and talks."""
    rng = stream(scene, "synthetic", "crowd", number)
    # where the person turns (m), how long they stop (s), where, and how long a crossing takes (s)
    side = 1.0 if number % 2 else -1.0
    reach = pick(rng, scene, 1.0, 1.45)
    pause = pick(rng, scene, 0.8, 2.0)
    stop = pick(rng, scene, -0.5, 0.5)
    cross = pick(rng, scene, 2.6, 3.4)
    # Duration of the way there, x, direction along x (0: towards the camera), and gesture.
    stations = [
        (0.0, -side * reach, side, 0.0),
        (cross * 0.5, side * stop, side, 0.0),
        (pause, side * stop, 0, 1.0),
        (cross * 0.5, side * reach, side, 0.0),
        (0.7, side * reach, -side, 0.0),
        (cross, -side * reach, -side, 0.0),
        (0.6, -side * reach, side, 0.0),
    ]
    # keys at the ends of these stretches; 180 degrees is towards the camera
    times = itertools.accumulate(station[0] for station in stations)
    keys = tuple(
        Key(t, x, lane, 180.0 - 90.0 * direction if direction else 180.0, 0, talk)
        for t, (_, x, direction, talk) in zip(times, stations, strict=True)
    )
    return rng, replace(draw_person(scene, number), instance=number + 1), keys


CROWDS = {
    f"crowd_{motion}": Variant(partial(build_crowd, motion), "high-dynamic")
    for motion in ("xyz", "static")
}


# Two people who step from side to side in time with the camera: in its image they stand still.


Step = Callable[[Array], Array]
"""The common motion: times in seconds to the offset along x in metres."""
DT_S = 0.05
"""Time over which the speed of a side-step is measured."""


def _step(reach: float, period: float, phase: float, times: Array) -> Array:
    """To and fro, with rests at both ends."""
    # flattened at both ends, where the person rests
    swing = sin(2 * math.pi * (times / period + phase))
    return np.asarray(reach * swing * (1.5 - 0.5 * swing * swing))


def build_synchronous(scene: int) -> World:
    """The office, two people side by side, and a camera that moves with them."""
    # the common motion: reach (m), period (s) and phase (turns)
    plan = plan_room(scene)
    rng = stream(scene, "synthetic", "synchronous")
    reach = pick(rng, scene, 0.5, 0.6)
    period = pick(rng, scene, 4.4, 5.2)
    phase = pick(rng, scene, 0.0, 1.0)
    step = partial(_step, reach, period, phase)
    # two places in front of the camera (x, y in m), and who stands there
    left = (-pick(rng, scene, 0.3, 0.36), pick(rng, scene, 1.2, 1.3))
    right = (pick(rng, scene, 0.28, 0.34), 1.35)
    actors = tuple(
        (draw_person(scene, k), partial(_stepping_posture, step, place))
        for k, place in enumerate((left, right))
    )
    camera = partial(_stepping_camera, step, scene)
    return World(build_room(scene, plan), camera, glare_window(plan), actors=actors)


def _stepping_posture(step: Step, place: tuple[float, float], time: float) -> Posture:
    """Posture at `time` (s) of a person at `place` (x, y, m) who faces the camera and follows the common motion."""
    x, x_later = step(np.array([time, time + DT_S]))
    gait = min(abs(x_later - x) / DT_S / FULL_GAIT_M_S, 1.0)
    return Posture(
        x=place[0] + x,
        y=place[1],
        facing=180.0,
        # side-steps are half as long as steps forward, and the legs swing less
        stride=2 * x * 2 * math.pi / STRIDE_M,
        gait=0.4 * gait,
        sit=0.0,
        gesture=0.1,
        clock=time,
    )


def _stepping_camera(step: Step, scene: int, times: Array) -> Array:
    """Poses ``[N, 4, 4]`` of a camera that is held by hand and moves with the people."""
    rng = stream(scene, "synthetic", "camera", "synchronous")
    rotation = product(camera_axes(TILT_RAD), rotations(hand(rng, times, math.radians(0.5), 3)))
    place = hand(rng, times, 0.004, 3) + np.array([0.0, 0.0, EYE_HEIGHT_M])
    place[:, 0] += step(times)
    return se3.from_matrix(place, rotation)


SYNCHRONOUS = {"synchronous": Variant(build_synchronous, "high-dynamic")}


# What the sensors dislike: little light, little texture, little depth, depth as in sunlight.

Change = Callable[[World, int], World]
"""Change that a condition makes to the world of a scene, given by its number."""
# sensors under a condition
DARK = Optics(gain=0.13, color={"read_noise": 2.4, "shot_noise": 0.12, "shutter": 0.8})
SUNLIGHT = Optics(
    gain=1.25, depth={"disparity_noise_px": 0.25, "far_m": 4.0, "dark": 0.1, "edge_px": 4}
)


def build_condition(change: Change, people: bool, scene: int) -> World:
    """The replica of a walking sequence under a condition, with a camera path of its own."""
    world = change(build_replica("walking", "xyz", scene), scene)
    world = replace(world, camera=partial(camera_poses, "halfsphere", "conditions", scene))
    return world if people else replace(world, actors=(), bodies=())


def _hall(world: World, scene: int) -> World:
    """A hall whose walls and furniture stand beyond the depth sensor's reach."""
    plan = plan_room(scene, 0)
    x = 7.0
    front = -3.0
    back = 8.6
    corners = [(-x, front), (x, front), (x, back), (-x, back), (-x, front)]

    # direction in degrees and place of each bay: three along the back wall, one at either side.
    bays = [(0.0, ((k - 1) * 4.3, back - 0.05, 0.0)) for k in range(3)]
    bays += [(-90.0 * side, (side * (x - 0.05), 5.0, 0.0)) for side in (-1, 1)]

    # floor, walls and bays
    hall = floor((-x, front), (x, back), plan)
    for start, end in itertools.pairwise(corners):
        hall += partition(start, end, plan)
    for k, (yaw, at) in enumerate(bays):
        hall += copies(office_bay(scene, k), yaw, at, f"/{k}")
    return replace(world, static=hall, window=(0.0, back, 2.15))


def _dark(world: World, scene: int) -> World:
    """Little light: a small gain and strong noise."""
    return replace(world, optics=DARK)


def _blank(world: World, scene: int) -> World:
    """Everything that does not move is plain."""
    static = [replace(part, texture=("plain",) * 6) for part in world.static]
    return replace(world, static=static)


def _outdoor(world: World, scene: int) -> World:
    """Bright light, in which the depth sensor sees little."""
    return replace(world, optics=SUNLIGHT)


_CHANGES: dict[str, Change] = {"dark": _dark, "blank": _blank, "far": _hall, "outdoor": _outdoor}
CONDITIONS = {
    f"{name}_{kind}": Variant(
        partial(build_condition, change, kind == "walking"),
        "high-dynamic" if kind == "walking" else "static",
    )
    for name, change in _CHANGES.items()
    for kind in ("empty", "walking")
}


# What changes within the sequence: the people, the camera's tempo, the light. The change comes 3 to
# 5 s after the start, one way in the even scenes and the other way in the odd ones.

CHANGING_FRAMES = 240
"""Frames of a sequence that changes: 8 s."""
_CHANGE_S = 0.8
"""Time in which a level changes."""
_TEMPO = 0.4, 3.5
"""The camera's tempo before and after the change, relative to TUM's fr3."""
_LIGHT = 1.0, 0.1
"""Gain of the colour image before and after the change."""
_ENTRY_S = 1.8
"""Time in which a person comes in or leaves."""
_OUTSIDE_M = 3.0
"""Distance from their lane's end at which they wait outside, metres."""


@dataclass(frozen=True)
class Ramp:
    """A level that goes smoothly from one value to another.

    Attributes:
        at_s: When it begins to change.
        before: The level until then.
        after: The level `_CHANGE_S` later.
    """

    at_s: float
    before: float
    after: float

    def level(self, time: float) -> float:
        """The level at a time (seconds)."""
        share = min(max((time - self.at_s) / _CHANGE_S, 0.0), 1.0)
        return self.before + (self.after - self.before) * ease(share)

    def integral(self, times: Array) -> Array:
        """The integral of the level from 0 to each time, seconds."""
        # time after the change begins, and share of the change that has passed
        since = np.maximum(times - self.at_s, 0.0)
        x = np.minimum(since / _CHANGE_S, 1.0)
        # The time after the change, and the integral of `ease` during it.
        eased = np.maximum(since - _CHANGE_S, 0.0) + _CHANGE_S * (x * x * x * (1.0 - 0.5 * x))
        return np.asarray(self.before * times + (self.after - self.before) * eased)


def build_changing(name: str, scene: int) -> World:
    """The office of the replicas: four people who come (or leave), a camera that speeds up, or a light that fades."""
    plan = plan_room(scene)
    rng = stream(scene, "synthetic", "changing", name)
    at_s = pick(rng, scene, 3.0, 5.0)
    # The other way round in odd scenes.
    order = -1 if scene % 2 else 1
    motion = "halfsphere" if name == "tempo" else "xyz"
    camera = partial(camera_poses, motion, "changing", scene)
    world = World(build_room(scene, plan), camera, glare_window(plan))
    # the people come one after the other
    if name == "crowd":
        visitors = [
            _visitor(scene, k, lane, at_s + 0.3 * k, order > 0) for k, lane in enumerate(LANES_M)
        ]
        return replace(world, actors=tuple(visitors))
    # the camera's time runs faster or slower after the change
    if name == "tempo":
        tempo = Ramp(at_s, *_TEMPO[::order])
        return replace(
            world, camera=lambda times: camera(tempo.integral(np.asarray(times, dtype=np.float64)))
        )
    # the light
    return replace(world, optics=Optics(gain=Ramp(at_s, *_LIGHT[::order]).level))


def _visitor(scene: int, number: int, lane: float, at_s: float, comes: bool) -> Actor:
    """A person of the crowd who comes from outside of the view, or leaves it."""
    _, person, keys = _lane_keys(scene, number, lane)

    # from outside to the beginning of the lane, or from there to outside.
    inside = keys[0]
    side = math.copysign(1.0, inside.x)
    facing = 90.0 * side if comes else -90.0 * side
    outside = replace(inside, x=inside.x + side * _OUTSIDE_M, facing=facing)
    if comes:
        first, last = outside, inside
    else:
        first, last = replace(inside, facing=facing), outside
    entry = (replace(first, t=0.0), replace(last, t=_ENTRY_S), replace(last, t=1e6))

    def at(time: float) -> Posture:
        """The posture at a time, seconds."""
        since = time - at_s
        # on the lane after coming in, or before leaving.
        on_lane_s = since - _ENTRY_S if comes else since
        on_lane = on_lane_s >= 0 if comes else on_lane_s < 0
        if on_lane:
            now = posture(keys, keys[-1].t, on_lane_s)
        else:
            now = posture(entry, entry[-1].t, max(since, 0.0))
        return replace(now, clock=time)

    return person, at


_CHANGING: dict[str, Tag] = {"crowd": "high-dynamic", "tempo": "static", "light": "static"}
CHANGING = {
    f"changing_{name}": Variant(partial(build_changing, name), tag, CHANGING_FRAMES)
    for name, tag in _CHANGING.items()
}


# The camera follows a person around a room, as in Bonn's person tracking.


def build_tracking(scene: int) -> World:
    """The hall of the loops, walked by a person and, two metres behind, the camera."""
    hall, walk = build_walk("room", scene)
    rng = stream(scene, "synthetic", "tracking")
    lead_s = pick(rng, scene, 1.7, 2.0) / HALL_SPEED
    person = replace(draw_person(scene, 0), instance=len(hall.bodies) + 1)
    camera = partial(walking_camera, walk, scene, "tracking", 6.0)
    actor = (person, partial(_walking_posture, walk, lead_s))
    return replace(hall, camera=camera, actors=(actor,))


def _walking_posture(walk: Walk, lead_s: float, time: float) -> Posture:
    """A person who walks `lead_s` seconds ahead of the camera, a stride a metre."""
    place, ahead = walk.at(np.array([time + lead_s, time + lead_s + 0.3]))
    direction = ahead - place
    return Posture(
        x=float(place[0]),
        y=float(place[1]),
        facing=math.degrees(atan2(direction[1], direction[0])) - 90.0,
        stride=HALL_SPEED * (time + lead_s) * 2 * math.pi / 1.0,
        gait=0.6,
        sit=0.0,
        gesture=0.0,
        clock=time,
    )


TRACKING = {"tracking": Variant(build_tracking, "high-dynamic", 1200)}


# The tempo of TUM's fr1: turns of 1-3 rad/s, motion blur, a rolling shutter and automatic exposure.

OPTICS = Optics(readout_s=0.026, auto_exposure=0.7, color={"shutter": 0.3})
"""26 ms from the first row to the last, as in the first Kinect."""

SWINGS: dict[str, tuple[tuple[float, ...], tuple[float, ...]]] = {
    "desk": ((0.17, 0.12, 0.14), (0.26, 0.46, 0.26)),
    "rpy": ((0.03, 0.03, 0.03), (0.3, 0.52, 0.38)),
    "spin": ((0.14, 0.08, 0.14), (0.12, 0.25, 0.12)),
    "walking": ((0.15, 0.1, 0.1), (0.24, 0.44, 0.26)),
}
"""Amplitudes of each variant: right, down, forward in metres; pitch, yaw, roll in radians."""


def build_fast(variant: str, scene: int) -> World:
    """The office, without people or with the walking ones, or the hall of the loops."""
    if variant == "spin":
        world = build_loop("room", scene)
    else:
        world = build_replica("walking", "xyz", scene)
        world = world if variant == "walking" else replace(world, bodies=(), actors=())
    return replace(world, camera=partial(fast_camera, variant, scene), optics=OPTICS)


def fast_camera(variant: str, scene: int, times: Array) -> Array:
    """Poses ``[N, 4, 4]``: sines of several frequencies along and about all axes; `spin` also turns round and round."""
    # jitter of the hand
    rng = stream(scene, "synthetic", "camera", "fast", variant)
    t = times
    shifts, turns = SWINGS[variant]
    offset = hand(rng, t, 0.006, 3)
    angles = hand(rng, t, math.radians(0.8), 3)
    # Two sines along and about each axis.
    for amplitudes, values in ((shifts, offset), (turns, angles)):
        for axis, amplitude in enumerate(amplitudes):
            main = pick(rng, scene, 0.45, 0.7)
            second = pick(rng, scene, 0.8, 1.1)
            values[:, axis] += 0.75 * amplitude * sin(2 * math.pi * (main * t + rng.random()))
            values[:, axis] += 0.4 * amplitude * sin(2 * math.pi * (second * t + rng.random()))
    # round and round, and from where it looks
    yaw = np.zeros((len(t), 3))
    place = np.array([0.0, 0.0, EYE_HEIGHT_M])
    if variant == "spin":
        yaw[:, 2] = pick(rng, scene, 1.3, 1.6) * t
        place = np.array([2.7, 0.2, EYE_HEIGHT_M])
    base = product(rotations(yaw), camera_axes(TILT_RAD))
    moved = place + product(base, offset[..., None])[..., 0]
    return se3.from_matrix(moved, product(base, rotations(angles)))


FAST = {
    f"fast_{name}": Variant(
        partial(build_fast, name), "high-dynamic" if name == "walking" else "static"
    )
    for name in SWINGS
}
