"""The contract of data sets: what announces them, and what a sequence hands out."""

from dataclasses import dataclass, replace
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.geometry import Camera, Trajectory, from_seconds


@dataclass(frozen=True, eq=False)
class Frame:
    """One synchronised colour and depth image.

    Attributes:
        index: Position in the sequence (after association), from 0.
        timestamp: Seconds, the colour image's stamp.
        rgb: uint8 ``[H, W, 3]``, red first.
        depth: float32 ``[H, W]``, z-depth in metres, 0 where it is missing.
    """

    index: int
    timestamp: float
    rgb: NDArray[np.uint8]
    depth: NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class FrameMasks:
    """Exact (or recorded) object masks of one frame.

    Attributes:
        instances: uint8 or int32 ``[H, W]``: 0 is background, k > 0 is instance k.
        class_names: Class name of each instance id that can occur, e.g.
            ``{1: "person", 3: "chair"}`` (COCO names).
        moving: Ids of the instances that move in this frame (relative to the previous one).
    """

    instances: NDArray[np.integer]
    class_names: dict[int, str]
    moving: frozenset[int]


@runtime_checkable
class MaskSource(Protocol):
    """Gives the masks of a frame by its index."""

    def __getitem__(self, index: int) -> FrameMasks: ...


@runtime_checkable
class Sequence(Protocol):
    """A recorded or rendered RGB-D sequence; frames are decoded (or rendered) when they are asked for.

    One without depth images says so with an attribute ``has_depth`` that is False; its frames'
    depth is 0 everywhere. One whose stamps are known to more digits than a float holds has an
    attribute ``timestamps_ns``, int64 ``[N]``.
    """

    @property
    def id(self) -> str:
        """For example ``tum/fr3/walking_xyz`` or ``synthetic/walking_xyz?scene=0&frames=600``."""

    @property
    def camera(self) -> Camera:
        """Intrinsics of the images that `__getitem__` returns."""

    @property
    def timestamps(self) -> NDArray[np.float64]:
        """Stamps of all frames in seconds, strictly increasing."""

    @property
    def ground_truth(self) -> Trajectory | None:
        """Camera-to-world poses at their own stamps, possibly with holes; None if there are none."""

    @property
    def masks(self) -> MaskSource | None:
        """Exact masks, where the sequence has them."""

    @property
    def fps(self) -> float:
        """Nominal frame rate in Hz."""

    @property
    def license(self) -> str:
        """Licence of the data."""

    @property
    def citation(self) -> str:
        """Citation of the data set, as text."""

    def digest(self) -> str:
        """Short digest of the content (files' names and sizes, or the renderer's version and parameters)."""

    def __len__(self) -> int: ...

    def __getitem__(self, index: int) -> Frame: ...


def read_only(frame: Frame) -> Frame:
    """A copy of the frame whose images cannot be written, for code of others; no pixel is copied.

    A data set may keep its frames, so that what one tracker writes into them would reach the next.
    """
    return replace(frame, rgb=_read_only_view(frame.rgb), depth=_read_only_view(frame.depth))


def read_only_masks(masks: FrameMasks) -> FrameMasks:
    """A copy of the masks that cannot be written; no pixel is copied."""
    return replace(
        masks, instances=_read_only_view(masks.instances), class_names=dict(masks.class_names)
    )


def _read_only_view(image: Any) -> Any:
    view = np.asarray(image).view()
    view.flags.writeable = False
    return view


def timestamps_ns(sequence: Sequence) -> NDArray[np.int64]:
    """Stamps of all frames in nanoseconds, int64 ``[N]``."""
    exact: NDArray[np.int64] | None = getattr(sequence, "timestamps_ns", None)
    return from_seconds(sequence.timestamps.tolist()) if exact is None else exact


def exact_stamps(sequence: Sequence) -> dict[float, int]:
    """The nanoseconds of every frame's stamp by its seconds."""
    return dict(zip(sequence.timestamps.tolist(), timestamps_ns(sequence).tolist(), strict=True))


@dataclass(frozen=True)
class DatasetSpec:
    """Announces a data set; importable without torch or OpenCV.

    Attributes:
        id: Prefix of its sequences: the data set ``mine`` serves ``mine/anything``.
        entry_point: ``"module:factory"``, called as ``factory(sequence_id, data_root=Path)``; it
            returns a `Sequence` or raises a `SequenceError`.
        sequences: Ids that are listed; the factory may accept more.
        summary: One line.
        license: SPDX id or remark.
        citation: What to cite.
    """

    id: str
    entry_point: str
    sequences: tuple[str, ...] = ()
    summary: str = ""
    license: str = ""
    citation: str = ""
