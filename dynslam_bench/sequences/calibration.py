"""What is often not known of an RGB-D camera, measured in a recording: readout time, delay of depth, depth factor.

Keypoints are tracked through windows of consecutive frames, and each window is adjusted as a bundle whose camera moves
continuously: every pixel belongs to the pose at its row's time, every depth to the pose at its image's time (Kerl,
Stueckler and Cremers, Dense Continuous-Time Tracking and Mapping with Rolling Shutter RGB-D Cameras, ICCV 2015; points
in place of their dense images). The readout time and the delay of the depth images are unknowns that all windows share.
They show where the camera's velocity changes: under a constant velocity each row is late in all frames alike.

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

from dynslam_bench.contracts.sequence import Sequence
from dynslam_bench.core.errors import SequenceError
from dynslam_bench.geometry.camera import Camera
from dynslam_bench.sequences.continuous_time import LEAST_POINTS, Unusable, Window, corners, track

Array = NDArray[np.float64]

WINDOW_FRAMES = 16
"""Frames of a window, half of which the next one shares: 0.5 s at 30 Hz, in which a hand changes the velocity."""
LEAST_WINDOW_FRAMES = 8
LEAST_WINDOWS = 3
MOST_WINDOWS = 12
CANDIDATES = 64
"""So many windows of a long recording are looked at; the `MOST_WINDOWS` whose velocity changes most are used."""
JITTER = 0.25
"""Share of the frame interval by which stamps may be off that were given after the exposure (as TUM's are)."""
SMALLEST_DELAY_S, LARGEST_DELAY_S = 0.005, 0.1
"""A smaller delay changes hardly any pair of images; a larger one is not looked for."""
ROUNDS = 12
RESOLVED_S, RESOLVED_SHARE = 0.004, 0.25
"""Half the interval must be at most this, or this share of the value, or the quantity counts as not observable."""
RESOLVED_FACTOR = 0.05
SYSTEMATIC_S = 0.001
"""Standard deviation of what all windows share: intrinsics, depth errors, the sub-pixel error of tracking.

Windows of 10 to 25 frames give 23.4 to 27.3 ms on the excerpt of fr1_xyz."""
SYSTEMATIC_FACTOR = 0.012
"""Alike for lengths, relative: 1.5 % are missing where depth is noisy (`fast_desk`)."""


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
    """What was measured in a recording.

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


def calibrate(sequence: Sequence, *, progress: Callable[[int, int], None] | None = None) -> Calibration:
    """Measure the readout time of the colour camera, the delay of its depth images, and the depth factor.

    The readout time and the delay use images and stamps alone. The depth factor is compared with the ground truth,
    if there is one. Of a long recording those stretches are used in which the image's velocity changes most.

    Args:
        sequence: A recording with colour and depth images; its camera's intrinsics have to be right.
        progress: Called with (windows done, windows in all).

    Returns:
        Estimates with 95 % intervals over windows, and what is to be written of each.

    Raises:
        SequenceError: There is no depth, there are too few frames, or too few windows have points that can be tracked.
    """
    frames = len(sequence)
    if not getattr(sequence, "has_depth", True):
        raise SequenceError(f"{sequence.id} has no depth images", "calibration needs depth beside colour")
    length = int(np.clip(2 * frames // 5, LEAST_WINDOW_FRAMES, WINDOW_FRAMES))
    if frames < 2 * length:
        raise SequenceError(
            f"{sequence.id} has {frames} frame{'s' * (frames != 1)}, calibration needs {2 * LEAST_WINDOW_FRAMES}",
            "record some seconds of a textured scene with a camera that is turned to and fro",
        )
    starts = _choose(sequence, length)
    windows, faults = [], []
    for done, first in enumerate(starts):
        try:
            windows.append(window_of(sequence, first, length))
        except Unusable as fault:
            faults.append(str(fault))
        if progress is not None:
            progress(done + 1, len(starts))
    if len(windows) < LEAST_WINDOWS:
        common = max(set(faults), key=faults.count)
        raise SequenceError(
            f"{len(windows)} of {len(starts)} windows of {sequence.id} can be used, expected {LEAST_WINDOWS}: {common}",
            "record a well-lit, textured, static scene within the depth camera's reach",
        )
    try:
        readout, delay = adjust(windows)
    except np.linalg.LinAlgError as error:
        raise SequenceError(f"the windows of {sequence.id} cannot be adjusted: {error}", "try another part") from None
    quantities = (
        _readout(readout, windows, sequence.camera),
        _delay(delay, sequence.camera),
        _factor(windows, sequence),
    )
    values: dict[str, Any] = {
        quantity.name: quantity.written for quantity in quantities if quantity.written is not None
    }
    noise = float(np.median([window.noise[0] for window in windows]))
    return Calibration(replace(sequence.camera, **values), quantities, len(windows), length, noise)


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
    deep = [cv2.erode((frame.depth > 0).astype(np.uint8), np.ones((9, 9))) for frame in frames]
    grey = [cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2GRAY) for frame in frames]
    pixels = track([np.asarray(image, np.uint8) for image in grey], [np.asarray(mask, np.uint8) for mask in deep])
    if len(pixels) < LEAST_POINTS:
        raise Unusable("too few points can be followed")
    return Window(sequence.camera, stamps, pixels, np.stack([frame.depth for frame in frames]), offsets)


def _stamps(sequence: Sequence, first: int, length: int) -> tuple[Array, Array]:
    """Stamps ``[length]`` of the colour images, and by how much the depth images' are later."""
    part = slice(max(first - 25, 0), first + length + 25)
    inside = slice(first - part.start, first - part.start + length)
    stamps = np.asarray(sequence.timestamps, dtype=np.float64)[part]
    colour = _regular(stamps)[inside]
    depth = getattr(sequence, "depth_timestamps", None)
    return colour, np.zeros(length) if depth is None else _regular(np.asarray(depth)[part])[inside] - colour


def _regular(stamps: Array) -> Array:
    """Evenly spaced stamps where a camera's even ticks explain them; a stamp is given some time after the exposure."""
    gaps = np.diff(stamps)
    ticks = np.maximum(np.round(gaps / np.median(gaps)), 1)
    if np.abs(gaps - ticks * np.median(gaps)).max() > JITTER * np.median(gaps):
        return stamps
    count = np.concatenate([[0.0], np.cumsum(ticks)])
    return np.asarray(np.polyval(np.polyfit(count, stamps - stamps[0], 1), count) + stamps[0])


def _choose(sequence: Sequence, length: int) -> list[int]:
    """First frames of the windows to use: all of a short recording, those of most change of velocity of a long one."""
    starts = list(range(0, len(sequence) - length + 1, length // 2))
    if len(starts) <= MOST_WINDOWS:
        return starts
    if len(starts) > CANDIDATES:
        starts = [starts[i] for i in np.unique(np.linspace(0, len(starts) - 1, CANDIDATES).round().astype(int))]
    change = [_change(sequence, first, first + length - 2) for first in starts]
    return sorted(starts[i] for i in np.argsort(change)[::-1][:MOST_WINDOWS])


def _change(sequence: Sequence, first: int, last: int) -> float:
    """Pixels a frame by which the image's velocity changes between two frames, less where few corners are followed."""
    flows = []
    for i in (first, last):
        now, later = (
            cv2.resize(cv2.cvtColor(sequence[j].rgb, cv2.COLOR_RGB2GRAY), None, fx=0.5, fy=0.5) for j in (i, i + 1)
        )
        start_pixels = corners(np.asarray(now, np.uint8), np.ones(now.shape, np.uint8), np.zeros((0, 2)), 40)
        if len(start_pixels) < LEAST_POINTS:
            return 0.0
        start = start_pixels.reshape(-1, 1, 2)
        there, status, _ = cv2.calcOpticalFlowPyrLK(now, later, start, start.copy(), winSize=(21, 21), maxLevel=3)
        good = status[:, 0] > 0
        if good.sum() < LEAST_POINTS:
            return 0.0
        flows.append(np.median(there[good, 0] - start_pixels[good], axis=0))
    return float(np.linalg.norm(flows[1] - flows[0]))


@dataclass(frozen=True)
class Estimate:
    """A value with its 95 % interval over windows.

    Attributes:
        value: Seconds, or the factor of a length.
        half: Half the interval, alike.
    """

    value: float
    half: float

    @property
    def resolved(self) -> bool:
        """Whether a time in seconds is determined well enough to be used."""
        return self.half <= max(RESOLVED_S, RESOLVED_SHARE * abs(self.value))


def adjust(windows: list[Window]) -> tuple[Estimate, Estimate]:
    """Adjust all windows together with the readout time and the delay of depth that they share.

    Args:
        windows: At least two; they are left as adjusted.

    Returns:
        Readout time and delay in seconds.
    """
    shared = np.array([0.0, _coarse_delay(windows)])
    for turn in range(ROUNDS):
        parts = []
        for window in windows:
            window.move_depth(*shared)
            if turn < 4:
                window.measure_noise(shared[0])
            equations = window.normal_equations(shared[0])
            parts.append((equations, *equations.shared()))
        information, slopes = np.array([part[1] for part in parts]), np.array([part[2] for part in parts])
        step = np.clip(-np.linalg.lstsq(information.sum(0), slopes.sum(0), rcond=None)[0], -0.02, 0.02)
        for window, (equations, _, _, response) in zip(windows, parts, strict=True):
            window.update(*equations.steps(step, response))
        shared = shared + step
        if turn >= 4 and np.abs(step).max() < 1e-5:
            break
    slopes = slopes + information @ step
    own = np.maximum(np.diagonal(information, axis1=1, axis2=2), 1e-12)
    values = shared - slopes / own
    return _over_windows(windows, values[:, 0], own[:, 0]), _over_windows(windows, values[:, 1], own[:, 1])


def _coarse_delay(windows: list[Window]) -> float:
    """The delay of least robust cost of the depth images, on a grid."""
    grid = np.linspace(-LARGEST_DELAY_S, LARGEST_DELAY_S, 21)
    costs = []
    for delay in grid:
        parts = [window.depth_cost(0.0, float(delay)) for window in windows]
        costs.append(sum(part[0] for part in parts) / max(sum(part[1] for part in parts), 1))
    return float(grid[int(np.argmin(costs))])


def _over_windows(
    windows: list[Window], values: Array, information: Array, systematic: float = SYSTEMATIC_S
) -> Estimate:
    """Mean of the windows' values, each with its own and the windows' common variance, and half the 95 % interval.

    A random-effects mean (DerSimonian and Laird, 1986) with the interval of Hartung and Knapp (2001), not less than
    that of the fixed effects. Windows that share frames count as fewer.
    """
    k = len(values)
    mean = float((values * information).sum() / information.sum())
    q = float((information * (values - mean) ** 2).sum())
    spare = information.sum() - (information**2).sum() / information.sum()
    between = max(0.0, (q - (k - 1)) / max(spare, 1e-12))
    weights = 1 / (1 / np.maximum(information, 1e-12) + between)
    mean = float((values * weights).sum() / weights.sum())
    scatter = float((weights * (values - mean) ** 2).sum() / ((k - 1) * weights.sum()))
    starts = np.array([window.start for window in windows])
    length = float(np.median([np.ptp(window.stamps) for window in windows]))
    variance = max(scatter, float(1 / weights.sum())) * (1 + float((np.diff(starts) < length).mean()))
    return Estimate(mean, float(np.hypot(student.ppf(0.975, k - 1) * np.sqrt(variance), 1.96 * systematic)))


def _readout(estimate: Estimate, windows: list[Window], camera: Camera) -> Quantity:
    interval_s = float(np.median([np.median(np.diff(window.stamps)) for window in windows]))
    low, high = estimate.value - estimate.half, estimate.value + estimate.half
    about = Quantity("readout_s", estimate.value, low, high)
    if not estimate.resolved:
        change = float(np.median([window.turning_change() for window in windows]))
        return replace(
            about,
            reason=f"interval of +- {1e3 * estimate.half:.1f} ms, wanted +- {1e3 * RESOLVED_S:g} ms: the turning rate "
            f"changes by {change:.2f} rad/s within a window; turn the camera to and fro faster",
        )
    if high < 0 or estimate.value > interval_s + RESOLVED_S:
        return replace(about, reason=f"outside of 0 to {1e3 * interval_s:.0f} ms, a frame's interval: check the stamps")
    about = replace(about, observable=True)
    if low <= 0:
        agrees = "the interval contains 0: a global shutter, or as good as one"
        return replace(about, written=0.0 if camera.readout_s > high else None, reason=agrees)
    if low <= camera.readout_s <= high:
        return replace(about, reason=f"agrees with the camera's {1e3 * camera.readout_s:g} ms")
    return replace(about, written=round(estimate.value, 4), reason="a rolling shutter")


def _delay(estimate: Estimate, camera: Camera) -> Quantity:
    """The stamps that the reader gives have the camera's own delay added already."""
    low, high = estimate.value - estimate.half, estimate.value + estimate.half
    own = camera.depth_delay_s
    about = Quantity("depth_delay_s", own + estimate.value, own + low, own + high)
    if not estimate.resolved:
        return replace(
            about,
            reason=f"interval of +- {1e3 * estimate.half:.1f} ms, wanted +- {1e3 * RESOLVED_S:g} ms: too slow a motion",
        )
    if abs(estimate.value) > LARGEST_DELAY_S:
        return replace(about, reason=f"beyond +- {1e3 * LARGEST_DELAY_S:g} ms: do colour and depth use the same clock?")
    about = replace(about, observable=True)
    if low <= 0 <= high or abs(estimate.value) < SMALLEST_DELAY_S:
        return replace(about, reason="colour and depth are exposed as their stamps say, to a sixth of a frame")
    late = "later" if estimate.value > 0 else "earlier"
    written = round(camera.depth_delay_s + estimate.value, 4)
    return replace(about, written=written, reason=f"depth is exposed {late} than its stamps say")


def _factor(windows: list[Window], sequence: Sequence) -> Quantity:
    """The depth factor by which the windows' paths are as long as the ground truth's."""
    about = Quantity("depth_factor")
    truth = sequence.ground_truth
    if truth is None or len(truth) < 2:
        return replace(about, reason="there is no ground truth: images alone do not determine the unit of length")
    used, scales, information = [], [], []
    for window in windows:
        stamps = window.start + window.stamps - window.stamps[0]
        after = np.clip(np.searchsorted(truth.timestamps, stamps), 1, len(truth) - 1)
        if (np.diff(truth.timestamps)[after - 1] > 0.1).any() or not (
            truth.timestamps[0] <= stamps[0] and stamps[-1] <= truth.timestamps[-1]
        ):
            continue
        places = np.stack([np.interp(stamps, truth.timestamps, truth.T_world_cam[:, k, 3]) for k in range(3)], axis=1)
        own, true = window.centre - window.centre.mean(0), places - places.mean(0)
        turn = Rotation.align_vectors(true, own)[0].apply(own)
        length = float((own**2).sum())
        scale = float((turn * true).sum()) / length
        error = float(((true - scale * turn) ** 2).sum()) / (3 * len(own) - 7)
        if scale > 0:
            used.append(window)
            scales.append(scale)
            information.append(length / max(error, 1e-12))
    if len(scales) < LEAST_WINDOWS:
        return replace(about, reason=f"the ground truth covers {len(scales)} of {len(windows)} windows")
    estimate = _over_windows(
        used, np.array(scales), np.array(information), SYSTEMATIC_FACTOR * float(np.median(scales))
    )
    if estimate.half > RESOLVED_FACTOR * estimate.value:
        share = estimate.half / max(estimate.value, 1e-9)
        return replace(
            about, reason=f"interval of +- {share:.0%}, wanted +- {RESOLVED_FACTOR:.0%}: the camera's path is too short"
        )
    factor = sequence.camera.depth_factor
    value, low, high = (
        factor / estimate.value,
        factor / (estimate.value + estimate.half),
        factor / (estimate.value - estimate.half),
    )
    about = replace(about, value=value, low=low, high=high, observable=True)
    if low <= factor <= high:
        return replace(about, reason=f"agrees with the camera's {factor:g}")
    return replace(about, written=float(f"{value:.4g}"), reason=f"the camera states {factor:g}")
