"""Primitives of a scene: unit shapes in a local frame, how to collect them, and timelines of things that move."""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike

from dynslam_bench.sequences.synthetic.arithmetic import Array, cos, norm, product, sin

# kinds of primitives, as the kernels tell them apart
BOX = 0
ROUND_CONE = 1
QUAD = 2


@dataclass(frozen=True, eq=False)
class Primitive:
    """One shape. A local point p lies in the world at ``rotation @ (scale * p) + origin``; see `primitive`.

    Attributes:
        kind: `BOX`, `ROUND_CONE` or `QUAD`.
        rotation: ``[3, 3]``, local to world.
        origin: ``[3]``, world position of the local origin, metres.
        scale: ``[3]``, factors of the local axes.
        shape: ``[3]``, sizes in the local frame, metres; see `primitive`.
        instance: Number of the object it belongs to; 0 for the background.
        texture: Six names, one a face.
        uv: ``[6, 4]``: repeats and shift of the texture along both axes of each face.
        tint: ``[3]``, factors of the colour channels.
    """

    kind: int
    rotation: Array
    origin: Array
    scale: Array
    shape: Array
    instance: int
    texture: tuple[str, ...]
    uv: Array
    tint: Array


Primitives = list[Primitive]
"""The primitives that a thing is made of."""


def primitive(
    kind: int,
    rotation: Array,
    origin: ArrayLike,
    shape: tuple[float, float, float],
    *,
    instance: int = 0,
    texture: str | tuple[str, ...] = "plain",
    repeat: tuple[float, float] = (1.0, 1.0),
    shift: tuple[float, float] = (0.0, 0.0),
    tint: tuple[float, float, float] | Array = (1.0, 1.0, 1.0),
    scale: tuple[float, float, float] = (1.0, 1.0, 1.0),
    fit: tuple[int, ...] = (),
) -> Primitive:
    """One primitive; see `box`, `cone` and `quad`.

    Args:
        kind: `BOX` (half extents), `ROUND_CONE` (height, radius below, radius above) or `QUAD`
            (half extents x, y).
        rotation: 3x3, local to world.
        origin: World position of the local origin, metres.
        shape: See `kind`.
        instance: 0 for the background.
        texture: One name, or six for the faces -x +x -y +y -z +z.
        repeat: Texture repeats a metre (around a cone: repeats a turn, repeats a metre).
        shift: Texture offset in repeats.
        tint: Factor of each colour channel.
        scale: Local scale of each axis.
        fit: Faces on which the texture is stretched to fit once.
    """
    names = (texture,) * 6 if isinstance(texture, str) else texture
    uv = np.array([(*repeat, *shift)] * 6, dtype=np.float64)
    # once over the whole face: texture coordinates 0 to 1 over the extent of the face's two axes
    for face in fit:
        du, dv = ((1, 2), (0, 2), (0, 1))[face // 2]
        uv[face] = (0.5 / shape[du], 0.5 / shape[dv], 0.5, 0.5)
    return Primitive(
        kind,
        rotation,
        origin=np.asarray(origin, dtype=np.float64),
        scale=np.asarray(scale, dtype=np.float64),
        shape=np.asarray(shape, dtype=np.float64),
        instance=instance,
        texture=names,
        uv=uv,
        tint=np.asarray(tint, dtype=np.float64),
    )


# `primitive` of each kind
box = partial(primitive, BOX)
cone = partial(primitive, ROUND_CONE)
quad = partial(primitive, QUAD)


def copies(
    parts: Primitives, yaw: float, shift: tuple[float, float, float], suffix: str = ""
) -> Primitives:
    """Copies of primitives.

    Args:
        parts: The primitives.
        yaw: Turned by this many degrees about the world's z axis, then ...
        shift: ... moved by this much, metres.
        suffix: Put behind the names of patterned textures, so that they are drawn again.
    """
    body = rotation_about_z(yaw)
    return [
        replace(
            part,
            rotation=product(body, part.rotation),
            origin=product(body, part.origin) + shift,
            texture=tuple(name + suffix if ":" in name else name for name in part.texture),
        )
        for part in parts
    ]


def rotation_about_z(degrees: float) -> Array:
    """Rotation ``[3, 3]`` about the world's z axis."""
    a = np.radians(degrees)
    c = cos(a)
    s = sin(a)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def wall(x_axis: tuple[float, float, float], y_axis: tuple[float, float, float]) -> Array:
    """Rotation ``[3, 3]`` of a quad whose local x and y run along these world axes."""
    x = np.array(x_axis)
    y = np.array(y_axis)
    return np.stack([x, y, np.cross(x, y)], axis=1)


def along(start: Array, end: Array, side: Array) -> tuple[Array, float]:
    """Rotation ``[3, 3]`` of a frame whose z axis runs from start to end, its x axis towards `side`; and the length."""
    length = float(norm(end - start))
    z = (end - start) / length
    # what is left of `side` without its part along z (Gram-Schmidt)
    x = side - product(side, z) * z
    x = x / norm(x)
    return np.stack([x, np.cross(z, x), z], axis=1), length


# Timelines: places at a few times, eased in between.


@dataclass(frozen=True)
class At:
    """Place and direction of a thing at one time: a key of its timeline.

    Attributes:
        t: Seconds.
        x: World position, metres.
        y: World position, metres.
        z: World position, metres.
        yaw: Degrees about the vertical, not reduced to a turn.
    """

    t: float
    x: float
    y: float
    z: float = 0.0
    yaw: float = 0.0


@dataclass(frozen=True)
class Key:
    """Place and activity of a person, or place of a chair, at one time: a key of the timeline.

    Attributes:
        t: Seconds.
        x: World position, metres.
        y: World position, metres.
        facing: Degrees, 0 looks along +y; between two keys the smaller angle is turned.
        sit: 0 stands, 1 sits.
        gesture: 0 arms at rest, 1 lively.
    """

    t: float
    x: float
    y: float
    facing: float
    sit: float = 0.0
    gesture: float = 0.0


KeyT = TypeVar("KeyT", At, Key)


def between(keys: Sequence[KeyT], time: float) -> tuple[KeyT, KeyT, float]:
    """The keys before and after a time, and how far it lies between them, 0 to 1; after the last key that one twice."""
    for before, after in itertools.pairwise(keys):
        if time < after.t:
            return before, after, max(time - before.t, 0.0) / (after.t - before.t)
    return keys[-1], keys[-1], 0.0


def ease(share: float) -> float:
    """A share of the way as a share of the time: slow at both ends (a cubic, "smoothstep")."""
    return share * share * (3 - 2 * share)


def angle_between(start: float, end: float, share: float) -> float:
    """From one direction to another through the smaller angle, degrees."""
    return start + share * ((end - start + 180.0) % 360.0 - 180.0)


def on_track(keys: tuple[At, ...], period: float | None, time: float) -> tuple[Array, Array]:
    """Rotation 3x3 and origin of a thing at a time.

    Args:
        keys: In order of time.
        period: After this it begins again, seconds; None lets it stay at the last place.
        time: Seconds from the start.
    """
    a, b, share = between(keys, time if period is None else time % period)
    e = ease(share)
    place = np.array([a.x + e * (b.x - a.x), a.y + e * (b.y - a.y), a.z + e * (b.z - a.z)])
    return rotation_about_z(a.yaw + e * (b.yaw - a.yaw)), place
