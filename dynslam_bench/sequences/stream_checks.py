"""Do the colour and depth images of a recording fit together? Statistics of single frames and of short stretches.

Contours of depth are contours in the colour image, too, at the same place and time. Their correlation over shifts,
mirrorings and delays says whether the depth is registered, which way up the images are, and whether the two streams
are synchronous.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from dynslam_bench.contracts.sequence import Frame


@dataclass(frozen=True)
class Finding:
    """One thing that a check of a recording found.

    Attributes:
        id: Stable name, for example ``truth-time-shift``.
        severity: ``fault``: results on the recording are wrong until it is mended; ``note``: good to know.
        value: The measured number; None where nothing is measured.
        unit: Its unit, for example ``s``; empty for a ratio or where nothing is measured.
        text: One line that says what was measured.
        cure: What to change, and in which file.
    """

    id: str
    severity: Literal["fault", "note"]
    value: float | None
    unit: str
    text: str
    cure: str


def fault(id: str, value: float | None, unit: str, text: str, cure: str) -> Finding:
    """A finding that makes results on the recording wrong."""
    return Finding(id, "fault", None if value is None else float(value), unit, text, cure)


Map = NDArray[np.float32]

MAP_WIDTH = 160
"""Width of the maps of contours, in cells; of an image 640 pixels wide a cell is 4 pixels."""
MOST_DELAY = 10
"""Largest delay between colour and depth that is looked for, in frames."""
FLIPS = {"": (1, 1), "upside down": (-1, 1), "mirrored": (1, -1), "turned by 180 degrees": (-1, -1)}


@dataclass(eq=False)
class Streams:
    """What is kept of the frames that were read, stretch by stretch.

    Attributes:
        depth_factor: Raw units a metre.
        seconds_a_frame: Median interval of the stamps.
        dark: How many frames have a colour image without contrast.
        empty: How many have no depth.
        medians: Median depth of each frame that has any, metres.
        colour_run: Most equal colour images in a row.
        depth_run: Most equal depth images in a row.
        rough: Median step between neighbouring raw depths relative to the depth, and the same with swapped bytes.
        contours: Of each stretch the maps of contours of its colour and of its depth images, both ``[N, H, W]``.
        cell_px: Pixels a cell of the maps.
    """

    depth_factor: float
    seconds_a_frame: float
    dark: int = 0
    empty: int = 0
    medians: list[float] = field(default_factory=list)
    colour_run: int = 1
    depth_run: int = 1
    rough: list[tuple[float, float]] = field(default_factory=list)
    contours: list[tuple[Map, Map]] = field(default_factory=list)
    cell_px: int = 1

    @property
    def frames(self) -> int:
        """How many frames were added."""
        return sum(len(colour) for colour, _ in self.contours)

    def add(self, stretch: list[Frame]) -> None:
        """Add consecutive frames of one size."""
        colour_maps, depth_maps = [], []
        self.cell_px = max(1, round(stretch[0].rgb.shape[1] / MAP_WIDTH))
        self.colour_run = max(self.colour_run, _longest_run([frame.rgb for frame in stretch]))
        self.depth_run = max(self.depth_run, _longest_run([frame.depth for frame in stretch]))
        for number, frame in enumerate(stretch):
            gray = np.asarray(cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2GRAY), np.uint8)
            valid = frame.depth[::4, ::4]
            valid = valid[valid > 0]
            self.dark += bool(gray.std() < 1.0)
            self.empty += bool(len(valid) < 100)
            if len(valid) >= 100:
                self.medians.append(float(np.median(valid)))
                if number % 5 == 0:
                    self.rough.append(_roughness(frame.depth, self.depth_factor))
            colour_maps.append(_standardised(_colour_contours(gray, self.cell_px)))
            depth_maps.append(_standardised(_depth_contours(frame.depth, self.cell_px)))
        self.contours.append((np.stack(colour_maps), np.stack(depth_maps)))


def _longest_run(images: list[NDArray[Any]]) -> int:
    """Most equal images in a row."""
    longest = run = 1
    for before, after in itertools.pairwise(images):
        run = run + 1 if np.array_equal(before, after) else 1
        longest = max(longest, run)
    return longest


def _correlation(colour: Map, depth: Map) -> Map:
    """Sum of the circular correlations ``[H, W]`` of maps of the colour with maps of the depth, both ``[N, H, W]``."""
    spectrum = (np.fft.rfft2(colour) * np.conj(np.fft.rfft2(depth))).sum(axis=0)
    return np.fft.irfft2(spectrum, s=colour.shape[1:]).astype(np.float32)


def _by_delay(streams: Streams, delays: Sequence[int]) -> tuple[Map, NDArray[np.intp]]:
    """Correlation of every second colour image with the depth so many frames later.

    Returns:
        Sums over all pairs ``[D, H, W]``, and how many pairs each sums ``[D]``.
    """
    shape = streams.contours[0][0].shape[1:]
    surfaces, pairs = np.zeros((len(delays), *shape), np.float32), np.zeros(len(delays), np.intp)
    for colour, depth in streams.contours:
        colours, depths = np.fft.rfft2(colour), np.conj(np.fft.rfft2(depth))
        for row, delay in enumerate(delays):
            index = np.arange(0, len(colour), 2)
            index = index[(index + delay >= 0) & (index + delay < len(depth))]
            spectrum = (colours[index] * depths[index + delay]).sum(axis=0)
            surfaces[row] += np.fft.irfft2(spectrum, s=shape).astype(np.float32)
            pairs[row] += len(index)
    return surfaces, pairs


def _roughness(depth: Map, factor: float) -> tuple[float, float]:
    raw = np.clip(np.round(depth[::2].astype(np.float64) * factor), 0, 65535).astype(np.uint16)
    both = (raw[:, 1:] > 0) & (raw[:, :-1] > 0)
    if both.sum() < 100:
        return np.nan, np.nan
    wide = np.stack([raw, raw.byteswap()]).astype(np.float64)
    steps = np.minimum(np.abs(np.diff(wide, axis=2)) / np.maximum(wide[:, :, 1:], 1), 1)[:, both].mean(axis=1)
    return float(steps[0]), float(steps[1])


def _colour_contours(gray: NDArray[np.uint8], cell: int) -> Map:
    small = cv2.resize(gray, (gray.shape[1] // cell, gray.shape[0] // cell), interpolation=cv2.INTER_AREA)
    wide = small.astype(np.float32)
    return np.asarray(np.sqrt(np.hypot(cv2.Sobel(wide, -1, 1, 0), cv2.Sobel(wide, -1, 0, 1))), np.float32)


def _depth_contours(depth: Map, cell: int) -> Map:
    """The step in depth around each cell, as a logarithm; missing depth is no contour."""
    rows, columns = depth.shape[0] // cell, depth.shape[1] // cell
    blocks = depth[: rows * cell, : columns * cell].reshape(rows, cell, columns, cell)
    around, least = np.ones((3, 3), np.uint8), np.where(blocks > 0, blocks, np.inf).min(axis=(1, 3))
    far, near = cv2.dilate(blocks.max(axis=(1, 3)), around), cv2.erode(least.astype(np.float32), around)
    valid = (far > 0) & np.isfinite(near)
    steps = np.log(np.where(valid, far / np.where(valid, near, 1), 1))
    return np.where(valid, np.minimum(steps, 0.3), 0).astype(np.float32)


def _standardised(values: Map) -> Map:
    """Without slow changes across the image, with zero mean and unit length."""
    sharp = values - cv2.blur(values, (25, 25))
    sharp -= sharp.mean()
    return np.asarray(sharp / max(float(np.linalg.norm(sharp)), 1e-9), np.float32)


FROZEN_FRAMES = 4
LEAST_SHIFT_PX = 14.0
"""A shift of the depth below this occurs in published data: 7-Scenes' depth is not registered to its colour."""
LEAST_DELAY = 2
"""In frames; the first Kinect's depth lags by nearly one."""
CLEAR_PEAK = 7.0
"""Of a correlation, in standard deviations over all shifts: what has nothing in common stays below 6."""
DEPTH_RANGE_M = (0.1, 60.0)


