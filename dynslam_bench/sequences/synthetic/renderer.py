"""Renders frames of a scene: geometry, colour, depth as measured, masks and flow.

All rows of a frame see the scene from one pose, or each from its own under a rolling shutter. Then
the camera's pose is exact for every row, while things and people are placed as they are when the
middle of the image is exposed.
"""

import hashlib
import math
import os
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.core.settings import Settings
from dynslam_bench.sequences.synthetic import kernels
from dynslam_bench.sequences.synthetic.arithmetic import Array, cos, exp, norm, power, product, sin
from dynslam_bench.sequences.synthetic.ids import SyntheticId
from dynslam_bench.sequences.synthetic.kernels import NEAR_M, TILE
from dynslam_bench.sequences.synthetic.parts import QUAD, ROUND_CONE
from dynslam_bench.sequences.synthetic.scene import Scene, View
from dynslam_bench.sequences.synthetic.settings import CAMERA, FPS, RenderSettings

SIZE = CAMERA.height, CAMERA.width
_INTRINSICS = CAMERA.fx, CAMERA.fy, CAMERA.cx, CAMERA.cy
_FOCAL = _INTRINSICS[:2]
_CENTRE = _INTRINSICS[2:]
_ROUNDS = 5
"""Rounds of the search for the row that sees a point; each shrinks the error by the rows' motion a row, 0.1 or less."""
_MARGIN_PX = 2.0
_BAND = 48
_JITTER = np.array([[-0.125, -0.375], [0.375, -0.125], [0.125, 0.375], [-0.375, 0.125]])
_MEAN_GREY = 105.0
"""What automatic exposure aims at."""
_NOISE_VERSION = 5
"""Seeds the noise of the sensors. It stays while versions of the renderer differ in last bits only."""
_SLACK_M = 0.01
"""How much nearer than in the rows that were looked at a thing may be in another one."""
_LAMPS = np.array(
    [[0, 0, 1.0, 0.52], [0.25, -0.45, 0.86, 0.36], [-0.75, -0.6, 0.25, 0.2], [0.6, -0.7, 0.1, 0.1]]
)
"""Direction to each lamp in the world (not normalised) and its strength; row 0 is the ambient light."""

Tiles = tuple[int, NDArray[np.integer[Any]], NDArray[np.integer[Any]], Array]
"""Tiles in a row, start of each tile's list, the lists, and the least depth of every primitive."""


def motion_of_primitives(now: View, other: View) -> tuple[Array, Array]:
    """Rotations ``[P, 3, 3]`` and shifts ``[P, 3]`` in the world that carry primitives from one frame to another."""
    rotation = product(other.rotation, np.swapaxes(now.rotation, 1, 2))
    return rotation, other.origin - product(rotation, now.origin[:, :, None])[:, :, 0]


