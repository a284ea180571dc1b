"""Renders frames of a scene: geometry, colour, depth as measured, masks and flow.

All rows of a frame see the scene from one pose, or each from its own under a rolling shutter: then the camera's pose is
exact for every row, while things and people are placed as they are when the middle of the image is exposed.
"""

from __future__ import annotations

import hashlib
import math
import os
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache, partial
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.core.settings import Settings
from dynslam_bench.sequences.synthetic import kernels, sensors
from dynslam_bench.sequences.synthetic.arithmetic import cos, exp, norm, power, product, sin
from dynslam_bench.sequences.synthetic.ids import SyntheticId
from dynslam_bench.sequences.synthetic.kernels import NEAR_M
from dynslam_bench.sequences.synthetic.parts import QUAD, ROUND_CONE
from dynslam_bench.sequences.synthetic.scene import Scene, Snapshot
from dynslam_bench.sequences.synthetic.settings import CAMERA, FPS, RenderSettings
from dynslam_bench.sequences.synthetic.textures import TextureAtlas

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

    def local(self, visible: NDArray[np.int32]) -> Array:
        """Maps ``[R, P, 12]`` from the camera to the primitives, as in `Snapshot`.

        Under a rolling shutter those of the primitives `visible` alone are filled in.
        """
        if not self.rolling:
            return self.middle.local[None]
        inverse = np.swapaxes(self.middle.rotation[visible], 1, 2) / self.scale[visible, :, None]
        poses = np.repeat(self.poses[:, None, :3], len(visible), axis=1)
        poses[..., 3] -= self.middle.origin[visible]
        local = np.empty((len(self.poses), len(self.scale), 12))
        local[:, visible] = (product(inverse, poses)).reshape(len(poses), -1, 12)
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


# Where in the image a primitive can be seen: the rectangle around the part of its box that lies before the camera.

_MARGIN_PX = 2.0
_EDGES = np.array([(i, i | 1 << axis) for axis in range(3) for i in range(8) if not i >> axis & 1])
"""The twelve edges of a box, as pairs of corners; bit k of a corner's number is its side along axis k."""


def bounds_of(points: Array) -> tuple[Array, Array, Array, Array, Array]:
    """Bounds of boxes.

    Args:
        points: Corners ``[P, 8, 3]`` in the camera frame, metres.

    Returns:
        Least depth of all corners, and least u, least v, greatest u, greatest v (pixels, with a margin); an empty
        rectangle (least above greatest) where a box lies behind the camera.
    """
    depth = points[:, :, 2]
    rectangle = _project(points, depth > NEAR_M)
    crossing = np.flatnonzero((depth.min(axis=1) <= NEAR_M) & (depth.max(axis=1) > NEAR_M))
    if len(crossing):
        a, b = points[crossing][:, _EDGES[:, 0]], points[crossing][:, _EDGES[:, 1]]
        cut = (a[..., 2] > NEAR_M) != (b[..., 2] > NEAR_M)
        share = (NEAR_M - a[..., 2]) / np.where(cut, b[..., 2] - a[..., 2], 1.0)
        ends = a + share[..., None] * (b - a)
        at_cut = _project(ends, cut)
        rectangle[:2, crossing] = np.minimum(rectangle[:2, crossing], at_cut[:2])
        rectangle[2:, crossing] = np.maximum(rectangle[2:, crossing], at_cut[2:])
    low_u, low_v, high_u, high_v = rectangle
    return depth.min(axis=1), low_u - _MARGIN_PX, low_v - _MARGIN_PX, high_u + _MARGIN_PX, high_v + _MARGIN_PX


def _project(points: Array, valid: NDArray[np.bool_]) -> Array:
    """Rectangle ``[4, P]`` (least u, v, greatest u, v) around the valid ones of points ``[P, K, 3]``."""
    z = np.where(valid, points[..., 2], 1.0)
    u = points[..., 0] / z * CAMERA.fx + CAMERA.cx
    v = points[..., 1] / z * CAMERA.fy + CAMERA.cy
    low = [np.where(valid, x, np.inf).min(axis=1) for x in (u, v)]
    high = [np.where(valid, x, -np.inf).max(axis=1) for x in (u, v)]
    return np.stack(low + high)


_BAND = 48
_JITTER = np.array([[-0.125, -0.375], [0.375, -0.125], [0.125, 0.375], [-0.375, 0.125]])

