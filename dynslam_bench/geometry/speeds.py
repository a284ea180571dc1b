"""Motions that no camera makes: positions in another unit than metres, and single poses far from all others."""

from dataclasses import dataclass

import numpy as np

from dynslam_bench.geometry.trajectory import Trajectory

FASTEST_M_S = 100.0
"""No camera goes faster than this from one pose to the next, if it goes as far as `LONGEST_STEP_M`."""
LONGEST_STEP_M = 1.0
"""Shorter steps are not doubted, however fast."""


@dataclass(frozen=True)
class ImpossibleMotion:
    """A motion that no camera makes.

    Attributes:
        fault: What was measured.
        cure: What to do.
        of_single_poses: Whether a few poses are wrong, not the unit of all.
    """

    fault: str
    cure: str
    of_single_poses: bool

    def __str__(self) -> str:
        return f"{self.fault}: {self.cure}"


def impossible_motion(trajectory: Trajectory, whose: str) -> ImpossibleMotion | None:
    """Find poses of a trajectory that no camera reaches from one to the next; None where there are none.

    Args:
        trajectory: The poses.
        whose: What the message calls it, e.g. ``ground truth``.
    """
    seconds = np.diff(trajectory.timestamps)
    steps_m = np.linalg.norm(np.diff(trajectory.positions, axis=0), axis=1)[seconds > 0]
    speeds = steps_m / seconds[seconds > 0]
    fast = (speeds > FASTEST_M_S) & (steps_m > LONGEST_STEP_M)
    if not fast.any():
        return None
    # most steps: the unit is another one
    if 2 * fast.sum() > len(fast):
        fault = f"the {whose} moves at {np.median(speeds):.3g} m/s by the median"
        return ImpossibleMotion(fault, "are its positions in millimetres? Give metres", False)
    # a few steps: single poses
    distances_m = np.linalg.norm(
        trajectory.positions - np.median(trajectory.positions, axis=0), axis=1
    )
    farthest = int(distances_m.argmax())
    fault = f"{fast.sum()} of {len(fast)} steps of the {whose} are faster than {FASTEST_M_S:g} m/s"
    stamp = trajectory.timestamps[farthest]
    where = f"the pose at the stamp {stamp:.6f} lies {distances_m[farthest]:.3g} m from the middle of the path"
    return ImpossibleMotion(f"{fault}: {where}", "correct or remove it", True)
