"""How a frame's rows see the scene: all from one pose, or each from its own under a rolling shutter.

Under a rolling shutter the camera's pose is exact for every row; things and people are placed as they are when the
middle of the image is exposed.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from .arithmetic import product
from .scenes.scene import Scene, Snapshot
from .settings import CAMERA, FPS

Array = NDArray[np.float64]
_ROUNDS = 5
"""Rounds of the search for the row that sees a point; each shrinks the error by the rows' motion a row, 0.1 or less."""


@dataclass(frozen=True, eq=False)
class View:
    """The scene as the rows of one frame see it.

    Attributes:
        middle: The scene when the middle of the image is exposed.
        poses: ``[R, 4, 4]`` camera poses of all rows; R is 1 or the height of the image.
        scale: ``[P, 3]`` scale of each primitive's local axes.
    """

    middle: Snapshot
    poses: Array
    scale: Array

    @property
    def rolling(self) -> bool:
        """Whether every row has its own pose."""
        return len(self.poses) > 1

    def local(self, seen: NDArray[np.int32]) -> Array:
        """Maps ``[R, P, 12]`` from the camera to the primitives, as in `Snapshot`.

        Under a rolling shutter those of the primitives `seen` alone are filled in.
        """
        if not self.rolling:
            return self.middle.local[None]
        inverse = np.swapaxes(self.middle.rotation[seen], 1, 2) / self.scale[seen, :, None]
        poses = np.repeat(self.poses[:, None, :3], len(seen), axis=1)
        poses[..., 3] -= self.middle.origin[seen]
        local = np.empty((len(self.poses), len(self.scale), 12))
        local[:, seen] = (product(inverse, poses)).reshape(len(poses), -1, 12)
        return local

    def at_row(self, row: int) -> Snapshot:
        """The scene from the pose of a row."""
        return self.middle if not self.rolling else replace(self.middle, T_world_cam=self.poses[row])


def row_times(index: int, readout_s: float) -> Array:
    """When each row of frame `index` is exposed, seconds from the start; the image's middle at the frame's stamp."""
    rows = (np.arange(CAMERA.height) + 0.5) / CAMERA.height - 0.5
    return index / FPS + rows * readout_s


def view_of(scene: Scene, index: int) -> View:
    """How frame `index` sees the scene."""
    middle, readout = scene.snapshot(index / FPS), scene.world.optics.readout_s
    if readout == 0:
        return View(middle, middle.T_world_cam[None], scene.scale)
    return View(middle, scene.poses(row_times(index, readout)), scene.scale)


def rolling_flow(now: View, other: View, hit: NDArray[np.int32], depth: Array) -> NDArray[np.float32]:
    """Exact flow float32 ``[H, W, 2]`` in pixels between frames whose rows have poses of their own.

    A point is seen in the other frame by the row onto which that very row's pose projects it. Beyond the image's first
    and last row the pose goes on as that row's.
    """
    v, u = np.mgrid[0 : CAMERA.height, 0 : CAMERA.width].astype(np.float64)
    rays = np.stack([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, np.ones_like(u)], axis=-1)
    turns, places = now.poses[:, :3, :3], now.poses[:, :3, 3]
    world = product(rays * depth[..., None], np.swapaxes(turns, 1, 2)) + places[:, None]
    turn = product(other.middle.rotation, np.swapaxes(now.middle.rotation, 1, 2))
    shift = other.middle.origin - product(turn, now.middle.origin[:, :, None])[:, :, 0]
    primitive = np.maximum(hit >> 3, 0)
    world = product(turn[primitive], world[..., None])[..., 0] + shift[primitive]
    row, last = v.copy(), CAMERA.height - 1
    for _ in range(_ROUNDS):
        first = np.clip(np.floor(row), 0, last - 1).astype(np.int64)
        share = np.clip(row - first, 0.0, 1.0)[..., None]
        ends = []
        for near in (first, first + 1):
            away = world - other.poses[near, :3, 3]
            ends.append(product(away[..., None, :], other.poses[near, :3, :3])[..., 0, :])
        points = (1 - share) * ends[0] + share * ends[1]
        w = np.where(points[..., 2] > 0.05, points[..., 2], np.nan)
        x, row_now = points[..., 0] / w * CAMERA.fx + CAMERA.cx, points[..., 1] / w * CAMERA.fy + CAMERA.cy
        row = np.where(np.isfinite(row_now), row_now, row)
    flow = np.stack([x - u, row_now - v], axis=-1)
    flow[hit < 0] = np.nan
    return flow.astype(np.float32)
