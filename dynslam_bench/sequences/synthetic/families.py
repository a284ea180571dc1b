"""The rendered sequences, family by family: what stands and moves in each, and how its camera moves.

There are replicas of TUM's fr3 dynamic sequences, a crowd, people who step in time with the camera,
conditions that sensors dislike, and scenes that change. Then moving objects after Bonn's, long
paths that return, a followed person, and the tempo of TUM's fr1.
"""

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from dynslam_bench.core.seeding import stream
from dynslam_bench.geometry import se3
from dynslam_bench.sequences.synthetic.arithmetic import (
    Array,
    arctan2,
    atan2,
    cos,
    norm,
    product,
    sin,
)
from dynslam_bench.sequences.synthetic.parts import (
    At,
    Key,
    Parts,
    angle_between,
    between,
    box,
    copies,
    ease,
    on_track,
    rotation_about_z,
)
from dynslam_bench.sequences.synthetic.people import (
    Draw,
    Person,
    Posture,
    draw_person,
    posture,
    write_script,
)
from dynslam_bench.sequences.synthetic.rooms import (
    Plan,
    Point,
    balloon,
    build_room,
    cartons,
    corridor_bay,
    door_leaf,
    floor,
    notices,
    office_bay,
    office_chair,
    partition,
    pick,
    plan_room,
    printed_box,
    trolley,
)
from dynslam_bench.sequences.synthetic.scene import Actor, Body, Optics, Placement, Variant, World
from dynslam_bench.sequences.tags import Tag

# The camera's motions, after the descriptions of TUM's fr3 sequences, at their tempo.
#
# World frame: z up, the camera starts near the origin's plumb line at 1.35 m and looks along +y at
# the desk. Positions are sums of smooth functions of time, so that every pose is exact at any time.
#
# * xyz: along the camera's three axes, one after the other, 0.25 m to each side;
# * static: held in place by hand;
# * halfsphere: over a half sphere of about 1 m diameter, always towards the desk;
# * rpy: rotations about the three principal axes, one after the other.

MOTIONS = ("xyz", "static", "halfsphere", "rpy")
EYE_HEIGHT_M = 1.35
TILT_RAD = math.radians(10.0)


def camera_poses(motion: str, people: str, scene: int, times: Array) -> Array:
    """Camera-to-world poses ``[N, 4, 4]`` at `times` (seconds from the start)."""
    rng = stream(scene, "synthetic", "camera", people, motion)
    tempo = 0.72 if people == "sitting" and motion == "xyz" else 1.0
    t = np.asarray(times, dtype=np.float64)
    offset = np.zeros((len(t), 3))  # along the camera's rest axes: right, down, forward
    angles = np.zeros((len(t), 3))  # about right (pitch), down (yaw), forward (roll)
    phase = rng.permutation(3)
    signs = np.where(rng.random(3) < 0.5, -1.0, 1.0)
    for slot, axis in enumerate(phase):
        if motion == "xyz":
            offset[:, axis] = signs[axis] * (0.25, 0.2, 0.25)[axis] * _turns(t, 4.6 / tempo, slot)
        elif motion == "rpy":
            angles[:, axis] = (
                signs[axis] * np.radians([14.0, 19.0, 20.0])[axis] * _turns(t, 3.6 / tempo, slot)
            )
    if motion == "halfsphere":
        around = 2 * math.pi * t / (6.1 / tempo)
        lift = 0.5 - 0.5 * cos(2 * math.pi * t / (16.9 / tempo) + 0.4)
        radius = 0.36
        distance = 0.9
        offset[:, 0] = signs[0] * radius * sin(around)
        offset[:, 1] = -radius * (0.85 * lift - 0.12) * cos(around * 0.5 + 0.3)
        offset[:, 2] = -0.1 + 0.2 * cos(around) * (0.4 + 0.6 * lift)
        angles[:, 1] = -0.9 * arctan2(offset[:, 0], distance - offset[:, 2])
        angles[:, 0] = 0.9 * arctan2(offset[:, 1], distance - offset[:, 2])
        angles[:, 2] = 0.2 * sin(around * 0.77 + 1.0)
    offset += hand(rng, t, 0.004, 3)
    angles += hand(rng, t, math.radians(0.5), 3)
    base = camera_axes(TILT_RAD)
    place = product(offset, base.T) + np.array([0.0, 0.0, EYE_HEIGHT_M])
    return se3.from_matrix(place, product(base, rotations(angles)))


def camera_axes(tilt: float) -> Array:
    """Camera to world, 3x3, of a camera that looks along +y and `tilt` radians down."""
    rest = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
    return np.asarray(product(rest, rotations(np.array([[-tilt, 0.0, 0.0]]))[0]))


def _turns(t: Array, period: float, slot: int) -> Array:
    """One sine of `period` in this one of three slots, zero in the others, with no jump in position or speed."""
    local = (t / period) % 3 - slot
    inside = (local >= 0) & (local < 1)
    x = np.clip(local, 0, 1)
    # The phase runs through x - sin(4 pi x) / (4 pi) * 0.5: slower at the start and the end of the
    # slot.
    eased = x - sin(2 * math.pi * x) / (2 * math.pi) * 0.6
    window = np.minimum(1.0, np.minimum(x, 1 - x) / 0.1)
    window = window * window * (3 - 2 * window)
    return np.where(inside, sin(2 * math.pi * eased) * window, 0.0)


