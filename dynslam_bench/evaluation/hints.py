"""Hints: faults of a trajectory file that its numbers show, each with the measured evidence and the cure.

An estimate may be scored without a word although its stamps are late, its unit is the millimetre or
its poses are world-to-camera: an alignment and a short path hide much of it. Here the same
trajectory is compared with the truth as if one such fault were undone. A hint is given only where
that explains the true motion and the trajectory as it stands does not; a tracker that is merely bad
gets none. Hints never change a number.

Motions are compared from pose to pose, over some seconds at most, so that drift and the choice of
the world frame do not matter. Time shifts follow from the correlation of displacements over lags,
coarse to fine, scales from Umeyama's alignment.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from math import comb
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.core.number_text import mm
from dynslam_bench.evaluation.alignment import align
from dynslam_bench.evaluation.protocol import Protocol, get_protocol
from dynslam_bench.geometry import Array, FileNotes, Trajectory, se3

FARTHEST_M = 1e12
"""Squares of larger numbers are no numbers any more."""

MOSTLY = 0.25
"""Share of the displacements that may stay unexplained where a time shift or a scale is said to explain them."""
STEADY = 1e-3
"""Displacements whose variance is a smaller share of their squares are one steady motion."""
LONGEST_SHIFT_S = 5.0
"""Time shifts are looked for up to this, at most a quarter of the trajectory's time."""
SHORTEST_SHIFT_S = 0.03
"""The clocks of good recordings differ by up to 25 ms, and a rolling shutter adds half its readout time."""
DISPLACEMENT_S = 0.5
"""Displacements are taken over this time, at most a sixth of the trajectory's."""
LAG_S = 0.04
"""Step of the coarse search for a time shift, at most a third of the displacements' time."""
MOST_PLACES = 4096
"""Places at which displacements are taken at most: more than two minutes at intervals of `LAG_S`."""
SCALE_FACTOR = 1.15
"""Scales closer to 1 than this factor are errors of a tracker."""
COPY_SHARE = 1e-3
"""No tracker's error is below this share of the extent of the path ..."""
COPY_M = 1e-4
"""... and below this at once, where the truth was measured."""
EXACT_M = 1e-6
"""In place of `COPY_M` where the truth shows no noise of its own, as that of rendered images."""
NOISE_M = 1e-5
"""A truth with less noise than this was not measured."""
MEASURED_S = 1 / 60
"""Longest step of a truth in which noise can be told from fast motion, seconds."""
OTHER_RECORDING_S = 10.0
"""Poses outside of the truth's time, apart from the others by a hole as long, are of another recording; so are those
behind a step back in time as long."""


def hints(
    estimate: Trajectory,
    ground_truth: Trajectory,
    protocol: Protocol | str = "tum-rgbd/v1",
    *,
    notes: FileNotes | None = None,
) -> tuple[Hint, ...]:
    """Find what is probably wrong with an estimate, by comparing it with the truth.

    Args:
        estimate: Camera-to-world poses, as they were read.
        ground_truth: True camera-to-world poses at their own stamps; may have holes.
        protocol: Only its alignment is used: an alignment that finds the scale makes hints on the
            scale meaningless.
        notes: What the estimate's file held in disorder.

    Returns:
        One hint a fault, by `Hint.id`; none where the estimate is healthy, or where nothing
        explains why it is bad.
    """
    # several recordings in one file
    sim3 = get_protocol(protocol).alignment == "sim3"
    faults = _several_recordings(estimate, ground_truth, notes)
    truth = Track(ground_truth.timestamps, ground_truth.T_world_cam)
    inside = truth.covers(estimate.timestamps)
    farthest_m = max(
        np.abs(trajectory.positions).max(initial=0.0) for trajectory in (estimate, ground_truth)
    )
    if inside.sum() < MIN_POSES or farthest_m > FARTHEST_M:
        return tuple(faults)

    # wrong convention and late stamps; a convention that is undone may show another time shift
    stamps = estimate.timestamps[inside]
    poses = estimate.T_world_cam[inside]
    # seconds to add to the stamps, and the share of the displacements that stays unexplained then
    shift, unexplained = _time_shift(stamps, poses, truth)
    wrong, poses = _wrong_convention(stamps, poses, truth, shift)
    if wrong:
        shift, unexplained = _time_shift(stamps, poses, truth)
    late = _shift_hint(stamps, poses, truth, shift, unexplained) if shift else []
    faults += wrong + late

    # scale and noise, at the stamps with the time shift undone
    shift = shift if late else 0.0
    covered = truth.covers(stamps + shift)
    stamps = stamps[covered] + shift
    poses = poses[covered]
    if not sim3 and unexplained < MOSTLY:
        faults += _scale(stamps, poses, truth)
    return (*faults, *_below_noise(stamps, poses, truth))


