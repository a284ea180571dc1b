"""Opening what an environment is named: an id, a folder, or a sequence object."""

from __future__ import annotations

from collections.abc import Sequence as PySequence
from pathlib import Path
from typing import cast

from dynslam_bench.core.errors import SequenceError
from dynslam_bench.sequences.catalogue import open_sequence, parse_frames
from dynslam_bench.sequences.frame import Sequence, SequenceView

Frames = PySequence[int | None] | str | None
"""Part of a sequence: ``(start, stop)``, ``"start:stop"`` with either end open, or None for all."""


def open_frames(
    sequence: str | Sequence, data_root: str | Path | None, camera: str | Path | None, frames: Frames, stride: int
) -> Sequence:
    """The sequence, cut to the frames asked for.

    Raises:
        SequenceError: Unknown, missing or damaged sequence, or no frames are left.
    """
    start, stop = parse_frames(frames if frames is None or isinstance(frames, str) else _pair(frames))
    if isinstance(sequence, str | Path):
        return open_sequence(sequence, data_root=data_root, camera=camera, frames=(start, stop), stride=stride)
    if stride < 1:
        raise SequenceError(f"stride is {stride}, expected at least 1")
    if (start, stop, stride) == (0, None, 1):
        return sequence
    return cast("Sequence", SequenceView(sequence, start, stop, stride))


def _pair(frames: PySequence[int | None]) -> tuple[int, int | None]:
    if len(frames) != 2:
        raise SequenceError(f"frames {list(frames)} has {len(frames)} entries", "give (start, stop)")
    return int(frames[0] or 0), frames[1]
