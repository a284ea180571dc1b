"""A scene to be filmed: static parts, rigid bodies on paths, people, a camera, two sensors.

`World` is the description, `Scene` its primitives at any time, `View` how the rows of one frame see
them.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from itertools import chain
from typing import Any

import numpy as np

from dynslam_bench.core.seeding import stream
from dynslam_bench.sequences.synthetic import textures
from dynslam_bench.sequences.synthetic.arithmetic import Array, norm, product
from dynslam_bench.sequences.synthetic.parts import QUAD, ROUND_CONE, Primitives
from dynslam_bench.sequences.synthetic.people import Person, Posture, build_person
from dynslam_bench.sequences.synthetic.settings import CAMERA, DEFAULT_FRAMES, FPS, RenderSettings
from dynslam_bench.sequences.tags import Tag

Placement = Callable[[float], tuple[Array, Array]]
"""Time in seconds to the rotation 3x3 and the origin (metres) of a rigid body in the world."""


@dataclass(frozen=True, eq=False)
class Body:
    """A rigid thing that may move.

    Attributes:
        instance: Its id in the masks, 1-255; its parts carry the same.
        name: Class name; a COCO name where there is one.
        parts: Its primitives about its own origin.
        path: Where it is at a time.
    """

    instance: int
    name: str
    parts: Primitives
    path: Placement


Actor = tuple[Person, Callable[[float], Posture]]
"""A person and what they do at a time in seconds; `Person.instance` is the id in the masks."""


@dataclass(frozen=True, eq=False)
class Optics:
    """Settings of a sequence's sensors that differ from the defaults.

    Attributes:
        readout_s: Seconds from the first row's exposure to the last one's; 0 is a global shutter.
            The frame's stamp and pose belong to the middle of the image.
        auto_exposure: 0 keeps the exposure, 1 brings every image to the same mean brightness.
        gain: Brightness of the lamps, or what gives it for a time in seconds.
        color: Settings of `ColorSensor` that differ, where the user left them.
        depth: Settings of `DepthSensor` that differ, where the user left them.
    """

    readout_s: float = 0.0
    auto_exposure: float = 0.0
    gain: float | Callable[[float], float] = 1.0
    color: Mapping[str, Any] = field(default_factory=dict)
    depth: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class World:
    """Everything that a scene decides.

    Attributes:
        static: What never moves.
        camera: Times ``[N]`` in seconds to camera-to-world poses ``[N, 4, 4]``.
        window: Where the glare of `RenderSettings` comes from, world coordinates in metres.
        bodies: Rigid things.
        actors: People.
        optics: The sensors.
    """

    static: Primitives
    camera: Callable[[Array], Array]
    window: tuple[float, float, float]
    bodies: tuple[Body, ...] = ()
    actors: tuple[Actor, ...] = ()
    optics: Optics = Optics()

    @property
    def class_names(self) -> dict[int, str]:
        """Class name of every instance id."""
        names = {person.instance: "person" for person, _ in self.actors}
        return dict(sorted((names | {body.instance: body.name for body in self.bodies}).items()))


@dataclass(frozen=True, eq=False)
class Variant:
    """A rendered sequence in all its scenes, ``synthetic/<name>``.

    Attributes:
        build: Makes the world that is filmed in a scene, from the scene's number.
        tag: How much of the scene moves.
        frames: Default length.
        version: Raised whenever any pixel, pose or mask changes; 0 where the renderer's version
            alone counts.
    """

    build: Callable[[int], World]
    tag: Tag
    frames: int = DEFAULT_FRAMES
    version: int = 1


# A scene: the primitives of the static world, of bodies and of people at any time.

MOVED_M = 5e-4
"""An instance moves in a frame if a point of it has moved by more than this since the previous frame."""


@dataclass(frozen=True, eq=False)
class View:
    """All P primitives as one frame sees them.

    Attributes:
        pose: The camera's pose when the middle of the image is exposed.
        rows: ``[R, 4, 4]`` poses of all rows; R is 1 under a global shutter, else the height of the
            image.
        rotation: ``[P, 3, 3]`` local (scaled) to world, when the middle of the image is exposed.
        origin: ``[P, 3]`` world positions of the local origins at that time, metres.
    """

    pose: Array
    rows: Array
    rotation: Array
    origin: Array

    @property
    def rolling(self) -> bool:
        """Whether every row has its own pose."""
        return len(self.rows) > 1

    def pose_of(self, row: int) -> Array:
        """The pose of a row."""
        return self.rows[row] if self.rolling else self.pose


def row_times(index: int, readout_s: float) -> Array:
    """Times when frame `index` exposes its rows, seconds from the start; the image's middle at its stamp."""
    rows = (np.arange(CAMERA.height) + 0.5) / CAMERA.height - 0.5
    return index / FPS + rows * readout_s


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
        self.moves = settings.people == "moving"
        self.actors = () if settings.people == "none" else world.actors

        # all primitives, in the order in which `_place` moves them: static parts, bodies, people.
        bodies = (body.parts for body in world.bodies)
        people = (build_person(person, posture(0.0)) for person, posture in self.actors)
        parts = [*world.static, *chain(*bodies, *people)]

        # their attributes as arrays ``[P, ...]``.
        self.kind = np.array([part.kind for part in parts]).astype(np.int32)
        self.instance = np.array([part.instance for part in parts]).astype(np.int32)
        self.scale = np.array([part.scale for part in parts])
        self.shape = np.array([part.shape for part in parts])
        self.uv = np.array([part.uv for part in parts])
        self.tint = np.array([part.tint for part in parts])
        self._rotation = np.array([part.rotation for part in parts])
        self._origin = np.array([part.origin for part in parts])

        # textures by number
        self.texture_names = sorted({name for part in parts for name in part.texture})
        number = {name: i for i, name in enumerate(self.texture_names)}
        faces = [[number[name] for name in part.texture] for part in parts]
        self.texture = np.array(faces, np.int32)
        self.corners = self._corners()
        # neighbouring frames ask for the same places and views
        self._placed = lru_cache(maxsize=8)(self._place)
        self.view = lru_cache(maxsize=8)(self._view)
        """The scene as frame `index` sees it."""

    @cached_property
    def atlas(self) -> textures.TextureAtlas:
        """The scene's textures; drawn when the first frame is coloured."""
        drawn = []
        for name in self.texture_names:
            draw = textures.MAKERS[name.partition(":")[0]]
            drawn.append(draw(stream(self.seed, "synthetic", "texture", name)))
        return textures.build_atlas(drawn)

    def place(self, time: float) -> tuple[Array, Array]:
        """Rotation ``[P, 3, 3]`` and origin ``[P, 3]`` of every primitive at a time (seconds from the start)."""
        return self._placed(time if self.moves else 0.0)

    def _place(self, time: float) -> tuple[Array, Array]:
        """Place static parts, bodies and people at a time."""
        rotation = self._rotation.copy()
        origin = self._origin.copy()
        end = len(self.world.static)

        # bodies: their parts turn and move with them
        for body in self.world.bodies:
            part = slice(end, end + len(body.parts))
            R_world_body, position = body.path(time)
            rotation[part] = product(R_world_body, rotation[part])
            origin[part] = product(origin[part], R_world_body.T) + position
            end = part.stop

        # people: built again in their posture
        people = [build_person(person, posture(time)) for person, posture in self.actors]
        limbs = list(chain(*people))
        if limbs:
            rotation[end:] = [part.rotation for part in limbs]
            origin[end:] = [part.origin for part in limbs]
        return rotation, origin

    def _view(self, index: int) -> View:
        """The scene as frame `index` sees it; things stand still while its rows are read."""
        time = index / FPS
        readout_s = self.world.optics.readout_s
        pose = self.world.camera(np.array([time]))[0]
        rows = self.world.camera(row_times(index, readout_s)) if readout_s else pose[None]
        return View(pose, rows, *self.place(time))

    def moving(self, index: int) -> frozenset[int]:
        """Instances with a point that moved by more than `MOVED_M` since the previous frame; frame 0 has none."""
        if index == 0 or not self.moves:
            return frozenset()
        # places in this frame and in the previous one
        rotation_before, origin_before = self.place((index - 1) / FPS)
        rotation, origin = self.place(index / FPS)

        # motion of the corners of every primitive's box: no point inside moves by more.
        box = self.corners * self.scale[:, None, :]
        turned = product(box, np.swapaxes(rotation - rotation_before, 1, 2))
        shift = turned + (origin - origin_before)[:, None, :]
        moved = norm(shift).max(axis=1) > MOVED_M
        return frozenset(int(k) for k in np.unique(self.instance[moved]) if k > 0)

    def _corners(self) -> Array:
        """Corners ``[P, 8, 3]`` of each primitive's box in its local frame."""
        # boxes: half extents; quads: the same, without depth
        low = -self.shape.copy()
        high = self.shape.copy()
        low[self.kind == QUAD, 2] = 0.0
        high[self.kind == QUAD, 2] = 0.0

        # round cones: around the spheres at both ends
        cones = self.kind == ROUND_CONE
        h, r1, r2 = self.shape[cones].T
        radius = np.maximum(r1, r2)
        low[cones] = np.stack([-radius, -radius, np.minimum(-r1, h - r2)], 1)
        high[cones] = np.stack([radius, radius, np.maximum(h + r2, r1)], 1)

        # bit k of a corner's number is its side along axis k
        is_high = np.array([[(i >> axis) & 1 for axis in range(3)] for i in range(8)], dtype=bool)
        return np.where(is_high[None], high[:, None, :], low[:, None, :])
