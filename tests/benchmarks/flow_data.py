"""Image pairs with known correspondences for the flow measurements: exact warps, real frames with depth and pose."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from dynslam_bench.geometry.camera import Camera

DATA = Path(__file__).resolve().parents[3] / "shared" / "data"
FR1 = Camera(640, 480, 517.3, 516.5, 318.6, 255.3, (0.2624, -0.9531, -0.0054, 0.0026, 1.1633))
BONN = Camera(640, 480, 542.822841, 542.576870, 315.593520, 237.756098, (0.039903, -0.099343, -0.00073, -0.000144, 0.0))
RECORDINGS = {
    "fr1_xyz": (DATA / "tum/rgbd_dataset_freiburg1_xyz", FR1),
    "fr1_rpy": (DATA / "tum/rgbd_dataset_freiburg1_rpy", FR1),
    "bonn": (DATA / "bonn/rgbd_bonn_crowd", BONN),
}


@dataclass
class Pair:
    """Two images and where points of the first lie in the second.

    `guess` is where the motion over the gap before the first image, kept up, takes the points; NaN without depth.
    """

    name: str
    reference: np.ndarray
    target: np.ndarray
    points: np.ndarray
    truth: np.ndarray
    guess: np.ndarray | None = None


def corners(gray: np.ndarray, count: int = 1000) -> np.ndarray:
    """ORB keypoints over all octaves, spread over a grid, float32 ``[N, 2]``."""
    found = cv2.ORB.create(4 * count, fastThreshold=7).detect(gray)
    found = sorted(found, key=lambda k: -k.response)
    cells: dict[tuple[int, int], int] = {}
    quota = max(1, int(1.5 * count / (16 * 12)))
    xy = []
    for k in found:
        cell = (int(k.pt[0] * 16 / gray.shape[1]), int(k.pt[1] * 12 / gray.shape[0]))
        if cells.get(cell, 0) < quota:
            cells[cell] = cells.get(cell, 0) + 1
            xy.append(k.pt)
    return np.asarray(xy[:count], dtype=np.float32)


def textures(limit: int) -> list[np.ndarray]:
    """Frames of the recordings and photographs, 640x480 grey."""
    paths = []
    for folder, _ in RECORDINGS.values():
        files = sorted((folder / "rgb").glob("*.png"))
        paths += [files[0], files[len(files) // 2]]
    photos = sorted((DATA / "coco128-seg/images/train2017").glob("*.jpg"))
    images = [cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) for path in paths]
    images += [
        image for image in (cv2.imread(str(p), cv2.IMREAD_GRAYSCALE) for p in photos) if image.shape == (480, 640)
    ]
    return images[:limit]


def _warp(image: np.ndarray, matrix: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    scale = np.sqrt(abs(np.linalg.det(matrix[:2, :2])))
    if scale < 1:  # what the camera would have averaged
        image = cv2.GaussianBlur(image, (0, 0), 0.5 * np.sqrt(1 / scale**2 - 1) + 1e-3)
    return cv2.warpPerspective(image, matrix, size, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)


def _similarity(scale: float, degrees: float, tx: float, ty: float, centre: tuple[float, float]) -> np.ndarray:
    c, s = scale * np.cos(np.deg2rad(degrees)), scale * np.sin(np.deg2rad(degrees))
    x, y = centre
    return np.array([[c, -s, x - c * x + s * y + tx], [s, c, y - s * x - c * y + ty], [0, 0, 1.0]])


def synthetic(kinds: tuple[str, ...], images: int, seed: int = 7) -> list[Pair]:
    """Exact warps of real images with sensor noise of 1.5 grey levels.

    Kinds: ``translation``, ``scale``, ``rotation``, ``similarity``, ``homography``, ``foreground``.
    """
    rng = np.random.default_rng(seed)
    pairs = []
    pictures = textures(images + 1)
    for index, image in enumerate(pictures[:-1]):
        height, width = image.shape
        size, centre = (width, height), (width / 2, height / 2)
        points = corners(image)
        for kind in kinds:
            t = rng.uniform(-1, 1, 2) * (100, 75)
            if kind == "translation":
                matrix = _similarity(1, 0, *t, centre)
            elif kind == "scale":
                matrix = _similarity(2 ** rng.uniform(-1, 1), 0, *(t * 0.3), centre)
            elif kind == "rotation":
                matrix = _similarity(1, rng.uniform(-45, 45), *(t * 0.3), centre)
            elif kind in ("similarity", "foreground"):
                matrix = _similarity(2 ** rng.uniform(-0.5, 0.5), rng.uniform(-20, 20), *(t * 0.5), centre)
            elif kind == "homography":
                corner = np.array([[0, 0], [width, 0], [width, height], [0, height]], np.float32)
                moved = corner + rng.uniform(-90, 90, (4, 2)).astype(np.float32)
                matrix = cv2.getPerspectiveTransform(corner, moved).astype(np.float64)
            target = _warp(image, matrix, size)
            reference, here = image, points
            truth = cv2.perspectiveTransform(points[:, None].astype(np.float64), matrix)[:, 0]
            if kind == "foreground":  # an ellipse with another picture's texture moves its own way
                other = pictures[index + 1]
                spot = (float(rng.uniform(200, 440)), float(rng.uniform(160, 320)))
                mask = np.zeros_like(image)
                cv2.ellipse(mask, (int(spot[0]), int(spot[1])), (110, 80), float(rng.uniform(0, 180)), 0, 360, 255, -1)
                own = _similarity(2 ** rng.uniform(-0.2, 0.2), rng.uniform(-10, 10), *rng.uniform(-45, 45, 2), spot)
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
                here, truth = here[~hidden], truth[~hidden]
            seen = ((truth >= 4) & (truth < (width - 4, height - 4))).all(axis=1)
            noisy = [
                np.clip(x + rng.normal(0, 1.5, x.shape), 0, 255).round().astype(np.uint8) for x in (reference, target)
            ]
            if seen.sum() >= 30:
                pairs.append(Pair(f"{kind}", *noisy, here[seen], truth[seen]))
    return pairs


def _stamped(folder: Path, kind: str) -> list[tuple[float, Path]]:
    return sorted((float(path.stem), path) for path in (folder / kind).glob("*.png"))


def _poses(folder: Path) -> tuple[np.ndarray, np.ndarray]:
    rows = np.loadtxt(folder / "groundtruth.txt", comments="#")
    q = rows[:, 4:8] / np.linalg.norm(rows[:, 4:8], axis=1, keepdims=True)
    x, y, z, w = q.T
    rotation = np.stack([
        1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w),
        2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w),
        2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y),
    ], axis=1).reshape(-1, 3, 3)  # fmt: skip
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = rotation, rows[:, 1:4]
    return rows[:, 0], poses


def _exp(w: np.ndarray) -> np.ndarray:
    return cv2.Rodrigues(w.astype(np.float64))[0]


def _refine_pose(
    motion: np.ndarray, points: np.ndarray, observed: np.ndarray, camera: Camera
) -> tuple[np.ndarray, float]:
    """Robust Gauss-Newton on the reprojection error, from the ground truth on; returns the median residual."""
    for scale in (6.0, 3.0, 2.0, 1.5, 1.0, 1.0, 1.0):
        p = points @ motion[:3, :3].T + motion[:3, 3]
        z = np.maximum(p[:, 2], 0.1)
        uv = np.stack([camera.fx * p[:, 0] / z + camera.cx, camera.fy * p[:, 1] / z + camera.cy], axis=1)
        r = uv - observed
        weight = (1 - np.minimum((r**2).sum(1) / (3 * scale) ** 2, 1)) ** 2
        jacobian = np.zeros((len(p), 2, 6))
        jacobian[:, 0, 0], jacobian[:, 0, 2] = camera.fx / z, -camera.fx * p[:, 0] / z**2
        jacobian[:, 1, 1], jacobian[:, 1, 2] = camera.fy / z, -camera.fy * p[:, 1] / z**2
        skew = np.zeros((len(p), 3, 3))
        skew[:, 0, 1], skew[:, 0, 2], skew[:, 1, 2] = -p[:, 2], p[:, 1], -p[:, 0]
        skew -= skew.transpose(0, 2, 1)
        jacobian[:, :, 3:] = -jacobian[:, :, :3] @ skew
        h = np.einsum("nki,n,nkj->ij", jacobian, weight, jacobian) + 1e-6 * np.eye(6)
        step = np.linalg.solve(h, -np.einsum("nki,n,nk->i", jacobian, weight, r))
        delta = np.eye(4)
        delta[:3, :3], delta[:3, 3] = _exp(step[3:]), step[:3]
        motion = delta @ motion
    good = weight > 0.2
    return motion, float(np.median(np.linalg.norm(r[good], axis=1))) if good.any() else np.inf


@dataclass
class _Shot:
    """A recorded frame: grey image, depth in metres, pose of the motion capture."""

    gray: np.ndarray
    depth: np.ndarray
    pose: np.ndarray


def _shots(folder: Path) -> list[tuple[Path, Path, np.ndarray]]:
    """Colour image, depth image and pose of every frame that has all three."""
    colour, depth = _stamped(folder, "rgb"), _stamped(folder, "depth")
    stamps, poses = _poses(folder)
    depth_stamps = np.array([stamp for stamp, _ in depth])
    frames = []
    for stamp, path in colour:
        near, pose = int(np.argmin(abs(depth_stamps - stamp))), int(np.argmin(abs(stamps - stamp)))
        if abs(depth_stamps[near] - stamp) < 0.02 and abs(stamps[pose] - stamp) < 0.02:
            frames.append((path, depth[near][1], poses[pose]))
    return frames


def _read(frame: tuple[Path, Path, np.ndarray]) -> _Shot:
    gray = cv2.imread(str(frame[0]), cv2.IMREAD_GRAYSCALE)
    return _Shot(gray, cv2.imread(str(frame[1]), cv2.IMREAD_UNCHANGED).astype(np.float32) / 5000, frame[2])


def _lift(xy: np.ndarray, z: np.ndarray, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Points in space (metres, camera frame), and whether the depth around them is known and smooth."""
    column, row = np.rint(xy).astype(int).T
    offsets = [(dy, dx) for dy in (-1, 0, 1) for dx in (-1, 0, 1)]
    patch = np.stack([z[np.clip(row + dy, 0, 479), np.clip(column + dx, 0, 639)] for dy, dx in offsets])
    smooth = (patch.min(0) > 0.2) & (patch.max(0) - patch.min(0) < 0.03 * patch.max(0))
    return camera.unproject(camera.undistort_points(xy), z[row, column]), smooth


