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
FAR_ENOUGH_PX = 25.0
"""Median displacement of the corners at which a pair of frames ends: far above the tracker's noise."""
MOST_FRAMES_APART = 6
INLIER_PX = 4.0
"""Reprojection error of an inlier: leaves room for a rolling shutter and for the depth sensor's noise."""
LEAST_INLIERS = 25
LEAST_INLIER_SHARE = 0.4
_BACK_AND_FORTH_PX = 0.7
_DEPTH_EDGE = 0.1


@dataclass(frozen=True, eq=False)
class RgbdPair:
    """Two frames, the corners that were tracked between them, and the motion that most of these agree on.

    Attributes:
        first: Index of the earlier frame in the sequence.
        second: Index of the later frame.
        pixels_first: Undistorted pixels of all tracked corners in the first frame ``[N, 2]``.
        depth_first: Their z-depth in metres ``[N]``.
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
    key = frames[0]
    last = np.zeros((0, 0), np.uint8)
    points = start
    for frame in frames:
        gray = np.asarray(cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2GRAY), np.uint8)
        due = True
        if len(points):
            tracked, good = follow_corners(last, gray, points, points, _BACK_AND_FORTH_PX)
            start = start[good]
            points = tracked[good]
            moved = float(np.median(np.linalg.norm(points - start, axis=1))) if len(points) else 0.0
            due = frame.index - key.index >= MOST_FRAMES_APART or moved >= FAR_ENOUGH_PX
            if len(points) >= LEAST_INLIERS and due:
                yield measure_pair(key, frame, start, points, camera)
        if len(points) < LEAST_INLIERS or due:
            key = frame
            start = _corners(gray, frame.depth)
            points = start
        last = gray
    if frames[-1].index - key.index > 1 and len(points) >= LEAST_INLIERS:
        yield measure_pair(key, frames[-1], start, points, camera)


def measure_pair(
    first: Frame, second: Frame, start: Pixels, end: Pixels, camera: Camera
) -> RgbdPair:
    """The pair of two frames whose corners `start` ``[N, 2]`` were found again at `end` ``[N, 2]``, raw pixels."""
    x, y = np.round(start).astype(int).T
    depth = np.asarray(first.depth[y, x], dtype=np.float64)
    a = camera.undistort_points(start)
    b = camera.undistort_points(end)
    points = camera.unproject(a, depth)
    inliers = np.zeros(len(a), bool)
    pose = None
    cv2.setRNGSeed(0)
    success, rotation, translation, index = cv2.solvePnPRansac(
        points,
        b,
        camera.matrix,
        None,
        iterationsCount=200,
        reprojectionError=INLIER_PX,
        confidence=0.999,
    )
    if (
        success
        and index is not None
        and len(index) >= max(LEAST_INLIERS, LEAST_INLIER_SHARE * len(points))
    ):
        inliers[np.asarray(index).reshape(-1)] = True
        rotation, translation = cv2.solvePnPRefineLM(
            points[inliers], b[inliers], camera.matrix, None, rotation, translation
        )
        pose = se3.inverse(se3.from_matrix(translation[:, 0], cv2.Rodrigues(rotation)[0]))
    displacement = float(np.median(np.linalg.norm(b - a, axis=1)))
    share = float(np.mean(first.depth[::4, ::4] > 0))
    pose = pose if pose is not None and np.isfinite(pose).all() else None
    return RgbdPair(first.index, second.index, a, depth, b, inliers, pose, displacement, share)


def _corners(gray: NDArray[np.uint8], depth: NDArray[np.float32]) -> Pixels:
    """Corners ``[N, 2]`` that lie on a surface, not at its edge."""
    window = np.ones((5, 5), np.uint8)
    near = cv2.erode(depth, window)
    far = cv2.dilate(depth, window)
    mask = ((near > 0) & (far - near < _DEPTH_EDGE * near)).astype(np.uint8)
    corners = cv2.goodFeaturesToTrack(gray, CORNERS, 0.01, max(6, gray.shape[1] // 60), mask=mask)
    return (
        np.zeros((0, 2), np.float32)
        if corners is None
        else np.asarray(corners, np.float32).reshape(-1, 2)
    )


def follow_corners(
    before: NDArray[np.uint8],
    after: NDArray[np.uint8],
    points: Pixels,
    guess: Pixels,
    tolerance_px: float,
) -> tuple[Pixels, NDArray[np.bool_]]:
    """Where corners ``[N, 2]`` of one image lie in the next one, and which were found, by pyramidal Lucas-Kanade.

    A corner is found if it lies inside the image and, tracked back, ends within `tolerance_px` of
    where it began. `guess` ``[N, 2]`` is where the search begins.
    """
    options: Any = {"maxLevel": 4, "flags": cv2.OPTFLOW_USE_INITIAL_FLOW}
    there, status, _ = cv2.calcOpticalFlowPyrLK(before, after, points, guess.copy(), **options)
    back, status_back, _ = cv2.calcOpticalFlowPyrLK(after, before, there, points.copy(), **options)
    good = (status.reshape(-1) == 1) & (status_back.reshape(-1) == 1)
    good &= np.linalg.norm(back - points, axis=1) < tolerance_px
    good &= (there >= 0).all(axis=1) & (there <= (after.shape[1] - 1, after.shape[0] - 1)).all(
        axis=1
    )
    return np.asarray(there, np.float32), np.asarray(good, np.bool_)


_EXPLAINED_PX = 3.0
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
    shares = []
    for length in _LENGTHS:
        parts = []
        for pair, back in zip(pairs, se3.inverse(relative), strict=True):
            points = camera.unproject(pair.pixels_first, pair.depth_first)
            pixels = camera.project(points @ back[:3, :3].T + length * back[:3, 3])
            off = np.linalg.norm(pixels - pair.pixels_second, axis=1)
            parts.append(float((off < _EXPLAINED_PX).mean()))
        shares.append(float(np.mean(parts)))
    return max(shares)


# Motions of a ground truth, read in several conventions, compared with the measured ones.


READINGS = ("as stored", "inverted", "w first", "w first, inverted", "rotations inverted")
ROTATION_NOISE = np.radians(0.25)
TRANSLATION_NOISE = 0.006
"""Of a measured motion: as a part of the median depth."""


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
        steps = se3.inverse(self.poses[:-1]) @ self.poses[1:]
        gaps = np.diff(self.stamps)
        self._turns = se3.log(steps)[:, 3:] if len(steps) else np.zeros((0, 3))
        self._widest = max(0.12, 2.5 * float(np.median(gaps))) if len(gaps) else 0.0

    def at(self, stamps: Array) -> tuple[Array, NDArray[np.bool_]]:
        """Poses ``[N, 4, 4]`` and whether the truth has them: not beyond its ends nor in its holes."""
        if len(self.stamps) < 2:
            return np.tile(np.eye(4), (len(stamps), 1, 1)), np.zeros(len(stamps), bool)
        index = np.clip(
            np.searchsorted(self.stamps, stamps, side="right") - 1, 0, len(self.stamps) - 2
        )
        low = self.stamps[index]
        high = self.stamps[index + 1]
        share = np.clip((stamps - low) / (high - low), 0, 1)[:, None]
        turn = np.pad(share * self._turns[index], ((0, 0), (3, 0)))
        slack = 0.005
        poses = se3.with_rotation(
            self.poses[index], self.poses[index, :3, :3] @ se3.exp(turn)[:, :3, :3]
        )
        poses[:, :3, 3] += share * (self.poses[index + 1, :3, 3] - self.poses[index, :3, 3])
        inside = (stamps >= self.stamps[0] - slack) & (stamps <= self.stamps[-1] + slack)
        return poses, inside & (high - low <= self._widest)

    def between(self, start: Array, end: Array) -> tuple[Array, Array, Array, NDArray[np.bool_]]:
        """Poses at `start`, relative poses from there to `end`, their rotation vectors, and which of them there are."""
        (first, valid) = self.at(start)
        (second, valid_too) = self.at(end)
        relative = se3.inverse(first) @ second
        return first, relative, se3.log(relative)[:, 3:], valid & valid_too


def read_as(poses: Array, reading: str) -> Array:
    """Poses ``[N, 4, 4]`` of a file that was written in the convention `reading` and read as if in TUM's."""
    if reading.startswith("w first"):
        poses = se3.from_wxyz_read_as_xyzw(poses)
    if reading == "rotations inverted":
        poses = se3.with_rotation(poses, np.swapaxes(poses[:, :3, :3], 1, 2))
    return se3.inverse(poses) if reading in ("inverted", "w first, inverted") else poses


