"""What every segmenter returns, and the protocol of a segmenter."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from .sequence import Frame


@dataclass(frozen=True, eq=False)
class Instances:
    """Objects found in one image.

    Attributes:
        masks: bool ``[K, H, W]`` at the frame's resolution.
        boxes: float32 ``[K, 4]``: x0, y0, x1, y1 in pixels (x1, y1 exclusive).
        class_names: COCO name of each object, e.g. ``"person"``.
        scores: float32 ``[K]`` in [0, 1].
    """

    masks: NDArray[np.bool_]
    boxes: NDArray[np.float32]
    class_names: tuple[str, ...]
    scores: NDArray[np.float32]
    moving: NDArray[np.bool_] | None = field(default=None)
    """bool ``[K]``: which objects move, known to oracles only; None for everybody else."""

    def __len__(self) -> int:
        return len(self.class_names)

    @classmethod
    def empty(cls, height: int, width: int) -> Instances:
        """No objects in an image of this size."""
        boxes, scores = np.zeros((0, 4), np.float32), np.zeros(0, np.float32)
        return cls(np.zeros((0, height, width), bool), boxes, (), scores)

    def of_classes(self, names: Collection[str]) -> Instances:
        """Only the objects of these classes."""
        keep = np.array([name in names for name in self.class_names], dtype=bool)
        kept = tuple(name for name in self.class_names if name in names)
        moving = None if self.moving is None else self.moving[keep]
        return Instances(self.masks[keep], self.boxes[keep], kept, self.scores[keep], moving)

    def union(self) -> NDArray[np.bool_]:
        """Bool ``[H, W]``: pixels of any object."""
        return np.asarray(self.masks.any(axis=0))


@runtime_checkable
class Segmenter(Protocol):
    """Finds objects in a frame. Built once a run by a factory that takes typed settings and a context."""

    def segment(self, frame: Frame) -> Instances:
        """The objects in the frame; no objects is an empty result, never an error."""
        ...
