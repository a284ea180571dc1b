"""The contract of segmenters: their spec, their context and their result."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.contracts.sequence import Frame, MaskSource


@dataclass(frozen=True, eq=False)
class Instances:
    """Objects found in one image.

    Attributes:
        masks: bool ``[K, H, W]`` at the frame's resolution.
        boxes: float32 ``[K, 4]``: x0, y0, x1, y1 in pixels (x1, y1 exclusive).
        class_names: Class of each object, e.g. ``"person"``: COCO's name where there is one. Case
            does not matter.
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
        masks = np.zeros((0, height, width), bool)
        boxes = np.zeros((0, 4), np.float32)
        return cls(masks, boxes, (), np.zeros(0, np.float32))

    def of_classes(self, names: Collection[str]) -> Instances:
        """Only the objects of these classes."""
        return self.select(np.array([name in names for name in self.class_names], dtype=bool))

    def select(self, keep: NDArray[np.bool_]) -> Instances:
        """Only the objects where `keep`, bool ``[K]``, is true."""
        if keep.all():
            return self
        names = tuple(name for name, kept in zip(self.class_names, keep, strict=True) if kept)
        moving = None if self.moving is None else self.moving[keep]
        return Instances(self.masks[keep], self.boxes[keep], names, self.scores[keep], moving)

    def visible(self) -> Instances:
        """Only the objects with a pixel."""
        return self.select(np.asarray(self.masks.any(axis=(1, 2))))

    def union(self) -> NDArray[np.bool_]:
        """Bool ``[H, W]``: pixels of any object."""
        return np.asarray(self.masks.any(axis=0))


@dataclass(frozen=True)
class SegmenterContext:
    """Facts of the run that a segmenter may use: sequence, device, threads, source.

    Attributes:
        sequence_id: Id of the sequence.
        masks: Exact masks of the sequence, for oracles only; None where there are none.
        device: ``cpu`` or ``cuda:N``.
        threads: Threads it may use.
        argument: What stands after the colon of the source, e.g. a path.
        floor: Least score of a detection that is returned; the settings' confidence is applied
            afterwards.
    """

    sequence_id: str = ""
    masks: MaskSource | None = None
    device: str = "cpu"
    threads: int = 1
    argument: str = ""
    floor: float = 0.1


@dataclass(frozen=True)
class SegmenterSpec:
    """Announces a segmenter; importable without torch or OpenCV.

    Attributes:
        id: For example ``embedded``; users write ``segmentation.source = plugin:ID`` for those that
            are not built in.
        entry_point: ``"module:factory"``, called as ``factory(settings, context)`` with
            `SegmentationSettings` and `SegmenterContext`; returns a `Segmenter`.
        summary: One line.
        license: License of code and weights: an SPDX id or a remark.
        citation: What to cite.
    """

    id: str
    entry_point: str
    summary: str = ""
    license: str = ""
    citation: str = ""


@runtime_checkable
class Segmenter(Protocol):
    """Finds objects in a frame. Built once a run by a factory that takes typed settings and a context."""

    def segment(self, frame: Frame) -> Instances:
        """The objects in the frame; no objects is an empty result, never an error."""


@runtime_checkable
class ForgetsFrames(Protocol):
    """A segmenter that remembers frames, and forgets them where a new sequence begins. Its masks are not stored."""

    def reset(self) -> None:
        """Forget all frames."""