def agreement(measured: Array, true: Array, bounds: tuple[float, float] = (1e-6, 1e6)) -> float:
    """How well vectors ``[N, 3]`` agree up to a gain within bounds: 1 - weighted median of their relative differences.

    1 is perfect; independent directions give some 0.3; less is the opposite.
    """
    true = best_gain(measured, true, *bounds) * true
    size = np.linalg.norm(measured, axis=1) + np.linalg.norm(true, axis=1)
    off = np.linalg.norm(measured - true, axis=1) / np.maximum(size, 1e-12)
    order = np.argsort(off)
    total = np.cumsum(size[order])
    if not len(total) or total[-1] <= 0:
        return 0.0
    return 1.0 - float(off[order][np.searchsorted(total, total[-1] / 2)])


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
        left, _, right = np.linalg.svd((true * weight[:, None]).T @ measured)
        sign = np.linalg.det(left @ right) if proper else 1.0
        X = left @ np.diag([1.0, 1.0, sign]) @ right
        off = np.linalg.norm(true - gain * measured @ X.T, axis=1)
        weight = 1.0 / (1.0 + (off / max(float(np.median(off)), 1e-12)) ** 2)
    return X


@dataclass(frozen=True)
class Match:
    """How well a truth, read in one convention and shifted in time, agrees with the measured motions.

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
        """The same, or the rotations' agreement where it is better and they are clear: people spoil it least."""
        return max(self.total, self.rotation) if self.weights[0] >= 0.5 else self.total


def weighted_mean(rotation: float, translation: float, weights: tuple[float, float]) -> float:
    """Mean of the agreements of rotations and translations."""
    return (weights[0] * rotation + weights[1] * translation) / max(sum(weights), 1e-9)


def match(motions: Motions, truth: TruthMotion, reading: str, shift_s: float) -> Match:
    """Compare the motions with those of a truth under a shift in time."""
    _, relative, turns, valid = truth.between(motions.start + shift_s, motions.end + shift_s)
    share = float(valid.mean()) if len(valid) else 0.0
    if valid.sum() < 5:
        return Match(reading, shift_s, share)
    rotation = motions.rotation[valid]
    translation = motions.translation[valid]
    true = relative[valid, :3, 3]
    noise = ((rotation, ROTATION_NOISE), (translation, TRANSLATION_NOISE * motions.depth_m))
    snr, snr_t = (
        float(np.median(np.linalg.norm(vectors, axis=1))) / sigma for vectors, sigma in noise
    )
    weights = snr**2 / (4 + snr**2), snr_t**2 / (4 + snr_t**2)
    alike = agreement(rotation, turns[valid], ROTATION_GAIN), agreement(translation, true)
    return Match(reading, shift_s, share, *alike, weights, best_gain(translation, true))
