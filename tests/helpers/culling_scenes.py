"""Constructed scenes: exact flow and depth of static and moving points seen by a moving camera."""

from dataclasses import dataclass, replace

import cv2
import numpy as np

from dynslam_bench.contracts import (
    FilterState,
    FlowResult,
    FrameBundle,
    Instances,
    KeyframeView,
    Keypoints,
)
from dynslam_bench.geometry import Camera, se3
from dynslam_bench.segmentation.settings import SegmentationSettings

CAMERA = Camera(640, 480, 535.4, 539.2, 320.1, 247.6)
SEGMENTATION = SegmentationSettings(dilation_px=0)
SIDEWAYS = se3.exp(np.array([0.06, 0.02, 0.03, 0.01, -0.01, 0.005]))
ROTATION = se3.exp(np.array([0, 0, 0, 0.02, 0.03, 0.01]))
ACROSS = np.array([0.0, 0.05, 0.0])
BOX = (200, 100, 331, 381)


@dataclass
class Scene:
    frame: FrameBundle
    state: FilterState
    moving: np.ndarray


def keypoints(xy: np.ndarray) -> Keypoints:
    n = len(xy)
    return Keypoints(
        xy.astype(np.float32),
        np.zeros(n, np.int32),
        np.zeros(n, np.float32),
        np.ones(n, np.float32),
        np.zeros((n, 32), np.uint8),
    )


def bundle(xy: np.ndarray, z: np.ndarray, depth: np.ndarray, timestamp: float) -> FrameBundle:
    gray = np.zeros(depth.shape, np.uint8)
    return FrameBundle(
        0,
        timestamp,
        np.zeros((*depth.shape, 3), np.uint8),
        gray,
        depth,
        keypoints(xy),
        xy,
        z.astype(np.float32),
    )


def splat(xy: np.ndarray, z: np.ndarray, background: float = 0.0) -> np.ndarray:
    """A depth image that has each point's depth on a 7x7 patch, the nearer ones on top."""
    depth = np.full((CAMERA.height, CAMERA.width), background, np.float32)
    for i in np.argsort(-z):
        column, row = np.rint(xy[i]).astype(int)
        depth[max(row - 3, 0) : row + 4, max(column - 3, 0) : column + 4] = z[i]
    return depth


def on_top(xy: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Which points no other point's patch covers."""
    return ~((np.abs(xy[:, None] - xy[None]).max(axis=2) < 5) & (z[None] < z[:, None])).any(axis=1)


def scene(
    T_prev_cur: np.ndarray,
    *,
    n_static: int = 300,
    n_moving: int = 60,
    motion: np.ndarray | None = None,
    noise_px: float = 0.1,
    seed: int = 0,
    instances: Instances | None = None,
    depths: tuple[float, float] = (1.0, 4.0),
    camera: Camera = CAMERA,
) -> Scene:
    """Static points all over the image, moving ones inside x 200..330, y 100..380 at 1.5 m.

    `motion` [3] is the moving points' displacement between the frames, metres, in the previous
    camera frame. `camera` is `CAMERA` with any distortion, which moves where the keypoints and the
    ends of their flow lie in the image.
    """
    rng = np.random.default_rng(seed)
    xy = np.concatenate(
        [
            rng.uniform((20, 20), (620, 460), (n_static, 2)),
            rng.uniform((200, 100), (330, 380), (n_moving, 2)),
        ]
    )
    z = np.concatenate([rng.uniform(*depths, n_static), rng.uniform(1.45, 1.55, n_moving)])
    moving = np.arange(len(xy)) >= n_static
    previous_points = se3.transform(T_prev_cur, CAMERA.unproject(xy, z))
    if motion is not None:
        previous_points[moving] -= motion
    before = CAMERA.project(previous_points) + rng.normal(0, noise_px, xy.shape)
    visible = (before > 5).all(axis=1) & (before < (634, 474)).all(axis=1)
    visible &= on_top(xy, z) & on_top(before, previous_points[:, 2])
    xy, z, moving, before, previous_points = (
        array[visible] for array in (xy, z, moving, before, previous_points)
    )
    frame = replace(
        bundle(xy, z, splat(xy, z), 1.0),
        keypoints=keypoints(camera.distort_points(xy)),
        instances=instances,
    )
    previous = bundle(
        before, previous_points[:, 2], splat(before, previous_points[:, 2]), 1.0 - 1 / 30
    )
    state = FilterState(
        camera=camera,
        keep=np.ones(len(xy), bool),
        previous=previous,
        previous_keep=np.ones(len(xy), bool),
        T_world_prev=np.eye(4),
        T_world_pred=T_prev_cur,
        flow=FlowResult(
            camera.distort_points(before).astype(np.float32),
            np.ones(len(xy), bool),
            np.zeros(len(xy), np.float32),
        ),
    )
    return Scene(frame, state, moving)


def box_instance(x0: int, y0: int, x1: int, y1: int, name: str = "person") -> Instances:
    mask = np.zeros((1, CAMERA.height, CAMERA.width), bool)
    mask[0, y0:y1, x0:x1] = True
    return Instances(
        mask, np.array([[x0, y0, x1, y1]], np.float32), (name,), np.ones(1, np.float32)
    )


def on_rectangle(made: Scene | FrameBundle, x0: int, y0: int, x1: int, y1: int) -> np.ndarray:
    """Which keypoints, rounded to pixels, lie on a rectangle."""
    x, y = np.rint((made.frame if isinstance(made, Scene) else made).keypoints.xy).T
    return (x >= x0) & (x < x1) & (y >= y0) & (y < y1)


def keyframe(T_world_cam: np.ndarray, depth: np.ndarray, timestamp: float) -> KeyframeView:
    empty = np.zeros((0, 2))
    return KeyframeView(
        T_world_cam, keypoints(empty), empty, np.zeros(0, np.float32), depth, timestamp
    )


def at_rest(
    frame: FrameBundle, previous: FrameBundle | None = None, keyframes: tuple = ()
) -> FilterState:  # type: ignore[type-arg]
    """The state of a camera at rest at the origin."""
    pose = np.eye(4)
    return FilterState(
        CAMERA,
        np.ones(len(frame), bool),
        previous=previous,
        T_world_prev=pose,
        T_world_pred=pose,
        keyframes=keyframes,
    )


def texture(seed: int) -> np.ndarray:
    noise = np.random.default_rng(seed).integers(0, 255, (480, 640), dtype=np.uint8)
    return cv2.normalize(cv2.GaussianBlur(noise, (0, 0), 2.0), None, 0, 255, cv2.NORM_MINMAX)


def moved_patch(shift: int) -> tuple[np.ndarray, np.ndarray]:
    """Two images of a textured wall; the box's texture has moved by `shift` pixels downwards in the second."""
    wall = texture(0)
    person = texture(1)
    x0, y0, x1, y1 = BOX
    before = wall.copy()
    after = wall.copy()
    before[y0:y1, x0:x1] = person[y0:y1, x0:x1]
    after[y0:y1, x0:x1] = person[y0 - shift : y1 - shift, x0:x1]
    return before, after
