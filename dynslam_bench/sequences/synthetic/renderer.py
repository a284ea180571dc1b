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
from dynslam_bench.sequences.synthetic.kernels import (
    NEAR_M,
    TILE,
    DepthModel,
    Materials,
    Primitives,
    Tiles,
)
from dynslam_bench.sequences.synthetic.parts import QUAD, ROUND_CONE
from dynslam_bench.sequences.synthetic.scene import Scene, View
from dynslam_bench.sequences.synthetic.settings import CAMERA, FPS, RenderSettings

SIZE = CAMERA.height, CAMERA.width
"""Height and width of the images, pixels."""
_INTRINSICS = CAMERA.fx, CAMERA.fy, CAMERA.cx, CAMERA.cy
_FOCAL = _INTRINSICS[:2]
_CENTRE = _INTRINSICS[2:]
_BAND = 48
"""Rows that a thread renders at a time."""
_JITTER = np.array([[-0.125, -0.375], [0.375, -0.125], [0.125, 0.375], [-0.375, 0.125]])
"""Samples of a pixel on an edge (a rotated grid), pixels from its centre."""

_ROW_ITERATIONS = 5
"""Iterations of the search for the row that sees a point. Each shrinks the error to a tenth or less: a point moves by
at most 0.1 rows while one row is read."""
_MARGIN_PX = 2.0
"""Added around the bounds of a primitive in the image."""
_SAMPLED_ROWS = 9
"""Rows of a rolling shutter by whose poses primitives are sorted into tiles."""
_SLACK_M = 0.01
"""Metres by which a primitive may be nearer in another row than in the sampled ones."""

_LAMPS = np.array(
    [[0, 0, 1.0, 0.52], [0.25, -0.45, 0.86, 0.36], [-0.75, -0.6, 0.25, 0.2], [0.6, -0.7, 0.1, 0.1]]
)
"""Direction to each lamp in the world (not normalised) and its strength; row 0 is the ambient light."""
_SHADOW_PLANE_M = 2.2
"""Height of the plane in which the things lie that cast the soft shadows."""
_MEAN_GREY = 105.0
"""Mean grey value (0-255) that automatic exposure aims at."""
_MAINS_HZ = 100.0
"""Lamps flicker at twice the frequency of the mains."""
_NOISE_VERSION = 5
"""Seeds the noise of the sensors. It stays while versions of the renderer differ in last bits only."""

HitImage = NDArray[np.int32]
"""Surface that every pixel sees, ``[H, W]``: 8 * primitive + face, -1 for nothing."""
ColorImage = NDArray[np.float32]
"""Colours ``[H, W, 3]`` from 0 to 255 before exposure and noise."""


def motion_of_primitives(view: View, other: View) -> tuple[Array, Array]:
    """Rotations ``[P, 3, 3]`` and shifts ``[P, 3]`` in the world that carry primitives from one frame to another."""
    rotation = product(other.rotation, np.swapaxes(view.rotation, 1, 2))
    return rotation, other.origin - product(rotation, view.origin[:, :, None])[:, :, 0]


