"""Ids of the rendered sequences; light: imports neither numba nor OpenCV."""

import re
from dataclasses import dataclass, replace
from typing import Literal

from dynslam_bench.core import SequenceError, did_you_mean
from dynslam_bench.sequences.synthetic.buildings import LOOPS
from dynslam_bench.sequences.synthetic.families import (
    CHANGING,
    CONDITIONS,
    CROWDS,
    FAST,
    REPLICAS,
    SYNCHRONOUS,
    TRACKING,
)
from dynslam_bench.sequences.synthetic.moving_objects import OBJECTS
from dynslam_bench.sequences.synthetic.scene import Variant
from dynslam_bench.sequences.synthetic.sealed import SCENE_BYTES, scene_of_text
from dynslam_bench.sequences.synthetic.settings import DEFAULT_FRAMES, MAX_FRAMES, TUNE_SCENES

VARIANTS: dict[str, Variant] = {
    **REPLICAS,
    **LOOPS,
    **FAST,
    **OBJECTS,
    **CROWDS,
    **SYNCHRONOUS,
    **TRACKING,
    **CONDITIONS,
    **CHANGING,
}
"""Every rendered sequence by its name, for example ``walking_xyz``."""
REPLICA_IDS = tuple(f"synthetic/{name}" for name in REPLICAS)
"""The eight synthetic replicas of TUM's fr3 dynamic sequences."""
SYNTHETIC_IDS = tuple(f"synthetic/{name}" for name in VARIANTS)
"""Every rendered sequence that is listed, scene 0, default length."""

_OPTIONS = {
    "scene": (0, 2 ** (8 * SCENE_BYTES) - 1),
    "frames": (1, MAX_FRAMES),
    "noise": (0, 999_999_999),
}
"""Options behind the question mark of an id, with the least and the largest value."""
_ID = re.compile(r"synthetic/(?P<name>[^@?]*)(?:@(?P<scene>[^?]*))?(?:\?(?P<query>.*))?", re.DOTALL)

PROBE_FRAMES = 2
"""Frames of a public scene that tell machines apart: the second has motion blur of what moves."""


@dataclass(frozen=True)
class SyntheticId:
    """A parsed id ``synthetic/<name>[?scene=N][&frames=N][&noise=SEED]``.

    Attributes:
        name: For example ``walking_xyz``.
        scene: Selects room, textures, clothes and paths: 0-99 for tuning and training, all others
            held out. It has 64 bits.
        frames: Length of the sequence; frames are the same whatever the length.
        noise: Seed of the sensors' noise: another draw of the same scene. None is the scene's own
            draw.
    """

    name: str
    scene: int = 0
    frames: int = DEFAULT_FRAMES
    noise: int | None = None

    @property
    def variant(self) -> Variant:
        """The settings that all scenes of this name share."""
        return VARIANTS[self.name]

    @property
    def split(self) -> Literal["tune", "held-out"]:
        """Split that the scene belongs to."""
        return "tune" if self.scene in TUNE_SCENES else "held-out"

    @property
    def whole(self) -> str:
        """The id without its length: what is seen, however much of it."""
        return str(self).replace(f"&frames={self.frames}", "", 1)

    def __str__(self) -> str:
        noise = "" if self.noise is None else f"&noise={self.noise}"
        return f"synthetic/{self.name}?scene={self.scene}&frames={self.frames}{noise}"


def parse_synthetic_id(text: str) -> SyntheticId:
    """Parse an id such as ``synthetic/walking_xyz?scene=101&frames=150``; ``walking_xyz@101`` is read as scene 101.

    A sealed scene, ``scene=sealed:ROUND/INDEX``, is read as the number that the salt in the
    environment gives it, see `sealed.sealed_scene`.

    Raises:
        SequenceError: Unknown name (with a did-you-mean), or a scene, length or noise seed out of
            range, or a sealed scene without its salt.
    """
    match = _ID.fullmatch(text)
    if match is None:
        raise SequenceError(
            f"'{text}' is not the id of a rendered sequence", did_you_mean(text, SYNTHETIC_IDS)
        )
    # the name, one of `VARIANTS`
    name = match["name"]
    if name not in VARIANTS:
        near = did_you_mean(f"synthetic/{name}", SYNTHETIC_IDS)
        raise SequenceError(f"unknown rendered sequence 'synthetic/{name}'", near)

    # the options, of which the scene may stand behind an @
    written = [] if match["scene"] is None else [f"scene={match['scene']}"]
    written += [] if match["query"] is None else match["query"].split("&")
    options: dict[str, int] = {}
    for option in written:
        key, separator, value = option.partition("=")
        if key not in _OPTIONS or not separator:
            forms = "write ?scene=N, ?frames=N, ?noise=SEED, or several, as ?scene=100&frames=60"
            raise SequenceError(f"'{text}' has an unknown option '{option}'", forms)
        if key in options:
            raise SequenceError(f"'{text}' names {key} twice", "leave one out")
        sealed = scene_of_text(value, name) if key == "scene" else None
        if sealed is not None:
            options[key] = sealed
            continue
        low, high = _OPTIONS[key]
        if not re.fullmatch(r"[0-9]{1,20}", value) or not low <= int(value) <= high:
            raise SequenceError(
                f"{key} '{value}' of '{text}' is not a whole number from {low} to {high}"
            )
        options[key] = int(value)
    return replace(SyntheticId(name, frames=VARIANTS[name].frames), **options)  # type: ignore[arg-type]  # all integers


def probe_id(family: str) -> str:
    """The id of the public scene whose bits tell machines apart that render a family."""
    return f"synthetic/{family}?scene=0&frames={PROBE_FRAMES}"
