"""Do camera, depth and lengths of a recording fit a ground truth whose rotations are the camera's?

The value is at fault that explains the reprojection errors under the truth's motions (`camera_fit`).
The depth factor is measured by the lengths of the translations (`depth_scale`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dynslam_bench.geometry import Array, Camera, se3
from dynslam_bench.sequences.camera_fit import GROUPS, Fit, fit_camera
from dynslam_bench.sequences.depth_scale import DepthScale, depth_scale
from dynslam_bench.sequences.findings import Finding, finding_of
from dynslam_bench.sequences.readers.recorded import USUAL_FACTORS
from dynslam_bench.sequences.rgbd_motion import (
    ROTATION_NOISE,
    Match,
    Motions,
    RgbdPair,
    TruthMotion,
    agreement,
    explained_share,
    rotation_between,
)

LEAST_PAIRS = 8
"""Pairs of frames with a motion that a comparison needs."""
GOOD = 0.75
"""`Match.total` of a truth that agrees with the motion; 0.78 to 0.98 in healthy recordings, else up to 0.5."""
UNLIKE = 0.6
"""Agreement below which rotations, or translations, count as not alike."""
LEAST_UNIT = 30.0
"""Ratio of true to measured translations from which the truth's unit is no metre: no depth factor is that wrong."""
_LIMITS = {"focal": 0.08, "centre": 25.0, "scale": 0.1, "turn": np.radians(6), "lever": 0.04}
"""Published recordings differ from their cameras and truths by less: Bonn's lever arm is 0.019 m."""
_EXPLAINED: tuple[tuple[int, float], ...] = ((5, 0.75), (8, 0.88))
"""Standard deviations, and the part of the errors that may remain, for one value to be at fault: 0.87 and more remain
in healthy recordings, and no value above its limit is sure to 4."""
_EXPLAINED_BY_LEVER: tuple[tuple[int, float], ...] = ((5, 0.62),)
"""These limits for the lever arm: people who walk past can feign one: 0.68 remained then."""
_LEAST_DEPTH = 0.5
"""Part of the image that has depth, for a lever arm or a depth factor. With less, the corners may lie on moving people
alone: of the errors that a lever arm explains 0.61 remained then, and lengths came out at 0.43 of
the true ones."""
_WIDEST = 2.0
"""Ratio of the ends of the depth factor's interval above which it counts as not compared."""


@dataclass(frozen=True)
class _Fits:
    """Fits of the camera to the truth's motions.

    Attributes:
        stated: The stated camera, nothing fitted.
        groups: Each group of `GROUPS` fitted alone.
    """

    stated: Fit
    groups: dict[str, Fit]

    @property
    def best(self) -> str:
        """The group that explains the errors best."""
        return min(self.groups, key=lambda group: self.groups[group].cost)


