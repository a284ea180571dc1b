"""Labelled images at the network's input size, kept in one file on disk, and their random variation for training."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from dynslam_bench.core.errors import SegmentationError
from dynslam_bench.core.files import atomic_folder
from dynslam_bench.core.reading import TABLE_BYTES, read_json
from dynslam_bench.core.records import digest
from dynslam_bench.core.seeding import stream
from dynslam_bench.segmentation.postprocess import boxes_of
from dynslam_bench.segmentation.training.labelled_images import LabelledImage, LabelledImages
from dynslam_bench.segmentation.training.settings import TrainSettings

MIN_VISIBLE_PX = 16
"""Objects with fewer pixels at the network's input size are not learned."""

_AGAIN = "delete the folder, they are prepared again"


@dataclass(frozen=True, eq=False)
class Example:
    """One training image.

    Attributes:
        rgb: uint8 ``[H, W, 3]``.
        masks: bool ``[G, H, W]``.
        boxes: float32 ``[G, 4]``.
        labels: int64 ``[G]``, class numbers from 1.
    """

    rgb: NDArray[np.uint8]
    masks: NDArray[np.bool_]
    boxes: NDArray[np.float32]
    labels: NDArray[np.int64]


class PreparedImages:
    """Images of one size with label images, memory-mapped from a folder.

    Where objects overlap, the smaller one is in front.

    Args:
        folder: Written by `prepare`.
        classes: The names to learn, in order; other objects become background.

    Raises:
        SegmentationError: The folder is damaged.
    """

    def __init__(self, folder: Path, classes: Sequence[str]) -> None:
        try:
            self.images, self.labels = (
                np.load(folder / f"{name}.npy", mmap_mode="r", allow_pickle=False) for name in ("images", "labels")
            )
        except Exception as error:  # numpy raises many types for a damaged header
            raise SegmentationError(f"the prepared images in {folder} are damaged: {error}", _AGAIN) from error
        self.names: list[list[str]] = read_json(folder / "names.json", limit=TABLE_BYTES, kind=SegmentationError)
        if not len(self.images) == len(self.labels) == len(self.names):
            raise SegmentationError(f"the prepared images in {folder} are damaged: their numbers differ", _AGAIN)
        self.classes = tuple(classes)

    def __len__(self) -> int:
        return len(self.images)

    def example(self, index: int, rng: np.random.Generator | None = None) -> Example:
        """An image; with a generator at random scale, place, mirror image, colour, noise and blur."""
        rgb, labels, names = np.array(self.images[index]), np.array(self.labels[index]), self.names[index]
        if rng is not None:
            rgb, labels = vary(rgb, labels, rng)
        numbers = [k + 1 for k, name in enumerate(names) if name in self.classes]
        masks = labels[None] == np.array(numbers, np.uint8).reshape(-1, 1, 1)
        visible = np.count_nonzero(masks, axis=(1, 2)) >= MIN_VISIBLE_PX
        classes = np.array([self.classes.index(names[number - 1]) + 1 for number in numbers], np.int64)
        return Example(rgb, masks[visible], boxes_of(masks[visible]), classes[visible])


def prepare(
    source: LabelledImages[Any],
    folder: Path,
    height: int,
    width: int,
    progress: Callable[[int, int], object] = lambda *_: None,
) -> Path:
    """Write a set at one size; an existing set is not written again.

    Args:
        source: The images.
        folder: Under which a folder is made, named by the digest of the set's name, content and size.
        height: Rows of the network's input.
        width: Columns.
        progress: Called with (images done, images in all).

    Returns:
        The folder for `PreparedImages`.
    """
    key = digest({"name": source.name, "version": source.version, "count": len(source), "size": [height, width]})
    target = folder / f"prepared-{key}"
    if (target / "names.json").is_file():
        return target
    with atomic_folder(target) as work:
        images = np.lib.format.open_memmap(work / "images.npy", "w+", np.uint8, (len(source), height, width, 3))
        labels = np.lib.format.open_memmap(work / "labels.npy", "w+", np.uint8, (len(source), height, width))
        names: list[list[str]] = []
        for index in range(len(source)):
            images[index], labels[index], present = shrink(source[index], height, width)
            names.append(present)
            progress(index + 1, len(source))
        (work / "names.json").write_text(json.dumps(names))
    return target


def shrink(image: LabelledImage, height: int, width: int) -> tuple[NDArray[np.uint8], NDArray[np.uint8], list[str]]:
    """An image at another size with grey borders where the aspect ratio differs; objects as a label image.

    Returns:
        uint8 ``[height, width, 3]``, label image uint8 ``[height, width]`` (0 = background) and the objects' names.
    """
    rows, columns = image.rgb.shape[:2]
    ratio = min(height / rows, width / columns)
    size = (max(1, round(columns * ratio)), max(1, round(rows * ratio)))
    how = cv2.INTER_AREA if ratio < 1 else cv2.INTER_LINEAR
    rgb = np.full((height, width, 3), 114, np.uint8)
    labels = np.zeros((height, width), np.uint8)
    top, left = (height - size[1]) // 2, (width - size[0]) // 2
    rgb[top : top + size[1], left : left + size[0]] = cv2.resize(image.rgb, size, interpolation=how)
    patch = labels[top : top + size[1], left : left + size[0]]
    order = np.argsort([-int(np.count_nonzero(mask)) for mask in image.masks], kind="stable")[:255]
    for number, index in enumerate(order, 1):
        share = cv2.resize(image.masks[index].astype(np.float32), size, interpolation=how)
        patch[share >= 0.5] = number
    return rgb, labels, [image.class_names[index] for index in order]


