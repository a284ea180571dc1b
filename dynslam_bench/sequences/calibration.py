"""Calibration of an RGB-D camera from a recording: readout time, delay of depth, depth factor.

Keypoints are tracked through windows of consecutive frames, and each window is adjusted as a bundle
whose camera moves continuously. Every pixel belongs to the pose at its row's time, every depth to
the pose at its image's time. This is after Kerl, Stueckler and Cremers (Dense Continuous-Time
Tracking and Mapping with Rolling Shutter RGB-D Cameras, ICCV 2015), with points in place of their
dense images. The readout time and the delay of the depth images are unknowns that all windows
share. They show where the camera's velocity changes: under a constant velocity each row is late in
all frames alike.

The ground truth serves for the depth factor alone.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.stats import t as student

from dynslam_bench.contracts import Sequence
from dynslam_bench.core import SequenceError, translate_errors
from dynslam_bench.geometry import Array, Camera, Trajectory
from dynslam_bench.sequences.window_adjustment import (
    LEAST_POINTS,
    ReducedEquations,
    Unusable,
    Window,
    corners,
    track,
)

WINDOW_FRAMES = 16
"""Frames of a window, half of which the next one shares: 0.5 s at 30 Hz, in which a hand changes the velocity."""
LEAST_WINDOW_FRAMES = 8
"""Frames of a window of a short recording, at least."""
LEAST_WINDOWS = 3
"""Windows that have to be usable."""
MOST_WINDOWS = 12
"""Windows that are used."""
CANDIDATES = 64
"""So many windows of a long recording are looked at; the `MOST_WINDOWS` whose velocity changes most are used."""
JITTER = 0.25
"""Share of the frame interval by which stamps may be off that were given after the exposure (as TUM's are)."""
SMALLEST_DELAY_S = 0.005
"""A smaller delay changes hardly any pair of images."""
LARGEST_DELAY_S = 0.1
"""A larger delay is not looked for."""
DELAYS_TRIED = 21
"""Delays of the grid from which the adjustment starts."""
ROUNDS = 12
"""Gauss-Newton steps of all windows together, at most."""
ROUGH_ROUNDS = 4
"""In the first of these steps the noise is measured again."""
LARGEST_STEP_S = 0.02
"""A step changes readout time and delay by no more."""
CONVERGED_S = 1e-5
"""The adjustment ends with a smaller step."""
RESOLVED_S = 0.004
"""Half the interval of an observable time is at most this, or `RESOLVED_SHARE` of the value."""
RESOLVED_SHARE = 0.25
"""See `RESOLVED_S`."""
RESOLVED_FACTOR = 0.05
"""Half the interval of the depth factor must be at most this share of the value."""
LARGEST_TRUTH_GAP_S = 0.1
"""A window with a wider gap between true poses is not compared with them."""
SYSTEMATIC_S = 0.001
"""Standard deviation of what all windows share: intrinsics, depth errors, the sub-pixel error of tracking.

Windows of 10 to 25 frames give 23.4 to 27.3 ms on the excerpt of fr1_xyz.
"""
SYSTEMATIC_FACTOR = 0.012
"""Relative standard deviation of lengths that all windows share.

1.5 % are missing where depth is noisy (`fast_desk`).
"""


@dataclass(frozen=True)
class Quantity:
    """One calibrated quantity.

    Attributes:
        name: Field of a ``camera.toml``: `readout_s`, `depth_delay_s` or `depth_factor`.
        value: The estimate, in seconds or raw depth units a metre; None where there is none.
        low: Lower end of the 95 % interval.
        high: Its upper end.
        written: What a ``camera.toml`` should state; None to leave it as it is.
        observable: False where the recording does not determine the quantity.
        reason: What that rests on, one phrase.
    """

    name: str
    value: float | None = None
    low: float | None = None
    high: float | None = None
    written: float | None = None
    observable: bool = False
    reason: str = ""


@dataclass(frozen=True, eq=False)
class Calibration:
    """The result of calibrating a recording.

    Attributes:
        camera: The recording's camera with the measured values in place of its own.
        quantities: Readout time, delay of depth, depth factor.
        windows: How many windows were used.
        frames: Frames of one window.
        pixel_noise: Standard deviation of a keypoint's place in pixels, median of the windows.
    """

    camera: Camera
    quantities: tuple[Quantity, ...]
    windows: int
    frames: int
    pixel_noise: float

    @property
    def measured(self) -> bool:
        """Whether anything is to be written."""
        return any(quantity.written is not None for quantity in self.quantities)


def calibrate(
    sequence: Sequence, *, progress: Callable[[int, int], None] = lambda done, total: None
) -> Calibration:
    """Measure the readout time of the colour camera, the delay of its depth images, and the depth factor.

    The readout time and the delay use images and stamps alone. The depth factor is compared with
    the ground truth, if there is one. Of a long recording those stretches are used in which the
    image's velocity changes most.

    Args:
        sequence: A recording with colour and depth images; its camera's intrinsics have to be
            right.
        progress: Called with (windows done, windows in all).

    Returns:
        Estimates with 95 % intervals over windows, and what is to be written of each.

    Raises:
        SequenceError: There is no depth, there are too few frames, or too few windows have points
            that can be tracked.
    """
    # depth, and frames enough for two windows
    if not getattr(sequence, "has_depth", True):
        raise SequenceError(
            f"{sequence.id} has no depth images", "calibration needs depth beside colour"
        )
    frames = len(sequence)
    length = int(np.clip(2 * frames // 5, LEAST_WINDOW_FRAMES, WINDOW_FRAMES))
    if frames < 2 * length:
        raise SequenceError(
            f"{sequence.id} has {frames} frame{'s' * (frames != 1)}, calibration needs {2 * LEAST_WINDOW_FRAMES}",
            "record some seconds of a textured scene with a camera that is turned to and fro",
        )

    # track keypoints through windows, and estimate what all windows share.
    windows = _read_windows(sequence, length, progress)
    with translate_errors(
        SequenceError,
        f"the windows of {sequence.id} cannot be adjusted",
        "try another part",
        of=np.linalg.LinAlgError,
    ):
        readout, delay = adjust(windows)

    # what each estimate means for the camera's file
    camera = sequence.camera
    quantities = (
        _readout_quantity(readout, windows, camera),
        _delay_quantity(delay, camera),
        _factor_quantity(windows, sequence),
    )
    written: dict[str, Any] = {
        quantity.name: quantity.written for quantity in quantities if quantity.written is not None
    }
    noise = float(np.median([window.noise[0] for window in windows]))
    return Calibration(replace(camera, **written), quantities, len(windows), length, noise)


# Windows of a recording.


def _read_windows(
    sequence: Sequence, length: int, progress: Callable[[int, int], None]
) -> list[Window]:
    """The usable windows of those that `_choose` names, `LEAST_WINDOWS` at least."""
    # each window, or why it cannot be used
    starts = _choose(sequence, length)
    windows = []
    faults = []
    for done, first in enumerate(starts):
        try:
            windows.append(window_of(sequence, first, length))
        except Unusable as fault:
            faults.append(str(fault))
        progress(done + 1, len(starts))

    # too few: the most frequent reason
    if len(windows) < LEAST_WINDOWS:
        common = max(set(faults), key=faults.count)
        raise SequenceError(
            f"{len(windows)} of {len(starts)} windows of {sequence.id} can be used, expected {LEAST_WINDOWS}: {common}",
            "record a well-lit, textured, static scene within the depth camera's reach",
        )
    return windows


def window_of(sequence: Sequence, first: int, length: int) -> Window:
    """The window of `length` frames from frame `first` on.

    Raises:
        Unusable: See `Window`.
    """
    frames = [sequence[i] for i in range(first, first + length)]
    stamps, offsets = _stamps(sequence, first, length)
    if np.diff(stamps).max() > 2.5 * np.median(np.diff(stamps)):
        raise Unusable("frames are missing")
    if not any(frame.depth.any() for frame in frames):
        raise Unusable("the depth images are empty")

    # corners are detected where depth is known all around, and tracked through the grey images.
    around = np.ones((9, 9))
    masks = []
    images = []
    for frame in frames:
        masks.append(np.asarray(cv2.erode((frame.depth > 0).astype(np.uint8), around), np.uint8))
        images.append(np.asarray(cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2GRAY), np.uint8))
    pixels = track(images, masks)
    if len(pixels) < LEAST_POINTS:
        raise Unusable("too few points can be followed")
    depth = np.stack([frame.depth for frame in frames])
    return Window(sequence.camera, stamps, pixels, depth, offsets)


def _stamps(sequence: Sequence, first: int, length: int) -> tuple[Array, Array]:
    """Stamps ``[length]`` of the colour images, and by how much the depth images' are later."""
    # 25 frames to either side tell the camera's ticks.
    part = slice(max(first - 25, 0), first + length + 25)
    inside = slice(first - part.start, first - part.start + length)
    stamps = np.asarray(sequence.timestamps, dtype=np.float64)[part]
    colour = _regular(stamps)[inside]
    depth_stamps = getattr(sequence, "depth_timestamps", None)
    if depth_stamps is None:
        return colour, np.zeros(length)
    depth = _regular(np.asarray(depth_stamps)[part])[inside]
    return colour, depth - colour


def _regular(stamps: Array) -> Array:
    """Evenly spaced stamps where a camera's even ticks explain them; a stamp is given some time after the exposure."""
    # whole numbers of the usual interval between the stamps
    gaps = np.diff(stamps)
    interval = np.median(gaps)
    ticks = np.maximum(np.round(gaps / interval), 1)
    if np.abs(gaps - ticks * interval).max() > JITTER * interval:
        return stamps

    # a line through the stamps over these numbers
    count = np.concatenate([[0.0], np.cumsum(ticks)])
    line = np.polyfit(count, stamps - stamps[0], 1)
    return np.asarray(np.polyval(line, count) + stamps[0])


def _choose(sequence: Sequence, length: int) -> list[int]:
    """First frames of the windows to use: all of a short recording, those of most change of velocity of a long one."""
    starts = list(range(0, len(sequence) - length + 1, length // 2))
    if len(starts) <= MOST_WINDOWS:
        return starts

    # of some windows spread over the recording those of most change
    candidates = np.linspace(0, len(starts) - 1, min(len(starts), CANDIDATES))
    spread = candidates.round().astype(int).tolist()
    changes = [_velocity_change(sequence, starts[i], starts[i] + length - 2) for i in spread]
    most = np.argsort(changes)[::-1][:MOST_WINDOWS]
    return sorted(starts[spread[i]] for i in most)


def _velocity_change(sequence: Sequence, first: int, last: int) -> float:
    """Pixels a frame by which the image's velocity changes between two frames; 0 where few corners are followed."""
    velocities = []
    for i in (first, last):
        # corners of the frame
        image = _half_size_grey(sequence, i)
        next_image = _half_size_grey(sequence, i + 1)
        start = corners(image, np.ones(image.shape, np.uint8), np.zeros((0, 2)), 40)
        if len(start) < LEAST_POINTS:
            return 0.0

        # their median motion to the next frame
        end, status, _ = cv2.calcOpticalFlowPyrLK(
            image, next_image, start, start.copy(), winSize=(21, 21), maxLevel=3
        )
        good = status[:, 0] > 0
        if good.sum() < LEAST_POINTS:
            return 0.0
        velocities.append(np.median(end[good] - start[good], axis=0))
    return float(np.linalg.norm(velocities[1] - velocities[0]))


def _half_size_grey(sequence: Sequence, index: int) -> NDArray[np.uint8]:
    """A frame's brightness at half the resolution."""
    grey = cv2.cvtColor(sequence[index].rgb, cv2.COLOR_RGB2GRAY)
    return np.asarray(cv2.resize(grey, None, fx=0.5, fy=0.5), np.uint8)


# Estimates that all windows share.


@dataclass(frozen=True)
class CalibrationEstimate:
    """A value with its 95 % interval over windows.

    Attributes:
        value: Seconds, or the factor of a length.
        half: Half the interval, in the value's unit.
    """

    value: float
    half: float

    @property
    def resolved(self) -> bool:
        """Whether a time in seconds is determined well enough to be used."""
        return self.half <= max(RESOLVED_S, RESOLVED_SHARE * abs(self.value))


def adjust(windows: list[Window]) -> tuple[CalibrationEstimate, CalibrationEstimate]:
    """Adjust all windows together with the readout time and the delay of depth that they share.

    Args:
        windows: At least two; they are left as adjusted.

    Returns:
        Readout time and delay in seconds.
    """
    # start from a global shutter and the delay of a grid at which the depths fit best.
    shared = np.array([0.0, _coarse_delay(windows)])
    for turn in range(ROUNDS):
        # linearise every window about the shared values.
        equations: list[ReducedEquations] = []
        for window in windows:
            window.move_depth(*shared)
            if turn < ROUGH_ROUNDS:
                window.measure_noise(shared[0])
            equations.append(window.normal_equations(shared[0]))
        information = np.array([equation.information for equation in equations])
        slopes = np.array([equation.slope for equation in equations])

        # one Gauss-Newton step of the shared values, then of each window's poses and points.
        solution = np.linalg.lstsq(information.sum(0), slopes.sum(0), rcond=None)[0]
        step = np.clip(-solution, -LARGEST_STEP_S, LARGEST_STEP_S)
        for window, equation in zip(windows, equations, strict=True):
            window.update(*equation.steps(step))
        shared = shared + step
        if turn >= ROUGH_ROUNDS and np.abs(step).max() < CONVERGED_S:
            break

    # the value that each window alone would give, and its information, for the interval.
    slopes = slopes + information @ step
    own_information = np.maximum(np.diagonal(information, axis1=1, axis2=2), 1e-12)
    values = shared - slopes / own_information
    readout = _over_windows(windows, values[:, 0], own_information[:, 0])
    delay = _over_windows(windows, values[:, 1], own_information[:, 1])
    return readout, delay


def _coarse_delay(windows: list[Window]) -> float:
    """The delay in seconds of a grid at which the mean robust cost of a depth is least."""
    # mean cost of a depth, of all windows together
    grid: list[float] = np.linspace(-LARGEST_DELAY_S, LARGEST_DELAY_S, DELAYS_TRIED).tolist()
    means = []
    for delay in grid:
        cost, count = np.sum([window.depth_cost(delay) for window in windows], axis=0)
        means.append(cost / max(count, 1))
    return grid[int(np.argmin(means))]


def _over_windows(
    windows: list[Window], values: Array, information: Array, systematic: float = SYSTEMATIC_S
) -> CalibrationEstimate:
    """Mean of the windows' values, each with its own and the windows' common variance, and half the 95 % interval.

    A random-effects mean (DerSimonian and Laird, 1986) with the interval of Hartung and Knapp
    (2001), not less than that of the fixed effects. Windows that share frames count as fewer.
    """
    k = len(values)
    # fixed effects, and by how much the windows scatter more than these say (Cochran's Q).
    mean = float((values * information).sum() / information.sum())
    q = float((information * (values - mean) ** 2).sum())
    spare = information.sum() - (information**2).sum() / information.sum()
    between = max(0.0, (q - (k - 1)) / max(spare, 1e-12))

    # mean of the windows, weighted by the variance within and between them (random effects)
    weights = 1 / (1 / np.maximum(information, 1e-12) + between)
    mean = float((values * weights).sum() / weights.sum())
    scatter = float((weights * (values - mean) ** 2).sum() / ((k - 1) * weights.sum()))

    # windows that overlap the next one, and the interval
    starts = np.array([window.start for window in windows])
    length = float(np.median([np.ptp(window.stamps) for window in windows]))
    overlapping = float((np.diff(starts) < length).mean())
    variance = max(scatter, float(1 / weights.sum())) * (1 + overlapping)
    statistical = student.ppf(0.975, k - 1) * np.sqrt(variance)
    return CalibrationEstimate(mean, float(np.hypot(statistical, 1.96 * systematic)))


# What an estimate means for the camera's file.


def _readout_quantity(
    estimate: CalibrationEstimate, windows: list[Window], camera: Camera
) -> Quantity:
    """The readout time; what is written is never longer than the time between two frames."""
    interval_s = float(np.median([np.median(np.diff(window.stamps)) for window in windows]))
    longest = np.floor(1e4 * interval_s) / 1e4
    value = estimate.value
    low = estimate.value - estimate.half
    high = estimate.value + estimate.half
    stated = camera.readout_s
    quantity = Quantity("readout_s", value, low, high)
    frame = f"{1e3 * interval_s:.0f} ms, a frame's interval"

    # Not observable; a stated value that cannot be right is removed.
    impossible = high < 0 or low > interval_s or value > interval_s + RESOLVED_S
    if impossible or not estimate.resolved:
        if estimate.resolved:
            reason = f"outside of 0 to {frame}: check the stamps"
        else:
            reason = _too_wide(estimate, _slow_turning(windows))
        if stated > interval_s:
            more = f"the camera's {1e3 * stated:g} ms are more than {frame}, and 0 stands for not known"
            return replace(quantity, written=0.0, reason=f"{reason}; {more}")
        return replace(quantity, reason=reason)

    # A global shutter.
    quantity = replace(quantity, observable=True)
    if low <= 0:
        written = 0.0 if stated > min(high, interval_s) else None
        reason = "the interval contains 0: a global shutter, or as good as one"
        return replace(quantity, written=written, reason=reason)

    # A rolling shutter, as stated or not.
    if low <= stated <= min(high, interval_s):
        return replace(quantity, reason=f"agrees with the camera's {1e3 * stated:g} ms")
    reason = "a rolling shutter" if value <= interval_s else f"a rolling shutter, at most {frame}"
    return replace(quantity, written=min(round(value, 4), float(longest)), reason=reason)


def _slow_turning(windows: list[Window]) -> str:
    """The median change of the turning rate, as the reason why a readout time is not determined."""
    change = float(np.median([window.turning_change() for window in windows]))
    return f"the turning rate changes by {change:.2f} rad/s within a window; turn the camera to and fro faster"


def _delay_quantity(estimate: CalibrationEstimate, camera: Camera) -> Quantity:
    """The delay of the depth images; the stamps that the reader gives have the camera's own delay added already."""
    value = estimate.value
    half = estimate.half
    own = camera.depth_delay_s
    interval = (own + value, own + (value - half), own + (value + half))
    quantity = Quantity("depth_delay_s", *interval)
    if not estimate.resolved:
        return replace(quantity, reason=_too_wide(estimate, "too slow a motion"))
    if abs(value) > LARGEST_DELAY_S:
        beyond = f"beyond +- {1e3 * LARGEST_DELAY_S:g} ms: do colour and depth use the same clock?"
        return replace(quantity, reason=beyond)
    quantity = replace(quantity, observable=True)
    if value - half <= 0 <= value + half or abs(value) < SMALLEST_DELAY_S:
        reason = "colour and depth are exposed as their stamps say, to a sixth of a frame"
        return replace(quantity, reason=reason)
    side = "later" if value > 0 else "earlier"
    reason = f"depth is exposed {side} than its stamps say"
    return replace(quantity, written=round(own + value, 4), reason=reason)


def _too_wide(estimate: CalibrationEstimate, why: str) -> str:
    return f"interval of +- {1e3 * estimate.half:.1f} ms, wanted +- {1e3 * RESOLVED_S:g} ms: {why}"


def _factor_quantity(windows: list[Window], sequence: Sequence) -> Quantity:
    """The depth factor by which the windows' paths are as long as the ground truth's."""
    truth = sequence.ground_truth
    name = "depth_factor"
    if truth is None or len(truth) < 2:
        reason = "there is no ground truth: images alone do not determine the unit of length"
        return Quantity(name, reason=reason)

    # The scale of each window that the truth covers, and its mean over windows.
    covered: list[Window] = []
    scales = []
    information = []
    for window in windows:
        scale, weight = _path_scale(window, truth)
        if scale > 0:
            covered.append(window)
            scales.append(scale)
            information.append(weight)
    if len(covered) < LEAST_WINDOWS:
        reason = f"the ground truth covers {len(covered)} of {len(windows)} windows"
        return Quantity(name, reason=reason)
    systematic = SYSTEMATIC_FACTOR * float(np.median(scales))
    estimate = _over_windows(covered, np.array(scales), np.array(information), systematic)
    if estimate.half > RESOLVED_FACTOR * estimate.value:
        share = f"{estimate.half / estimate.value:.0%}"
        reason = f"interval of +- {share}, wanted +- {RESOLVED_FACTOR:.0%}: the camera's path is too short"
        return Quantity(name, reason=reason)

    # Longer true paths mean that fewer raw units are a metre.
    stated = sequence.camera.written_depth_factor
    low = stated / (estimate.value + estimate.half)
    high = stated / (estimate.value - estimate.half)
    value = stated / estimate.value
    quantity = Quantity(name, value, low, high, observable=True)
    if low <= stated <= high:
        return replace(quantity, reason=f"agrees with the camera's {stated:g}")
    written = float(f"{value:.4g}")
    return replace(quantity, written=written, reason=f"the camera states {stated:g}")


def _path_scale(window: Window, truth: Trajectory) -> tuple[float, float]:
    """Length of the true path as a multiple of a window's, and its information; 0 where the truth does not cover it.

    The paths are aligned by a rotation and a scale, by least squares.
    """
    # The true positions ``[n, 3]`` at the window's stamps, unless there is a gap.
    stamps = window.start + window.stamps - window.stamps[0]
    after = np.clip(np.searchsorted(truth.timestamps, stamps), 1, len(truth) - 1)
    outside = stamps[0] < truth.timestamps[0] or stamps[-1] > truth.timestamps[-1]
    if outside or (np.diff(truth.timestamps)[after - 1] > LARGEST_TRUTH_GAP_S).any():
        return 0.0, 0.0
    axes = [np.interp(stamps, truth.timestamps, truth.T_world_cam[:, k, 3]) for k in range(3)]
    positions = np.stack(axes, axis=1)

    own = window.centre - window.centre.mean(0)
    true = positions - positions.mean(0)
    turned = Rotation.align_vectors(true, own)[0].apply(own)
    square = float((own**2).sum())
    scale = float((turned * true).sum()) / square
    # 3 n measurements less seven of the alignment.
    error = float(((true - scale * turned) ** 2).sum()) / (3 * len(own) - 7)
    return scale, square / max(error, 1e-12)