def hand(rng: np.random.Generator, t: Array, amplitude: float, axes: int) -> Array:
    """Handheld jitter: sines from 0.2 to 4 Hz whose amplitude falls with the frequency."""
    total = np.zeros((len(t), axes))
    for frequency in (0.23, 0.51, 0.97, 1.7, 2.6, 3.9):
        f = frequency * (0.85 + 0.3 * rng.random(axes))
        total += (
            amplitude * (0.5 / (0.4 + f)) * sin(2 * math.pi * (f * t[:, None] + rng.random(axes)))
        )
    return total


def rotations(vectors: Array) -> Array:
    """Rotation matrices ``[N, 3, 3]`` of rotation vectors ``[N, 3]`` (Rodrigues)."""
    theta = norm(vectors)
    k = vectors / np.where(theta < 1e-12, 1.0, theta)[:, None]
    zero = np.zeros(len(k))
    hat = np.stack(
        [zero, -k[:, 2], k[:, 1], k[:, 2], zero, -k[:, 0], -k[:, 1], k[:, 0], zero], 1
    ).reshape(-1, 3, 3)
    s = sin(theta)[:, None, None]
    c = (1 - cos(theta))[:, None, None]
    return np.asarray(np.eye(3) + s * hat + c * (product(hat, hat)))


# Long paths of a hand-held camera: closed loops along way points, at walking pace, exact at any
# time.

_STEP_M = 0.4
"""Distance of the spline's control points."""


@dataclass(frozen=True)
class Walk:
    """A closed walk, lap after lap.

    Its ground plan is the uniform cubic B-spline on points that stand `_STEP_M` apart along a
    polygon: it cuts corners and slows down there, and has continuous speed and acceleration.

    Attributes:
        control: Control points ``[N, 2]``, metres.
        lap_s: Seconds a lap.
    """

    control: Array
    lap_s: float

    def at(self, times: Array) -> Array:
        """Places ``[N, 2]`` at times (seconds)."""
        s = np.asarray(times, dtype=np.float64) * (len(self.control) / self.lap_s)
        i = np.floor(s).astype(np.int64)
        f = (s - i)[:, None]
        g = 1 - f
        n = len(self.control)
        before, here, after, beyond = (self.control[(i + k) % n] for k in (-1, 0, 1, 2))
        return np.asarray(
            g * g * g / 6 * before
            + (3 * f * f * f - 6 * f * f + 4) / 6 * here
            + (-3 * f * f * f + 3 * f * f + 3 * f + 1) / 6 * after
            + f * f * f / 6 * beyond
        )

    def time_nearest(self, place: tuple[float, float]) -> float:
        """When, in the first lap, the walk is nearest to a place."""
        times = np.linspace(0.0, self.lap_s, 4 * len(self.control), endpoint=False)
        return float(times[norm(self.at(times) - place).argmin()])


def walk_along(corners: list[tuple[float, float]], speed: float) -> Walk:
    """The closed walk around a polygon, at `speed` m/s where it is straight."""
    ends = np.array([*corners, corners[0]], dtype=np.float64)
    reach = np.concatenate([[0.0], np.cumsum(norm(np.diff(ends, axis=0)))])
    n = round(reach[-1] / _STEP_M)
    s = np.arange(n) * reach[-1] / n
    return Walk(
        np.stack([np.interp(s, reach, ends[:, k]) for k in range(2)], axis=1),
        float(reach[-1]) / speed,
    )


def walking_camera(walk: Walk, scene: int, name: str, aside_deg: float, times: Array) -> Array:
    """Poses ``[N, 4, 4]`` of a camera that is carried along a walk.

    Args:
        walk: The path.
        scene: Seeds the hand's jitter and how each lap strays from the others.
        name: Names that seed.
        aside_deg: How far the camera looks to the left of its direction of motion; it looks around
            by 12 degrees more.
        times: Seconds from the start.
    """
    rng = stream(scene, "synthetic", "walk", name)
    t = np.asarray(times, dtype=np.float64)
    step_s = walk.lap_s / len(walk.control)
    ahead = walk.at(t + 2.3 * step_s) - walk.at(t - 0.8 * step_s)
    stray = 0.12 * _slow(rng, t, 2)
    steps = 0.012 * sin(2 * math.pi * 1.7 * t)[:, None] * np.array([0.0, 0.0, 1.0])
    heading = arctan2(ahead[:, 1], ahead[:, 0]) + math.radians(aside_deg)
    heading = heading + math.radians(12.0) * _slow(rng, t, 1)[:, 0]
    turned = np.zeros((len(t), 3))
    # about the world's z axis; the camera at rest looks along +y
    turned[:, 2] = heading - math.pi / 2
    rotation = product(
        rotations(turned), camera_axes(TILT_RAD), rotations(hand(rng, t, math.radians(0.7), 3))
    )
    place = np.column_stack([walk.at(t) + stray, np.full(len(t), EYE_HEIGHT_M)])
    return se3.from_matrix(place + (steps + hand(rng, t, 0.006, 3)), rotation)


