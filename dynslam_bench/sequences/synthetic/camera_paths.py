"""Paths of the rendered sequences' cameras: held in the hand before a desk, or carried along a walk.

World frame: z up, the camera starts near the origin's plumb line at 1.35 m and looks along +y at
the desk. Positions are sums of smooth functions of time, so that every pose is exact at any time.
"""

import math
from dataclasses import dataclass

import numpy as np

from dynslam_bench.core.seeding import stream
from dynslam_bench.geometry import se3
from dynslam_bench.sequences.synthetic.arithmetic import Array, arctan2, cos, norm, product, sin

# The camera's motions, after the descriptions of TUM's fr3 sequences, at their tempo.
#
# * xyz: along the camera's three axes, one after the other, 0.25 m to each side;
# * static: held in place by hand;
# * halfsphere: over a half sphere of about 1 m diameter, always towards the desk;
# * rpy: rotations about the three principal axes, one after the other.

MOTIONS = ("xyz", "static", "halfsphere", "rpy")
"""Names of the motions, those of TUM's fr3 sequences."""
EYE_HEIGHT_M = 1.35
"""Height of the camera at rest."""
TILT_RAD = math.radians(10.0)
"""Angle by which the camera looks down, radians."""
_XYZ_M = (0.25, 0.2, 0.25)
"""Amplitudes of `xyz` to the right, down and forward."""
_XYZ_PERIOD_S = 4.6
_RPY_RAD = np.radians([14.0, 19.0, 20.0])
"""Amplitudes of `rpy` about the axes to the right (pitch), down (yaw) and forward (roll)."""
_RPY_PERIOD_S = 3.6


def camera_poses(motion: str, people: str, scene: int, times: Array) -> Array:
    """Camera-to-world poses ``[N, 4, 4]`` at `times` (seconds from the start)."""
    rng = stream(scene, "synthetic", "camera", people, motion)
    # TUM's sitting_xyz is slower.
    tempo = 0.72 if people == "sitting" and motion == "xyz" else 1.0
    t = np.asarray(times, dtype=np.float64)
    # along the camera's rest axes: right, down, forward
    offset = np.zeros((len(t), 3))
    # about right (pitch), down (yaw), forward (roll)
    angles = np.zeros((len(t), 3))
    order = rng.permutation(3)
    signs = np.where(rng.random(3) < 0.5, -1.0, 1.0)
    if motion == "xyz":
        for slot, axis in enumerate(order):
            amplitude = signs[axis] * _XYZ_M[axis]
            offset[:, axis] = amplitude * _swing_in_slot(t, _XYZ_PERIOD_S / tempo, slot)
    elif motion == "rpy":
        for slot, axis in enumerate(order):
            amplitude = signs[axis] * _RPY_RAD[axis]
            angles[:, axis] = amplitude * _swing_in_slot(t, _RPY_PERIOD_S / tempo, slot)
    elif motion == "halfsphere":
        offset, angles = _halfsphere(t, tempo, signs[0])
    # The hand's jitter, then from the axes at rest to the world.
    offset += hand(rng, t, 0.004, 3)
    angles += hand(rng, t, math.radians(0.5), 3)
    base = camera_axes(TILT_RAD)
    place = product(offset, base.T) + np.array([0.0, 0.0, EYE_HEIGHT_M])
    return se3.from_matrix(place, product(base, rotations(angles)))


