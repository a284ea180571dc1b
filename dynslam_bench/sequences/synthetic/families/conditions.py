"""What the sensors dislike: little light, little texture, little depth, depth as in sunlight.

Each with nobody in the room (``empty``) and with the two walking people of the twins.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

from ..scenes.camera_paths import camera_poses
from ..scenes.interiors import add_floor, add_wall, office_bay
from ..scenes.parts import Parts
from ..scenes.plan import plan_room
from ..scenes.world import Optics, World
from .family import Family
from .twins import build_twin

DARK = Optics(gain=0.13, color={"read_noise": 2.4, "shot_noise": 0.12, "shutter": 0.8})
SUNLIGHT = Optics(gain=1.25, depth={"disparity_noise_px": 0.25, "far_m": 4.0, "dark": 0.1, "edge_px": 4})


def build_condition(alter: Callable[[World, int], World], variant: str, instance: int) -> World:
    """The walking twin under a condition, with its own way of the camera."""
    world = alter(build_twin("walking", "xyz", instance), instance)
    camera = partial(camera_poses, "halfsphere", "conditions", instance)
    if variant == "walking":
        return replace(world, camera=camera)
    return replace(world, camera=camera, actors=(), bodies=())


def _plain(world: World, instance: int) -> World:
    """The same things without a pattern."""
    room = Parts()
    room.extend(world.room)
    room.texture = [tuple("plain" for _ in row) for row in room.texture]
    return replace(world, room=room)


def _hall(world: World, instance: int) -> World:
    """A hall whose walls and furniture stand beyond the depth sensor's reach."""
    plan, room, x, front, back = plan_room(instance, 0), Parts(), 7.0, -3.0, 8.6
    add_floor(room, (-x, front), (x, back), plan)
    for start, end in (((-x, front), (x, front)), ((x, front), (x, back)), ((x, back), (-x, back)),
                       ((-x, back), (-x, front))):  # fmt: skip
        add_wall(room, start, end, plan)
    for k in range(3):
        room.extend(office_bay(instance, k), 0.0, ((k - 1) * 4.3, back - 0.05, 0.0), f"/{k}")
    for k, side in enumerate((-1, 1)):
        room.extend(office_bay(instance, 3 + k), -90.0 * side, (side * (x - 0.05), 5.0, 0.0), f"/{3 + k}")
    return replace(world, room=room, window=(0.0, back, 2.15))


def _seen_by(optics: Optics) -> Callable[[World, int], World]:
    return lambda world, _: replace(world, optics=optics)


_TAGS: dict[str, tuple[str, ...]] = {"empty": ("static",), "walking": ("high-dynamic",)}

CONDITIONS = tuple(
    Family(name, tuple(_TAGS), partial(build_condition, alter), _TAGS)
    for name, alter in (("dark", _seen_by(DARK)), ("blank", _plain), ("far", _hall), ("outdoor", _seen_by(SUNLIGHT)))
)
