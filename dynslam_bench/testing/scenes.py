"""Small exact scenes for conformance checks: a corner with a moving panel, and the corner from a turning camera."""

from dataclasses import replace
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from dynslam_bench.contracts import Camera, Frame, FrameMasks, MaskSource, Trajectory
from dynslam_bench.geometry import se3


class CornerSequence:
    """Two textured walls that meet in a corner, and a textured panel that slides along; everything is exact.

    It is drawn by intersecting each pixel's ray with three planes, so that it needs no renderer and
    no data.

    Args:
        frames: Number of frames at 30 Hz.
    """

    id = "synthetic/conformance"
    """Under ``synthetic/`` exact masks count as available."""
    license = "CC0-1.0"
    citation = "dynslam-bench"
    fps = 30.0
    camera = Camera(640, 480, 535.4, 539.2, 320.1, 247.6, depth_factor=5000.0)
    has_panel = True
    detail = 1.0
    """Detail of the texture: small images hold less."""

    def __init__(self, frames: int = 8) -> None:
        self._count = frames
        self.timestamps: NDArray[np.float64] = np.round(100.0 + np.arange(frames) / 30, 6)
        self.ground_truth: Trajectory | None = Trajectory(
            self.timestamps, np.stack([self.pose(index) for index in range(frames)])
        )

    @property
    def masks(self) -> MaskSource | None:
        """Exact masks of the panel, which counts as a person that moves."""
        return _Masks(self)

    def digest(self) -> str:
        """A function of the parameters."""
        return f"{self.id}-{self._count}"

    def __len__(self) -> int:
        return self._count

    def __getitem__(self, index: int) -> Frame:
        index = range(self._count)[index]
        rgb, depth, _ = draw(type(self), index)  # type: ignore[arg-type]  # mypy: a class is no Hashable
        return Frame(index, float(self.timestamps[index]), rgb.copy(), depth.copy())

    @staticmethod
    def pose(index: int) -> NDArray[np.float64]:
        """The camera's pose ``[4, 4]``, camera to world, at a frame."""
        pose = np.eye(4)
        pose[:3, 3] = 0.012 * index, 0.004 * np.sin(index), 0.006 * index
        return pose


class TurningSequence(CornerSequence):
    """The walls, filmed in small images by a camera that moves along all axes and turns about them.

    World-to-camera poses, other axes and other units are told apart from right ones by its path.

    Args:
        frames: Number of frames at 30 Hz.
    """

    id = "synthetic/conformance_turning"
    camera = Camera(320, 240, 267.7, 269.6, 159.8, 123.6, depth_factor=5000.0)
    has_panel = False
    detail = 1 / 3

    def __init__(self, frames: int = 24) -> None:
        super().__init__(frames)

    @staticmethod
    def pose(index: int) -> NDArray[np.float64]:
        """The camera's pose ``[4, 4]``, camera to world, at a frame."""
        # a loop of 24 frames: metres along the axes, radians about them
        phase = 2 * np.pi * index / 24
        translation = 0.12 * np.sin(phase), 0.06 * np.sin(2 * phase), 0.08 * (1 - np.cos(phase))
        rotation = 0.05 * np.sin(2 * phase), 0.1 * np.sin(phase + 1), 0.08 * np.cos(phase)
        return se3.exp(np.array([*translation, *rotation]))


class _Masks:
    """The panel's masks, frame by frame; in the first frame nothing has moved yet."""

    def __init__(self, sequence: CornerSequence) -> None:
        self._sequence = sequence

    def __getitem__(self, index: int) -> FrameMasks:
        number = range(len(self._sequence))[index]
        _, _, panel = draw(type(self._sequence), number)  # type: ignore[arg-type]
        moving = frozenset({1} if index and panel.any() else ())
        return FrameMasks(panel.astype(np.uint8), {1: "person"}, moving)


def grey(frame: Frame) -> NDArray[np.uint8]:
    """A frame's brightness, uint8 ``[H, W]``."""
    return np.asarray(cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2GRAY), np.uint8)


