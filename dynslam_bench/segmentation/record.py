"""Write a segmenter's masks of a sequence as label images, which `recorded` reads."""

import json
import warnings
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from dynslam_bench.contracts import Instances, Sequence
from dynslam_bench.core import SegmentationError, read_json, write_atomic
from dynslam_bench.segmentation.build_segmenter import build_segmenter, weights_digest
from dynslam_bench.segmentation.recorded import CLASSES_FILE, read_classes
from dynslam_bench.segmentation.settings import SegmentationSettings

ORIGIN_FILE = "recorded.json"
"""Lies beside the masks, and holds the sequence and the settings that they were made of."""


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
    # the segmenter of the settings
    segmenter = build_segmenter(
        settings, sequence_id=sequence.id, masks=sequence.masks, device=device, threads=threads
    )
    if segmenter is None:
        raise SegmentationError("segmentation.source=none has no masks to record")
    # masks of another sequence or other settings are not mixed with these
    origin = {
        "sequence": sequence.id,
        "source": segmenter.source,
        "weights": weights_digest(settings, sequence.id, sequence.masks),
        "classes": settings.classes,
        "confidence": settings.confidence,
    }
    _prepare_folder(folder, origin)

    # an interrupted recording goes on where it ended
    classes = read_classes(folder / CLASSES_FILE)
    segmented = 0
    for index in range(len(sequence)):
        path = folder / f"{sequence.timestamps[index]:.6f}.png"
        if not path.exists():
            before = len(classes)
            labels = label_image(segmenter.segment(sequence[index]), classes)
            # the classes first: a label image needs the names of its numbers
            if len(classes) > before:
                write_atomic(folder / CLASSES_FILE, json.dumps(classes, indent=1))
            write_atomic(path, cv2.imencode(".png", labels)[1].tobytes())
            segmented += 1
        progress(index + 1, len(sequence))
    if not classes:
        objects = f"no object of the classes {settings.classes} in any of {len(sequence)} frames of {sequence.id}"
        warnings.warn(f"{segmenter.source} found {objects}", stacklevel=2)
    return segmented


def _prepare_folder(folder: Path, origin: dict[str, object]) -> None:
    """Make the folder, or make sure that it holds the same masks."""
    # a folder that was made by this: with equal origin it goes on
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
    # numbers of the classes so far
    labels = np.zeros(instances.masks.shape[1:], np.uint16)
    free = sorted(classes)
    # in order of rising score, so that higher ones are written over lower ones
    for index in np.argsort(instances.scores, kind="stable"):
        # the lowest number of the class that no object of the frame has, or a new one
        name = instances.class_names[index]
        of_class = [number for number in free if classes[number] == name]
        number = of_class[0] if of_class else max(classes, default=0) + 1
        classes[number] = name
        free = [other for other in free if other != number]
        labels[instances.masks[index]] = number
    return labels