def rolling_flow(
    now: View, other: View, hit: NDArray[np.int32], depth: Array
) -> NDArray[np.float32]:
    """Exact flow float32 ``[H, W, 2]`` in pixels between frames whose rows have poses of their own.

    A point is seen in the other frame by the row onto which that very row's pose projects it.
    Beyond the image's first and last row the pose goes on as that row's.
    """
    v, u = np.mgrid[0 : CAMERA.height, 0 : CAMERA.width].astype(np.float64)
    rays = np.stack(
        [(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, np.ones_like(u)], axis=-1
    )
    world = (
        product(rays * depth[..., None], np.swapaxes(now.rows[:, :3, :3], 1, 2))
        + now.rows[:, None, :3, 3]
    )
    rotation, shift = motion_of_primitives(now, other)
    primitive = np.maximum(hit >> 3, 0)
    world = product(rotation[primitive], world[..., None])[..., 0] + shift[primitive]
    row = v.copy()
    for _ in range(_ROUNDS):
        first = np.clip(np.floor(row), 0, CAMERA.height - 2).astype(np.int64)
        share = np.clip(row - first, 0.0, 1.0)[..., None]
        before, after = (
            product((world - other.rows[near, :3, 3])[..., None, :], other.rows[near, :3, :3])[
                ..., 0, :
            ]
            for near in (first, first + 1)
        )
        points = (1 - share) * before + share * after
        w = np.where(points[..., 2] > 0.05, points[..., 2], np.nan)
        x = points[..., 0] / w * CAMERA.fx + CAMERA.cx
        y = points[..., 1] / w * CAMERA.fy + CAMERA.cy
        row = np.where(np.isfinite(y), y, row)
    flow = np.stack([x - u, y - v], axis=-1)
    flow[hit < 0] = np.nan
    return flow.astype(np.float32)


_EDGES = np.array(
    [(i, i | 1 << axis) for axis in range(3) for i in range(8) if not i >> axis & 1]
).T
"""The twelve edges of a box, as pairs of corners; bit k of a corner's number is its side along axis k."""


def bounds_of(corners: Array) -> Array:
    """Where in the image boxes can be seen: around the parts of them that lie before the camera.

    Args:
        corners: ``[P, 8, 3]`` in the camera frame, metres.

    Returns:
        ``[5, P]``: least depth of all corners, and least u, least v, greatest u, greatest v
        (pixels, with a margin); least above greatest where a box lies behind the camera.
    """
    start = corners[:, _EDGES[0]]
    end = corners[:, _EDGES[1]]
    cut = (start[..., 2] > NEAR_M) != (end[..., 2] > NEAR_M)
    share = (NEAR_M - start[..., 2]) / np.where(cut, end[..., 2] - start[..., 2], 1.0)
    points = np.concatenate([corners, start + share[..., None] * (end - start)], axis=1)
    valid = np.concatenate([corners[..., 2] > NEAR_M, cut], axis=1)
    pixels = points[..., :2] / np.where(valid, points[..., 2], 1.0)[..., None] * _FOCAL + _CENTRE
    low = np.where(valid[..., None], pixels, np.inf).min(axis=1) - _MARGIN_PX
    high = np.where(valid[..., None], pixels, -np.inf).max(axis=1) + _MARGIN_PX
    return np.stack([corners[..., 2].min(axis=1), *low.T, *high.T])


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
        scene: Its scene.
        settings: Renderer settings.
        threads: Threads that share the rows of a frame.
    """

    def __init__(
        self, sequence: SyntheticId, scene: Scene, settings: RenderSettings, threads: int
    ) -> None:
        self.settings = settings
        self.scene = scene
        self.threads = threads
        self.depth_sensor = _adapted(settings.depth, scene.world.optics.depth)
        self.color_sensor = _adapted(settings.color, scene.world.optics.color)
        text = f"{_NOISE_VERSION}/{sequence.name}@{sequence.scene}"
        text += "" if sequence.noise is None else f"/noise={sequence.noise}"
        self._seed = int.from_bytes(hashlib.sha256(text.encode()).digest()[:6], "little")
        self._ids = np.append(scene.instance, 0).astype(np.uint8)

    def render(self, index: int) -> Rendered:
        """Render frame `index`."""
        now = self.scene.view(index)
        time = index / FPS
        tiles, local = self._tiles(now)
        hit, depth = self._cast(tiles, local)
        color, cosine = self._shade(now, tiles, local, hit, depth, time)
        raw = self._measure(index, depth, cosine, color)
        if self.settings.shadow:
            self._shadow(now.pose, time, depth, color)
        if self.settings.glare:
            color += self._glare(now.pose, time)
        if self.color_sensor.shutter > 0:
            color = self._blur(now, self.scene.view(index + 1), hit, depth, color)
        return Rendered(self._expose(index, color), raw, self._ids[hit >> 3])

    def flow(self, index: int, other: int) -> NDArray[np.float32]:
        """Exact flow float32 ``[H, W, 2]`` in pixels from frame `index` to frame `other`; NaN where there is none.

        It is the motion of the surface point seen at each pixel centre, also where it is hidden in
        the other frame.
        """
        now, after = self.scene.view(index), self.scene.view(other)
        hit, depth = self.cast(now)
        return (
            rolling_flow(now, after, hit, depth)
            if now.rolling
            else self._flow(now, after, hit, depth)
        )

    def geometry(self, index: int) -> tuple[Array, NDArray[np.uint8]]:
        """Exact z-depth (metres, 0 = nothing) and instance ids of frame `index`, without shading."""
        hit, depth = self.cast(self.scene.view(index))
        return depth, self._ids[hit >> 3]

    def cast(self, view: View) -> tuple[NDArray[np.int32], Array]:
        """What every pixel of a view sees (8 * primitive + face, -1 for nothing) and its z-depth in metres."""
        return self._cast(*self._tiles(view))

    def _rows(self, work: Callable[[int, int], None]) -> None:
        """Share the bands of an image among the threads; under a rolling shutter they do not depend on their number."""
        whole = self.threads == 1 and not self.scene.world.optics.readout_s
        height = CAMERA.height if whole else _BAND
        starts = range(0, CAMERA.height, height)
        with ThreadPoolExecutor(self.threads) as pool:
            list(pool.map(work, starts, [first + height for first in starts]))

    def _tiles(self, view: View) -> tuple[Tiles, Array]:
        """Bin the primitives into tiles by the bounds of their boxes, as seen by several rows of a rolling shutter.

        Returns:
            The tiles, and maps ``[R, P, 12]`` from the camera at each row of the view to the local
            frames of what lies in the tiles (row-major 3x4).
        """
        scene = self.scene
        corners = self.scene.corners * self.scene.scale[:, None, :]
        world = product(corners, np.swapaxes(view.rotation, 1, 2)) + view.origin[:, None, :]
        chosen = np.linspace(0, len(view.rows) - 1, 9 if view.rolling else 1).astype(int)
        bounds = [
            bounds_of(product(world - pose[:3, 3], pose[:3, :3])) for pose in view.rows[chosen]
        ]
        nearest, *low = np.min(bounds, axis=0)[:3]
        high = np.max(bounds, axis=0)[3:]
        nearest = nearest - (_SLACK_M if view.rolling else 0.0)
        last = np.array([[CAMERA.width - 1], [CAMERA.height - 1]])
        visible = ((high >= 0) & (low <= last)).all(axis=0)
        order = np.argsort(nearest, kind="stable")
        order = order[visible[order]].astype(np.int32)
        boxes = np.concatenate([np.clip(low, 0, last), np.clip(high, 0, last)]).T // TILE
        tiles_x = -(-CAMERA.width // TILE)
        tiles_y = -(-CAMERA.height // TILE)
        tiles = (
            tiles_x,
            *kernels.bin_tiles(order, boxes.astype(np.int32), tiles_x, tiles_y),
            nearest,
        )
        inverse = np.swapaxes(view.rotation[order], 1, 2) / scene.scale[order, :, None]
        poses = np.repeat(view.rows[:, None, :3], len(order), axis=1)
        poses[..., 3] -= view.origin[order]
        local = np.empty((len(poses), len(scene.kind), 12))
        local[:, order] = product(inverse, poses).reshape(len(poses), -1, 12)
        return tiles, local

    def _cast(self, tiles: Tiles, local: Array) -> tuple[NDArray[np.int32], Array]:
        """What every pixel sees (`cast_geometry`) and its z-depth in metres."""
        hit, depth, scene = np.empty(SIZE, np.int32), np.empty(SIZE), self.scene
        self._rows(
            lambda a, b: kernels.cast_geometry(
                a, b, _INTRINSICS, *tiles, scene.kind, local, scene.shape, hit, depth
            )
        )
        return hit, depth

    def _shade(
        self,
        now: View,
        tiles: Tiles,
        local: Array,
        hit: NDArray[np.int32],
        depth: Array,
        time: float,
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Colour ``[H, W, 3]`` and cosine of incidence ``[H, W]``; a rolling shutter's normals are those of a band."""
        scene = self.scene
        density = self._density
        color, cosine = np.empty((*SIZE, 3), np.float32), np.empty(SIZE, np.float32)
        jitter = _JITTER if self.settings.antialias else np.zeros((1, 2))

        def work(a: int, b: int) -> None:
            pose = now.pose_of((a + b) // 2)
            lights = self._lights(pose, time)
            facets = self._facets(now, pose, lights, density)
            kernels.shade_pixels(
                a, b, _INTRINSICS, *tiles, scene.kind, local, scene.shape, scene.texture, scene.uv, scene.tint, facets,
                *scene.atlas, lights, hit, depth, jitter, color, cosine,
            )  # fmt: skip

        self._rows(work)
        return color, cosine

    def _flow(
        self, now: View, other: View, hit: NDArray[np.int32], depth: Array
    ) -> NDArray[np.float32]:
        """Exact flow under a global shutter; under a rolling one along the motion of each band's middle row."""
        flow = np.empty((*SIZE, 2), np.float32)
        rotation, shift = motion_of_primitives(now, other)

        def work(a: int, b: int) -> None:
            pose, after = now.pose_of((a + b) // 2), other.pose_of((a + b) // 2)
            # from points in this camera's frame to the other camera's frame
            motion = np.empty((len(shift), 3, 4))
            motion[:, :, :3] = product(after[:3, :3].T, rotation, pose[:3, :3])
            motion[:, :, 3] = product(
                product(rotation, pose[:3, 3]) + shift - after[:3, 3], after[:3, :3]
            )
            kernels.flow_field(a, b, _INTRINSICS, hit, depth, motion.reshape(-1, 12), flow)

        self._rows(work)
        return flow

    def _blur(
        self,
        now: View,
        after: View,
        hit: NDArray[np.int32],
        depth: Array,
        sharp: NDArray[np.float32],
    ) -> NDArray[np.float32]:
        """Motion blur while the shutter is open."""
        flow, blurred = self._flow(now, after, hit, depth), np.empty_like(sharp)
        exact, shares, shutter = (
            sharp.astype(np.float64).ravel(),
            kernels.tap_shares(),
            self.color_sensor.shutter,
        )
        self._rows(
            lambda a, b: kernels.motion_blur(a, b, sharp, exact, shares, flow, shutter, blurred)
        )
        return blurred

    def _lights(self, pose: Array, time: float) -> Array:
        """Directions to the lights in the camera frame, and strengths; row 0 is the ambient light."""
        rows = _LAMPS.copy()
        rows[:, :3] /= norm(rows[:, :3])[:, None]
        if self.settings.lighting_change:
            rows[:, 3] *= 0.78 + 0.22 * cos(2 * math.pi * time / 7.0)
            rows[2, 3] += 0.25 if sin(2 * math.pi * time / 4.7) > 0.3 else 0.0
        rows[:, :3] = product(rows[:, :3], pose[:3, :3])
        return rows

    def _facets(self, view: View, pose: Array, lights: Array, density: Array) -> Array:
        """What is the same all over a face ``[P, 6, 5]``: normal in the camera frame, light, texels a pixel at 1 m."""
        quads = self.scene.kind == QUAD
        axes = product(pose[:3, :3].T, view.rotation).transpose(0, 2, 1)
        facets = np.empty((len(axes), 6, 5))
        facets[:, 0::2, :3] = -axes
        facets[:, 1::2, :3] = axes
        facets[quads, 4:, :3] = axes[quads, 2:]
        to_camera = pose[:3, 3] - view.origin
        behind = (product(to_camera[:, None, :], view.rotation) < 0)[:, 0, 2] & quads
        facets[behind, 4:, :3] *= -1
        facing = np.maximum(product(facets[:, :, :3], lights[1:, :3].T), 0)
        facets[:, :, 3] = lights[0, 3] + product(facing, lights[1:, 3])
        facets[:, :, 4] = density
        return facets

    @cached_property
    def _density(self) -> Array:
        """Texels a pixel at 1 m on each face ``[P, 6]`` seen at right angles."""
        scene = self.scene
        log2_size = self.scene.atlas[2]
        repeats = np.abs(scene.uv[:, :, :2])
        cones = scene.kind == ROUND_CONE
        repeats[cones, :, 0] /= (
            math.pi * np.maximum(scene.shape[cones, 1] + scene.shape[cones, 2], 2e-3)
        )[:, None]
        repeats[cones] /= scene.scale[cones].mean(axis=1)[:, None, None]
        return np.asarray(repeats.max(axis=2) * (1 << log2_size[scene.texture]) / CAMERA.fx)

    def _shadow(self, pose: Array, time: float, depth: Array, color: NDArray[np.float32]) -> None:
        """Soft shadows of things outside the picture, sweeping over the scene."""
        light = _LAMPS[1, :3] / _LAMPS[1, 2]
        sweep = 1.6 * sin(2 * math.pi * time / 6.3)
        first = [sweep + light[0] * 1.2, 0.7 + 0.3 * sin(1.1 * time), 1.0, 0.5]
        # x, y, radius in metres, and darkness
        spots = (first, [-0.7 * sweep + light[0] * 1.2, 2.9, 0.9, 0.4])
        v, u = np.mgrid[0 : CAMERA.height, 0 : CAMERA.width].astype(np.float64)
        x = (u - CAMERA.cx) / CAMERA.fx * depth
        y = (v - CAMERA.cy) / CAMERA.fy * depth
        wx, wy, wz = (row[0] * x + row[1] * y + row[2] * depth + row[3] for row in pose[:3])
        up = (2.2 - wz) / light[2]  # along the light to the plane in which the spots lie
        wx = wx + light[0] * up
        wy = wy + light[1] * up
        factor = np.ones(SIZE)
        for at_x, at_y, radius, darkness in spots:
            near = 1.0 - ((wx - at_x) ** 2 + (wy - at_y) ** 2) / (radius * radius)
            factor *= 1.0 - darkness * np.clip(2.0 * near, 0.0, 1.0)
        color *= np.where((depth > 0.0) & (up > 0.0), factor, 1.0)[..., None]

    def _glare(self, pose: Array, time: float) -> NDArray[np.float32]:
        """A bright veil ``[H, W, 1]`` around a window beside the back wall, brightening and fading."""
        x, y, z = product(np.array(self.scene.world.window) - pose[:3, 3], pose[:3, :3])
        if z <= 0.1:
            return np.zeros((*SIZE, 1), np.float32)
        u = x / z * CAMERA.fx + CAMERA.cx
        v = y / z * CAMERA.fy + CAMERA.cy
        strength = 110 * (0.6 + 0.4 * sin(2 * math.pi * time / 5.3))
        across = exp(-(((np.arange(CAMERA.width) - u) / 210.0) ** 2))
        down = exp(-(((np.arange(CAMERA.height) - v) / 180.0) ** 2))
        return np.asarray((strength * down[:, None] * across[None, :])[..., None], np.float32)

    def _noise_seed(self, number: int) -> np.uint64:
        return np.uint64((self._seed + 0x9E3779B97F4A7C15 * number) & 0xFFFFFFFFFFFFFFFF)

    def _measure(
        self, index: int, depth: Array, cosine: NDArray[np.float32], color: NDArray[np.float32]
    ) -> NDArray[np.uint16]:
        """The depth as the sensor measures it."""
        sensor, raw, seed = (
            self.depth_sensor,
            np.empty(SIZE, np.uint16),
            self._noise_seed(2 * index),
        )
        factor = CAMERA.written_depth_factor
        if not sensor.noise:
            return np.clip(np.floor(depth * factor + 0.5), 0, 65535).astype(np.uint16)
        values = sensor.disparity_noise_px, sensor.near_m, sensor.far_m, sensor.edge_px, sensor.dark
        self._rows(
            lambda a, b: kernels.measure_depth(
                a, b, seed, CAMERA.fx, CAMERA.baseline_m, depth, cosine, color, *values, factor, raw
            )
        )
        return raw

    def _expose(self, index: int, color: NDArray[np.float32]) -> NDArray[np.uint8]:
        """Exposure of a rolling readout (drift and mains flicker), noise and rounding."""
        sensor = self.color_sensor
        optics = self.scene.world.optics
        rgb = np.empty(color.shape, np.uint8)
        time = index / FPS + np.arange(CAMERA.height) / CAMERA.height / FPS * 0.9
        drift = 0.7 * sin(2 * math.pi * time / 6.1) + 0.3 * sin(2 * math.pi * time / 1.9 + 1.0)
        gain = 1 + sensor.exposure_drift * drift
        gain *= 1 + sensor.flicker * sin(2 * math.pi * 100.0 * time * 1.0013)
        lamps = optics.gain(index / FPS) if callable(optics.gain) else optics.gain
        if lamps != 1 or optics.auto_exposure:
            mean = max(float(color.mean(dtype=np.float64)) * lamps, 1.0)
            gain *= lamps * power(_MEAN_GREY / mean, optics.auto_exposure)
        seed = self._noise_seed(2 * index + 1)
        read, shot = (sensor.read_noise, sensor.shot_noise) if sensor.noise else (0.0, 0.0)
        self._rows(lambda a, b: kernels.expose(a, b, seed, color, gain, read, shot, rgb))
        return rgb


SensorSettings = TypeVar("SensorSettings", bound=Settings)


def _adapted(sensor: SensorSettings, world: Mapping[str, Any]) -> SensorSettings:
    """The sensor's settings with those of the world where the user left the default."""
    return sensor.model_copy(
        update={k: v for k, v in world.items() if k not in sensor.model_fields_set}
    )


def default_threads() -> int:
    """Cores this process may use, at most four; ``NUMBA_NUM_THREADS`` lowers it."""
    cores = (
        len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    )
    limit = os.environ.get("NUMBA_NUM_THREADS", "")
    return max(1, min(cores, 4, int(limit) if limit.isdigit() and int(limit) > 0 else 4))
