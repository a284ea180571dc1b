"""What part of which sequence is seen, whatever it is called: equal frames have one identity in every spelling."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

from dynslam_bench.contracts.sequence import Sequence
from dynslam_bench.core.records import digest

from .view import SequenceView


@dataclass(frozen=True)
class Part:
    """Which frames of which content are seen.

    Attributes:
        id: Id without a length: ``synthetic/walking_xyz@0`` for all its lengths; a noise seed stays in it.
        content: Digest of the whole content, however much of it is seen.
        scene: The same without the draw of the sensors' noise.
        camera: Intrinsics of the camera before any preprocessing.
        start: First frame of the named part in the numbering of the whole sequence, before any offset.
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


def part_of(sequence: Sequence, offset: int = 0) -> Part:
    """What part a sequence is.

    A sequence whose frames are cut from a longer one may offer ``whole_id``, ``scene_digest()`` and ``noise``, as the
    rendered ones do; any other is its own whole.

    Args:
        sequence: The opened sequence, cut and preprocessed or not.
        offset: How many leading frames of the named part were dropped to get it.
    """
    base, frames = _unwrapped(sequence)
    noise: int | None = getattr(base, "noise", None)
    scene_digest = getattr(base, "scene_digest", None)
    scene = base.digest() if scene_digest is None else str(scene_digest())
    return Part(
        id=str(getattr(base, "whole_id", base.id)),
        content=scene if noise is None else digest([scene, noise]),
        scene=scene,
        camera={
            name: value
            for name, value in asdict(base.camera).items()
            if name not in ("readout_s", "depth_delay_s") or value
        },
        start=frames.start - offset,
        stop=frames.stop,
        stride=frames.step,
        noise=noise,
    )


def _unwrapped(sequence: Any) -> tuple[Any, range]:
    """The sequence below all views and preprocessing, and which of its frames are seen."""
    from .preprocessing import Preprocessed

    frames = range(len(sequence))
    while isinstance(sequence, SequenceView | Preprocessed):
        if isinstance(sequence, SequenceView):
            frames = sequence.range[frames.start : frames.stop : frames.step]
        sequence = sequence.base
    return sequence, frames
