"""Causal pose error, frame by frame, for environments and for ``frames.csv``."""

from dataclasses import dataclass, field

import numpy as np

from dynslam_bench.geometry import Array, Trajectory, se3


@dataclass(frozen=True)
class OnlineSample:
    """The pose error at one frame that has ground truth.

    Attributes:
        trans_m: Cumulative translational error in metres, estimate and truth joined at the first
            frame that has both.
        rot_deg: Cumulative rotational error in degrees.
        frame_trans_m: Frame-to-frame translational error in metres (Eq. 26 over one frame); None
            where the frame before has no ground truth.
        frame_rot_deg: Frame-to-frame rotational error in degrees; None as `frame_trans_m`.
        path_length_m: Length in metres of the true path since the first frame with ground truth, straight
            across frames that have none (it was at least that); no tracker changes it.
        tracked: Whether the frame was tracked.
        lost_way_m: Metres that the camera truly moved over the lost frames since the last tracked
            pose, where its frame-to-frame motion is known; 0 without lost frames in between.
        T_world_true: True pose ``[4, 4]``, camera to world of the ground truth.
        T_world_held: The estimate in the same world: of the last tracked frame; the first true pose
            before there is one.
    """

    trans_m: float
    rot_deg: float
    frame_trans_m: float | None
    frame_rot_deg: float | None
    path_length_m: float = 0.0
    tracked: bool = True
    lost_way_m: float = 0.0
    T_world_true: Array = field(default_factory=lambda: np.eye(4), compare=False, repr=False)
    T_world_held: Array = field(default_factory=lambda: np.eye(4), compare=False, repr=False)


def truths_at(truth: Trajectory | None, stamps: Array) -> dict[int, Array]:
    """The true pose ``[4, 4]`` nearest in time to each stamp ``[N]`` that has one, by the stamp's row."""
    errors = OnlineError(truth)
    poses = {row: errors.truth_at(float(stamp)) for row, stamp in enumerate(stamps)}
    return {row: pose for row, pose in poses.items() if pose is not None}


class OnlineError:
    """Follows the pose error of a running tracker; what is known at a frame never changes later.

    A frame that is lost counts as not having moved: it stays at the last tracked pose, cumulatively
    and frame to frame, as if the tracker had repeated that pose. The first tracked pose after it is
    a jump from there. Until a first pose is tracked the camera counts as standing at the first true
    pose, and where it then is joins estimate and truth.

    Args:
        ground_truth: True camera-to-world poses at their own stamps, possibly with holes; None if
            there are none.
        max_dt: A frame has ground truth if a true pose is closer in time than this, in seconds.
    """

    def __init__(self, ground_truth: Trajectory | None, max_dt: float = 0.02) -> None:
        self._truth = ground_truth if ground_truth is not None and len(ground_truth) else None
        self._max_dt = max_dt
        # from the estimate's world to the truth's
        self._T_truth_estimate: Array | None = None
        # the last tracked pose in the truth's world, which is held while tracking is lost
        self._held: Array | None = None
        # true pose of the frame before, if it has one
        self._previous_truth: Array | None = None
        # pose of the last tracked frame in the estimate's world
        self._previous_pose: Array | None = None
        # last true pose of any frame, the path up to it, and the true motion since the last tracked pose
        self._last_truth: Array | None = None
        self._path_m = 0.0
        self._lost_way_m = 0.0

    def truth_at(self, timestamp: float) -> Array | None:
        """The true pose ``[4, 4]`` nearest in time, or None in a hole."""
        if self._truth is None:
            return None
        gaps = np.abs(self._truth.timestamps - timestamp)
        nearest = int(gaps.argmin())
        return np.array(self._truth.T_world_cam[nearest]) if gaps[nearest] < self._max_dt else None

    def update(self, timestamp: float, pose: Array | None) -> OnlineSample | None:
        """Take in the next frame.

        Args:
            timestamp: Seconds, the frame's stamp.
            pose: Estimated camera-to-world pose ``[4, 4]``; None where the frame was not tracked.

        Returns:
            The error at this frame, or None where there is no ground truth.
        """
        # join estimate and truth at the first frame that has both
        truth = self.truth_at(timestamp)
        if pose is not None and truth is not None and self._T_truth_estimate is None:
            self._T_truth_estimate = truth @ se3.inverse(pose)
        if pose is not None and self._T_truth_estimate is not None:
            self._held = self._T_truth_estimate @ pose
        sample = None if truth is None else self._sample(truth, pose)
        self._previous_truth = truth
        if pose is not None:
            self._previous_pose = pose
            self._lost_way_m = 0.0
        return sample

    def _sample(self, truth: Array, pose: Array | None) -> OnlineSample:
        """The errors at a frame with a true pose ``[4, 4]``."""
        # before a first tracked pose the camera stands at the first true one
        if self._held is None:
            self._held = truth.copy()

        # length of the true path
        if self._last_truth is not None:
            self._path_m += float(np.linalg.norm(truth[:3, 3] - self._last_truth[:3, 3]))
        self._last_truth = truth

        # cumulative error, of the held pose
        error = se3.inverse(truth) @ self._held
        trans = float(np.linalg.norm(error[:3, 3]))
        rot = float(np.rad2deg(se3.rotation_angle(error)))

        # frame-to-frame error (Eq. 26); a lost frame counts as not having moved
        frame_trans = None
        frame_rot = None
        if self._previous_truth is not None:
            moved = se3.inverse(self._previous_truth) @ truth
            estimated = np.eye(4)
            if pose is not None and self._previous_pose is not None:
                estimated = se3.inverse(self._previous_pose) @ pose
            gap = se3.inverse(moved) @ estimated
            frame_trans = float(np.linalg.norm(gap[:3, 3]))
            frame_rot = float(np.rad2deg(se3.rotation_angle(gap)))
            if pose is None:
                self._lost_way_m += frame_trans
        return OnlineSample(
            trans_m=trans,
            rot_deg=rot,
            frame_trans_m=frame_trans,
            frame_rot_deg=frame_rot,
            path_length_m=self._path_m,
            tracked=pose is not None,
            lost_way_m=self._lost_way_m,
            T_world_true=truth,
            T_world_held=self._held,
        )
