"""Quality of a tracker's knowledge of its own errors: NEES and 95 % coverage of the covariances of its motions.

The error of a motion is the twist ``xi`` (translation in metres, rotation in radians) in
``T_true = T_estimated Exp(xi)``, a right perturbation. Its normalised estimation error squared,
``NEES = xi^T C^-1 xi``, is distributed as chi-square with six degrees of freedom if the covariance C is right
(Bar-Shalom, Li and Kirubarajan, Estimation with Applications to Tracking and Navigation, 2001, Section 5.4).
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.geometry import Trajectory, se3
from dynslam_bench.geometry.motion_covariances import (
    MotionCovariances,
    adjoint,
    between_poses,
    check_covariances,
    compose_covariances,
)
from dynslam_bench.geometry.se3 import Array

DEGREES = 6
CHI2_95 = 12.592
"""95 % quantile of chi-square with six degrees of freedom."""
CHI2_MEDIAN = 5.348
"""Median of chi-square with six degrees of freedom."""
SECOND_S = 1.0
SECOND_TOLERANCE = 0.05
"""Share of a second by which the span of two frames may miss it."""
LONGEST_GAP_S = 0.1
"""Between true poses farther apart none is interpolated."""
LARGEST_NEES = 1e12
"""A larger NEES counts as this: means stay numbers, however small a variance is."""
FAR_OFF = 100.0
"""A mean NEES of translation or rotation over its three degrees this far from 1 is stated, with its factor."""
UNITS = {
    "translation": {1e3: "millimetres", 1e2: "centimetres"},
    "rotation": {180 / np.pi: "degrees"},
}
"""Other units of the two parts, by how many of them a metre or a radian has."""
UNIT_TOLERANCE = 3.0
"""Standard deviations that miss a unit by up to this factor are taken for that unit."""


@dataclass(frozen=True)
class PoseNoise:
    """Standard deviations of a true pose, along and about each axis of the camera.

    Attributes:
        translation_m: Metres.
        rotation_rad: Radians.
    """

    translation_m: float
    rotation_rad: float

    def covariance(self) -> Array:
        """As a matrix ``[6, 6]``."""
        return np.diag([self.translation_m**2] * 3 + [self.rotation_rad**2] * 3)


NO_NOISE = PoseNoise(0.0, 0.0)
"""Noise of exact poses."""
EXACT = "synthetic/"
"""Beginning of the ids of rendered sequences, whose true poses are exact."""
MOTION_CAPTURE = {
    "tum/": PoseNoise(1.5e-4, np.deg2rad(0.06)),
    "bonn/": PoseNoise(1.5e-4, np.deg2rad(0.13)),
}
"""Noise of the true poses by the beginning of a sequence's id: the rms of third differences of positions and
orientations over sqrt(20), which a smooth motion hardly adds to, on parts of fr1/xyz, fr1/rpy and crowd."""


def truth_noise(sequence_id: str) -> PoseNoise | None:
    """The noise of a sequence's true poses, `NO_NOISE` for exact ones; None where it is not known."""
    if sequence_id.startswith(EXACT):
        return NO_NOISE
    for prefix, noise in MOTION_CAPTURE.items():
        if sequence_id.startswith(prefix):
            return noise
    return None


@dataclass(frozen=True)
class Uncertainty:
    """The scores of a tracker's covariances.

    Attributes:
        metrics: ``nees_<span>_mean`` and ``nees_<span>_median``, both 1 for right covariances (over
            six, and over chi-square's median); ``within95_<span>``, the share of the
            motions whose error lies within the 95 % ellipsoid. The span is ``1f`` (from a frame to
            the next) or ``1s`` (one second); one without motions has none.
        diagnostics: On how many motions they are, and with which noise of the truth.
        warnings: What is wrong with the covariances, a line each.
    """

    metrics: dict[str, float] = field(default_factory=dict)
    diagnostics: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)


