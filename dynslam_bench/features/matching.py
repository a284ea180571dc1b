"""Matching of binary descriptors: Hamming distances, brute force, search in a radius, rotation consistency.

Descriptors are compared as 64-bit words (`as_words`); rows of equal length are comparable, whatever
the extractor. All functions are pure and deterministic; ties are broken by the lower index.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.core.compiled import Scalar, inlined_statements, kernel
from dynslam_bench.core.ordering import counting_sort

Words = NDArray[np.uint64]

# masks of every other bit, pair of bits and half byte, and a one in every byte
_BITS = np.uint64(0x5555555555555555)
_PAIRS = np.uint64(0x3333333333333333)
_HALF_BYTES = np.uint64(0x0F0F0F0F0F0F0F0F)
_EVERY_BYTE = np.uint64(0x0101010101010101)
# shifts; numba adds a signed and an unsigned integer as floats
_ONE = np.uint64(1)
_TWO = np.uint64(2)
_FOUR = np.uint64(4)
_HIGHEST_BYTE = np.uint64(56)

FAR = 1 << 20
"""A distance above that of any two descriptors."""


def as_words(descriptors: NDArray[np.uint8]) -> Words:
    """Packed descriptors uint8 ``[N, B]`` as uint64 ``[N, ceil(B / 8)]``, padded with zero bits."""
    count, length = descriptors.shape
    padded = np.zeros((count, -(-length // 8) * 8), np.uint8)
    padded[:, :length] = descriptors
    return padded.view(np.uint64)


@inlined_statements
def distance(a: Words, b: Words) -> Scalar:
    """Hamming distance of two descriptors ``[W]``; for use inside compiled kernels."""
    total = np.int64(0)
    for w in range(a.shape[0]):
        # number of ones in the word: counted in pairs, half bytes and bytes, then the bytes added up
        v = a[w] ^ b[w]
        v = v - ((v >> _ONE) & _BITS)
        v = (v & _PAIRS) + ((v >> _TWO) & _PAIRS)
        v = (v + (v >> _FOUR)) & _HALF_BYTES
        total += np.int64((v * _EVERY_BYTE) >> _HIGHEST_BYTE)
    return total


@kernel
def _brute_force(
    a: Words, b: Words
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Compare all with all.

    Returns:
        For each of `a` ``[N]``: the nearest of `b`, its distance and the second nearest's; for each
        of `b` ``[M]``: the nearest of `a`.
    """
    # nothing is matched yet, and everything is `FAR`
    n = a.shape[0]
    m = b.shape[0]
    nearest = np.full(n, -1, np.int64)
    distances = np.full(n, FAR, np.int64)
    second_distances = np.full(n, FAR, np.int64)
    nearest_in_a = np.full(m, -1, np.int64)
    distances_in_a = np.full(m, FAR, np.int64)
    for i in range(n):
        for j in range(m):
            d = distance(a[i], b[j])
            # nearest and second nearest of b; of equal ones the lower index
            if d < distances[i]:
                second_distances[i] = distances[i]
                distances[i] = d
                nearest[i] = j
            elif d < second_distances[i]:
                second_distances[i] = d
            # nearest of a
            if d < distances_in_a[j]:
                distances_in_a[j] = d
                nearest_in_a[j] = i
    return nearest, distances, second_distances, nearest_in_a


