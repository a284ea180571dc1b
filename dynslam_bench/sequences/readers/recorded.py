"""Recorded RGB-D sequences of every layout: frames that are decoded when asked for."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import NoReturn

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.contracts.sequence import Frame, MaskSource
from dynslam_bench.core.errors import SequenceError
from dynslam_bench.core.fingerprint import contents_digest
from dynslam_bench.core.records import digest
from dynslam_bench.core.sanitise import inside
from dynslam_bench.geometry.association import associate, nearest_gap
from dynslam_bench.geometry.camera import Camera
from dynslam_bench.geometry.rigs import in_camera_axes
from dynslam_bench.geometry.trajectory import Trajectory
from dynslam_bench.sequences.readers.lists import Contents, Dropped, ImageList

GROUND_TRUTH_DT_S = 0.02
SLOWEST_S = 5.0
"""Frames further apart by the median are no video: their stamps are in another unit than seconds."""
MISSING_TOLERATED = 0.02
"""Part of a list's images that may be missing: Bonn's lists name a few images that its archives lack."""


@dataclass(frozen=True)
class Description:
    """What is known of a sequence beside its files.

    Attributes:
        id: For example ``tum/fr3/walking_xyz``.
        camera: Intrinsics of the colour images.
        fps: Nominal frame rate in Hz; None to take it from the stamps.
        license: Licence of the data.
        citation: What to cite.
        tags: For example ``high-dynamic``.
        split: ``tune``, ``held-out`` or empty.
        R_body_cam: Rotation from the camera's axes to those of the body that the ground truth tracks, rows of a 3x3
            matrix; None where the ground truth is the camera's.
    """

    id: str
    camera: Camera
    fps: float | None = None
    license: str = "unknown"
    citation: str = ""
    tags: frozenset[str] = frozenset()
    split: str = ""
    R_body_cam: tuple[tuple[float, float, float], ...] | None = None


class RecordedSequence:
    """A folder with colour images, depth images and (maybe) a ground truth; frames are decoded when asked for.

    Images that are not paired already are paired as TUM's ``associate.py`` pairs them. Files are looked for and the
    first pair is decoded on opening, so that most damage shows at once.

    Args:
        folder: The sequence's folder.
        contents: What its reader found in it.
        description: Camera, id, licence and so on.
        max_time_difference_s: Colour and depth further apart are not paired (strictly less is).
        any_depth_size: True if the caller resizes, so that depth images may differ in size from colour images.

    Attributes:
        folder: The sequence's folder.
        timestamps_ns: Stamps of the colour images in nanoseconds, int64 ``[N]``.
        dropped: What was not used, and why.

    Raises:
        SequenceError: Its images are missing, damaged, of the wrong kind, or lie outside.
    """

    def __init__(
        self,
        folder: Path,
        contents: Contents,
        description: Description,
        *,
        max_time_difference_s: float = 0.02,
        any_depth_size: bool = False,
    ) -> None:
        self.folder = folder
        self._description = description
        self._any_depth_size = any_depth_size
        self._missing_depth, self._furthest_m = contents.missing_depth, contents.furthest_m
        delay_s = description.camera.depth_delay_s
        delayed = contents.depth.stamps_ns + round(1e9 * delay_s)
        colour, depth = contents.colour, replace(contents.depth, stamps_ns=delayed)
        for file in (*colour.files, *depth.files):
            inside(folder, file, where=f"a list of images in {folder}", kind=SequenceError)
        if contents.paired and not delay_s:
            index = np.arange(len(colour)), np.arange(len(colour))
            _check_files(folder, colour.files, "colour")
            _check_files(folder, depth.files, "depth")
            absent = 0
        else:
            listed = len(colour) + len(depth)
            colour, depth = _existing(folder, colour, "colour"), _existing(folder, depth, "depth")
            absent = listed - len(colour) - len(depth)
            index = associate(colour.stamps, depth.stamps, max_time_difference_s)
        if not len(index[0]):
            gap = float(nearest_gap(colour.stamps, depth.stamps).min())
            raise SequenceError(
                f"none of the {len(colour)} colour images of {folder} has a depth image within "
                f"{max_time_difference_s:g} s (closest: {gap:.3f} s)",
                "do both lists use the same clock?",
            )
        self.timestamps_ns = colour.stamps_ns[index[0]]
        self.timestamps_ns.flags.writeable = False
        self._timestamps = colour.stamps[index[0]]
        _check_unit(folder, self._timestamps)
        self._timestamps.flags.writeable = False
        self._depth_timestamps = depth.stamps[index[1]]
        self._colour = [colour.files[i] for i in index[0]]
        self._depth = [depth.files[i] for i in index[1]]
        self._ground_truth = _turned(contents.truth, description.R_body_cam)
        self.dropped = _count(
            colour,
            depth,
            index,
            absent,
            max_time_difference_s,
            self._timestamps,
            self._ground_truth,
            contents.truth_dropped,
        )
        self[0]

    @property
    def id(self) -> str:
        """For example ``tum/fr3/walking_xyz``."""
        return self._description.id

    @property
    def camera(self) -> Camera:
        """Intrinsics of the colour images."""
        return self._description.camera

    @property
    def timestamps(self) -> NDArray[np.float64]:
        """Stamps of the colour images in seconds ``[N]``, strictly increasing."""
        return self._timestamps

    @property
    def depth_timestamps(self) -> NDArray[np.float64]:
        """Stamps of the frames' depth images in seconds ``[N]``, the camera's `depth_delay_s` added."""
        return self._depth_timestamps

    @property
    def colour_files(self) -> dict[float, str]:
        """The colour image of each stamp, relative to `folder`."""
        return dict(zip(self._timestamps.tolist(), self._colour, strict=True))

    @property
    def ground_truth(self) -> Trajectory | None:
        """Camera-to-world poses in the frame of the motion capture, at their own stamps; None if there are none."""
        return self._ground_truth

    @property
    def masks(self) -> MaskSource | None:
        """None: recorded sequences come without exact masks."""
        return None

    @property
    def fps(self) -> float:
        """Nominal frame rate in Hz; where none is stated, the inverse of the median interval (30 for one frame)."""
        if self._description.fps is not None:
            return self._description.fps
        return float(1 / np.median(np.diff(self._timestamps))) if len(self) > 1 else 30.0

    @property
    def license(self) -> str:
        """Licence of the data."""
        return self._description.license

    @property
    def citation(self) -> str:
        """What to cite."""
        return self._description.citation

    @property
    def tags(self) -> frozenset[str]:
        """For example ``high-dynamic``."""
        return self._description.tags

    @property
    def split(self) -> str:
        """``tune``, ``held-out`` or empty."""
        return self._description.split

    def digest(self) -> str:
        """Digest of camera, frame rate, stamps, ground truth and the contents of all paired images."""
        return self._digest

    @cached_property
    def _digest(self) -> str:
        truth = self._ground_truth
        poses = None if truth is None else [truth.timestamps_ns.tolist(), truth.T_world_cam.tolist()]
        try:
            images = contents_digest(self.folder / file for file in (*self._colour, *self._depth))
        except OSError as error:
            raise SequenceError(
                f"cannot read {error.filename}: {error.strerror}", "fetch the sequence again"
            ) from error
        special = [self._missing_depth, self._furthest_m]
        return digest([repr(self.camera), self.fps, self.timestamps_ns.tolist(), images, poses, special])

    def __len__(self) -> int:
        return len(self._colour)

    def __getitem__(self, index: int) -> Frame:
        from dynslam_bench.sequences.readers.images import read_colour, read_depth

        index = range(len(self))[index]
        size = (self.camera.width, self.camera.height)
        expected = f"{size[0]}x{size[1]}"
        rgb = read_colour(
            self.folder / self._colour[index], size=size, mismatch=f"but the camera of {self.id} is {expected}"
        )
        depth = read_depth(
            self.folder / self._depth[index],
            self.camera.depth_factor,
            size=None if self._any_depth_size else size,
            mismatch=f"but its colour image is {expected}",
            missing=self._missing_depth,
            furthest_m=self._furthest_m,
        )
        return Frame(index, float(self._timestamps[index]), rgb, depth)

    def __repr__(self) -> str:
        return f"<{type(self).__name__} {self.id}: {len(self)} frames in {self.folder}>"

    def verify(self, indices: Iterable[int] | None = None) -> list[str]:
        """Decode frames and say what is wrong with them.

        Args:
            indices: Which frames; all by default.

        Returns:
            One line a damaged frame; empty if all are sound.
        """
        faults = []
        for index in range(len(self)) if indices is None else indices:
            try:
                self[index]
            except SequenceError as error:
                faults.append(f"frame {index}: {error}")
        return faults


def _check_unit(folder: Path, stamps: NDArray[np.float64]) -> None:
    """Refuse stamps in milliseconds, microseconds or nanoseconds: associations and RPE would be over other spans."""
    interval = float(np.median(np.diff(stamps))) if len(stamps) > 1 else 0.0
    if interval <= SLOWEST_S:
        return
    units = {"milliseconds": 1e3, "microseconds": 1e6, "nanoseconds": 1e9}
    likely = [f"{name} ({per_s / interval:.3g} Hz)" for name, per_s in units.items() if 1 <= per_s / interval <= 1000]
    raise SequenceError(
        f"the colour images of {folder} are {interval:g} s apart by the median of their stamps ({1 / interval:.2g} Hz)",
        f"stamps are in seconds; these look like {likely[0] if likely else 'another unit'}",
    )


def _existing(folder: Path, images: ImageList, kind: str) -> ImageList:
    """The images whose files are there; a few may be missing, as in some published sequences."""
    missing = {file for file in images.files if _file_size(folder / file) is None}
    if len(missing) > MISSING_TOLERATED * len(images):
        _refuse(folder, [file for file in images.files if file in missing], len(images), kind, "missing")
    there = [i for i, file in enumerate(images.files) if file not in missing]
    kept = replace(images, stamps_ns=images.stamps_ns[there], files=tuple(images.files[i] for i in there))
    _check_files(folder, kept.files, kind)
    return kept


def _check_files(folder: Path, files: tuple[str, ...], kind: str) -> None:
    """Refuse images that are missing or empty."""
    sizes = {file: _file_size(folder / file) for file in files}
    missing = [file for file in files if sizes[file] is None]
    if missing:
        _refuse(folder, missing, len(files), kind, "missing")
    empty = [file for file in files if sizes[file] == 0]
    if empty:
        _refuse(folder, empty, len(files), kind, "empty (0 bytes)")


def _file_size(path: Path) -> int | None:
    try:
        return path.stat().st_size
    except OSError:
        return None


def _refuse(folder: Path, files: list[str], listed: int, kind: str, state: str) -> NoReturn:
    raise SequenceError(
        f"{len(files)} of {listed} {kind} images of {folder} are {state}, the first is {files[0]}",
        "fetch the sequence again, or remove their lines from the list",
    )


def _turned(truth: Trajectory | None, R_body_cam: tuple[tuple[float, float, float], ...] | None) -> Trajectory | None:
    """The camera's orientations, of a truth that holds those of the body that carries it."""
    if truth is None or R_body_cam is None:
        return truth
    return truth.with_poses(in_camera_axes(truth.T_world_cam, R_body_cam))