def vary(
    rgb: NDArray[np.uint8], labels: NDArray[np.uint8], rng: np.random.Generator
) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """A random variation of an image and its label image, of the same size."""
    height, width = labels.shape
    mirror = -1.0 if rng.random() < 0.5 else 1.0
    scale = float(np.exp(rng.uniform(np.log(0.7), np.log(1.5)))) if rng.random() < 0.7 else 1.0
    slack = np.abs(np.array([width, height]) * (scale - 1)) / 2 + 0.05 * np.array([width, height])
    shift = rng.uniform(-slack, slack) if scale != 1.0 else np.zeros(2)
    angle = float(rng.normal(0, 4.0)) if rng.random() < 0.5 else 0.0
    cosine, sine = scale * np.cos(np.deg2rad(angle)), scale * np.sin(np.deg2rad(angle))
    linear = np.array([[cosine * mirror, -sine], [sine * mirror, cosine]])
    middle = np.array([(width - 1) / 2, (height - 1) / 2])
    move = np.column_stack([linear, middle + shift - linear @ middle])
    rgb = np.asarray(
        cv2.warpAffine(rgb, move, (width, height), flags=cv2.INTER_LINEAR, borderValue=(114, 114, 114)), np.uint8
    )
    labels = np.asarray(cv2.warpAffine(labels, move, (width, height), flags=cv2.INTER_NEAREST), np.uint8)
    return _photometric(rgb, rng), labels


def _photometric(rgb: NDArray[np.uint8], rng: np.random.Generator) -> NDArray[np.uint8]:
    value: NDArray[np.float32] = rgb.astype(np.float32) / np.float32(255)
    if rng.random() < 0.8:
        value = value ** np.float32(np.exp(rng.normal(0, 0.25)))
        value = (value - 0.5) * np.float32(rng.uniform(0.7, 1.3)) + np.float32(0.5 + rng.uniform(-0.15, 0.15))
        value = value * rng.uniform(0.85, 1.15, 3).astype(np.float32)
    if rng.random() < 0.3:
        grey = value.mean(axis=2, keepdims=True)
        value = grey + (value - grey) * np.float32(rng.uniform(0.0, 1.6))
    if rng.random() < 0.2:  # a veil, brighter to one side
        direction = rng.normal(size=2)
        y, x = np.mgrid[-1 : 1 : value.shape[0] * 1j, -1 : 1 : value.shape[1] * 1j]
        ramp = np.clip(0.5 + (direction[0] * x + direction[1] * y) * 0.5, 0, 1)[:, :, None].astype(np.float32)
        value = value * (1 - ramp * np.float32(rng.uniform(0, 0.6))) + ramp * np.float32(rng.uniform(0, 0.5))
    if rng.random() < 0.25:
        length, angle = int(rng.integers(3, 10)), rng.uniform(0, np.pi)
        kernel, half = np.zeros((length, length), np.float32), (length - 1) / 2
        for t in np.linspace(-half, half, 4 * length):
            kernel[round(half + t * np.sin(angle)), round(half + t * np.cos(angle))] = 1
        value = np.asarray(cv2.filter2D(value, -1, kernel / kernel.sum()), np.float32)
    elif rng.random() < 0.2:
        value = np.asarray(cv2.GaussianBlur(value, (0, 0), float(rng.uniform(0.4, 1.5))), np.float32)
    if rng.random() < 0.4:
        value = value + rng.standard_normal(value.shape, np.float32) * np.float32(rng.uniform(0, 0.05))
    return np.asarray(np.rint(np.clip(value, 0, 1) * 255), np.uint8)


def batch_of(sets: list[PreparedImages], settings: TrainSettings, step: int) -> list[Example]:
    """The step's images: sets in proportion to their size, every image once an epoch, in random order."""
    ends = np.cumsum([len(images) for images in sets])
    total = int(ends[-1])
    examples = []
    for position in range(step * settings.batch, (step + 1) * settings.batch):
        epoch, place = divmod(position, total)
        number = int(_permutation(total, settings.seed, epoch)[place])
        chosen = int(np.searchsorted(ends, number, side="right"))
        number -= int(ends[chosen]) - len(sets[chosen])
        examples.append(sets[chosen].example(number, stream(settings.seed, "vary", position)))
    return examples


@lru_cache(maxsize=1)
def _permutation(total: int, seed: int, epoch: int) -> NDArray[np.int64]:
    return np.asarray(stream(seed, "order", epoch).permutation(total))
