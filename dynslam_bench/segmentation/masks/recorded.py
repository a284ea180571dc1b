"""Masks that somebody else's network wrote to disk: one PNG a frame."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from dynslam_bench.contracts.segmenter import Instances
from dynslam_bench.contracts.sequence import Frame
from dynslam_bench.core.errors import SegmentationError
from dynslam_bench.core.images import read_image
from dynslam_bench.core.reading import read_json

from ..classes import COCO_NAMES
from ..networks.images import boxes_of, check_mask_shape

CLASSES_FILE = "classes.json"
MAX_DIFFERENCE_S = 0.02


class RecordedSegmenter:
    """Reads label images ``DIR/<stamp>.png`` or ``DIR/<index>.png``.

    A label image is 8 or 16 bit, one channel (or several equal ones): 0 is background, every other value one object. A
    file with the values 0 and 255 (or 0 and 1) holds one object. Objects are persons unless ``DIR/classes.json`` maps
    values to COCO names, e.g. ``{"1": "person", "7": "chair"}``.

    File names with a decimal point are stamps in seconds, matched to the nearest within 0.02 s; names without are
    indices into the sequence as it is run (from 0): prefer stamps where only part of a sequence is run.

    Args:
        folder: Where the files are.

    Raises:
        SegmentationError: No such folder, no PNG files in it, names of both kinds or of none, a bad ``classes.json``.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder.expanduser()
        files = sorted(self.folder.glob("*.png")) if self.folder.is_dir() else []
        if not files:
            reason = "holds no PNG files" if self.folder.is_dir() else "does not exist"
            raise SegmentationError(
                f"the folder of recorded masks {self.folder} {reason}",
                "it needs one PNG a frame, named by stamp or index",
            )
        stamped = [file for file in files if "." in file.stem]
        if stamped and len(stamped) != len(files):
            raise SegmentationError(
                f"{self.folder}: {len(stamped)} of {len(files)} mask files are named by stamp, the others are not",
                "name all by stamp or all by index",
            )
        try:
            numbers = [float(file.stem if stamped else int(file.stem)) for file in files]
            if not np.isfinite(numbers).all():
                raise ValueError("a stamp is not finite")
        except (ValueError, OverflowError) as error:
            raise SegmentationError(
                f"{self.folder}: a mask file is named neither by stamp nor by index: {error}",
                "for example 1311868164.363181.png or 000012.png",
            ) from error
        self.by_stamp = bool(stamped)
        order = np.argsort(numbers, kind="stable")
        self._keys: NDArray[np.float64] = np.asarray(numbers, np.float64)[order]
        self._files = [files[i] for i in order]
        self._names = read_classes(self.folder / CLASSES_FILE)

    def segment(self, frame: Frame) -> Instances:
        """The recorded objects of a frame.

        Raises:
            SegmentationError: No file for the frame, an unreadable file, a wrong size, an object without a class.
        """
        path = self._find(frame)
        height, width = frame.rgb.shape[:2]
        image = read_image(
            path,
            size=(width, height),
            mismatch=f"but the frame is {width}x{height}",
            hint="record the masks at the size of the frames",
            flags=cv2.IMREAD_UNCHANGED,
            kind=SegmentationError,
        )
        labels = _one_channel(image, path)
        check_mask_shape(labels, frame.rgb.shape, str(path))
        values = [int(value) for value in np.unique(labels) if value != 0]
        if not values:
            return Instances.empty(*labels.shape)
        masks = labels[None] == np.array(values, labels.dtype)[:, None, None]
        names = tuple(self._name(value, path) for value in values)
        return Instances(masks, boxes_of(masks), names, np.ones(len(values), np.float32))

    def missing(self, timestamps: NDArray[np.float64]) -> list[int]:
        """Indices of the frames that have no file.

        Args:
            timestamps: Stamps in seconds of all frames, in their order.
        """
        wanted = timestamps if self.by_stamp else np.arange(len(timestamps), dtype=np.float64)
        after = np.searchsorted(self._keys, wanted).clip(1, max(len(self._keys) - 1, 1))
        near = np.stack([self._keys[after - 1], self._keys[np.minimum(after, len(self._keys) - 1)]])
        distance = np.abs(near - wanted).min(axis=0)
        found = distance < MAX_DIFFERENCE_S if self.by_stamp else distance == 0
        return [int(index) for index in np.flatnonzero(~found)]

    def _find(self, frame: Frame) -> Path:
        wanted = frame.timestamp if self.by_stamp else float(frame.index)
        nearest = int(np.argmin(np.abs(self._keys - wanted)))
        difference = abs(float(self._keys[nearest]) - wanted)
        if self.by_stamp and difference >= MAX_DIFFERENCE_S:
            raise SegmentationError(
                f"no recorded mask within {MAX_DIFFERENCE_S} s of frame {frame.index} ({frame.timestamp:.6f} s) "
                f"in {self.folder}",
                f"the nearest is {self._files[nearest].name}, {difference:.3f} s away",
            )
        if not self.by_stamp and difference > 0:
            raise SegmentationError(
                f"no recorded mask of frame {frame.index} in {self.folder}",
                f"there are {len(self._files)}, indices {self._keys[0]:.0f} to {self._keys[-1]:.0f}",
            )
        path: Path = self._files[nearest]
        return path

    def _name(self, value: int, path: Path) -> str:
        if self._names is None:
            return "person"
        if value not in self._names:
            raise SegmentationError(
                f"{path}: object {value} has no class in {CLASSES_FILE}",
                "known: " + ", ".join(map(str, sorted(self._names))),
            )
        return self._names[value]


def _one_channel(image: NDArray[Any], path: Path) -> NDArray[Any]:
    if image.ndim == 2:
        return image
    colour = image[:, :, :3]
    if (colour == colour[:, :, :1]).all():
        return np.asarray(colour[:, :, 0])
    raise SegmentationError(
        f"{path} is a colour image", "a mask has one channel: 0 background, else the object's number"
    )


def read_classes(path: Path) -> dict[int, str] | None:
    """The COCO name of each number in the label images; None where no file says it.

    Raises:
        SegmentationError: The file cannot be read, or names something else.
    """
    if not path.is_file():
        return None
    try:
        names = {int(key): str(name) for key, name in read_json(path, kind=SegmentationError).items()}
    except (ValueError, AttributeError) as error:
        raise SegmentationError(f"cannot read {path}: {error}", 'expected {"1": "person", ...}') from error
    unknown = sorted({name for name in names.values() if name not in COCO_NAMES})
    if unknown:
        raise SegmentationError(f"{path}: '{unknown[0]}' is no COCO class")
    return names
