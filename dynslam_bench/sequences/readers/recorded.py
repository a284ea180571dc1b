"""Recorded RGB-D sequences of every layout: frames that are decoded when asked for."""

import os
from collections import Counter
from dataclasses import replace
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from dynslam_bench.contracts import Frame, FrameMasks, MaskSource
from dynslam_bench.core import SequenceError, path_below, translate_errors
from dynslam_bench.core.fingerprint import contents_digest
from dynslam_bench.core.images import read_image
from dynslam_bench.core.records import digest
from dynslam_bench.geometry import Camera, Trajectory, associate, nearest_gap
from dynslam_bench.geometry.rigs import in_camera_axes
from dynslam_bench.geometry.speeds import impossible_motion
from dynslam_bench.sequences.readers.files import Contents, ImageList
from dynslam_bench.sequences.view import Masks

GROUND_TRUTH_DT_S = 0.02
"""A frame has a true pose if there is one within this time."""
SLOWEST_S = 5.0
"""Frames further apart by the median are no video: their stamps are in another unit than seconds."""
FASTEST_S = 0.0005
"""Frames closer together by the median are no camera's: their stamps are in another unit than their layout says."""
RATES_AGREE = 1.25
"""A stated frame rate and the stamps' may differ by this factor: clocks drift. More is said."""
RATES_CONTRADICT = 3.0
"""Nobody means a frame rate that differs from the stamps' by this factor; the stamps' is taken."""
LONGEST_READOUT = 2.0
"""Times between two images that a stated readout may last: built-in cameras are used at twice their rate, too."""
DEPTH_RANGE_M = (0.1, 60.0)
"""Median depths outside of this range are in another unit than metres."""
USUAL_FACTORS = (1.0, 100.0, 1000.0, 5000.0)
"""Raw units a metre of public data: metres, centimetres, millimetres, TUM's."""
MISSING_TOLERATED = 0.02
"""Part of a list's images that may be missing: Bonn's lists name a few images that its archives lack."""


