"""Four corridors around a block, as points with known descriptors: a lap comes back to where it began."""

import numpy as np

from dynslam_bench.geometry import Camera, se3
from helpers.point_world import PointWorld, make_backend, track_all, without_depth

WIDTH = 2.0
CORNER = 1.0
VIEW_M = 6.0


def rotated(quarters):
    c = np.cos(quarters * np.pi / 2)
    s = np.sin(quarters * np.pi / 2)
    return np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])


class RingWorld(PointWorld):
    """A ring with centre lines of `side` metres; a share `alike` of the points is the same in all four corridors."""

    def __init__(self, side=6.0, density=24, seed=0, *, alike=0.0):
        rng = np.random.default_rng(seed)
        walls = []
        descriptors = []
        same = {}
        for r in (side / 2 + WIDTH / 2, side / 2 - WIDTH / 2):
            for quarter in range(4):
                n = int(density * 5 * r)
                wall = np.stack(
                    [rng.uniform(-r, r, n), rng.uniform(-1.2, 1.3, n), np.full(n, r)], axis=1
                )
                words = rng.integers(0, 256, (n, 32), dtype=np.uint8)
                if alike:
                    common = int(alike * n)
                    wall[:common], words[:common] = same.setdefault(
                        r, (wall[:common], words[:common])
                    )
                walls.append(wall @ rotated(quarter).T)
                descriptors.append(words)
        self.side = side
        self.camera = Camera(640, 480, 525.0, 525.0, 319.5, 239.5)
        self.walls, self._descriptors = np.concatenate(walls), np.concatenate(descriptors)

    def frames_of_a_lap(self, step_m):
        return int(np.ceil((4 * (self.side - 2) + 2 * np.pi) / step_m))

    def lap(self, count, step_m):
        """Camera-to-world poses along the centre line, looking ahead, y down; corners are quarter circles."""
        straight = self.side - 2 * CORNER
        arc = np.pi / 2 * CORNER
        poses = np.tile(np.eye(4), (count, 1, 1))
        for pose, path in zip(poses, np.arange(count) * step_m, strict=True):
            quarter, along = divmod(path, straight + arc)
            bend = max(0.0, along - straight) / CORNER
            before = min(along, straight) - straight / 2
            spot = [
                before + CORNER * np.sin(bend),
                0.0,
                self.side / 2 - CORNER * (1 - np.cos(bend)),
            ]
            ahead = rotated(quarter + bend / (np.pi / 2)) @ [1.0, 0.0, 0.0]
            down = np.array([0.0, 1.0, 0.0])
            pose[:3, :3] = np.column_stack([np.cross(down, ahead), down, ahead])
            pose[:3, 3] = rotated(quarter) @ spot
        return poses

    def see(self, T_world_cam, index, **noise):
        """What `PointWorld.see` sees of the walls that no other wall hides."""
        centre = T_world_cam[:3, 3]
        near = np.flatnonzero(np.linalg.norm(self.walls - centre, axis=1) < VIEW_M)
        sight = centre + (self.walls[near] - centre) * np.linspace(0.05, 0.95, 12)[:, None, None]
        inner = (self.side - WIDTH) / 2 - 0.05
        outer = (self.side + WIDTH) / 2 + 0.05
        far = np.abs(sight[..., [0, 2]]).max(axis=-1)
        visible = near[~((far < inner) | (far > outer)).any(axis=0)]
        self.points = self.walls[visible]
        self.descriptors = self._descriptors[visible]
        return super().see(T_world_cam, index, **noise)


def drive(world, path, step_m, *, rate=10.0, monocular=False, noise=None, **settings):
    """A back end along frames of a lap (None is a blind frame), the results, and the lap's poses from the first one."""
    backend = make_backend(world, monocular=monocular, **settings)
    lap = world.lap(max(index for index in path if index is not None) + 1, step_m)
    frames = [
        world.blind(number, stamp=number / rate)
        if index is None
        else world.see(lap[index], number, stamp=number / rate, **(noise or {}))
        for number, index in enumerate(path)
    ]
    results = track_all(backend, map(without_depth, frames) if monocular else frames)
    return backend, results, se3.inverse(lap[path[0]]) @ lap


def position_errors(results, path, truth):
    """Metres; infinite where there is no truth."""
    return np.array([
        np.inf if index is None else np.linalg.norm(result.T_world_cam[:3, 3] - truth[index][:3, 3])
        for result, index in zip(results, path, strict=True)
    ])  # fmt: skip
