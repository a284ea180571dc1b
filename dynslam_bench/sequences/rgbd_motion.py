"""The camera's motion between frames of an RGB-D sequence, and the agreement of a ground truth with it.

The motion is measured by tracked corners and their depth. A truth is read in several conventions
and shifted in time.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from dynslam_bench.contracts import Frame
from dynslam_bench.geometry import Array, Camera, Trajectory, se3

Pixels = NDArray[np.float32]

CORNERS = 300
"""Corners that are detected in a frame, at most."""
FAR_ENOUGH_PX = 25.0
"""Median displacement of the corners at which a pair of frames ends: far above the tracker's noise."""
MOST_FRAMES_APART = 6
"""A pair ends after so many frames, even if the corners have moved less."""
INLIER_PX = 4.0
"""Reprojection error of an inlier: leaves room for a rolling shutter and for the depth sensor's noise."""
LEAST_INLIERS = 25
"""Corners that have to agree on a motion, and this share of those tracked: `LEAST_INLIER_SHARE`."""
LEAST_INLIER_SHARE = 0.4
"""See `LEAST_INLIERS`."""
_BACK_AND_FORTH_PX = 0.7
"""A corner that is tracked back ends at most so far from where it began."""
_DEPTH_EDGE = 0.1
"""Depths around a corner that differ by more, relative to the nearest, are the edge of a surface."""


@dataclass(frozen=True, eq=False)
class RgbdPair:
    """Two frames, the corners that were tracked between them, and the motion that most of these agree on.

    Attributes:
        first: Index of the earlier frame in the sequence.
        second: Index of the later frame.
        pixels_first: Undistorted pixels of all tracked corners in the first frame ``[N, 2]``.
        depth_first: Z-depth of these corners in the first frame, metres ``[N]``.
        pixels_second: Undistorted pixels of the same corners in the second frame ``[N, 2]``.
        inliers: Which corners agree with the motion ``[N]``.
        T_first_second: Pose of the second camera in the first one's frame ``[4, 4]``, metres; None
            if too few corners agree on any motion.
        displacement_px: Median displacement of the corners.
        depth_share: Part of the first depth image that holds depth.
    """

    first: int
    second: int
    pixels_first: Array
    depth_first: Array
    pixels_second: Array
    inliers: NDArray[np.bool_]
    T_first_second: Array | None
    displacement_px: float
    depth_share: float


def rgbd_pairs(frames: Sequence[Frame], camera: Camera) -> Iterator[RgbdPair]:
    """Pairs of frames of one stretch, each as far apart as the corners need to move by `FAR_ENOUGH_PX`.

    Corners of Shi and Tomasi (CVPR 1994) are tracked by pyramidal Lucas-Kanade, there and back; the
    motion is found by PnP with RANSAC on the first frame's depth. A pair ends where the corners
    have moved far enough, after `MOST_FRAMES_APART` frames, or with the stretch; the next one
    begins there.

    Args:
        frames: Consecutive frames, at least one, all of the camera's size.
        camera: Its intrinsics; the motion holds in their units.
    """
    start: Pixels = np.zeros((0, 2), np.float32)
    first = frames[0]
    last_gray = np.zeros((0, 0), np.uint8)
    points = start
    for frame in frames:
        gray = np.asarray(cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2GRAY), np.uint8)
        due = True

        # track the corners from the last frame, and end the pair where they have moved far enough
        if len(points):
            tracked, good = follow_corners(last_gray, gray, points, points, _BACK_AND_FORTH_PX)
            start = start[good]
            points = tracked[good]
            moved = float(np.median(np.linalg.norm(points - start, axis=1))) if len(points) else 0.0
            due = frame.index - first.index >= MOST_FRAMES_APART or moved >= FAR_ENOUGH_PX
            if len(points) >= LEAST_INLIERS and due:
                yield measure_pair(first, frame, start, points, camera)

        # begin the next pair, also where too few corners are left
        if len(points) < LEAST_INLIERS or due:
            first = frame
            start = _corners(gray, frame.depth)
            points = start
        last_gray = gray

    # what is left of the stretch
    if frames[-1].index - first.index > 1 and len(points) >= LEAST_INLIERS:
        yield measure_pair(first, frames[-1], start, points, camera)


