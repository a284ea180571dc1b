"""ORB features that are spread evenly over the image and the scales.

FAST corners (Rosten and Drummond, 2006) of each pyramid level are ranked by strength within the
cells of a grid. The strongest of every cell come first, then the second strongest, until the
level's share is full. Orientation is the intensity centroid and the descriptor the rotated BRIEF of
Rublee et al. (2011).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from dynslam_bench.contracts import Keypoints
from dynslam_bench.core import SettingsError
from dynslam_bench.core.compiled import kernel
from dynslam_bench.core.ordering import counting_sort
from dynslam_bench.features.brief import rotated_brief, smooth
from dynslam_bench.features.fast import EDGE, fast_corners
from dynslam_bench.features.settings import FeatureSettings
from dynslam_bench.geometry import inside

PATCH_RADIUS = 15
"""Radius of the disc whose intensity centroid gives the orientation, pixels of the level."""
PATCH_SIDE = 32
"""Rows and columns of the patch that is summed: the disc's 31, and one of zeros that makes whole vectors of it."""
# row and column of each pixel of the patch from the disc's centre, 0 outside the disc
_ROW, _COLUMN = np.mgrid[:PATCH_SIDE, :PATCH_SIDE].astype(np.int32) - PATCH_RADIUS
# columns and rows inside the disc: weights of the first moments
_IN_DISC = _ROW * _ROW + _COLUMN * _COLUMN <= PATCH_RADIUS * PATCH_RADIUS
_DISC_COLUMNS = _COLUMN * _IN_DISC
_DISC_ROWS = _ROW * _IN_DISC


@dataclass(frozen=True, eq=False)
class _Level:
    """One level of the pyramid and all its corners.

    Attributes:
        image: uint8 ``[h, w]``.
        scale: pixels of the given image a pixel of the level.
        xy: float32 ``[N, 2]``, pixels of the level.
        response: int16 ``[N]``, strengths.
        cells: int64 ``[N]``, cell of the grid that each lies in.
    """

    image: NDArray[np.uint8]
    scale: float
    xy: NDArray[np.float32]
    response: NDArray[np.int16]
    cells: NDArray[np.int64]