def _slow(rng: np.random.Generator, t: Array, axes: int) -> Array:
    """Smooth wandering within about [-1, 1] that does not repeat from lap to lap."""
    total = np.zeros((len(t), axes))
    for period in (17.3, 7.1):
        total += 0.5 * sin(
            2
            * math.pi
            * (t[:, None] / (period * (0.9 + 0.2 * rng.random(axes))) + rng.random(axes))
        )
    return total


# Replicas of TUM's fr3 dynamic sequences: two people who walk or sit in an office, four camera
# motions.


def build_replica(people: str, motion: str, scene: int) -> World:
    """The office with its two people and two chairs."""
    plan = plan_room(scene)
    script = write_script(people, scene)
    return World(
        static=build_room(scene, plan),
        camera=partial(camera_poses, motion, people, scene),
        window=window_of(plan),
        bodies=tuple(
            Body(
                3 + k,
                "chair",
                office_chair(plan, 3 + k, (1.0, 0.8)[k]),
                partial(_roll, keys, script.period),
            )
            for k, keys in enumerate(script.chairs)
        ),
        actors=tuple(
            (draw_person(scene, k), partial(posture, keys, script.period))
            for k, keys in enumerate(script.people)
        ),
    )


def window_of(plan: Plan) -> tuple[float, float, float]:
    """Beside the back wall, where glare comes from."""
    return plan.left_x * 0.55, plan.back_y, 2.15


def _roll(keys: tuple[Key, ...], period: float, time: float) -> tuple[Array, Array]:
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
    """A person on a lane, at a drawn place from the start."""
    rng, person, keys = _lane_keys(scene, number, lane)
    start = pick(rng, scene, 0.0, keys[-1].t)
    return person, lambda time: replace(posture(keys, keys[-1].t, time + start), clock=time)


def _lane_keys(
    scene: int, number: int, lane: float
) -> tuple[np.random.Generator, Person, tuple[Key, ...]]:
    """To and fro on a lane, with a stop in the middle where the person turns to the camera and talks."""
    rng = stream(scene, "synthetic", "crowd", number)
    side = 1.0 if number % 2 else -1.0
    reach = pick(rng, scene, 1.0, 1.45)
    pause = pick(rng, scene, 0.8, 2.0)
    stop = pick(rng, scene, -0.5, 0.5)
    cross = pick(rng, scene, 2.6, 3.4)
    stations = [
        (0.0, -side * reach, side, 0.0),
        (cross * 0.5, side * stop, side, 0.0),
        (pause, side * stop, 0, 1.0),
        (cross * 0.5, side * reach, side, 0.0),
        (0.7, side * reach, -side, 0.0),
        (cross, -side * reach, -side, 0.0),
        (0.6, -side * reach, side, 0.0),
    ]
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


def _step(reach: float, period: float, phase: float, times: Array) -> Array:
    """To and fro, with rests at both ends."""
    swing = sin(2 * math.pi * (times / period + phase))
    return np.asarray(reach * swing * (1.5 - 0.5 * swing * swing))


def build_synchronous(scene: int) -> World:
    """The office, two people side by side, and a camera that moves with them."""
    plan = plan_room(scene)
    rng = stream(scene, "synthetic", "synchronous")
    step = partial(
        _step, pick(rng, scene, 0.5, 0.6), pick(rng, scene, 4.4, 5.2), pick(rng, scene, 0.0, 1.0)
    )
    places = (
        (-pick(rng, scene, 0.3, 0.36), pick(rng, scene, 1.2, 1.3)),
        (pick(rng, scene, 0.28, 0.34), 1.35),
    )
    actors = tuple(
        (draw_person(scene, k), partial(_stepping, step, place)) for k, place in enumerate(places)
    )
    return World(
        build_room(scene, plan), partial(_camera, step, scene), window_of(plan), actors=actors
    )


def _stepping(step: Step, place: tuple[float, float], time: float) -> Posture:
    x, ahead = step(np.array([time, time + 0.05]))
    gait = min(abs(ahead - x) / 0.05 / 0.9, 1.0)
    return Posture(
        place[0] + x, place[1], 180.0, 2 * x * 2 * math.pi / 1.35, 0.4 * gait, 0.0, 0.1, time
    )


def _camera(step: Step, scene: int, times: Array) -> Array:
    rng = stream(scene, "synthetic", "camera", "synchronous")
    rotation = product(camera_axes(TILT_RAD), rotations(hand(rng, times, math.radians(0.5), 3)))
    place = hand(rng, times, 0.004, 3) + np.array([0.0, 0.0, EYE_HEIGHT_M])
    place[:, 0] += step(times)
    return se3.from_matrix(place, rotation)


SYNCHRONOUS = {"synchronous": Variant(build_synchronous, "high-dynamic")}


# What the sensors dislike: little light, little texture, little depth, depth as in sunlight.

Change = Callable[[World, int], World]
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
    places = [
        *((0.0, ((k - 1) * 4.3, back - 0.05, 0.0)) for k in range(3)),
        *((-90.0 * side, (side * (x - 0.05), 5.0, 0.0)) for side in (-1, 1)),
    ]
    hall = [
        *floor((-x, front), (x, back), plan),
        *(
            part
            for start, end in itertools.pairwise(corners)
            for part in partition(start, end, plan)
        ),
        *(
            part
            for k, (yaw, at) in enumerate(places)
            for part in copies(office_bay(scene, k), yaw, at, f"/{k}")
        ),
    ]
    return replace(world, static=hall, window=(0.0, back, 2.15))


