"""What announces a family of rendered sequences."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from ..scenes.world import World
from ..settings import DEFAULT_FRAMES


@dataclass(frozen=True)
class Family:
    """Rendered sequences of one kind, ``synthetic/<name>_<variant>``.

    Attributes:
        name: First part of the ids.
        variants: Second parts; the empty one stands for the name alone.
        build: Variant and instance to the world that is filmed.
        tags: As in the catalogue: ``static``, ``low-dynamic``, ``high-dynamic``.
        frames: Default length of each variant, or of all.
        version: Raised whenever any pixel, pose or mask of this family changes.
    """

    name: str
    variants: tuple[str, ...]
    build: Callable[[str, int], World]
    tags: tuple[str, ...]
    frames: int | dict[str, int] = DEFAULT_FRAMES
    version: int = 1

    def length(self, variant: str) -> int:
        """Default number of frames of a variant."""
        return self.frames if isinstance(self.frames, int) else self.frames[variant]

    def ids(self) -> list[str]:
        """All ids, for example ``synthetic/walking_xyz``."""
        return [f"synthetic/{self.name}" + (f"_{variant}" if variant else "") for variant in self.variants]