# -- several recordings ----------------------------------------------------------------------------


def _several_recordings(
    estimate: Trajectory, truth: Trajectory, notes: FileNotes | None
) -> list[Hint]:
    """Stretches of stamps that lie wholly outside of the truth's time, and lines that go back in time."""
    # stretches of time that holes divide
    stamps = estimate.timestamps
    parts = np.split(stamps, np.flatnonzero(np.diff(stamps) > OTHER_RECORDING_S) + 1)
    outside = [
        part for part in parts if part[-1] < truth.timestamps[0] or part[0] > truth.timestamps[-1]
    ]
    evidence: list[str] = []
    numbers: dict[str, float] = {}
    if 0 < len(outside) < len(parts):
        rows = sum(map(len, outside))
        stretches = "stretches" if len(outside) > 1 else "stretch"
        evidence.append(
            f"{len(stamps) - rows} of {len(stamps)} poses lie within the truth's time, the others in {len(outside)} "
            f"{stretches} of time outside of it"
        )
        numbers |= {"poses_outside": float(rows), "stretches_outside": float(len(outside))}
    if notes is not None and notes.back_s > OTHER_RECORDING_S:
        repeated = ""
        if notes.duplicates:
            repeated = f", {notes.duplicates} of {notes.lines} lines repeat a stamp"
        evidence.append(f"the stamps of the file go back by {notes.back_s:.0f} s{repeated}")
        numbers |= {"back_s": notes.back_s, "repeated_stamps": float(notes.duplicates)}
    if not evidence:
        return []
    text = f"the file seems to hold several recordings: {'; '.join(evidence)}; keep the rows of one"
    return [Hint("several-recordings", text, numbers)]


# -- time ------------------------------------------------------------------------------------------


