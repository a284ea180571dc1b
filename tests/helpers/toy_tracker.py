"""A tracker whose error is known, and sequences for it: depth tells the true position, a setting scales it."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import cv2
import numpy as np

from dynslam_bench.contracts import Frame, TrackResult
from dynslam_bench.core.settings import Settings, tunable
from dynslam_bench.geometry.camera import Camera
from dynslam_bench.sequences.cameras import write_camera
from dynslam_bench.trackers import TrackerSpec


class ToySettings(Settings):
    gain: float = tunable(
        1.5, low=0.2, high=3.0, scale="log", meaning="scale of the motion; 1 is right"
    )
    wobble: int = tunable(2, low=0, high=8, meaning="noise", unit="mm")
    mode: Literal["fine", "crash"] = tunable("fine", meaning="whether it crashes")
    anger: float = tunable(0.5, low=0.0, high=1.0, meaning="nothing")
    plain: str = "not tunable"


class Toy:
    def __init__(self, settings: ToySettings) -> None:
        self.settings = settings

    def reset(self, camera: Camera, *, rng: np.random.Generator) -> None:
        self.rng = rng

    def track(self, frame: Frame) -> TrackResult:
        if self.settings.mode == "crash" and frame.index == 3:
            raise RuntimeError("the toy broke")
        pose = np.eye(4)
        pose[0, 3] = self.settings.gain * (float(frame.depth[0, 0]) - 1.0)
        pose[:3, 3] += self.rng.normal(0, 1e-3 * self.settings.wobble, 3)
        return TrackResult(pose, "ok", {"keypoints": 1.0}, {"tracking": 1e-3})


SPEC = TrackerSpec(id="toy", entry_point=f"{__file__}:Toy", label="Toy", settings=ToySettings)


def make_sequence(folder: Path, phase: float, frames: int = 12) -> Path:
    """A folder in TUM layout of 16x12 images whose camera swings along x."""
    lists: dict[str, list[str]] = {"rgb": [], "depth": [], "groundtruth": []}
    for i in range(frames):
        x = 0.2 * np.sin(0.7 * i + phase)
        stamp = 100 + i / 30
        images = {"rgb": np.full((12, 16, 3), 10 * i, np.uint8)}
        images["depth"] = np.full((12, 16), round(5000 * (1 + x)), np.uint16)
        for kind, image in images.items():
            (folder / kind).mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(folder / kind / f"{i}.png"), image)
            lists[kind].append(f"{stamp:.6f} {kind}/{i}.png")
        lists["groundtruth"].append(f"{stamp:.6f} {x:.6f} 0 0 0 0 0 1")
    for name, lines in lists.items():
        (folder / f"{name}.txt").write_text("\n".join(lines) + "\n")
    write_camera(folder / "camera.toml", Camera(16, 12, 15.0, 15.0, 7.5, 5.5, depth_factor=5000.0))
    return folder
