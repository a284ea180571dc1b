"""Files of a run beside its trajectory: snapshots of frames, the map, the sheet, the video."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from dynslam_bench.contracts import MapOutputs, TrackResult
from dynslam_bench.core import RunError, TrackerError, read_npz, translate_errors
from dynslam_bench.envs.episode import FrameOutcome
from dynslam_bench.envs.rendering import CULLED, KEPT, MASK, Canvas, Image, annotated
from dynslam_bench.envs.slam_env import SlamEnv
from dynslam_bench.evaluation.alignment import align
from dynslam_bench.evaluation.online import truths_at
from dynslam_bench.geometry import Trajectory, se3
from dynslam_bench.runs.spec import RunSpec
from dynslam_bench.slam.map_files import MAP_FILE, write_keyframes_csv, write_ply
from dynslam_bench.slam.run_figure import write_run_figure

SNAPSHOTS_FILE = "snapshots.npz"
"""Holds the snapshots of a run."""
SPREAD = 24
"""Frames that are kept evenly spread over a run."""
MOST_FRAMES = 1000
"""A file with more snapshots is damaged."""
WORST = 6
"""Frames that are kept besides: those with the largest frame-to-frame error, and as many on which tracking was lost."""
PICTURE = "frame_{:06d}.webp"
"""Name of the picture of a frame, as its tracker saw it, in the folder of its run."""
_PICTURE_WIDTH = 400
_PICTURE_QUALITY = 55
"""Quality of the WebP files, 1 to 100."""


@dataclass(frozen=True, eq=False)
class Snapshot:
    """One frame as the tracker saw it.

    Attributes:
        index: Index of the frame in the run's part of the sequence.
        points: int16 ``[N, 2]``, pixels of the features.
        kept: bool ``[N]``, which of them were kept.
        packed: uint8 ``[H, ceil(W / 8)]``, eight pixels of the mask a byte; None where the tracker
            gave no mask.
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
        if self.packed is None:
            return None
        return np.unpackbits(self.packed, axis=1, count=self.width).view(np.bool_)


def spread(frames: int, count: int = SPREAD) -> list[int]:
    """At most `count` frames evenly spread over so many, the first and the last among them."""
    indices = np.linspace(0, max(frames - 1, 0), min(count, frames)).round()
    return sorted({int(index) for index in indices})


class _WorstFrame(NamedTuple):
    """A frame with a large frame-to-frame error.

    Attributes:
        error_m: The translational error in metres.
        shot: Its snapshot; None if its tracker shows neither features nor a mask.
        number: Its index in the run's part of the sequence.
        picture: Its picture.
    """

    error_m: float
    shot: Snapshot | None
    number: int
    picture: Image


class SnapshotWriter:
    """Keeps frames while a run goes on: pictures, and snapshots of trackers that show features or masks.

    Pictures of the worst frames are written at the end, all others at once: a run that is killed
    leaves them.

    Args:
        folder: The run's.
        frames: Frames of the run's part of the sequence.
    """

    def __init__(self, folder: Path, frames: int) -> None:
        self._spread = set(spread(frames))
        self._folder = folder
        self._even: list[Snapshot] = []
        self._worst: list[_WorstFrame] = []  # with the largest error first
        self._size = (0, 0)  # height and width
        self._state = ""
        self._losses = 0

    def add(self, outcome: FrameOutcome, rgb: Image, result: TrackResult) -> None:
        """Keep the frame if it is one of those spread over the run, of the worst so far, or the first of a loss."""
        # is it one of the frames spread over the run, or the first of a loss?
        error_m = None if outcome.error is None else outcome.error.frame_trans_m
        is_loss = outcome.state == "lost" and self._state == "ok"
        self._state = outcome.state
        self._losses += is_loss
        is_kept = outcome.index in self._spread or (is_loss and self._losses <= WORST)
        # is its error among the largest so far?
        is_among_worst = error_m is not None and (
            len(self._worst) < WORST or error_m > self._worst[-1].error_m
        )
        if not is_kept and not is_among_worst:
            return
        # what is drawn over it: features and mask
        shot = snapshot_of(outcome.index, result)
        self._size = (rgb.shape[0], rgb.shape[1])
        picture = annotated(rgb, result, _PICTURE_WIDTH)
        if is_kept:
            if shot is not None:
                self._even.append(shot)
            self._write_picture(outcome.index, picture)
        # pictures of the worst wait for the end: a later frame may be worse
        elif error_m is not None:
            self._worst.append(_WorstFrame(error_m, shot, outcome.index, picture))
            self._worst = sorted(self._worst, key=lambda entry: -entry.error_m)[:WORST]

    def _write_picture(self, index: int, picture: Image) -> None:
        options = (cv2.IMWRITE_WEBP_QUALITY, _PICTURE_QUALITY)
        # OpenCV takes blue first
        _, data = cv2.imencode(".webp", np.ascontiguousarray(picture[:, :, ::-1]), options)
        (self._folder / PICTURE.format(index)).write_bytes(data.tobytes())

    def write(self) -> None:
        """Write what was kept."""
        for frame in self._worst:
            self._write_picture(frame.number, frame.picture)
        # all snapshots in the order of their frames
        worst = [frame.shot for frame in self._worst if frame.shot is not None]
        shots = sorted([*self._even, *worst], key=lambda shot: shot.index)
        if not shots:
            return
        # one array each for all frames; frames without a mask get an empty one
        empty = np.zeros((self._size[0], _packed_width(self._size[1])), np.uint8)
        np.savez_compressed(
            self._folder / SNAPSHOTS_FILE,
            index=np.array([shot.index for shot in shots], np.int32),
            count=np.array([len(shot.points) for shot in shots], np.int32),
            points=np.concatenate([shot.points for shot in shots]),
            kept=np.concatenate([shot.kept for shot in shots]),
            size=np.array(self._size, np.int32),
            masked=np.array([shot.packed is not None for shot in shots]),
            masks=np.stack([empty if shot.packed is None else shot.packed for shot in shots]),
        )


