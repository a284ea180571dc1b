"""Measure the raw units of a recording's depth in a metre of its ground truth, with a 95 % interval.

Between two frames the truth gives the rotation, the corners and their depth give the translation.
Its length is compared with the true one. What else can lie between the two is estimated along: a
lever arm, the turn of axes, a shift in time, and the readout of a rolling shutter, each within what
published recordings show.
"""

from dataclasses import dataclass

import numpy as np
from scipy.stats import t as student

from dynslam_bench.geometry import Array, Camera, se3
from dynslam_bench.sequences.rgbd_motion import RgbdPair, TruthMotion

ROTATION_SIGMA = np.radians(0.1)
"""Standard deviation of the truth's rotation between two frames.

Of 0.05, 0.1, 0.2 degrees and no bound, 0.1 gives translations with the least errors on Bonn,
fr1_xyz and fr1_rpy."""
LEVER_SIGMA_M = 0.02
"""Bonn's camera is 0.019 m from its markers."""
TURN_SIGMA = np.radians(2.0)
"""Standard deviation of the turn of the truth's axes."""
SHIFT_SIGMA_S = 0.01
"""Standard deviation of the truth's shift in time."""
READOUT_S = 0.013
"""Mean of a readout time that the camera does not state: from a global shutter to most of a frame."""
READOUT_SIGMA_S = 0.013
"""Standard deviation of that readout time, seconds."""
STATED_READOUT_SIGMA_S = 0.005
"""Standard deviation of one that it states."""
SYSTEMATIC = 0.03
"""Relative standard deviation of what all pairs share: Bonn's own calibration has a scale of 1.059."""
CAUCHY = 2.5
"""Scale of the robust kernels in standard deviations."""
LEAST_PAIRS = 8
"""Pairs that are needed for an interval."""
BLOCK = 2
"""Successive pairs that are left out together: they share an image, and often the same people."""
_ROUNDS = 20
"""Rounds of reweighted least squares, at most."""
_READOUT_STEP_S = 0.03
"""Step of the derivative by the readout time."""
_RATE_S = 0.015
"""Half the time over which the truth's turning rate is taken."""
_SHIFT_S = 0.01
"""Step of the derivative by the shift in time."""
_LEAST_PX = 0.3
"""Least standard deviation of a corner: below it the images' rounding counts."""
_LEAST_Z_M = 0.05
"""Smaller depths are taken as this one in projections."""


@dataclass(frozen=True)
class DepthScale:
    """Lengths that depth images give, as multiples of the truth's.

    Attributes:
        value: The estimate; 5 for depths that are five times too large.
        low: Lower end of the 95 % interval, not below 0.
        high: Its upper end.
    """

    value: float
    low: float
    high: float

    def excludes(self, share: float) -> bool:
        """Whether the interval lies outside of the lengths that are right within `share`."""
        return self.low > 1 + share or self.high < 1 / (1 + share)


def depth_scale(
    pairs: list[RgbdPair],
    truth: TruthMotion,
    start: Array,
    end: Array,
    camera: Camera,
    first_guess: float,
) -> DepthScale | None:
    """Estimate the scale of the depth images.

    Args:
        pairs: Pairs of frames whose rotations agree with the truth's.
        truth: The ground truth.
        start: Stamps ``[N]`` of the pairs' first frames, on the truth's clock.
        end: Stamps ``[N]`` of the pairs' second frames, on the truth's clock.
        camera: The stated camera.
        first_guess: A scale near which the translations are looked for.

    Returns:
        The scale; None where there are too few pairs, or the truth does not move.
    """
    if len(pairs) < LEAST_PAIRS:
        return None
    relative = truth.between(start, end)[1]
    rates = list(zip(_turning_rates(truth, start), _turning_rates(truth, end), strict=True))

    def translations(readout_s: float) -> Array:
        """Measured translations ``[N, 3]`` under a readout time."""
        return np.stack(
            [
                translation_of(pair, T, both_rates, camera, readout_s, first_guess)
                for pair, T, both_rates in zip(pairs, relative, rates, strict=True)
            ]
        )

    # under a global shutter, and how they change with the readout time
    still = translations(0.0)
    rolling = translations(_READOUT_STEP_S)
    by_readout = (rolling - still) / _READOUT_STEP_S

    # the readout time: stated, else the usual one with a wide prior
    if camera.readout_s > 0:
        readout_s = camera.readout_s
        readout_sigma_s = STATED_READOUT_SIGMA_S
    else:
        readout_s = READOUT_S
        readout_sigma_s = READOUT_SIGMA_S

    # how the true translations change with a shift in time.
    later = truth.between(start + _SHIFT_S, end + _SHIFT_S)[1]
    earlier = truth.between(start - _SHIFT_S, end - _SHIFT_S)[1]
    by_shift = (later - earlier)[:, :3, 3] / (2 * _SHIFT_S)

    # what the translations consist of ``[N, 3, 9]``, and the prior of each column's factor.
    true = relative[:, :3, 3]
    if not (np.linalg.norm(true, axis=1) > 0).any():
        return None
    columns = np.concatenate(
        [
            true[..., None],
            # by the lever arm
            relative[:, :3, :3] - np.eye(3),
            # by the turn of the axes
            -se3.hat(true),
            by_shift[..., None],
            -by_readout[..., None],
        ],
        axis=-1,
    )
    scaled = np.array([0.0, *[LEVER_SIGMA_M] * 3, *[TURN_SIGMA] * 3, SHIFT_SIGMA_S, 0.0])
    fixed = np.array([0.0] * 8 + [readout_sigma_s])
    return _regression(columns, still + readout_s * by_readout, scaled, fixed)