def measure_pair(
    first: Frame, second: Frame, start: Pixels, end: Pixels, camera: Camera
) -> RgbdPair:
    """The pair of two frames whose corners `start` ``[N, 2]`` were found again at `end` ``[N, 2]``, raw pixels."""
    # undistorted pixels in both frames, and points ``[N, 3]`` in the first camera.
    x, y = np.round(start).astype(int).T
    depth = np.asarray(first.depth[y, x], dtype=np.float64)
    pixels_first = camera.undistort_points(start)
    pixels_second = camera.undistort_points(end)
    points = camera.unproject(pixels_first, depth)

    # PnP with RANSAC on the first frame's depth, refined on the inliers.
    inliers = np.zeros(len(points), bool)
    pose = None
    cv2.setRNGSeed(0)
    success, rotation, translation, index = cv2.solvePnPRansac(
        points,
        pixels_second,
        camera.matrix,
        None,
        iterationsCount=200,
        reprojectionError=INLIER_PX,
        confidence=0.999,
    )
    enough = max(LEAST_INLIERS, LEAST_INLIER_SHARE * len(points))
    if success and index is not None and len(index) >= enough:
        inliers[np.asarray(index).reshape(-1)] = True
        rotation, translation = cv2.solvePnPRefineLM(
            points[inliers], pixels_second[inliers], camera.matrix, None, rotation, translation
        )
        T_second_first = se3.from_matrix(translation[:, 0], cv2.Rodrigues(rotation)[0])
        pose = se3.inverse(T_second_first)
        if not np.isfinite(pose).all():
            pose = None
    # how far the corners moved, and how much of the image has a depth
    displacements = np.linalg.norm(pixels_second - pixels_first, axis=1)
    return RgbdPair(
        first=first.index,
        second=second.index,
        pixels_first=pixels_first,
        depth_first=depth,
        pixels_second=pixels_second,
        inliers=inliers,
        T_first_second=pose,
        displacement_px=float(np.median(displacements)),
        depth_share=float(np.mean(first.depth[::4, ::4] > 0)),
    )


