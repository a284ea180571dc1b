"""Does the ground truth of a recording agree with the motion that its images show?

The motion between frames (`rgbd_motion`) is compared with that of the truth: as stored, shifted in time, inverted,
with its quaternions read in the other order, in other axes. Where the two agree, camera and depth are measured by them.
"""

from __future__ import annotations

from collections.abc import Sequence as PySequence
from dataclasses import dataclass
from operator import attrgetter

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from dynslam_bench.geometry import se3
from dynslam_bench.geometry.association import nearest_gap
from dynslam_bench.geometry.camera import Camera
from dynslam_bench.geometry.trajectory import Trajectory
from dynslam_bench.sequences.rgbd_motion import (
    READINGS,
    ROTATION_GAIN,
    ROTATION_NOISE,
    Match,
    Motions,
    RgbdPair,
    TruthMotion,
    agreement,
    match,
    motions_of,
    rotation_between,
    weighted_mean,
)
from dynslam_bench.sequences.stream_checks import Finding, fault

Array = NDArray[np.float64]
total = attrgetter("total")

LARGEST_SHIFT_S = 2.0
SAME_FRAME_S = 0.02
LEAST_COVERAGE = 0.15
LEAST_PAIRS = 8
REST_PX = 2.0
GOOD = 0.75
"""`Match.total` of a truth that agrees with the motion; 0.78 to 0.98 in healthy recordings, else up to 0.5."""
SURE = 0.86
"""The same for a shift in time of a recording that is shorter than the range of shifts searched, or has few pairs: one
of 160 shifts fits by chance to 0.84."""
MANY_PAIRS = 25
UNLIKE = 0.6
LEAST_TIME_S = 0.05
UNRELATED = 0.48
"""The best agreement of a truth of another recording stays below; where moving things fill the view it is 0.55."""
LEAST_UNLIKE = 12
_STEP_S = 0.025
RESAVE = "write each line of groundtruth.txt as: timestamp tx ty tz qx qy qz qw, camera to world, metres"
_CURES = {
    "inverted": ("truth-inverted", "the poses are world-to-camera", "invert them: p -> -R^T p, R -> R^T"),
    "w first": ("truth-quaternion-order", "the quaternions are in the order qw qx qy qz", RESAVE),
    "w first, inverted": (
        "truth-quaternion-order",
        "the quaternions are in the order qw qx qy qz, and the poses are world-to-camera",
        RESAVE,
    ),
    "rotations inverted": (
        "truth-inverted",
        "the rotations are world-to-camera while the positions are the camera's",
        "invert the rotations: conjugate the quaternions",
    ),
}


def truth_findings(
    stamps: Array, truth: Trajectory | None, camera: Camera, pairs: PySequence[RgbdPair]
) -> list[Finding]:
    """What the truth of a recording does not share with its images, then what camera and depth do not.

    Args:
        stamps: Stamps of the frames.
        truth: Poses at their stamps; None if there are none.
        camera: The stated camera.
        pairs: Pairs of frames and their motions.
    """
    if truth is None:
        text = "there is no ground truth: units of the depth, intrinsics and time were not compared with any"
        return [Finding("no-truth", "note", None, "", text, "add groundtruth.txt to check more")]
    begin, end = truth.timestamps[[0, -1]]
    apart = max(begin - stamps[-1], stamps[0] - end)
    if apart > 0:
        text = (
            f"truth and images share no time: {begin:.3f} to {end:.3f} s and {stamps[0]:.3f} to {stamps[-1]:.3f} s, "
            f"{apart:.3f} s apart"
        )
        cure = "take the groundtruth.txt of this recording, or put its stamps on the images' clock"
        return [fault("truth-other-sequence", float(apart), "s", text, cure)]
    covered = int((nearest_gap(stamps, truth.timestamps) < SAME_FRAME_S).sum())
    if covered < max(LEAST_COVERAGE * len(stamps), 3):
        text = f"{covered} of {len(stamps)} frames have a true pose within {SAME_FRAME_S} s"
        return [fault("truth-sparse", covered, "frames", text, "export the truth of all frames again")]
    usable = [pair for pair in pairs if pair.T_first_second is not None and pair.inliers.mean() >= 0.5]
    displacement = float(np.median([pair.displacement_px for pair in usable])) if usable else np.inf
    if displacement < REST_PX and len(usable) >= 3:
        return [_at_rest(TruthMotion(truth), camera, motions_of(usable, stamps), displacement)]
    if len(usable) < LEAST_PAIRS:
        text = (
            f"the images give a motion for {len(usable)} of {len(pairs)} pairs of frames, fewer than {LEAST_PAIRS}: "
            "truth and camera were not compared"
        )
        return [
            Finding("motion-unmeasured", "note", float(len(usable)), "pairs", text, "check a part with more texture")
        ]
    return _compared(stamps, truth, camera, [pair for pair in usable if pair.displacement_px >= REST_PX], len(pairs))


