"""Small sequences in TUM layout for tests, where real data may lie, and the flow of rendered frames."""

import hashlib
from pathlib import Path

import cv2
import numpy as np
import pytest

from dynslam_bench.contracts.sequence import Frame
from dynslam_bench.geometry import Camera, se3
from dynslam_bench.sequences.cameras import write_camera
from dynslam_bench.sequences.synthetic import CAMERA

SHARED = Path(__file__).resolve().parents[3] / "shared"
needs_shared = pytest.mark.skipif(
    not (SHARED / "data").is_dir(), reason="needs the excerpts in ../shared/data"
)


def make_folder(folder, *, frames=4, width=32, height=24, rate=30, fps=30.0, start=100.0):
    """A folder with random images; returns it with the colour (RGB) and raw depth images."""
    rng = np.random.default_rng(7)
    rgb = rng.integers(0, 256, (frames, height, width, 3), dtype=np.uint8)
    depth = rng.integers(2000, 20000, (frames, height, width), dtype=np.uint16)
    depth[:, :2] = 0
    stamps = [start + i / rate for i in range(frames)]
    for kind, images in (("rgb", rgb[..., ::-1]), ("depth", depth)):
        (folder / kind).mkdir(parents=True)
        for i, image in enumerate(images):
            cv2.imwrite(str(folder / kind / f"{i}.png"), image)
        (folder / f"{kind}.txt").write_text(
            "".join(f"{stamp!r} {kind}/{i}.png\n" for i, stamp in enumerate(stamps))
        )
    poses = (f"{stamp!r} {i * 0.01} 0 0 0 0 0 1\n" for i, stamp in enumerate(stamps))
    (folder / "groundtruth.txt").write_text("".join(poses))
    camera = Camera(width, height, 30.0, 30.5, 15.5, 11.5, depth_factor=5000.0)
    write_camera(folder / "camera.toml", camera, fps=fps)
    return folder, rgb, depth


def rewrite(path, change):
    """Replace a list file's lines by ``change(lines)``."""
    path.write_text("\n".join(change(path.read_text().splitlines())) + "\n")


V, U = np.mgrid[0:480, 0:640].astype(float)
"""Rows and columns of a rendered image."""


def reprojected(sequence, index, other):
    """Flow from a rendered frame to another if nothing but the camera moves."""
    points = CAMERA.unproject(np.stack([U, V], -1), sequence.exact_depth(index))
    poses = sequence.ground_truth.T_world_cam
    relative = se3.inverse(poses[other]) @ poses[index]
    return CAMERA.project(points @ relative[:3, :3].T + relative[:3, 3]) - np.stack([U, V], -1)


def flipped(data):
    """A file with another byte in its middle."""
    middle = len(data) // 2
    return data[:middle] + bytes([data[middle] ^ 255]) + data[middle + 1 :]


class Altered:
    """A sequence with other frames, truth or camera."""

    def __init__(self, base, *, frame=None, truth=None, camera=None):
        self.base = base
        self.frame = frame
        self.frames = getattr(base, "frames", None) or [base[index] for index in range(len(base))]
        self.ground_truth = truth(base.ground_truth) if truth else base.ground_truth
        self.camera = camera(base.camera) if camera else base.camera

    def __getattr__(self, name):
        return getattr(self.base, name)

    def __len__(self):
        return len(self.base)

    def __getitem__(self, index):
        frame = self.frames[index]
        if self.frame is None:
            return frame
        rgb, depth = self.frame(frame, self.base)
        return Frame(
            frame.index, frame.timestamp, np.ascontiguousarray(rgb), np.ascontiguousarray(depth)
        )


def frame_hash(frame):
    """A hash of a frame's colours and depth."""
    return hashlib.sha256(frame.rgb.tobytes() + frame.depth.tobytes()).hexdigest()