class OrbExtractor:
    """Finds oriented FAST corners and describes them with rotated BRIEF (32 bytes).

    Deterministic: the result depends on the image and the settings only.

    Args:
        settings: Number of features, pyramid, thresholds and grid.

    Raises:
        SettingsError: The second FAST threshold lies above the first.
    """

    def __init__(self, settings: FeatureSettings | None = None) -> None:
        settings = settings or FeatureSettings()
        least = settings.fast_threshold_min
        if least > settings.fast_threshold:
            raise SettingsError(
                f"fast_threshold_min is {least}, above fast_threshold {settings.fast_threshold}",
                "lower fast_threshold_min",
            )
        self.settings = settings

    def configure(self, settings: FeatureSettings) -> None:
        """Use other FAST thresholds and numbers; with a second threshold above the first, the second alone applies."""
        self.settings = settings

    def extract(self, gray: NDArray[np.uint8]) -> Keypoints:
        """The keypoints of a uint8 ``[H, W]`` image, ordered by level; none is an empty result."""
        levels = self._levels(gray)
        everywhere = [np.ones(len(level.xy), bool) for level in levels]
        return self._describe(levels, self._choose(levels, everywhere))

    def extract_masked(
        self, gray: NDArray[np.uint8], mask: NDArray[np.bool_], share: float
    ) -> Keypoints:
        """The keypoints of an image with enough of them outside a mask.

        Args:
            gray: uint8 ``[H, W]``.
            mask: bool ``[H, W]``, dynamic pixels.
            share: Least share of `n_features` outside the mask. With fewer, as many as `n_features`
                are extracted there, beside those inside that `extract` returns.
        """
        levels = self._levels(gray)
        everywhere = [np.ones(len(level.xy), bool) for level in levels]
        chosen = self._choose(levels, everywhere)

        # how many of the chosen corners lie outside the mask
        outside = [~inside(mask, level.xy * level.scale) for level in levels]
        count = 0
        for is_outside, index in zip(outside, chosen, strict=True):
            count += int(np.count_nonzero(is_outside[index]))

        # too few: those inside stay, those outside are chosen again among themselves
        if count < share * self.settings.n_features:
            chosen_outside = self._choose(levels, outside)
            chosen = [
                np.concatenate([index[~is_outside[index]], index_outside])
                for is_outside, index, index_outside in zip(
                    outside, chosen, chosen_outside, strict=True
                )
            ]
        return self._describe(levels, chosen)

    def _levels(self, gray: NDArray[np.uint8]) -> list[_Level]:
        """All corners of every level of the pyramid."""
        # until a level is too small for a corner with its patch
        image = gray = np.ascontiguousarray(gray, dtype=np.uint8)
        levels: list[_Level] = []
        for number in range(self.settings.levels):
            scale = self.settings.scale_factor**number
            size = round(gray.shape[1] / scale), round(gray.shape[0] / scale)
            if min(size) <= 2 * EDGE:
                break
            # each level is resized from the one before
            if number > 0:
                image = np.asarray(
                    cv2.resize(image, size, interpolation=cv2.INTER_LINEAR), dtype=np.uint8
                )
            levels.append(self._corners(image, scale))
        return levels

    def _choose(
        self, levels: Sequence[_Level], allowed: Sequence[NDArray[np.bool_]]
    ) -> list[NDArray[np.int64]]:
        """Indices of up to `n_features` allowed corners, by level, spread over the cells of each.

        A corner below the first threshold is taken only in a cell without a stronger one.
        """
        # from the coarsest level to the finest
        quotas = level_quotas(self.settings.n_features, len(levels), self.settings.scale_factor)
        chosen: list[NDArray[np.int64]] = []
        missing = 0
        coarse_to_fine = list(zip(levels, quotas, allowed, strict=True))[::-1]
        for level, quota, among in coarse_to_fine:
            # weak corners count in cells without a strong one
            strong = among & (level.response >= self.settings.fast_threshold)
            cells = level.cells.max(initial=0) + 1
            has_strong = np.bincount(level.cells[strong], minlength=cells) > 0
            eligible = strong | among & ~has_strong[level.cells]
            chosen.append(spread(level.cells, level.response, eligible, quota + missing))
            # a coarse level's missing features are added to the next finer level
            missing += quota - len(chosen[-1])
        return chosen[::-1]

    def _corners(self, image: NDArray[np.uint8], scale: float) -> _Level:
        """A level with its FAST corners, and the cell of the grid that each lies in."""
        # corners as flat indices of the image
        at, response = fast_corners(image, self.settings.fast_threshold_min)
        row, column = np.divmod(at, image.shape[1])
        # the grid begins at ORB-SLAM's border, FAST's radius of three pixels before the first corner
        cell = self.settings.cell_px
        origin = EDGE - 3
        # cells a row, rounded up
        columns = -(-(image.shape[1] - 2 * origin) // cell)
        cells = (row - origin) // cell * columns + (column - origin) // cell
        xy = np.stack([column, row], axis=1).astype(np.float32)
        return _Level(image, scale, xy, response, cells)

    def _describe(self, levels: Sequence[_Level], chosen: Sequence[NDArray[np.int64]]) -> Keypoints:
        """The keypoints of the chosen corners, indices by level, in pixels of the full image."""
        # rows of all levels after each other
        counts = [len(index) for index in chosen]
        octave = np.repeat(np.arange(len(levels), dtype=np.int32), counts)
        xy = np.empty((len(octave), 2))
        descriptors = np.empty((len(octave), 32), np.uint8)
        angle = np.empty(len(octave), np.float32)
        response = np.empty(len(octave), np.float32)
        end = 0
        for level, index in zip(levels, chosen, strict=True):
            # the level's corners: pixels of the full image, response, orientation and descriptor
            at = level.xy[index]
            rows = slice(end, end + len(index))
            end += len(index)
            xy[rows] = np.multiply(at, level.scale, dtype=np.float64)
            response[rows] = level.response[index]
            angle[rows] = orientations(level.image, at, _DISC_COLUMNS, _DISC_ROWS)
            descriptors[rows] = rotated_brief(smooth(level.image), at, angle[rows])
        return Keypoints(xy.astype(np.float32), octave, angle, response, descriptors)


def level_quotas(n_features: int, levels: int, scale_factor: float) -> list[int]:
    """Number of features of each level: in proportion to its side length, `n_features` in all."""
    # a level's share; what rounding down leaves goes to the finest
    shares = scale_factor ** -np.arange(levels, dtype=np.float64)
    quotas = np.floor(n_features * shares / shares.sum()).astype(int)
    quotas[:1] += n_features - quotas.sum()
    return list(map(int, quotas))


def spread(
    cells: NDArray[np.int64], response: NDArray[np.int16], allowed: NDArray[np.bool_], quota: int
) -> NDArray[np.int64]:
    """Choose points so that all cells get their share: first every cell's strongest, then the second strongest, ...

    Args:
        cells: Cell of each point ``[N]``.
        response: Strength of each point ``[N]``; equal strengths keep their order.
        allowed: bool ``[N]``, points that may be chosen.
        quota: How many points to choose at most.

    Returns:
        Indices of the chosen points, at most `quota`, in order of rank within the cell, then of
        strength.
    """
    index = np.flatnonzero(allowed)
    if len(index) == 0:
        return index
    # the strongest first
    weakness = response.max() - response[index].astype(np.int64)
    _, order = counting_sort(weakness, int(weakness.max()) + 1)
    index = index[order]
    # a point's rank is the number of stronger ones in its cell
    rank = _occurrences_before(cells[index], int(cells.max()) + 1)
    _, order = counting_sort(rank, int(rank.max()) + 1)
    return index[order[: max(quota, 0)]]


@kernel
def _occurrences_before(numbers: NDArray[np.int64], count: int) -> NDArray[np.int64]:
    """Count for each of the numbers ``[N]``, from 0 to `count` - 1, how often it occurs before."""
    # counted while the numbers are read in order
    occurred = np.zeros(count, np.int64)
    before = np.empty(len(numbers), np.int64)
    for i in range(len(numbers)):
        before[i] = occurred[numbers[i]]
        occurred[numbers[i]] += 1
    return before


@kernel
def orientations(
    image: NDArray[np.uint8],
    xy: NDArray[np.float32],
    columns: NDArray[np.int32],
    rows: NDArray[np.int32],
) -> NDArray[np.float32]:
    """Orientations of discs by their intensity centroid (Rublee et al., 2011, Section 3.2), degrees in [0, 360).

    Args:
        image: uint8 ``[H, W]``.
        xy: Integer-valued pixels, float32 ``[N, 2]``, more than the disc's radius away from the
            border.
        columns: int32 ``[PATCH_SIDE, PATCH_SIDE]``, column of each pixel of the disc from its
            centre; 0 outside ...
        rows: ... and its row.
    """
    out = np.zeros(len(xy), np.float32)
    # a constant number of turns would be unrolled, and no vector code made
    side = len(rows)
    for i in range(len(xy)):
        top = int(xy[i, 1]) - PATCH_RADIUS
        left = int(xy[i, 0]) - PATCH_RADIUS
        patch = image[top : top + side, left : left + side]
        # first moments of the grey levels, exact in 32 bits
        m10 = np.int32(0)
        m01 = np.int32(0)
        for row in range(side):
            for column in range(side):
                pixel = np.int32(patch[row, column])
                m10 = np.int32(m10 + pixel * columns[row, column])
                m01 = np.int32(m01 + pixel * rows[row, column])
        out[i] = math.degrees(math.atan2(float(m01), float(m10))) % 360.0
        # float32 may round up to 360
        if out[i] >= 360.0:
            out[i] = 0.0
    return out
