"""A small world for the tests of environments and runs: a textured plane in TUM layout, and simple trackers."""

import ctypes
import itertools
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from dynslam_bench.contracts import Frame, FrameMasks, Sequence, TrackerSpec, TrackResult
from dynslam_bench.core.settings import Settings, tunable
from dynslam_bench.geometry import Camera, Trajectory, se3, write_tum
from dynslam_bench.sequences.cameras import write_camera

CAMERA = Camera(160, 120, 130.0, 130.0, 79.5, 59.5, depth_factor=5000.0)
STEP_M = 0.01
"""The toy camera moves so far along x from frame to frame, in its own frame."""


def truth(frames: int) -> np.ndarray:
    """Camera-to-world poses ``[N, 4, 4]``: a straight walk along x with a slow turn about y."""
    step = se3.exp(np.array([STEP_M, 0, 0.002, 0, np.deg2rad(0.3), 0]))
    return np.array(list(itertools.accumulate([np.eye(4), *[step] * (frames - 1)], np.matmul)))


class ToyMasks:
    """A square that is a person, in every frame."""

    def __getitem__(self, index: int) -> FrameMasks:
        instances = np.zeros((CAMERA.height, CAMERA.width), np.uint8)
        instances[40:80, 10 + index : 50 + index] = 1
        return FrameMasks(instances, {1: "person"}, frozenset({1}))


class ToySequence:
    """Random textures in memory; frame i is a function of i only."""

    id = "toy/walk"
    camera = CAMERA
    fps = 30.0
    license = "MIT"
    citation = "tests"

    def __init__(
        self, frames: int = 12, *, has_truth: bool = True, hole: tuple[int, int] | None = None
    ) -> None:
        self.timestamps = 100.0 + np.arange(frames) / 30.0
        keep = np.ones(frames, bool)
        if hole is not None:
            keep[hole[0] : hole[1]] = False
        self.ground_truth = (
            Trajectory(self.timestamps[keep], truth(frames)[keep]) if has_truth else None
        )
        self.masks = ToyMasks()

    def __len__(self) -> int:
        return len(self.timestamps)

    def __getitem__(self, index: int) -> Frame:
        if not 0 <= index < len(self):
            raise IndexError(index)
        return Frame(index, float(self.timestamps[index]), *images(index))

    def digest(self) -> str:
        return f"toy{len(self)}"


def images(index: int) -> tuple[np.ndarray, np.ndarray]:
    """Colour and depth of frame `index`: a texture that slides along."""
    texture = np.random.default_rng(7).integers(
        0, 255, (CAMERA.height, CAMERA.width + 400, 3), dtype=np.uint8
    )
    rgb = np.ascontiguousarray(texture[:, index : index + CAMERA.width])
    return rgb, np.full((CAMERA.height, CAMERA.width), 1.3, np.float32)


def write_folder(folder: Path, frames: int = 12, *, has_truth: bool = True) -> Path:
    """The toy sequence as a folder in TUM layout."""
    return write_sequence(folder, ToySequence(frames, has_truth=has_truth))


def write_sequence(folder: Path, sequence: Sequence) -> Path:
    """A sequence as a folder in TUM layout."""
    lists: dict[str, list[str]] = {"rgb": [], "depth": []}
    for kind in lists:
        (folder / kind).mkdir(parents=True)
    for frame in map(sequence.__getitem__, range(len(sequence))):
        name = f"{frame.timestamp:.6f}.png"
        cv2.imwrite(str(folder / "rgb" / name), frame.rgb[:, :, ::-1])
        cv2.imwrite(str(folder / "depth" / name), np.round(frame.depth * 5000).astype(np.uint16))
        for kind, lines in lists.items():
            lines.append(f"{frame.timestamp:.6f} {kind}/{name}\n")
    for kind, lines in lists.items():
        (folder / f"{kind}.txt").write_text("".join(lines))
    if sequence.ground_truth is not None:
        write_tum(folder / "groundtruth.txt", sequence.ground_truth)
    write_camera(folder / "camera.toml", sequence.camera, fps=30)
    return folder


