"""Opening what an environment is named: an id, a folder, or a sequence object."""

from __future__ import annotations

from collections.abc import Sequence as PySequence
from pathlib import Path
from typing import cast

from dynslam_bench.contracts.sequence import Sequence
from dynslam_bench.core.errors import SequenceError
from dynslam_bench.core.settings import Settings
from dynslam_bench.sequences.catalogue import open_sequence, parse_frames
from dynslam_bench.sequences.settings import PreprocessingSettings
from dynslam_bench.sequences.view import SequenceView

Frames = PySequence[int | None] | str | None
"""Part of a sequence: ``(start, stop)``, ``"start:stop"`` with either end open, or None for all."""


def open_frames(
    sequence: str | Sequence,
    data_root: str | Path | None,
    camera: str | Path | None,
    frames: Frames,
    stride: int,
    preprocessing: PreprocessingSettings | None = None,
) -> Sequence:
    """The sequence, preprocessed and cut to the frames asked for.

    Raises:
        SequenceError: Unknown, missing or damaged sequence, or no frames are left.
    """
    start, stop = parse_frames(frames if frames is None or isinstance(frames, str) else _pair(frames))
    if isinstance(sequence, str | Path):
        part = (start, stop)
        return open_sequence(
            sequence, data_root=data_root, camera=camera, frames=part, stride=stride, preprocessing=preprocessing
        )
    if stride < 1:
        raise SequenceError(f"stride is {stride}, expected at least 1")
    if preprocessing is not None and preprocessing.changes_images:
        from dynslam_bench.sequences.preprocessing import Preprocessed

        sequence = cast("Sequence", Preprocessed(sequence, preprocessing))
    if (start, stop, stride) == (0, None, 1):
        return sequence
    return cast("Sequence", SequenceView(sequence, start, stop, stride))


def preprocessing_of(settings: Settings) -> PreprocessingSettings | None:
    """The group ``preprocessing`` of a tracker's settings; None for trackers without one."""
    found = getattr(settings, "preprocessing", None)
    return found if isinstance(found, PreprocessingSettings) else None


def _pair(frames: PySequence[int | None]) -> tuple[int, int | None]:
    if len(frames) != 2:
        raise SequenceError(f"frames {list(frames)} has {len(frames)} entries", "give (start, stop)")
    return int(frames[0] or 0), frames[1]