def stream_findings(streams: Streams, with_depth: bool = True) -> list[Finding]:
    """What is wrong with the images alone, the most basic fault first; what follows from a fault is not repeated.

    Args:
        streams: Statistics of the frames that were read.
        with_depth: Whether the sequence announces depth images.
    """
    for check in (_empty, _frozen, _swapped, _units, _flipped, _asynchronous, _shifted) if with_depth else (_empty,):
        finding = check(streams)
        if finding is not None and (with_depth or finding.id == "colour-blank"):
            return [finding]
    text = "the sequence has no depth images: only the colour images were checked"
    return [] if with_depth else [Finding("no-depth", "note", None, "", text, "add depth images to check more")]


def _empty(streams: Streams) -> Finding | None:
    for id, count, text, cure in (
        ("colour-blank", streams.dark, "colour images hold one brightness only", "record or export the colour again"),
        ("depth-empty", streams.empty, "depth images hold no depth",
         "record or export the depth again, or use trackers that need none"),
    ):  # fmt: skip
        if count >= 0.5 * streams.frames:
            return fault(id, count / streams.frames, "", f"{count} of {streams.frames} {text}", cure)
    return None


def _frozen(streams: Streams) -> Finding | None:
    colour, depth = streams.colour_run >= FROZEN_FRAMES, streams.depth_run >= FROZEN_FRAMES
    if colour == depth:  # a rendered camera at rest repeats both; the truth says whether it rests
        return None
    run, name, other = (streams.colour_run, "colour", "depth") if colour else (streams.depth_run, "depth", "colour")
    text = f"one {name} image is repeated in {run} or more successive frames while the {other} changes"
    return fault(f"{name}-frozen", run, "frames", text, f"export the {name} images again")


