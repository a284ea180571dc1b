"""Primitives of a scene: unit shapes in a local frame, how to collect them, and paths of rigid bodies."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.sequences.synthetic.arithmetic import cos, product, sin

Array = NDArray[np.float64]

BOX, ROUND_CONE, QUAD = 0, 1, 2


@dataclass
class Parts:
    """Growing lists of primitives; row i of every list belongs to primitive i.

    A local point p lies in the world at ``rotation @ (scale * p) + origin``.
    """

    kind: list[int] = field(default_factory=list)
    rotation: list[Array] = field(default_factory=list)
    origin: list[Array] = field(default_factory=list)
    scale: list[Array] = field(default_factory=list)
    shape: list[Array] = field(default_factory=list)
    instance: list[int] = field(default_factory=list)
    texture: list[tuple[str, ...]] = field(default_factory=list)
    uv: list[Array] = field(default_factory=list)
    tint: list[Array] = field(default_factory=list)

    def __len__(self) -> int:
        return len(self.kind)

    def add(self, kind: int, rotation: Array, origin: Array, shape: tuple[float, float, float], *, instance: int = 0,
            texture: str | tuple[str, ...] = "plain", repeat: tuple[float, float] = (1.0, 1.0),
            shift: tuple[float, float] = (0.0, 0.0), tint: tuple[float, float, float] | Array = (1.0, 1.0, 1.0),
            scale: tuple[float, float, float] = (1.0, 1.0, 1.0),
            fit: tuple[int, ...] = ()) -> None:  # fmt: skip
        """Add one primitive.

        Args:
            kind: `BOX` (half extents), `ROUND_CONE` (height, radius below, radius above) or `QUAD` (half extents x, y).
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
        uv = np.tile(np.array([*repeat, *shift], dtype=np.float64), (6, 1))
        for face in fit:
            du, dv = ((1, 2), (0, 2), (0, 1))[face // 2]
            uv[face] = (0.5 / shape[du], 0.5 / shape[dv], 0.5, 0.5)
        self.kind.append(kind)
        self.rotation.append(np.asarray(rotation, dtype=np.float64))
        self.origin.append(np.asarray(origin, dtype=np.float64))
        self.scale.append(np.asarray(scale, dtype=np.float64))
        self.shape.append(np.asarray(shape, dtype=np.float64))
        self.instance.append(instance)
        self.texture.append(names)
        self.uv.append(uv)
        self.tint.append(np.asarray(tint, dtype=np.float64))

    def extend(
        self, other: Parts, yaw: float = 0.0, shift: tuple[float, float, float] | None = None, suffix: str = ""
    ) -> None:
        """Add copies of all primitives of `other`.

        Args:
            other: Whose primitives.
            yaw: Turned by this many degrees about the world's z axis, then ...
            shift: ... moved by this much, metres; None leaves them where they are.
            suffix: Put behind the names of patterned textures, so that they are drawn again.
        """
        for name in ("kind", "scale", "shape", "instance", "uv", "tint"):
            getattr(self, name).extend(getattr(other, name))
        self.texture += [tuple(kind + suffix if ":" in kind else kind for kind in row) for row in other.texture]
        if shift is None:
            self.rotation += other.rotation
            self.origin += other.origin
        else:
            body = turn(yaw)
            self.rotation += [product(body, rotation) for rotation in other.rotation]
            self.origin += [product(body, origin) + shift for origin in other.origin]


def turn(degrees: float) -> Array:
    """Rotation about the world's z axis."""
    a = np.radians(degrees)
    c, s = cos(a), sin(a)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def wall(x_axis: tuple[float, float, float], y_axis: tuple[float, float, float]) -> Array:
    """Rotation of a quad whose local x and y run along these world axes."""
    x, y = np.array(x_axis), np.array(y_axis)
    return np.stack([x, y, np.cross(x, y)], axis=1)


def along(start: Array, end: Array, side: Array) -> tuple[Array, float]:
    """Frame whose z axis runs from start to end, its x axis towards `side`; and the length."""
    z = end - start
    length = float(np.sqrt(product(z, z)))
    z = z / length
    x = side - (product(side, z)) * z
    x = x / np.sqrt(product(x, x))
    return np.stack([x, _cross(z, x), z], axis=1), length


def _cross(a: Array, b: Array) -> Array:
    """The cross product of two vectors, ``[3]``, numpy's to the bit, without its overhead."""
    (a0, a1, a2), (b0, b1, b2) = a.tolist(), b.tolist()
    return np.array([a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0])


# Paths of rigid things: places at a few times, eased in between.


@dataclass(frozen=True)
class At:
    """Where a thing is at one time: seconds, metres, degrees about the vertical (not reduced to a turn)."""

    t: float
    x: float
    y: float
    z: float = 0.0
    yaw: float = 0.0


def on_track(keys: tuple[At, ...], period: float | None, time: float) -> tuple[Array, Array]:
    """Rotation 3x3 and origin of a thing at a time.

    Args:
        keys: In order of time.
        period: After this it begins again, seconds; None lets it stay at the last place.
        time: Seconds from the start.
    """
    local = time if period is None else time % period
    for a, b in itertools.pairwise(keys):
        if local < b.t:
            s = max(local - a.t, 0.0) / (b.t - a.t)
            e = s * s * (3 - 2 * s)
            place = np.array([a.x + e * (b.x - a.x), a.y + e * (b.y - a.y), a.z + e * (b.z - a.z)])
            return turn(a.yaw + e * (b.yaw - a.yaw)), place
    k = keys[-1]
    return turn(k.yaw), np.array([k.x, k.y, k.z])
