"""Masks that no network computes here: read from PNG files (`record` writes them), or exact masks of the sequence."""

import warnings
from dataclasses import replace
from difflib import get_close_matches
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from dynslam_bench.contracts import (
    Frame,
    FrameMasks,
    Instances,
    MaskSource,
    SegmenterContext,
)
from dynslam_bench.core import SegmentationError, read_json, translate_errors
from dynslam_bench.core.images import read_image
from dynslam_bench.segmentation.postprocess import boxes_of
from dynslam_bench.segmentation.settings import COCO_NAMES, SegmentationSettings, canonical_name

CLASSES_FILE = "classes.json"
"""Lies beside the masks, and holds the class name of each number."""
MAX_DIFFERENCE_S = 0.02
"""Largest difference of a frame's stamp and a mask's, as in TUM's association of images."""
MISSPELLED = 0.8
"""Ratio (`difflib`) of a class name to a COCO name above which it is probably misspelled."""


class RecordedSegmenter:
    """Reads label images ``DIR/<stamp>.png`` or ``DIR/<index>.png``.

    A label image is 8 or 16 bit, one channel (or several equal ones): 0 is background, every other
    value one object. A file with the values 0 and 255 (or 0 and 1) holds one object. Objects are
    persons unless ``DIR/classes.json`` maps values to class names, e.g.
    ``{"1": "person", "7": "chair"}``.

    File names with a decimal point are stamps in seconds, matched to the nearest within 0.02 s;
    names without are indices into the sequence as it is run (from 0): prefer stamps where only part
    of a sequence is run.

    Args:
        folder: Where the files are.

    Attributes:
        class_names: The names that objects may have.

    Raises:
        SegmentationError: No such folder, no PNG files in it, names of both kinds or of none, a bad
            ``classes.json``.
    """

    def __init__(self, folder: Path) -> None:
        # files named all by stamp or all by index
        self.folder = folder.expanduser()
        files = sorted(self.folder.glob("*.png"))
        if not files:
            reason = "holds no PNG files" if self.folder.is_dir() else "does not exist"
            raise SegmentationError(
                f"the folder of recorded masks {self.folder} {reason}",
                "it needs one PNG a frame, named by stamp or index",
            )

        # named by stamp or by index, all alike
        stamped = sum("." in file.stem for file in files)
        if stamped not in (0, len(files)):
            raise SegmentationError(
                f"{self.folder}: {stamped} of {len(files)} mask files are named by stamp, the others are not",
                "name all by stamp or all by index",
            )
        self.by_stamp = stamped > 0
        self._tolerance = MAX_DIFFERENCE_S if self.by_stamp else 0.5
        with translate_errors(
            SegmentationError,
            f"{self.folder}: a mask file is named neither by stamp nor by index",
            "for example 1311868164.363181.png or 000012.png",
            of=(ValueError, OverflowError),
        ):
            keys = [float(file.stem) if self.by_stamp else float(int(file.stem)) for file in files]
            numbers = np.array(keys)
            if not np.isfinite(numbers).all():
                raise ValueError("a stamp is not finite")

        # in order of time
        order = np.argsort(numbers, kind="stable")
        self._keys: NDArray[np.float64] = numbers[order]
        self._files = [files[i] for i in order]

        # without a table every number of a 16-bit image is a person
        self._names = read_classes(self.folder / CLASSES_FILE)
        if not self._names:
            self._names = dict.fromkeys(range(1 << 16), "person")
        self.class_names = tuple(dict.fromkeys(self._names.values()))

    def segment(self, frame: Frame) -> Instances:
        """The recorded objects of a frame.

        Raises:
            SegmentationError: No file for the frame, an unreadable file, a wrong size, an object
                without a class.
        """
        # the file of the frame's stamp or index
        nearest, distance = self._nearest(frame.timestamp if self.by_stamp else frame.index)
        path = self._files[nearest]
        if distance >= self._tolerance:
            within = f" within {MAX_DIFFERENCE_S} s" if self.by_stamp else ""
            away = f", {distance:.3f} s away" if self.by_stamp else ""
            raise SegmentationError(
                f"no recorded mask{within} of frame {frame.index} ({frame.timestamp:.6f} s) in {self.folder}",
                f"the nearest is {path.name}{away}",
            )

        # its objects; what moves is not recorded
        height, width = frame.rgb.shape[:2]
        labels = _read_labels(path, (width, height))
        instances = instances_of(FrameMasks(labels, self._names, frozenset()), where=str(path))
        return replace(instances, moving=None)

    def first_object(self, timestamps: NDArray[np.float64], classes: frozenset[str]) -> int | None:
        """Index of the first frame with an object of these classes; None if no frame has one.

        Args:
            timestamps: Stamps in seconds of all frames, in their order.
            classes: Names as `canonical_name` writes them.

        Raises:
            SegmentationError: A file cannot be read, or is a colour image.
        """
        # their numbers in the label images, frame by frame
        numbers = [
            number for number, name in self._names.items() if canonical_name(name) in classes
        ]
        for index, key in enumerate(self._keys_of(timestamps)):
            nearest, distance = self._nearest(key)
            if distance >= self._tolerance:
                continue
            labels = _read_labels(self._files[nearest])
            if np.isin(labels, numbers).any():
                return index
        return None

    def missing(self, timestamps: NDArray[np.float64]) -> list[int]:
        """Indices of the frames that have no file.

        Args:
            timestamps: Stamps in seconds of all frames, in their order.
        """
        missing = []
        for index, key in enumerate(self._keys_of(timestamps)):
            _, distance = self._nearest(key)
            if distance >= self._tolerance:
                missing.append(index)
        return missing

    def _keys_of(self, timestamps: NDArray[np.float64]) -> list[float]:
        """Keys by which frames are looked up: their stamps in seconds, or their indices."""
        return timestamps.tolist() if self.by_stamp else list(range(len(timestamps)))

    def _nearest(self, key: float) -> tuple[int, float]:
        """The file nearest to a stamp or index, and its distance."""
        distance = np.abs(self._keys - key)
        nearest = int(np.argmin(distance))
        return nearest, float(distance[nearest])


