"""Masks that no network computes here: read from PNG files, written to them, or exact masks of the sequence."""

import json
import warnings
from collections.abc import Callable
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
    Sequence,
)
from dynslam_bench.core import SegmentationError, read_json, translate_errors, write_atomic
from dynslam_bench.core.images import read_image
from dynslam_bench.segmentation.build_segmenter import build_segmenter, weights_digest
from dynslam_bench.segmentation.postprocess import boxes_of
from dynslam_bench.segmentation.settings import COCO_NAMES, SegmentationSettings, canonical_name

CLASSES_FILE = "classes.json"
MAX_DIFFERENCE_S = 0.02
"""Largest difference of a frame's stamp and a mask's, as in TUM's association of images."""
ORIGIN_FILE = "recorded.json"
"""Beside the masks: the sequence and the settings that they were made of."""
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
        self.folder = folder.expanduser()
        files = sorted(self.folder.glob("*.png"))
        if not files:
            reason = "holds no PNG files" if self.folder.is_dir() else "does not exist"
            raise SegmentationError(
                f"the folder of recorded masks {self.folder} {reason}",
                "it needs one PNG a frame, named by stamp or index",
            )
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
            numbers = np.array(
                [float(file.stem if self.by_stamp else int(file.stem)) for file in files]
            )
            if not np.isfinite(numbers).all():
                raise ValueError("a stamp is not finite")
        order = np.argsort(numbers, kind="stable")
        self._keys: NDArray[np.float64] = numbers[order]
        self._files = [files[i] for i in order]
        self._names = read_classes(self.folder / CLASSES_FILE) or dict.fromkeys(
            range(1 << 16), "person"
        )
        self.class_names = tuple(dict.fromkeys(self._names.values()))

    def segment(self, frame: Frame) -> Instances:
        """The recorded objects of a frame.

        Raises:
            SegmentationError: No file for the frame, an unreadable file, a wrong size, an object
                without a class.
        """
        nearest, distance = self._nearest(frame.timestamp if self.by_stamp else frame.index)
        path = self._files[nearest]
        if distance >= self._tolerance:
            within = f" within {MAX_DIFFERENCE_S} s" if self.by_stamp else ""
            raise SegmentationError(
                f"no recorded mask{within} of frame {frame.index} ({frame.timestamp:.6f} s) in {self.folder}",
                f"the nearest is {path.name}"
                + (f", {distance:.3f} s away" if self.by_stamp else ""),
            )
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
        numbers = [
            number for number, name in self._names.items() if canonical_name(name) in classes
        ]
        for index, key in enumerate(
            timestamps.tolist() if self.by_stamp else range(len(timestamps))
        ):
            nearest, distance = self._nearest(key)
            if (
                distance < self._tolerance
                and np.isin(_read_labels(self._files[nearest]), numbers).any()
            ):
                return index
        return None

    def missing(self, timestamps: NDArray[np.float64]) -> list[int]:
        """Indices of the frames that have no file.

        Args:
            timestamps: Stamps in seconds of all frames, in their order.
        """
        keys = timestamps.tolist() if self.by_stamp else range(len(timestamps))
        return [index for index, key in enumerate(keys) if self._nearest(key)[1] >= self._tolerance]

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
        names = {
            int(key): str(name) for key, name in read_json(path, kind=SegmentationError).items()
        }
    for name in names.values():
        meant = get_close_matches(canonical_name(name), COCO_NAMES, n=1, cutoff=MISSPELLED)
        if meant and meant[0] != canonical_name(name):
            warnings.warn(
                f"{path}: '{name}' is no COCO class; did you mean '{meant[0]}'?", stacklevel=2
            )
    return names