def _motion(first: _Shot, second: _Shot, camera: Camera) -> np.ndarray | None:
    """``T_second_first`` of the camera: the ground truth's, refined on ORB matches; None where these contradict it."""
    orb = cv2.ORB.create(2000, fastThreshold=7)
    (k1, d1), (k2, d2) = (orb.detectAndCompute(shot.gray, None) for shot in (first, second))
    if d1 is None or d2 is None:
        return None
    found = [m for m in cv2.BFMatcher(cv2.NORM_HAMMING).match(d1, d2) if m.distance < 50]
    xy1 = np.array([k1[m.queryIdx].pt for m in found], np.float32).reshape(-1, 2)
    xy2 = np.array([k2[m.trainIdx].pt for m in found], np.float32).reshape(-1, 2)
    if len(xy1) < 50:
        return None
    space, smooth = _lift(xy1, first.depth, camera)
    observed = camera.undistort_points(xy2)[smooth]
    motion, residual = _refine_pose(np.linalg.inv(second.pose) @ first.pose, space[smooth], observed, camera)
    return motion if residual < 1.0 else None


def real(name: str, gaps: tuple[int, ...], every: int = 4) -> list[Pair]:
    """Pairs of real frames; truth is depth and the relative pose, refined on ORB matches near the raw ground truth.

    Points whose depth in the second image contradicts the prediction (occluded, moved) are left out.

    Args:
        name: Of `RECORDINGS`.
        gaps: Frames between the two images.
        every: First images are this far apart, further for wide gaps.
    """
    folder, camera = RECORDINGS[name]
    frames = _shots(folder)
    pairs = []
    for gap in gaps:
        for start in range(0, len(frames) - gap, every * max(1, gap // 2)):
            first, second = _read(frames[start]), _read(frames[start + gap])
            motion = _motion(first, second, camera)
            if motion is None:
                continue
            points = corners(first.gray)
            space, smooth = _lift(points, first.depth, camera)
            moved = space @ motion[:3, :3].T + motion[:3, 3]
            truth = camera.distort_points(camera.project(moved))
            seen = smooth & (moved[:, 2] > 0.2) & ((truth >= 4) & (truth < (636, 476))).all(axis=1)
            column, row = np.clip(np.nan_to_num(np.rint(truth)), 0, (639, 479)).astype(int).T
            there = second.depth[row, column]
            seen &= (there > 0) & (abs(there - moved[:, 2]) < 0.04 * moved[:, 2])
            if seen.sum() < 50:
                continue
            pairs.append(Pair(f"{name} +{gap}", first.gray, second.gray, points[seen], truth[seen]))
    return pairs


def kitti() -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """The KITTI pair: colour frames (BGR), flow float32 ``[H, W, 2]``, validity."""
    folder = DATA / "flow/kitti"
    raw = cv2.imread(str(folder / "flow_gt.png"), cv2.IMREAD_UNCHANGED)[..., ::-1].astype(np.float32)
    frames = [cv2.imread(str(folder / name)) for name in ("frame1.png", "frame2.png")]
    return frames[0], frames[1], (raw[..., :2] - 2**15) / 64, raw[..., 2] > 0
