"""Part of a sequence, renumbered from 0."""

from __future__ import annotations

from collections.abc import Sequence as PySequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.contracts.sequence import Frame, FrameMasks, MaskSource, Sequence, timestamps_ns


class SequenceView:
    """Part of a sequence: every `stride`-th frame of ``start:stop``; indices and masks are renumbered.

    Args:
        base: The whole sequence.
        start: First frame.
        stop: One past the last frame; None for the end.
        stride: Step between frames.
    """

    def __init__(self, base: Sequence, start: int = 0, stop: int | None = None, stride: int = 1) -> None:
        self.base = base
        self.range = range(len(base))[start:stop:stride]

    def __getattr__(self, name: str) -> object:
        if name.startswith("__") or name in ("base", "range"):  # not yet set while unpickling
            raise AttributeError(name)
        return getattr(self.base, name)

    @property
    def timestamps(self) -> NDArray[np.float64]:
        """Stamps of the selected frames."""
        return self.base.timestamps[self.range.start : self.range.stop : self.range.step]

    @property
    def timestamps_ns(self) -> NDArray[np.int64]:
        """The same in nanoseconds."""
        return timestamps_ns(self.base)[self.range.start : self.range.stop : self.range.step]

    @property
    def depth_timestamps(self) -> NDArray[np.float64]:
        """Stamps of the selected frames' depth images; the frames' own where the sequence does not tell."""
        stamps = getattr(self.base, "depth_timestamps", self.base.timestamps)
        return np.asarray(stamps[self.range.start : self.range.stop : self.range.step])

    @property
    def masks(self) -> MaskSource | None:
        """Masks of the selected frames, under their new indices."""
        source = self.base.masks
        return None if source is None else _SelectedMasks(source, self.range)

    def __len__(self) -> int:
        return len(self.range)

    def __getitem__(self, index: int) -> Frame:
        frame = self.base[self.range[index]]
        return Frame(range(len(self))[index], frame.timestamp, frame.rgb, frame.depth)


@dataclass(frozen=True)
class _SelectedMasks:
    source: MaskSource
    selected: PySequence[int]

    def __getitem__(self, index: int) -> FrameMasks:
        return self.source[self.selected[index]]
