"""Labelled images from sequences with exact masks."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from dynslam_bench.contracts.sequence import Sequence
from dynslam_bench.core.errors import SegmentationError
from dynslam_bench.core.seeding import stream
from dynslam_bench.core.settings import apply_overrides
from dynslam_bench.sequences.catalogue import open_sequence
from dynslam_bench.sequences.synthetic import TWIN_IDS, RenderSettings, parse_synthetic_id
from dynslam_bench.sequences.synthetic.sequence import SyntheticSequence
from dynslam_bench.sequences.synthetic.settings import RENDERER_VERSION

from ..masks.oracle import instances_of
from .labelled import LabelledImage

VARIANTS: tuple[dict[str, object], ...] = (
    {"lighting_change": True},
    {"glare": True},
    {"shadow": True},
    {"color.read_noise": 6.0, "color.shot_noise": 0.1},
    {"color.shutter": 0.9},
    {"color.shutter": 0.0, "color.read_noise": 0.0, "color.shot_noise": 0.0},
)
"""Renderer options that a share of the training frames is rendered with."""


@dataclass(frozen=True)
class SequenceFrames:
    """Every frame of a sequence that has masks."""

    sequence: Sequence

    @classmethod
    def open(cls, sequence_id: str) -> SequenceFrames:
        """Open a sequence by id or folder.

        Raises:
            SegmentationError: It has no masks.
        """
        sequence = open_sequence(sequence_id)
        if sequence.masks is None:
            raise SegmentationError(f"sequence '{sequence.id}' has no masks to train on or compare with")
        return cls(sequence)

    @property
    def name(self) -> str:
        """The sequence's id."""
        return self.sequence.id

    @property
    def version(self) -> str:
        """Digest of the sequence's content."""
        return self.sequence.digest()

    def __len__(self) -> int:
        return len(self.sequence)

    def __getitem__(self, index: int) -> LabelledImage:
        return labelled_frame(self.sequence, index)


@dataclass(frozen=True)
class RenderedFrames:
    """Frames drawn at random from rendered sequences.

    Attributes:
        instances: Which instances (0-99 are for training, 100-199 held out).
        frames: Frames drawn from each of an instance's eight sequences.
        length: Frames of a sequence that are drawn from.
        options: Share of the frames rendered with one of `VARIANTS`.
        seed: Decides which frames.
    """

    instances: range
    frames: int = 2
    length: int = 600
    options: float = 0.0
    seed: int = 0
    _cache: dict[str, SyntheticSequence] = field(default_factory=dict, repr=False, compare=False)

    @classmethod
    def parse(cls, text: str) -> RenderedFrames:
        """From ``instances=0-99,frames=4,length=600,options=0.3,seed=0``; what is left out keeps its default.

        Raises:
            SegmentationError: Unknown option, or a value that does not fit.
        """
        values = {"instances": "0-99", "frames": "2", "length": "600", "options": "0", "seed": "0"}
        for part in filter(None, text.split(",")):
            key, separator, value = part.partition("=")
            if key not in values or not separator:
                raise SegmentationError(f"synthetic: unknown option '{part}'", "known: " + ", ".join(values))
            values[key] = value
        try:
            first, _, last = values["instances"].partition("-")
            chosen = range(int(first), int(last or first) + 1)
            result = cls(
                chosen, int(values["frames"]), int(values["length"]), float(values["options"]), int(values["seed"])
            )
        except ValueError as error:
            raise SegmentationError(f"synthetic: '{text}' is not understood: {error}") from error
        if not chosen or chosen[0] < 0 or chosen[-1] > 199 or result.frames < 1 or result.length < result.frames:
            raise SegmentationError(
                f"synthetic: '{text}' asks for instances or frames that do not exist",
                "instances 0-199, at least one frame",
            )
        return result

    @property
    def name(self) -> str:
        """The text that names this set."""
        return (
            f"synthetic:instances={self.instances.start}-{self.instances.stop - 1},frames={self.frames},"
            f"length={self.length},options={self.options:g},seed={self.seed}"
        )

    @property
    def version(self) -> str:
        """The renderer's version."""
        return f"renderer {RENDERER_VERSION}"

    def __len__(self) -> int:
        return len(self.instances) * len(TWIN_IDS) * self.frames

    def __getitem__(self, index: int) -> LabelledImage:
        order, draw = divmod(range(len(self))[index], self.frames)
        instance, motion = divmod(order, len(TWIN_IDS))
        sequence_id = f"{TWIN_IDS[motion]}@{self.instances[instance]}?frames={self.length}"
        rng = stream(self.seed, "frames", sequence_id)
        frame = int(rng.choice(self.length, self.frames, replace=False)[draw])
        variant = stream(self.seed, "variant", sequence_id, draw)
        overrides = VARIANTS[int(variant.integers(len(VARIANTS)))] if variant.random() < self.options else {}
        return labelled_frame(self._open(sequence_id, overrides), frame)

    def _open(self, sequence_id: str, overrides: dict[str, object]) -> SyntheticSequence:
        key = f"{sequence_id} {sorted(overrides.items())}"
        if key not in self._cache:
            self._cache.clear()  # neighbours in the order share a sequence; nothing older is needed again
            settings = apply_overrides(RenderSettings(), overrides)
            self._cache[key] = SyntheticSequence(parse_synthetic_id(sequence_id), None, settings, threads=1)
        return self._cache[key]


def labelled_frame(sequence: Sequence, index: int) -> LabelledImage:
    """A frame and its exact masks."""
    assert sequence.masks is not None
    frame = sequence[index]
    found = instances_of(sequence.masks[index], where=f"{sequence.id} frame {index}")
    return LabelledImage(np.ascontiguousarray(frame.rgb), found.masks, found.class_names)