def _halfsphere(t: Array, tempo: float, sign: float) -> tuple[Array, Array]:
    """Offsets and angles ``[N, 3]`` of a path over a half sphere, on which the camera looks at its middle.

    Args:
        t: Seconds from the start ``[N]``.
        tempo: Relative speed.
        sign: To which side it begins.
    """
    offset = np.zeros((len(t), 3))
    angles = np.zeros((len(t), 3))
    # once around in 6.1 s, while the path rises and falls in 16.9 s; lengths in metres
    around = 2 * math.pi * t / (6.1 / tempo)
    lift = 0.5 - 0.5 * cos(2 * math.pi * t / (16.9 / tempo) + 0.4)
    radius = 0.36
    # of what it looks at
    distance = 0.9
    offset[:, 0] = sign * radius * sin(around)
    offset[:, 1] = -radius * (0.85 * lift - 0.12) * cos(around * 0.5 + 0.3)
    offset[:, 2] = -0.1 + 0.2 * cos(around) * (0.4 + 0.6 * lift)
    # turn towards what it looks at, nearly all the way, and roll
    angles[:, 1] = -0.9 * arctan2(offset[:, 0], distance - offset[:, 2])
    angles[:, 0] = 0.9 * arctan2(offset[:, 1], distance - offset[:, 2])
    angles[:, 2] = 0.2 * sin(around * 0.77 + 1.0)
    return offset, angles


def camera_axes(tilt: float) -> Array:
    """Camera to world, 3x3, of a camera that looks along +y and `tilt` radians down."""
    rest = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
    return np.asarray(product(rest, rotations(np.array([[-tilt, 0.0, 0.0]]))[0]))


def _swing_in_slot(t: Array, period: float, slot: int) -> Array:
    """One sine of `period` in this one of three slots, zero in the others, with no jump in position or speed."""
    # share of the slot that has passed
    local = (t / period) % 3 - slot
    inside = (local >= 0) & (local < 1)
    x = np.clip(local, 0, 1)
    # The phase runs through x - sin(4 pi x) / (4 pi) * 0.5: slower at the start and the end of the
    # slot.
    eased = x - sin(2 * math.pi * x) / (2 * math.pi) * 0.6
    # faded in and out over a tenth of the slot
    window = np.minimum(1.0, np.minimum(x, 1 - x) / 0.1)
    window = window * window * (3 - 2 * window)
    return np.where(inside, sin(2 * math.pi * eased) * window, 0.0)


def hand(rng: np.random.Generator, t: Array, amplitude: float, axes: int) -> Array:
    """Handheld jitter: sines from 0.2 to 4 Hz whose amplitude falls with the frequency.

    Args:
        rng: Draws frequencies and phases.
        t: Seconds ``[N]``.
        amplitude: Amplitude of the slowest sine, in the unit of the result.
        axes: Number of axes.
    """
    total = np.zeros((len(t), axes))
    for frequency in (0.23, 0.51, 0.97, 1.7, 2.6, 3.9):
        # each axis has a frequency and a phase of its own
        f = frequency * (0.85 + 0.3 * rng.random(axes))
        turns = f * t[:, None] + rng.random(axes)
        total += amplitude * (0.5 / (0.4 + f)) * sin(2 * math.pi * turns)
    return total


def rotations(vectors: Array) -> Array:
    """Rotation matrices ``[N, 3, 3]`` of rotation vectors ``[N, 3]`` (Rodrigues)."""
    # angles and unit axes
    theta = norm(vectors)
    k = vectors / np.where(theta < 1e-12, 1.0, theta)[:, None]
    # Cross-product matrices of the axes.
    x = k[:, 0]
    y = k[:, 1]
    z = k[:, 2]
    zero = np.zeros(len(k))
    hat = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], 1).reshape(-1, 3, 3)
    # R = I + sin(theta) [k] + (1 - cos(theta)) [k]^2
    s = sin(theta)[:, None, None]
    c = (1 - cos(theta))[:, None, None]
    return np.asarray(np.eye(3) + s * hat + c * (product(hat, hat)))


# Long paths of a hand-held camera: closed loops along way points, at walking pace, exact at any
# time.

_STEP_M = 0.4
"""Distance of the spline's control points."""