def _swapped(streams: Streams) -> Finding | None:
    stated, swapped = np.nanmedian(np.array(streams.rough or [(np.nan, np.nan)]), axis=0)
    if not swapped < stated / 3:
        return None
    text = (
        f"neighbouring depths differ by {100 * stated:.0f} % on average, by {100 * swapped:.1f} % with the bytes of "
        "each value swapped"
    )
    cure = "write the 16-bit depth images in the machine's byte order (PNG stores big-endian by itself)"
    return fault("depth-byte-order", stated, "", text, cure)


def _units(streams: Streams) -> Finding | None:
    median, factor = float(np.median(streams.medians)), streams.depth_factor
    if DEPTH_RANGE_M[0] <= median <= DEPTH_RANGE_M[1]:
        return None
    text = f"the median depth is {median:.3g} m with {factor:g} raw units a metre"
    likely = next((f for f in (1.0, 100.0, 1000.0, 5000.0) if 0.4 < median * factor / f < 8), factor)
    cure = f"set depth_factor in camera.toml (here perhaps {likely:g}), or store arrays in metres"
    return fault("depth-units", median, "m", text, cure)


def _flipped(streams: Streams) -> Finding | None:
    peaks = {}
    for name, (rows, columns) in FLIPS.items():
        parts = [_correlation(colour[::4], depth[::4, ::rows, ::columns]) for colour, depth in streams.contours]
        peaks[name] = _peak(np.sum(parts, axis=0), 8)[0]
    best = max(peaks, key=lambda name: peaks[name])
    if best == "" or peaks[best] < CLEAR_PEAK or peaks[best] < 1.4 * peaks[""]:
        return None
    text = (
        f"the colour images are {best} relative to the depth: contours agree by {peaks[best]:.0f} standard "
        f"deviations so, by {peaks['']:.0f} as stored"
    )
    return fault("colour-flipped", peaks[best], "sigma", text, "turn the colour images as the depth images are")