_CHANGES: dict[str, Change] = {
    "dark": lambda world, _: replace(world, optics=DARK),
    "blank": lambda world, _: replace(
        world, static=[replace(part, texture=("plain",) * 6) for part in world.static]
    ),
    "far": _hall,
    "outdoor": lambda world, _: replace(world, optics=SUNLIGHT),
}
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
_CHANGE_S = 0.8
_TEMPO = 0.4, 3.5
_LIGHT = 1.0, 0.1
_ENTRY_S = 1.8
_OUTSIDE_M = 3.0


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
        return self.before + (self.after - self.before) * ease(
            min(max((time - self.at_s) / _CHANGE_S, 0.0), 1.0)
        )

    def integral(self, times: Array) -> Array:
        """The integral of the level from 0 to each time, seconds."""
        since = np.maximum(times - self.at_s, 0.0)
        x = np.minimum(since / _CHANGE_S, 1.0)
        eased = np.maximum(since - _CHANGE_S, 0.0) + _CHANGE_S * (x * x * x * (1.0 - 0.5 * x))
        return np.asarray(self.before * times + (self.after - self.before) * eased)


def build_changing(name: str, scene: int) -> World:
    """The office of the replicas: four people who come (or leave), a camera that speeds up, or a light that fades."""
    plan = plan_room(scene)
    rng = stream(scene, "synthetic", "changing", name)
    at_s = pick(rng, scene, 3.0, 5.0)
    order = -1 if scene % 2 else 1
    camera = partial(camera_poses, "halfsphere" if name == "tempo" else "xyz", "changing", scene)
    world = World(build_room(scene, plan), camera, window_of(plan))
    if name == "crowd":
        visitors = (
            _visitor(scene, k, lane, at_s + 0.3 * k, order > 0) for k, lane in enumerate(LANES_M)
        )
        return replace(world, actors=tuple(visitors))
    if name == "tempo":
        tempo = Ramp(at_s, *_TEMPO[::order])
        return replace(
            world, camera=lambda times: camera(tempo.integral(np.asarray(times, dtype=np.float64)))
        )
    return replace(world, optics=Optics(gain=Ramp(at_s, *_LIGHT[::order]).level))


def _visitor(scene: int, number: int, lane: float, at_s: float, comes: bool) -> Actor:
    """A person of the crowd who comes from outside of the view, or leaves it."""
    _, person, keys = _lane_keys(scene, number, lane)
    inside = keys[0]
    side = math.copysign(1.0, keys[0].x)
    outside = replace(
        inside, x=inside.x + side * _OUTSIDE_M, facing=90.0 * side if comes else -90.0 * side
    )
    first, last = (outside, inside) if comes else (replace(inside, facing=-90.0 * side), outside)
    way = (replace(first, t=0.0), replace(last, t=_ENTRY_S), replace(last, t=1e6))

    def at(time: float) -> Posture:
        since = time - at_s
        among = since - _ENTRY_S if comes else since
        walks = among >= 0 if comes else among < 0
        moved = (
            posture(keys, keys[-1].t, among) if walks else posture(way, way[-1].t, max(since, 0.0))
        )
        return replace(moved, clock=time)

    return person, at


_CHANGING: dict[str, Tag] = {"crowd": "high-dynamic", "tempo": "static", "light": "static"}
CHANGING = {
    f"changing_{name}": Variant(partial(build_changing, name), tag, CHANGING_FRAMES)
    for name, tag in _CHANGING.items()
}


# Things without a known class that move, after Bonn's balloon, box and kidnapping sequences. Each
# has an id of its own in the masks. What is moved with hands outside of the picture has no person;
# a carrier is there where Bonn has one.

PERIOD_S = 20.0
Cast = tuple[tuple[Body, ...], tuple[Key, ...]]
"""Bodies and, where a person carries them, the carrier's timeline."""


def build_objects(variant: str, scene: int) -> World:
    """The office, what moves in it, and the xyz camera path of TUM's replicas."""
    plan = plan_room(scene)
    rng = stream(scene, "synthetic", "objects", variant)
    room = build_room(scene, plan)
    if variant == "door":
        room += _doorway(plan)
    bodies, keys = _SCRIPTS[variant](partial(pick, rng, scene), scene, plan)
    person = replace(draw_person(scene, 0), instance=9)
    actors = ((person, partial(posture, keys, PERIOD_S)),) if keys else ()
    return World(
        room, partial(camera_poses, "xyz", "objects", scene), window_of(plan), bodies, actors
    )


def _body(
    id: int, name: str, parts: Parts, keys: tuple[At, ...], period: float | None = PERIOD_S
) -> Body:
    return Body(id, name, parts, partial(on_track, keys, period))


def _balloon(j: Draw, scene: int, plan: Plan) -> Cast:
    """A person walks to and fro and plays with a balloon in front of the camera."""
    y = j(0.95, 1.05)
    reach = j(0.32, 0.42)
    high = j(1.45, 1.55)
    keys = [At(0.0, reach, y, high - 0.3)]
    for k in range(8):
        side = -1 if k % 2 == 0 else 1
        keys += [At(2.5 * k + 0.9, 0.3 * side * reach, y - 0.1, high + 0.12, 60.0 * k)]
        keys += [At(2.5 * k + 2.5, side * reach, y, high - 0.3, 60.0 * k + 30.0)]
    walker = [Key(k.t, 1.1 * k.x, y + 0.55, 180.0 - 15.0 * np.sign(k.x), 0, 1) for k in keys[::2]]
    return (_body(1, "sports ball", balloon(1, j(0.17, 0.2)), tuple(keys)),), tuple(walker)


