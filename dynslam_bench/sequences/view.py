"""Parts of a sequence: a view with renumbered frames, and the identity of the frames that it shows."""

from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.contracts import Frame, FrameMasks, MaskSource, Sequence, timestamps_ns
from dynslam_bench.core import SequenceError
from dynslam_bench.core.records import digest


class Wrapped:
    """A sequence made of another one, `base`, from which it takes whatever it does not define itself."""

    base: Sequence

    def __getattr__(self, name: str) -> object:
        # `base` is not yet set while unpickling
        if name.startswith("__") or "base" not in vars(self):
            raise AttributeError(name)
        return getattr(self.base, name)


class SequenceView(Wrapped):
    """Part of a sequence: every `stride`-th frame of ``start:stop``; indices and masks are renumbered.

    Args:
        base: The whole sequence.
        start: First frame.
        stop: One past the last frame; None for the end.
        stride: Step between frames.

    Raises:
        SequenceError: The stride is none, or no frame is left.
    """

    def __init__(
        self, base: Sequence, start: int = 0, stop: int | None = None, stride: int = 1
    ) -> None:
        if stride < 1:
            raise SequenceError(f"stride is {stride}, expected at least 1")
        self.base = base
        self.range = range(len(base))[start:stop:stride]
        if not self.range:
            end = "" if stop is None else stop
            raise SequenceError(
                f"frames {start}:{end} hold none of the {len(base)} frames of '{base.id}'"
            )

    @property
    def fps(self) -> float:
        """Selected frames a second."""
        return self.base.fps / self.range.step

    @property
    def timestamps(self) -> NDArray[np.float64]:
        """Stamps of the selected frames."""
        return self.base.timestamps[self.range.start : self.range.stop : self.range.step]

    @property
    def timestamps_ns(self) -> NDArray[np.int64]:
        """Stamps of the selected frames in nanoseconds."""
        return timestamps_ns(self.base)[self.range.start : self.range.stop : self.range.step]

    @property
    def depth_timestamps(self) -> NDArray[np.float64]:
        """Stamps of the selected frames' depth images; the frames' own where the sequence does not state them."""
        stamps = getattr(self.base, "depth_timestamps", self.base.timestamps)
        return np.asarray(stamps[self.range.start : self.range.stop : self.range.step])

    @property
    def masks(self) -> MaskSource | None:
        """Masks of the selected frames, under their new indices."""
        source = self.base.masks
        return None if source is None else Masks(lambda index: source[self.range[index]])

    def __len__(self) -> int:
        return len(self.range)

    def __getitem__(self, index: int) -> Frame:
        frame = self.base[self.range[index]]
        return Frame(range(len(self))[index], frame.timestamp, frame.rgb, frame.depth)


def reader_of(sequence: Sequence) -> str:
    """The module that reads or renders a sequence, whatever views and preprocessing lie around it."""
    base = sequence
    while isinstance(base, Wrapped):
        base = base.base
    return type(base).__module__


@dataclass(frozen=True)
class Masks:
    """A `MaskSource` that is a function of the frame's index."""

    masks_of: Callable[[int], FrameMasks]

    def __getitem__(self, index: int) -> FrameMasks:
        return self.masks_of(index)


# Identity of the frames: equal frames have one identity in every spelling.


@dataclass(frozen=True)
class SequencePart:
    """The part of a sequence that is seen: which frames of which content.

    Attributes:
        id: Id without a length: ``synthetic/walking_xyz?scene=0`` for all its lengths; a noise seed
            stays in it.
        content: Digest of the whole content, however much of it is seen.
        scene: Digest of the content without the draw of the sensors' noise.
        camera: The camera before any preprocessing, without what its ground truth tracks.
        start: First frame of the named part in the numbering of the whole sequence, before any
            offset.
        stop: One past its last frame, never past the end.
        stride: Every so many frames.
        noise: Seed of the sensors' noise, None for the sequence's own.
    """

    id: str
    content: str
    scene: str
    camera: dict[str, Any]
    start: int
    stop: int
    stride: int
    noise: int | None

    @property
    def block(self) -> str:
        """Digest of scene, camera, frames and stride: equal for repeats by offset or noise, and for every spelling."""
        return digest([self.scene, self.camera, self.start, self.stop, self.stride], 16)


def sequence_part_of(sequence: Sequence, offset: int = 0) -> SequencePart:
    """The part of a whole sequence that an opened sequence is.

    A sequence whose frames are cut from a longer one may offer ``whole_id``, ``scene_digest()`` and
    ``noise``, as the rendered ones do; any other is its own whole.

    Args:
        sequence: The opened sequence, cut and preprocessed or not.
        offset: How many leading frames of the named part were dropped to get it.
    """
    # through all views to the whole sequence, and its frames that are seen
    base: Any = sequence
    frames = range(len(sequence))
    while isinstance(base, Wrapped):
        if isinstance(base, SequenceView):
            frames = base.range[frames.start : frames.stop : frames.step]
        base = base.base

    # what is filmed, with and without the draw of the sensors' noise
    noise: int | None = getattr(base, "noise", None)
    scene_digest = getattr(base, "scene_digest", None)
    scene = base.digest() if scene_digest is None else str(scene_digest())
    return SequencePart(
        id=str(getattr(base, "whole_id", base.id)),
        content=scene if noise is None else digest([scene, noise]),
        scene=scene,
        camera={name: value for name, value in asdict(base.camera).items() if name != "R_body_cam"},
        start=frames.start - offset,
        stop=frames.stop,
        stride=frames.step,
        noise=noise,
    )
