"""Conformance of segmenters."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from dynslam_bench.contracts.segmenter import Instances, Segmenter
from dynslam_bench.contracts.sequence import Frame, Sequence

from .report import ConformanceReport, require
from .scenes import CornerSequence, hard_frames


def check_segmenter(construct: Callable[[], Segmenter], *, sequence: Sequence | None = None, frames: int = 2) -> None:
    """Check that a segmenter keeps its contract.

    Args:
        construct: Builds a segmenter.
        sequence: Whose frames to segment; the built-in scene by default.
        frames: How many.

    Raises:
        ConformanceError: Names every failed check, what was found and the likely cause.
    """
    segmenter_report(construct, sequence=sequence, frames=frames).raise_for_failures()


def segmenter_report(
    construct: Callable[[], Segmenter], *, sequence: Sequence | None = None, frames: int = 2
) -> ConformanceReport:
    """Run all checks of `check_segmenter` and report each."""
    scene = sequence if sequence is not None else CornerSequence(frames)
    images = [scene[index] for index in range(min(frames, len(scene)))]
    report = ConformanceReport(f"segmenter {getattr(construct, '__name__', type(construct).__name__)!r}")
    if not report.run("construction", lambda: _construct(construct)):
        return report
    if not report.run("results", lambda: _all(construct(), images)):
        return report
    report.run("frames are left alone", lambda: _left_alone(construct(), images[0]))
    report.run("determinism", lambda: _determinism(construct, images))
    for name, frame in hard_frames(images[0]).items():
        report.run(f"{name} frame", lambda frame=frame: _all(construct(), [frame]))  # type: ignore[misc]
    return report


def check_instances(found: Instances, frame: Frame) -> None:
    """Check what a segmenter gave for one frame.

    Raises:
        ConformanceError: Something in it breaks the contract.
    """
    at, shape = f"frame {frame.index}", frame.depth.shape
    require(
        isinstance(found, Instances),
        f"{at}: segment() gave a {type(found).__name__}, not Instances",
        "nothing found is Instances.empty(height, width)",
    )
    count = len(found.class_names)
    require(
        found.masks.dtype == np.bool_ and found.masks.shape == (count, *shape),
        f"{at}: masks are {found.masks.dtype} {found.masks.shape}, expected bool {(count, *shape)}",
        "masks have to be at the frame's resolution and thresholded",
    )
    require(
        found.boxes.dtype == np.float32 and found.boxes.shape == (count, 4),
        f"{at}: boxes are {found.boxes.dtype} {found.boxes.shape}, expected float32 {(count, 4)}",
    )
    require(
        found.scores.dtype == np.float32 and found.scores.shape == (count,),
        f"{at}: scores are {found.scores.dtype} {found.scores.shape}, expected float32 {(count,)}",
    )
    require(
        ((found.scores >= 0) & (found.scores <= 1)).all(), f"{at}: a score lies outside [0, 1]", "logits, not scores"
    )
    require(all(isinstance(name, str) and name for name in found.class_names), f"{at}: a class has no name")
    require(np.isfinite(found.boxes).all(), f"{at}: a box is not finite")
    low, high = found.boxes[:, :2], found.boxes[:, 2:]
    require((low <= high).all(), f"{at}: a box ends before it begins", "boxes are x0, y0, x1, y1, not x, y, w, h")
    for mask, box, name in zip(found.masks, found.boxes, found.class_names, strict=True):
        rows, columns = np.nonzero(mask)
        if not len(rows):
            continue
        inside = (columns >= box[0] - 1) & (columns <= box[2] + 1) & (rows >= box[1] - 1) & (rows <= box[3] + 1)
        outside = 100 * (1 - float(inside.mean()))
        require(
            outside < 10,
            f"{at}: {outside:.0f} % of the mask of a {name} lie outside its box",
            "boxes of another resolution, or y before x",
        )
    require(found.moving is None or found.moving.shape == (count,), f"{at}: moving does not fit the objects")


def _construct(construct: Callable[[], Segmenter]) -> None:
    segmenter = construct()
    require(callable(getattr(segmenter, "segment", None)), f"a {type(segmenter).__name__} lacks segment()")


def _all(segmenter: Segmenter, frames: list[Frame]) -> None:
    for frame in frames:
        check_instances(segmenter.segment(frame), frame)


def _left_alone(segmenter: Segmenter, frame: Frame) -> None:
    rgb, depth = frame.rgb.copy(), frame.depth.copy()
    segmenter.segment(frame)
    require(np.array_equal(frame.rgb, rgb) and np.array_equal(frame.depth, depth), "the frame was changed")


def _determinism(construct: Callable[[], Segmenter], frames: list[Frame]) -> None:
    first, second = construct(), construct()
    for frame in frames:
        a, b = first.segment(frame), second.segment(frame)
        same = (
            a.class_names == b.class_names and np.array_equal(a.masks, b.masks) and np.array_equal(a.scores, b.scores)
        )
        require(
            same,
            f"frame {frame.index} gives other objects when it is segmented again",
            "a network in training mode, or unseeded randomness",
        )
