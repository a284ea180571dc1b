"""Conventions of poses that an estimate may have in place of camera-to-world matrices, found by its motions."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.geometry import se3

from .hint_tracks import Array, Hint, HintId, Track, fit

MIN_POSES = 8
"""With fewer poses that have truth nothing is said of their motion."""
PAIR_S = 2.0
"""Motions from pose to pose are taken over a third of the trajectory, at most over this many seconds."""
ROTATES_DEG, MOVES_M = 1.5, 0.01
"""Motions smaller than this are not distinguished from noise."""
EXPLAINED, UNEXPLAINED, CLEARLY = 0.4, 0.25, 4.0
"""Median error of the motions over the motions themselves: below the first they may be explained, above the second they
may be not; an undone fault has to be better than the trajectory as it stands by the third, a factor."""
VARIES, TIE = 0.7, 0.1
"""Least correlation of motions that are explained, and the errors between which the path does not tell."""

_AXES = {
    "y up, z back (OpenGL)": np.diag([1.0, -1.0, -1.0]),
    "x forward, y left, z up (ROS)": np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]),
}
"""Axes that are not the camera's (x right, y down, z forward): rotations ``R_named_camera``."""


class Motions:
    """An estimate's motions from pose to pose beside the true ones."""

    def __init__(self, stamps: Array, poses: Array, truth: Track) -> None:
        self.stamps, self.poses, self.truth = stamps, poses, truth
        span = stamps[-1] - stamps[0]
        ends = np.searchsorted(stamps, stamps + min(PAIR_S, span / 3))
        starts = np.flatnonzero(ends < len(stamps))
        length = stamps[ends[starts]] - stamps[starts]
        keep = length < 2 * min(PAIR_S, span / 3)  # no motions over holes
        step = 1 + int(keep.sum()) // 300
        self.pairs = starts[keep][::step], ends[starts[keep][::step]]
        self.true = _relative(truth.at(stamps), self.pairs)

    def compare(self, poses: Array, R_est_cam: Array | None = None) -> tuple[float, float]:
        """`_compare` with the true motions at the stamps."""
        return _compare(_relative(poses, self.pairs), self.true, R_est_cam)

    def wrong_convention(self, shift: float) -> tuple[Hint, Array] | None:
        """The convention that explains motions which the poses as they stand do not, and the poses brought in order.

        Args:
            shift: A time shift that would explain them as well, seconds; the better explanation counts.
        """
        as_read, _ = self.compare(self.poses)
        if as_read < UNEXPLAINED or not np.isfinite(as_read):
            return None
        limit = min(EXPLAINED, as_read / CLEARLY, self._shifted(shift) if shift else np.inf)
        found: list[tuple[float, HintId, Array, str]] = []
        for name, axes, undo in _CONVENTIONS:
            poses = undo(self.poses)
            error, varies = self.compare(poses)
            if error < limit and varies > VARIES:
                found.append((error, name, poses, axes))
        if not found:
            return self._other_axes(as_read)
        true = self.truth.at(self.stamps)
        misfit = [one[0] + fit(one[2], true).misfit for one in found]
        best = [one for one, score in zip(found, misfit, strict=True) if score < min(misfit) + TIE]
        error, name, poses, axes = best[0]
        others = [_CURES[one[1]][0].format(axes=one[3]) for one in best[1:]]
        return self._hint(name, as_read, error, axes, others), poses

    def _shifted(self, shift: float) -> float:
        """The error of the poses as they stand beside the true motions at another time."""
        covered = self.truth.covers(self.stamps + shift)
        keep = covered[self.pairs[0]] & covered[self.pairs[1]]
        pairs = self.pairs[0][keep], self.pairs[1][keep]
        true = _relative(self.truth.at(self.stamps + shift), pairs)
        return _compare(_relative(self.poses, pairs), true)[0]

    def _other_axes(self, as_read: float) -> tuple[Hint, Array] | None:
        """The same where the truth is that of a body with axes of its own, such as a set of markers."""
        as_turned, _ = self.compare(self.poses, R_est_cam=self._axes(self.poses))
        true = self.truth.at(self.stamps)
        before = fit(self.poses, true).misfit
        for name, axes, undo in _CONVENTIONS[:2]:
            poses = undo(self.poses)
            error, varies = self.compare(poses, R_est_cam=self._axes(poses))
            if error < min(EXPLAINED, as_turned / CLEARLY) and varies > VARIES:
                if name == "inverted-poses" and 2 * fit(poses, true).misfit > before:
                    continue
                return self._hint(name, as_read, error, axes), poses
        return None

    def _axes(self, poses: Array) -> Array:
        """Rotation from the truth's axes to the estimate's that explains most of the rotations."""
        estimated, true = (_axis(motions) for motions in (_relative(poses, self.pairs), self.true))
        u, _, vt = np.linalg.svd(estimated.T @ true)
        return np.asarray(u @ np.diag([1.0, 1.0, np.linalg.det(u) * np.linalg.det(vt)]) @ vt)

    def _hint(self, name: HintId, as_read: float, undone: float, axes: str = "", others: Sequence[str] = ()) -> Hint:
        what, cure = _CURES[name]
        text = (
            f"{what.format(axes=axes)}: the motions are off by {100 * as_read:.0f} % of the true ones, "
            f"by {100 * undone:.0f} % {cure}"
        ) + "".join(f" (or {other}: the path does not tell)" for other in others)
        return Hint(name, text, {"motion_error": as_read, "motion_error_undone": undone})