_MEAN_GREY = 105.0
"""What automatic exposure aims at."""
_NOISE_VERSION = 5
"""Seeds the noise of the sensors. It stays while versions of the renderer differ in last bits only."""
_SLACK_M = 0.01
"""How much nearer than in the rows that were looked at a thing may be in another one."""
Tiles = tuple[int, NDArray[np.int32], NDArray[np.int32], NDArray[np.float64]]
"""Tiles in a row, start of each tile's list, the lists, and the least depth of every primitive."""

_LAMPS = np.array([[0, 0, 1.0, 0.52], [0.25, -0.45, 0.86, 0.36], [-0.75, -0.6, 0.25, 0.2], [0.6, -0.7, 0.1, 0.1]])
"""Direction to each lamp in the world (not normalised) and its strength; row 0 is the ambient light."""


@dataclass(frozen=True, eq=False)
class Rendered:
    """One frame as it is stored.

    Attributes:
        rgb: uint8 ``[H, W, 3]``.
        raw_depth: uint16 ``[H, W]`` in units of 1 / 5000 m, 0 = missing, as the sensor measures it.
        instances: uint8 ``[H, W]``.
    """

    rgb: NDArray[np.uint8]
    raw_depth: NDArray[np.uint16]
    instances: NDArray[np.uint8]