def _box_obstructing(j: Draw, scene: int, plan: Plan) -> Cast:
    """A large carton is moved close across the view, held before it, and moved away again."""
    y = j(1.15, 1.25)
    z = j(1.06, 1.14)
    yaw = j(10, 25)
    box = printed_box(1, (j(0.34, 0.4), j(0.18, 0.24), j(0.28, 0.34)))
    keys = (
        At(0, -1.7, y, z),
        At(2.0, -1.7, y, z),
        At(4.0, -0.25, y, z, yaw),
        At(7.0, 0.25, y, z + 0.05, -yaw),
        At(9.0, 1.7, y, z),
        At(11.5, 1.7, y, z),
        At(14.0, 0.1, y - 0.08, z, yaw),
        At(16.5, -0.2, y, z, 0.0),
        At(18.5, -1.7, y, z),
        At(20.0, -1.7, y, z),
    )
    return (_body(1, "box", box, keys),), ()


def _box_aside(j: Draw, scene: int, plan: Plan) -> Cast:
    """A person carries a carton through the room; it never hides most of the view."""
    y = j(1.3, 1.4)
    z = j(0.95, 1.05)
    box = printed_box(1, (j(0.21, 0.25), j(0.15, 0.19), j(0.17, 0.21)))
    times = (
        (0, -1.6),
        (1.5, -1.6),
        (5.5, 0.35),
        (7.5, 0.2),
        (10.0, 1.6),
        (12.0, 1.6),
        (16.0, -0.3),
        (18.5, -1.6),
        (20, -1.6),
    )
    keys = tuple(At(t, x, y, z, 8.0 * k) for k, (t, x) in enumerate(times))
    walker = tuple(Key(k.t, k.x, y + 0.38, 180) for k in keys)
    return (_body(1, "box", box, keys),), walker


def _carried(came: bool, j: Draw, scene: int, plan: Plan) -> Cast:
    """A carton is brought and put down before the desk, where it stays; or it stands there and is taken away."""
    stations = (  # time, x, share of the carrying height
        [(1.0, -1.7, 1.1), (3.5, -0.1, 1.0), (5.0, -0.05, 0.0)]
        if came
        else [(6.0, -0.05, 0.0), (7.5, -0.1, 1.0), (10.0, -1.7, 1.1)]
    )
    y = j(1.3, 1.4)
    half = (j(0.3, 0.35), j(0.22, 0.27), j(0.32, 0.38))
    low = half[2] + 0.35
    lift = j(0.35, 0.42)
    shift = j(-0.1, 0.1)
    keys = tuple(
        At(t, x + shift, y, low + lift * min(share, 1.0), 4.0 * k)
        for k, (t, x, share) in enumerate(stations)
    )
    pedestal = printed_box(2, (half[0] * 0.9, half[1] * 0.9, 0.175))
    floor = Body(2, "box", pedestal, partial(on_track, (At(0.0, -0.05 + shift, y, 0.175),), None))
    walker = [Key(k.t, k.x, y + 0.45, 180) for k in keys]
    away = -1.75
    if came:
        walker += [
            Key(7.0, walker[-1].x, y + 0.45, 90),
            Key(9.5, away, y + 0.5, 90),
            Key(20, away, y + 0.5, 90),
        ]
    else:
        walker = [
            Key(0, away, y + 0.5, 270),
            Key(3.5, away, y + 0.5, 270),
            *walker,
            Key(20, away, y + 0.5, 90),
        ]
    first = [] if walker[0].t == 0 else [replace(walker[0], t=0.0)]
    return (_body(1, "box", printed_box(1, half), keys, None), floor), (*first, *walker)


def _kidnapped(j: Draw, scene: int, plan: Plan) -> Cast:
    """A very large carton comes before the camera, fills the image while it moves, and leaves."""
    y = j(1.0, 1.1)
    z = j(1.1, 1.2)
    box = printed_box(1, (j(1.15, 1.25), 0.12, j(0.8, 0.9)))
    keys = (
        At(0, -2.6, y, z),
        At(3.0, -2.6, y, z),
        At(5.0, -0.3, y, z),
        At(7.5, 0.3, y - 0.06, z + 0.05),
        At(9.5, 2.7, y, z),
        At(13.0, 2.7, y, z),
        At(15.0, 0.25, y, z),
        At(17.0, -0.3, y - 0.05, z - 0.04),
        At(19.0, -2.6, y, z),
        At(20.0, -2.6, y, z),
    )
    return (_body(1, "box", box, keys),), ()