def _at_rest(truth: TruthMotion, camera: Camera, motions: Motions, displacement: float) -> Finding:
    """Images that do not move beside a truth that does, or does not either."""
    _, relative, turns, valid = truth.between(motions.start, motions.end)
    moves = np.linalg.norm(turns, axis=1) + np.linalg.norm(relative[:, :3, 3], axis=1) / motions.depth_m
    expected = camera.fx * float(np.median(moves[valid])) if valid.any() else 0.0
    if expected > 10 * REST_PX:
        text = f"the truth moves the image by {expected:.0f} pixels between frames that move by {displacement:.1f}"
        return fault("truth-other-sequence", expected, "px", text, "take the truth of this recording")
    text = f"the camera rests (the image moves by {displacement:.1f} pixels): truth and intrinsics cannot be compared"
    return Finding("no-motion", "note", displacement, "px", text, "check a part in which the camera moves")


def _compared(stamps: Array, truth: Trajectory, camera: Camera, pairs: list[RgbdPair], tried: int) -> list[Finding]:
    motions = motions_of(pairs, stamps)
    readings = {reading: TruthMotion(truth, reading) for reading in READINGS}
    steps = round(LARGEST_SHIFT_S / _STEP_S)
    shifts = _STEP_S * np.arange(-steps, steps + 1)  # exact multiples: the same limits early and late
    every = [match(motions, readings[name], name, float(shift)) for name in READINGS for shift in shifts]
    matches = [candidate for candidate in every if candidate.share >= 0.5]
    near = [one for one in matches if one.reading == READINGS[0] and abs(one.shift_s) < LEAST_TIME_S]
    if not near or sum(near[0].weights) < 0.4:
        text = f"only {len(pairs)} pairs of frames with a small motion share time with the truth: it cannot be compared"
        return [Finding("motion-unmeasured", "note", float(len(pairs)), "pairs", text, "check a longer part")]
    stated, best = max(near, key=total), max(matches, key=total)
    unshifted = min(near, key=lambda one: abs(one.shift_s))
    if unshifted.total > stated.total - 0.02:
        stated = unshifted
    differs = best.reading != READINGS[0] or abs(best.shift_s) >= LEAST_TIME_S
    long = len(pairs) >= MANY_PAIRS and float((motions.end - motions.start).sum()) >= 2 * LARGEST_SHIFT_S
    needed = GOOD if long or abs(best.shift_s) < LEAST_TIME_S else SURE
    now, then = stated.clearest, best.clearest
    if differs and then >= needed and 1 - then < 0.65 * (1 - now) and now < then - 0.05:
        turned = None if best.reading == READINGS[0] else _turned(motions, readings[READINGS[0]], stated, best)
        return _misread(motions, readings, stated, best) if turned is None else [turned]
    if stated.rotation >= UNLIKE and stated.weights[0] >= 0.3:
        return _measured(motions, readings[READINGS[0]], stated, camera, pairs)
    return _otherwise(motions, readings, stated, best, tried)


def _misread(motions: Motions, readings: dict[str, TruthMotion], stated: Match, best: Match) -> list[Finding]:
    findings = []
    fine = [match(motions, readings[best.reading], best.reading, best.shift_s + d) for d in np.arange(-5, 6) * 0.005]
    shift = max(fine, key=total).shift_s
    so = f"so they explain {100 * best.clearest:.0f} % of the images' motion, as stored {100 * stated.clearest:.0f} %"
    if best.reading != READINGS[0]:
        name, text, cure = _CURES[best.reading]
        findings.append(fault(name, best.total, "", f"{text}: {so}", cure))
    if abs(shift) >= LEAST_TIME_S:
        when = "late" if shift > 0 else "early"
        text = f"the truth is {abs(shift):.3f} s {when}: {so.replace('they explain', 'it explains')}"
        change = "subtract {} s from" if shift > 0 else "add {} s to"
        cure = f"{change.format(f'{abs(shift):.3f}')} the stamps of the truth"
        findings.append(fault("truth-time-shift", shift, "s", text, cure))
    return findings


