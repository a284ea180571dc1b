"""Image pairs with known correspondences for the flow measurements: exact warps, real frames with depth and pose."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pandas as pd

from dynslam_bench.contracts.sequence import Frame
from dynslam_bench.flow.settings import DenseFlowSettings
from dynslam_bench.geometry import Camera, se3
from dynslam_bench.sequences.catalogue import open_sequence
from dynslam_bench.slam.pose_optimisation import Measurements, optimise_pose

DATA = Path(__file__).resolve().parents[3] / "shared" / "data"
RECORDINGS = {
    "fr1_xyz": DATA / "tum/rgbd_dataset_freiburg1_xyz",
    "fr1_rpy": DATA / "tum/rgbd_dataset_freiburg1_rpy",
    "bonn": DATA / "bonn/rgbd_bonn_crowd",
}
DENSE_SEARCHES = {
    "default": DenseFlowSettings(),
    "smaller superpixels": DenseFlowSettings(superpixel_px=12, budget=64, sweeps=4, candidates=3),
    "larger": DenseFlowSettings(superpixel_px=12, budget=384, sweeps=12, candidates=5),
}
"""Searches of the dense flow that the measurements compare."""


@dataclass
class Pair:
    """Two images and where points of the first lie in the second.

    `guess` is where the motion over the gap before the first image, kept up, takes the points; NaN
    without depth.
    """

    name: str
    reference: np.ndarray
    target: np.ndarray
    points: np.ndarray
    truth: np.ndarray
    guess: np.ndarray | None = None


def lengths(pairs: Sequence[Pair]) -> np.ndarray:
    """How far the points of all pairs move, in pixels."""
    return np.concatenate([np.hypot(*(pair.truth - pair.points).T) for pair in pairs])


def corners(gray: np.ndarray, count: int = 1000) -> np.ndarray:
    """ORB keypoints over all octaves, spread over a grid, float32 ``[N, 2]``."""
    keypoints = sorted(
        cv2.ORB.create(4 * count, fastThreshold=7).detect(gray), key=lambda k: -k.response
    )
    xy = np.array([k.pt for k in keypoints], np.float32).reshape(-1, 2)
    column, row = (xy * (16, 12) // gray.shape[::-1]).astype(int).T
    cells = pd.Series(16 * row + column)
    return xy[cells.groupby(cells).cumcount() < max(1, int(1.5 * count / (16 * 12)))][:count]


def textures(limit: int) -> list[np.ndarray]:
    """Frames of the recordings and photographs, 640x480 grey."""
    paths = []
    for folder in RECORDINGS.values():
        files = sorted((folder / "rgb").glob("*.png"))
        paths += [files[0], files[len(files) // 2]]
    photos = sorted((DATA / "coco128-seg/images/train2017").glob("*.jpg"))
    images = [cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) for path in [*paths, *photos]]
    return [image for image in images if image.shape == (480, 640)][:limit]


def _warp(image: np.ndarray, matrix: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    scale = np.sqrt(abs(np.linalg.det(matrix[:2, :2])))
    if scale < 1:  # what the camera would have averaged
        image = cv2.GaussianBlur(image, (0, 0), 0.5 * np.sqrt(1 / scale**2 - 1) + 1e-3)
    return cv2.warpPerspective(
        image, matrix, size, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT
    )


def _similarity(
    scale: float, degrees: float, tx: float, ty: float, centre: tuple[float, float]
) -> np.ndarray:
    c = scale * np.cos(np.deg2rad(degrees))
    s = scale * np.sin(np.deg2rad(degrees))
    x, y = centre
    return np.array([[c, -s, x - c * x + s * y + tx], [s, c, y - s * x - c * y + ty], [0, 0, 1.0]])


SIMILARITIES = {
    "translation": (0, 0, 1), "scale": (1, 0, 0.3), "rotation": (0, 45, 0.3), "similarity": (0.5, 20, 0.5),
    "foreground": (0.5, 20, 0.5),
}  # fmt: skip
"""Largest octaves of scale and degrees of rotation of each kind of warp, and the share of the translation."""


def synthetic(kinds: tuple[str, ...], images: int) -> list[Pair]:
    """Exact warps of real images with sensor noise of 1.5 grey levels: ``homography``, and those of `SIMILARITIES`."""
    rng = np.random.default_rng(7)
    pairs = []
    pictures = textures(images + 1)
    for index, image in enumerate(pictures[:-1]):
        height, width = image.shape
        size = (width, height)
        centre = (width / 2, height / 2)
        points = corners(image)
        for kind in kinds:
            t = rng.uniform(-1, 1, 2) * (100, 75)
            if kind == "homography":
                corner = np.array([[0, 0], [width, 0], [width, height], [0, height]], np.float32)
                moved = corner + rng.uniform(-90, 90, (4, 2)).astype(np.float32)
                matrix = cv2.getPerspectiveTransform(corner, moved).astype(np.float64)
            else:
                octaves, degrees, share = SIMILARITIES[kind]
                scale = 2 ** rng.uniform(-octaves, octaves) if octaves else 1
                matrix = _similarity(
                    scale, rng.uniform(-degrees, degrees) if degrees else 0, *(t * share), centre
                )
            target = _warp(image, matrix, size)
            reference = image
            here = points
            truth = cv2.perspectiveTransform(points[:, None].astype(np.float64), matrix)[:, 0]
            if kind == "foreground":  # an ellipse with another picture's texture moves its own way
                other = pictures[index + 1]
                spot = (float(rng.uniform(200, 440)), float(rng.uniform(160, 320)))
                mask = np.zeros_like(image)
                cv2.ellipse(
                    mask,
                    (int(spot[0]), int(spot[1])),
                    (110, 80),
                    float(rng.uniform(0, 180)),
                    0,
                    360,
                    255,
                    -1,
                )
                own = _similarity(
                    2 ** rng.uniform(-0.2, 0.2),
                    rng.uniform(-10, 10),
                    *rng.uniform(-45, 45, 2),
                    spot,
                )
                reference = np.where(mask > 0, other, image)
                moved_mask = _warp(mask, own, size) > 127
                target = np.where(moved_mask, _warp(other, own, size), target)
                here = corners(reference)
                inside = mask[here[:, 1].astype(int), here[:, 0].astype(int)] > 0
                behind = cv2.perspectiveTransform(here[:, None].astype(np.float64), matrix)[:, 0]
                front = cv2.perspectiveTransform(here[:, None].astype(np.float64), own)[:, 0]
                truth = np.where(inside[:, None], front, behind)
                column, row = np.clip(np.rint(truth).astype(int), 0, (width - 1, height - 1)).T
                hidden = ~inside & moved_mask[row, column]
                here = here[~hidden]
                truth = truth[~hidden]
            seen = ((truth >= 4) & (truth < (width - 4, height - 4))).all(axis=1)
            noisy = [
                np.clip(x + rng.normal(0, 1.5, x.shape), 0, 255).round().astype(np.uint8)
                for x in (reference, target)
            ]
            if seen.sum() >= 30:
                pairs.append(Pair(f"{kind}", *noisy, here[seen], truth[seen]))
    return pairs


def _lift(xy: np.ndarray, z: np.ndarray, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Points in space (metres, camera frame), and whether the depth around them is known and smooth."""
    column, row = np.rint(xy).astype(int).T
    offsets = [(dy, dx) for dy in (-1, 0, 1) for dx in (-1, 0, 1)]
    patch = np.stack(
        [z[np.clip(row + dy, 0, 479), np.clip(column + dx, 0, 639)] for dy, dx in offsets]
    )
    smooth = (patch.min(0) > 0.2) & (patch.max(0) - patch.min(0) < 0.03 * patch.max(0))
    return camera.unproject(camera.undistort_points(xy), z[row, column]), smooth


