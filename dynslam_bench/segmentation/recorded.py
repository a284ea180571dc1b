"""Masks that somebody else's network wrote to disk: one PNG a frame."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from dynslam_bench.contracts.segmenter import Instances
from dynslam_bench.contracts.sequence import Frame, FrameMasks, MaskSource, Sequence
from dynslam_bench.core.errors import SegmentationError
from dynslam_bench.core.files import write_atomic
from dynslam_bench.core.images import read_image
from dynslam_bench.core.reading import read_json
from dynslam_bench.segmentation.build_segmenter import build_segmenter, weights_digest
from dynslam_bench.segmentation.postprocess import boxes_of, check_mask_shape
from dynslam_bench.segmentation.settings import COCO_NAMES, SegmentationSettings

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


# Write a segmenter's masks to disk, in the form that `recorded` reads.

Progress = Callable[[int, int], None]
ORIGIN_FILE = "recorded.json"
"""Beside the masks: what they were made of and with."""


def record_masks(
    sequence: Sequence,
    folder: Path,
    settings: SegmentationSettings,
    *,
    device: str = "cpu",
    threads: int = 1,
    progress: Progress | None = None,
) -> int:
    """Segment every frame of a sequence, one PNG a frame, named by stamp; frames that are there already are kept.

    What is written are the objects of the settings' classes and confidence, before repair and dilation: those are done
    when the masks are used. Where two objects overlap, the surer one has the pixel. Scores are not kept.

    Args:
        sequence: Whose frames are segmented.
        folder: Made if it is not there.
        settings: Source, classes, confidence.
        device: ``cpu`` or ``cuda:N``.
        threads: Threads a network may use.
        progress: Called with (frames done, frames in all).

    Returns:
        How many frames were segmented now.

    Raises:
        SegmentationError: The source is ``none`` or not available, or the folder holds other masks.
    """
    segmenter = build_segmenter(settings, sequence_id=sequence.id, masks=sequence.masks, device=device, threads=threads)
    if segmenter is None:
        raise SegmentationError("segmentation.source=none has no masks to record")
    _begin(folder, _origin(sequence, settings, segmenter.source))
    numbers = LabelNumbers(folder / CLASSES_FILE)
    segmented = 0
    for index in range(len(sequence)):
        path = folder / f"{sequence.timestamps[index]:.6f}.png"
        if not path.exists():
            frame = sequence[index]
            labels = numbers.label_image(segmenter.segment(frame))
            encoded = cv2.imencode(".png", labels)[1]
            write_atomic(path, encoded.tobytes())
            segmented += 1
        if progress is not None:
            progress(index + 1, len(sequence))
    return segmented


def _origin(sequence: Sequence, settings: SegmentationSettings, source: str) -> dict[str, object]:
    return {
        "sequence": sequence.id,
        "source": source,
        "weights": weights_digest(settings, sequence.id, sequence.masks),
        "classes": settings.classes,
        "confidence": settings.confidence,
    }


def _begin(folder: Path, origin: dict[str, object]) -> None:
    """Make the folder, or make sure that it holds the same masks."""
    path = folder / ORIGIN_FILE
    if path.is_file():
        known = read_json(path, kind=SegmentationError)
        different = [name for name, value in origin.items() if not isinstance(known, dict) or known.get(name) != value]
        if different:
            name = different[0]
            known_value = known.get(name) if isinstance(known, dict) else known
            raise SegmentationError(
                f"{folder} holds other masks: {name} is '{known_value}' there and '{origin[name]}' now",
                "record into a folder of their own",
            )
        return
    if folder.exists() and any(folder.iterdir()):
        raise SegmentationError(f"{folder} holds something else", "record into an empty folder")
    folder.mkdir(parents=True, exist_ok=True)
    write_atomic(path, json.dumps(origin, indent=1))


class LabelNumbers:
    """The number of each object in the label images: one for the first person of a frame, one for the second, ...

    Args:
        path: The file that says which class each number is; written whenever a number is added.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._classes = read_classes(path) or {}

    def label_image(self, found: Instances) -> NDArray[np.uint16]:
        """uint16 ``[H, W]``: 0 background, else the object's number; the surest object on top."""
        labels = np.zeros(found.masks.shape[1:], np.uint16)
        free = dict(sorted(self._classes.items()))
        for place in np.argsort(found.scores, kind="stable"):
            name = found.class_names[place]
            number = next((each for each, known in free.items() if known == name), None)
            if number is None:
                number = self._add(name)
            free.pop(number, None)
            labels[found.masks[place]] = number
        return labels

    def _add(self, name: str) -> int:
        number = max(self._classes, default=0) + 1
        self._classes[number] = name
        write_atomic(self._path, json.dumps({str(each): known for each, known in self._classes.items()}, indent=1))
        return number


# Exact masks of rendered (or annotated) sequences, as if a perfect network had found them.


def instances_of(masks: FrameMasks, *, where: str = "masks") -> Instances:
    """The objects of a label image, with exact boxes and score 1.

    Args:
        masks: Label image with class names and the set of moving ids.
        where: Named in the error.

    Returns:
        One row an id that is visible and has a class name, in order of id. `Instances.moving` is filled.

    Raises:
        SegmentationError: An id in the image has no class name.
    """
    labels = np.asarray(masks.instances)
    ids = [int(number) for number in np.unique(labels) if number != 0]
    nameless = [number for number in ids if number not in masks.class_names]
    if nameless:
        raise SegmentationError(
            f"{where}: instance {nameless[0]} has no class name",
            "known ids: " + (", ".join(map(str, sorted(masks.class_names))) or "none"),
        )
    if not ids:
        empty = Instances.empty(labels.shape[0], labels.shape[1])
        return Instances(empty.masks, empty.boxes, (), empty.scores, np.zeros(0, bool))
    planes = labels[None] == np.array(ids, dtype=labels.dtype)[:, None, None]
    return Instances(
        planes,
        boxes_of(planes),
        tuple(masks.class_names[number] for number in ids),
        np.ones(len(ids), np.float32),
        np.array([number in masks.moving for number in ids], dtype=bool),
    )


class OracleSegmenter:
    """Hands out a sequence's exact masks: every object, with the flag whether it moves.

    Args:
        source: The sequence's masks.
        motion: Whether to say what moves; without, objects count by their class alone, as a perfect network has them.
    """

    def __init__(self, source: MaskSource, *, motion: bool = True) -> None:
        self.source = source
        self.motion = motion

    def segment(self, frame: Frame) -> Instances:
        """The objects of frame `frame.index`.

        Raises:
            SegmentationError: The masks do not have the frame's size, or the sequence has none for this frame, or they
                cannot be read.
        """
        try:
            masks = self.source[frame.index]
        except (IndexError, KeyError) as error:
            raise SegmentationError(f"there are no exact masks for frame {frame.index}") from error
        except MemoryError:
            raise
        except Exception as error:  # the masks of a data set of the user's may raise anything
            raise SegmentationError(f"the exact masks of frame {frame.index} cannot be read: {error}") from error
        check_mask_shape(np.asarray(masks.instances), frame.rgb.shape, f"exact masks of frame {frame.index}")
        found = instances_of(masks, where=f"exact masks of frame {frame.index}")
        return found if self.motion else replace(found, moving=None)