def _otherwise(
    motions: Motions, readings: dict[str, TruthMotion], stated: Match, best: Match, tried: int
) -> list[Finding]:
    """A truth that agrees with the motion in no convention: in other axes, or not at all."""
    closest = best.total
    for reading in READINGS[:3]:
        for shift in np.arange(-4, 5) * 0.025 if reading == READINGS[0] else (0.0,):
            _, _, turns, valid = readings[reading].between(motions.start + shift, motions.end + shift)
            if valid.mean() < 0.5:
                continue
            measured, true = motions.rotation[valid], turns[valid]
            X = rotation_between(measured, true)
            alike = agreement(measured @ X.T, true, ROTATION_GAIN)
            closest = max(closest, alike)
            if alike >= GOOD and reading == READINGS[0]:
                return [_axes(X, alike, stated)]
    enough = stated.weights[0] >= 0.5 and len(motions.start) >= LEAST_UNLIKE and len(motions.start) >= 0.5 * tried
    if enough and closest < UNRELATED:
        text = (
            f"the truth explains at most {100 * closest:.0f} % of the motion that {len(motions.start)} pairs of frames "
            f"show, under any shift to {LARGEST_SHIFT_S:g} s, inverse, order of quaternions or axes"
        )
        return [fault("truth-other-sequence", closest, "", text, "take the truth of this recording")]
    text = (
        f"the truth explains {100 * stated.total:.0f} % of the motion between the frames, too little to compare more: "
        "it may belong to another recording"
    )
    cure = "make sure that groundtruth.txt is this recording's, or check a part with a clearer motion"
    return [Finding("truth-unclear", "note", stated.total, "", text, cure)]


def _turned(motions: Motions, truth: TruthMotion, stated: Match, best: Match) -> Finding | None:
    """Other axes, where these explain rotations and translations better than another reading of the file."""
    _, relative, turns, valid = truth.between(motions.start, motions.end)
    X = rotation_between(motions.rotation[valid], turns[valid])
    rotation = agreement(motions.rotation[valid] @ X.T, turns[valid], ROTATION_GAIN)
    translation = agreement(motions.translation[valid] @ X.T, relative[valid, :3, 3])
    total = weighted_mean(rotation, translation, stated.weights)
    return _axes(X, rotation, stated) if total > best.total + 0.03 else None


def _degrees(X: Array) -> float:
    """The angle of an orthogonal matrix."""
    return float(np.degrees(np.arccos(np.clip((np.trace(X) - 1) / 2, -1, 1))))


def _axes(X: Array, alike: float, stated: Match) -> Finding:
    angle = _degrees(X)
    text = (
        f"the truth's axes are turned by {angle:.0f} degrees against the camera's: so they explain "
        f"{100 * alike:.0f} % of the images' rotation, as stored {100 * stated.rotation:.0f} %"
    )
    return fault("truth-axes", angle, "degrees", text, _turn(X))


def _turn(R_body_cam: Array) -> str:
    """How to give a truth the camera's axes; a rotation within 20 degrees of swapped axes is written as such."""
    swapped = np.round(R_body_cam)
    near = not np.array_equal(swapped, np.eye(3)) and np.trace(swapped.T @ R_body_cam) > 1 + 2 * np.cos(np.radians(20))
    rows = [", ".join(f"{value:g}" for value in row) for row in (swapped if near else R_body_cam.round(3)) + 0.0]
    return f"multiply each rotation of groundtruth.txt from the right by [{'; '.join(rows)}]"