def hard_frames(like: Frame) -> dict[str, Frame]:
    """Frames on which a tracker must not fail, by name.

    Args:
        like: A frame whose index, stamp and size they take.
    """
    black = np.zeros_like(like.rgb)
    flat = np.full_like(like.rgb, 128)
    noise = np.random.default_rng(3).integers(0, 256, like.rgb.shape, dtype=np.uint8)
    zero = np.zeros_like(like.depth)
    return {
        "all-black": replace(like, rgb=black, depth=zero),
        "saturated": replace(like, rgb=np.full_like(like.rgb, 255)),
        "zero depth": replace(like, depth=zero),
        "textureless": replace(like, rgb=flat, depth=np.full_like(like.depth, 2.0)),
        "noise": replace(like, rgb=noise),
    }


@lru_cache(maxsize=32)  # the 4 frames and the 24 turning ones of `tracker_report`; 25 MB
def draw(
    scene: type[CornerSequence], index: int
) -> tuple[NDArray[np.uint8], NDArray[np.float32], NDArray[np.bool_]]:
    """Colour uint8 ``[H, W, 3]``, depth float32 ``[H, W]`` in metres, and the panel's mask, of a frame."""
    camera = scene.camera
    pose = scene.pose(index)
    centre = pose[:3, 3]
    v, u = np.mgrid[: camera.height, : camera.width]

    # rays through all pixels, in the world, with a length of 1 along the camera's optical axis
    rays = np.stack(
        [(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(u.shape)], axis=-1
    )
    ray_x, ray_y, ray_z = np.moveaxis(rays @ pose[:3, :3].T, -1, 0)

    # depth along each ray of the walls z = 2.6 + 0.5 x and z = 2.6 - 0.7 x in metres; the nearer
    # wall is seen
    walls = [
        (2.6 + slope * centre[0] - centre[2]) / (ray_z - slope * ray_x) for slope in (0.5, -0.7)
    ]
    depth = np.minimum(*[np.where(wall > 0, wall, np.inf) for wall in walls])
    x = centre[0] + depth * ray_x
    y = centre[1] + depth * ray_y

    # the panel z = 1.5, 0.25 m wide and 0.8 m high, which moves 0.03 m to the right in a frame
    left = -0.35 + 0.03 * index
    panel_depth = (1.5 - centre[2]) / ray_z
    panel_x = centre[0] + panel_depth * ray_x
    panel_y = centre[1] + panel_depth * ray_y
    panel = np.asarray(
        scene.has_panel & (panel_x > left) & (panel_x < left + 0.25) & (np.abs(panel_y) < 0.4)
    )

    # what is seen, and its place on the texture; the panel has a part of its own, which moves along
    depth = np.where(panel, panel_depth, depth)
    x = np.where(panel, panel_x - left + 7.3, x)
    y = np.where(panel, panel_y + 3.1, y)
    return _sample(_texture(), scene.detail * x, scene.detail * y), depth.astype(np.float32), panel


@lru_cache(maxsize=1)
def _texture(size: int = 512) -> NDArray[np.float64]:
    """Random rectangles over a coarse pattern, ``[size, size, 3]``, which repeats at its edges."""
    rng = np.random.default_rng(5)
    texture = rng.uniform(60, 200, (size // 32, size // 32, 3)).repeat(32, 0).repeat(32, 1)
    for _ in range(900):
        x, y, w, h = rng.integers([0, 0, 4, 4], [size, size, 40, 40])
        texture[y : y + h, x : x + w] = rng.uniform(0, 255, 3)
    return texture


def _sample(
    texture: NDArray[np.float64], x: NDArray[np.float64], y: NDArray[np.float64]
) -> NDArray[np.uint8]:
    """Colours ``[..., 3]`` of a wall, bilinear, 250 texels a metre.

    Args:
        texture: ``[S, S, 3]``, repeated.
        x: Metres along the wall, any shape.
        y: Metres, of the same shape.
    """
    size = len(texture)
    x = x * 250
    y = y * 250
    # corners of the texel grid around each position, and the position between them
    x0 = np.floor(x).astype(np.int64)
    y0 = np.floor(y).astype(np.int64)
    fx = (x - x0)[..., None]
    fy = (y - y0)[..., None]
    x0 = x0 % size
    y0 = y0 % size
    x1 = (x0 + 1) % size
    y1 = (y0 + 1) % size
    top = texture[y0, x0] * (1 - fx) + texture[y0, x1] * fx
    bottom = texture[y1, x0] * (1 - fx) + texture[y1, x1] * fx
    return np.round(top * (1 - fy) + bottom * fy).astype(np.uint8)
