"""What the tracker saw on some frames of a run: its features, kept or culled, and its mask; for pictures afterwards."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.contracts.tracker import MapOutputs, TrackResult
from dynslam_bench.core.errors import RunError, TrackerError
from dynslam_bench.core.reading import read_npz
from dynslam_bench.envs.rendering import CULLED, KEPT, MASK, Canvas, Image
from dynslam_bench.envs.slam_env import SlamEnv
from dynslam_bench.evaluation.alignment import align
from dynslam_bench.evaluation.online import OnlineError
from dynslam_bench.geometry import se3
from dynslam_bench.geometry.trajectory import Trajectory
from dynslam_bench.runs.spec import RunSpec
from dynslam_bench.slam.map_files import MAP_FILE, write_keyframes_csv, write_ply
from dynslam_bench.slam.sheet import draw_sheet, write_sheet

if TYPE_CHECKING:
    from dynslam_bench.envs.episode import FrameOutcome


SNAPSHOTS_FILE = "snapshots.npz"
SPREAD = 24
"""Frames that are kept evenly spread over a run."""
MOST_FRAMES = 1000
"""Of a file that is read."""
WORST = 6
"""Frames that are kept besides, those with the largest frame-to-frame error."""


@dataclass(frozen=True, eq=False)
class Snapshot:
    """One frame as the tracker saw it.

    Attributes:
        index: Index of the frame in the run's part of the sequence.
        points: int16 ``[N, 2]``, pixels of the features.
        kept: bool ``[N]``, which of them were kept.
        packed: uint8 ``[H, ceil(W / 8)]``, eight pixels of the mask a byte; None where the tracker gave no mask.
        width: W, pixels of a line of the mask.
    """

    index: int
    points: NDArray[np.int16]
    kept: NDArray[np.bool_]
    packed: NDArray[np.uint8] | None
    width: int

    @property
    def mask(self) -> NDArray[np.bool_] | None:
        """Pixels held for dynamic, bool ``[H, W]``; None where the tracker gave no mask."""
        return None if self.packed is None else np.unpackbits(self.packed, axis=1, count=self.width).view(np.bool_)


def spread(frames: int, count: int = SPREAD) -> list[int]:
    """At most `count` frames evenly spread over so many, the first and the last among them."""
    return sorted({int(index) for index in np.linspace(0, max(frames - 1, 0), min(count, frames)).round()})


class SnapshotWriter:
    """Collects snapshots while a run goes on; nothing is written for trackers that show neither features nor masks.

    Args:
        folder: The run's.
        frames: Frames of the run's part of the sequence.
    """

    def __init__(self, folder: Path, frames: int) -> None:
        self._path, self._spread = folder / SNAPSHOTS_FILE, set(spread(frames))
        self._even: list[Snapshot] = []
        self._worst: list[tuple[float, Snapshot]] = []
        self._size = (0, 0)

    def add(self, outcome: FrameOutcome, shape: tuple[int, ...], result: TrackResult) -> None:
        """Keep the frame if it is one of those spread over the run, or among the worst so far."""
        if result.keypoints_xy is None and result.dynamic_mask is None:
            return
        self._size = (shape[0], shape[1])
        error = None if outcome.error is None else outcome.error.frame_trans_m
        if outcome.index in self._spread:
            self._even.append(taken(outcome.index, result))
        elif error is not None and (len(self._worst) < WORST or error > self._worst[-1][0]):
            self._worst.append((error, taken(outcome.index, result)))
            self._worst = sorted(self._worst, key=lambda pair: -pair[0])[:WORST]

    def write(self) -> None:
        """Write what was kept."""
        shots = sorted([*self._even, *(shot for _, shot in self._worst)], key=lambda shot: shot.index)
        if not shots:
            return
        empty = np.zeros((self._size[0], -(-self._size[1] // 8)), np.uint8)
        np.savez_compressed(
            self._path,
            index=np.array([shot.index for shot in shots], np.int32),
            count=np.array([len(shot.points) for shot in shots], np.int32),
            points=np.concatenate([shot.points for shot in shots]),
            kept=np.concatenate([shot.kept for shot in shots]),
            size=np.array(self._size, np.int32),
            masked=np.array([shot.packed is not None for shot in shots]),
            masks=np.stack([empty if shot.packed is None else shot.packed for shot in shots]),
        )


def taken(index: int, result: TrackResult) -> Snapshot:
    """What a tracker saw on a frame."""
    points = np.zeros((0, 2)) if result.keypoints_xy is None else np.asarray(result.keypoints_xy).reshape(-1, 2)
    kept = result.keypoints_keep
    mask = result.dynamic_mask
    return Snapshot(
        index,
        np.clip(points.round(), -(2**15), 2**15 - 1).astype(np.int16),
        np.ones(len(points), bool) if kept is None else np.array(kept, dtype=bool),
        None if mask is None else np.packbits(np.asarray(mask, dtype=bool), axis=1),
        0 if mask is None else mask.shape[1],
    )


def read_snapshots(folder: Path) -> tuple[tuple[int, int], list[Snapshot]]:
    """The snapshots of a stored run.

    Args:
        folder: The run's.

    Returns:
        Height and width of the images in pixels, and the snapshots in order; none for runs without any (imported, of
        older versions, of trackers that show neither features nor masks).

    Raises:
        RunError: The file is damaged.
    """
    path = folder / SNAPSHOTS_FILE
    if not path.is_file():
        return (0, 0), []
    found = read_npz(path, kind=RunError)
    try:
        height, width = map(int, found["size"])
        index, count, points, kept = found["index"], found["count"], found["points"], found["kept"]
        masks, masked = found["masks"], found["masked"]
        if masks.dtype != np.uint8 or masks.shape[1:] != (height, -(-width // 8)):
            raise ValueError(f"masks of {masks.dtype} {masks.shape} do not fit {width} x {height} pixels")
        if not (
            len(index) == len(count) == len(masks) == len(masked) <= MOST_FRAMES
            and (count >= 0).all()
            and points.shape == (count.sum(), 2)
            and kept.shape == points.shape[:1]
            and points.dtype == np.int16
            and kept.dtype == masked.dtype == np.bool_
        ):
            raise ValueError("its arrays do not fit each other")
        ends = np.cumsum(count)[:-1]
        parts = zip(np.split(points, ends), np.split(kept, ends), strict=True)
        shots = [
            Snapshot(int(index[at]), place, keep, masks[at] if masked[at] else None, width)
            for at, (place, keep) in enumerate(parts)
        ]
    except (LookupError, ValueError, TypeError, ArithmeticError) as error:
        raise RunError(f"{path} holds no snapshots: {' '.join(str(error).split())[:200]}") from error
    return (height, width), shots


# What is kept of the map at the end of a run.


@dataclass(frozen=True)
class KeptMap:
    """A run's map.

    Attributes:
        outputs: Keyframes and points; None if the tracker offers none.
        counts: ``keyframes``, ``map_points`` and ``maps`` for the record; None for what the tracker does not say.
        notes: What a reader should know of it.
    """

    outputs: MapOutputs | None
    counts: dict[str, Any] = field(default_factory=lambda: dict.fromkeys(("keyframes", "map_points", "maps")))
    notes: tuple[str, ...] = ()


def keep_map(env: SlamEnv, folder: Path, spec: RunSpec) -> KeptMap:
    """Write ``keyframes.csv``, ``map.ply`` and, if it was asked for, ``map.npz``.

    Raises:
        DynslamError: A file cannot be written.
    """
    not_saved = _save(env, folder, spec) if spec.save_map else ()
    outputs = env.map_outputs()
    if outputs is None:
        return KeptMap(None, notes=not_saved)
    write_keyframes_csv(folder / "keyframes.csv", outputs, env.exact_stamps)
    write_ply(folder / "map.ply", outputs)
    numbers = np.array([record.map for record in outputs.keyframes])
    maps = len(np.unique(numbers))
    counts = {"keyframes": len(outputs.keyframes), "map_points": len(outputs.positions), "maps": maps}
    apart = int(np.count_nonzero(numbers))
    met = (
        f"{maps} maps that never met: {apart} of {len(numbers)} keyframes lie in others than the first, whose place "
        "in it is unknown; frames tracked there count as lost, and no points of it are in map.ply"
    )
    return KeptMap(outputs, counts, (*not_saved, *([met] if maps > 1 else [])))


def _save(env: SlamEnv, folder: Path, spec: RunSpec) -> tuple[str, ...]:
    """Write the map; why that was not possible, if it was not."""
    start, stop = spec.frames_seen or (0, None)
    asked = spec.settings | {f"degrade.{kind}": strength for kind, strength in spec.degrade.items()}
    words = [f"{env.tracker_spec.id} on {env.sequence.id}", f"frames {start}:{'' if stop is None else stop}"]
    words += [f"stride {spec.stride}"] * (spec.stride != 1) + [f"seed {spec.seed}"]
    words += [f"{name}={value}" for name, value in asked.items()]
    try:
        env.save_map(folder / MAP_FILE, ", ".join(words))
    except TrackerError as error:
        return (f"no {MAP_FILE}: {error}",)
    return ()


# Collects what the five-panel sheet of a run shows while the run goes on, and writes it at the end.

SHOWN = 9
"""Frames, and keyframes, on a sheet."""
SHEET_FILE = "sheet.png"
FEATURES = (("kept", KEPT), ("culled", CULLED), ("mask", MASK))


class SheetWriter:
    """Input, frames with their features, keyframes, map and track of one run as ``sheet.png``.

    Args:
        path: Where to write.
        env: The run's environment.
    """

    def __init__(self, path: Path, env: SlamEnv) -> None:
        self._path, self._env = path, env
        self._canvas = Canvas(env.sequence, env.tracker_spec.label)
        self._wanted = set(_spread(len(env.sequence)))
        self._frames: list[Image] = []

    def add(self) -> None:
        """Keep the picture of the current frame if it is one of those shown."""
        if self._env.episode.outcomes[-1].index in self._wanted:
            self._frames.append(self._canvas.picture(self._env.frame, self._env.result))

    def write(self, outputs: MapOutputs, track: Trajectory) -> None:
        """Draw and write the sheet.

        Args:
            outputs: Keyframes and map points.
            track: The run's final trajectory, or the online one.
        """
        sequence = self._env.sequence
        own = [record.frame for record in outputs.keyframes if record.frame >= 0]  # others are of an earlier run
        shown = [own[row] for row in _spread(len(own))]
        title = f"{self._env.tracker_spec.label}  |  {sequence.id}"
        keyframes = [sequence[index].rgb for index in shown]
        truth, ate_m = aligned_truth(sequence.ground_truth, track)
        sheet = draw_sheet(title, sequence[0].rgb, self._frames, keyframes, outputs, track, truth, ate_m, FEATURES)
        write_sheet(self._path, sheet)


def _spread(count: int) -> list[int]:
    """At most `SHOWN` indices spread over `count` things, the first and the last among them."""
    return sorted({int(index) for index in np.linspace(0, max(count - 1, 0), min(SHOWN, count)).round()})


# The video of a run, in a format that browsers play: VP9 in WebM, which OpenCV brings along.

VIDEO_FILE = "video.webm"


class VideoWriter:
    """Writes the rendered frames of an environment as `VIDEO_FILE`; a run that ends early leaves what it has.

    Args:
        folder: Where to write.
        env: The run's environment, in render mode ``rgb_array``.
    """

    def __init__(self, folder: Path, env: SlamEnv) -> None:
        self._path, self._env = folder / VIDEO_FILE, env
        self._writer: Any = None

    def add(self) -> None:
        """Append the picture of the current frame.

        Raises:
            RunError: This OpenCV cannot write such a video.
        """
        import cv2

        image = self._env.render()
        assert image is not None
        if self._writer is None:
            size = (image.shape[1], image.shape[0])
            code = cv2.VideoWriter.fourcc(*"VP90")
            self._writer = cv2.VideoWriter(str(self._path), code, self._env.sequence.fps, size)
            if not self._writer.isOpened():
                raise RunError(
                    f"OpenCV {cv2.__version__} cannot write VP9 video",
                    "pip install opencv-python-headless, or no --video",
                )
        self._writer.write(np.ascontiguousarray(image[:, :, ::-1]))

    def close(self) -> None:
        """Finish the file."""
        if self._writer is not None:
            self._writer.release()


# The ground truth laid over a run's trajectory, for pictures of it.


def aligned_truth(truth: Trajectory | None, track: Trajectory) -> tuple[Trajectory | None, float | None]:
    """The ground truth at the track's stamps, moved onto the track by least squares, and what is left in metres (RMSE).

    Both are None without enough of it.
    """
    if truth is None:
        return None, None
    errors = OnlineError(truth)
    poses = [errors.truth_at(float(stamp)) for stamp in track.timestamps]
    known = [row for row, pose in enumerate(poses) if pose is not None]
    if len(known) < 3:
        return None, None
    true = np.array([poses[row] for row in known])
    fit = align(track.T_world_cam[known], true, "se3")
    move = np.eye(4)
    move[:3, :3], move[:3, 3] = fit.rotation, fit.translation
    moved = Trajectory(track.timestamps[known], se3.inverse(move) @ true)
    left = moved.positions - track.positions[known]
    return moved, float(np.sqrt(np.square(left).sum(axis=1).mean()))
