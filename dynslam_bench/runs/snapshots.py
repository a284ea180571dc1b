"""What the tracker saw on some frames of a run: its features, kept or culled, and its mask; for pictures afterwards."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.contracts.result import TrackResult
from dynslam_bench.core.array_files import read_npz
from dynslam_bench.core.errors import RunError

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