class RecordedSequence:
    """A folder with colour images, depth images and (maybe) a ground truth; frames are decoded when asked for.

    Images that are not paired already are paired as TUM's ``associate.py`` pairs them. Files are
    looked for and the first pair is decoded on opening, so that most damage shows at once.

    Args:
        folder: The sequence's folder.
        contents: What its reader found in it.
        camera: Intrinsics of the colour images; its `R_body_cam` is applied to the ground truth.
        id: For example ``tum/fr3/walking_xyz``.
        fps: Nominal frame rate in Hz; None to take it from the stamps, as is done where these
            contradict it.
        license: Licence of the data.
        citation: What to cite.
        tags: For example ``high-dynamic``.
        split: ``tune``, ``held-out`` or empty.
        notes: Phrases for `dropped` on how the folder was read.
        layout: Name of the folder's layout, for `taken_for`.
        camera_source: What says which camera it is, for `taken_for`.
        max_time_difference_s: Colour and depth further apart are not paired (strictly less is).
        any_depth_size: True if the caller resizes, so that depth images may differ in size from
            colour images.

    Attributes:
        folder: The sequence's folder.
        timestamps: Stamps of the colour images in seconds ``[N]``, strictly increasing.
        timestamps_ns: Stamps of the colour images in nanoseconds, int64 ``[N]``.
        depth_timestamps: Stamps of the frames' depth images in seconds ``[N]``, the camera's
            `depth_delay_s` added.
        ground_truth: Camera-to-world poses in the frame of the motion capture, at their own stamps;
            None without any.
        masks: Exact masks of people where the folder lists them (`PEOPLE_LIST`), else None.
        fps: Nominal frame rate in Hz; where none is stated, or one that differs from the stamps' by
            `RATES_CONTRADICT`, the inverse of the median interval (30 for one frame).
        dropped: One line on the frames, and on all that was not used or not taken as it stands.
        remarks: Phrases of that line that tell more than numbers of images and poses: files
            that were not used, a frame rate or a depth that nobody could mean.
        taken_for: Three lines on what the folder was taken for: images and rate; camera and depth
            unit; ground truth and numbers of what was not used. `remarks` are not repeated: the
            table of the runs has them.

    Raises:
        SequenceError: Its images are missing, damaged, of the wrong kind, or lie outside.
    """

    def __init__(
        self,
        folder: Path,
        contents: Contents,
        camera: Camera,
        *,
        id: str,
        fps: float | None = None,
        license: str = "unknown",
        citation: str = "",
        tags: frozenset[str] = frozenset(),
        split: str = "",
        notes: tuple[str, ...] = (),
        layout: str = "",
        camera_source: str = "",
        max_time_difference_s: float = 0.02,
        any_depth_size: bool = False,
    ) -> None:
        self.folder = folder
        self.id = id
        self.camera = camera
        self.license = license
        self.citation = citation
        self.tags = tags
        self.split = split
        self._any_depth_size = any_depth_size
        self._furthest_m = contents.furthest_m

        # the images that are there, in pairs of a colour and a depth image
        _check_inside(folder, contents)
        paired = contents.paired and not camera.depth_delay_s
        colour, depth = _existing_images(folder, contents, camera, paired=paired)
        if paired:
            first = second = np.arange(len(colour))
        else:
            first, second = _associated(folder, colour, depth, max_time_difference_s)

        # stamps in seconds, the frame rate, and the files of each frame
        self.timestamps_ns = colour.stamps_ns[first]
        self.timestamps = colour.stamps[first]
        self.timestamps_ns.flags.writeable = False
        self.timestamps.flags.writeable = False
        _check_unit(folder, self.timestamps)
        self.fps, rate_note = _frame_rate(fps, self.timestamps)
        _check_readout(folder, camera, self.timestamps)
        self.depth_timestamps = depth.stamps[second]
        self._colour = [colour.files[i] for i in first]
        self._depth = [depth.files[i] for i in second]

        # masks of people, and the truth in the camera's axes
        self._people: list[str] = []
        if contents.people is not None:
            self._people = self._mask_files(_existing(folder, contents.people, "mask", 0.0))
        self.masks: MaskSource | None = Masks(self._masks_of) if self._people else None
        self.ground_truth, turned = _truth_of_camera(contents.truth, camera)

        # what was not used, or nobody could mean; most damage shows in the first frame
        remarks = [*contents.notes, *notes, rate_note, self._doubtful_depth(self[0].depth)]
        self.remarks = tuple(remark for remark in remarks if remark)
        counts = {
            "colour images without depth": len(colour) - len(self),
            "depth images unused": len(depth) - len(self),
            **(colour.irregular + depth.irregular),
            **self._count_poses(),
        }
        phrases = [
            f"{len(self)} frames of {len(colour)} colour and {len(depth)} depth images "
            f"(|dt| < {max_time_difference_s:g} s)",
            *(f"{count} {what}" for what, count in counts.items() if count),
            "" if self.ground_truth else "no ground truth",
            contents.truth_dropped,
            turned,
        ]
        doubtful = [self._doubtful_truth(), *self.remarks]
        self.dropped = "; ".join(phrase for phrase in (*phrases, *doubtful) if phrase)

        # what the folder was taken for
        unit = "depth in metres"
        if camera.depth_factor is not None:
            unit = f"{camera.depth_factor:g} raw depth units a metre"
        of = [str(Path(files[0]).parent) for files in (self._colour, self._depth)]
        rate = "stated" if fps is not None and not rate_note else "by the stamps"
        self.taken_for = (
            f"taken for layout {layout or 'unknown'}: colour in {of[0]}, depth in {of[1]}, {len(self)} frames at "
            f"{self.fps:.4g} Hz ({rate})",
            f"camera by {camera_source or 'the caller'}: {camera.width}x{camera.height}, fx {camera.fx:g}, "
            f"fy {camera.fy:g}, {unit}",
            "; ".join(phrase for phrase in phrases[1:] if phrase)
            or "all images and poses are used",
        )

    def _doubtful_depth(self, depth: NDArray[np.float32]) -> str:
        """A phrase where the first image holds no depth, or one that its factor cannot mean; empty otherwise."""
        measured = depth[depth > 0]
        if not len(measured):
            return "the first depth image holds no depth"
        median = float(np.median(measured))
        if DEPTH_RANGE_M[0] <= median <= DEPTH_RANGE_M[1]:
            return ""
        factor = self.camera.depth_factor
        fault = f"the first depth image is {median:.3g} m away by the median"
        if factor is None:
            return f"{fault}: are its numbers metres?"
        likely = likely_factor(median * factor)
        cure = "no usual factor fits"
        if likely is not None:
            cure = f"depth_factor = {likely:g} would give {median * factor / likely:.3g} m"
        return f"{fault}, with depth_factor = {factor:g}: {cure}"

    def _doubtful_truth(self) -> str:
        """A phrase where the truth moves as no camera does; empty otherwise."""
        if self.ground_truth is None:
            return ""
        motion = impossible_motion(self.ground_truth, "ground truth")
        return "" if motion is None else str(motion)

    def _mask_files(self, people: ImageList) -> list[str]:
        """The mask of each frame; all have to have one of their stamp."""
        at = np.searchsorted(people.stamps_ns, self.timestamps_ns).clip(max=len(people) - 1)
        unmasked = int(np.count_nonzero(people.stamps_ns[at] != self.timestamps_ns))
        if unmasked:
            raise SequenceError(
                f"{unmasked} of {len(self)} frames of {self.folder} have no mask of their stamp"
            )
        return [people.files[i] for i in at]

    def _count_poses(self) -> dict[str, int]:
        """Number of poses of the ground truth, and of frames that have none."""
        stamps = self.timestamps
        truth = self.ground_truth
        if truth is None:
            return {}
        without = int(np.count_nonzero(nearest_gap(stamps, truth.timestamps) >= GROUND_TRUTH_DT_S))

        # the largest time without a pose, the first and the last frame included
        times = truth.timestamps
        within = times[(times >= stamps[0]) & (times <= stamps[-1])]
        hole = float(np.diff(np.concatenate([stamps[:1], within, stamps[-1:]])).max(initial=0.0))
        gap = f"frames without ground truth within {GROUND_TRUTH_DT_S:g} s (largest hole {hole:.2f} s)"
        return {"ground-truth poses": len(truth), gap: without}

    @property
    def colour_files(self) -> dict[float, str]:
        """The colour image of each stamp, relative to `folder`."""
        return dict(zip(self.timestamps.tolist(), self._colour, strict=True))

    def digest(self) -> str:
        """Digest of camera, frame rate, stamps, ground truth and the contents of all paired images."""
        return self._digest

    @cached_property
    def _digest(self) -> str:
        """See `digest`; computed once, as all files are read."""
        truth = self.ground_truth
        poses = None
        if truth is not None:
            poses = [truth.timestamps_ns.tolist(), truth.T_world_cam.tolist()]
        try:
            # text, not paths: joining those takes longer than asking for the files' times.
            files = (*self._colour, *self._depth, *self._people)
            images = contents_digest(f"{self.folder}{os.sep}{file}" for file in files)
        except OSError as error:
            raise SequenceError(
                f"cannot read {error.filename}: {error.strerror}", "fetch the sequence again"
            ) from error
        stamps = self.timestamps_ns.tolist()
        return digest([repr(self.camera), self.fps, stamps, images, poses, self._furthest_m])

    def __len__(self) -> int:
        return len(self._colour)

    def __getitem__(self, index: int) -> Frame:
        index = range(len(self))[index]
        size = (self.camera.width, self.camera.height)
        expected = f"{size[0]}x{size[1]}"
        rgb = read_colour(
            self.folder / self._colour[index],
            size=size,
            mismatch=f"but the camera of {self.id} is {expected}",
        )
        depth = read_depth(
            self.folder / self._depth[index],
            self.camera.depth_factor,
            size=None if self._any_depth_size else size,
            mismatch=f"but its colour image is {expected}",
            furthest_m=self._furthest_m,
        )
        return Frame(index, float(self.timestamps[index]), rgb, depth)

    def _masks_of(self, index: int) -> FrameMasks:
        """The masks of a frame; 0 is the background, every other value is a person who moves."""
        path = self.folder / self._people[index]
        size = (self.camera.width, self.camera.height)
        people = read_image(path, size=size, mismatch="unlike its colour image", kind=SequenceError)
        if people.dtype != np.uint8 or people.ndim != 2:
            raise SequenceError(f"mask {path} has another form than 8 bits in one channel")
        ids = frozenset(np.unique(people[people > 0]).tolist())
        return FrameMasks(people.astype(np.uint8), dict.fromkeys(ids, "person"), ids)

    def __repr__(self) -> str:
        return f"<{type(self).__name__} {self.id}: {len(self)} frames in {self.folder}>"