def _compare(motions: Array, true: Array, R_est_cam: Array | None = None) -> tuple[float, float]:
    """How far the motions are from the true ones, and how well they vary with them.

    Scales are left out. Of rotations and translations those count that are larger than noise.

    Args:
        motions: Of the estimate, ``[P, 4, 4]``.
        true: The true ones.
        R_est_cam: Rotation from the camera's axes to those that the motions are given in.

    Returns:
        Median error over the median motion, of the moving half of the pairs, rotations or translations, whichever
        is worse: infinite if nothing moves. And the best correlation of the two about their means: low where the
        motion is always the same, and then many wrong poses explain it.
    """
    if R_est_cam is not None:
        motions = motions.copy()
        motions[:, :3, :3] = R_est_cam.T @ motions[:, :3, :3] @ R_est_cam
        motions[:, :3, 3] = motions[:, :3, 3] @ R_est_cam
    if len(true) < MIN_POSES:
        return np.inf, 0.0
    found = []
    angle = np.rad2deg(se3.rotation_angle(true))
    moving = angle >= np.median(angle)
    if (turned := float(np.median(angle[moving]))) > ROTATES_DEG:
        off = np.rad2deg(se3.rotation_angle(se3.inverse(motions[moving]) @ true[moving]))
        found.append((float(np.median(off)) / turned, _correlation(_axis(motions), _axis(true))))
    length = np.linalg.norm(true[:, :3, 3], axis=1)
    moving = length >= np.median(length)
    moved, estimated = true[moving, :3, 3], motions[moving, :3, 3]
    way = float(np.median(np.linalg.norm(estimated, axis=1)))
    if (true_way := float(np.median(length[moving]))) > MOVES_M:
        off = np.linalg.norm(estimated * (true_way / way) - moved, axis=1) if way > 0 else length[moving]
        found.append((float(np.median(off)) / true_way, _correlation(motions[:, :3, 3], true[:, :3, 3])))
    return max((error for error, _ in found), default=np.inf), max((good for _, good in found), default=0.0)


def _reordered(poses: Array) -> Array:
    """The poses of a file whose quaternions stand as ``qw qx qy qz``."""
    position, quaternion = se3.to_quaternion(poses)
    return se3.from_quaternion(position, np.roll(quaternion, -1, axis=1))


def _turned_back(poses: Array) -> Array:
    turned = poses.copy()
    turned[:, :3, :3] = poses[:, :3, :3].transpose(0, 2, 1)
    return turned


def _other_camera(rotation: Array) -> Callable[[Array], Array]:
    def turned(poses: Array) -> Array:
        poses = poses.copy()
        poses[:, :3, :3] = poses[:, :3, :3] @ rotation
        return poses

    return turned


_CONVENTIONS: tuple[tuple[HintId, str, Callable[[Array], Array]], ...] = (
    ("inverted-poses", "", se3.inverse),
    ("quaternion-order", "", _reordered),
    ("inverted-rotations", "", _turned_back),
    *(("camera-axes", axes, _other_camera(rotation)) for axes, rotation in _AXES.items()),
)
"""What poses may be in place of ``T_world_cam``, the likeliest first, and what brings them in order."""
_CURES: dict[HintId, tuple[str, str]] = {
    "inverted-poses": (
        "the poses seem to be world to camera",
        "after inverting each pose; give T_world_cam, camera to world: invert your matrices",
    ),
    "quaternion-order": (
        "the quaternions seem to be in the order qw qx qy qz",
        "after re-ordering; write them as qx qy qz qw",
    ),
    "inverted-rotations": (
        "the rotations seem to be world to camera, the positions are not",
        "after transposing each rotation; give those of T_world_cam, camera to world",
    ),
    "camera-axes": (
        "the orientations seem to have the axes {axes}",
        "after turning them; give those of a camera with x right, y down, z forward",
    ),
}


def _relative(poses: Array, pairs: tuple[NDArray[np.intp], NDArray[np.intp]]) -> Array:
    return np.asarray(se3.inverse(poses[pairs[0]]) @ poses[pairs[1]])


def _correlation(first: Array, second: Array) -> float:
    """Correlation of vectors ``[N, 3]`` about their means, jumps left out; 0 where one does not vary."""
    length = np.linalg.norm(first, axis=1)
    usual = length <= 6 * np.median(length)
    first, second = (each[usual] - each[usual].mean(axis=0) for each in (first, second))
    sizes = np.linalg.norm(first), np.linalg.norm(second)
    if sizes[0] <= 0.1 * np.linalg.norm(length[usual]) or not sizes[1] > 0:
        return 0.0
    return float((first * second).sum() / (sizes[0] * sizes[1]))


def _axis(motions: Array) -> Array:
    """Axes of rotation, as long as the sines of the angles ``[N, 3]``."""
    r = motions[:, :3, :3]
    return np.stack([r[:, 2, 1] - r[:, 1, 2], r[:, 0, 2] - r[:, 2, 0], r[:, 1, 0] - r[:, 0, 1]], axis=1) / 2