def _motion(first: Frame, second: Frame, motion: np.ndarray, camera: Camera) -> np.ndarray | None:
    """``T_second_first`` of the camera: the ground truth's, refined on ORB matches; None where these contradict it."""
    orb = cv2.ORB.create(2000, fastThreshold=7)
    (k1, d1), (k2, d2) = (orb.detectAndCompute(grey(frame), None) for frame in (first, second))
    if d1 is None or d2 is None:
        return None
    matches = [m for m in cv2.BFMatcher(cv2.NORM_HAMMING).match(d1, d2) if m.distance < 50]
    xy1 = np.array([k1[m.queryIdx].pt for m in matches], np.float32).reshape(-1, 2)
    xy2 = np.array([k2[m.trainIdx].pt for m in matches], np.float32).reshape(-1, 2)
    space, smooth = _lift(xy1, first.depth, camera)
    uv = camera.undistort_points(xy2)[smooth]
    one = np.ones(smooth.sum())
    none = np.zeros(smooth.sum())
    estimate = optimise_pose(motion, space[smooth], Measurements(uv, none, one, none), camera)
    return estimate.T_cam_world if len(xy1) >= 50 and estimate.residual_px < 1.0 else None


def grey(frame: Frame) -> np.ndarray:
    """The intensities of a frame, uint8 ``[H, W]``."""
    return cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2GRAY)