def likely_factor(raw: float) -> float | None:
    """The first usual depth factor with which a median raw number is 0.4 to 8 m; None where there is none."""
    return next((factor for factor in USUAL_FACTORS if 0.4 < raw / factor < 8), None)


def _check_inside(folder: Path, contents: Contents) -> None:
    """Refuse lists with a file outside of the folder."""
    listed = [*contents.colour.files, *contents.depth.files]
    if contents.people is not None:
        listed += contents.people.files
    for file in listed:
        path_below(folder, file, where=f"a list of images in {folder}", kind=SequenceError)


def _existing_images(
    folder: Path, contents: Contents, camera: Camera, *, paired: bool
) -> tuple[ImageList, ImageList]:
    """The colour and the depth images whose files are there, the depth's stamps as the camera delays them.

    Args:
        folder: The sequence's folder.
        contents: Its lists.
        camera: Tells by how much depth is exposed later than its stamps say.
        paired: Whether the lists are paired entry by entry, so that no file may be missing.
    """
    tolerated = 0.0 if paired else MISSING_TOLERATED
    colour = _existing(folder, contents.colour, "colour", tolerated)
    delayed = contents.depth.stamps_ns + round(1e9 * camera.depth_delay_s)
    depth = replace(contents.depth, stamps_ns=delayed)
    return colour, _existing(folder, depth, "depth", tolerated)