def _count(
    colour: ImageList,
    depth: ImageList,
    index: tuple[NDArray[np.intp], NDArray[np.intp]],
    absent: int,
    max_time_difference_s: float,
    stamps: NDArray[np.float64],
    truth: Trajectory | None,
    ground_truth_dropped: str,
) -> Dropped:
    without, hole = 0, 0.0
    if truth is not None:
        without = int(np.count_nonzero(nearest_gap(stamps, truth.timestamps) >= GROUND_TRUTH_DT_S))
        inside = truth.timestamps[(truth.timestamps >= stamps[0]) & (truth.timestamps <= stamps[-1])]
        hole = float(np.diff(np.concatenate([stamps[:1], inside, stamps[-1:]])).max(initial=0.0))
    return Dropped(
        colour_listed=len(colour),
        depth_listed=len(depth),
        pairs=len(stamps),
        colour_unpaired=len(colour) - len(index[0]),
        depth_unpaired=len(depth) - len(index[1]),
        bad_stamps=colour.bad_stamps + depth.bad_stamps,
        duplicate_stamps=colour.duplicate_stamps + depth.duplicate_stamps,
        unsorted=colour.unsorted + depth.unsorted,
        absent=absent,
        unnamed=colour.unnamed + depth.unnamed,
        max_time_difference_s=max_time_difference_s,
        ground_truth_poses=0 if truth is None else len(truth),
        ground_truth_dropped=ground_truth_dropped,
        frames_without_ground_truth=without,
        largest_hole_s=hole,
    )
