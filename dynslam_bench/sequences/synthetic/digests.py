"""A digest of what a rendered sequence holds: equal on machines that render the same bits."""

import hashlib
from collections.abc import Iterable

import numpy as np

from dynslam_bench.sequences.synthetic import open_synthetic
from dynslam_bench.sequences.synthetic.sequence import SyntheticSequence


def rendered_digest(sequence: SyntheticSequence, indices: Iterable[int] | None = None) -> str:
    """SHA-256 of the images, depths, masks and exact poses of a rendered sequence, 64 hexadecimal digits.

    The arrays count, not the PNG files that store them: libraries compress in different ways.

    Args:
        sequence: The sequence; frames that are not stored yet are rendered.
        indices: Frames that count; all by default.
    """
    state = hashlib.sha256()
    for index in range(len(sequence)) if indices is None else indices:
        frame = sequence[index]
        instances = sequence.masks[index].instances
        pose = sequence.ground_truth.T_world_cam[index]
        for array, kind in (
            (frame.rgb, "u1"),
            (frame.depth, "<f4"),
            (instances, "u1"),
            (pose, "<f8"),
        ):
            state.update(np.ascontiguousarray(array, dtype=kind).tobytes())
    return state.hexdigest()


def probe_digest(probe: str) -> str:
    """The digest of a probe as this machine renders it; nothing stored is read."""
    return rendered_digest(open_synthetic(probe, None))