def _time_shift(stamps: Array, poses: Array, truth: Track) -> tuple[float, float]:
    """Delay with which the truth has to be read for displacements to agree, and the share that then stays unexplained.

    Returns:
        Seconds to add to the stamps, 0 without clear evidence, and the share in [0, 1], at any
        scale.
    """
    # displacements over a window, at lags of a step
    span = float(stamps[-1] - stamps[0])
    window = min(DISPLACEMENT_S, span / 6)
    step = min(LAG_S, window / 3)
    most = int(min(LONGEST_SHIFT_S, span / 4) / step)
    track = Track(stamps, poses)

    # places on a grid of lags from which the estimate moves by a known displacement; at most some
    # 128 of them, and none at a jump
    at = _grid_places(track, step)
    moved = _displacements(track, stamps[0] + step * at, window)
    usable = np.flatnonzero(np.isfinite(moved[:, 0]))
    usable = usable[:: 1 + len(usable) // 128]
    length = np.linalg.norm(moved[usable], axis=1)
    usable = usable[length <= 6 * np.median(length)] if len(usable) else usable
    if len(usable) < MIN_POSES:
        return 0.0, 1.0
    at = at[usable]
    moved = moved[usable]

    # coarse: the lag at which the true displacements agree best; each place of the grid is looked at once
    lags = np.arange(-most, most + 1)
    places, place_of = np.unique(at + lags[:, None], return_inverse=True)
    true_moved = _displacements(truth, stamps[0] + step * places, window)
    expected = true_moved[place_of.reshape(len(lags), len(at))]
    lag = int(lags[np.argmin(_unexplained(moved, expected))])

    # fine: a quarter of a step; the last one is no shift, for comparison
    fine = lag * step + np.linspace(-1, 1, 9) * step
    begin = stamps[0] + step * at
    unexplained = _unexplained(
        moved, _displacements(truth, begin + np.append(fine, 0.0)[:, None], window)
    )
    unshifted_share = float(unexplained[-1])
    shares = unexplained[:-1]
    best = int(np.argmin(shares))
    shift = float(fine[best])
    least_share = float(shares[best])

    # finer: the minimum of the parabola through the best and its neighbours
    if 0 < best < len(fine) - 1:
        before = shares[best - 1]
        after = shares[best + 1]
        curvature = before - 2 * least_share + after
        if curvature > 0:
            shift += float(0.5 * (before - after) / curvature * (fine[1] - fine[0]))

    # clear: it explains the motion, and such a shift shows on a path of this shape
    shifted_self = _displacements(track, begin[None] + shift, window)
    visible = float(_unexplained(moved, shifted_self)[0])
    clear = (
        abs(shift) > SHORTEST_SHIFT_S
        and least_share < min(MOSTLY, 0.55 * unshifted_share)
        and visible > 0.3 * unshifted_share
    )
    return (shift, least_share) if clear else (0.0, unshifted_share)


def _grid_places(track: Track, step: float) -> Array:
    """Whole multiples of a step, from the first stamp on, that lie between poses without a hole: `MOST_PLACES` at most.

    They are counted stretch by stretch, so that the work grows with the poses and not with the time
    that they span.
    """
    # the multiples within each stretch
    since = track.stamps - track.stamps[0]
    ends = np.flatnonzero(track.holes)
    starts = np.append(0, ends[:-1] + 1)
    first = np.ceil(since[starts] / step)
    last = np.floor(since[ends] / step)
    count = np.maximum(last - first + 1, 0)
    # every so many of them, counted through all stretches
    before = np.cumsum(count) - count
    ranks = np.arange(min(count.sum(), MOST_PLACES)) * max(1.0, np.ceil(count.sum() / MOST_PLACES))
    ranks = ranks[ranks < count.sum()]
    stretch = np.searchsorted(before + count, ranks, side="right")
    return np.asarray(first[stretch] + ranks - before[stretch])


def _displacements(track: Track, stamps: Array, window: float) -> Array:
    """Displacements ``[..., 3]`` from stamps ``[...]`` to those a window later; NaN in holes."""
    ends = stamps + window
    moved = track.positions_at(ends) - track.positions_at(stamps)
    moved[~(track.covers(stamps) & track.covers(ends))] = np.nan
    return moved


def _unexplained(own: Array, true: Array) -> Array:
    """Share of the true displacements that one rotation and scale of the estimated ones leaves unexplained.

    Args:
        own: Displacements ``[N, 3]``.
        true: True ones for each of several lags ``[L, N, 3]``; NaN where there are none.

    Returns:
        ``[L]``; 1 where fewer than half of them have a counterpart.
    """
    # the best rotation and scale of each lag (Umeyama 1991), from the moments
    valid = np.isfinite(true[..., 0])
    true = np.where(valid[..., None], true, 0.0)
    u, singular, vt = np.linalg.svd(true.transpose(0, 2, 1) @ own)
    sign = np.sign(np.linalg.det(u) * np.linalg.det(vt))
    explained = (singular[:, 0] + singular[:, 1] + sign * singular[:, 2]).clip(0)
    size = (true**2).sum(axis=(1, 2)) * (valid @ (own**2).sum(axis=1))
    enough = (valid.mean(axis=1) > 0.5) & (size > 0)
    share = 1 - np.divide(explained**2, size, out=np.zeros(len(true)), where=enough)
    return np.asarray(np.where(enough, share.clip(0), 1.0))


def _shift_hint(stamps: Array, poses: Array, truth: Track, shift: float, left: float) -> list[Hint]:
    """The hint, if the absolute error falls, too: by half where displacements stay unexplained."""
    both = truth.covers(stamps) & truth.covers(stamps + shift)
    if both.sum() < MIN_POSES:
        return []
    error = fit(poses[both], truth.at(stamps[both] + 0.0)).sim3_m
    undone = fit(poses[both], truth.at(stamps[both] + shift)).sim3_m
    if not undone < (0.9 if left < 0.05 else 0.5) * error:
        return []
    return [
        Hint(
            "time-shift",
            f"the stamps seem to be {abs(shift):.3f} s {'early' if shift > 0 else 'late'}: with {shift:+.3f} s on each "
            f"the error falls from {mm(error)} to {mm(undone)} mm (at its best scale); give the stamps of the images, "
            "on the truth's clock",
            {"shift_s": shift, "error_m": error, "error_undone_m": undone},
        )
    ]


# -- scale and noise -------------------------------------------------------------------------------


def _scale(stamps: Array, poses: Array, truth: Track) -> list[Hint]:
    """A scale that explains the error, where displacements agree at some scale as well."""
    # it must lie far from 1, and the error fall by much
    best = fit(poses, truth.at(stamps))
    scale = best.scale
    error = best.se3_m
    undone = best.sim3_m
    if not (
        scale > 0
        and abs(np.log(scale)) > np.log(SCALE_FACTOR)
        and undone < min(0.4 * error, 0.2 * best.extent_m)
    ):
        return []

    # displacements about their mean must agree: a steady motion fits many paths at some scale
    window = min(DISPLACEMENT_S, (stamps[-1] - stamps[0]) / 6)
    moved = _displacements(Track(stamps, poses), stamps, window)
    true = _displacements(truth, stamps, window)
    both = np.isfinite(moved[:, 0]) & np.isfinite(true[:, 0])
    varying = moved[both] - moved[both].mean(axis=0)
    true_varying = true[both] - true[both].mean(axis=0)
    steady = both.sum() < MIN_POSES or (varying**2).sum() < STEADY * (moved[both] ** 2).sum()
    if steady or _unexplained(varying, true_varying[None])[0] > MOSTLY:
        return []

    # a unit of this size, or no scale at all
    unit = next((name for name, size in _UNITS.items() if abs(np.log(scale / size)) < 0.1), "")
    cure = "check the depth factor; score a tracker without depth under a protocol that finds the scale"
    if unit:
        cure = f"are they in {unit}? give metres"
    return [
        Hint(
            "scale",
            f"the positions seem to have a wrong scale: with the factor {scale:.4g} the error falls from {mm(error)} "
            f"to {mm(undone)} mm; {cure}",
            {"scale": scale, "error_m": error, "error_undone_m": undone},
        )
    ]


# metres of other units
_UNITS = {
    "millimetres": 1e-3,
    "centimetres": 1e-2,
    "feet": 0.3048,
    "inches": 0.0254,
    "kilometres": 1e3,
}


def _below_noise(stamps: Array, poses: Array, truth: Track) -> list[Hint]:
    """An error that no tracker reaches, or jitter of the truth's measurement that the estimate shares."""
    # the truth between its stamps, and at the nearest: a copy may have been made by either
    between = truth.at(stamps)
    nearest = truth.poses[truth.nearest(stamps)]
    fits = [fit(poses, true) for true in (between, nearest)]
    error = min(one.sim3_m for one in fits)

    # the truth's own noise; one that was not measured frequently enough tells none
    inside = (truth.stamps >= stamps[0]) & (truth.stamps <= stamps[-1])
    noise = _jitter(truth.positions[inside], 5) if truth.step < MEASURED_S else 0.0

    # the error is smaller than a tracker's
    accuracy = COPY_M if noise > NOISE_M else EXACT_M
    least = min(accuracy, COPY_SHARE * fits[0].extent_m)
    if error < least:
        # the scale is fitted: without that the error may be larger
        text = (
            f"with the scale fitted, the error of {mm(error)} mm is below what trackers reach: were the poses "
            "read from the truth?"
        )
        return [Hint("below-truth-noise", text, {"error_m": error, "least_m": least})]

    # the error jitters less than the truth does: the estimate has the same noise
    jitters = []
    for true in (between, nearest):
        aligned = align(poses, true, "se3").apply(poses)
        jitters.append(_jitter(aligned[:, :3, 3] - true[:, :3, 3], 3))
    jitter = min(jitters)
    if jitter < 0.5 * noise and noise > NOISE_M:
        text = (
            f"from frame to frame the error changes by {mm(jitter)} mm, less than the truth's own noise of "
            f"{mm(noise)} mm: were the poses made from the truth?"
        )
        return [Hint("below-truth-noise", text, {"jitter_m": jitter, "truth_noise_m": noise})]
    return []


def _jitter(positions: Array, order: int) -> float:
    """Standard deviation of white noise, per axis, that differences of some order show; metres, nan of few."""
    if len(positions) < 30:
        return float("nan")
    # the median of absolute values is 0.6745 deviations of a normal distribution; differences of
    # order n of white noise have the variance binomial(2 n, n)
    median = np.median(np.abs(np.diff(positions, order, axis=0)))
    return float(median / (0.6745 * np.sqrt(comb(2 * order, order))))


# What hints are made from: poses between their stamps, and how well positions can be aligned.

HintId = Literal[
    "several-recordings",
    "inverted-poses",
    "quaternion-order",
    "inverted-rotations",
    "camera-axes",
    "time-shift",
    "scale",
    "below-truth-noise",
]


@dataclass(frozen=True)
class Hint:
    """A probable fault of an estimate.

    Attributes:
        id: Id of the fault.
        text: One line: what was measured, and the cure.
        numbers: What was measured, by name with its unit.
    """

    id: HintId
    text: str
    numbers: dict[str, float] = field(default_factory=dict)

    def __str__(self) -> str:
        return f"{self.id}: {self.text}"


class Track:
    """Poses between their stamps.

    Args:
        stamps: Seconds ``[N]``, ascending.
        poses: ``[N, 4, 4]``.

    Attributes:
        step: Median interval, seconds.
        holes: Behind which poses a hole begins ``[N]``; behind the last one there is one.
    """

    def __init__(self, stamps: Array, poses: Array) -> None:
        self.stamps = stamps
        self.poses = poses
        self.positions = np.ascontiguousarray(poses[:, :3, 3])
        steps = np.diff(self.stamps)
        self.step = float(np.median(steps)) if len(steps) else 0.0
        self.holes = np.append(steps > max(0.1, 3 * self.step), True)

    def covers(self, stamps: Array) -> NDArray[np.bool_]:
        """Whether stamps lie within its time and in no hole ``[...]``."""
        after = np.searchsorted(self.stamps, stamps, side="right") - 1
        return np.asarray(
            (after >= 0) & (~self.holes[after] | (self.stamps[after.clip(0)] == stamps))
        )

    def positions_at(self, stamps: Array) -> Array:
        """Positions ``[..., 3]``, on straight lines between the stamps."""
        return np.stack(
            [np.interp(stamps, self.stamps, self.positions[:, axis]) for axis in range(3)], axis=-1
        )

    def at(self, stamps: Array) -> Array:
        """Poses ``[N, 4, 4]``: these positions, with the rotation of the pose that is nearest in time."""
        poses = self.poses[self.nearest(stamps)]
        poses[:, :3, 3] = self.positions_at(stamps)
        return poses

    def nearest(self, stamps: Array) -> NDArray[np.intp]:
        """Indices ``[N]`` of the poses nearest in time."""
        after = np.searchsorted(self.stamps, stamps).clip(1, len(self.stamps) - 1)
        return np.asarray(after - (stamps - self.stamps[after - 1] < self.stamps[after] - stamps))


@dataclass(frozen=True)
class Fit:
    """Fit of positions by alignments, from their moments: Umeyama 1991, Eq. 40-43.

    Attributes:
        scale: Scale of the Sim(3) alignment.
        se3_m: Root mean square error after the SE(3) alignment, metres; exact to 1e-8.
        sim3_m: Root mean square error after the Sim(3) alignment, metres.
        extent_m: Root mean square distance of the true positions from their mean, metres: the error
            of a camera that stands still.
    """

    scale: float
    se3_m: float
    sim3_m: float
    extent_m: float

    @property
    def misfit(self) -> float:
        """The error after the Sim(3) alignment over that of a camera that stands still, in [0, 1]."""
        return self.sim3_m / self.extent_m if self.extent_m > 0 else 1.0


def fit(poses: Array, truth: Array) -> Fit:
    """Fit of the positions of poses ``[N, 4, 4]`` to those of the true ones by alignments."""
    # positions about their means, their covariance and variances
    own = poses[:, :3, 3] - poses[:, :3, 3].mean(axis=0)
    true = truth[:, :3, 3] - truth[:, :3, 3].mean(axis=0)
    u, singular, vt = np.linalg.svd(true.T @ own / len(own))
    sign = np.sign(np.linalg.det(u) * np.linalg.det(vt))
    explained = singular[0] + singular[1] + sign * singular[2]
    own_variance = float((own**2).sum() / len(own))
    true_variance = float((true**2).sum() / len(own))

    # mean squared errors that are left; rounding may make them negative
    scale = max(float(explained), 0.0) / own_variance if own_variance > 0 else 1.0
    se3_error = own_variance + true_variance - 2 * explained
    sim3_error = true_variance - scale * explained
    return Fit(
        scale=scale,
        se3_m=float(np.sqrt(max(se3_error, 0.0))),
        sim3_m=float(np.sqrt(max(sim3_error, 0.0))),
        extent_m=float(np.sqrt(true_variance)),
    )


# Conventions of poses that an estimate may have in place of camera-to-world matrices, found by its
# motions.

MIN_POSES = 8
"""With fewer poses that have truth nothing is said of their motion."""
PAIR_S = 2.0
"""Motions from pose to pose are taken over a third of the trajectory, at most over this many seconds."""
ROTATES_DEG = 1.5
"""Smaller rotations are not distinguished from noise."""
MOVES_M = 0.01
"""Smaller translations are not distinguished from noise."""
EXPLAINED = 0.4
"""Motions are explained if their median error is below this share of the motions themselves."""
UNEXPLAINED = 0.25
"""A trajectory is healthy if the motions as they stand are off by less than this share."""
CLEARLY = 4.0
"""An undone fault has to be better than the trajectory as it stands by this factor."""
VARIES = 0.7
"""Least correlation of motions that are explained."""
TIE = 0.1
"""Conventions whose scores differ by less than this are not told apart by the path."""


def _wrong_convention(
    stamps: Array, poses: Array, truth: Track, shift: float
) -> tuple[list[Hint], Array]:
    """The convention that explains motions which the poses as they stand do not, and the poses brought in order.

    Args:
        stamps: Seconds ``[N]``.
        poses: The estimate's ``[N, 4, 4]``.
        truth: The true poses.
        shift: A time shift that would explain them as well, seconds; the better explanation counts.
    """
    # healthy motions are left alone
    pairs = _pairs(stamps)
    true_poses = truth.at(stamps)
    true = se3.between(true_poses, pairs)
    as_read, _ = _compare(se3.between(poses, pairs), true)
    if as_read < UNEXPLAINED or not np.isfinite(as_read):
        return [], poses

    # a convention must explain them better than the time shift does
    limit = min(EXPLAINED, as_read / CLEARLY)
    if shift:
        covered = truth.covers(stamps + shift)
        covered_pairs = pairs[covered[pairs].all(axis=1)]
        shifted = se3.between(truth.at(stamps + shift), covered_pairs)
        with_shift, _ = _compare(se3.between(poses, covered_pairs), shifted)
        limit = min(limit, with_shift)

    # the conventions that do; else those of a body with other axes than the camera's
    candidates: list[tuple[float, Convention, Array]] = []
    for convention in CONVENTIONS:
        undone = convention.undo(poses)
        error, varies = _compare(se3.between(undone, pairs), true)
        if error < limit and varies > VARIES:
            candidates.append((error, convention, undone))
    candidates = candidates or _in_axes_of_a_body(poses, pairs, true, true_poses)
    if not candidates:
        return [], poses

    # the best by motions and positions; among equals the likeliest, which comes first
    misfits = [error + fit(undone, true_poses).misfit for error, _, undone in candidates]
    best = [
        candidate
        for candidate, misfit in zip(candidates, misfits, strict=True)
        if misfit < min(misfits) + TIE
    ]
    error, convention, undone = best[0]
    others = "".join(f" (or {other.what}: the path does not tell)" for _, other, _ in best[1:])
    text = (
        f"{convention.what}: the motions are off by {100 * as_read:.0f} % of the true ones, "
        f"by {100 * error:.0f} % {convention.cure}{others}"
    )
    numbers = {"motion_error": as_read, "motion_error_undone": error}
    return [Hint(convention.id, text, numbers)], undone


def _in_axes_of_a_body(
    poses: Array, pairs: NDArray[np.intp], true: Array, true_poses: Array
) -> list[tuple[float, Convention, Array]]:
    """The convention where the truth is that of a body with axes of its own, such as a set of markers; none or one.

    Args:
        poses: Estimated poses ``[N, 4, 4]``.
        pairs: Pairs of poses ``[P, 2]`` whose motions are compared.
        true: True motions ``[P, 4, 4]`` of these pairs.
        true_poses: True poses ``[N, 4, 4]``.
    """
    motions = se3.between(poses, pairs)
    as_turned, _ = _compare(motions, true, R_est_cam=_axes(motions, true))
    # of the conventions only the first two, in axes that are fitted
    for convention in CONVENTIONS[:2]:
        undone = convention.undo(poses)
        motions = se3.between(undone, pairs)
        error, varies = _compare(motions, true, R_est_cam=_axes(motions, true))
        fits = convention.id != "inverted-poses" or (
            2 * fit(undone, true_poses).misfit <= fit(poses, true_poses).misfit
        )
        if error < min(EXPLAINED, as_turned / CLEARLY) and varies > VARIES and fits:
            return [(error, convention, undone)]
    return []


def _pairs(stamps: Array) -> NDArray[np.intp]:
    """Indices ``[P, 2]`` of the poses between which motions are compared; none over holes.

    Args:
        stamps: Stamps of the poses ``[N]``, seconds, ascending.
    """
    # each pose, and the first one that is at least so much later
    apart_s = min(PAIR_S, (stamps[-1] - stamps[0]) / 3)
    ends = np.searchsorted(stamps, stamps + apart_s)
    starts = np.flatnonzero(ends < len(stamps))
    pairs = np.stack([starts, ends[starts]], axis=1)

    # a pair that is twice as long goes over a hole; some 300 pairs are enough
    pairs = pairs[stamps[pairs[:, 1]] - stamps[pairs[:, 0]] < 2 * apart_s]
    return np.asarray(pairs[:: 1 + len(pairs) // 300])


def _axes(motions: Array, true: Array) -> Array:
    """Rotation from the truth's axes to the estimate's that explains most of the rotations."""
    u, _, vt = np.linalg.svd(se3.scaled_axes(motions)[0].T @ se3.scaled_axes(true)[0])
    return np.asarray(u @ np.diag([1.0, 1.0, np.linalg.det(u) * np.linalg.det(vt)]) @ vt)


def _compare(motions: Array, true: Array, R_est_cam: Array | None = None) -> tuple[float, float]:
    """Distance of the motions from the true ones, and how well they vary with them.

    Scales are left out. Of rotations and translations those count that are larger than noise.

    Args:
        motions: Relative poses of the estimate ``[P, 4, 4]``, in its own units of length.
        true: The true ones.
        R_est_cam: Rotation from the camera's axes to those that the motions are given in.

    Returns:
        Median error over the median motion, of the moving half of the pairs, rotations or
        translations, whichever is worse: infinite if nothing moves. And the best correlation of the
        two about their means: low where the motion is always the same, and then many wrong poses
        explain it.
    """
    if R_est_cam is not None:
        motions = se3.with_rotation(motions, R_est_cam.T @ motions[:, :3, :3] @ R_est_cam)
        motions[:, :3, 3] = motions[:, :3, 3] @ R_est_cam
    if len(true) < MIN_POSES:
        return np.inf, 0.0
    errors = []
    correlations = []

    # rotations of the half of the pairs that rotates most
    angle = np.rad2deg(se3.rotation_angle(true))
    moving = angle >= np.median(angle)
    true_angle = float(np.median(angle[moving]))
    if true_angle > ROTATES_DEG:
        off = np.rad2deg(se3.rotation_angle(se3.inverse(motions[moving]) @ true[moving]))
        errors.append(float(np.median(off)) / true_angle)
        correlations.append(_correlation(se3.scaled_axes(motions)[0], se3.scaled_axes(true)[0]))

    # translations of the half that moves most, at equal median lengths
    length = np.linalg.norm(true[:, :3, 3], axis=1)
    moving = length >= np.median(length)
    moved = true[moving, :3, 3]
    estimated = motions[moving, :3, 3]
    own_length = float(np.median(np.linalg.norm(estimated, axis=1)))
    true_length = float(np.median(length[moving]))
    if true_length > MOVES_M:
        off = length[moving]
        if own_length > 0:
            off = np.linalg.norm(estimated * (true_length / own_length) - moved, axis=1)
        errors.append(float(np.median(off)) / true_length)
        correlations.append(_correlation(motions[:, :3, 3], true[:, :3, 3]))
    return max(errors, default=np.inf), max(correlations, default=0.0)


@dataclass(frozen=True)
class Convention:
    """A convention that poses may follow in place of camera-to-world matrices.

    Attributes:
        id: Id of the hint that names this convention.
        what: What they seem to be.
        cure: What was done to them, and what to give instead.
        undo: Brings poses ``[N, 4, 4]`` in order.
    """

    id: HintId
    what: str
    cure: str
    undo: Callable[[Array], Array]


CONVENTIONS = (
    Convention(
        "inverted-poses",
        "the poses seem to be world to camera",
        "after inverting each pose; give T_world_cam, camera to world: invert your matrices",
        se3.inverse,
    ),
    Convention(
        "quaternion-order",
        "the quaternions seem to be in the order qw qx qy qz",
        "after re-ordering; write them as qx qy qz qw",
        se3.from_wxyz_read_as_xyzw,
    ),
    Convention(
        "inverted-rotations",
        "the rotations seem to be world to camera, the positions are not",
        "after transposing each rotation; give those of T_world_cam, camera to world",
        lambda poses: se3.with_rotation(poses, poses[:, :3, :3].transpose(0, 2, 1)),
    ),
    Convention(
        "camera-axes",
        "the orientations seem to have the axes y up, z back (OpenGL)",
        "after turning them; give those of a camera with x right, y down, z forward",
        lambda poses: se3.with_rotation(poses, poses[:, :3, :3] @ np.diag([1.0, -1.0, -1.0])),
    ),
    Convention(
        "camera-axes",
        "the orientations seem to have the axes x forward, y left, z up (ROS)",
        "after turning them; give those of a camera with x right, y down, z forward",
        lambda poses: se3.with_rotation(
            poses, poses[:, :3, :3] @ [[0, 0, 1], [-1, 0, 0], [0, -1, 0]]
        ),
    ),
)
"""The likeliest first."""


def _correlation(estimated: Array, true: Array) -> float:
    """Correlation of motions ``[N, 3]`` about their means, jumps left out; 0 where one does not vary."""
    # an estimate jumps where a tracker relocalises or closes a loop; the truth does not
    length = np.linalg.norm(estimated, axis=1)
    usual = length <= 6 * np.median(length)
    estimated_about_mean = estimated[usual] - estimated[usual].mean(axis=0)
    true_about_mean = true[usual] - true[usual].mean(axis=0)

    # a motion that is nearly the same at every step says nothing of the convention
    estimated_size = np.linalg.norm(estimated_about_mean)
    true_size = np.linalg.norm(true_about_mean)
    if estimated_size <= 0.1 * np.linalg.norm(length[usual]) or not true_size > 0:
        return 0.0
    return float((estimated_about_mean * true_about_mean).sum() / (estimated_size * true_size))