class Noise(Settings):
    level_m: float = tunable(
        0.001, low=1e-4, high=1e-1, scale="log", unit="m", online=True, meaning="noise of a pose"
    )
    clip: float = tunable(
        2.0, low=0.0, high=4.0, online=True, meaning="largest deviation in standard deviations"
    )
    passes: int = tunable(1, low=1, high=5, online=True, meaning="how often noise is added")
    enabled: bool = tunable(True, online=True, meaning="whether there is noise")
    seedless: int = tunable(0, low=0, high=3, meaning="may not change in mid-episode")


class ToySettings(Settings):
    """What the toy tracker does and when it misbehaves."""

    noise: Noise = Noise()
    mode: str = "ok"
    at: int = 4
    until: int = 10_000


class ToyTracker:
    """Knows the toy camera's motion and adds seeded noise; misbehaves from frame `at` to `until` if told to."""

    def __init__(self, settings: ToySettings) -> None:
        self.settings = self._built = settings

    def reset(self, camera: Camera, *, rng: np.random.Generator) -> None:
        assert camera.width > 0
        self.settings = self._built
        self._rng = rng
        self._poses: dict[float, np.ndarray] = {}

    def configure(self, settings: ToySettings) -> None:
        self.settings = settings

    def track(self, frame: Frame) -> TrackResult:
        noise = self.settings.noise
        pose = truth(frame.index + 1)[-1]
        for _ in range(noise.passes):
            wobble = (
                np.clip(self._rng.normal(size=6), -noise.clip, noise.clip)
                * noise.level_m
                * noise.enabled
            )
            pose = pose @ se3.exp(wobble)
        points = self._rng.uniform(
            (0, 0), (frame.rgb.shape[1], frame.rgb.shape[0]), (100, 2)
        ).astype(np.float32)
        mask = np.zeros(frame.depth.shape, bool)
        mask[40:80, 10 + frame.index : 40 + frame.index] = True
        result = TrackResult(
            pose, "ok",
            {"keypoints": 100.0, "culled": 20.0, "matches": 60.0, "inliers": 50.0, "mask_fraction": float(mask.mean())},
            {"features": 0.001, "tracking": 0.002}, mask, points, np.arange(100) >= 20,
        )  # fmt: skip
        if self.settings.mode != "ok" and self.settings.at <= frame.index < self.settings.until:
            result = misbehave(self.settings.mode, result)
        if (
            isinstance(result, TrackResult)
            and result.state == "ok"
            and result.T_world_cam is not None
        ):
            self._poses[frame.timestamp] = result.T_world_cam
        return result

    def finalize(self) -> Trajectory:
        return Trajectory(
            np.array(list(self._poses)), np.array(list(self._poses.values())).reshape(-1, 4, 4)
        )


def misbehave(mode: str, result: TrackResult) -> TrackResult:
    """One of the ways in which a tracker can fail."""
    match mode:
        case "lost" | "initialising":
            return replace(result, T_world_cam=None, state=mode)
        case "nan":
            return replace(result, T_world_cam=np.full((4, 4), np.nan))
        case "raise":
            raise ValueError("the toy tracker raised on purpose")
        case "segfault":
            ctypes.string_at(0)
        case "memoryerror":
            raise MemoryError("the toy tracker ran out of memory on purpose")
    raise AssertionError(f"unknown mode {mode}")


class FixedTracker:
    """Cannot be steered, has no final trajectory and returns nothing but the pose."""

    def __init__(self, settings: ToySettings) -> None:
        self.settings = settings

    def reset(self, camera: Camera, *, rng: np.random.Generator) -> None:
        """Nothing to forget."""

    def track(self, frame: Frame) -> TrackResult:
        return TrackResult(truth(frame.index + 1)[-1], "ok")


def _spec(
    name: str, factory: str, presets: Mapping[str, Mapping[str, object]] | None = None
) -> TrackerSpec:
    return TrackerSpec(
        id=name, entry_point=f"{__file__}:{factory}", label=f"{name} (tests)", settings=ToySettings,
        summary="for tests", presets=presets or {},
    )  # fmt: skip


SPEC = _spec("toy", "ToyTracker", {"quiet": {"noise.level_m": 1e-4}})
FIXED = _spec("toy-fixed", "FixedTracker")

TARGET = f"{__file__}:SPEC"
"""The toy tracker as users name it."""