def _corners(gray: NDArray[np.uint8], depth: NDArray[np.float32]) -> Pixels:
    """Corners ``[N, 2]`` that lie on a surface, not at its edge."""
    # within 5x5 pixels the depth is measured everywhere and has no step
    window = np.ones((5, 5), np.uint8)
    near = cv2.erode(depth, window)
    far = cv2.dilate(depth, window)
    mask = ((near > 0) & (far - near < _DEPTH_EDGE * near)).astype(np.uint8)
    corners = cv2.goodFeaturesToTrack(gray, CORNERS, 0.01, max(6, gray.shape[1] // 60), mask=mask)
    # OpenCV gives None where there is no corner
    return np.asarray([] if corners is None else corners, np.float32).reshape(-1, 2)


def follow_corners(
    before: NDArray[np.uint8],
    after: NDArray[np.uint8],
    points: Pixels,
    guess: Pixels,
    tolerance_px: float,
) -> tuple[Pixels, NDArray[np.bool_]]:
    """Find corners ``[N, 2]`` of one image in the next one, and flag those found, by pyramidal Lucas-Kanade.

    A corner is found if it lies inside the image and, tracked back, ends where it began.

    Args:
        before: uint8 ``[H, W]``.
        after: uint8 ``[H, W]``, the next image.
        points: Corners in the first image, pixels.
        guess: Where the search begins, ``[N, 2]``, pixels of the next one.
        tolerance_px: Largest distance of that end.
    """
    # there and back
    options: Any = {"maxLevel": 4, "flags": cv2.OPTFLOW_USE_INITIAL_FLOW}
    there, status, _ = cv2.calcOpticalFlowPyrLK(before, after, points, guess.copy(), **options)
    back, status_back, _ = cv2.calcOpticalFlowPyrLK(after, before, there, points.copy(), **options)
    good = (status.reshape(-1) == 1) & (status_back.reshape(-1) == 1)
    good &= np.linalg.norm(back - points, axis=1) < tolerance_px

    # inside the image
    height, width = after.shape
    good &= (there >= 0).all(axis=1) & (there <= (width - 1, height - 1)).all(axis=1)
    return np.asarray(there, np.float32), np.asarray(good, np.bool_)


_EXPLAINED_PX = 3.0
"""A motion explains a corner that it carries to within this distance of where it is seen."""
_LENGTHS = (0.2, 1.0, 5.0)
"""Factors of the translations that are tried: of depth in millimetres that is read as TUM's, and the reverse."""


def explained_share(pairs: Sequence[RgbdPair], relative: Array, camera: Camera) -> float:
    """Mean share of the corners that motions carry to within 3 pixels of where they are seen.

    Unlike the motion on which most corners agree, a true one explains the background also where
    people fill the view.

    Args:
        pairs: Pairs of frames.
        relative: A motion for each ``[N, 4, 4]``: the second camera's pose in the first one's
            frame.
        camera: The stated camera.

    Returns:
        The mean share, with the factor of the translations for which it is largest.
    """
    # for each length of the translations: the mean share over all pairs
    T_second_first = se3.inverse(relative)
    means = []
    for length in _LENGTHS:
        shares = []
        for pair, T in zip(pairs, T_second_first, strict=True):
            points = camera.unproject(pair.pixels_first, pair.depth_first)
            pixels = camera.project(points @ T[:3, :3].T + length * T[:3, 3])
            error = np.linalg.norm(pixels - pair.pixels_second, axis=1)
            shares.append(float((error < _EXPLAINED_PX).mean()))
        means.append(float(np.mean(shares)))
    return max(means)


# Motions of a ground truth, read in several conventions, compared with the measured ones.


READINGS = ("as stored", "inverted", "w first", "w first, inverted", "rotations inverted")
"""Conventions in which the poses of a file may be written."""
ROTATION_NOISE = np.radians(0.25)
"""Standard deviation of a measured rotation."""
TRANSLATION_NOISE = 0.006
"""Standard deviation of a measured translation, as a part of the median depth."""
_FEWEST_MOTIONS = 5
"""Motions that are needed to compare a truth with them."""
_SLACK_S = 0.005
"""So far beyond its ends a truth still has poses."""


@dataclass(frozen=True, eq=False)
class Motions:
    """Measured motions between pairs of frames.

    Attributes:
        start: Stamps of the first frames ``[N]``.
        end: Stamps of the second frames ``[N]``.
        rotation: Rotation vectors ``[N, 3]`` in rad.
        translation: Translations ``[N, 3]`` in metres of the depth images.
        depth_m: Median depth of the corners.
    """

    start: Array
    end: Array
    rotation: Array
    translation: Array
    depth_m: float


def motions_of(pairs: Sequence[RgbdPair], stamps: Array) -> Motions:
    """The motions of pairs that have one."""
    poses = np.array([pair.T_first_second for pair in pairs]).reshape(-1, 4, 4)
    first = [pair.first for pair in pairs]
    second = [pair.second for pair in pairs]
    depths = [float(np.median(pair.depth_first[pair.inliers])) for pair in pairs]
    median = float(np.median(depths)) if depths else 1.0
    return Motions(stamps[first], stamps[second], se3.log(poses)[:, 3:], poses[:, :3, 3], median)


class TruthMotion:
    """A truth that is asked for motions at any stamps: poses between its own are interpolated.

    Args:
        truth: Poses at their stamps.
        reading: How to read them, one of `READINGS`.
    """

    def __init__(self, truth: Trajectory, reading: str = READINGS[0]) -> None:
        self.poses = read_as(truth.T_world_cam, reading)
        self.stamps = truth.timestamps
        # rotation vectors from each pose to the next; a wider gap than some steps is a hole.
        steps = se3.inverse(self.poses[:-1]) @ self.poses[1:]
        gaps = np.diff(self.stamps)
        self._turns = se3.log(steps)[:, 3:] if len(steps) else np.zeros((0, 3))
        self._widest = max(0.12, 2.5 * float(np.median(gaps))) if len(gaps) else 0.0

    def at(self, stamps: Array) -> tuple[Array, NDArray[np.bool_]]:
        """Poses ``[N, 4, 4]`` and whether the truth has them: not beyond its ends nor in its holes."""
        if len(self.stamps) < 2:
            return np.tile(np.eye(4), (len(stamps), 1, 1)), np.zeros(len(stamps), bool)

        # the poses before and after each stamp, and how far it lies between them.
        after = np.searchsorted(self.stamps, stamps, side="right")
        index = np.clip(after - 1, 0, len(self.stamps) - 2)
        low = self.stamps[index]
        high = self.stamps[index + 1]
        share = np.clip((stamps - low) / (high - low), 0, 1)[:, None]

        # interpolate rotations along the shortest turn, and positions along a line.
        turn = np.pad(share * self._turns[index], ((0, 0), (3, 0)))
        R = self.poses[index, :3, :3] @ se3.exp(turn)[:, :3, :3]
        poses = se3.with_rotation(self.poses[index], R)
        poses[:, :3, 3] += share * (self.poses[index + 1, :3, 3] - self.poses[index, :3, 3])

        # not beyond the ends, and not in a hole
        inside = (stamps >= self.stamps[0] - _SLACK_S) & (stamps <= self.stamps[-1] + _SLACK_S)
        return poses, inside & (high - low <= self._widest)

    def between(self, start: Array, end: Array) -> tuple[Array, Array, Array, NDArray[np.bool_]]:
        """Poses at `start`, relative poses from there to `end`, their rotation vectors, and which of them there are."""
        first, first_valid = self.at(start)
        second, second_valid = self.at(end)
        relative = se3.inverse(first) @ second
        return first, relative, se3.log(relative)[:, 3:], first_valid & second_valid


def read_as(poses: Array, reading: str) -> Array:
    """Poses ``[N, 4, 4]`` of a file that was written in the convention `reading` and read as if in TUM's."""
    if reading.startswith("w first"):
        poses = se3.from_wxyz_read_as_xyzw(poses)
    if reading == "rotations inverted":
        poses = se3.with_rotation(poses, np.swapaxes(poses[:, :3, :3], 1, 2))
    if reading in ("inverted", "w first, inverted"):
        return se3.inverse(poses)
    return poses


def agreement(measured: Array, true: Array, bounds: tuple[float, float] = (1e-6, 1e6)) -> float:
    """Agreement of vectors ``[N, 3]`` up to a gain within bounds: 1 - weighted median of their relative differences.

    1 is perfect; independent directions give some 0.3; less is the opposite.
    """
    # relative difference of each pair of vectors, after the gain: 0 for equal ones, 1 for opposite ones
    true = best_gain(measured, true, *bounds) * true
    size = np.linalg.norm(measured, axis=1) + np.linalg.norm(true, axis=1)
    difference = np.linalg.norm(measured - true, axis=1) / np.maximum(size, 1e-12)

    # the median of the differences, weighted by the vectors' size.
    order = np.argsort(difference)
    total = np.cumsum(size[order])
    if not len(total) or total[-1] <= 0:
        return 0.0
    return 1.0 - float(difference[order][np.searchsorted(total, total[-1] / 2)])


ROTATION_GAIN = (0.4, 2.5)
"""Bounds of the ratio of measured to true rotations; that of translations is free."""


def best_gain(measured: Array, true: Array, low: float = 1e-6, high: float = 1e6) -> float:
    """The ratio of the lengths of vectors, by their weighted sums, within bounds."""
    a = np.linalg.norm(measured, axis=1).sum()
    b = np.linalg.norm(true, axis=1).sum()
    return float(np.clip(a / max(b, 1e-12), low, high))


def rotation_between(measured: Array, true: Array, *, proper: bool = True) -> Array:
    """The orthogonal matrix ``[3, 3]`` that turns `measured` ``[N, 3]`` into `true` best, by three robust rounds."""
    weight = np.ones(len(measured))
    X = np.eye(3)
    gain = 1.0 / best_gain(measured, true)
    for _ in range(4):
        # orthogonal Procrustes, then weights by the distance of each vector.
        left, _, right = np.linalg.svd((true * weight[:, None]).T @ measured)
        sign = np.linalg.det(left @ right) if proper else 1.0
        X = left @ np.diag([1.0, 1.0, sign]) @ right
        distance = np.linalg.norm(true - gain * measured @ X.T, axis=1)
        weight = 1.0 / (1.0 + (distance / max(float(np.median(distance)), 1e-12)) ** 2)
    return X


@dataclass(frozen=True)
class Match:
    """Agreement of a truth, read in one convention and shifted in time, with the measured motions.

    Attributes:
        reading: One of `READINGS`.
        shift_s: What is added to the images' stamps to find their poses.
        share: Part of the motions for which the truth has poses.
        rotation: `agreement` of the rotations.
        translation: `agreement` of the translations.
        weights: What either counts: near 1 where the motion is far above the noise.
        gain: Ratio of the lengths of the measured translations to the true ones.
    """

    reading: str
    shift_s: float
    share: float
    rotation: float = 0.0
    translation: float = 0.0
    weights: tuple[float, float] = (0.0, 0.0)
    gain: float = 1.0

    @property
    def total(self) -> float:
        """Weighted mean of both agreements."""
        return weighted_mean(self.rotation, self.translation, self.weights)

    @property
    def clearest(self) -> float:
        """`total`, or the rotations' agreement where it is better and they are clear: people spoil it least."""
        return max(self.total, self.rotation) if self.weights[0] >= 0.5 else self.total


def weighted_mean(rotation: float, translation: float, weights: tuple[float, float]) -> float:
    """Mean of the agreements of rotations and translations."""
    return (weights[0] * rotation + weights[1] * translation) / max(sum(weights), 1e-9)


def match(motions: Motions, truth: TruthMotion, reading: str, shift_s: float) -> Match:
    """Compare the motions with those of a truth under a shift in time."""
    # the truth's motions between the shifted stamps, where it has poses
    _, relative, turns, valid = truth.between(motions.start + shift_s, motions.end + shift_s)
    share = float(valid.mean()) if len(valid) else 0.0
    if valid.sum() < _FEWEST_MOTIONS:
        return Match(reading, shift_s, share)

    # agreement of rotations and of translations, weighted by how far they are above the noise
    rotation = motions.rotation[valid]
    translation = motions.translation[valid]
    true_rotation = turns[valid]
    true_translation = relative[valid, :3, 3]
    return Match(
        reading=reading,
        shift_s=shift_s,
        share=share,
        rotation=agreement(rotation, true_rotation, ROTATION_GAIN),
        translation=agreement(translation, true_translation),
        weights=(
            _weight(rotation, ROTATION_NOISE),
            _weight(translation, TRANSLATION_NOISE * motions.depth_m),
        ),
        gain=best_gain(translation, true_translation),
    )


def _weight(vectors: Array, noise: float) -> float:
    """Weight of vectors ``[N, 3]`` by their median length over the noise: near 0 below it, near 1 far above."""
    snr = float(np.median(np.linalg.norm(vectors, axis=1))) / noise
    return snr**2 / (4 + snr**2)
