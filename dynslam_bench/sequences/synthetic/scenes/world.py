"""What an instance of a family films, as data: a room, rigid bodies on paths, people, a camera, two sensors."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..people.bodies import Person, Posture
from .parts import Parts

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
    """Everything that an instance of a family decides.

    Attributes:
        room: What never moves.
        camera: Times ``[N]`` in seconds to camera-to-world poses ``[N, 4, 4]``.
        window: Where the glare of `RenderSettings` comes from, world coordinates in metres.
        bodies: Rigid things.
        actors: People.
        optics: The sensors.
    """

    room: Parts
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