class Renderer:
    """Renders any frame of one sequence; frames do not depend on each other nor on the number of threads.

    Args:
        sequence: Which sequence.
        settings: Renderer settings.
        threads: Threads that share the rows of a frame; None for the cores there are, at most four.
    """

    def __init__(self, sequence: SyntheticId, settings: RenderSettings, threads: int | None = None) -> None:
        self.settings = settings
        self.scene = Scene(sequence.world(), sequence.scene, settings)
        self._view = lru_cache(maxsize=8)(partial(view_of, self.scene))
        """How a frame sees the scene; neighbouring frames ask for the same views."""
        self.depth_sensor = _adapted(settings.depth, self.scene.world.optics.depth)
        self.color_sensor = _adapted(settings.color, self.scene.world.optics.color)
        self.threads = threads or default_threads()
        self._pool: ThreadPoolExecutor | None = None
        self._pool_process = 0
        text = f"{_NOISE_VERSION}/{sequence.name}@{sequence.scene}"
        text += "" if sequence.noise is None else f"/noise={sequence.noise}"
        self._seed = int.from_bytes(hashlib.sha256(text.encode()).digest()[:6], "little")
        self._intrinsics = (CAMERA.fx, CAMERA.fy, CAMERA.cx, CAMERA.cy)

    @cached_property
    def atlas(self) -> TextureAtlas:
        """The textures; drawn when the first frame is coloured."""
        return self.scene.atlas()

    def prepare(self) -> None:
        """Draw the textures now: once, before several threads render."""
        self._density  # noqa: B018

    def render(self, index: int) -> Rendered:
        """Render frame `index`."""
        settings = self.settings
        now = self._view(index)
        tiles, local = self._tiles(now)
        hit, depth = self._geometry(tiles, local)
        color, cosine = self._shade(now, tiles, local, hit, depth, index / FPS)
        raw = self._measure(index, depth, cosine, color)
        if settings.shadow:
            self._shadow(now.middle, index / FPS, depth, color)
        if settings.glare:
            color += self._glare(now.middle, index / FPS)
        if self.color_sensor.shutter > 0:
            color = self._blur(now, index, hit, depth, color)
        rgb = self._expose(index, color)
        ids = np.append(self.scene.instance, 0).astype(np.uint8)
        return Rendered(rgb, raw, ids[hit >> 3])

    def flow(self, index: int, other: int) -> NDArray[np.float32]:
        """Exact flow float32 ``[H, W, 2]`` in pixels from frame `index` to frame `other`; NaN where there is none.

        It is the motion of the surface point seen at each pixel centre, also where it is hidden in the other frame.
        """
        now, after = self._view(index), self._view(other)
        hit, depth = self._geometry(*self._tiles(now))
        if now.rolling:
            return rolling_flow(now, after, hit, depth)
        flow = np.empty((*hit.shape, 2), np.float32)
        motion = self._motion(now.middle, after.middle)
        self._rows(lambda a, b: kernels.flow_field(a, b, self._intrinsics, hit, depth, motion, flow))
        return flow

    def geometry(self, index: int) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
        """Exact z-depth (metres, 0 = nothing) and instance ids of frame `index`, without shading."""
        now = self._view(index)
        hit, depth = self._geometry(*self._tiles(now))
        return depth, np.append(self.scene.instance, 0).astype(np.uint8)[hit >> 3]

    def _shade(
        self,
        now: View,
        tiles: Tiles,
        local: NDArray[np.float64],
        hit: NDArray[np.int32],
        depth: NDArray[np.float64],
        time: float,
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Colour ``[H, W, 3]`` and cosine of incidence ``[H, W]``; a rolling shutter's normals are those of a band."""
        scene, atlas = self.scene, self.atlas
        color = np.empty((CAMERA.height, CAMERA.width, 3), np.float32)
        cosine = np.empty((CAMERA.height, CAMERA.width), np.float32)
        jitter = _JITTER if self.settings.antialias else np.zeros((1, 2))

        def work(a: int, b: int) -> None:
            snapshot = now.at_row((a + b) // 2)
            lights = self._lights(snapshot, time)
            facets = self._facets(snapshot, lights)
            for first, end, maps in _rows_of(local, a, b):
                kernels.shade_pixels(
                    first, end, self._intrinsics, *tiles, scene.kind, maps, scene.shape, scene.texture, scene.uv,
                    scene.tint, facets, atlas.texels, atlas.level_offset, atlas.log2_size, lights, hit, depth, jitter,
                    color, cosine,
                )  # fmt: skip

        self._rows(work, bands=now.rolling)
        return color, cosine

    def _blur(
        self, now: View, index: int, hit: NDArray[np.int32], depth: NDArray[np.float64], sharp: NDArray[np.float32]
    ) -> NDArray[np.float32]:
        """Motion blur; under a rolling shutter along the motion of each band's middle row."""
        flow, blurred = np.empty((*hit.shape, 2), np.float32), np.empty_like(sharp)
        after = self._view(index + 1)

        def work(a: int, b: int) -> None:
            row = (a + b) // 2
            motion = self._motion(now.at_row(row), after.at_row(row))
            kernels.flow_field(a, b, self._intrinsics, hit, depth, motion, flow)

        self._rows(work, bands=now.rolling)
        shutter, exact, shares = (
            self.color_sensor.shutter,
            sharp.astype(np.float64).ravel(),
            kernels.tap_shares(),
        )
        self._rows(lambda a, b: kernels.motion_blur(a, b, sharp, exact, shares, flow, shutter, blurred))
        return blurred

    def _rows(self, work: Callable[[int, int], None], *, bands: bool = False) -> None:
        """Share the rows among the threads; `bands` asks for the same bands whatever the number of threads."""
        parts = [(a, min(a + _BAND, CAMERA.height)) for a in range(0, CAMERA.height, _BAND)]
        if self.threads == 1:
            for a, b in parts if bands else [(0, CAMERA.height)]:
                work(a, b)
            return
        if self._pool is None or self._pool_process != os.getpid():  # threads do not survive a fork
            self._pool, self._pool_process = ThreadPoolExecutor(self.threads), os.getpid()
        for done in [self._pool.submit(work, a, b) for a, b in parts]:
            done.result()

    def _tiles(self, view: View) -> tuple[Tiles, NDArray[np.float64]]:
        """Bin the primitives into tiles by the bounds of their boxes, as seen by several rows of a rolling shutter.

        Returns:
            The tiles, and the maps from the camera to what lies in them (`View.local`).
        """
        scene, snap = self.scene, view.middle
        world = (
            product(scene.corners * scene.scale[:, None, :], np.swapaxes(snap.rotation, 1, 2)) + snap.origin[:, None, :]
        )
        chosen = np.linspace(0, len(view.poses) - 1, 9 if view.rolling else 1).astype(int)
        bounds = [bounds_of(product(world - pose[:3, 3], pose[:3, :3])) for pose in view.poses[chosen]]
        nearest, low_u, low_v = (np.min([bound[k] for bound in bounds], axis=0) for k in range(3))
        high_u, high_v = (np.max([bound[k] for bound in bounds], axis=0) for k in (3, 4))
        if view.rolling:
            nearest = nearest - _SLACK_M
        tiles_x, tiles_y = -(-CAMERA.width // kernels.TILE), -(-CAMERA.height // kernels.TILE)
        visible = (high_u >= 0) & (low_u < CAMERA.width) & (high_v >= 0) & (low_v < CAMERA.height)
        boxes = np.stack(
            [
                np.clip(low_u, 0, CAMERA.width - 1),
                np.clip(low_v, 0, CAMERA.height - 1),
                np.clip(high_u, 0, CAMERA.width - 1),
                np.clip(high_v, 0, CAMERA.height - 1),
            ],
            axis=1,
        )
        boxes = (boxes // kernels.TILE).astype(np.int32)
        order = np.argsort(nearest, kind="stable")
        order = order[visible[order]].astype(np.int32)
        start, members = kernels.bin_tiles(order, boxes, tiles_x, tiles_y)
        tiles = tiles_x, np.asarray(start, np.int32), np.asarray(members, np.int32), nearest
        return tiles, view.local(order)

    def _geometry(self, tiles: Tiles, local: NDArray[np.float64]) -> tuple[NDArray[np.int32], NDArray[np.float64]]:
        """What every pixel sees (`cast_geometry`) and its z-depth in metres."""
        hit = np.empty((CAMERA.height, CAMERA.width), np.int32)
        depth = np.empty((CAMERA.height, CAMERA.width))

        def work(a: int, b: int) -> None:
            for first, end, maps in _rows_of(local, a, b):
                kernels.cast_geometry(
                    first, end, self._intrinsics, *tiles, self.scene.kind, maps, self.scene.shape, hit, depth
                )

        self._rows(work)
        return hit, depth

    def _motion(self, now: Snapshot, other: Snapshot) -> NDArray[np.float64]:
        """Maps ``[P, 12]`` from points in this camera's frame, fixed to a primitive, to the other camera's frame."""
        turn = product(other.rotation, np.swapaxes(now.rotation, 1, 2))
        shift = other.origin - product(turn, now.origin[:, :, None])[:, :, 0]
        to_other = other.T_world_cam[:3, :3].T
        result = np.empty((len(shift), 3, 4))
        result[:, :, :3] = product(to_other, turn, now.T_world_cam[:3, :3])
        moved = product(turn, now.T_world_cam[:3, 3]) + shift - other.T_world_cam[:3, 3]
        result[:, :, 3] = product(moved, to_other.T)
        return np.ascontiguousarray(result.reshape(-1, 12))

    def _lights(self, snap: Snapshot, time: float) -> NDArray[np.float64]:
        """Directions to the lights in the camera frame, and strengths; row 0 is the ambient light."""
        rows = _LAMPS.copy()
        rows[:, :3] /= norm(rows[:, :3])[:, None]
        if self.settings.lighting_change:
            rows[:, 3] *= 0.78 + 0.22 * cos(2 * math.pi * time / 7.0)
            if sin(2 * math.pi * time / 4.7) > 0.3:
                rows[2, 3] += 0.25
        rows[:, :3] = product(rows[:, :3], snap.T_world_cam[:3, :3])
        return np.ascontiguousarray(rows)

    def _facets(self, snap: Snapshot, lights: NDArray[np.float64]) -> NDArray[np.float64]:
        """What is the same all over a face ``[P, 6, 5]``: normal in the camera frame, light, texels a pixel at 1 m."""
        scene = self.scene
        axes = product(snap.T_world_cam[:3, :3].T, snap.rotation).transpose(0, 2, 1)
        facets = np.empty((len(axes), 6, 5))
        facets[:, 0::2, :3], facets[:, 1::2, :3] = -axes, axes
        facets[scene.kind == QUAD, 4:, :3] = axes[scene.kind == QUAD, 2:]
        to_camera = snap.T_world_cam[:3, 3] - snap.origin
        behind = (product(to_camera[:, None, :], snap.rotation) < 0)[:, 0, 2] & (scene.kind == QUAD)
        facets[behind, 4:, :3] *= -1
        facets[:, :, 3] = lights[0, 3] + product(
            np.maximum(product(facets[:, :, :3], lights[1:, :3].T), 0), lights[1:, 3]
        )
        facets[:, :, 4] = self._density
        return facets

    @cached_property
    def _density(self) -> NDArray[np.float64]:
        """Texels a pixel at 1 m on each face ``[P, 6]`` seen at right angles."""
        scene = self.scene
        repeats = np.abs(scene.uv[:, :, :2])
        cones = scene.kind == ROUND_CONE
        girth = math.pi * np.maximum(scene.shape[cones, 1] + scene.shape[cones, 2], 2e-3)
        repeats[cones, :, 0] /= girth[:, None]
        repeats[cones] /= scene.scale[cones].mean(axis=1)[:, None, None]
        return np.asarray(repeats.max(axis=2) * (1 << self.atlas.log2_size[scene.texture]) / CAMERA.fx)

    def _shadow(self, snap: Snapshot, time: float, depth: NDArray[np.float64], color: NDArray[np.float32]) -> None:
        """Soft shadows of things outside the picture, sweeping over the room."""
        light = _LAMPS[1, :3] / _LAMPS[1, 2]
        sweep = 1.6 * sin(2 * math.pi * time / 6.3)
        spots = np.array(
            [
                [sweep + light[0] * 1.2, 0.7 + 0.3 * sin(1.1 * time), 1.0, 0.5],
                [-0.7 * sweep + light[0] * 1.2, 2.9, 0.9, 0.4],
            ]
        )
        pose = snap.T_world_cam
        self._rows(lambda a, b: sensors.dim(a, b, self._intrinsics, pose, depth, light, 2.2, spots, color))

    def _glare(self, snap: Snapshot, time: float) -> NDArray[np.float32]:
        """A bright veil ``[H, W, 1]`` around a window beside the room's back wall, brightening and fading."""
        window = np.array(self.scene.world.window)
        x, y, z = product(window - snap.T_world_cam[:3, 3], snap.T_world_cam[:3, :3])
        if z <= 0.1:
            return np.zeros((CAMERA.height, CAMERA.width, 1), np.float32)
        u, v = x / z * CAMERA.fx + CAMERA.cx, y / z * CAMERA.fy + CAMERA.cy
        strength = 110 * (0.6 + 0.4 * sin(2 * math.pi * time / 5.3))
        across = exp(-(((np.arange(CAMERA.width) - u) / 210.0) ** 2))
        down = exp(-(((np.arange(CAMERA.height) - v) / 180.0) ** 2))
        return np.asarray((strength * down[:, None] * across[None, :])[..., None], np.float32)

    def _measure(
        self, index: int, depth: NDArray[np.float64], cosine: NDArray[np.float32], color: NDArray[np.float32]
    ) -> NDArray[np.uint16]:
        sensor = self.depth_sensor
        if not sensor.noise:
            return np.clip(np.floor(depth * CAMERA.depth_factor + 0.5), 0, 65535).astype(np.uint16)
        raw = np.empty(depth.shape, np.uint16)
        seed = np.uint64((self._seed + 0x9E3779B97F4A7C15 * (2 * index)) & 0xFFFFFFFFFFFFFFFF)
        self._rows(
            lambda a, b: sensors.measure_depth(
                a,
                b,
                seed,
                CAMERA.fx,
                CAMERA.baseline_m,
                depth,
                cosine,
                color,
                sensor.disparity_noise_px,
                sensor.near_m,
                sensor.far_m,
                sensor.edge_px,
                sensor.dark,
                CAMERA.depth_factor,
                raw,
            )
        )
        return raw

    def _expose(self, index: int, color: NDArray[np.float32]) -> NDArray[np.uint8]:
        """Exposure of a rolling readout (drift and mains flicker), noise and rounding."""
        sensor, optics = self.color_sensor, self.scene.world.optics
        rows = np.arange(CAMERA.height)
        time = index / FPS + rows / CAMERA.height / FPS * 0.9
        gain = 1 + sensor.exposure_drift * (
            0.7 * sin(2 * math.pi * time / 6.1) + 0.3 * sin(2 * math.pi * time / 1.9 + 1.0)
        )
        gain *= 1 + sensor.flicker * sin(2 * math.pi * 100.0 * time * 1.0013)
        if optics.gain != 1 or optics.auto_exposure:
            mean = max(float(color.mean(dtype=np.float64)) * optics.gain, 1.0)
            gain *= optics.gain * power(_MEAN_GREY / mean, optics.auto_exposure)
        rgb = np.empty(color.shape, np.uint8)
        seed = np.uint64((self._seed + 0x9E3779B97F4A7C15 * (2 * index + 1)) & 0xFFFFFFFFFFFFFFFF)
        read, shot = (sensor.read_noise, sensor.shot_noise) if sensor.noise else (0.0, 0.0)
        self._rows(lambda a, b: sensors.expose(a, b, seed, color, gain, read, shot, rgb))
        return rgb


def _rows_of(local: NDArray[np.float64], first: int, end: int) -> Iterator[tuple[int, int, NDArray[np.float64]]]:
    """Runs of rows that share a pose: first row, one past the last, the maps into the primitives' frames."""
    if len(local) == 1:
        yield first, end, local[0]
        return
    for row in range(first, end):
        yield row, row + 1, local[row]


SensorSettings = TypeVar("SensorSettings", bound=Settings)


def _adapted(sensor: SensorSettings, family: Mapping[str, Any]) -> SensorSettings:
    """The sensor's settings with those of the family where the user left the default."""
    return sensor.model_copy(update={k: v for k, v in family.items() if k not in sensor.model_fields_set})


def default_threads() -> int:
    """Cores this process may use, at most four; ``NUMBA_NUM_THREADS`` lowers it."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    limit = os.environ.get("NUMBA_NUM_THREADS", "")
    return max(1, min(cores, 4, int(limit) if limit.isdigit() and int(limit) > 0 else 4))
