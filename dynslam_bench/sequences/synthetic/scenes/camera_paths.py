"""The camera's motions, after the descriptions of TUM's fr3 sequences, at their tempo.

World frame: z up, the camera starts near the origin's plumb line at 1.35 m and looks along +y at the desk. Positions
are sums of smooth functions of time, so that every pose is exact at any time.

* xyz: along the camera's three axes, one after the other, 0.25 m to each side;
* static: held in place by hand;
* halfsphere: over a half sphere of about 1 m diameter, always towards the desk;
* rpy: rotations about the three principal axes, one after the other.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.core.seeding import stream

from ..arithmetic import arctan2, cos, norm, product, sin

Array = NDArray[np.float64]

MOTIONS = ("xyz", "static", "halfsphere", "rpy")
EYE_HEIGHT_M = 1.35
TILT_RAD = math.radians(10.0)


def camera_poses(motion: str, people: str, instance: int, times: Array) -> Array:
    """Camera-to-world poses ``[N, 4, 4]`` at `times` (seconds from the start)."""
    rng = stream(instance, "synthetic", "camera", people, motion)
    tempo = 0.72 if people == "sitting" and motion == "xyz" else 1.0
    t = np.asarray(times, dtype=np.float64)
    offset = np.zeros((len(t), 3))  # along the camera's rest axes: right, down, forward
    angles = np.zeros((len(t), 3))  # about right (pitch), down (yaw), forward (roll)
    phase = rng.permutation(3)
    signs = np.where(rng.random(3) < 0.5, -1.0, 1.0)
    if motion == "xyz":
        period = 4.6 / tempo
        for slot, axis in enumerate(phase):
            amplitude = (0.25, 0.2, 0.25)[axis]
            offset[:, axis] = signs[axis] * amplitude * _turns(t, period, 3, slot)
    elif motion == "rpy":
        period = 3.6 / tempo
        amplitudes = np.radians([14.0, 19.0, 20.0])
        for slot, axis in enumerate(phase):
            angles[:, axis] = signs[axis] * amplitudes[axis] * _turns(t, period, 3, slot)
    elif motion == "halfsphere":
        around = 2 * math.pi * t / (6.1 / tempo)
        lift = 0.5 - 0.5 * cos(2 * math.pi * t / (16.9 / tempo) + 0.4)
        radius, distance = 0.36, 0.9
        offset[:, 0] = signs[0] * radius * sin(around)
        offset[:, 1] = -radius * (0.85 * lift - 0.12) * cos(around * 0.5 + 0.3)
        offset[:, 2] = -0.1 + 0.2 * cos(around) * (0.4 + 0.6 * lift)
        angles[:, 1] = -0.9 * arctan2(offset[:, 0], distance - offset[:, 2])
        angles[:, 0] = 0.9 * arctan2(offset[:, 1], distance - offset[:, 2])
        angles[:, 2] = 0.2 * sin(around * 0.77 + 1.0)
    offset += hand(rng, t, 0.004, 3)
    angles += hand(rng, t, math.radians(0.5), 3)
    base = camera_axes(TILT_RAD)
    poses = np.tile(np.eye(4), (len(t), 1, 1))
    poses[:, :3, :3] = product(base, rotations(angles))
    poses[:, :3, 3] = product(offset, base.T) + np.array([0.0, 0.0, EYE_HEIGHT_M])
    return poses


def camera_axes(tilt: float) -> Array:
    """Camera to world, 3x3, of a camera that looks along +y and `tilt` radians down."""
    rest = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
    return np.asarray(product(rest, rotations(np.array([[-tilt, 0.0, 0.0]]))[0]))


def _turns(t: Array, period: float, slots: int, slot: int) -> Array:
    """One sine of `period` during this slot of every `slots`, zero in the others, with no jump in position or speed."""
    local = (t / period) % slots - slot
    inside = (local >= 0) & (local < 1)
    x = np.clip(local, 0, 1)
    # The phase runs through x - sin(4 pi x) / (4 pi) * 0.5: slower at the start and the end of the slot.
    eased = x - sin(2 * math.pi * x) / (2 * math.pi) * 0.6
    window = np.minimum(1.0, np.minimum(x, 1 - x) / 0.1)
    window = window * window * (3 - 2 * window)
    return np.where(inside, sin(2 * math.pi * eased) * window, 0.0)


def hand(rng: np.random.Generator, t: Array, amplitude: float, axes: int) -> Array:
    """Handheld jitter: sines from 0.2 to 4 Hz whose amplitude falls with the frequency."""
    total = np.zeros((len(t), axes))
    for frequency in (0.23, 0.51, 0.97, 1.7, 2.6, 3.9):
        f = frequency * (0.85 + 0.3 * rng.random(axes))
        total += amplitude * (0.5 / (0.4 + f)) * sin(2 * math.pi * (f * t[:, None] + rng.random(axes)))
    return total


def rotations(vectors: Array) -> Array:
    """Rotation matrices ``[N, 3, 3]`` of rotation vectors ``[N, 3]`` (Rodrigues)."""
    theta = norm(vectors)
    safe = np.where(theta < 1e-12, 1.0, theta)
    k = vectors / safe[:, None]
    zero = np.zeros(len(k))
    hat = np.stack([zero, -k[:, 2], k[:, 1], k[:, 2], zero, -k[:, 0], -k[:, 1], k[:, 0], zero], 1).reshape(-1, 3, 3)
    s, c = sin(theta)[:, None, None], (1 - cos(theta))[:, None, None]
    return np.asarray(np.eye(3) + s * hat + c * (product(hat, hat)))