def _measured(
    motions: Motions, truth: TruthMotion, stated: Match, camera: Camera, pairs: PySequence[RgbdPair]
) -> list[Finding]:
    """Of a truth whose rotations are the camera's: units, positions' axes, then camera, depth and lever arm."""
    first, relative, turns, valid = truth.between(motions.start + stated.shift_s, motions.end + stated.shift_s)
    size = np.linalg.norm(motions.rotation, axis=1) + np.linalg.norm(turns, axis=1) + 2 * ROTATION_NOISE
    agreeing = valid & (np.linalg.norm(motions.rotation - turns, axis=1) < 0.5 * size)
    if agreeing.sum() < LEAST_PAIRS:
        return []
    relative, clear = relative[agreeing], stated.weights[1] >= 0.4
    if stated.gain < 0.05:
        return [_scale(1 / stated.gain, camera, motions)]
    fitted = _fitted([pair for pair, use in zip(pairs, agreeing, strict=True) if use], relative, camera)
    if not fitted and clear and stated.translation >= 0.7 and abs(np.log(stated.gain)) > np.log(1.5):
        return [_scale(1 / stated.gain, camera, motions)]
    if not fitted and clear and stated.translation < UNLIKE:
        return _positions(motions.translation[agreeing], first[agreeing, :3, :3], relative[:, :3, 3], stated)
    return fitted


def _scale(factor: float, camera: Camera, motions: Motions) -> Finding:
    """The true translations are `factor` times the measured ones."""
    text = f"the truth's translations are {factor:.4g} times the measured ones (median depth {motions.depth_m:.2f} m)"
    if factor > 30 and 0.15 < motions.depth_m < 20:
        unit, divisor = ("millimetres", 1000) if factor > 300 else ("centimetres", 100)
        cure = f"divide the positions of groundtruth.txt by {divisor}"
        return fault("truth-scale", factor, "", f"{text}: they are in {unit}", cure)
    cure = f"set depth_factor = {camera.depth_factor / factor:.4g} in camera.toml (it is {camera.depth_factor:g})"
    return fault("depth-factor", factor, "", text, f"{cure}, unless the truth is not in metres")


def _positions(steps: Array, R_world_first: Array, true_steps: Array, stated: Match) -> list[Finding]:
    """Positions in other axes than the orientations, or mirrored, of translations in the camera's axes ``[N, 3]``."""
    in_world = [np.einsum("nij,nj->ni", R_world_first, motion) for motion in (steps, true_steps)]
    for measured, true, where in ((*in_world, "world"), (steps, true_steps, "camera")):
        W = rotation_between(measured, true, proper=False)
        alike = agreement(measured @ W.T, true)
        angle = _degrees(W)
        if alike >= GOOD and alike > stated.translation + 0.2 and (np.linalg.det(W) < 0 or angle > 15):
            how = "mirrored" if np.linalg.det(W) < 0 else f"turned by {angle:.0f} degrees"
            text = (
                f"the truth's positions are {how} in the {where}'s axes against its orientations: so they explain "
                f"{100 * alike:.0f} % of the images' translation, as stored {100 * stated.translation:.0f} %"
            )
            return [fault("truth-axes", angle, "degrees", text, "use one right-handed frame for both")]
    return []


def _fitted(pairs: PySequence[RgbdPair], relative: Array, camera: Camera) -> list[Finding]:
    """The one of focal length, principal point, depth scale, axes and lever arm that explains the errors best."""
    before = fit_camera(pairs, relative, camera, ())
    fits = {name: fit_camera(pairs, relative, camera, names) for name, names in _GROUPS.items()}
    name = min(fits, key=lambda group: fits[group].cost)
    fit = fits[name]
    size, sigma = (float(np.linalg.norm([values[part] for part in _GROUPS[name]])) for values in (fit.value, fit.sigma))
    left = fit.cost / before.cost
    rules = _EXPLAINED if name != "lever" else _EXPLAINED_BY_LEVER
    if name == "lever" and float(np.median([pair.depth_share for pair in pairs])) < _DEPTH_FOR_LEVER:
        return []
    if size < _LIMITS[name] or not any(size >= sigmas * sigma and left <= share for sigmas, share in rules):
        return []
    errors = f"reprojection errors {before.residual_px:.1f} px -> {fit.residual_px:.1f} px"
    return [_described(name, fit, size, sigma, errors, camera)]


_GROUPS = {"focal": ("focal",), "centre": ("cx", "cy"), "scale": ("scale",), "turn": ("turn",), "lever": ("lever",)}
_LIMITS = {"focal": 0.08, "centre": 25.0, "scale": 0.1, "turn": np.radians(6), "lever": 0.04}
"""Published recordings differ from their cameras and truths by less: Bonn's lever arm is 0.019 m."""
_EXPLAINED = ((5, 0.75), (8, 0.88))
"""Standard deviations, and the part of the errors that may remain, for one value to be at fault: 0.87 and more remain
in healthy recordings, and no value above its limit is sure to 4."""
_EXPLAINED_BY_LEVER = ((5, 0.62),)
"""People who walk past can feign one: 0.68 remained then."""
_DEPTH_FOR_LEVER = 0.5
"""Part of the image that has depth. With less, the corners may lie on moving people alone: 0.61 remained then."""