def _trolley(j: Draw, scene: int, plan: Plan) -> Cast:
    """A person pushes a loaded trolley to and fro before the desk."""
    y = j(1.3, 1.4)
    stops = (
        (0, -2.0, 0),
        (1.5, -2.0, 0),
        (6.0, 0.15, 0),
        (8.0, 0.2, 6),
        (11.5, 2.3, 0),
        (12.5, 2.3, 180),
        (15.5, 0.1, 180),
        (16.5, 0.05, 174),
        (19.5, -2.0, 180),
        (20.0, -2.0, 360),
    )
    keys = tuple(At(t, x, y, 0.0, yaw) for t, x, yaw in stops)
    walker = tuple(Key(k.t, k.x - 0.75 * cos(np.radians(k.yaw)), y, k.yaw - 90.0) for k in keys)
    return (_body(1, "trolley", trolley(1, scene, plan), keys),), walker


def _chair(j: Draw, scene: int, plan: Plan) -> Cast:
    """A chair with a carton on it is turned and rolled; no person is in view."""
    x = j(-0.2, 0.2)
    y = j(1.15, 1.25)
    turned = j(150, 210)
    parts = [
        *office_chair(plan, 1),
        *copies(printed_box(1, (0.2, 0.17, 0.2)), 15.0, (0.0, -0.02, 0.69)),
    ]
    keys = (
        At(0, x, y),
        At(1.5, x, y),
        At(5, x + 0.1, y, 0, turned),
        At(7, x, y, 0, turned),
        At(9.5, x - 0.5, y + 0.2),
        At(11, x - 0.5, y + 0.2),
        At(14, x + 0.45, y + 0.1, 0, -turned),
        At(16, x + 0.45, y + 0.1, 0, -turned),
        At(19, x, y),
        At(20, x, y),
    )
    return (_body(1, "chair", parts, keys),), ()


_DOOR = (-0.5, 1.55, 1.0)
"""Hinge x and y, and the width of the door, metres."""


def _door(j: Draw, scene: int, plan: Plan) -> Cast:
    """A door in a partition opens towards the camera and falls shut, twice in a period."""
    x, y, width = _DOOR
    wide = j(72, 80)
    ajar = j(20, 30)
    angles = (
        (0, 0),
        (1.5, 0),
        (4.0, -wide),
        (6.5, -wide),
        (9.0, -ajar),
        (10.5, -ajar),
        (13.0, -wide),
        (15.0, -wide),
        (18.0, 0),
        (20, 0),
    )
    keys = tuple(At(t, x, y, 0.0, yaw) for t, yaw in angles)
    return (_body(1, "door", door_leaf(1, plan, width), keys),), ()


def _doorway(plan: Plan) -> Parts:
    """A wall before the desk, with a doorway, and posters on it."""
    x, y, width = _DOOR
    return [
        *partition((plan.left_x, y + 0.05), (x - 0.02, y + 0.05), plan),
        *partition((x + width + 0.02, y + 0.05), (plan.right_x, y + 0.05), plan),
        *(
            box(
                np.eye(3),
                (at, y - 0.006, z),
                (0.19, 0.005, 0.26),
                texture=f"poster:{(k + int(2 * z)) % 4}",
                fit=(2,),
            )
            for k, at in enumerate((x - 0.28, x - 0.75, x + width + 0.28, x + width + 0.75))
            for z in (1.0, 1.62)
        ),
    ]


_SCRIPTS: dict[str, Callable[[Draw, int, Plan], Cast]] = {
    "balloon": _balloon,
    "box_obstructing": _box_obstructing,
    "box_aside": _box_aside,
    "placed": partial(_carried, True),
    "removed": partial(_carried, False),
    "kidnapped": _kidnapped,
    "trolley": _trolley,
    "chair": _chair,
    "door": _door,
}

OBJECTS = {
    f"objects_{name}": Variant(partial(build_objects, name), "unknown-objects") for name in _SCRIPTS
}


# Long paths that return: a room circled (20 m), a ring of corridors (60 m), six rooms along a
# corridor (120 m).
#
# `moved`: chairs and cartons stand elsewhere whenever the camera comes by again; each is moved
# while the camera is half a lap away. `repeated`: every stretch of wall is the same, down to its
# textures.

_SHAPES = {"room": (-32.0, 2400, 1), "corridor": (-14.0, 3900, 1), "rooms": (0.0, 6600, 2)}
"""How far the camera looks aside (degrees), frames, and version of each building."""


@dataclass
class _Building:
    """What is built so far; every stretch of wall and every loose piece has its number."""

    scene: int
    repeated: bool
    parts: Parts = field(default_factory=list)
    loose: list[tuple[str, Parts, float, Point]] = field(default_factory=list)
    bays: int = 0

    def bay(self, make: Callable[[int, int], Parts], yaw: float, at: Point, alike: int = 0) -> None:
        """Furnish a stretch of wall; where walls are repeated, all that are `alike` are the same."""
        number = alike if self.repeated else self.bays
        self.parts += copies(make(self.scene, number), yaw, (*at, 0.0), f"/{number}")
        self.bays += 1

    def piece(self, kind: str, yaw: float, at: Point) -> None:
        """Put a piece that may be moved on the floor: a ``chair`` or a ``box``."""
        number = 0 if self.repeated else len(self.loose)
        id = len(self.loose) + 1
        chair = kind == "chair"
        plain = (
            office_chair(plan_room(self.scene, number), id)
            if chair
            else cartons(self.scene, number, id)
        )
        self.loose.append((kind, copies(plain, 0.0, (0.0, 0.0, 0.0), f"/{number}"), yaw, at))


