"""Groups of sequences: those of one family film one kind of scene, those of one path are one recording."""

import numpy as np
from scipy.spatial import cKDTree

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


_POSE = 1e-6
"""Largest distance of poses of one path, metres and parts of a rotation matrix: rounding in files."""
_SHARED = 0.9
"""Share of the longer path's poses that a copy has at least: a few may be left out, at an end or between."""


def same_path(one: Trajectory | None, other: Trajectory | None) -> bool:
    """Whether two true trajectories of moving cameras hold the same poses: one recording.

    Stamps may be shifted, and a few poses may be left out: two recordings never have many equal poses. Of cameras
    that stand still it is False, since many recordings may share such a truth: their images tell.
    """
    if one is None or other is None:
        return False
    shorter, longer = sorted((one, other), key=len)
    if len(shorter) < max(2, _SHARED * len(longer)) or se3.is_static(shorter.T_world_cam):
        return False

    # the nearest position of the longer path to each of the shorter one, and whether the whole pose is equal
    distances, nearest = cKDTree(longer.positions).query(shorter.positions)
    nearest = np.asarray(nearest)
    is_near = np.asarray(distances) <= _POSE
    poses = shorter.T_world_cam[is_near]
    differences = np.abs(poses - longer.T_world_cam[nearest[is_near]]).max(axis=(1, 2))
    shared = int((differences <= _POSE).sum()) if len(poses) else 0
    return shared >= _SHARED * len(longer)
