"""Ids and families of the rendered sequences; light: imports neither numba nor OpenCV."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from dynslam_bench.core.errors import SequenceError, did_you_mean
from dynslam_bench.sequences.synthetic.loops import FAST, LOOP, TRACKING
from dynslam_bench.sequences.synthetic.objects import OBJECTS
from dynslam_bench.sequences.synthetic.replicas import CONDITIONS, CROWD, SITTING, SYNCHRONOUS, WALKING, Family
from dynslam_bench.sequences.synthetic.scene import World
from dynslam_bench.sequences.synthetic.settings import DEFAULT_FRAMES, HELD_OUT_SCENES, MAX_FRAMES

FAMILIES: dict[str, Family] = {
    family.name: family for family in (WALKING, SITTING, LOOP, FAST, OBJECTS, CROWD, SYNCHRONOUS, TRACKING, *CONDITIONS)
}
REPLICA_IDS = (*WALKING.ids(), *SITTING.ids())
"""The eight synthetic replicas of TUM's fr3 dynamic sequences."""
SYNTHETIC_IDS = tuple(name for family in FAMILIES.values() for name in family.ids())
"""Every rendered sequence that is listed, scene 0, default length."""


_OPTIONS = {"scene": (0, HELD_OUT_SCENES.stop - 1), "frames": (1, MAX_FRAMES), "noise": (0, 999_999_999)}
"""What may stand behind the question mark, with the least and the largest value."""
_ID = re.compile(r"synthetic/(?P<name>[^@?]*)(?:@(?P<scene>[^?]*))?(?:\?(?P<query>.*))?", re.DOTALL)


@dataclass(frozen=True)
class SyntheticId:
    """A parsed id ``synthetic/<family>_<variant>[?scene=N][&frames=N][&noise=SEED]``.

    Attributes:
        family: For example ``walking`` or ``loop``.
        variant: For the replicas of TUM's sequences the camera's motion; may be empty.
        scene: Selects room, textures, clothes and paths: 0-99 for tuning and training, 100-199 held out.
        frames: Length of the sequence; frames are the same whatever the length.
        noise: Seed of the sensors' noise: another draw of the same scene. None is the scene's own draw.
    """

    family: str
    variant: str
    scene: int = 0
    frames: int = DEFAULT_FRAMES
    noise: int | None = None

    @property
    def name(self) -> str:
        """For example ``walking_xyz``."""
        return f"{self.family}_{self.variant}" if self.variant else self.family

    @property
    def version(self) -> int:
        """Version of the variant; 0 where the renderer's alone counts."""
        return FAMILIES[self.family].version(self.variant)

    @property
    def tags(self) -> tuple[str, ...]:
        """As in the catalogue, for example ``high-dynamic``."""
        return FAMILIES[self.family].tags_of(self.variant)

    def world(self) -> World:
        """What is filmed."""
        return FAMILIES[self.family].build(self.variant, self.scene)

    @property
    def split(self) -> Literal["tune", "held-out"]:
        """Which split the scene belongs to."""
        return "held-out" if self.scene in HELD_OUT_SCENES else "tune"

    @property
    def whole(self) -> str:
        """The id without its length: what is seen, however much of it."""
        noise = "" if self.noise is None else f"&noise={self.noise}"
        return f"synthetic/{self.name}?scene={self.scene}{noise}"

    def __str__(self) -> str:
        noise = "" if self.noise is None else f"&noise={self.noise}"
        return f"synthetic/{self.name}?scene={self.scene}&frames={self.frames}{noise}"


def parse_synthetic_id(text: str) -> SyntheticId:
    """Parse an id such as ``synthetic/walking_xyz?scene=101&frames=150``; ``walking_xyz@101`` is read as scene 101.

    Raises:
        SequenceError: Unknown name (with a did-you-mean), or a scene, length or noise seed out of range.
    """
    match = _ID.fullmatch(text)
    if match is None:
        raise SequenceError(f"'{text}' is not the id of a rendered sequence", did_you_mean(text, SYNTHETIC_IDS))
    name = f"synthetic/{match['name']}"
    if name not in SYNTHETIC_IDS:
        raise SequenceError(f"unknown rendered sequence '{name}'", did_you_mean(name, SYNTHETIC_IDS))
    family, _, variant = match["name"].partition("_")
    written = [] if match["scene"] is None else [f"scene={match['scene']}"]
    written += [] if match["query"] is None else match["query"].split("&")
    options = {"scene": 0, "frames": FAMILIES[family].length(variant)} | _options(written, text)
    return SyntheticId(family, variant, options["scene"], options["frames"], options.get("noise"))


def _options(written: Sequence[str], text: str) -> dict[str, int]:
    """The values of options such as ``scene=3``, each at most once."""
    options: dict[str, int] = {}
    for option in written:
        key, separator, value = option.partition("=")
        if key not in _OPTIONS or not separator:
            forms = "write ?scene=N, ?frames=N, ?noise=SEED, or several, as ?scene=100&frames=60"
            raise SequenceError(f"'{text}' has an unknown option '{option}'", forms)
        if key in options:
            raise SequenceError(f"'{text}' names {key} twice", "leave one out")
        options[key] = _integer(value, key, text, *_OPTIONS[key])
    return options


def _integer(value: str, what: str, text: str, low: int, high: int) -> int:
    if not re.fullmatch(r"[0-9]{1,9}", value) or not low <= int(value) <= high:
        raise SequenceError(f"{what} '{value}' of '{text}' is not a whole number from {low} to {high}")
    return int(value)