def build_loop(variant: str, scene: int) -> World:
    """The building, its loose pieces, and a camera that is carried around in it."""
    shape, _, change = variant.partition("_")
    building = _Building(scene, change == "repeated")
    walk = {"room": _room, "corridor": _corridor, "rooms": _rooms}[shape](building)
    bodies = tuple(
        Body(k + 1, kind, parts, _moves(building, walk, change == "moved", k))
        for k, (kind, parts, _, _) in enumerate(building.loose)
    )
    return World(
        building.parts,
        partial(walking_camera, walk, scene, shape, _SHAPES[shape][0]),
        (0.0, 3.0, 2.15),
        bodies,
    )


def _moves(building: _Building, walk: Walk, moved: bool, number: int) -> Placement:
    """The place of a loose piece, by lap."""
    rng = stream(building.scene, "synthetic", "moved", number)
    (_, _, yaw, at) = building.loose[number]
    places = [(rotation_about_z(yaw), np.array([*at, 0.0]))]
    for _ in range(2 if moved else 0):
        angle = np.radians(pick(rng, building.scene, 0.0, 360.0))
        away = pick(rng, building.scene, 0.3, 0.55) * np.array([cos(angle), sin(angle), 0.0])
        places.append(
            (
                rotation_about_z(yaw + pick(rng, building.scene, 40.0, 320.0)),
                np.array([*at, 0.0]) + away,
            )
        )
    return partial(_by_lap, places, walk.time_nearest(at), walk.lap_s)


def _by_lap(
    places: list[tuple[Array, Array]], near_s: float, lap_s: float, time: float
) -> tuple[Array, Array]:
    return places[int(np.floor((time - near_s) / lap_s + 0.5)) % len(places)]


def _room(b: _Building) -> Walk:
    """A hall with desks along its walls and a partition in the middle."""
    rng = stream(b.scene, "synthetic", "hall")
    plan = plan_room(b.scene, 0)
    x = pick(rng, b.scene, 5.2, 5.5)
    y = pick(rng, b.scene, 4.2, 4.4)
    b.parts += floor((-x, -y), (x, y), plan)
    for start, end in _around(x, y):
        b.parts += partition(start, end, plan)
    for yaw, side, along in ((0, y, 2.4), (0, y, -2.4), (180, -y, 2.4), (180, -y, -2.4)):
        b.bay(office_bay, yaw, (along, side - np.sign(side) * 0.05))
        b.piece("chair", yaw, (along + 0.3, side - np.sign(side) * 1.55))
    for yaw, side in ((-90, x), (90, -x)):
        b.bay(office_bay, yaw, (side - np.sign(side) * 0.05, 0.0))
        b.piece("box", yaw, (side - np.sign(side) * 1.3, 0.9))
    names = (*(f"poster:{face % 4}" for face in range(4)), "plain", "plain")
    block = box(np.eye(3), (0.0, 0.0, 1.0), (1.2, 0.35, 1.0), texture=names, fit=(0, 1, 2, 3))
    b.parts += copies([block], 0.0, (0.0, 0.0, 0.0), "/partition")
    b.piece("box", 20.0, (0.3, 0.75))
    return walk_along(
        [(-x + 2.2, -y + 2.1), (x - 2.2, -y + 2.1), (x - 2.2, y - 2.1), (-x + 2.2, y - 2.1)], 0.45
    )


def _around(x: float, y: float) -> list[tuple[Point, Point]]:
    return list(itertools.pairwise([(-x, -y), (x, -y), (x, y), (-x, y), (-x, -y)]))


def _corridor(b: _Building) -> Walk:
    """A ring of four corridors, 2.4 m wide, around a core."""
    rng = stream(b.scene, "synthetic", "ring")
    plan = plan_room(b.scene, 0)
    x = pick(rng, b.scene, 9.6, 10.2)
    y = pick(rng, b.scene, 5.6, 6.0)
    width = 1.2
    b.parts += floor((-x - width, -y - width), (x + width, y + width), plan)
    for sign in (1, -1):
        for start, end in _around(x + sign * width, y + sign * width):
            b.parts += partition(start, end, plan)
            wall = np.array(end) - start
            length = float(norm(wall))
            yaw = float(np.degrees(atan2(wall[1], wall[0]))) + (0 if sign < 0 else 180)
            inward = sign * np.array([-wall[1], wall[0]]) / length * 0.05
            count = int(length / 2.3)
            for k in range(count):
                at = np.array(start) + wall * (k + 0.5) / count + inward
                b.bay(corridor_bay, yaw, (float(at[0]), float(at[1])), alike=b.bays % 4)
                if k % 3 == 1:
                    out = at + inward / 0.05 * 0.35
                    b.piece(("chair", "box")[k % 2], yaw, (float(out[0]), float(out[1])))
    return walk_along([(-x, -y), (x, -y), (x, y), (-x, y)], 0.6)


