"""What is often not known of an RGB-D camera, measured in a recording: readout time, delay of depth, depth factor.

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
from itertools import pairwise, permutations, product
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.stats import t as student

from dynslam_bench.contracts import Sequence
from dynslam_bench.core import SequenceError, translate_errors
from dynslam_bench.geometry import Array, Camera, se3
from dynslam_bench.sequences.rgbd_motion import follow_corners

WINDOW_FRAMES = 16
"""Frames of a window, half of which the next one shares: 0.5 s at 30 Hz, in which a hand changes the velocity."""
LEAST_WINDOW_FRAMES = 8
LEAST_WINDOWS = 3
MOST_WINDOWS = 12
CANDIDATES = 64
"""So many windows of a long recording are looked at; the `MOST_WINDOWS` whose velocity changes most are used."""
JITTER = 0.25
"""Share of the frame interval by which stamps may be off that were given after the exposure (as TUM's are)."""
SMALLEST_DELAY_S = 0.005
LARGEST_DELAY_S = 0.1
"""A smaller delay changes hardly any pair of images; a larger one is not looked for."""
ROUNDS = 12
RESOLVED_S = 0.004
RESOLVED_SHARE = 0.25
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
    frames = len(sequence)
    if not getattr(sequence, "has_depth", True):
        raise SequenceError(
            f"{sequence.id} has no depth images", "calibration needs depth beside colour"
        )
    length = int(np.clip(2 * frames // 5, LEAST_WINDOW_FRAMES, WINDOW_FRAMES))
    if frames < 2 * length:
        raise SequenceError(
            f"{sequence.id} has {frames} frame{'s' * (frames != 1)}, calibration needs {2 * LEAST_WINDOW_FRAMES}",
            "record some seconds of a textured scene with a camera that is turned to and fro",
        )
    starts = _choose(sequence, length)
    windows = []
    faults = []
    for done, first in enumerate(starts):
        try:
            windows.append(window_of(sequence, first, length))
        except Unusable as fault:
            faults.append(str(fault))
        progress(done + 1, len(starts))
    if len(windows) < LEAST_WINDOWS:
        common = max(set(faults), key=faults.count)
        raise SequenceError(
            f"{len(windows)} of {len(starts)} windows of {sequence.id} can be used, expected {LEAST_WINDOWS}: {common}",
            "record a well-lit, textured, static scene within the depth camera's reach",
        )
    with translate_errors(
        SequenceError,
        f"the windows of {sequence.id} cannot be adjusted",
        "try another part",
        of=np.linalg.LinAlgError,
    ):
        readout, delay = adjust(windows)
    camera = sequence.camera
    quantities = (
        _readout(readout, windows, camera),
        _delay(delay, camera),
        _factor(windows, sequence),
    )
    written: dict[str, Any] = {
        one.name: one.written for one in quantities if one.written is not None
    }
    noise = float(np.median([window.noise[0] for window in windows]))
    return Calibration(replace(camera, **written), quantities, len(windows), length, noise)


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
    pixels = track(
        [np.asarray(image, np.uint8) for image in grey],
        [np.asarray(mask, np.uint8) for mask in deep],
    )
    if len(pixels) < LEAST_POINTS:
        raise Unusable("too few points can be followed")
    return Window(
        sequence.camera, stamps, pixels, np.stack([frame.depth for frame in frames]), offsets
    )


def _stamps(sequence: Sequence, first: int, length: int) -> tuple[Array, Array]:
    """Stamps ``[length]`` of the colour images, and by how much the depth images' are later."""
    part = slice(max(first - 25, 0), first + length + 25)
    inside = slice(first - part.start, first - part.start + length)
    stamps = np.asarray(sequence.timestamps, dtype=np.float64)[part]
    colour = _regular(stamps)[inside]
    depth = getattr(sequence, "depth_timestamps", None)
    return colour, np.zeros(length) if depth is None else _regular(np.asarray(depth)[part])[
        inside
    ] - colour


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
    spread = (
        np.linspace(0, len(starts) - 1, min(len(starts), CANDIDATES)).round().astype(int).tolist()
    )
    change = [_change(sequence, starts[i], starts[i] + length - 2) for i in spread]
    return sorted(starts[spread[i]] for i in np.argsort(change)[::-1][:MOST_WINDOWS])


def _change(sequence: Sequence, first: int, last: int) -> float:
    """Pixels a frame by which the image's velocity changes between two frames, less where few corners are followed."""
    flows = []
    for i in (first, last):
        grey = (cv2.cvtColor(sequence[j].rgb, cv2.COLOR_RGB2GRAY) for j in (i, i + 1))
        now, later = (
            np.asarray(cv2.resize(image, None, fx=0.5, fy=0.5), np.uint8) for image in grey
        )
        start = corners(now, np.ones(now.shape, np.uint8), np.zeros((0, 2)), 40)
        if len(start) < LEAST_POINTS:
            return 0.0
        there, status, _ = cv2.calcOpticalFlowPyrLK(
            now, later, start, start.copy(), winSize=(21, 21), maxLevel=3
        )
        good = status[:, 0] > 0
        if good.sum() < LEAST_POINTS:
            return 0.0
        flows.append(np.median(there[good] - start[good], axis=0))
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
    grid = np.linspace(-LARGEST_DELAY_S, LARGEST_DELAY_S, 21).tolist()
    costs = [np.sum([window.depth_cost(delay) for window in windows], axis=0) for delay in grid]
    shared = np.array([0.0, grid[int(np.argmin([cost / max(count, 1) for cost, count in costs]))]])
    for turn in range(ROUNDS):
        parts = []
        for window in windows:
            window.move_depth(*shared)
            if turn < 4:
                window.measure_noise(shared[0])
            parts.append(window.normal_equations(shared[0]))
        information, slopes = (
            np.array([getattr(part, name) for part in parts]) for name in ("information", "slope")
        )
        step = np.clip(
            -np.linalg.lstsq(information.sum(0), slopes.sum(0), rcond=None)[0], -0.02, 0.02
        )
        for window, part in zip(windows, parts, strict=True):
            window.update(*part.steps(step))
        shared = shared + step
        if turn >= 4 and np.abs(step).max() < 1e-5:
            break
    slopes = slopes + information @ step
    own = np.maximum(np.diagonal(information, axis1=1, axis2=2), 1e-12)
    values = shared - slopes / own
    readout, delay = (_over_windows(windows, values[:, i], own[:, i]) for i in (0, 1))
    return readout, delay


def _over_windows(
    windows: list[Window], values: Array, information: Array, systematic: float = SYSTEMATIC_S
) -> Estimate:
    """Mean of the windows' values, each with its own and the windows' common variance, and half the 95 % interval.

    A random-effects mean (DerSimonian and Laird, 1986) with the interval of Hartung and Knapp
    (2001), not less than that of the fixed effects. Windows that share frames count as fewer.
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
    variance = max(scatter, float(1 / weights.sum())) * (
        1 + float((np.diff(starts) < length).mean())
    )
    return Estimate(
        mean, float(np.hypot(student.ppf(0.975, k - 1) * np.sqrt(variance), 1.96 * systematic))
    )


def _readout(estimate: Estimate, windows: list[Window], camera: Camera) -> Quantity:
    """The readout time; what is written is never longer than the time between two frames."""
    interval_s = float(np.median([np.median(np.diff(window.stamps)) for window in windows]))
    longest = np.floor(1e4 * interval_s) / 1e4
    value = estimate.value
    low = estimate.value - estimate.half
    high = estimate.value + estimate.half
    quantity = Quantity("readout_s", value, low, high)
    frame = f"{1e3 * interval_s:.0f} ms, a frame's interval"
    impossible = high < 0 or low > interval_s or value > interval_s + RESOLVED_S
    if impossible or not estimate.resolved:
        change = float(np.median([window.turning_change() for window in windows]))
        slow = f"the turning rate changes by {change:.2f} rad/s within a window; turn the camera to and fro faster"
        outside = f"outside of 0 to {frame}: check the stamps"
        reason = outside if estimate.resolved else _too_wide(estimate, slow)
        if camera.readout_s > interval_s:
            stated = f"the camera's {1e3 * camera.readout_s:g} ms are more than {frame}, and 0 stands for not known"
            return replace(quantity, written=0.0, reason=f"{reason}; {stated}")
        return replace(quantity, reason=reason)
    if low <= 0:
        written = 0.0 if camera.readout_s > min(high, interval_s) else None
        reason = "the interval contains 0: a global shutter, or as good as one"
        return replace(quantity, written=written, observable=True, reason=reason)
    if low <= camera.readout_s <= min(high, interval_s):
        return replace(
            quantity,
            observable=True,
            reason=f"agrees with the camera's {1e3 * camera.readout_s:g} ms",
        )
    reason = "a rolling shutter" if value <= interval_s else f"a rolling shutter, at most {frame}"
    return replace(
        quantity, written=min(round(value, 4), float(longest)), observable=True, reason=reason
    )


def _delay(estimate: Estimate, camera: Camera) -> Quantity:
    """The stamps that the reader gives have the camera's own delay added already."""
    value = estimate.value
    half = estimate.half
    own = camera.depth_delay_s
    beyond = f"beyond +- {1e3 * LARGEST_DELAY_S:g} ms: do colour and depth use the same clock?"
    synchronous = value - half <= 0 <= value + half or abs(value) < SMALLEST_DELAY_S
    side = "later" if value > 0 else "earlier"
    return _judged(
        "depth_delay_s",
        (own + value, own + (value - half), own + (value + half)),
        (
            (not estimate.resolved, False, None, _too_wide(estimate, "too slow a motion")),
            (abs(value) > LARGEST_DELAY_S, False, None, beyond),
            (
                synchronous,
                True,
                None,
                "colour and depth are exposed as their stamps say, to a sixth of a frame",
            ),
            (True, True, round(own + value, 4), f"depth is exposed {side} than its stamps say"),
        ),
    )


def _too_wide(estimate: Estimate, why: str) -> str:
    return f"interval of +- {1e3 * estimate.half:.1f} ms, wanted +- {1e3 * RESOLVED_S:g} ms: {why}"


def _judged(
    name: str,
    interval: tuple[float, float, float],
    cases: tuple[tuple[bool, bool, float | None, str], ...],
) -> Quantity:
    """A quantity with its value and interval, by the first of the cases (holds, observable, written, reason)."""
    _, observable, written, reason = next(case for case in cases if case[0])
    return Quantity(name, *interval, written, observable, reason)


def _factor(windows: list[Window], sequence: Sequence) -> Quantity:
    """The depth factor by which the windows' paths are as long as the ground truth's."""
    truth = sequence.ground_truth
    name = "depth_factor"
    if truth is None or len(truth) < 2:
        return Quantity(
            name,
            reason="there is no ground truth: images alone do not determine the unit of length",
        )
    used: list[tuple[Window, float, float]] = []
    for window in windows:
        stamps = window.start + window.stamps - window.stamps[0]
        after = np.clip(np.searchsorted(truth.timestamps, stamps), 1, len(truth) - 1)
        outside = stamps[0] < truth.timestamps[0] or stamps[-1] > truth.timestamps[-1]
        if outside or (np.diff(truth.timestamps)[after - 1] > 0.1).any():
            continue
        places = np.stack(
            [np.interp(stamps, truth.timestamps, truth.T_world_cam[:, k, 3]) for k in range(3)],
            axis=1,
        )
        own = window.centre - window.centre.mean(0)
        true = places - places.mean(0)
        turn = Rotation.align_vectors(true, own)[0].apply(own)
        length = float((own**2).sum())
        scale = float((turn * true).sum()) / length
        error = float(((true - scale * turn) ** 2).sum()) / (3 * len(own) - 7)
        if scale > 0:
            used.append((window, scale, length / max(error, 1e-12)))
    if len(used) < LEAST_WINDOWS:
        return Quantity(
            name, reason=f"the ground truth covers {len(used)} of {len(windows)} windows"
        )
    covered, scales, information = zip(*used, strict=True)
    systematic = SYSTEMATIC_FACTOR * float(np.median(scales))
    estimate = _over_windows(list(covered), np.array(scales), np.array(information), systematic)
    if estimate.half > RESOLVED_FACTOR * estimate.value:
        share = f"{estimate.half / estimate.value:.0%}"
        return Quantity(
            name,
            reason=f"interval of +- {share}, wanted +- {RESOLVED_FACTOR:.0%}: the camera's path is too short",
        )
    factor = sequence.camera.written_depth_factor
    low = factor / (estimate.value + estimate.half)
    high = factor / (estimate.value - estimate.half)
    agrees = low <= factor <= high
    value = factor / estimate.value
    reason = f"agrees with the camera's {factor:g}" if agrees else f"the camera states {factor:g}"
    return Quantity(name, value, low, high, None if agrees else float(f"{value:.4g}"), True, reason)


# Bundle adjustment of a window whose camera moves continuously: every row and every depth image has
# its own time.

POINTS = 110
"""So many corners are followed at a time."""


def track(images: list[NDArray[np.uint8]], allowed: list[NDArray[np.uint8]]) -> Array:
    """Corners followed from image to image by Lucas and Kanade, pixels ``[L, n, 2]``; NaN where they are not seen.

    A corner that is tracked back more than half a pixel off is lost. New ones are detected where
    few are left and `allowed` is not 0.
    """
    n = len(images)
    (height, width) = images[0].shape
    tracks = np.full((0, n, 2), np.nan)
    for i in range(n - 1):
        alive = np.isfinite(tracks[:, i, 0])
        if alive.sum() < POINTS and i < n - 3:
            fresh = corners(images[i], allowed[i], tracks[alive, i], POINTS - int(alive.sum()))
            tracks = np.pad(tracks, ((0, len(fresh)), (0, 0), (0, 0)), constant_values=np.nan)
            tracks[len(alive) :, i] = fresh
            alive = np.isfinite(tracks[:, i, 0])
        here = tracks[alive, i].astype(np.float32)
        if not len(here):
            continue
        flow = here - tracks[alive, i - 1] if i else np.full(here.shape, np.nan)
        valid = np.isfinite(flow[:, 0])
        flow[~valid] = np.median(flow[valid], axis=0) if valid.any() else 0.0
        there, good = follow_corners(
            images[i], images[i + 1], here, (here + flow).astype(np.float32), 0.5
        )
        good &= (there >= 8).all(axis=1) & (there < (width - 8, height - 8)).all(axis=1)
        tracks[np.flatnonzero(alive)[good], i + 1] = there[good]
    return np.asarray(tracks[np.isfinite(tracks[..., 0]).sum(axis=1) >= 4])


def corners(
    image: NDArray[np.uint8], allowed: NDArray[np.uint8], taken: Array, count: int
) -> NDArray[np.float32]:
    """Corners ``[N, 2]`` spread over the cells of a grid, away from those that there are."""
    height, width = image.shape
    free = allowed.copy()
    for x, y in taken:
        cv2.circle(free, (int(x), int(y)), 12, 0, -1)
    rows = np.linspace(0, height, 5).astype(int).tolist()
    columns = np.linspace(0, width, 6).astype(int).tolist()
    pixels = [np.zeros((0, 2), np.float32)]
    cells = list(product(pairwise(rows), pairwise(columns)))
    per_cell = int(np.ceil(1.5 * count / len(cells)))
    for (top, bottom), (left, right) in cells:
        cell = np.s_[top:bottom, left:right]
        in_cell = cv2.goodFeaturesToTrack(image[cell], per_cell, 0.02, 12, mask=free[cell])
        if in_cell is not None:
            pixels.append(np.asarray(in_cell.reshape(-1, 2) + np.array([left, top]), np.float32))
    return np.concatenate(pixels)


def inverse_depth(depth: NDArray[np.float32], pixels: Array) -> Array:
    """Mean inverse depth ``[N]`` of the 5x5 pixels around `pixels` ``[N, 2]``; NaN at edges, holes and outside."""
    height, width = depth.shape
    place: Array = np.asarray(np.round(pixels))
    ahead = (place >= 2).all(axis=1)
    before = (place < (width - 2, height - 2)).all(axis=1)
    inside = np.asarray(np.isfinite(place).all(axis=1) & ahead & before)
    u, v = np.where(inside[:, None], place, 2).astype(np.intp).T
    around = np.arange(-2, 3)
    patch = (
        depth[v[:, None, None] + around[:, None], u[:, None, None] + around]
        .reshape(len(u), 25)
        .astype(np.float64)
    )
    measured = patch > 0
    inverse = 1 / np.where(measured, patch, 1.0)
    count = measured.sum(axis=1)
    mean = (inverse * measured).sum(axis=1) / np.maximum(count, 1)
    spread = np.where(measured, inverse, -np.inf).max(axis=1) - np.where(
        measured, inverse, np.inf
    ).min(axis=1)
    return np.where(inside & (count >= 20) & (spread < 0.12 * mean), mean, np.nan)


LEAST_POINTS = 15
LARGEST_NOISE_PX = 3.0
"""Before the rolling shutter is taken into account, which costs up to a pixel."""
STENCIL = 5
"""Poses that a pose between frames is interpolated from (a quartic in time)."""
CAUCHY = 2.5
"""Scale of the robust kernel in standard deviations."""
_DIFFERENCE_S = 0.004


class Unusable(Exception):
    """A window that cannot be used, and why."""


class Window:
    """Keypoints tracked through consecutive frames, and the state of their bundle adjustment.

    L points, n frames; what was not observed is NaN. The world is the camera of the middle frame.

    Args:
        camera: Intrinsics; distorted pixels are those of its images.
        stamps: ``[n]`` seconds, when the middle row of each colour image was exposed.
        pixels: ``[L, n, 2]`` tracked pixels of the colour images, as they are (distorted).
        depth: ``[n, H, W]`` depth images in metres, 0 = missing.
        offsets: ``[n]`` seconds by which the depth images' stamps are later than the colour
            images'.

    Raises:
        Unusable: Too few points have depth, or do not move as one rigid body.
    """

    def __init__(
        self,
        camera: Camera,
        stamps: Array,
        pixels: Array,
        depth: NDArray[np.float32],
        offsets: Array,
    ) -> None:
        self.camera = camera
        self.depth = depth
        self.offsets = offsets
        self.raw = pixels
        self.start, self.stamps = float(stamps[0]), stamps - stamps[len(stamps) // 2]
        self.xy = camera.undistort_points(pixels).reshape(pixels.shape)
        self.inverse_depth = np.stack(
            [inverse_depth(image, pixels[:, i]) for i, image in enumerate(depth)], axis=1
        )
        self.R, self.centre = self._chain()
        with np.errstate(divide="ignore", invalid="ignore"):
            points = camera.unproject(self.xy, 1 / self.inverse_depth)
        world = np.einsum("nji,lnj->lni", self.R, points) + self.centre
        deep = np.isfinite(world[..., 0])
        keep = (np.isfinite(self.xy[..., 0]).sum(1) >= 4) & (deep.sum(1) >= 2)
        if keep.sum() < LEAST_POINTS:
            raise Unusable("too few points with depth can be followed")
        self.raw = self.raw[keep]
        self.xy = self.xy[keep]
        self.inverse_depth = self.inverse_depth[keep]
        self.depth_drift = np.zeros(self.raw.shape[:2])
        self.points = np.nanmedian(world[keep], axis=1)
        self.late = np.nan_to_num((self.raw[..., 1] + 0.5) / camera.height - 0.5)
        self.noise = 1.0, 0.01
        self.measure_noise(0.0)
        for _ in range(4):
            self.update(*self.normal_equations(0.0).steps(np.zeros(2)))
        self.measure_noise(0.0)
        if not self.noise[0] < LARGEST_NOISE_PX:
            raise Unusable(f"the points fit one rigid scene to {self.noise[0]:.1f} px only")

    def _chain(self) -> tuple[Array, Array]:
        """Rotations world to camera ``[n, 3, 3]`` and centres ``[n, 3]``, frame by frame by PnP; drops what moves."""
        T = [np.eye(4)]
        matrix = self.camera.matrix
        for i in range(len(self.stamps) - 1):
            usable = np.isfinite(self.inverse_depth[:, i]) & np.isfinite(self.xy[:, i + 1, 0])
            if usable.sum() < LEAST_POINTS:
                raise Unusable("too few points with depth can be followed")
            points = self.camera.unproject(self.xy[usable, i], 1 / self.inverse_depth[usable, i])
            pixels = self.xy[usable, i + 1]
            success, turn, shift, inliers = cv2.solvePnPRansac(
                points,
                pixels,
                matrix,
                None,
                iterationsCount=200,
                reprojectionError=3.0,
                flags=cv2.SOLVEPNP_EPNP,
            )
            if (
                not success
                or inliers is None
                or len(inliers) < max(LEAST_POINTS // 2, 0.4 * len(points))
            ):
                raise Unusable("the points do not move as one rigid scene")
            chosen = inliers[:, 0]
            turn, shift = cv2.solvePnPRefineLM(
                points[chosen], pixels[chosen], matrix, None, turn, shift
            )
            step = se3.from_matrix(shift[:, 0], cv2.Rodrigues(turn)[0])
            error = np.linalg.norm(
                self.camera.project(points @ step[:3, :3].T + step[:3, 3]) - pixels, axis=1
            )
            moving = np.flatnonzero(usable)[~(error < 6.0)]
            self.xy[moving, i + 1 :] = self.inverse_depth[moving, i + 1 :] = np.nan
            T.append(step @ T[-1])
        poses = np.array(T) @ np.linalg.inv(T[len(T) // 2])
        return poses[:, :3, :3], -np.einsum("nji,nj->ni", poses[:, :3, :3], poses[:, :3, 3])

    def _at(self, offset: Array) -> _Moment:
        """The camera at times `offset` ``[L, n]`` seconds after the frames' stamps."""
        n = len(self.stamps)
        times = self.stamps + offset
        nearest = np.searchsorted((self.stamps[1:] + self.stamps[:-1]) / 2, times)
        nodes = np.clip(np.arange(n) - STENCIL // 2, 0, n - STENCIL)[:, None] + np.arange(STENCIL)
        spread = self.stamps[nodes] - self.stamps[:, None]
        turns = _rotvec(self.R[nodes] @ np.swapaxes(self.R, 1, 2)[:, None])
        weights, slopes = _lagrange(spread[nearest], times - self.stamps[nearest])
        turn = turns[nearest]
        centres = self.centre[nodes][nearest]
        return _Moment(
            R=_matrix((weights[..., None, :] @ turn)[..., 0, :]) @ self.R[nearest],
            centre=(weights[..., None, :] @ centres)[..., 0, :],
            turning=(slopes[..., None, :] @ turn)[..., 0, :],
            velocity=(slopes[..., None, :] @ centres)[..., 0, :],
            weights=weights,
            nodes=nodes[nearest],
            within=(times > 1.5 * self.stamps[0] - 0.5 * self.stamps[1])
            & (times < 1.5 * self.stamps[-1] - 0.5 * self.stamps[-2]),
        )

    def _in_camera(self, moment: _Moment) -> Array:
        """The points ``[L, n, 3]`` in the camera at a moment."""
        return np.asarray((moment.R @ (self.points[:, None] - moment.centre)[..., None])[..., 0])

    def _residuals(self, points: Array) -> Array:
        """Pixels and inverse depth ``[L, n, 3]``: predicted less observed."""
        inverse = 1 / np.maximum(points[..., 2:], 1e-3)
        pixels = points[..., :2] * inverse * (self.camera.fx, self.camera.fy) + (
            self.camera.cx,
            self.camera.cy,
        )
        return np.concatenate([pixels - self.xy, inverse - self.inverse_depth[..., None]], axis=-1)

    def measure_noise(self, readout_s: float) -> None:
        """Take the noise of pixels and of inverse depth from the median residuals."""
        residuals = self._residuals(self._in_camera(self._at(self.late * readout_s)))
        error = np.hypot(residuals[..., 0], residuals[..., 1])
        depth = np.abs(residuals[..., 2])
        valid = np.isfinite(error)
        deep = np.isfinite(depth)
        if valid.any() and deep.any():
            self.noise = (
                max(np.median(error[valid]) / 1.177, 0.05),
                max(1.4826 * np.median(depth[deep]), 1e-6),
            )

    def turning_change(self) -> float:
        """Root mean square change of the turning rate within the window, rad/s."""
        rates = _rotvec(self.R[1:] @ np.swapaxes(self.R[:-1], 1, 2)) / np.diff(self.stamps)[:, None]
        return float(np.sqrt(((rates - rates.mean(0)) ** 2).sum(1).mean()))

    def move_depth(self, readout_s: float, delay_s: float) -> None:
        """Carry each depth from its image's time to its pixel's, with the motion as estimated so far.

        Args:
            readout_s: Readout time; the depth image's rows are taken to be read as the colour
                image's are.
            delay_s: By which the depth images are exposed later than their stamps say.
        """
        now = self._in_camera(self._at(self.late * readout_s))
        self.inverse_depth, before, after = (
            self._depth_at(now, readout_s, delay_s + step)
            for step in (0.0, -_DIFFERENCE_S, _DIFFERENCE_S)
        )
        drift = (after - before) / (2 * _DIFFERENCE_S)
        self.inverse_depth[~np.isfinite(drift)] = np.nan
        self.depth_drift = np.nan_to_num(drift)

    def _depth_at(self, now: Array, readout_s: float, delay_s: float) -> Array:
        """Inverse depth ``[L, n]`` at the pixels' time of images exposed `delay_s` after their stamps."""
        moment = self._at(self.late * readout_s + self.offsets + delay_s)
        then = self._in_camera(moment)
        inverse_now = 1 / np.maximum(now[..., 2:], 1e-3)
        inverse_then = 1 / np.maximum(then[..., 2:], 1e-3)
        shift = (then[..., :2] * inverse_then - now[..., :2] * inverse_now) * (
            self.camera.fx,
            self.camera.fy,
        )
        place = np.where(moment.within[..., None] & np.isfinite(self.xy), self.raw + shift, np.nan)
        observed = np.stack(
            [inverse_depth(image, place[:, i]) for i, image in enumerate(self.depth)], axis=1
        )
        return np.asarray(observed - (inverse_then - inverse_now)[..., 0])

    def depth_cost(self, delay_s: float) -> tuple[float, int]:
        """Robust cost of the depth images under a delay without a rolling shutter, and how many depths it sums."""
        now = self._in_camera(self._at(np.zeros_like(self.late)))
        error = (
            1 / np.maximum(now[..., 2], 1e-3) - self._depth_at(now, 0.0, delay_s)
        ) / self.noise[1]
        valid = np.isfinite(error)
        return float(np.log1p((error[valid] / CAUCHY) ** 2).sum()), int(valid.sum())

    def normal_equations(self, readout_s: float) -> _Reduced:
        """Gauss-Newton's normal equations about the state, the points eliminated."""
        L = len(self.xy)
        n = len(self.stamps)
        moment = self._at(self.late * readout_s)
        points = self._in_camera(moment)
        residuals = self._residuals(points)
        pixels, depth = self.noise
        error = np.hypot(residuals[..., 0], residuals[..., 1]) / pixels
        by_pixels = 1 / (pixels * np.sqrt(1 + (error / CAUCHY) ** 2))
        by_depth = 1 / (depth * np.sqrt(1 + (residuals[..., 2] / depth / CAUCHY) ** 2))
        weight = np.nan_to_num(np.stack([by_pixels, by_pixels, by_depth], axis=-1))
        x = points[..., 0]
        y = points[..., 1]
        z = np.maximum(points[..., 2], 1e-3)
        by_point = np.zeros((L, n, 3, 3))
        by_point[..., 0, 0] = self.camera.fx / z
        by_point[..., 0, 2] = -self.camera.fx * x / z**2
        by_point[..., 1, 1] = self.camera.fy / z
        by_point[..., 1, 2] = -self.camera.fy * y / z**2
        by_point[..., 2, 2] = -1 / z**2
        by_point *= weight[..., None]
        by_world = by_point @ moment.R
        # rotation, centre
        by_pose = np.concatenate([-by_point @ se3.hat(points), -by_world], axis=-1)
        moving = np.cross(moment.turning, points) - (moment.R @ moment.velocity[..., None])[..., 0]
        share = np.zeros((L, n, n))  # of each pose in the interpolated one
        np.put_along_axis(share, moment.nodes, moment.weights, axis=2)
        poses = np.delete(share, n // 2, axis=2)[:, :, None, :, None] * by_pose[:, :, :, None, :]
        by_shared = np.zeros((L, n, 3, 2))
        by_shared[..., 0] = (by_point @ moving[..., None])[..., 0] * self.late[..., None]
        by_shared[..., 2, 1] = -self.depth_drift * weight[..., 2]
        jacobian = np.concatenate([poses.reshape(L, n, 3, -1), by_shared], axis=-1)
        return _Reduced(
            jacobian.reshape(L, 3 * n, -1),
            by_world.reshape(L, 3 * n, 3),
            (np.nan_to_num(residuals) * weight).reshape(L, 3 * n),
        )

    def update(self, poses: Array, points: Array) -> None:
        """Move the state.

        Args:
            poses: ``[n - 1, 6]`` rotation vector (from the left) and centre of all poses but the
                middle one.
            points: ``[L, 3]``.
        """
        others = np.delete(np.arange(len(self.stamps)), len(self.stamps) // 2)
        self.R, self.centre = self.R.copy(), self.centre.copy()
        self.R[others] = _matrix(poses[:, :3]) @ self.R[others]
        self.centre[others] += poses[:, 3:]
        self.points = self.points + points


@dataclass(frozen=True, eq=False)
class _Moment:
    """The camera at times between frames, ``[L, n, ...]``.

    Attributes:
        R: World to camera.
        centre: In the world.
        turning: Rotation a second, in the camera.
        velocity: Of the centre, in the world.
        weights: Of the `nodes`, the frames that the pose is interpolated from.
        nodes: See `weights`.
        within: Whether the time is at most half a frame outside of the window.
    """

    R: Array
    centre: Array
    turning: Array
    velocity: Array
    weights: Array
    nodes: NDArray[np.intp]
    within: NDArray[np.bool_]


class _Reduced:
    """Normal equations of a window without its points: those of its poses, then readout time and delay.

    Args:
        J: Jacobian ``[L, k, m + 2]`` by the poses, readout time and delay, weighted.
        by_point: Jacobian ``[L, k, 3]`` by the points, weighted.
        r: Residuals ``[L, k]``, weighted.

    Attributes:
        information: Of readout and delay, the poses eliminated, ``[2, 2]``.
        slope: Of the cost by readout and delay alike ``[2]``.
    """

    def __init__(self, J: Array, by_point: Array, r: Array) -> None:
        turned = np.swapaxes(by_point, 1, 2)
        own = turned @ by_point
        own += (1e-6 * np.trace(own, axis1=1, axis2=2)[:, None, None] + 1e-9) * np.eye(3)
        self._inverse = np.linalg.inv(own)
        self._mixed = turned @ J
        self._pull = (turned @ r[..., None])[..., 0]
        columns = J.shape[-1]
        flat = J.reshape(-1, columns)
        carried = (self._inverse @ self._mixed).reshape(-1, columns)
        H = flat.T @ flat - self._mixed.reshape(-1, columns).T @ carried
        b = flat.T @ r.ravel() - carried.T @ self._pull.ravel()
        m = columns - 2
        damped = H[:m, :m] + 1e-9 * np.trace(H[:m, :m]) / m * np.eye(m)
        # of the poses
        self._response = np.linalg.solve(damped, np.column_stack([H[:m, m:], b[:m]]))
        self.information = H[m:, m:] - H[m:, :m] @ self._response[:, :2]
        self.slope = b[m:] - H[m:, :m] @ self._response[:, 2]

    def steps(self, shared: Array) -> tuple[Array, Array]:
        """Steps of the poses ``[n - 1, 6]`` and the points ``[L, 3]`` that go with steps ``[2]`` of what is shared."""
        poses = -self._response[:, 2] - self._response[:, :2] @ shared
        change = self._pull + self._mixed @ np.concatenate([poses, shared])
        return poses.reshape(-1, 6), -(self._inverse @ change[..., None])[..., 0]


def _matrix(turns: Array) -> Array:
    return Rotation.from_rotvec(turns.reshape(-1, 3)).as_matrix().reshape(*turns.shape, 3)


def _rotvec(R: Array) -> Array:
    return Rotation.from_matrix(R.reshape(-1, 3, 3)).as_rotvec().reshape(R.shape[:-1])


def _lagrange(nodes: Array, at: Array) -> tuple[Array, Array]:
    """Weights ``[..., k]`` of the nodes ``[..., k]`` of the interpolating polynomial at ``[...]``, and their slopes."""
    weights = np.ones_like(nodes)
    slopes = np.zeros_like(nodes)
    for j, m in permutations(range(nodes.shape[-1]), 2):
        span = nodes[..., j] - nodes[..., m]
        slopes[..., j] = (slopes[..., j] * (at - nodes[..., m]) + weights[..., j]) / span
        weights[..., j] *= (at - nodes[..., m]) / span
    return weights, slopes
