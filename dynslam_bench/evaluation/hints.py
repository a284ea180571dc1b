"""Hints: faults of a trajectory file that its numbers show, each with the measured evidence and the cure.

An estimate may be scored without a word although its stamps are late, its unit is the millimetre or its poses are
world-to-camera: an alignment and a short path hide much of it. Here the same trajectory is compared with the truth as
if one such fault were undone. A hint is given only where that explains the true motion and the trajectory as it stands
does not; a tracker that is merely bad gets none. Hints never change a number.

Motions are compared from pose to pose, over some seconds at most, so that drift and the choice of the world frame do
not matter. Time shifts follow from the correlation of displacements over lags, coarse to fine, scales from Umeyama's
alignment.
"""

from __future__ import annotations

from math import comb

import numpy as np

from dynslam_bench.geometry.trajectory import Trajectory
from dynslam_bench.geometry.tum_file import FileNotes

from .alignment import align
from .hint_conventions import MIN_POSES, Motions
from .hint_tracks import Array, Hint, Track, fit
from .protocol import Protocol, get_protocol

FARTHEST_M = 1e12
"""Squares of larger numbers are no numbers any more."""
MOSTLY = 0.25
"""Share of the displacements that may stay unexplained where a time shift or a scale is said to explain them."""
STEADY = 1e-3
"""Displacements whose variance is a smaller share of their squares are one steady motion."""
LONGEST_SHIFT_S = 5.0
SHORTEST_SHIFT_S = 0.03
"""The clocks of good recordings differ by up to 25 ms, and a rolling shutter adds half its readout time."""
DISPLACEMENT_S = 0.5
LAG_S = 0.04
SCALE_FACTOR = 1.15
"""Scales closer to 1 than this factor are errors of a tracker."""
COPY_SHARE, COPY_M, EXACT_M = 1e-3, 1e-4, 1e-6
"""No tracker is as accurate as a thousandth of the extent of the path and a tenth of a millimetre at once; where the
truth shows no noise of its own, as that of rendered images, as a thousandth of a millimetre."""
NOISE_M = 1e-5
"""A truth with less noise than this was not measured."""
MEASURED_S = 1 / 60
"""Of a truth with longer steps than this, fast motion and noise are not told apart."""
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
    """What is probably wrong with an estimate, from its comparison with the truth.

    Args:
        estimate: Camera-to-world poses, as they were read.
        ground_truth: True camera-to-world poses at their own stamps; may have holes.
        protocol: Of it only whether the alignment finds the scale, which then means nothing.
        notes: What the estimate's file held in disorder.

    Returns:
        One hint a fault, by `Hint.id`; none where the estimate is healthy, or where nothing explains why it is bad.
    """
    sim3 = get_protocol(protocol).alignment == "sim3"
    found = _several_recordings(estimate, ground_truth, notes)
    truth = Track(ground_truth.timestamps, ground_truth.T_world_cam)
    inside = truth.covers(estimate.timestamps)
    if inside.sum() < MIN_POSES or np.abs(estimate.positions).max() > FARTHEST_M:
        return tuple(found)
    stamps, poses = estimate.timestamps[inside], estimate.T_world_cam[inside]
    shift, left = _time_shift(stamps, poses, truth)
    motions = Motions(stamps, poses, truth)
    if (wrong := motions.wrong_convention(shift)) is not None:
        hint, poses = wrong
        found.append(hint)
        shift, left = _time_shift(stamps, poses, truth)
    if shift:
        late = _shift_hint(stamps, poses, truth, shift, left)
        found += [late] if late else []
        shift = shift if late else 0.0
    covered = truth.covers(stamps + shift)
    stamps, poses = stamps[covered] + shift, poses[covered]
    if not sim3 and left < MOSTLY:
        found += _scale(stamps, poses, truth)
    return (*found, *_below_noise(stamps, poses, truth))


# -- several recordings --------------------------------------------------------------------------------------------