def rolling_flow(view: View, other: View, hit: HitImage, depth: Array) -> NDArray[np.float32]:
    """Exact flow float32 ``[H, W, 2]`` in pixels between frames whose rows have poses of their own.

    A point is seen in the other frame by the row onto which that very row's pose projects it.
    Beyond the image's first and last row the pose goes on as that row's.
    """
    # points seen at the pixel centres, in the world, at the frame's own time
    v, u = np.mgrid[0 : CAMERA.height, 0 : CAMERA.width].astype(np.float64)
    rays = np.stack(
        [(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, np.ones_like(u)], axis=-1
    )
    row_rotations = np.swapaxes(view.rows[:, :3, :3], 1, 2)
    row_positions = view.rows[:, None, :3, 3]
    points = product(rays * depth[..., None], row_rotations) + row_positions

    # where they are in the other frame
    rotation, shift = motion_of_primitives(view, other)
    primitive = np.maximum(hit >> 3, 0)
    points = product(rotation[primitive], points[..., None])[..., 0] + shift[primitive]

    # fixed-point iteration: project with the pose of the row, take the row of the projection.
    row = v.copy()
    for _ in range(_ROW_ITERATIONS):
        first = np.clip(np.floor(row), 0, CAMERA.height - 2).astype(np.int64)
        share = np.clip(row - first, 0.0, 1.0)[..., None]
        by_first = _in_camera(points, other.rows[first])
        by_next = _in_camera(points, other.rows[first + 1])
        in_camera = (1 - share) * by_first + share * by_next
        z = np.where(in_camera[..., 2] > NEAR_M, in_camera[..., 2], np.nan)
        x = in_camera[..., 0] / z * CAMERA.fx + CAMERA.cx
        y = in_camera[..., 1] / z * CAMERA.fy + CAMERA.cy
        row = np.where(np.isfinite(y), y, row)
    flow = np.stack([x - u, y - v], axis=-1)
    flow[hit < 0] = np.nan
    return flow.astype(np.float32)


def _in_camera(points: Array, poses: Array) -> Array:
    """World points ``[H, W, 3]`` in the frames of cameras at `poses` ``[H, W, 4, 4]``."""
    offsets = points - poses[..., :3, 3]
    return product(offsets[..., None, :], poses[..., :3, :3])[..., 0, :]


_EDGES = np.array(
    [(i, i | 1 << axis) for axis in range(3) for i in range(8) if not i >> axis & 1]
).T
"""The twelve edges of a box, as pairs of corners; bit k of a corner's number is its side along axis k."""


def bounds_of(corners: Array) -> Array:
    """Bounds of boxes in the image: around the parts of them that lie before the camera.

    Args:
        corners: ``[P, 8, 3]`` in the camera frame, metres.

    Returns:
        ``[5, P]``: least depth of all corners, and least u, least v, greatest u, greatest v
        (pixels, with a margin); least above greatest where a box lies behind the camera.
    """
    # Edges are cut at the near plane, so that no point behind the camera is projected.
    start = corners[:, _EDGES[0]]
    end = corners[:, _EDGES[1]]
    cut = (start[..., 2] > NEAR_M) != (end[..., 2] > NEAR_M)
    share = (NEAR_M - start[..., 2]) / np.where(cut, end[..., 2] - start[..., 2], 1.0)
    cut_points = start + share[..., None] * (end - start)
    points = np.concatenate([corners, cut_points], axis=1)
    valid = np.concatenate([corners[..., 2] > NEAR_M, cut], axis=1)
    # Bounds of the projections.
    z = np.where(valid, points[..., 2], 1.0)[..., None]
    pixels = points[..., :2] / z * _FOCAL + _CENTRE
    low = np.where(valid[..., None], pixels, np.inf).min(axis=1) - _MARGIN_PX
    high = np.where(valid[..., None], pixels, -np.inf).max(axis=1) + _MARGIN_PX
    return np.stack([corners[..., 2].min(axis=1), *low.T, *high.T])


@dataclass(frozen=True, eq=False)
class Rendered:
    """One frame as it is stored.

    Attributes:
        rgb: uint8 ``[H, W, 3]``, as the sensor measures it.
        raw_depth: uint16 ``[H, W]`` in units of 1 / 5000 m, 0 = missing, as the sensor measures it.
        instances: uint8 ``[H, W]`` instance ids, 0 is the background.
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
        # sensors of this world, and a seed of noise that its id alone decides
        self.settings = settings
        self.scene = scene
        self.threads = threads
        self.depth_sensor = _adapted(settings.depth, scene.world.optics.depth)
        self.color_sensor = _adapted(settings.color, scene.world.optics.color)
        text = f"{_NOISE_VERSION}/{sequence.name}@{sequence.scene}"
        text += "" if sequence.noise is None else f"/noise={sequence.noise}"
        self._seed = int.from_bytes(hashlib.sha256(text.encode()).digest()[:6], "little")
        # the last one is that of pixels that see nothing: hit >> 3 is -1
        self._ids = np.append(scene.instance, 0).astype(np.uint8)

    def render(self, index: int) -> Rendered:
        """Render frame `index`."""
        view = self.scene.view(index)
        time = index / FPS

        # geometry and colour
        tiles, primitives = self._tiles(view)
        hit, depth = self._cast(tiles, primitives)
        color, cosine = self._shade(view, tiles, primitives, hit, depth, time)

        # depth sensor, by the colour before light and blur change it.
        raw = self._measure(index, depth, cosine, color)

        # light and motion blur, then the colour sensor
        if self.settings.shadow:
            self._shadow(view.pose, time, depth, color)
        if self.settings.glare:
            color += self._glare(view.pose, time)
        if self.color_sensor.shutter > 0:
            color = self._blur(view, self.scene.view(index + 1), hit, depth, color)
        return Rendered(self._expose(index, color), raw, self._ids[hit >> 3])

    def flow(self, index: int, other: int) -> NDArray[np.float32]:
        """Exact flow float32 ``[H, W, 2]`` in pixels from frame `index` to frame `other`; NaN where there is none.

        It is the motion of the surface point seen at each pixel centre, also where it is hidden in
        the other frame.
        """
        view = self.scene.view(index)
        other_view = self.scene.view(other)
        hit, depth = self.cast(view)
        if view.rolling:
            return rolling_flow(view, other_view, hit, depth)
        return self._flow(view, other_view, hit, depth)

    def geometry(self, index: int) -> tuple[Array, NDArray[np.uint8]]:
        """Exact z-depth (metres, 0 = nothing) and instance ids of frame `index`, without shading."""
        hit, depth = self.cast(self.scene.view(index))
        return depth, self._ids[hit >> 3]

    def cast(self, view: View) -> tuple[HitImage, Array]:
        """Surface that every pixel of a view sees (8 * primitive + face, -1 for nothing), and its z-depth in metres."""
        return self._cast(*self._tiles(view))

    def _rows(self, work: Callable[[int, int], None]) -> None:
        """Call `work` for bands of rows in all threads: with the first row and one past the last one.

        Under a rolling shutter the bands do not depend on the number of threads.
        """
        whole = self.threads == 1 and not self.scene.world.optics.readout_s
        height = CAMERA.height if whole else _BAND
        starts = range(0, CAMERA.height, height)
        with ThreadPoolExecutor(self.threads) as pool:
            list(pool.map(work, starts, [first + height for first in starts]))

    def _tiles(self, view: View) -> tuple[Tiles, Primitives]:
        """Sort the primitives into tiles by the bounds of their boxes, as seen by several rows of a rolling shutter.

        Returns:
            The tiles, and the primitives as the camera sees them; maps of those that lie in no tile
            are not filled.
        """
        scene = self.scene
        # Bounds of every primitive's box in the image, and its least depth.
        corners = scene.corners * scene.scale[:, None, :]
        world = product(corners, np.swapaxes(view.rotation, 1, 2)) + view.origin[:, None, :]
        samples = _SAMPLED_ROWS if view.rolling else 1
        sampled = np.linspace(0, len(view.rows) - 1, samples).astype(int)
        bounds = [
            bounds_of(product(world - pose[:3, 3], pose[:3, :3])) for pose in view.rows[sampled]
        ]
        nearest, *low = np.min(bounds, axis=0)[:3]
        high = np.max(bounds, axis=0)[3:]
        nearest = nearest - (_SLACK_M if view.rolling else 0.0)

        # Visible primitives in order of depth, and the tiles that each covers.
        last = np.array([[CAMERA.width - 1], [CAMERA.height - 1]])
        visible = ((high >= 0) & (low <= last)).all(axis=0)
        order = np.argsort(nearest, kind="stable")
        order = order[visible[order]].astype(np.int32)
        boxes = np.concatenate([np.clip(low, 0, last), np.clip(high, 0, last)]).T // TILE
        columns = -(-CAMERA.width // TILE)
        rows = -(-CAMERA.height // TILE)
        start, members = kernels.bin_tiles(order, boxes.astype(np.int32), columns, rows)
        tiles = Tiles(columns, start, members, nearest)

        # Maps from the camera at each row to the primitives' frames.
        inverse = np.swapaxes(view.rotation[order], 1, 2) / scene.scale[order, :, None]
        poses = np.repeat(view.rows[:, None, :3], len(order), axis=1)
        poses[..., 3] -= view.origin[order]
        camera_to_local = np.empty((len(poses), len(scene.kind), 12))
        camera_to_local[:, order] = product(inverse, poses).reshape(len(poses), -1, 12)
        return tiles, Primitives(scene.kind, camera_to_local, scene.shape)

    def _cast(self, tiles: Tiles, primitives: Primitives) -> tuple[HitImage, Array]:
        """The surface that every pixel sees (`cast_geometry`) and its z-depth in metres."""
        hit = np.empty(SIZE, np.int32)
        depth = np.empty(SIZE)
        self._rows(
            lambda row0, row1: kernels.cast_geometry(
                row0, row1, _INTRINSICS, tiles, primitives, hit, depth
            )
        )
        return hit, depth

    def _shade(
        self,
        view: View,
        tiles: Tiles,
        primitives: Primitives,
        hit: HitImage,
        depth: Array,
        time: float,
    ) -> tuple[ColorImage, NDArray[np.float32]]:
        """Colour ``[H, W, 3]`` and cosine of incidence ``[H, W]``; a rolling shutter's normals are those of a band."""
        # images that the bands fill
        scene = self.scene
        texel_density = self._texel_density
        color = np.empty((*SIZE, 3), np.float32)
        cosine = np.empty(SIZE, np.float32)
        jitter = _JITTER if self.settings.antialias else np.zeros((1, 2))

        def shade_band(row0: int, row1: int) -> None:
            """Shade the rows `row0` to `row1` - 1."""
            # lights and normals in the frame of the camera at the band's middle row
            pose = view.pose_of((row0 + row1) // 2)
            lights = self._lights(pose, time)
            facets = self._facets(view, pose, lights, texel_density)
            materials = Materials(scene.texture, scene.uv, scene.tint, facets)
            kernels.shade_pixels(
                row0,
                row1,
                _INTRINSICS,
                tiles,
                primitives,
                materials,
                scene.atlas,
                lights,
                hit,
                depth,
                jitter,
                color,
                cosine,
            )

        self._rows(shade_band)
        return color, cosine

    def _flow(self, view: View, other: View, hit: HitImage, depth: Array) -> NDArray[np.float32]:
        """Exact flow under a global shutter; under a rolling one along the motion of each band's middle row."""
        flow = np.empty((*SIZE, 2), np.float32)
        rotation, shift = motion_of_primitives(view, other)

        def flow_of_band(row0: int, row1: int) -> None:
            """Fill the flow of the rows `row0` to `row1` - 1."""
            # camera-to-world poses of the band's middle row in both frames
            pose = view.pose_of((row0 + row1) // 2)
            other_pose = other.pose_of((row0 + row1) // 2)
            # from points in this camera's frame to the other camera's frame
            motion = np.empty((len(shift), 3, 4))
            motion[:, :, :3] = product(other_pose[:3, :3].T, rotation, pose[:3, :3])
            moved_centre = product(rotation, pose[:3, 3]) + shift
            motion[:, :, 3] = product(moved_centre - other_pose[:3, 3], other_pose[:3, :3])
            kernels.flow_field(row0, row1, _INTRINSICS, hit, depth, motion.reshape(-1, 12), flow)

        self._rows(flow_of_band)
        return flow

    def _blur(
        self,
        view: View,
        next_view: View,
        hit: HitImage,
        depth: Array,
        sharp: ColorImage,
    ) -> ColorImage:
        """Motion blur while the shutter is open."""
        flow = self._flow(view, next_view, hit, depth)
        blurred = np.empty_like(sharp)
        exact = sharp.astype(np.float64).ravel()
        shares = kernels.tap_shares()
        shutter = self.color_sensor.shutter
        self._rows(
            lambda row0, row1: kernels.motion_blur(
                row0, row1, sharp, exact, shares, flow, shutter, blurred
            )
        )
        return blurred

    def _lights(self, pose: Array, time: float) -> Array:
        """Directions to the lights in the camera frame, and strengths; row 0 is the ambient light."""
        # unit directions in the world
        rows = _LAMPS.copy()
        rows[:, :3] /= norm(rows[:, :3])[:, None]
        # all dim and brighten slowly, one lamp switches
        if self.settings.lighting_change:
            rows[:, 3] *= 0.78 + 0.22 * cos(2 * math.pi * time / 7.0)
            rows[2, 3] += 0.25 if sin(2 * math.pi * time / 4.7) > 0.3 else 0.0
        # into the camera frame
        rows[:, :3] = product(rows[:, :3], pose[:3, :3])
        return rows

    def _facets(self, view: View, pose: Array, lights: Array, texel_density: Array) -> Array:
        """Values of each face ``[P, 6, 5]``: its normal in the camera frame, light, texels a pixel at 1 m."""
        # Normals of boxes point outwards, those of quads along their z axis ...
        quads = self.scene.kind == QUAD
        axes = product(pose[:3, :3].T, view.rotation).transpose(0, 2, 1)
        facets = np.empty((len(axes), 6, 5))
        facets[:, 0::2, :3] = -axes
        facets[:, 1::2, :3] = axes
        facets[quads, 4:, :3] = axes[quads, 2:]
        # ... or against it, where the camera is behind them: quads are seen from both sides.
        to_camera = pose[:3, 3] - view.origin
        behind = (product(to_camera[:, None, :], view.rotation) < 0)[:, 0, 2] & quads
        facets[behind, 4:, :3] *= -1
        # Ambient light and Lambert's law.
        facing = np.maximum(product(facets[:, :, :3], lights[1:, :3].T), 0)
        facets[:, :, 3] = lights[0, 3] + product(facing, lights[1:, 3])
        facets[:, :, 4] = texel_density
        return facets

    @cached_property
    def _texel_density(self) -> Array:
        """Texels a pixel at 1 m on each face ``[P, 6]`` seen at right angles."""
        scene = self.scene
        # Repeats a metre; those around a round cone are stated a turn, of its mean circumference.
        repeats = np.abs(scene.uv[:, :, :2])
        cones = scene.kind == ROUND_CONE
        diameter = np.maximum(scene.shape[cones, 1] + scene.shape[cones, 2], 2e-3)
        repeats[cones, :, 0] /= (math.pi * diameter)[:, None]
        repeats[cones] /= scene.scale[cones].mean(axis=1)[:, None, None]
        texture_size = 1 << scene.atlas.log2_size[scene.texture]
        return np.asarray(repeats.max(axis=2) * texture_size / CAMERA.fx)

    def _shadow(self, pose: Array, time: float, depth: Array, color: NDArray[np.float32]) -> None:
        """Soft shadows of things outside the picture, sweeping over the scene."""
        direction = _LAMPS[1, :3] / _LAMPS[1, 2]
        # Spots in the plane: x, y, radius in metres, and darkness.
        sweep = 1.6 * sin(2 * math.pi * time / 6.3)
        first = (sweep + direction[0] * 1.2, 0.7 + 0.3 * sin(1.1 * time), 1.0, 0.5)
        second = (-0.7 * sweep + direction[0] * 1.2, 2.9, 0.9, 0.4)

        # The points that the pixels see, in the world.
        v, u = np.mgrid[0 : CAMERA.height, 0 : CAMERA.width].astype(np.float64)
        x = (u - CAMERA.cx) / CAMERA.fx * depth
        y = (v - CAMERA.cy) / CAMERA.fy * depth
        wx, wy, wz = (row[0] * x + row[1] * y + row[2] * depth + row[3] for row in pose[:3])

        # From there along the light to the plane.
        up = (_SHADOW_PLANE_M - wz) / direction[2]
        wx = wx + direction[0] * up
        wy = wy + direction[1] * up
        # darker towards the middle of each spot
        factor = np.ones(SIZE)
        for spot_x, spot_y, radius, darkness in (first, second):
            near = 1.0 - ((wx - spot_x) ** 2 + (wy - spot_y) ** 2) / (radius * radius)
            factor *= 1.0 - darkness * np.clip(2.0 * near, 0.0, 1.0)
        color *= np.where((depth > 0.0) & (up > 0.0), factor, 1.0)[..., None]

    def _glare(self, pose: Array, time: float) -> NDArray[np.float32]:
        """A bright veil ``[H, W, 1]`` around a window beside the back wall, brightening and fading."""
        # the window in the image
        x, y, z = product(np.array(self.scene.world.window) - pose[:3, 3], pose[:3, :3])
        if z <= 0.1:
            return np.zeros((*SIZE, 1), np.float32)
        u = x / z * CAMERA.fx + CAMERA.cx
        v = y / z * CAMERA.fy + CAMERA.cy
        # a Gaussian around it along both axes, as bright as the time says
        strength = 110 * (0.6 + 0.4 * sin(2 * math.pi * time / 5.3))
        across = exp(-(((np.arange(CAMERA.width) - u) / 210.0) ** 2))
        down = exp(-(((np.arange(CAMERA.height) - v) / 180.0) ** 2))
        veil = strength * down[:, None] * across[None, :]
        return np.asarray(veil[..., None], np.float32)

    def _noise_seed(self, number: int) -> np.uint64:
        """Seed of a frame's noise: even numbers are for the depth sensor, odd ones for the colour sensor."""
        return np.uint64((self._seed + 0x9E3779B97F4A7C15 * number) & 0xFFFFFFFFFFFFFFFF)

    def _measure(
        self, index: int, depth: Array, cosine: NDArray[np.float32], color: NDArray[np.float32]
    ) -> NDArray[np.uint16]:
        """The depth as the sensor measures it."""
        # without noise it is rounded to the file's units only
        sensor = self.depth_sensor
        units_per_m = CAMERA.written_depth_factor
        if not sensor.noise:
            return np.clip(np.floor(depth * units_per_m + 0.5), 0, 65535).astype(np.uint16)
        model = DepthModel(
            fx=CAMERA.fx,
            baseline_m=CAMERA.baseline_m,
            disparity_noise_px=sensor.disparity_noise_px,
            near_m=sensor.near_m,
            far_m=sensor.far_m,
            edge_px=sensor.edge_px,
            dark=sensor.dark,
            units_per_m=units_per_m,
        )
        raw = np.empty(SIZE, np.uint16)
        seed = self._noise_seed(2 * index)
        self._rows(
            lambda row0, row1: kernels.measure_depth(
                row0, row1, seed, model, depth, cosine, color, raw
            )
        )
        return raw

    def _expose(self, index: int, color: NDArray[np.float32]) -> NDArray[np.uint8]:
        """Exposure of a rolling readout (drift and mains flicker), noise and rounding."""
        sensor = self.color_sensor
        optics = self.scene.world.optics
        rgb = np.empty(color.shape, np.uint8)
        # Gain of each row: rows are read one after the other during 0.9 of the frame's interval.
        time = index / FPS + np.arange(CAMERA.height) / CAMERA.height / FPS * 0.9
        drift = 0.7 * sin(2 * math.pi * time / 6.1) + 0.3 * sin(2 * math.pi * time / 1.9 + 1.0)
        gain = 1 + sensor.exposure_drift * drift
        # mains whose frequency is 0.13 % off
        gain *= 1 + sensor.flicker * sin(2 * math.pi * _MAINS_HZ * time * 1.0013)

        # Brightness of the lamps, and automatic exposure against it.
        lamps = optics.gain(index / FPS) if callable(optics.gain) else optics.gain
        if lamps != 1 or optics.auto_exposure:
            mean = max(float(color.mean(dtype=np.float64)) * lamps, 1.0)
            gain *= lamps * power(_MEAN_GREY / mean, optics.auto_exposure)

        seed = self._noise_seed(2 * index + 1)
        read_noise = sensor.read_noise if sensor.noise else 0.0
        shot_noise = sensor.shot_noise if sensor.noise else 0.0
        self._rows(
            lambda row0, row1: kernels.expose(
                row0, row1, seed, color, gain, read_noise, shot_noise, rgb
            )
        )
        return rgb


SensorSettings = TypeVar("SensorSettings", bound=Settings)


def _adapted(sensor: SensorSettings, world: Mapping[str, Any]) -> SensorSettings:
    """The sensor's settings with those of the world where the user left the default."""
    changes = {name: value for name, value in world.items() if name not in sensor.model_fields_set}
    return sensor.model_copy(update=changes)


_MOST_THREADS = 4
"""Threads of one frame, at most."""


def default_threads() -> int:
    """Cores this process may use, at most four; ``NUMBA_NUM_THREADS`` lowers it."""
    if hasattr(os, "sched_getaffinity"):
        cores = len(os.sched_getaffinity(0))
    else:
        cores = os.cpu_count() or 1
    text = os.environ.get("NUMBA_NUM_THREADS", "")
    limit = int(text) if text.isdigit() and int(text) > 0 else _MOST_THREADS
    return max(1, min(cores, _MOST_THREADS, limit))