def record_masks(
    sequence: Sequence,
    folder: Path,
    settings: SegmentationSettings,
    *,
    device: str = "cpu",
    threads: int = 1,
    progress: Callable[[int, int], object] = lambda *_: None,
) -> int:
    """Segment every frame of a sequence, one PNG a frame, named by stamp; existing files are kept.

    The files hold the objects of the settings' classes and confidence, before repair and dilation,
    which are done when the masks are used. Where two objects overlap, the one with the higher score
    has the pixel. Scores are not stored. It warns where no frame has an object.

    Args:
        sequence: The frames.
        folder: Made if it does not exist.
        settings: Source, classes, confidence.
        device: ``cpu`` or ``cuda:N``.
        threads: Threads a network may use.
        progress: Called with (frames done, frames in all).

    Returns:
        How many frames were segmented now.

    Raises:
        SegmentationError: The source is ``none`` or not available, or the folder holds other masks.
    """
    segmenter = build_segmenter(
        settings, sequence_id=sequence.id, masks=sequence.masks, device=device, threads=threads
    )
    if segmenter is None:
        raise SegmentationError("segmentation.source=none has no masks to record")
    origin = {
        "sequence": sequence.id,
        "source": segmenter.source,
        "weights": weights_digest(settings, sequence.id, sequence.masks),
        "classes": settings.classes,
        "confidence": settings.confidence,
    }
    _begin(folder, origin)
    classes = read_classes(folder / CLASSES_FILE)
    segmented = 0
    for index in range(len(sequence)):
        path = folder / f"{sequence.timestamps[index]:.6f}.png"
        if not path.exists():
            before = len(classes)
            labels = label_image(segmenter.segment(sequence[index]), classes)
            if len(classes) > before:
                write_atomic(folder / CLASSES_FILE, json.dumps(classes, indent=1))
            write_atomic(path, cv2.imencode(".png", labels)[1].tobytes())
            segmented += 1
        progress(index + 1, len(sequence))
    if not classes:
        objects = f"no object of the classes {settings.classes} in any of {len(sequence)} frames of {sequence.id}"
        warnings.warn(f"{segmenter.source} found {objects}", stacklevel=2)
    return segmented


def _begin(folder: Path, origin: dict[str, object]) -> None:
    """Make the folder, or make sure that it holds the same masks."""
    path = folder / ORIGIN_FILE
    if path.is_file():
        stored = read_json(path, kind=SegmentationError)
        before = stored if isinstance(stored, dict) else {}
        for name, value in origin.items():
            if before.get(name) != value:
                raise SegmentationError(
                    f"{folder} holds other masks: {name} is '{before.get(name)}' there and '{value}' now",
                    "record into a folder of their own",
                )
    elif folder.exists() and any(folder.iterdir()):
        raise SegmentationError(f"{folder} holds something else", "record into an empty folder")
    folder.mkdir(parents=True, exist_ok=True)
    write_atomic(path, json.dumps(origin, indent=1))


def label_image(instances: Instances, classes: dict[int, str]) -> NDArray[np.uint16]:
    """Objects as a label image uint16 ``[H, W]``: 0 background, else the object's number; the highest score on top.

    Args:
        instances: The objects.
        classes: The class of each number; a number is added where a frame has more objects of a
            class than before.
    """
    labels = np.zeros(instances.masks.shape[1:], np.uint16)
    free = sorted(classes)
    for index in np.argsort(instances.scores, kind="stable"):
        name = instances.class_names[index]
        number = next(
            (number for number in free if classes[number] == name), max(classes, default=0) + 1
        )
        classes[number] = name
        free = [other for other in free if other != number]
        labels[instances.masks[index]] = number
    return labels


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
    labels = np.asarray(masks.instances)
    names = masks.class_names
    numbers = [int(number) for number in np.unique(labels) if number != 0]
    if nameless := [number for number in numbers if number not in names]:
        named = ", ".join(map(str, sorted(names))) or "none"
        raise SegmentationError(
            f"{where}: object {nameless[0]} has no class name", f"known numbers: {named}"
        )
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
    except Exception as error:  # the masks of a plug-in's data set may raise anything
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