def _described(name: str, fit: Fit, size: float, sigma: float, errors: str, camera: Camera) -> Finding:
    if name == "focal":
        factor = float(np.exp(fit.value["focal"][0]))
        text = f"the focal length is {factor:.3f} times the stated one (+- {100 * sigma:.1f} %): {errors}"
        cure = f"fx = {camera.fx * factor:.1f}, fy = {camera.fy * factor:.1f} in camera.toml, or name the right camera"
        return fault("camera-focal-length", factor, "", text, cure)
    if name == "centre":
        dx, dy = float(fit.value["cx"][0]), float(fit.value["cy"][0])
        text = f"the principal point is {dx:+.0f}, {dy:+.0f} px from the stated one (+- {sigma:.0f}): {errors}"
        cure = f"cx = {camera.cx + dx:.1f}, cy = {camera.cy + dy:.1f} in camera.toml, or name the right camera"
        return fault("camera-principal-point", size, "px", text, cure)
    if name == "scale":
        factor = float(np.exp(fit.value["scale"][0]))
        text = f"the depth, multiplied by {factor:.3f} (+- {100 * sigma:.1f} %), agrees with the truth: {errors}"
        cure = f"depth_factor = {camera.depth_factor / factor:.5g} in camera.toml (it is {camera.depth_factor:g})"
        return fault("depth-factor", factor, "", text, cure)
    if name == "turn":
        angle = float(np.degrees(size))
        text = f"the truth's axes are turned by {angle:.1f} degrees against the camera's: {errors}"
        turn = se3.exp(np.concatenate([np.zeros(3), fit.value["turn"]]))[:3, :3]
        return fault("truth-axes", angle, "degrees", text, _turn(turn))
    text = f"the camera is {size:.3f} m (+- {sigma:.3f}) from the point that the truth tracks: {errors}"
    lever = ", ".join(f"{value:+.3f}" for value in fit.value["lever"])
    return fault("truth-lever-arm", size, "m", text, f"move each position by R ({lever}), R being the pose's rotation")


# Focal length, principal point, depth scale, axes and lever arm at which a truth fits the images best.


@dataclass(frozen=True)
class Fit:
    """Camera and mounting that make the truth's motion carry the corners from image to image.

    Attributes:
        value: ``focal`` and ``scale`` (of the depth) as natural logarithms of the factor, ``cx`` and ``cy`` as pixels
            to be added, ``turn`` the rotation vector ``[3]`` in rad and ``lever`` the position ``[3]`` in metres of the
            camera in the frame of the body that the truth tracks.
        sigma: Their standard deviations, each pair of frames being one observation.
        residual_px: Median reprojection error.
        cost: Mean robust cost of a corner.
    """

    value: dict[str, Array]
    sigma: dict[str, Array]
    residual_px: float
    cost: float


_PARAMETERS = {"focal": slice(0, 1), "cx": slice(1, 2), "cy": slice(2, 3), "scale": slice(3, 4),
               "turn": slice(4, 7), "lever": slice(7, 10)}  # fmt: skip
_PRIOR = np.array([1.0, 200.0, 200.0, 2.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0])
_SCALES = np.array([0.1, 10, 10, 0.1, 0.1, 0.1, 0.1, 0.1, 0.1, 0.1])
_STEPS = np.array([1e-4, 0.05, 0.05, 1e-4, 1e-4, 1e-4, 1e-4, 1e-4, 1e-4, 1e-4])
_CORNERS_A_PAIR = 25
_OUTLIER_PX = 2.0


