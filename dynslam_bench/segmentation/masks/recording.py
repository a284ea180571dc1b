"""Write a segmenter's masks to disk, in the form that `recorded` reads."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from dynslam_bench.contracts.segmenter import Instances
from dynslam_bench.contracts.sequence import Sequence
from dynslam_bench.core.errors import SegmentationError
from dynslam_bench.core.files import write_atomic
from dynslam_bench.core.reading import read_json

from ..build_segmenter import build_segmenter, weights_digest
from ..settings import SegmentationSettings
from .recorded import CLASSES_FILE, read_classes

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