@dataclass(frozen=True)
class Walk:
    """A closed walk, lap after lap.

    Its ground plan is the uniform cubic B-spline on points that stand `_STEP_M` apart along a
    polygon: it cuts corners and slows down there, and has continuous speed and acceleration.

    Attributes:
        control: Control points ``[N, 2]``, metres.
        lap_s: Seconds a lap.
    """

    control: Array
    lap_s: float

    def at(self, times: Array) -> Array:
        """Places ``[N, 2]`` at times (seconds)."""
        # place in control points, its whole and its fractional part
        s = np.asarray(times, dtype=np.float64) * (len(self.control) / self.lap_s)
        i = np.floor(s).astype(np.int64)
        f = (s - i)[:, None]
        g = 1 - f
        n = len(self.control)
        p0, p1, p2, p3 = (self.control[(i + k) % n] for k in (-1, 0, 1, 2))
        # the cubic B-spline's basis at the four control points around it
        return np.asarray(
            g * g * g / 6 * p0
            + (3 * f * f * f - 6 * f * f + 4) / 6 * p1
            + (-3 * f * f * f + 3 * f * f + 3 * f + 1) / 6 * p2
            + f * f * f / 6 * p3
        )

    def time_nearest(self, place: tuple[float, float]) -> float:
        """When, in the first lap, the walk is nearest to a place."""
        times = np.linspace(0.0, self.lap_s, 4 * len(self.control), endpoint=False)
        return float(times[norm(self.at(times) - place).argmin()])


def walk_along(corners: list[tuple[float, float]], speed: float) -> Walk:
    """The closed walk around a polygon, at `speed` m/s where it is straight."""
    ends = np.array([*corners, corners[0]], dtype=np.float64)
    # Path length at each corner, and at control points an even distance apart.
    lengths = np.concatenate([[0.0], np.cumsum(norm(np.diff(ends, axis=0)))])
    n = round(lengths[-1] / _STEP_M)
    s = np.arange(n) * lengths[-1] / n
    control = np.stack([np.interp(s, lengths, ends[:, k]) for k in range(2)], axis=1)
    return Walk(control, float(lengths[-1]) / speed)


def walking_camera(walk: Walk, scene: int, name: str, aside_deg: float, times: Array) -> Array:
    """Poses ``[N, 4, 4]`` of a camera that is carried along a walk.

    Args:
        walk: The path.
        scene: Seeds the hand's jitter and how each lap strays from the others.
        name: Names that seed.
        aside_deg: How far the camera looks to the left of its direction of motion; it looks around
            by 12 degrees more.
        times: Seconds from the start.
    """
    rng = stream(scene, "synthetic", "walk", name)
    t = np.asarray(times, dtype=np.float64)
    # Where the walk goes, how the lap strays from it, and the bobbing of each step.
    step_s = walk.lap_s / len(walk.control)
    ahead = walk.at(t + 2.3 * step_s) - walk.at(t - 0.8 * step_s)
    stray = 0.12 * _slow(rng, t, 2)
    steps = 0.012 * sin(2 * math.pi * 1.7 * t)[:, None] * np.array([0.0, 0.0, 1.0])
    # Look aside of it, and around.
    heading = arctan2(ahead[:, 1], ahead[:, 0]) + math.radians(aside_deg)
    heading = heading + math.radians(12.0) * _slow(rng, t, 1)[:, 0]
    turned = np.zeros((len(t), 3))
    # about the world's z axis; the camera at rest looks along +y
    turned[:, 2] = heading - math.pi / 2
    shake = rotations(hand(rng, t, math.radians(0.7), 3))
    rotation = product(rotations(turned), camera_axes(TILT_RAD), shake)
    place = np.column_stack([walk.at(t) + stray, np.full(len(t), EYE_HEIGHT_M)])
    return se3.from_matrix(place + (steps + hand(rng, t, 0.006, 3)), rotation)


def _slow(rng: np.random.Generator, t: Array, axes: int) -> Array:
    """Smooth wandering within about [-1, 1] that does not repeat from lap to lap."""
    total = np.zeros((len(t), axes))
    for period in (17.3, 7.1):
        turns = t[:, None] / (period * (0.9 + 0.2 * rng.random(axes))) + rng.random(axes)
        total += 0.5 * sin(2 * math.pi * turns)
    return total