def real(name: str, gaps: tuple[int, ...], every: int = 4) -> list[Pair]:
    """Pairs of real frames; truth is depth and the relative pose, refined on ORB matches near the raw ground truth.

    Points whose depth in the second image contradicts the prediction (occluded, moved) are left
    out.

    Args:
        name: Name of one of `RECORDINGS`.
        gaps: Frames between the two images.
        every: First images are this far apart, further for wide gaps.
    """
    sequence = open_sequence(str(RECORDINGS[name]))
    camera = sequence.camera
    truth = sequence.ground_truth
    away = np.abs(truth.timestamps[:, None] - sequence.timestamps)
    known = np.flatnonzero(away.min(axis=0) < 0.02)
    poses = truth.T_world_cam[away.argmin(axis=0)]
    pairs = []
    for gap in gaps:
        for start in range(0, len(known) - gap, every * max(1, gap // 2)):
            at = known[start]
            then = known[start + gap]
            first = sequence[int(at)]
            second = sequence[int(then)]
            motion = _motion(first, second, se3.inverse(poses[then]) @ poses[at], camera)
            if motion is None:
                continue
            points = corners(grey(first))
            space, smooth = _lift(points, first.depth, camera)
            moved = se3.transform(motion, space)
            ends = camera.distort_points(camera.project(moved))
            seen = smooth & (moved[:, 2] > 0.2) & ((ends >= 4) & (ends < (636, 476))).all(axis=1)
            column, row = np.clip(np.nan_to_num(np.rint(ends)), 0, (639, 479)).astype(int).T
            depth = second.depth[row, column]
            seen &= (depth > 0) & (abs(depth - moved[:, 2]) < 0.04 * moved[:, 2])
            if seen.sum() >= 50:
                pairs.append(
                    Pair(f"{name} +{gap}", grey(first), grey(second), points[seen], ends[seen])
                )
    return pairs


def kitti() -> tuple[list[np.ndarray], np.ndarray, np.ndarray]:
    """The KITTI pair: both images in grey, flow float32 ``[H, W, 2]``, validity."""
    folder = DATA / "flow/kitti"
    raw = cv2.imread(str(folder / "flow_gt.png"), cv2.IMREAD_UNCHANGED)[..., ::-1].astype(
        np.float32
    )
    images = [cv2.imread(str(folder / name)) for name in ("frame1.png", "frame2.png")]
    return (
        [cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) for image in images],
        (raw[..., :2] - 2**15) / 64,
        raw[..., 2] > 0,
    )
