"""Which sequences go together: those of one family film one kind of scene, those of one path are one recording."""

import numpy as np

from dynslam_bench.core import SequenceError
from dynslam_bench.geometry import se3
from dynslam_bench.geometry.trajectory import Trajectory
from dynslam_bench.sequences.synthetic import parse_synthetic_id


def family_of(sequence: str) -> str:
    """The family of a sequence: a rendered one's name without its scene, a recording itself.

    Args:
        sequence: Id or folder, e.g. ``synthetic/walking_xyz?scene=3``.
    """
    if not sequence.startswith("synthetic/"):
        return sequence
    try:
        return parse_synthetic_id(sequence).name
    except SequenceError:
        return sequence


# how far the numbers of one path may lie apart: rounding in files
_STAMP_S = 1e-6
"""Of stamps, seconds."""
_POSE = 1e-6
"""Of the entries of poses, metres and parts of a rotation matrix."""


def same_path(one: Trajectory | None, other: Trajectory | None) -> bool:
    """Whether two true trajectories of moving cameras have equal poses at equal stamps: one recording.

    Of cameras that stand still it is False, since many recordings may share such a truth: their images tell.
    """
    if one is None or other is None or len(one) != len(other) or len(one) < 2:
        return False
    if not np.allclose(one.timestamps, other.timestamps, rtol=0.0, atol=_STAMP_S):
        return False
    poses = one.T_world_cam
    if not np.allclose(poses, other.T_world_cam, rtol=0.0, atol=_POSE):
        return False
    return not se3.is_static(poses)