def _reprojection_errors(
    x: Array, camera: Camera, pair: NDArray[np.intp], first: Array, depth: Array, second: Array, back: Array
) -> Array:
    """Reprojection errors ``[N, 2]`` in pixels under the values ``[10]``.

    Args:
        x: The values, in the order of `_PARAMETERS`.
        camera: The stated camera.
        pair: The pair of each corner ``[N]``.
        first: Its pixels in the first frame ``[N, 2]``.
        depth: Its depth there ``[N]``.
        second: Its pixels in the second frame ``[N, 2]``.
        back: The truth's motions back to the second frames, of all pairs ``[M, 4, 4]``.
    """
    focal, centre = np.exp(x[0]) * np.array([camera.fx, camera.fy]), np.array([camera.cx, camera.cy]) + x[1:3]
    rays = np.concatenate([(first - centre) / focal, np.ones((len(first), 1))], axis=1)
    mount = se3.exp(np.concatenate([np.zeros(3), x[4:7]]))
    mount[:3, 3] = x[7:10]
    moves = (se3.inverse(mount) @ back @ mount)[pair]
    moved = np.einsum("nij,nj->ni", moves[:, :3, :3], np.exp(x[3]) * depth[:, None] * rays) + moves[:, :3, 3]
    return np.asarray(moved[:, :2] / np.maximum(moved[:, 2:], 0.05) * focal + centre - second)


def fit_camera(pairs: PySequence[RgbdPair], relative: Array, camera: Camera, free: PySequence[str]) -> Fit:
    """Focal length, principal point, depth scale, axes and lever arm at which the truth fits the images best.

    Robust least squares of the reprojection errors of the corners of all pairs, with the truth's relative motions held.
    A weak prior keeps values that the motion does not determine near the stated ones.

    Args:
        pairs: Pairs of frames with a motion.
        relative: Motions of the truth between them ``[N, 4, 4]``, in the depth's units.
        camera: The stated camera.
        free: Names of what is fitted, of `Fit.value`; the rest stays as stated.
    """
    chosen = [np.flatnonzero(pair.inliers) for pair in pairs]
    chosen = [index[:: max(1, len(index) // _CORNERS_A_PAIR)][:_CORNERS_A_PAIR] for index in chosen]
    first, depth, second = (
        np.concatenate([getattr(pair, name)[index] for pair, index in zip(pairs, chosen, strict=True)])
        for name in ("pixels_first", "depth_first", "pixels_second")
    )
    number, back = np.repeat(np.arange(len(pairs)), [len(index) for index in chosen]), se3.inverse(relative)
    index = [number for name in free for number in np.arange(10)[_PARAMETERS[name]].tolist()]

    def filled(part: Array) -> Array:
        x = np.zeros(10)
        x[index] = part
        return x

    def errors(x: Array) -> Array:
        return _reprojection_errors(x, camera, number, first, depth, second, back)

    def robust(part: Array) -> Array:
        raw = errors(filled(part)) / _OUTLIER_PX
        square = (raw**2).sum(axis=1, keepdims=True)
        shrunk = raw * np.sqrt(2 * (np.sqrt(1 + square) - 1) / np.maximum(square, 1e-12))
        return np.concatenate([shrunk.ravel(), filled(part) / _PRIOR])

    part = np.zeros(len(index))
    if len(index):
        part = np.asarray(least_squares(robust, part, x_scale=_SCALES[index]).x, np.float64)
    x, left = filled(part), errors(filled(part))
    # Standard deviations by a sandwich estimate, each pair of frames being one observation.
    weight = 1 / np.sqrt(1 + ((left / _OUTLIER_PX) ** 2).sum(axis=1))
    slopes = np.stack([(errors(x + s) - errors(x - s)) / (2 * s.sum()) for s in np.diag(_STEPS)], axis=-1)
    prior, pulls = np.diag(1 / _PRIOR**2) * _OUTLIER_PX**2, np.zeros((len(pairs), 10))
    np.add.at(pulls, number, np.einsum("npi,n,np->ni", slopes, weight, left))
    free_part = np.ix_(index, index)
    inverse = np.linalg.inv((np.einsum("npi,n,npj->ij", slopes, weight, slopes) + prior)[free_part])
    spread = inverse @ (pulls.T @ pulls + prior)[free_part] @ inverse
    deviation = np.sqrt(np.maximum(np.diag(spread), 0)) * np.sqrt(len(pairs) / max(len(pairs) - len(index), 1))
    return Fit(
        {name: x[where] for name, where in _PARAMETERS.items()},
        {name: filled(deviation)[where] for name, where in _PARAMETERS.items()},
        float(np.median(np.linalg.norm(left, axis=1))),
        float((robust(part) ** 2).sum() / len(first)),
    )
