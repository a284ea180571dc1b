"""The sequence that a stored run saw, opened again, and only if it is still the same."""

from __future__ import annotations

from pathlib import Path

from dynslam_bench.contracts.sequence import Sequence
from dynslam_bench.core.errors import RunError
from dynslam_bench.envs.source import open_frames
from dynslam_bench.sequences.part import part_of

from ..storage.record import RunRecord


def open_stored(record: RunRecord, data_root: str | Path | None = None, camera: str | Path | None = None) -> Sequence:
    """The frames of a run as its tracker saw them, before any preprocessing.

    Args:
        record: The run's.
        data_root: Folder of the recorded sequences; None for the default one.
        camera: Camera of a folder that does not say its own.

    Raises:
        DynslamError: It is not here, or not the one that was run on.
    """
    if not record.sequence.content:  # else a record could name any folder of images, and a page or a file show them
        raise RunError(f"the record does not say what {record.sequence.id} held")
    start, stop = record.frames or (0, None)
    place = record.place or record.sequence.id
    sequence = open_frames(place, data_root, camera, (start + record.offset, stop), record.stride)
    if part_of(sequence, record.offset).content != record.sequence.content:
        raise RunError(f"the content of {record.sequence.id} has changed since the run")
    return sequence


def image_names(sequence: Sequence) -> list[str]:
    """The colour image of every frame, relative to the sequence's folder; TUM's way of naming where it has no files."""
    known: dict[float, str] = getattr(sequence, "colour_files", {})
    return [known.get(stamp, f"rgb/{stamp:.6f}.png") for stamp in sequence.timestamps.tolist()]