def _rooms(b: _Building) -> Walk:
    """A corridor with three rooms on either side; the path runs once around in each and returns."""
    rng = stream(b.scene, "synthetic", "floor")
    plan = plan_room(b.scene, 0)
    wide = pick(rng, b.scene, 6.6, 7.0)
    deep = pick(rng, b.scene, 5.8, 6.2)
    half = 1.2
    ends = 1.5 * wide
    b.parts += floor((-ends, -half - deep), (ends, half + deep), plan)
    for start, end in _around(ends, half + deep):
        b.parts += partition(start, end, plan)
    doors = (0.5 * wide, 1.5 * wide, 2.5 * wide)
    corners: list[Point] = []
    for side in (1, -1):
        b.parts += partition((-ends, side * half), (ends, side * half), plan, doors)
        for k in range(3):
            x = side * (k - 1) * wide
            if k:
                edge = x - side * wide / 2
                b.parts += partition((edge, side * half), (edge, side * (half + deep)), plan)
            _furnish(b, x, side, wide, half, half + deep)
            corners += [
                (x + side * u, side * v)
                for u, v in (
                    (-0.2, 0.3),
                    (-0.2, 2.2),
                    (-1.9, 3.1),
                    (-1.9, 5.0),
                    (1.9, 5.0),
                    (1.9, 3.1),
                    (0.2, 2.2),
                    (0.2, 0.3),
                )
            ]
            if k < 2:
                at = (x + side * wide / 2, side * (half - 0.05))
                b.bay(corridor_bay, 180.0 if side < 0 else 0.0, at)
        b.bay(notices, -90.0 * side, (side * (ends - 0.05), 0.0), alike=7)
        corners += [
            (side * u, side * v)
            for u, v in ((ends - 1.7, 0.6), (ends - 0.9, 0.1), (ends - 1.7, -0.6))
        ]
    return walk_along(corners, 0.7)


def _furnish(b: _Building, x: float, side: int, wide: float, front: float, back: float) -> None:
    """One room: an office along its back wall, furniture and notices along all others, loose pieces.

    The wall with the door, at `front`, has notices on both of its faces: those on the outer one
    hang in the corridor.
    """
    yaw = 0.0 if side > 0 else 180.0
    b.bay(office_bay, yaw, (x, side * (back - 0.05)))
    for end in (1, -1):
        beside = x + end * (wide / 2 - 0.05)
        b.bay(corridor_bay, -90.0 * end, (beside, side * (back - 2.6)), alike=1 if end > 0 else 2)
        b.bay(notices, -90.0 * end, (beside, side * (front + 1.5)), alike=3)
        b.bay(notices, yaw + 180.0, (x + end * 1.75, side * (front + 0.05)), alike=4)
        b.bay(notices, yaw, (x + end * 1.55, side * (front - 0.05)), alike=5)
    b.piece("chair", yaw, (x + 0.4, side * (back - 1.55)))
    b.piece("box", yaw, (x - 0.1 * wide, side * 3.9))


LOOPS = {
    f"loop_{shape}{change}": Variant(
        partial(build_loop, shape + change),
        "low-dynamic" if change == "_moved" else "static",
        frames,
        version,
    )
    for change in ("", "_moved", "_repeated")
    for shape, (_, frames, version) in _SHAPES.items()
}


# The camera follows a person around a room, as in Bonn's person tracking.


def build_tracking(scene: int) -> World:
    """The hall of the loops, walked by a person and, two metres behind, the camera."""
    hall = build_loop("room", scene)
    rng = stream(scene, "synthetic", "tracking")
    walk: Walk = hall.camera.args[0]  # type: ignore[attr-defined]  # a partial of `walking_camera`
    lead_s = pick(rng, scene, 1.7, 2.0) / 0.45
    person = replace(draw_person(scene, 0), instance=len(hall.bodies) + 1)
    camera = partial(walking_camera, walk, scene, "tracking", 6.0)
    return replace(hall, camera=camera, actors=((person, partial(_walking, walk, lead_s)),))


def _walking(walk: Walk, lead_s: float, time: float) -> Posture:
    place, ahead = walk.at(np.array([time + lead_s, time + lead_s + 0.3]))
    direction = ahead - place
    facing = math.degrees(atan2(direction[1], direction[0])) - 90.0
    stride = 0.45 * (time + lead_s) * 2 * math.pi / 1.0
    return Posture(float(place[0]), float(place[1]), facing, stride, 0.6, 0.0, 0.0, time)


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
    rng = stream(scene, "synthetic", "camera", "fast", variant)
    t = times
    shifts, turns = SWINGS[variant]
    offset = hand(rng, t, 0.006, 3)
    angles = hand(rng, t, math.radians(0.8), 3)
    for amplitudes, values in ((shifts, offset), (turns, angles)):
        for axis, amplitude in enumerate(amplitudes):
            main = pick(rng, scene, 0.45, 0.7)
            second = pick(rng, scene, 0.8, 1.1)
            values[:, axis] += 0.75 * amplitude * sin(2 * math.pi * (main * t + rng.random()))
            values[:, axis] += 0.4 * amplitude * sin(2 * math.pi * (second * t + rng.random()))
    yaw = np.zeros((len(t), 3))
    place = np.array([0.0, 0.0, EYE_HEIGHT_M])
    if variant == "spin":
        yaw[:, 2] = pick(rng, scene, 1.3, 1.6) * t
        place = np.array([2.7, 0.2, EYE_HEIGHT_M])
    base = product(rotations(yaw), camera_axes(TILT_RAD))
    return se3.from_matrix(
        place + product(base, offset[..., None])[..., 0], product(base, rotations(angles))
    )


FAST = {
    f"fast_{name}": Variant(
        partial(build_fast, name), "high-dynamic" if name == "walking" else "static"
    )
    for name in SWINGS
}