def _read_labels(path: Path, size: tuple[int, int] | None = None) -> NDArray[Any]:
    """A label image ``[H, W]``; of this width and height, if they are given."""
    image = read_image(
        path,
        size=size,
        mismatch="" if size is None else f"but the frame is {size[0]}x{size[1]}",
        hint="record the masks at the size of the frames",
        flags=cv2.IMREAD_UNCHANGED,
        kind=SegmentationError,
    )
    # three equal channels count as one
    labels: NDArray[Any] = np.atleast_3d(image)
    if (labels[:, :, :3] != labels[:, :, :1]).any():
        raise SegmentationError(
            f"{path} is a colour image",
            "a mask has one channel: 0 background, else the object's number",
        )
    return labels[:, :, 0]


def read_classes(path: Path) -> dict[int, str]:
    """The class name of each number in the label images; empty without that file.

    Raises:
        SegmentationError: The file cannot be read, or is no such table.
    """
    if not path.is_file():
        return {}
    with translate_errors(
        SegmentationError,
        f"cannot read {path}",
        'expected {"1": "person", ...}',
        of=(ValueError, AttributeError),
    ):
        table = read_json(path, kind=SegmentationError)
        names = {int(key): str(name) for key, name in table.items()}
    # a name that is nearly COCO's is probably misspelled
    for name in names.values():
        meant = get_close_matches(canonical_name(name), COCO_NAMES, n=1, cutoff=MISSPELLED)
        if meant and meant[0] != canonical_name(name):
            warnings.warn(
                f"{path}: '{name}' is no COCO class; did you mean '{meant[0]}'?", stacklevel=2
            )
    return names


def instances_of(masks: FrameMasks, *, where: str = "masks") -> Instances:
    """The objects of a label image, with exact boxes and score 1.

    Args:
        masks: Label image with class names and the set of moving ids.
        where: Named in the error.

    Returns:
        One row an id that is visible and has a class name, in order of id. `Instances.moving` is
        filled.

    Raises:
        SegmentationError: An id in the image has no class name.
    """
    # the objects that are visible; each needs a class
    labels = np.asarray(masks.instances)
    names = masks.class_names
    numbers = [int(number) for number in np.unique(labels) if number != 0]
    nameless = [number for number in numbers if number not in names]
    if nameless:
        named = ", ".join(map(str, sorted(names))) or "none"
        raise SegmentationError(
            f"{where}: object {nameless[0]} has no class name", f"known numbers: {named}"
        )
    # a mask each, [K, H, W]
    stack = np.asarray(labels[None] == np.array(numbers, labels.dtype)[:, None, None])
    classes = tuple(names[number] for number in numbers)
    moving = np.array([number in masks.moving for number in numbers], dtype=bool)
    return Instances(stack, boxes_of(stack), classes, np.ones(len(numbers), np.float32), moving)


def exact_masks(source: MaskSource, index: int) -> FrameMasks:
    """A frame's exact masks.

    Raises:
        SegmentationError: The sequence has no masks for this frame, or they cannot be read.
    """
    try:
        return source[index]
    except (IndexError, KeyError) as error:
        raise SegmentationError(f"there are no exact masks for frame {index}") from error
    except MemoryError:
        raise
    # the masks of a plug-in's data set may raise anything
    except Exception as error:
        raise SegmentationError(
            f"the exact masks of frame {index} cannot be read: {error}"
        ) from error


class OracleSegmenter:
    """A sequence's exact masks: every object, with the flag whether it moves.

    Args:
        source: The sequence's masks.
        motion: Whether `Instances.moving` is filled; without, objects count by class, as those of a
            perfect network.
    """

    def __init__(self, source: MaskSource, *, motion: bool = True) -> None:
        self.source = source
        self.motion = motion

    def segment(self, frame: Frame) -> Instances:
        """The objects of frame `frame.index`.

        Raises:
            SegmentationError: The sequence has no masks for this frame, or they cannot be read.
        """
        masks = exact_masks(self.source, frame.index)
        instances = instances_of(masks, where=f"exact masks of frame {frame.index}")
        return instances if self.motion else replace(instances, moving=None)


def build_oracle(settings: SegmentationSettings, context: SegmenterContext) -> OracleSegmenter:
    """Exact masks of the sequence; ``oracle`` also returns what moves, whatever its class.

    Raises:
        SegmentationError: The sequence has no exact masks.
    """
    if context.masks is None:
        raise SegmentationError(
            f"segmentation.source={settings.source}: sequence '{context.sequence_id}' has no exact masks",
            "only synthetic/* has them; use coco, onnx:PATH or recorded:DIR",
        )
    return OracleSegmenter(context.masks, motion=settings.source != "oracle-classes")


def build_recorded(settings: SegmentationSettings, context: SegmenterContext) -> RecordedSegmenter:
    """Masks from a folder."""
    return RecordedSegmenter(Path(context.argument))