def snapshot_of(index: int, result: TrackResult) -> Snapshot | None:
    """The snapshot of a frame that was tracked; None if its tracker shows neither features nor a mask."""
    if result.keypoints_xy is None and result.dynamic_mask is None:
        return None
    # feature points [N, 2] in pixels; none for a tracker that shows a mask alone
    points: NDArray[Any] = np.zeros((0, 2))
    if result.keypoints_xy is not None:
        points = np.asarray(result.keypoints_xy).reshape(-1, 2)
    kept = result.keypoints_keep
    mask = result.dynamic_mask
    return Snapshot(
        index=index,
        points=np.clip(points.round(), -(2**15), 2**15 - 1).astype(np.int16),
        kept=np.ones(len(points), bool) if kept is None else np.array(kept, dtype=bool),
        packed=None if mask is None else np.packbits(np.asarray(mask, dtype=bool), axis=1),
        width=0 if mask is None else mask.shape[1],
    )


def _packed_width(width: int) -> int:
    """Bytes of a line of a mask, eight pixels a byte."""
    return -(-width // 8)


def read_snapshots(folder: Path) -> tuple[tuple[int, int], list[Snapshot]]:
    """The snapshots of a stored run.

    Args:
        folder: The run's.

    Returns:
        Height and width of the images in pixels, and the snapshots in order; none for runs without
        any (imported, of older versions, of trackers that show neither features nor masks).

    Raises:
        RunError: The file is damaged.
    """
    path = folder / SNAPSHOTS_FILE
    if not path.is_file():
        return (0, 0), []
    arrays = read_npz(path, kind=RunError)
    with translate_errors(
        RunError,
        f"{path} holds no snapshots",
        of=(LookupError, ValueError, TypeError, ArithmeticError),
    ):
        height, width = map(int, arrays["size"])
        shots = _unpacked(arrays, height, width)
    return (height, width), shots


def _unpacked(arrays: Mapping[str, NDArray[Any]], height: int, width: int) -> list[Snapshot]:
    """The snapshots of a file's arrays.

    Args:
        arrays: ``index``, ``count`` (features of each frame), ``points`` ``[sum(count), 2]`` and
            ``kept`` of all frames, ``masked`` (whether there is a mask) and ``masks``
            ``[frames, height, ceil(width / 8)]``.
        height: Height of the images in pixels.
        width: Width of the images in pixels.

    Raises:
        LookupError: An array is missing.
        ValueError: They do not fit each other.
    """
    index = arrays["index"]
    count = arrays["count"]
    points = arrays["points"]
    kept = arrays["kept"]
    masks = arrays["masks"]
    masked = arrays["masked"]
    # types, shapes and counts, since the file may come from elsewhere
    if not (
        masks.dtype == np.uint8
        and masks.shape[1:] == (height, _packed_width(width))
        and len(index) == len(count) == len(masks) == len(masked) <= MOST_FRAMES
        and (count >= 0).all()
        and points.shape == (count.sum(), 2)
        and kept.shape == points.shape[:1]
        and points.dtype == np.int16
        and kept.dtype == masked.dtype == np.bool_
    ):
        raise ValueError(f"its arrays do not fit each other and {width} x {height} pixels")
    # the points of all frames lie one after the other: cut them frame by frame
    ends = np.cumsum(count)[:-1]
    features = zip(np.split(points, ends), np.split(kept, ends), strict=True)
    return [
        Snapshot(
            index=int(index[row]),
            points=points_of_frame,
            kept=kept_of_frame,
            packed=masks[row] if masked[row] else None,
            width=width,
        )
        for row, (points_of_frame, kept_of_frame) in enumerate(features)
    ]


def keep_map(
    env: SlamEnv, folder: Path, spec: RunSpec
) -> tuple[MapOutputs | None, dict[str, int | None], list[str]]:
    """Write ``keyframes.csv``, ``map.ply`` and, if it was asked for, ``map.npz``.

    Returns:
        Keyframes and points, None if the tracker offers none; ``keyframes``, ``map_points`` and
        ``maps`` for the record, None for what the tracker does not say; and notes for a reader.

    Raises:
        DynslamError: A file cannot be written.
    """
    notes: list[str] = []
    # the map to begin other runs with; a tracker may have none
    if spec.save_map:
        try:
            env.save_map(folder / MAP_FILE, _origin_of_map(env, spec))
        except TrackerError as error:
            notes.append(f"no {MAP_FILE}: {error}")
    outputs = env.map_outputs()
    if outputs is None:
        return None, dict.fromkeys(("keyframes", "map_points", "maps")), notes
    # keyframes and points, for readers
    write_keyframes_csv(folder / "keyframes.csv", outputs, env.exact_stamps)
    write_ply(folder / "map.ply", outputs)
    # maps that were never merged have numbers of their own
    numbers = np.array([keyframe.map for keyframe in outputs.keyframes])
    maps = len(np.unique(numbers))
    if maps > 1:
        notes.append(
            f"{maps} maps that never met: {np.count_nonzero(numbers)} of {len(numbers)} keyframes lie in others than "
            "the first, whose place in it is unknown; frames tracked there count as lost, and no points of it are in "
            "map.ply"
        )
    return (
        outputs,
        {"keyframes": len(numbers), "map_points": len(outputs.positions), "maps": maps},
        notes,
    )


def _origin_of_map(env: SlamEnv, spec: RunSpec) -> str:
    """Describe the run that made a map, in words."""
    start, stop = spec.frames_seen or (0, None)
    asked = spec.settings | {f"degrade.{kind}": strength for kind, strength in spec.degrade.items()}
    # tracker and sequence, then what was asked for otherwise than by default
    words = [
        f"{env.tracker_spec.id} on {env.sequence.id}",
        f"frames {start}:{'' if stop is None else stop}",
    ]
    if spec.stride != 1:
        words.append(f"stride {spec.stride}")
    words.append(f"seed {spec.seed}")
    words += [f"{name}={value}" for name, value in asked.items()]
    return ", ".join(words)


SHOWN = 9
"""Frames, and keyframes, on a sheet."""
SHEET_FILE = "sheet.png"
"""The picture that ``--sheet`` asks for."""
FEATURES = (("kept", KEPT), ("culled", CULLED), ("mask", MASK))
"""Legend of a sheet: what is drawn over its frames, and its colour."""


class SheetWriter:
    """Input, frames with their features, keyframes, map and track of one run as ``sheet.png``.

    Args:
        path: Where to write.
        env: The run's environment.
    """

    def __init__(self, path: Path, env: SlamEnv) -> None:
        self._path = path
        self._env = env
        self._canvas = Canvas(env.sequence, env.tracker_spec.label)
        self._wanted = set(spread(len(env.sequence), SHOWN))
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
        # keyframes without a frame came with the map of an earlier run
        frames_of_run = [record.frame for record in outputs.keyframes if record.frame >= 0]
        shown = [frames_of_run[row] for row in spread(len(frames_of_run), SHOWN)]
        title = f"{self._env.tracker_spec.label}  |  {sequence.id}"
        keyframes = [sequence[index].rgb for index in shown]
        # the ground truth, moved onto the track, as both are drawn
        truth, ate_m = aligned_truth(sequence.ground_truth, track)
        write_run_figure(
            self._path,
            title,
            sequence[0].rgb,
            self._frames,
            keyframes,
            outputs,
            track,
            truth,
            ate_m,
            FEATURES,
        )


VIDEO_FILE = "video.webm"
"""The video that ``--video`` asks for."""


class VideoWriter:
    """Writes the rendered frames of an environment as `VIDEO_FILE`; a run that ends early leaves what it has.

    Args:
        folder: Where to write.
        env: The run's environment, in render mode ``rgb_array``.
    """

    def __init__(self, folder: Path, env: SlamEnv) -> None:
        self._path = folder / VIDEO_FILE
        self._env = env
        self._writer: Any = None

    def add(self) -> None:
        """Append the picture of the current frame.

        Raises:
            RunError: This OpenCV cannot write such a video.
        """
        image = self._env.render()
        assert image is not None
        # the first picture decides the size
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


def aligned_truth(
    truth: Trajectory | None, track: Trajectory
) -> tuple[Trajectory | None, float | None]:
    """The ground truth at the track's stamps, moved onto the track by least squares, and what is left in metres (RMSE).

    Both are None without enough of it.
    """
    # ground truth of the rows that have one; three positions fix a rigid motion
    truth_by_row = truths_at(truth, track.timestamps)
    if len(truth_by_row) < 3:
        return None, None
    rows = list(truth_by_row)
    true_poses = np.array(list(truth_by_row.values()))
    # the rigid motion of the track onto the truth, and its inverse on the truth
    fit = align(track.T_world_cam[rows], true_poses, "se3")
    T_truth_track = np.eye(4)
    T_truth_track[:3, :3] = fit.rotation
    T_truth_track[:3, 3] = fit.translation
    moved = Trajectory(track.timestamps[rows], se3.inverse(T_truth_track) @ true_poses)
    # what is left after the alignment
    squared_errors = np.square(moved.positions - track.positions[rows]).sum(axis=1)
    return moved, float(np.sqrt(squared_errors.mean()))