def match_brute_force(
    a: Words, b: Words, *, max_distance: int = 64, ratio: float = 0.8
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Nearest neighbours among all descriptors.

    Args:
        a: Descriptors ``[N, W]``.
        b: Descriptors ``[M, W]``.
        max_distance: Largest Hamming distance of a match.
        ratio: The nearest must be nearer than `ratio` times the second nearest, and nearest in both
            directions.

    Returns:
        Indices into `a` and indices into `b` of the matches, ordered by the first.
    """
    if not len(a) or not len(b):
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    nearest, distances, second_distances, nearest_in_a = _brute_force(
        np.ascontiguousarray(a), np.ascontiguousarray(b)
    )
    # near enough, nearer than the second (Lowe's ratio test), and nearest in both directions
    mutual = nearest_in_a[nearest] == np.arange(len(a))
    distinct = distances < ratio * second_distances
    index = np.flatnonzero((distances <= max_distance) & distinct & mutual)
    return index, nearest[index]


@dataclass(frozen=True, eq=False)
class CellGrid:
    """Keypoints sorted into cells, for searches in a radius.

    Attributes:
        cell: Side of a cell, pixels.
        columns: Cells in a row.
        rows: Rows of cells.
        start: int64 ``[rows * columns + 1]``, where each cell's keypoints begin in `order`.
        order: int64 ``[N]``, keypoints sorted by cell, then by index.
    """

    cell: float
    columns: int
    rows: int
    start: NDArray[np.int64]
    order: NDArray[np.int64]

    @classmethod
    def of(cls, xy: NDArray[np.float64], width: int, height: int, cell: float = 20.0) -> CellGrid:
        """Sort the points ``[N, 2]`` into cells; points outside the image go to the nearest border cell."""
        columns = max(1, int(np.ceil(width / cell)))
        rows = max(1, int(np.ceil(height / cell)))
        return cls(cell, columns, rows, *_sorted_into_cells(xy, cell, columns, rows))


@kernel
def _sorted_into_cells(
    xy: NDArray[np.float64], cell: float, columns: int, rows: int
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """`CellGrid.start` and `CellGrid.order`.

    Args:
        xy: Pixels ``[N, 2]``.
        cell: Side of a cell, pixels.
        columns: Cells in a row.
        rows: Rows of cells.
    """
    cells = np.empty(len(xy), np.int64)
    for i in range(len(xy)):
        # the cell of the point; the border cells take what lies outside
        column = min(max(xy[i, 0] // cell, 0), columns - 1)
        row = min(max(xy[i, 1] // cell, 0), rows - 1)
        cells[i] = int(row) * columns + int(column)
    return counting_sort(cells, rows * columns)


class Features(NamedTuple):
    """Features to search among, with the attributes that the back end's `Observations` have as well.

    Attributes:
        xy: Undistorted pixels ``[N, 2]``.
        right: Columns in the right image ``[N]``, pixels; NaN without depth.
        octave: int64 ``[N]``.
        descriptors: uint64 ``[N, W]``.
        grid: Cells of the features.
    """

    xy: NDArray[np.float64]
    right: NDArray[np.float64]
    octave: NDArray[np.int64]
    descriptors: Words
    grid: CellGrid


class _SearchFeatures(NamedTuple):
    """`Features` and their grid as kernels read them.

    Attributes:
        cell: Side of a cell, pixels.
        columns: Cells in a row.
        rows: Rows of cells.
        start: `CellGrid.start`.
        order: `CellGrid.order`.
        xy: float64 ``[N, 2]``, undistorted pixels.
        right: float64 ``[N]``, columns in the right image; NaN without depth.
        octave: int64 ``[N]``.
        descriptors: uint64 ``[N, W]``.
        free: bool ``[N]``, features that may be matched.
    """

    cell: float
    columns: int
    rows: int
    start: NDArray[np.int64]
    order: NDArray[np.int64]
    xy: NDArray[np.float64]
    right: NDArray[np.float64]
    octave: NDArray[np.int64]
    descriptors: Words
    free: NDArray[np.bool_]


class _SearchTargets(NamedTuple):
    """Positions, search radii and descriptors that features are searched for.

    Attributes:
        xy: float64 ``[M, 2]``, expected pixels.
        right: float64 ``[M]``, expected columns in the right image; NaN is not compared.
        radius: float64 ``[M]``, half sides of the search windows, pixels.
        octave_low: int64 ``[M]``, lowest octave of a match.
        octave_high: int64 ``[M]``, highest.
        descriptors: uint64 ``[M, W]``.
    """

    xy: NDArray[np.float64]
    right: NDArray[np.float64]
    radius: NDArray[np.float64]
    octave_low: NDArray[np.int64]
    octave_high: NDArray[np.int64]
    descriptors: Words


@kernel
def _search(
    features: _SearchFeatures, targets: _SearchTargets, max_distance: int, ratio: float
) -> NDArray[np.int64]:
    """Index of the feature that each target is matched to ``[M]``, -1 without; see `search_in_radius`.

    Args:
        features: Features to choose from.
        targets: Where and with which descriptors they are looked for.
        max_distance: Largest Hamming distance of a match.
        ratio: Nearest over second nearest distance up to which a match is distinct.
    """
    # short names for the loops
    cell = features.cell
    columns = features.columns
    rows = features.rows
    start = features.start
    xy = features.xy
    right = features.right
    octave = features.octave

    # no target has a feature yet
    count = targets.xy.shape[0]
    match = np.full(count, -1, np.int64)
    match_distance = np.full(count, FAR, np.int64)
    # the target that a feature is matched to
    owner = np.full(xy.shape[0], -1, np.int64)
    for i in range(count):
        # the cells that the window covers
        x = targets.xy[i, 0]
        y = targets.xy[i, 1]
        r = targets.radius[i]
        target_right = targets.right[i]
        c0 = int((x - r) // cell)
        c1 = int((x + r) // cell)
        r0 = int((y - r) // cell)
        r1 = int((y + r) // cell)
        c0 = min(max(c0, 0), columns - 1)
        c1 = min(max(c1, 0), columns - 1)
        r0 = min(max(r0, 0), rows - 1)
        r1 = min(max(r1, 0), rows - 1)

        # nearest and second nearest descriptor among the features in the window
        best = -1
        first = FAR
        second = FAR
        first_octave = -1
        second_octave = -2
        for row in range(r0, r1 + 1):
            # a row's cells follow each other, and so do their features
            for k in range(start[row * columns + c0], start[row * columns + c1 + 1]):
                j = features.order[k]
                if not features.free[j]:
                    continue
                if octave[j] < targets.octave_low[i] or octave[j] > targets.octave_high[i]:
                    continue
                if abs(xy[j, 0] - x) > r or abs(xy[j, 1] - y) > r:
                    continue
                # right columns are compared where both are known: NaN is not equal to itself
                if right[j] == right[j] and target_right == target_right:
                    if abs(right[j] - target_right) > r:
                        continue
                d = distance(targets.descriptors[i], features.descriptors[j])
                if d < first:
                    second = first
                    second_octave = first_octave
                    first = d
                    first_octave = octave[j]
                    best = j
                elif d < second:
                    second = d
                    second_octave = octave[j]

        # ratio test, where both come from one octave
        if best < 0 or first > max_distance:
            continue
        if ratio < 1.0 and first_octave == second_octave and first > ratio * second:
            continue

        # where another target has the feature, the smaller distance wins
        rival = owner[best]
        if rival >= 0:
            if match_distance[rival] <= first:
                continue
            match[rival] = -1
        owner[best] = i
        match[i] = best
        match_distance[i] = first
    return match


def search_in_radius(
    features: Any,
    free: NDArray[np.bool_],
    windows: tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]],
    octave: NDArray[np.int64],
    descriptors: Words,
    *,
    max_distance: int,
    ratio: float = 1.0,
) -> NDArray[np.int64]:
    """For each target, the feature nearby whose descriptor is nearest; a feature is matched once at most.

    Args:
        features: `Features`, or anything with their attributes.
        free: bool ``[N]``, features that may be matched.
        windows: Expected pixels ``[M, 2]``, expected right coordinates ``[M]`` (NaN: not compared)
            and half sides of the search windows ``[M]``, pixels.
        octave: Expected octaves ``[M]``; the feature's may be one off.
        descriptors: uint64 ``[M, W]``, those of the targets.
        max_distance: Largest Hamming distance of a match.
        ratio: Nearest over second nearest, tested where both come from one octave; 1 switches the
            test off.

    Returns:
        int64 ``[M]``, matched feature or -1. Where two targets claim one feature the smaller
        distance wins, then the lower index.
    """
    # compiled code reads named tuples
    grid = features.grid
    searched = _SearchFeatures(
        cell=grid.cell,
        columns=grid.columns,
        rows=grid.rows,
        start=grid.start,
        order=grid.order,
        xy=features.xy,
        right=features.right,
        octave=features.octave,
        descriptors=features.descriptors,
        free=free,
    )
    xy, right, radius = windows
    targets = _SearchTargets(xy, right, radius, octave - 1, octave + 1, descriptors)
    return _search(searched, targets, max_distance, ratio)


def rotation_consistent(
    angle_a: NDArray[np.floating],
    angle_b: NDArray[np.floating],
    *,
    bins: int = 30,
    share: float = 0.1,
) -> NDArray[np.bool_]:
    """Flag matches that agree with the rotation in the image plane that most matches show.

    Args:
        angle_a: Keypoint orientations in the one image, degrees ``[N]``.
        angle_b: Keypoint orientations in the other, degrees ``[N]``.
        bins: Number of bins of the histogram of differences.
        share: The second and third fullest bin count only if they hold at least this share of the
            fullest one.

    Returns:
        bool ``[N]``, True for matches in the (up to three) fullest bins.
    """
    # histogram of the differences of orientation
    difference = np.mod(np.asarray(angle_a, np.float64) - np.asarray(angle_b, np.float64), 360.0)
    index = (difference * (bins / 360.0)).round().astype(np.int64) % bins
    counts = np.bincount(index, minlength=bins)
    # the three fullest bins, if they hold enough matches
    top = np.argsort(-counts, kind="stable")[:3]
    good = top[counts[top] >= max(1.0, share * counts[top[0]])]
    return np.asarray(np.isin(index, good))
