"""A simulated world of points with known descriptors, seen by a camera with a depth sensor; back ends that track it."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np

from dynslam_bench.contracts import FrameBundle, Keypoints
from dynslam_bench.core.settings import apply_overrides
from dynslam_bench.geometry import Camera, se3
from dynslam_bench.slam.backend import Backend, MonocularBackend
from dynslam_bench.slam.observations import observe
from dynslam_bench.slam.settings import BackendSettings, MonocularBackendSettings


class PointWorld:
    """Points on the walls of a room; `see` gives the frame that a camera at a pose would deliver."""

    def __init__(self, seed=0, count=3000):
        rng = np.random.default_rng(seed)
        side = rng.integers(0, 3, count)
        points = rng.uniform([-3.0, -2.0, -2.0], [3.0, 2.0, 2.5], (count, 3))
        points[side == 0, 2] = 2.5
        points[side == 1, 0] = np.where(rng.random(count) < 0.5, -3.0, 3.0)[side == 1]
        points[side == 2, 1] = np.where(rng.random(count) < 0.5, -2.0, 2.0)[side == 2]
        self.points = points
        self.descriptors = rng.integers(0, 256, (count, 32), dtype=np.uint8)
        self.camera = Camera(640, 480, 525.0, 525.0, 319.5, 239.5)

    def see(
        self,
        T_world_cam,
        index,
        *,
        stamp=None,
        noise_px=0.4,
        depth_noise=0.002,
        depthless=0.1,
        limit=700,
        wrong=0,
    ):
        """The frame at a pose; `wrong` features get positions that fit no point."""
        rng = np.random.default_rng([index, 77])
        local = se3.transform(se3.inverse(T_world_cam), self.points)
        with np.errstate(divide="ignore", invalid="ignore"):
            uv = self.camera.project(local)
        rows = np.flatnonzero(
            (local[:, 2] > 0.2) & (uv > 4).all(axis=1) & (uv[:, 0] < 636) & (uv[:, 1] < 476)
        )
        if len(rows) > limit:
            rows = np.sort(rng.permutation(rows)[:limit])
        n = len(rows)
        xy = uv[rows] + rng.normal(0, noise_px, (n, 2))
        if wrong:
            bad = rng.permutation(n)[:wrong]
            xy[bad] = rng.uniform([10, 10], [630, 470], (len(bad), 2))
        z = (local[rows, 2] * (1 + rng.normal(0, depth_noise, n))).astype(np.float32)
        z[rng.random(n) < depthless] = 0
        bits = np.unpackbits(self.descriptors[rows], axis=1)
        keypoints = Keypoints(
            xy.astype(np.float32),
            np.zeros(n, np.int32),
            np.zeros(n, np.float32),
            np.ones(n, np.float32),
            np.packbits(bits ^ (rng.random(bits.shape) < 0.03), axis=1),
        )
        blank = np.zeros((480, 640), np.uint8)
        return FrameBundle(
            index, index / 30.0 if stamp is None else stamp, np.dstack([blank] * 3), blank,
            np.zeros((480, 640), np.float32), keypoints, xy, z,
        )  # fmt: skip

    def blind(self, index, *, stamp=None):
        """A frame without any feature."""
        return self.see(np.eye(4), index, stamp=stamp, limit=0)

    def path(self, count):
        """Camera-to-world poses of a smooth hand-held movement, 30 Hz."""
        t = np.arange(count) / 30.0
        return se3.exp(np.stack(
            [0.5 * np.sin(1.1 * t), 0.2 * np.sin(1.7 * t), 0.3 * (1 - np.cos(0.9 * t)), 0.15 * np.sin(0.8 * t),
             0.4 * np.sin(0.7 * t), 0.1 * np.sin(1.3 * t)], axis=1,
        ))  # fmt: skip


def without_depth(frame):
    return replace(frame, z=np.zeros_like(frame.z))


def observed(frame, camera, levels=8, keep=None):
    """All features of a frame, or those of a mask, as the back end uses them."""
    keep = np.ones(len(frame), bool) if keep is None else keep
    return observe(frame, keep, np.ones(len(frame), np.float32), camera, 1.2 ** np.arange(levels))


def make_backend(world, *, monocular=False, seed=0, **overrides):
    """A back end that is ready for a world; settings as ``group__name=value``."""
    kind, settings = (
        (MonocularBackend, MonocularBackendSettings) if monocular else (Backend, BackendSettings)
    )
    backend = kind(
        apply_overrides(
            settings(), {name.replace("__", "."): value for name, value in overrides.items()}
        )
    )
    backend.reset(world.camera, seed)
    return backend


def track_all(backend, frames, keeps=None):
    """Track frames in order; all features are kept unless told otherwise. Results have their stats as attributes."""
    results = []
    for i, frame in enumerate(frames):
        keep = np.ones(len(frame), bool) if keeps is None else keeps[i]
        result = backend.track(frame, keep, np.ones(len(frame), np.float32))
        results.append(SimpleNamespace(**vars(result), **result.stats))
    return results


def states(results):
    return [result.state for result in results]


def errors(results, truth):
    """Translation errors in metres of the tracked frames, in the frame of the first pose."""
    tracked = [i for i, r in enumerate(results) if r.state == "ok"]
    start = results[tracked[0]].T_world_cam @ se3.inverse(truth[tracked[0]])
    return np.array(
        [
            np.linalg.norm((se3.inverse(start @ truth[i]) @ results[i].T_world_cam)[:3, 3])
            for i in tracked
        ]
    )
