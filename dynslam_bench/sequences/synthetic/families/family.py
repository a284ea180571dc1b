"""What announces a family of rendered sequences."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

from ..scenes.world import World
from ..settings import DEFAULT_FRAMES

Value = TypeVar("Value", int, tuple[str, ...])


@dataclass(frozen=True)
class Family:
    """Rendered sequences of one kind, ``synthetic/<name>_<variant>``.

    Attributes:
        name: First part of the ids.
        variants: Second parts; the empty one stands for the name alone.
        build: Variant and instance to the world that is filmed.
        tags: As in the catalogue: ``static``, ``low-dynamic``, ``high-dynamic``; of each variant, or of all.
        frames: Default length of each variant, or of all.
        versions: Raised whenever any pixel, pose or mask changes; of each variant, or of all.
    """

    name: str
    variants: tuple[str, ...]
    build: Callable[[str, int], World]
    tags: tuple[str, ...] | dict[str, tuple[str, ...]]
    frames: int | dict[str, int] = DEFAULT_FRAMES
    versions: int | dict[str, int] = 1

    def length(self, variant: str) -> int:
        """Default number of frames of a variant."""
        return _of(self.frames, variant)

    def version(self, variant: str) -> int:
        """Version of a variant."""
        return _of(self.versions, variant)

    def tags_of(self, variant: str) -> tuple[str, ...]:
        """How much moves in a variant."""
        return _of(self.tags, variant)

    def ids(self) -> list[str]:
        """All ids, for example ``synthetic/walking_xyz``."""
        return [f"synthetic/{self.name}" + (f"_{variant}" if variant else "") for variant in self.variants]


def _of(values: Value | dict[str, Value], variant: str) -> Value:
    return values[variant] if isinstance(values, dict) else values
