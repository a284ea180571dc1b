"""Do the colour and depth images of a recording fit together? Statistics of single frames and of short stretches.

Contours of depth are contours in the colour image, too, at the same place and time. Their
correlation over shifts, mirrorings and delays says whether the depth is registered, which way up
the images are, and whether the two streams are synchronous.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from dynslam_bench.contracts import Frame
from dynslam_bench.sequences.findings import Finding, finding_of
from dynslam_bench.sequences.readers.recorded import DEPTH_RANGE_M, likely_factor

Map = NDArray[np.float32]

MAP_WIDTH = 160
"""Width of the contour maps, in cells; of an image 640 pixels wide a cell is 4 pixels."""
MOST_DELAY = 10
"""Largest delay between colour and depth that is looked for, in frames."""
FLIPS = {"": (1, 1), "upside down": (-1, 1), "mirrored": (1, -1), "turned by 180 degrees": (-1, -1)}
"""Steps along rows and columns that undo each way in which the colour can be flipped."""
FROZEN_FRAMES = 4
"""So many equal images in a row count as a frozen stream."""
LEAST_SHIFT_PX = 14.0
"""A shift of the depth below this occurs in published data: 7-Scenes' depth is not registered to its colour."""
LEAST_DELAY = 2
"""In frames; the first Kinect's depth lags by nearly one."""
CLEAR_PEAK = 7.0
"""Height of a clear correlation peak, in standard deviations over all shifts: unrelated maps stay below 6."""
_PEAK_REACH = 30
"""Cells from no shift within which a correlation's peak is looked for."""


@dataclass(eq=False)
class ImageStatistics:
    """Statistics of the frames that were read, collected stretch by stretch.

    Attributes:
        depth_factor: Raw units a metre.
        seconds_a_frame: Median interval of the stamps.
        blank: How many frames have a colour image without contrast.
        empty: How many have no depth.
        medians: Median depth of each frame that has any, metres.
        colour_run: Most equal colour images in a row.
        depth_run: Most equal depth images in a row.
        roughness: Mean step between neighbouring raw depths relative to the depth, of every fifth
            depth image: as stored, and with swapped bytes.
        contours: Contour maps of the colour images and of the depth images, both ``[N, H, W]``, one
            pair a stretch.
        cell_px: Pixels a cell of the maps.
    """

    depth_factor: float
    seconds_a_frame: float
    blank: int = 0
    empty: int = 0
    medians: list[float] = field(default_factory=list)
    colour_run: int = 1
    depth_run: int = 1
    roughness: list[tuple[float, float]] = field(default_factory=list)
    contours: list[tuple[Map, Map]] = field(default_factory=list)
    cell_px: int = 1

    @property
    def frames(self) -> int:
        """Number of frames that were added."""
        return sum(len(colour) for colour, _ in self.contours)

    def add(self, stretch: list[Frame]) -> None:
        """Add consecutive frames of one size."""
        # images without contrast or depth
        grays = [
            np.asarray(cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2GRAY), np.uint8) for frame in stretch
        ]
        depths = [frame.depth for frame in stretch]
        self.blank += sum(bool(gray.std() < 1.0) for gray in grays)
        self._add_depths(depths)

        # images that are repeated
        self.colour_run = max(self.colour_run, _longest_run([frame.rgb for frame in stretch]))
        self.depth_run = max(self.depth_run, _longest_run(depths))

        # contours of both streams
        self.cell_px = max(1, round(stretch[0].rgb.shape[1] / MAP_WIDTH))
        colour_maps = [_standardised(_colour_contours(gray, self.cell_px)) for gray in grays]
        depth_maps = [_standardised(_depth_contours(depth, self.cell_px)) for depth in depths]
        self.contours.append((np.stack(colour_maps), np.stack(depth_maps)))

    def _add_depths(self, depths: list[Map]) -> None:
        """Add the statistics of single depth images: their medians, and of every fifth the roughness."""
        for i, depth in enumerate(depths):
            sampled = depth[::4, ::4]
            measured = sampled[sampled > 0]
            if len(measured) < 100:
                self.empty += 1
                continue
            self.medians.append(float(np.median(measured)))
            if i % 5 == 0:
                self.roughness.append(_roughness(depth, self.depth_factor))


def _longest_run(images: list[NDArray[Any]]) -> int:
    """Most equal images in a row."""
    longest = run = 1
    for before, after in itertools.pairwise(images):
        run = run + 1 if np.array_equal(before, after) else 1
        longest = max(longest, run)
    return longest


