"""``segmenter evaluate``: average precision, intersection over union and recall of masks on labelled images."""

import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydantic import ConfigDict

from dynslam_bench.contracts import Frame, Segmenter
from dynslam_bench.core import SegmentationError, write_atomic
from dynslam_bench.core.records import Record, schema
from dynslam_bench.evaluation import MaskCounts, compare_masks
from dynslam_bench.segmentation.build_segmenter import (
    build_segmenter,
    resolve_source,
    weights_digest,
)
from dynslam_bench.segmentation.settings import SegmentationSettings
from dynslam_bench.segmentation.training.labelled_images import LabelledImage, open_labelled

THRESHOLDS: tuple[float, ...] = tuple(round(0.5 + 0.05 * step, 2) for step in range(10))
"""COCO's IoU thresholds 0.50, 0.55 ... 0.95."""
RECALL_POINTS = np.linspace(0, 1, 101)
"""COCO's recall points of the average precision."""
LEAST_SCORE = 0.05
"""Detections down to this score enter the average precision."""


class MaskTally:
    """Mask quality of one class, gathered image by image.

    Args:
        confidence: Least score of detections that count for IoU and recall; AP takes them all.
        min_area: Objects with fewer pixels are ignored, and detections of them are no errors.
    """

    def __init__(self, confidence: float = 0.5, min_area: int = 0) -> None:
        self.confidence = confidence
        self.min_area = min_area
        self.truths = 0
        self._counts = MaskCounts()
        self._frame_ious: list[float] = []
        self._object_ious: list[float] = []
        self._scores: list[float] = []
        self._hits: list[NDArray[np.bool_]] = []
        self._ignored: list[NDArray[np.bool_]] = []

    def add(
        self, true: NDArray[np.bool_], guess: NDArray[np.bool_], scores: NDArray[np.float32]
    ) -> None:
        """Compare the detections in an image with its labels: masks ``[M, H, W]``, ``[N, H, W]`` and scores ``[N]``."""
        # detections by falling score
        order = np.argsort(-scores, kind="stable")
        guess = guess[order]
        scores = scores[order]
        overlap = mask_iou(guess, true)
        large = np.count_nonzero(true, axis=(1, 2)) >= max(self.min_area, 1)
        sure = scores >= self.confidence

        # pixel IoU of the class, of confident detections
        if len(true) or sure.any():
            counts = compare_masks(
                np.asarray(guess[sure].any(axis=0)), np.asarray(true.any(axis=0))
            )
            self._counts = self._counts + counts
            if counts.iou is not None:
                self._frame_ious.append(counts.iou)

        # IoU of each object's best detection
        self.truths += int(large.sum())
        self._object_ious.extend(overlap[sure][:, large].max(axis=0, initial=0.0).tolist())

        # hits of all detections at every threshold, for the average precision
        small = np.count_nonzero(guess, axis=(1, 2)) < self.min_area
        hits, ignored = assign(overlap, large, small)
        self._scores.extend(scores.tolist())
        self._hits.extend(hits)
        self._ignored.extend(ignored)

    def quality(self) -> dict[str, float | None]:
        """The quality over the images so far; None where there is nothing to measure.

        Returns:
            - ``truths`` and ``detections``: objects that are there, and that were found.
            - ``ap``: average precision (COCO's 101 recall points), mean over `THRESHOLDS`.
            - ``ap50``: average precision at IoU 0.5.
            - ``iou``: intersection over union of the class's pixels, added up over all images.
            - ``frame_iou``: mean IoU of the images in which the class is there or was found.
            - ``instance_iou``: IoU of the detection that fits an object best (0 if there is none),
              mean over the objects.
            - ``recall``: share of the objects that a detection covers with IoU >= 0.5.
        """
        # what was gathered, one row a detection or object
        scores = np.array(self._scores)
        best = np.array(self._object_ious)
        hits = np.array(self._hits, bool).reshape(-1, len(THRESHOLDS))
        ignored = np.array(self._ignored, bool).reshape(-1, len(THRESHOLDS))
        # average precision at each threshold, without the ignored detections
        precisions = []
        for k in range(len(THRESHOLDS)):
            counted = ~ignored[:, k]
            precisions.append(average_precision(scores[counted], hits[counted, k], self.truths))
        return {
            "truths": float(self.truths),
            "detections": float(len(scores)),
            "ap": mean(precisions),
            "ap50": mean(precisions[:1]),
            "iou": self._counts.iou,
            "frame_iou": mean(self._frame_ious),
            "instance_iou": mean(self._object_ious),
            "recall": mean((best >= 0.5).tolist()),
        }