def _several_recordings(estimate: Trajectory, truth: Trajectory, notes: FileNotes | None) -> list[Hint]:
    """Stretches of stamps that lie wholly outside of the truth's time, and lines that go back in time."""
    stamps = estimate.timestamps
    parts = np.split(stamps, np.flatnonzero(np.diff(stamps) > OTHER_RECORDING_S) + 1)
    outside = [part for part in parts if part[-1] < truth.timestamps[0] or part[0] > truth.timestamps[-1]]
    back = 0.0 if notes is None else notes.back_s
    evidence: list[str] = []
    numbers: dict[str, float] = {}
    if 0 < len(outside) < len(parts):
        rows = sum(map(len, outside))
        evidence.append(
            f"{rows} of {len(stamps)} poses, in {len(outside)} stretches of time, lie outside of the truth's"
        )
        numbers |= {"poses_outside": float(rows), "stretches_outside": float(len(outside))}
    if notes is not None and back > OTHER_RECORDING_S:
        repeated = f", {notes.duplicates} of {notes.lines} lines repeat a stamp" if notes.duplicates else ""
        evidence.append(f"the stamps of the file go back by {back:.0f} s{repeated}")
        numbers |= {"back_s": back, "repeated_stamps": float(notes.duplicates)}
    if not evidence:
        return []
    text = f"the file seems to hold several recordings: {'; '.join(evidence)}; keep the rows of one"
    return [Hint("several-recordings", text, numbers)]


# -- time ----------------------------------------------------------------------------------------------------------