def motion_uncertainty(
    estimate: Trajectory,
    covariances: MotionCovariances,
    truth: Trajectory,
    noise: PoseNoise | None = NO_NOISE,
) -> Uncertainty:
    """Score the covariances of a tracker's motions against its true errors.

    Args:
        estimate: Camera-to-world poses as they were when their frames came, in metres.
        covariances: Covariances of the motions to some or all of these frames.
        truth: True camera-to-world poses; those at the frames' stamps are interpolated.
        noise: Noise of the true poses; None where it is not known.
    """
    # the covariance of each motion between neighbouring poses; NaN where there is none
    matrices = between_poses(estimate, covariances)
    given = len(matrices) - int(np.isnan(matrices).all(axis=(1, 2)).sum())
    is_valid, warnings = _validate(matrices, given)
    if not is_valid.any():
        return Uncertainty(warnings=warnings)

    # motions by estimate and truth, where there are both
    known_noise = NO_NOISE if noise is None else noise
    poses, has_truth = _interpolated(truth, estimate.timestamps)
    after = np.arange(1, len(estimate))
    after = after[is_valid & has_truth[1:] & has_truth[:-1]]
    if not len(after):
        return Uncertainty(
            warnings=warnings, diagnostics=["no motion with a covariance has true poses"]
        )
    pairs = np.stack([after - 1, after], axis=1)
    one_frame = _Motions.of(estimate.T_world_cam, poses, pairs, matrices[after - 1], known_noise)

    # over one second, where all covariances between are valid
    seconds = _pairs_over_a_second(estimate.timestamps, is_valid, has_truth)
    composed = compose_covariances(estimate.T_world_cam, matrices, seconds)
    one_second = _Motions.of(estimate.T_world_cam, poses, seconds, composed, known_noise)

    metrics = one_frame.metrics("1f") | one_second.metrics("1s")
    if noise is None:
        source = "the errors of the truth, whose noise is not known"
    elif noise == NO_NOISE:
        source = "no noise of the truth"
    else:
        source = (
            f"the truth's own noise, {1e3 * noise.translation_m:.2g} mm and "
            f"{np.rad2deg(noise.rotation_rad):.2g} deg"
        )
    diagnostics = [
        f"NEES over {len(pairs)} motions from frame to frame and {len(seconds)} over one second, with {source}"
    ]
    return Uncertainty(metrics, diagnostics, warnings + one_frame.doubts())


@dataclass(frozen=True, eq=False)
class _Motions:
    """Errors ``[P, 6]`` of motions, and their covariances ``[P, 6, 6]``."""

    errors: Array
    covariances: Array

    @classmethod
    def of(
        cls,
        estimate: Array,
        truth: Array,
        pairs: NDArray[np.intp],
        covariances: Array,
        noise: PoseNoise,
    ) -> _Motions:
        """The motions of pairs ``[P, 2]`` of poses ``[N, 4, 4]``; the truth's noise is added to their covariances."""
        estimated = se3.between(estimate, pairs)
        errors = se3.log(se3.inverse(estimated) @ se3.between(truth, pairs))
        # the noise of the pose before counts as it appears behind the motion
        back = adjoint(se3.inverse(estimated))
        of_pose = noise.covariance()
        of_motion = of_pose + back @ of_pose @ np.swapaxes(back, -1, -2)
        return cls(errors, covariances + of_motion)

    def metrics(self, span: str) -> dict[str, float]:
        """See `Uncertainty.metrics`."""
        if not len(self.errors):
            return {}
        values = np.minimum(nees(self.errors, self.covariances), LARGEST_NEES)
        return {
            f"nees_{span}_mean": float(values.mean()) / DEGREES,
            f"nees_{span}_median": float(np.median(values)) / CHI2_MEDIAN,
            f"within95_{span}": float((values <= CHI2_95).mean()),
        }

    def doubts(self) -> list[str]:
        """One line where the covariances are far off, with the factor and the unit that it suggests."""
        ratio = _mean_nees(self.errors, self.covariances) / DEGREES
        parts = []
        for name, part in (("translation", slice(0, 3)), ("rotation", slice(3, 6))):
            of_part = _mean_nees(self.errors[:, part], self.covariances[:, part, part]) / 3
            if not 1 / FAR_OFF <= of_part <= FAR_OFF:
                factor = 1 / np.sqrt(max(of_part, np.finfo(float).tiny))
                unit = _unit_of(factor, UNITS[name])
                parts.append(f"standard deviations of {name} are {factor:.3g} x the errors{unit}")
        if not parts:
            return []
        return [
            f"the covariances do not fit the errors: NEES / 6 is {ratio:.3g} over one frame, 1 is right; "
            f"{'; '.join(parts)}; metres and radians are expected, translation first"
        ]


def _unit_of(factor: float, units: dict[float, str]) -> str:
    """The unit that would explain standard deviations so many times too large, in words; empty for none."""
    for size, unit in units.items():
        if size / UNIT_TOLERANCE <= factor <= size * UNIT_TOLERANCE:
            return f", as in {unit}"
    return ""


def _mean_nees(errors: Array, covariances: Array) -> float:
    """Mean NEES, none of them counting for more than `LARGEST_NEES`."""
    return float(np.minimum(nees(errors, covariances), LARGEST_NEES).mean())