def mean(values: Sequence[float | None]) -> float | None:
    """The mean of the values; None without any, or if one is missing or NaN."""
    result = float(np.mean(np.array(values, np.float64))) if values else float("nan")
    return result if np.isfinite(result) else None


def mask_iou(a: NDArray[np.bool_], b: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Intersection over union ``[N, M]`` of masks ``[N, H, W]`` and ``[M, H, W]``."""
    if not len(a) or not len(b):
        return np.zeros((len(a), len(b)))
    # common pixels of all pairs by one product
    x = a.reshape(len(a), -1).astype(np.float32)
    y = b.reshape(len(b), -1).astype(np.float32)
    inter = (x @ y.T).astype(np.float64)
    union = x.sum(axis=1, dtype=np.float64)[:, None] + y.sum(axis=1, dtype=np.float64)[None] - inter
    return np.asarray(inter / np.maximum(union, 1))


def assign(
    overlap: NDArray[np.float64], counted: NDArray[np.bool_], small: NDArray[np.bool_]
) -> tuple[list[NDArray[np.bool_]], list[NDArray[np.bool_]]]:
    """COCO's assignment: each detection, best first, takes the free object that it overlaps most.

    Args:
        overlap: ``[N, M]``, detections by falling score.
        counted: ``[M]``, objects that are asked for; the others absorb detections without effect.
        small: ``[N]``, detections that do not count if they hit nothing.

    Returns:
        For each detection, bool ``[10]`` at each of `THRESHOLDS`: whether it hits, and whether it
        is ignored.
    """
    # at each threshold by itself
    count, objects = overlap.shape
    hits = np.zeros((count, len(THRESHOLDS)), bool)
    ignored = np.zeros((count, len(THRESHOLDS)), bool)
    for level, threshold in enumerate(THRESHOLDS):
        free = np.ones(objects, bool)
        for row in range(count):
            # an object that is asked for comes before one that is not
            for group in (counted, ~counted):
                candidates = np.flatnonzero(free & group & (overlap[row] >= threshold))
                if candidates.size:
                    best = candidates[np.argmax(overlap[row, candidates])]
                    free[best] = not counted[best]
                    hits[row, level] = counted[best]
                    ignored[row, level] = not counted[best]
                    break
            else:
                ignored[row, level] = small[row]
    return list(hits), list(ignored)


def average_precision(scores: NDArray[np.float64], hits: NDArray[np.bool_], truths: int) -> float:
    """Area under the precision-recall curve at COCO's 101 recall points; NaN without objects."""
    if not truths:
        return float("nan")
    # recall and precision after each detection, the surest first
    order = np.argsort(-scores, kind="stable")
    positives = np.cumsum(hits[order])
    recall = positives / truths
    precision = positives / np.arange(1, len(order) + 1)
    # the best precision at this recall or a higher one, 0 beyond the highest
    precision = np.maximum.accumulate(precision[::-1])[::-1]
    at = np.searchsorted(recall, RECALL_POINTS, side="left")
    return float(np.append(precision, 0.0)[np.minimum(at, len(precision))].mean())


class SegmenterScore(Record):
    """The result of `evaluate_segmenter`.

    Attributes:
        segmenter: The resolved source.
        weights: Digest of its file.
        data: The set of images.
        images: Number of images.
        confidence: Least score of detections that count for IoU and recall.
        min_area: Smaller objects are left out.
        mean_ap: Mask AP (IoU 0.50 to 0.95), mean over the classes that occur.
        mean_iou: Pixel IoU, mean over the classes that occur.
        classes: Scores by class: truths, detections, ap, ap50, iou, frame_iou, instance_iou, recall
            (see `MaskTally.quality`).
        median_ms: Median time of one image.
        threads: Threads the network could use.
    """

    model_config = ConfigDict(extra="forbid", ser_json_inf_nan="null")

    schema_version: int = schema(1)
    segmenter: str
    weights: str
    data: str
    images: int
    confidence: float
    min_area: int
    mean_ap: float | None
    mean_iou: float | None
    classes: dict[str, dict[str, float | None]]
    median_ms: float
    threads: int


def _add_image(
    tallies: dict[str, MaskTally], segmenter: Segmenter, image: LabelledImage, index: int
) -> float:
    """Segment an image and add its masks to the tally of each class; returns the seconds that it took."""
    # segment; the frame has no depth
    frame = Frame(index, float(index), image.rgb, np.zeros(image.rgb.shape[:2], np.float32))
    start = time.perf_counter()
    detections = segmenter.segment(frame)
    seconds = time.perf_counter() - start
    # compare class by class
    for name, tally in tallies.items():
        labelled = image.masks[[kind == name for kind in image.class_names]]
        predicted = detections.of_classes([name])
        tally.add(labelled, predicted.masks, predicted.scores)
    return seconds


def evaluate_segmenter(
    settings: SegmentationSettings,
    data: str,
    *,
    output: Path | None = None,
    device: str = "cpu",
    threads: int = 1,
    min_area: int = 0,
    limit: int | None = None,
    progress: Callable[[int, int], object] = lambda *_: None,
) -> SegmenterScore:
    """Run a segmenter over labelled images and measure its masks.

    Args:
        settings: The segmenter and its thresholds; the network's own masks are measured, without
            dilation and repair.
        data: Names a set of labelled images (`open_labelled`).
        output: A JSON file for the result.
        device: ``cpu`` or ``cuda:N``.
        threads: Threads the network may use.
        min_area: Objects with fewer pixels are left out.
        limit: Only so many images, evenly spread.
        progress: Called with (images done, images in all).

    Raises:
        SegmentationError: The segmenter or the data are not available, or no image shows an object
            of the classes.
    """
    # detections down to a low score, which the precision-recall curve needs
    images = open_labelled(data)
    # images of a set do not follow each other, so that nothing is carried from one to the next
    low = settings.model_copy(
        update={"confidence": min(LEAST_SCORE, settings.confidence), "map_decay": 0.0}
    )
    segmenter = build_segmenter(low, sequence_id="synthetic/", device=device, threads=threads)
    if segmenter is None:
        raise SegmentationError("segmentation.source=none has no masks to evaluate")
    count = len(images) if limit is None else min(limit, len(images))
    chosen = np.unique(np.linspace(0, len(images) - 1, count).round().astype(int))

    # segment the images, and compare the masks class by class
    tallies = {
        name: MaskTally(settings.confidence, min_area) for name in sorted(settings.class_names())
    }
    times = []
    shown: set[str] = set()
    for done, index in enumerate(chosen.tolist(), 1):
        image = images[index]
        times.append(_add_image(tallies, segmenter, image, index))
        shown.update(image.class_names)
        progress(done, len(chosen))

    # means over the classes that occur
    qualities = {name: tally.quality() for name, tally in tallies.items()}
    occurring = [quality for quality in qualities.values() if quality["truths"]]
    if not occurring:
        raise SegmentationError(
            f"none of {len(chosen)} images of {images.name} shows an object of the classes {settings.classes} with at "
            f"least {max(min_area, 1)} px: nothing is measured",
            f"labelled are: {', '.join(sorted(shown)) or 'none'}",
        )
    reported = {
        name: quality
        for name, quality in qualities.items()
        if quality["truths"] or quality["detections"]
    }
    # the score, with what it was measured on
    score = SegmenterScore(
        segmenter=resolve_source(settings, "synthetic/"),
        weights=weights_digest(settings, "synthetic/"),
        data=images.name,
        images=len(chosen),
        confidence=settings.confidence,
        min_area=min_area,
        mean_ap=mean([quality["ap"] for quality in occurring]),
        mean_iou=mean([quality["iou"] for quality in occurring]),
        classes=reported,
        median_ms=1000 * float(np.median(times)) if times else float("nan"),
        threads=threads,
    )
    if output is not None:
        write_atomic(output, score.to_json())
    return score
