"""What a scene of a family films: static parts, rigid bodies on paths, people, a camera, two sensors.

`World` is the description, `Scene` its primitives at any time and their motion between two times.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.core.seeding import stream
from dynslam_bench.sequences.synthetic import textures
from dynslam_bench.sequences.synthetic.arithmetic import norm, product
from dynslam_bench.sequences.synthetic.parts import QUAD, ROUND_CONE, Parts
from dynslam_bench.sequences.synthetic.people import Person, Posture, add_person
from dynslam_bench.sequences.synthetic.settings import FPS, RenderSettings

Array = NDArray[np.float64]
Placement = Callable[[float], tuple[Array, Array]]
"""Time in seconds to the rotation 3x3 and the origin (metres) of a rigid body in the world."""


@dataclass(frozen=True, eq=False)
class Body:
    """A rigid thing that may move.

    Attributes:
        instance: Its id in the masks, 1-255; its parts carry the same.
        name: Class name; a COCO name where there is one.
        parts: Its primitives about its own origin.
        path: Where it is.
    """

    instance: int
    name: str
    parts: Parts
    path: Placement


@dataclass(frozen=True, eq=False)
class Actor:
    """A person and what they do; `Person.instance` is the id in the masks."""

    person: Person
    posture: Callable[[float], Posture]


@dataclass(frozen=True, eq=False)
class Optics:
    """What a family's sensors do beside the defaults.

    Attributes:
        readout_s: From the first row's exposure to the last one's; 0 is a global shutter. The frame's stamp and pose
            belong to the middle of the image.
        auto_exposure: 0 keeps the exposure, 1 brings every image to the same mean brightness.
        gain: Brightness of the lamps.
        color: Settings of `ColorSensor` that differ, where the user left them.
        depth: Settings of `DepthSensor` that differ, where the user left them.
    """

    readout_s: float = 0.0
    auto_exposure: float = 0.0
    gain: float = 1.0
    color: Mapping[str, Any] = field(default_factory=dict)
    depth: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class World:
    """Everything that a scene of a family decides.

    Attributes:
        static: What never moves.
        camera: Times ``[N]`` in seconds to camera-to-world poses ``[N, 4, 4]``.
        window: Where the glare of `RenderSettings` comes from, world coordinates in metres.
        bodies: Rigid things.
        actors: People.
        optics: The sensors.
    """

    static: Parts
    camera: Callable[[Array], Array]
    window: tuple[float, float, float]
    bodies: tuple[Body, ...] = ()
    actors: tuple[Actor, ...] = ()
    optics: Optics = Optics()

    @property
    def class_names(self) -> dict[int, str]:
        """Class name of every instance id."""
        names = {actor.person.instance: "person" for actor in self.actors}
        return dict(sorted((names | {body.instance: body.name for body in self.bodies}).items()))


# A scene: the room's primitives, those of people and chairs at any time, and their motion between two times.


MOVED_M = 5e-4
"""An instance moves in a frame if a point of it has moved by more than this since the previous frame."""


@dataclass(frozen=True, eq=False)
class Snapshot:
    """All primitives at one time: world placement, and the map from the camera to each local frame.

    Attributes:
        T_world_cam: The camera's pose.
        rotation: ``[P, 3, 3]`` local (scaled) to world.
        origin: ``[P, 3]``.
        local: ``[P, 12]`` row-major 3x4 map of points of the camera frame into the local frame.
    """

    T_world_cam: Array
    rotation: Array
    origin: Array
    local: Array


class _Poses(Parts):
    """Collects the placement only; everything else is known from the first time."""

    def add(self, kind: int, rotation: Array, origin: Array, *_: object, **__: object) -> None:
        self.rotation.append(rotation)
        self.origin.append(origin)


class Scene:
    """Everything of a sequence that does not depend on pixels.

    Args:
        world: What is filmed.
        scene: Number of the scene, the seed of the textures.
        settings: Renderer settings; only `people` matters here.
    """

    def __init__(self, world: World, scene: int, settings: RenderSettings) -> None:
        self.world = world
        self.seed = scene
        self.mode = settings.people
        self.actors = () if self.mode == "none" else world.actors
        parts = Parts()
        parts.extend(world.static)
        self._bodies = [(np.stack(body.parts.rotation), np.stack(body.parts.origin)) for body in world.bodies]
        for body in world.bodies:
            parts.extend(body.parts)
        self.fixed = len(world.static)
        for actor in self.actors:
            add_person(parts, actor.person, actor.posture(0.0))
        self.kind = np.array(parts.kind, np.int32)
        self.scale, self.shape = np.stack(parts.scale), np.stack(parts.shape)
        self.instance = np.array(parts.instance, np.int32)
        self.uv, self.tint = np.stack(parts.uv), np.stack(parts.tint)
        self._fixed_rotation = np.stack(parts.rotation[: self.fixed])
        self._fixed_origin = np.stack(parts.origin[: self.fixed])
        names = sorted({name for row in parts.texture for name in row})
        index = {name: i for i, name in enumerate(names)}
        self.texture = np.array([[index[name] for name in row] for row in parts.texture], np.int32)
        self.texture_names = names
        self.corners = self._corners()
        self._placed = lru_cache(maxsize=8)(self._place)

    def atlas(self) -> textures.TextureAtlas:
        """The scene's textures."""
        images = {}
        for name in self.texture_names:
            maker = textures.MAKERS[name.partition(":")[0]]
            images[name] = maker(stream(self.seed, "synthetic", "texture", name))
        return textures.build_atlas(images)

    def poses(self, times: Array) -> Array:
        """Camera-to-world poses ``[N, 4, 4]``."""
        return self.world.camera(times)

    def place(self, time: float) -> tuple[Array, Array]:
        """Rotation ``[P, 3, 3]`` and origin ``[P, 3]`` of every primitive at a time (seconds from the start).

        The last few times are kept, since neighbouring frames ask for the same ones.
        """
        return self._placed(time if self.mode == "moving" else 0.0)

    def _place(self, t: float) -> tuple[Array, Array]:
        parts = _Poses()
        for actor in self.actors:
            add_person(parts, actor.person, actor.posture(t))
        rotations, origins = [self._fixed_rotation], [self._fixed_origin]
        for (rotation, origin), body in zip(self._bodies, self.world.bodies, strict=True):
            turned, shift = body.path(t)
            rotations.append(product(turned, rotation))
            origins.append(product(origin, turned.T) + shift)
        if parts.rotation:
            rotations.append(np.stack(parts.rotation))
            origins.append(np.stack(parts.origin))
        return np.concatenate(rotations), np.concatenate(origins)

    def snapshot(self, time: float) -> Snapshot:
        """The scene as the camera sees it at a time (seconds from the start)."""
        return self.snapshot_from(self.poses(np.array([time]))[0], time)

    def snapshot_from(self, pose: Array, time: float) -> Snapshot:
        """The scene at a time as a camera at another pose (camera to world, 4x4) would see it."""
        rotation, origin = self.place(time)
        inverse = np.swapaxes(rotation, 1, 2) / self.scale[:, :, None]
        local = np.empty((len(origin), 3, 4))
        local[:, :, :3] = product(inverse, pose[:3, :3])
        local[:, :, 3] = product(inverse, (pose[:3, 3] - origin)[:, :, None])[:, :, 0]
        return Snapshot(pose, rotation, origin, np.ascontiguousarray(local.reshape(-1, 12)))

    def moving(self, index: int) -> frozenset[int]:
        """Instances with a point that moved by more than `MOVED_M` since the previous frame; frame 0 has none."""
        if index == 0 or self.mode != "moving":
            return frozenset()
        before, after = self.place((index - 1) / FPS), self.place(index / FPS)
        box = self.corners[:, :, :] * self.scale[:, None, :]
        moved = norm(product(box, np.swapaxes(after[0] - before[0], 1, 2)) + (after[1] - before[1])[:, None, :]).max(
            axis=1
        )
        return frozenset(int(k) for k in np.unique(self.instance[moved > MOVED_M]) if k > 0)

    def _corners(self) -> Array:
        """Corners ``[P, 8, 3]`` of each primitive's box in its local frame."""
        low, high = -self.shape.copy(), self.shape.copy()
        low[self.kind == QUAD, 2] = high[self.kind == QUAD, 2] = 0.0
        cones = self.kind == ROUND_CONE
        h, r1, r2 = self.shape[cones].T
        radius = np.maximum(r1, r2)
        low[cones] = np.stack([-radius, -radius, np.minimum(-r1, h - r2)], 1)
        high[cones] = np.stack([radius, radius, np.maximum(h + r2, r1)], 1)
        choose = np.array([[(i >> a) & 1 for a in range(3)] for i in range(8)], dtype=bool)
        return np.where(choose[None], high[:, None, :], low[:, None, :])