def _roughness(depth: Map, factor: float) -> tuple[float, float]:
    """Mean step between neighbouring raw depths relative to the depth, as stored and with swapped bytes.

    NaN where few neighbours have depth. A surface is smooth; with its bytes swapped it is noise.
    """
    # raw values of every second row, as they were stored
    metric = depth[::2].astype(np.float64)
    raw = np.clip(np.round(metric * factor), 0, 65535).astype(np.uint16)
    both = (raw[:, 1:] > 0) & (raw[:, :-1] > 0)
    if both.sum() < 100:
        return np.nan, np.nan

    # steps along the rows in either byte order, at most 100 %
    readings = np.stack([raw, raw.byteswap()]).astype(np.float64)
    steps = np.abs(np.diff(readings, axis=2)) / np.maximum(readings[:, :, 1:], 1)
    stored, swapped = np.minimum(steps, 1)[:, both].mean(axis=1)
    return float(stored), float(swapped)


# Contour maps.


def _colour_contours(gray: NDArray[np.uint8], cell: int) -> Map:
    """Square root of the brightness gradient ``[H, W]``, one value a cell of `cell` pixels."""
    # the mean of each cell, and its gradient
    size = (gray.shape[1] // cell, gray.shape[0] // cell)
    small = cv2.resize(gray, size, interpolation=cv2.INTER_AREA).astype(np.float32)
    gradient = np.hypot(cv2.Sobel(small, -1, 1, 0), cv2.Sobel(small, -1, 0, 1))
    return np.asarray(np.sqrt(gradient), np.float32)


def _depth_contours(depth: Map, cell: int) -> Map:
    """The step in depth around each cell, as a logarithm ``[H, W]``; missing depth is no contour."""
    rows = depth.shape[0] // cell
    columns = depth.shape[1] // cell
    blocks = depth[: rows * cell, : columns * cell].reshape(rows, cell, columns, cell)
    # the farthest and the nearest depth of each cell and its eight neighbours.
    around = np.ones((3, 3), np.uint8)
    least = np.where(blocks > 0, blocks, np.inf).min(axis=(1, 3))
    far = cv2.dilate(blocks.max(axis=(1, 3)), around)
    near = cv2.erode(least.astype(np.float32), around)
    valid = (far > 0) & np.isfinite(near)
    steps = np.log(np.where(valid, far / np.where(valid, near, 1), 1))
    return np.where(valid, np.minimum(steps, 0.3), 0).astype(np.float32)


def _standardised(values: Map) -> Map:
    """A map without slow changes across the image, with zero mean and unit length."""
    sharp = values - cv2.blur(values, (25, 25))
    sharp -= sharp.mean()
    return np.asarray(sharp / max(float(np.linalg.norm(sharp)), 1e-9), np.float32)


# Correlations of contour maps, by the Fourier transform: circular, over all shifts at once.


def _correlation(colour: Map, depth: Map) -> Map:
    """Sum of the circular correlations ``[H, W]`` of maps of the colour with maps of the depth, both ``[N, H, W]``."""
    spectrum = (np.fft.rfft2(colour) * np.conj(np.fft.rfft2(depth))).sum(axis=0)
    return np.fft.irfft2(spectrum, s=colour.shape[1:]).astype(np.float32)


def _correlations_by_delay(
    statistics: ImageStatistics, delays: range
) -> tuple[Map, NDArray[np.intp]]:
    """Correlation of every second colour image with the depth image some frames later, for each delay.

    Returns:
        Sums over all pairs of images ``[D, H, W]``, and how many pairs each sums ``[D]``.
    """
    shape = statistics.contours[0][0].shape[1:]
    surfaces = np.zeros((len(delays), *shape), np.float32)
    pairs = np.zeros(len(delays), np.intp)
    for colour, depth in statistics.contours:
        # by the correlation theorem, for all pairs of images with this delay
        colour_spectra = np.fft.rfft2(colour)
        depth_spectra = np.conj(np.fft.rfft2(depth))
        for row, delay in enumerate(delays):
            index = np.arange(0, len(colour), 2)
            index = index[(index + delay >= 0) & (index + delay < len(depth))]
            spectrum = (colour_spectra[index] * depth_spectra[index + delay]).sum(axis=0)
            surfaces[row] += np.fft.irfft2(spectrum, s=shape).astype(np.float32)
            pairs[row] += len(index)
    return surfaces, pairs


def _scores_by_delay(colour_maps: Map, depth_maps: Map) -> NDArray[np.float64]:
    """Correlation of the contours of each colour image with those of depth images before and after it, unshifted.

    ``[N, 2 * MOST_DELAY + 1]``; NaN beyond the stretch.
    """
    colour = _blurred_rows(colour_maps)
    depth = _blurred_rows(depth_maps)
    # all pairs of images at once; those of one delay lie on a diagonal
    products = colour @ depth.T
    scores = np.full((len(colour), 2 * MOST_DELAY + 1), np.nan)
    for column, delay in enumerate(range(-MOST_DELAY, MOST_DELAY + 1)):
        diagonal = np.diagonal(products, delay)
        first = max(0, -delay)
        scores[first : first + len(diagonal), column] = diagonal
    return scores


def _blurred_rows(maps: Map) -> Map:
    """Each blurred map ``[H, W]`` as one row ``[N, H * W]``."""
    return np.stack([cv2.GaussianBlur(contours, (0, 0), 1.0).ravel() for contours in maps])


def _peak(surface: Map, reach: int) -> tuple[float, tuple[int, int]]:
    """Height in standard deviations and place (row, column) of the peak within `reach` cells of no shift."""
    # shifts near 0 lie in all four corners of a circular correlation: roll them together
    height, width = surface.shape
    reach_y = min(reach, height // 2 - 1)
    reach_x = min(reach, width // 2 - 1)
    near = np.roll(surface, (reach_y, reach_x), (0, 1))[: 2 * reach_y + 1, : 2 * reach_x + 1]
    y, x = np.unravel_index(int(near.argmax()), near.shape)
    deviation = (float(near[y, x]) - float(surface.mean())) / max(float(surface.std()), 1e-12)
    return deviation, ((int(y) - reach_y) % height, (int(x) - reach_x) % width)


# The checks, each with its finding or None.


def image_findings(statistics: ImageStatistics, with_depth: bool = True) -> list[Finding]:
    """Findings on the images alone, the most basic fault first; what follows from a fault is not repeated.

    Args:
        statistics: Statistics of the frames that were read.
        with_depth: Whether the sequence announces depth images.
    """
    if not with_depth:
        finding = _check_empty(statistics)
        if finding is not None and finding.id == "colour-blank":
            return [finding]
        return [finding_of("no-depth", None)]
    for check in _CHECKS:
        finding = check(statistics)
        if finding is not None:
            return [finding]
    return []


def _check_empty(statistics: ImageStatistics) -> Finding | None:
    """Colour images without contrast, or depth images without depth."""
    for id, count in (("colour-blank", statistics.blank), ("depth-empty", statistics.empty)):
        if count >= 0.5 * statistics.frames:
            share = count / statistics.frames
            return finding_of(id, share, count=count, frames=statistics.frames)
    return None


def _check_frozen(statistics: ImageStatistics) -> Finding | None:
    """One image that is repeated while the other stream changes."""
    colour = statistics.colour_run >= FROZEN_FRAMES
    depth = statistics.depth_run >= FROZEN_FRAMES
    # a rendered camera at rest repeats both; the truth says whether it rests.
    if colour == depth:
        return None
    if colour:
        return finding_of("colour-frozen", statistics.colour_run)
    return finding_of("depth-frozen", statistics.depth_run)


def _check_byte_order(statistics: ImageStatistics) -> Finding | None:
    """Depth that is much smoother with the bytes of each value swapped."""
    roughness = np.array(statistics.roughness or [(np.nan, np.nan)])
    stored, swapped = np.nanmedian(roughness, axis=0)
    if not swapped < stored / 3:
        return None
    return finding_of("depth-byte-order", stored, stated=100 * stored, swapped=100 * swapped)


def _check_units(statistics: ImageStatistics) -> Finding | None:
    """A median depth outside of `DEPTH_RANGE_M`."""
    median = float(np.median(statistics.medians))
    factor = statistics.depth_factor
    if DEPTH_RANGE_M[0] <= median <= DEPTH_RANGE_M[1]:
        return None
    likely = likely_factor(median * factor) or factor
    return finding_of("depth-units", median, factor=factor, likely=likely)


def _check_flipped(statistics: ImageStatistics) -> Finding | None:
    """Colour images whose contours fit the depth's only upside down, mirrored or both."""
    # the peak of the correlation with the depth turned in each way
    peaks = {}
    for name, (rows, columns) in FLIPS.items():
        surfaces = [
            _correlation(colour[::4], depth[::4, ::rows, ::columns])
            for colour, depth in statistics.contours
        ]
        peaks[name], _ = _peak(np.sum(surfaces, axis=0), 8)
    best = max(peaks, key=lambda name: peaks[name])
    if best == "" or peaks[best] < CLEAR_PEAK or peaks[best] < 1.4 * peaks[""]:
        return None
    return finding_of("colour-flipped", peaks[best], how=best, stored=peaks[""])


def _check_delay(statistics: ImageStatistics) -> Finding | None:
    """Depth images that fit colour images of some frames before or after."""
    # agreement of the contours by delay: of each image ``[N, D]``, and on average ``[D]``.
    scores = np.concatenate(
        [_scores_by_delay(colour, depth) for colour, depth in statistics.contours]
    )
    pairs = np.isfinite(scores).sum(axis=0)
    usable = pairs >= max(10, 0.3 * len(scores))
    mean = np.where(usable, np.nansum(scores, axis=0) / np.maximum(pairs, 1), -np.inf)
    column = int(np.argmax(mean))
    delay = float(column - MOST_DELAY)

    # the best delay needs a clear peak over all shifts of the image, too.
    surfaces, _ = _correlations_by_delay(statistics, range(-MOST_DELAY, MOST_DELAY + 1))
    peaks = np.zeros(len(surfaces))
    for i, surface in enumerate(surfaces):
        if usable[i]:
            peaks[i], _ = _peak(surface, _PEAK_REACH)
    if abs(delay) < LEAST_DELAY or peaks[column] < CLEAR_PEAK:
        return None
    if not _is_better_delay(scores, mean, peaks, column):
        return None

    # the delay to a fraction of a frame
    delay += _vertex(mean, column)
    seconds = delay * statistics.seconds_a_frame
    side, change = ("before", "earlier") if delay > 0 else ("after", "later")
    return finding_of(
        "depth-delay",
        seconds,
        delay=abs(delay),
        s=abs(seconds),
        side=side,
        change=change,
        better=mean[column] / max(mean[MOST_DELAY], 0.01),
    )


def _is_better_delay(
    scores: NDArray[np.float64],
    mean: NDArray[np.float64],
    peaks: NDArray[np.float64],
    column: int,
) -> bool:
    """Whether a delay fits clearly better than the best of no delay and one frame to either side.

    Args:
        scores: Agreement of each image by delay ``[N, D]``.
        mean: Mean agreement by delay ``[D]``.
        peaks: Peak of the correlation by delay ``[D]``, in standard deviations.
        column: Index of the delay.
    """
    near = slice(MOST_DELAY - 1, MOST_DELAY + 2)
    reference = MOST_DELAY - 1 + int(np.argmax(mean[near]))
    gain = scores[:, column] - scores[:, reference]
    gain = gain[np.isfinite(gain)]
    # five successive images count as one observation.
    sigmas = float(gain.mean() / max(gain.std() / np.sqrt(len(gain) / 5), 1e-9))
    if sigmas < 4 or mean[column] < 1.25 * max(mean[reference], 0):
        return False
    return bool(peaks[column] >= 1.1 * peaks[near].max())


def _vertex(values: NDArray[np.float64], column: int) -> float:
    """Offset from `column` of the vertex of the parabola through the peak there; 0 at the ends."""
    around = values[max(column - 1, 0) : column + 2]
    if len(around) < 3 or not np.isfinite(around).all():
        return 0.0
    return float((around[0] - around[2]) / (2 * (around[0] - 2 * around[1] + around[2])))


def _check_registration(statistics: ImageStatistics) -> Finding | None:
    """Depth that lies beside the colour by some pixels."""
    # mean correlation ``[3, H, W]`` with the depth one frame before, the same and one frame later.
    sums, pairs = _correlations_by_delay(statistics, range(-1, 2))
    surfaces = sums / np.maximum(pairs, 1)[:, None, None]
    peaks = [_peak(surface, _PEAK_REACH) for surface in surfaces]
    heights = [float(surface[place]) for surface, (_, place) in zip(surfaces, peaks, strict=True)]
    best = heights.index(max(heights))
    clear, (row, column) = peaks[best]

    # the shift of the highest peak, from cells of a circular correlation to signed pixels.
    height, width = surfaces.shape[1:]
    down = (row + height // 2) % height - height // 2
    right = (column + width // 2) % width - width // 2
    size_px = float(np.hypot(down, right)) * statistics.cell_px
    unshifted = np.roll(surfaces, (2, 2), (1, 2))[:, :5, :5].max()
    if size_px < LEAST_SHIFT_PX or clear < CLEAR_PEAK:
        return None
    if surfaces[best][row, column] < 1.4 * unshifted:
        return None
    return finding_of(
        "depth-not-registered",
        size_px,
        right=-right * statistics.cell_px,
        down=-down * statistics.cell_px,
    )


_CHECKS: tuple[Callable[[ImageStatistics], Finding | None], ...] = (
    _check_empty,
    _check_frozen,
    _check_byte_order,
    _check_units,
    _check_flipped,
    _check_delay,
    _check_registration,
)
"""The most basic fault first; the first that is found ends the checks."""