def camera_findings(
    motions: Motions, truth: TruthMotion, stated: Match, camera: Camera, pairs: list[RgbdPair]
) -> list[Finding]:
    """Findings on a truth whose rotations are the camera's: units, positions' axes, camera, lever arm and depth.

    Args:
        motions: Measured motions.
        truth: The truth as it is stored.
        stated: How well it agrees with them.
        camera: The stated camera.
        pairs: Pairs of frames, one for each motion.
    """
    start = motions.start + stated.shift_s
    end = motions.end + stated.shift_s
    T_world_first, relative, turns, valid = truth.between(start, end)

    # pairs on whose rotation images and truth agree.
    size = np.linalg.norm(motions.rotation, axis=1) + np.linalg.norm(turns, axis=1)
    difference = np.linalg.norm(motions.rotation - turns, axis=1)
    agreeing = valid & (difference < 0.5 * (size + 2 * ROTATION_NOISE))
    if agreeing.sum() < LEAST_PAIRS:
        case = "depth-factor-unmeasured/pairs"
        return [finding_of(case, agreeing.sum(), pairs=len(pairs), least=LEAST_PAIRS)]

    # the truth's unit
    if 1 / stated.gain > LEAST_UNIT and 0.15 < motions.depth_m < 20:
        return [_unit_finding(1 / stated.gain, motions.depth_m)]

    # one wrong value of the camera or its mounting
    used = [pair for pair, use in zip(pairs, agreeing, strict=True) if use]
    relative = relative[agreeing]
    fits = _Fits(
        stated=fit_camera(used, relative, camera, ()),
        groups={name: fit_camera(used, relative, camera, names) for name, names in GROUPS.items()},
    )
    explained = _explains_errors(fits, used)
    if explained and fits.best != "scale":
        return [_fit_finding(fits, camera)]

    # axes of the positions
    if not explained and stated.weights[1] >= 0.4 and stated.translation < UNLIKE:
        measured = motions.translation[agreeing]
        R_world_first = T_world_first[agreeing, :3, :3]
        in_other_axes = _position_axes(measured, R_world_first, relative, stated)
        if in_other_axes is not None:
            finding, turned = in_other_axes
            if explained_share(used, turned, camera) > explained_share(used, relative, camera):
                return [finding]

    # the depth factor, from the scale of the images' translations beside the truth's
    first_guess = float(np.exp(-fits.groups["scale"].value["scale"][0]))
    share = _depth_share(used)
    if share < _LEAST_DEPTH:
        case = "depth-factor/depth" if explained else "depth-factor-unmeasured/depth"
        new = first_guess * camera.written_depth_factor
        facts = {"percent": 100 * share, "new": new, "old": camera.depth_factor}
        return [finding_of(case, 1 / first_guess, **facts)]
    scale = depth_scale(used, truth, start[agreeing], end[agreeing], camera, first_guess)
    if scale is None:
        return [finding_of("depth-factor-unmeasured/still", None)]
    sure = explained or scale.low <= first_guess <= scale.high
    return _depth_factor_findings(scale, camera, sure=sure)


def _depth_share(pairs: list[RgbdPair]) -> float:
    """Median part of the first images that holds depth."""
    return float(np.median([pair.depth_share for pair in pairs]))


def _unit_finding(ratio: float, depth_m: float) -> Finding:
    """A truth in millimetres or centimetres, by the ratio of true to measured translations."""
    unit, divisor = ("millimetres", 1000) if ratio > 300 else ("centimetres", 100)
    return finding_of("truth-scale", ratio, depth_m=depth_m, unit=unit, divisor=divisor)


# Camera and lever arm by reprojection errors.


def _explains_errors(fits: _Fits, pairs: list[RgbdPair]) -> bool:
    """Whether the best fitted value explains the reprojection errors so well that it is at fault."""
    # how large the value is, how sure, and which part of the errors remains with it
    name = fits.best
    fit = fits.groups[name]
    size = fit.size(name)
    sigma = fit.size_sigma(name)
    remaining = fit.cost / fits.stated.cost

    # a lever arm has stricter rules
    rules = _EXPLAINED
    if name == "lever":
        rules = _EXPLAINED_BY_LEVER
        if _depth_share(pairs) < _LEAST_DEPTH:
            return False
    beyond_chance = any(size >= sigmas * sigma and remaining <= share for sigmas, share in rules)
    return size >= _LIMITS[name] and beyond_chance


def _fit_finding(fits: _Fits, camera: Camera) -> Finding:
    """A wrong focal length, principal point, axes or lever arm."""
    name = fits.best
    fit = fits.groups[name]
    size = fit.size(name)
    sigma = fit.size_sigma(name)
    errors = f"reprojection errors {fits.stated.residual_px:.1f} px -> {fit.residual_px:.1f} px"
    if name == "focal":
        by = float(np.exp(fit.value["focal"][0]))
        facts = {"percent": 100 * sigma, "fx": camera.fx * by, "fy": camera.fy * by}
        return finding_of("camera-focal-length", by, errors=errors, **facts)
    if name == "centre":
        dx = float(fit.value["cx"][0])
        dy = float(fit.value["cy"][0])
        facts = {"sigma": sigma, "dx": dx, "dy": dy, "cx": camera.cx + dx, "cy": camera.cy + dy}
        return finding_of("camera-principal-point", size, errors=errors, **facts)
    if name == "turn":
        R = se3.exp(np.concatenate([np.zeros(3), fit.value["turn"]]))[:3, :3]
        return finding_of("truth-axes/fit", np.degrees(size), errors=errors, matrix=axes_text(R))
    lever = ", ".join(f"{metres:+.3f}" for metres in fit.value["lever"])
    return finding_of("truth-lever-arm", size, errors=errors, sigma=sigma, lever=lever)