def translation_of(
    pair: RgbdPair,
    T_true: Array,
    rates: tuple[Array, Array],
    camera: Camera,
    readout_s: float,
    first_guess: float,
) -> Array:
    """Translation ``[3]`` from the first camera to the second, in metres of the depth images.

    A robust least-squares fit of the reprojection errors of all corners that were followed, not
    only of those on which most agree: these may lie on people. It begins at the true motion, and
    the rotation stays near the true one.

    Args:
        pair: The pair of frames.
        T_true: The true motion ``[4, 4]``.
        rates: The camera's turning rates ``[3]`` at both frames, rad/s in the camera's axes.
        camera: Its intrinsics.
        readout_s: Readout time that is taken into account.
        first_guess: Length of the translation at the beginning, as a multiple of the true one.
    """
    # Points in the first camera and pixels in the second, as at the time of the middle rows.
    points = camera.unproject(pair.pixels_first, pair.depth_first)
    points = _at_middle_row(points, pair.pixels_first, rates[0], camera, readout_s)
    rays = camera.unproject(pair.pixels_second, np.ones(len(pair.pixels_second)))
    pixels = camera.project(_at_middle_row(rays, pair.pixels_second, rates[1], camera, readout_s))
    focal = np.array([camera.fx, camera.fy])
    centre = (camera.cx, camera.cy)
    back = se3.inverse(T_true)
    R_true = back[:3, :3]
    R = R_true
    t = first_guess * back[:3, 3]
    for _ in range(_ROUNDS):
        turned = points @ R.T
        moved = turned + t
        z = np.maximum(moved[:, 2], _LEAST_Z_M)
        errors = moved[:, :2] / z[:, None] * focal + centre - pixels
        # the slopes of the pixels by the moved points, then by rotation and translation
        by_point = np.zeros((len(points), 2, 3))
        by_point[:, 0, 0] = camera.fx / z
        by_point[:, 1, 1] = camera.fy / z
        by_point[:, :, 2] = -moved[:, :2] * focal / z[:, None] ** 2
        slopes = np.concatenate([-by_point @ se3.hat(turned), by_point], axis=2)
        # robust weights by the median error
        size = np.linalg.norm(errors, axis=1)
        sigma = max(float(np.median(size)) / 1.18, _LEAST_PX)
        weight = 1 / (1 + (size / sigma / CAUCHY) ** 2) / sigma**2
        normal = np.einsum("nki,n,nkj->ij", slopes, weight, slopes)
        pull = np.einsum("nki,n,nk->i", slopes, weight, errors)
        # the rotation stays near the truth's
        normal[:3, :3] += np.eye(3) / ROTATION_SIGMA**2
        pull[:3] += se3.rotation_vectors((R @ R_true.T)[None])[0] / ROTATION_SIGMA**2
        step = -np.linalg.solve(normal, pull)
        R = _rotation(step[:3]) @ R
        t = t + step[3:]
        if np.abs(step).max() < 1e-6:
            break
    return np.asarray(-R.T @ t)