def _asynchronous(streams: Streams) -> Finding | None:
    rows = np.concatenate([_agreements(colour, depth) for colour, depth in streams.contours])
    pairs = np.isfinite(rows).sum(axis=0)
    usable = pairs >= max(10, 0.3 * len(rows))
    surfaces, _ = _by_delay(streams, range(-MOST_DELAY, MOST_DELAY + 1))
    peaks = np.array([_peak(surface, 30)[0] if good else 0.0 for surface, good in zip(surfaces, usable, strict=True)])
    mean = np.where(usable, np.nansum(rows, axis=0) / np.maximum(pairs, 1), -np.inf)
    column = int(np.argmax(mean))
    delay = float(column - MOST_DELAY)
    if abs(delay) < LEAST_DELAY or peaks[column] < CLEAR_PEAK:
        return None
    near = slice(MOST_DELAY - 1, MOST_DELAY + 2)
    reference = MOST_DELAY - 1 + int(np.argmax(mean[near]))
    better = rows[:, column] - rows[:, reference]
    better = better[np.isfinite(better)]
    sure = float(better.mean() / max(better.std() / np.sqrt(len(better) / 5), 1e-9))
    if sure < 4 or mean[column] < 1.25 * max(mean[reference], 0) or peaks[column] < 1.1 * peaks[near].max():
        return None
    around = mean[max(column - 1, 0) : column + 2]
    if len(around) == 3 and np.isfinite(around).all():  # the vertex of the parabola through the peak
        delay += float((around[0] - around[2]) / (2 * (around[0] - 2 * around[1] + around[2])))
    seconds = delay * streams.seconds_a_frame
    text = (
        f"the depth images fit the colour images of {abs(delay):.1f} frames {'before' if delay > 0 else 'after'} "
        f"({abs(seconds):.2f} s): their contours agree {mean[column] / max(mean[MOST_DELAY], 0.01):.1f} times as well"
    )
    cure = f"make the depth's stamps {abs(seconds):.3f} s {'earlier' if delay > 0 else 'later'} in depth.txt"
    return fault("depth-delay", seconds, "s", text, cure)


def _agreements(colour_maps: Map, depth_maps: Map) -> NDArray[np.float64]:
    """Correlation of the contours of each colour image with those of depth images before and after it.

    ``[N, 2 * MOST_DELAY + 1]``; NaN beyond the stretch.
    """
    colour, depth = (
        np.stack([cv2.GaussianBlur(contours, (0, 0), 1.0).ravel() for contours in maps])
        for maps in (colour_maps, depth_maps)
    )
    products, scores = colour @ depth.T, np.full((len(colour), 2 * MOST_DELAY + 1), np.nan)
    for column, delay in enumerate(range(-MOST_DELAY, MOST_DELAY + 1)):
        diagonal, first = np.diagonal(products, delay), max(0, -delay)
        scores[first : first + len(diagonal), column] = diagonal
    return scores


def _shifted(streams: Streams) -> Finding | None:
    sums, pairs = _by_delay(streams, (-1, 0, 1))
    middle = sums / np.maximum(pairs, 1)[:, None, None]
    peaks = [(*_peak(surface, 30), surface) for surface in middle]
    clear, (row, column), surface = max(peaks, key=lambda peak: float(peak[2][peak[1]]))
    shape = middle.shape[1:]
    down, right = (row + shape[0] // 2) % shape[0] - shape[0] // 2, (column + shape[1] // 2) % shape[1] - shape[1] // 2
    size = float(np.hypot(down, right)) * streams.cell_px
    rolled = np.roll(middle, (2, 2), (1, 2))[:, :5, :5]
    if size < LEAST_SHIFT_PX or clear < CLEAR_PEAK or surface[row, column] < 1.4 * rolled.max():
        return None
    text = (
        f"the depth lies {size:.0f} pixels beside the colour ({-right * streams.cell_px:+d} right, "
        f"{-down * streams.cell_px:+d} down)"
    )
    return fault("depth-not-registered", size, "px", text, "register the depth to the colour camera")


def _peak(surface: Map, reach: int) -> tuple[float, tuple[int, int]]:
    """Height in standard deviations and place of the peak within `reach` cells of no shift."""
    height, width = surface.shape
    reach_y, reach_x = min(reach, height // 2 - 1), min(reach, width // 2 - 1)
    near = np.roll(surface, (reach_y, reach_x), (0, 1))[: 2 * reach_y + 1, : 2 * reach_x + 1]
    y, x = np.unravel_index(int(near.argmax()), near.shape)
    deviation = (float(near[y, x]) - float(surface.mean())) / max(float(surface.std()), 1e-12)
    return deviation, ((int(y) - reach_y) % height, (int(x) - reach_x) % width)