def _associated(
    folder: Path, colour: ImageList, depth: ImageList, max_time_difference_s: float
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Indices of the colour and the depth images that are paired by their stamps, one pair at least."""
    first, second = associate(colour.stamps, depth.stamps, max_time_difference_s)
    if not len(first):
        gap = float(nearest_gap(colour.stamps, depth.stamps).min())
        raise SequenceError(
            f"none of the {len(colour)} colour images of {folder} has a depth image within "
            f"{max_time_difference_s:g} s (closest: {gap:.3f} s)",
            "do both lists use the same clock?",
        )
    return first, second


def _truth_of_camera(truth: Trajectory | None, camera: Camera) -> tuple[Trajectory | None, str]:
    """The truth with orientations in the camera's axes, and a phrase where they were another body's."""
    R_body_cam = camera.R_body_cam
    if truth is None or R_body_cam is None or np.array_equal(R_body_cam, np.eye(3)):
        return truth, ""
    turned = truth.with_poses(in_camera_axes(truth.T_world_cam, R_body_cam))
    return turned, "ground truth: orientations of another body are turned into the camera's axes"


def _frame_rate(stated: float | None, stamps: NDArray[np.float64]) -> tuple[float, str]:
    """The nominal frame rate in Hz, and a phrase where the stamps say another one than is stated."""
    if len(stamps) < 2:
        return stated or 30.0, ""
    # by the stamps; a stated rate counts unless they contradict it
    measured = float(1 / np.median(np.diff(stamps)))
    if stated is None:
        return measured, ""
    factor = max(measured / stated, stated / measured)
    if factor < RATES_AGREE:
        return stated, ""
    note = f"fps = {stated:g} is stated, the stamps say {measured:.4g}"
    if factor < RATES_CONTRADICT:
        return stated, note
    return measured, f"{note}, which is taken"


def _check_readout(folder: Path, camera: Camera, stamps: NDArray[np.float64]) -> None:
    """Refuse a rolling shutter that is read out for longer than the time between two images."""
    if len(stamps) < 2:
        return
    interval = float(np.median(np.diff(stamps)))
    if camera.readout_s > LONGEST_READOUT * interval:
        raise SequenceError(
            f"readout_s = {camera.readout_s:g} of the camera of {folder} is longer than the {interval:.3g} s "
            "between two images",
            "write seconds, or 0 for a global shutter; `sequences calibrate` measures it",
        )


def _check_unit(folder: Path, stamps: NDArray[np.float64]) -> None:
    """Refuse stamps in another unit than they are read in: associations and RPE would be over other spans."""
    if len(stamps) < 2:
        return
    interval = float(np.median(np.diff(stamps)))
    if interval < FASTEST_S:
        raise SequenceError(
            f"the colour images of {folder} are {interval:g} s apart by the median of their stamps "
            f"({1 / interval:.3g} Hz), faster than any camera",
            "stamps of .txt lists are seconds, those of .csv tables nanoseconds",
        )
    if interval <= SLOWEST_S:
        return

    # the units in which the stamps would be those of 1 to 1000 frames a second.
    units = {"milliseconds": 1e3, "microseconds": 1e6, "nanoseconds": 1e9}
    likely = [
        f"{name} ({per_s / interval:.3g} Hz)"
        for name, per_s in units.items()
        if 1 <= per_s / interval <= 1000
    ]
    raise SequenceError(
        f"the colour images of {folder} are {interval:g} s apart by the median of their stamps ({1 / interval:.2g} Hz)",
        f"stamps are in seconds; these look like {likely[0] if likely else 'another unit'}",
    )


def _existing(folder: Path, images: ImageList, kind: str, tolerated: float) -> ImageList:
    """The images whose files are there; a share may be missing, as in some published sequences, and none empty."""
    # bytes of each file, None where it is missing
    sizes = []
    for file in images.files:
        path = folder / file
        sizes.append(path.stat().st_size if path.is_file() else None)

    # some may be missing, none empty
    for state, fault_size, allowed in (("missing", None, tolerated), ("empty (0 bytes)", 0, 0.0)):
        at_fault = [
            file for file, size in zip(images.files, sizes, strict=True) if size == fault_size
        ]
        if len(at_fault) > allowed * len(images):
            raise SequenceError(
                f"{len(at_fault)} of {len(images)} {kind} images of {folder} are {state}, the first is {at_fault[0]}",
                "fetch the sequence again, or remove their lines from the list",
            )

    # the others, in their order
    there = [i for i, size in enumerate(sizes) if size is not None]
    missing = Counter({"listed files that do not exist": len(images) - len(there)})
    return ImageList(
        images.stamps_ns[there], tuple(images.files[i] for i in there), images.irregular + missing
    )


# Decoding of colour and depth images.


def read_colour(
    path: Path, *, size: tuple[int, int] | None = None, mismatch: str = ""
) -> NDArray[np.uint8]:
    """The image as uint8 ``[H, W, 3]``, red first; grey images are repeated over the channels.

    Args:
        path: An image of 8 bits a channel.
        size: Width and height that it has to have; None for any.
        mismatch: Ends the message where it has another one.

    Raises:
        SequenceError: The file is missing, empty, truncated, of another size, no image, or has more
            than 8 bits a channel.
    """
    image = read_image(
        path,
        size=size,
        mismatch=mismatch,
        hint="name the right camera with --camera",
        kind=SequenceError,
    )
    if image.dtype != np.uint8:
        raise SequenceError(
            f"colour image {path} has {image.dtype.itemsize * 8} bits a channel, expected 8",
            "do rgb.txt and depth.txt name the right files?",
        )
    # to red, green, blue, whatever the channels
    if image.ndim == 2:
        return np.asarray(cv2.cvtColor(image, cv2.COLOR_GRAY2RGB), dtype=np.uint8)
    code = cv2.COLOR_BGRA2RGB if image.shape[2] == 4 else cv2.COLOR_BGR2RGB
    return np.asarray(cv2.cvtColor(image, code), dtype=np.uint8)


SATURATED = np.iinfo(np.uint16).max
"""Raw value of a depth beyond the range of 16 bits, or of a missing one."""


def read_depth(
    path: Path,
    depth_factor: float | None,
    *,
    size: tuple[int, int] | None = None,
    mismatch: str = "",
    furthest_m: float | None = None,
) -> NDArray[np.float32]:
    """The image as float32 ``[H, W]`` in metres, 0 where the depth is missing.

    Args:
        path: A 16-bit image of one channel, or an ``.npy`` array of metres.
        depth_factor: Raw units a metre of an image; an array of metres needs none.
        size: Width and height that it has to have; None for any.
        mismatch: Ends the message where it has another one.
        furthest_m: Depth beyond this is missing; None for no limit.

    Raises:
        SequenceError: The file is missing, empty, truncated, of another size, no image, or not of
            16 bits in one channel.
    """
    if path.suffix == ".npy":
        depth = read_metres(path, size=size, mismatch=mismatch)
    else:
        hint = "set the preprocessing's width and height to resize both"
        raw = read_image(path, size=size, mismatch=mismatch, hint=hint, kind=SequenceError)
        if depth_factor is None:
            raise SequenceError(
                f"nothing says how many units of the depth image {path} make a metre: no depth_factor"
            )
        if raw.dtype != np.uint16 or raw.ndim != 2:
            channels = 1 if raw.ndim == 2 else raw.shape[2]
            raise SequenceError(
                f"depth image {path} has {channels} channel(s) of {raw.dtype.itemsize * 8} bits (values {raw.min()} to "
                f"{raw.max()}), expected 1 of 16 bits",
                f"store depth x {depth_factor:g} as 16-bit PNG; an 8-bit image has lost its range",
            )
        # metres; the largest raw number is no measurement
        depth = raw.astype(np.float32) / np.float32(depth_factor)
        depth[raw == SATURATED] = 0
    if furthest_m is not None:
        depth[depth > furthest_m] = 0
    return depth


# Depth as arrays of metres in NumPy's own format; they are mapped, so that one that lies about its
# size costs nothing.


def read_metres(
    path: Path, *, size: tuple[int, int] | None = None, mismatch: str = ""
) -> NDArray[np.float32]:
    """The array as float32 ``[H, W]`` in metres; what is not finite or below 0 is missing, that is 0.

    Args:
        path: An ``.npy`` file of floating-point numbers.
        size: Width and height that it has to have; None for any.
        mismatch: Ends the message where it has another one.

    Raises:
        SequenceError: The file is missing, damaged, of another size, or holds something else.
    """
    # a damaged header makes numpy's reader raise whatever it likes
    with translate_errors(
        SequenceError, f"depth array {path} cannot be read", "is it an .npy file?", of=Exception
    ):
        values = np.load(path, mmap_mode="r", allow_pickle=False)
        shape = values.shape
        kind = values.dtype
    if len(shape) != 2 or kind.kind != "f":
        raise SequenceError(
            f"depth array {path} is {kind} of shape {str(shape)[:60]}, expected rows of metres"
        )
    if size is not None and shape != size[::-1]:
        raise SequenceError(f"depth array {path} is {shape[1]}x{shape[0]}, {mismatch}")
    with np.errstate(invalid="ignore", over="ignore"):
        depth = np.ascontiguousarray(values, dtype=np.float32)
        return np.where(np.isfinite(depth) & (depth > 0), depth, np.float32(0))