def _turning_rates(truth: TruthMotion, stamps: Array) -> Array:
    """The truth's turning rates ``[N, 3]`` at stamps ``[N]``, rad/s in the camera's axes."""
    return truth.between(stamps - _RATE_S, stamps + _RATE_S)[2] / (2 * _RATE_S)


def _at_middle_row(
    points: Array, pixels: Array, rate: Array, camera: Camera, readout_s: float
) -> Array:
    """Points ``[N, 3]`` in the camera at the time of its middle row, which it saw at the times of their rows.

    Args:
        points: In the camera at the times of their rows, metres.
        pixels: Their raw pixels ``[N, 2]``, which tell the rows.
        rate: Turning rate ``[3]`` of the camera, rad/s in its axes.
        camera: Its height.
        readout_s: Seconds from the first row to the last.
    """
    late = ((pixels[:, 1] + 0.5) / camera.height - 0.5) * readout_s
    return np.asarray(np.einsum("nij,nj->ni", _rotation(late[:, None] * rate), points))


def _rotation(turn: Array) -> Array:
    """Rotation matrices ``[..., 3, 3]`` of rotation vectors ``[..., 3]``."""
    return se3.exp(np.concatenate([np.zeros_like(turn), turn], axis=-1))[..., :3, :3]


def _regression(columns: Array, measured: Array, scaled: Array, fixed: Array) -> DepthScale | None:
    """Robust least squares of translations ``[N, 3]`` by columns ``[N, 3, K]``, of which the first is the scale's.

    The interval comes from a jackknife over blocks of successive pairs.

    Args:
        columns: What the translations consist of.
        measured: The translations.
        scaled: Standard deviations ``[K]`` about 0 of the other columns' factors, as multiples of
            the scale.
        fixed: Standard deviations that do not depend on the scale; 0 in both: no bound.
    """
    # a first guess by the lengths
    lengths = np.linalg.norm(measured, axis=1)
    scale = float(np.median(lengths) / np.median(np.linalg.norm(columns[..., 0], axis=1)))
    sigma = float(np.median(lengths)) / 2
    weight = np.ones(len(measured))
    if not (np.isfinite(scale) and sigma > 0):
        return None

    # reweighted least squares, by normal equations of each pair, with priors that grow with the scale.
    for _ in range(_ROUNDS):
        deviation = np.maximum(scaled * scale, fixed)
        prior = np.diag(np.where(deviation > 0, 1 / np.maximum(deviation, 1e-12) ** 2, 0.0))
        normals = np.einsum("nki,n,nkj->nij", columns, weight, columns) / sigma**2
        pulls = np.einsum("nki,n,nk->ni", columns, weight, measured) / sigma**2
        factors = np.linalg.solve(normals.sum(axis=0) + prior, pulls.sum(axis=0))
        scale = max(float(factors[0]), 1e-3)
        residual = np.linalg.norm(measured - columns @ factors, axis=1)
        # 1.54: median length of a normal vector in space
        sigma = max(float(np.median(residual)) / 1.54, 1e-4)
        weight = 1 / (1 + (residual / sigma / CAUCHY) ** 2)

    # the variance: by a jackknife over blocks, and what the bounds leave open.
    blocks = np.arange(len(measured)) // BLOCK
    count = int(blocks[-1]) + 1
    scales = []
    for block in range(count):
        kept = blocks != block
        without_block = np.linalg.solve(normals[kept].sum(axis=0) + prior, pulls[kept].sum(axis=0))
        scales.append(float(without_block[0]))
    without = np.array(scales)
    jackknife = (count - 1) / count * float(((without - without.mean()) ** 2).sum())
    inverse = np.linalg.inv(normals.sum(axis=0) + prior)
    left_open = float((inverse @ prior @ inverse)[0, 0])
    variance = max(jackknife + left_open, float(inverse[0, 0]))

    # half of the 95 % interval, with what all pairs share.
    value = float(factors[0])
    statistical = student.ppf(0.975, count - 1) * np.sqrt(variance)
    half = float(np.hypot(statistical, 1.96 * SYSTEMATIC * factors[0]))
    return DepthScale(value, max(value - half, 0.0), max(value + half, 0.0))
