"""``segmenter evaluate``: how good a segmenter's masks are on labelled images."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path

import numpy as np
from pydantic import ConfigDict

from dynslam_bench.contracts.segmenter import Segmenter
from dynslam_bench.contracts.sequence import Frame
from dynslam_bench.core.errors import SegmentationError
from dynslam_bench.core.files import write_atomic
from dynslam_bench.core.records import Record, schema

from ..build_segmenter import build_segmenter, resolve_source, weights_digest
from ..settings import SegmentationSettings
from .labelled import LabelledImages
from .mask_metrics import MaskQuality, MaskTally
from .open_labelled import open_labelled

Progress = Callable[[int, int], None]


class SegmenterScore(Record):
    """What `evaluate_segmenter` measured.

    Attributes:
        segmenter: The resolved source.
        weights: Digest of its file.
        data: The set of images.
        images: How many.
        confidence: Least score of detections that count for IoU and recall.
        min_area: Smaller objects are left out.
        mean_ap: Mask AP (IoU 0.50 to 0.95), mean over the classes that occur.
        mean_iou: Pixel IoU, mean over the classes that occur.
        classes: By class: truths, detections, ap, ap50, iou, frame_iou, instance_iou, recall (see `ClassQuality`).
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


def evaluate_segmenter(
    settings: SegmentationSettings,
    data: str | LabelledImages,
    *,
    output: Path | None = None,
    device: str = "cpu",
    threads: int = 1,
    min_area: int = 0,
    limit: int | None = None,
    progress: Progress | None = None,
) -> SegmenterScore:
    """Run a segmenter over labelled images and measure its masks.

    Args:
        settings: The segmenter and its thresholds; no dilation, no repair: the network's own masks are judged.
        data: A set or the text that names one (`open_labelled`).
        output: A JSON file for the result.
        device: ``cpu`` or ``cuda:N``.
        threads: Threads the network may use.
        min_area: Objects with fewer pixels are left out.
        limit: Only so many images, evenly spread.
        progress: Called with (images done, images in all).

    Raises:
        SegmentationError: The segmenter or the data are not available.
    """
    images = open_labelled(data) if isinstance(data, str) else data
    low = settings.model_copy(update={"confidence": min(0.05, settings.confidence)})  # AP wants weak detections too
    segmenter = build_segmenter(low, sequence_id="synthetic/", device=device, threads=threads)
    if segmenter is None:
        raise SegmentationError("segmentation.source=none has no masks to evaluate")
    quality, seconds = measure(segmenter, images, settings, min_area=min_area, limit=limit, progress=progress)
    classes = {
        name: {key: _finite(value) for key, value in asdict(one).items()}
        for name, one in quality.classes.items()
        if one.truths or one.detections
    }
    score = SegmenterScore(
        segmenter=resolve_source(settings, "synthetic/"), weights=weights_digest(settings, "synthetic/"),
        data=images.name, images=quality.images, confidence=settings.confidence, min_area=min_area,
        mean_ap=_finite(quality.mean_ap), mean_iou=_finite(quality.mean_iou), classes=classes,
        median_ms=1000 * seconds, threads=threads,
    )  # fmt: skip
    if output is not None:
        write_atomic(output, score.to_json())
    return score


def measure(
    segmenter: Segmenter,
    images: LabelledImages,
    settings: SegmentationSettings,
    *,
    min_area: int = 0,
    limit: int | None = None,
    progress: Progress | None = None,
) -> tuple[MaskQuality, float]:
    """Mask quality and the median seconds an image."""
    count = len(images) if limit is None else min(limit, len(images))
    chosen = np.unique(np.linspace(0, len(images) - 1, count).round().astype(int))
    tally = MaskTally(settings.class_names(), confidence=settings.confidence, min_area=min_area)
    times = []
    for done, index in enumerate(chosen.tolist(), 1):
        image = images[index]
        frame = Frame(index, float(index), image.rgb, np.zeros(image.rgb.shape[:2], np.float32))
        start = time.perf_counter()
        found = segmenter.segment(frame)
        times.append(time.perf_counter() - start)
        tally.add(image, found)
        if progress is not None:
            progress(done, len(chosen))
    return tally.quality(), float(np.median(times)) if times else float("nan")


def _finite(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