def nees(errors: Array, covariances: Array) -> Array:
    """``xi^T C^-1 xi`` of errors ``[P, d]`` and positive definite covariances ``[P, d, d]``."""
    # divided by the standard deviations, so that metres and radians of any size can be solved
    deviations = np.sqrt(np.diagonal(covariances, axis1=-2, axis2=-1))
    scaled = errors / deviations
    correlations = covariances / (deviations[:, :, None] * deviations[:, None, :])
    return np.asarray((scaled * np.linalg.solve(correlations, scaled[..., None])[..., 0]).sum(-1))


def _validate(matrices: Array, given: int) -> tuple[NDArray[np.bool_], list[str]]:
    """Flags ``[M]`` of the covariances ``[M, 6, 6]`` that can be used, and a line for each kind of fault.

    Args:
        matrices: The covariances.
        given: How many of them hold a number.
    """
    finite, positive, symmetric = check_covariances(matrices)
    valid = positive & symmetric
    warnings = []
    missing = len(matrices) - given
    not_finite = given - int(np.count_nonzero(finite))
    not_positive = int(np.count_nonzero(finite & ~positive))
    not_symmetric = int(np.count_nonzero(finite & positive & ~symmetric))
    for count, what in (
        (missing, "no covariance, or none of 6x6 numbers"),
        (not_finite, "a covariance with NaN or infinite numbers"),
        (not_positive, "a covariance that is not positive definite"),
        (not_symmetric, "a covariance that is not symmetric"),
    ):
        if count:
            warnings.append(f"{count} of {len(matrices)} motions have {what}; they are not scored")
    return valid, warnings


def _interpolated(truth: Trajectory, stamps: Array) -> tuple[Array, NDArray[np.bool_]]:
    """True poses ``[N, 4, 4]`` at stamps, and at which ``[N]`` there is one; elsewhere the pose is the identity."""
    # the module takes long to load
    from scipy.spatial.transform import Rotation, Slerp

    # of several true poses at one stamp the last counts, as in files
    is_last = np.append(np.diff(truth.timestamps) > 0, True)[: len(truth)]
    truth = truth.select(is_last)
    times = truth.timestamps
    poses = np.tile(np.eye(4), (len(stamps), 1, 1))
    if len(times) < 2:
        return poses, np.zeros(len(stamps), bool)
    after = np.clip(np.searchsorted(times, stamps), 1, len(times) - 1)
    gaps = times[after] - times[after - 1]
    has_pose = (stamps >= times[0]) & (stamps <= times[-1]) & (gaps <= LONGEST_GAP_S)
    # a stamp that has a true pose needs no neighbour
    nearest = np.where(stamps - times[after - 1] < times[after] - stamps, after - 1, after)
    has_pose |= np.abs(times[nearest] - stamps) <= 1e-6

    at = np.clip(stamps, times[0], times[-1])
    rotation = Slerp(times, Rotation.from_matrix(truth.T_world_cam[:, :3, :3]))(at).as_matrix()
    places = np.stack([np.interp(at, times, axis) for axis in truth.positions.T], axis=1)
    poses[has_pose] = se3.from_matrix(places, rotation)[has_pose]
    return poses, has_pose


def _pairs_over_a_second(
    stamps: Array, is_valid: NDArray[np.bool_], has_truth: NDArray[np.bool_]
) -> NDArray[np.intp]:
    """Pairs ``[P, 2]`` of poses one second apart, all motions between which have a covariance."""
    later = np.searchsorted(stamps, stamps + SECOND_S)
    # the nearer of the two around a second
    later = np.minimum(later, len(stamps) - 1)
    earlier = np.maximum(later - 1, 0)
    is_earlier = np.abs(stamps[earlier] - stamps - SECOND_S) < np.abs(
        stamps[later] - stamps - SECOND_S
    )
    second = np.where(is_earlier, earlier, later)
    pairs = np.stack([np.arange(len(stamps)), second], axis=1)
    near = np.abs(stamps[second] - stamps - SECOND_S) <= SECOND_TOLERANCE * SECOND_S

    # motions without a covariance, counted up to each pose
    gaps = np.concatenate([[0], np.cumsum(~is_valid)])
    unbroken = gaps[pairs[:, 1]] == gaps[pairs[:, 0]]
    usable = near & unbroken & has_truth[pairs].all(axis=1) & (pairs[:, 1] > pairs[:, 0])
    chosen: NDArray[np.intp] = pairs[usable]
    return chosen