# Axes.


def _position_axes(
    steps: Array, R_world_first: Array, relative: Array, stated: Match
) -> tuple[Finding, Array] | None:
    """Positions in other axes than the orientations, or mirrored.

    Args:
        steps: Measured translations in the first camera's axes ``[N, 3]``.
        R_world_first: The truth's rotations at the first frames ``[N, 3, 3]``.
        relative: The truth's motions ``[N, 4, 4]``.
        stated: How well the truth agrees as it is.

    Returns:
        The finding, and the motions with positions in the orientations' axes; None where these
        explain little.
    """
    identity = np.broadcast_to(np.eye(3), R_world_first.shape)
    # the axes in which the positions may be turned, and rotations to them and back.
    frames = (
        ("world", R_world_first, np.swapaxes(R_world_first, 1, 2)),
        ("camera", identity, identity),
    )
    for where, R_to, R_back in frames:
        measured = np.einsum("nij,nj->ni", R_to, steps)
        true = np.einsum("nij,nj->ni", R_to, relative[:, :3, 3])
        # the rotation or mirror image that explains the positions best
        W = rotation_between(measured, true, proper=False)
        mirrored = np.linalg.det(W) < 0
        angle = angle_degrees(W)
        alike = agreement(measured @ W.T, true)
        explains = alike >= GOOD and alike > stated.translation + 0.2
        if not (explains and (mirrored or angle > 15)):
            continue

        # the motions with the positions turned back
        how = "mirrored" if mirrored else f"turned by {angle:.0f} degrees"
        shares = {"percent_cured": 100 * alike, "percent_stored": 100 * stated.translation}
        turned = relative.copy()
        turned[:, :3, 3] = np.einsum("nij,nj->ni", R_back, true @ W)
        return finding_of("truth-axes/positions", angle, how=how, where=where, **shares), turned
    return None


def angle_degrees(X: Array) -> float:
    """The angle of an orthogonal matrix ``[3, 3]``."""
    return float(np.degrees(np.arccos(np.clip((np.trace(X) - 1) / 2, -1, 1))))


def axes_text(R_body_cam: Array) -> str:
    """The rotation that gives a truth the camera's axes; one within 20 degrees of swapped axes is written as such."""
    # three decimals, or whole numbers for axes that are nearly swapped
    written = R_body_cam.round(3)
    swapped = np.round(R_body_cam)
    is_rotation = np.array_equal(swapped @ swapped.T, np.eye(3))
    if is_rotation and not np.array_equal(swapped, np.eye(3)):
        if np.trace(swapped.T @ R_body_cam) > 1 + 2 * np.cos(np.radians(20)):
            written = swapped
    # adding 0.0 writes no -0
    return "; ".join(", ".join(f"{value:g}" for value in row) for row in written + 0.0)


# The depth factor.


def _depth_factor_findings(scale: DepthScale, camera: Camera, *, sure: bool) -> list[Finding]:
    """A depth factor that the truth's translations exclude, or a note that they leave it open.

    Args:
        scale: Lengths that the depth images give, as multiples of the truth's.
        camera: The stated camera.
        sure: Whether the reprojection errors agree.
    """
    old = camera.written_depth_factor
    interval = {"low": _three_digits(scale.low * old), "high": _three_digits(scale.high * old)}
    if scale.excludes(_LIMITS["scale"]):
        if not sure:
            return [finding_of("depth-factor-unmeasured/apart", None, **interval)]
        new = scale.value * old
        # the usual factor within the interval that is nearest to the estimate.
        usual = [factor for factor in USUAL_FACTORS if scale.low <= factor / old <= scale.high]
        facts = {
            "new": new,
            "old": old,
            "likely": min(usual, key=lambda factor: abs(np.log(factor / new)), default=new),
            "why": ", the usual value within the interval" if usual else "",
        }
        return [finding_of("depth-factor", 1 / scale.value, **facts, **interval)]
    if scale.high > _WIDEST * scale.low:
        return [finding_of("depth-factor-unmeasured", None, **interval)]
    return []


def _three_digits(value: float) -> str:
    """A number with three significant digits and no exponent."""
    return f"{float(f'{value:.3g}'):g}"