def _time_shift(stamps: Array, poses: Array, truth: Track) -> tuple[float, float]:
    """How late the truth has to be read for displacements to agree, and the share of them that then stays unexplained.

    Returns:
        Seconds to add to the stamps, 0 without clear evidence, and the share in [0, 1], at any scale.
    """
    span = float(stamps[-1] - stamps[0])
    window = min(DISPLACEMENT_S, span / 6)
    step = min(LAG_S, window / 3)
    most = int(min(LONGEST_SHIFT_S, span / 4) / step)
    grid = stamps[0] + step * np.arange(-most, int(span / step) + most + 1)
    track = Track(stamps, poses)
    own, known = (_displacements(each, grid, window) for each in (track, truth))
    at = most + np.flatnonzero(np.isfinite(own[most : len(own) - most, 0]))
    at = at[:: 1 + len(at) // 128]
    length = np.linalg.norm(own[at], axis=1)
    at = at[length <= 6 * np.median(length)] if len(at) else at  # without jumps
    if len(at) < MIN_POSES:
        return 0.0, 1.0
    lags = np.arange(-most, most + 1)
    lag = int(lags[np.argmin(_unexplained(own[at], known[at + lags[:, None]]))])
    coarse = lag * step
    fine = coarse + np.linspace(-1, 1, 9) * step
    begin, moved = grid[at], own[at]
    near = _unexplained(moved, _displacements(truth, begin + np.append(fine, 0.0)[:, None], window))
    now, near = float(near[-1]), near[:-1]
    best = int(np.argmin(near))
    shift, left = float(fine[best]), float(near[best])
    if 0 < best < len(fine) - 1 and (bend := near[best - 1] - 2 * left + near[best + 1]) > 0:
        shift += float(0.5 * (near[best - 1] - near[best + 1]) / bend * (fine[1] - fine[0]))
    itself = _displacements(track, begin[None] + shift, window)
    visible = float(_unexplained(moved, itself)[0])  # what such a shift does to a path of this shape
    clear = abs(shift) > SHORTEST_SHIFT_S and left < min(MOSTLY, 0.55 * now) and visible > 0.3 * now
    return (shift, left) if clear else (0.0, now)


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
    valid = np.isfinite(true[..., 0])
    true = np.where(valid[..., None], true, 0.0)
    u, singular, vt = np.linalg.svd(true.transpose(0, 2, 1) @ own)
    sign = np.sign(np.linalg.det(u) * np.linalg.det(vt))
    explained = (singular[:, 0] + singular[:, 1] + sign * singular[:, 2]).clip(0)
    size = (true**2).sum(axis=(1, 2)) * (valid @ (own**2).sum(axis=1))
    enough = (valid.mean(axis=1) > 0.5) & (size > 0)
    share = 1 - np.divide(explained**2, size, out=np.zeros(len(true)), where=enough)
    return np.asarray(np.where(enough, share.clip(0), 1.0))


def _shift_hint(stamps: Array, poses: Array, truth: Track, shift: float, left: float) -> Hint | None:
    """The hint, if the absolute error falls, too: by half where displacements stay unexplained."""
    both = truth.covers(stamps) & truth.covers(stamps + shift)
    if both.sum() < MIN_POSES:
        return None
    before, after = (fit(poses[both], truth.at(stamps[both] + late)).sim3_m for late in (0.0, shift))
    if not after < (0.9 if left < 0.05 else 0.5) * before:
        return None
    text = (
        f"the stamps seem to be {abs(shift):.3f} s {'early' if shift > 0 else 'late'}: with {shift:+.3f} s on each the "
        f"error falls from {before:.4f} to {after:.4f} m (at its best scale); give the stamps of the images, on the "
        "truth's clock"
    )
    return Hint("time-shift", text, {"shift_s": shift, "error_m": before, "error_undone_m": after})


# -- scale and noise ---


def _scale(stamps: Array, poses: Array, truth: Track) -> list[Hint]:
    best = fit(poses, truth.at(stamps))
    scale, before, after = best.scale, best.se3_m, best.sim3_m
    if not (scale > 0 and abs(np.log(scale)) > np.log(SCALE_FACTOR) and after < min(0.4 * before, 0.2 * best.extent_m)):
        return []
    window = min(DISPLACEMENT_S, (stamps[-1] - stamps[0]) / 6)
    moved, true = (_displacements(track, stamps, window) for track in (Track(stamps, poses), truth))
    both = np.isfinite(moved[:, 0]) & np.isfinite(true[:, 0])
    varying, varied = (each[both] - each[both].mean(axis=0) for each in (moved, true))
    steady = both.sum() < MIN_POSES or (varying**2).sum() < STEADY * (moved[both] ** 2).sum()
    if steady or _unexplained(varying, varied[None])[0] > MOSTLY:  # a steady motion fits many paths at some scale
        return []
    unit = next((name for name, size in _UNITS.items() if abs(np.log(scale / size)) < 0.1), "")
    cure = (
        f"are they in {unit}? give metres"
        if unit
        else "check the depth factor; score a tracker without depth under a protocol that finds the scale"
    )
    text = (
        f"the positions seem to have a wrong scale: with the factor {scale:.4g} the error falls from {before:.4g} to "
        f"{after:.4g} m; {cure}"
    )
    return [Hint("scale", text, {"scale": scale, "error_m": before, "error_undone_m": after})]


_UNITS = {"millimetres": 1e-3, "centimetres": 1e-2, "feet": 0.3048, "inches": 0.0254, "kilometres": 1e3}


def _below_noise(stamps: Array, poses: Array, truth: Track) -> list[Hint]:
    """An error that no tracker reaches, or jitter of the truth's measurement that the estimate shares."""
    between = truth.at(stamps)
    nearest = truth.poses[truth.nearest(stamps)]
    fits = [fit(poses, true) for true in (between, nearest)]
    error = min(each.sim3_m for each in fits)
    inside = (truth.stamps >= stamps[0]) & (truth.stamps <= stamps[-1])
    noise = _jitter(truth.positions[inside], 5) if truth.step < MEASURED_S else 0.0
    least = min(COPY_M if noise > NOISE_M else EXACT_M, COPY_SHARE * fits[0].extent_m)
    if error < least:
        text = f"the error of {1000 * error:.3g} mm is below what trackers reach: were the poses read from the truth?"
        return [Hint("below-truth-noise", text, {"error_m": error, "least_m": least})]
    own = min(
        _jitter(align(poses, true, "se3").apply(poses)[:, :3, 3] - true[:, :3, 3], 3) for true in (between, nearest)
    )
    if own < 0.5 * noise and noise > NOISE_M:
        text = (
            f"from frame to frame the error changes by {1000 * own:.3g} mm, less than the truth's own noise of "
            f"{1000 * noise:.3g} mm: were the poses made from the truth?"
        )
        return [Hint("below-truth-noise", text, {"jitter_m": own, "truth_noise_m": noise})]
    return []


def _jitter(positions: Array, order: int) -> float:
    """Standard deviation of white noise, per axis, that differences of some order show; metres, 0 if there are few."""
    if len(positions) < 30:
        return 0.0
    differences = np.diff(positions, order, axis=0)
    return float(np.median(np.abs(differences)) / (0.6745 * np.sqrt(comb(2 * order, order))))
