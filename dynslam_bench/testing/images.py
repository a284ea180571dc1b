"""Conformance of feature extractors."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray

from dynslam_bench.contracts.features import FeatureExtractor, Keypoints, MaskedExtractor
from dynslam_bench.contracts.flow import FlowEstimator, FlowResult, stats_names_of
from dynslam_bench.contracts.segmenter import Instances, Segmenter
from dynslam_bench.contracts.sequence import Frame, Sequence
from dynslam_bench.geometry.camera import inside
from dynslam_bench.testing.report import ConformanceReport, NotApplicable, require
from dynslam_bench.testing.scenes import CornerSequence, grey, hard_frames


def check_features(construct: Callable[[], FeatureExtractor], *, descriptor_bytes: int | None = None) -> None:
    """Check that a feature extractor keeps its contract.

    Args:
        construct: Builds an extractor.
        descriptor_bytes: What its spec says of the length of a descriptor; None where there is no spec.

    Raises:
        ConformanceError: Names every failed check, what was found and the likely cause.
    """
    features_report(construct, descriptor_bytes=descriptor_bytes).raise_for_failures()


def features_report(
    construct: Callable[[], FeatureExtractor], *, descriptor_bytes: int | None = None
) -> ConformanceReport:
    """Run all checks of `check_features` and report each."""
    scene = CornerSequence(2)
    images = [grey(scene[0]), grey(scene[1])]
    report = ConformanceReport(f"extractor {getattr(construct, '__name__', type(construct).__name__)!r}")
    if not report.run("construction", lambda: _construct_extractor(construct)):
        return report
    if not report.run("results", lambda: _extractor_results(construct(), images[0], descriptor_bytes, least=20)):
        return report
    report.run("images are left alone", lambda: _extractor_leaves_image(construct(), images[0]))
    report.run("determinism", lambda: _extractor_determinism(construct, images))
    report.run("beside a mask", lambda: _beside(construct(), images[0]))
    for name, frame in hard_frames(scene[0]).items():
        image = grey(frame)
        report.run(
            f"{name} image",
            lambda image=image: _extractor_results(construct(), image, descriptor_bytes),  # type: ignore[misc]
        )
    return report


def check_keypoints(found: Keypoints, shape: tuple[int, ...], descriptor_bytes: int | None = None) -> None:
    """Check what an extractor gave for one image.

    Args:
        found: The keypoints.
        shape: Of the image, ``(H, W)``.
        descriptor_bytes: The length that the spec states, if it is known.

    Raises:
        ConformanceError: Something in it breaks the contract.
    """
    require(isinstance(found, Keypoints), f"extract() gave a {type(found).__name__}, not Keypoints")
    count = len(found.xy)
    expected: dict[str, tuple[type, tuple[int, ...]]] = {
        "xy": (np.float32, (count, 2)),
        "octave": (np.int32, (count,)),
        "angle": (np.float32, (count,)),
        "response": (np.float32, (count,)),
    }
    for name, (kind, size) in expected.items():
        value = getattr(found, name)
        require(
            value.dtype == kind and value.shape == size,
            f"{name} is {value.dtype} {value.shape}, expected {np.dtype(kind)} {size}",
        )
    descriptors = found.descriptors
    require(
        descriptors.dtype == np.uint8 and descriptors.ndim == 2 and len(descriptors) == count,
        f"descriptors are {descriptors.dtype} {descriptors.shape}, expected uint8 [{count}, bytes]",
        "bits are packed: eight in a byte",
    )
    require(
        descriptor_bytes is None or not count or descriptors.shape[1] == descriptor_bytes,
        f"descriptors have {descriptors.shape[1]} bytes, the spec says {descriptor_bytes}",
    )
    require(np.isfinite(found.xy).all(), "a keypoint is not finite")
    within = (found.xy >= -0.5).all(axis=1) & (found.xy <= np.array(shape[::-1]) - 0.5).all(axis=1)
    require(
        within.all(),
        f"{int((~within).sum())} of {count} keypoints lie outside the image",
        "pixels of the full resolution, x first",
    )
    require((found.octave >= 0).all(), "a pyramid level is negative")
    require(((found.angle >= 0) & (found.angle < 360)).all(), "an angle lies outside [0, 360)", "degrees, not radians")


def _construct_extractor(construct: Callable[[], FeatureExtractor]) -> None:
    extractor = construct()
    require(callable(getattr(extractor, "extract", None)), f"a {type(extractor).__name__} lacks extract()")


def _extractor_results(
    extractor: FeatureExtractor, image: NDArray[np.uint8], descriptor_bytes: int | None, least: int = 0
) -> None:
    found = extractor.extract(image.copy())
    check_keypoints(found, image.shape, descriptor_bytes)
    require(len(found) >= least, f"only {len(found)} keypoints in a textured image")


def _extractor_leaves_image(extractor: FeatureExtractor, image: NDArray[np.uint8]) -> None:
    given = image.copy()
    extractor.extract(given)
    require(np.array_equal(given, image), "the image was changed", "an operation in place")


def _extractor_determinism(construct: Callable[[], FeatureExtractor], images: list[NDArray[np.uint8]]) -> None:
    first, second = construct(), construct()
    first.extract(images[1])  # what came before does not matter
    a, b = first.extract(images[0]), second.extract(images[0])
    require(
        np.array_equal(a.xy, b.xy) and np.array_equal(a.descriptors, b.descriptors),
        "the same image gives other keypoints",
        "unseeded randomness, or state that outlives an image",
    )


def _beside(extractor: FeatureExtractor, image: NDArray[np.uint8]) -> None:
    if not isinstance(extractor, MaskedExtractor):
        raise NotApplicable("it has no extract_masked(): features on people take the place of others")
    mask = np.zeros(image.shape, bool)
    mask[:, : image.shape[1] * 3 // 4] = True
    found, usual = extractor.extract_masked(image, mask, 1.0), extractor.extract(image)
    check_keypoints(found, image.shape)

    there, before = (int((~inside(mask, points.xy)).sum()) for points in (found, usual))
    require(there >= before, f"{there} keypoints beside the mask, {before} without asking for any")


# Conformance of optical flows.

SHIFT_PX = (3, -2)
"""The motion of the check of accuracy: small, so that any flow finds it, and not none."""


def check_flow(construct: Callable[[], FlowEstimator], *, points: int = 200) -> None:
    """Check that an optical flow keeps its contract.

    Args:
        construct: Builds a flow.
        points: How many points are tracked.

    Raises:
        ConformanceError: Names every failed check, what was found and the likely cause.
    """
    flow_report(construct, points=points).raise_for_failures()


def flow_report(construct: Callable[[], FlowEstimator], *, points: int = 200) -> ConformanceReport:
    """Run all checks of `check_flow` and report each."""
    scene = CornerSequence(2)
    first, second = grey(scene[0]), grey(scene[1])
    grid = _grid(first.shape, points)
    report = ConformanceReport(f"flow {getattr(construct, '__name__', type(construct).__name__)!r}")
    if not report.run("construction", lambda: _construct_flow(construct)):
        return report
    if not report.run("results", lambda: _flow_results(construct(), first, second, grid)):
        return report
    report.run("images are left alone", lambda: _flow_leaves_images(construct(), first, second, grid))
    report.run("no points", lambda: _flow_results(construct(), first, second, grid[:0]))
    report.run("points outside", lambda: _outside(construct(), first, second, grid))
    report.run("guesses", lambda: _guesses(construct(), first, second, grid))
    report.run("determinism", lambda: _flow_determinism(construct, first, second, grid))
    report.run("a small shift is found", lambda: _shift(construct(), first, grid))
    for name, frame in hard_frames(scene[0]).items():
        image = grey(frame)
        report.run(f"{name} image", lambda image=image: _flow_results(construct(), first, image, grid))  # type: ignore[misc]
    return report


def check_flow_result(found: FlowResult, points: NDArray[np.float32], names: tuple[str, ...] = ()) -> None:
    """Check what a flow gave.

    Args:
        found: The result.
        points: float32 ``[N, 2]``, the points that were looked for.
        names: The stats that the flow declares.

    Raises:
        ConformanceError: Something in it breaks the contract.
    """
    count = len(points)
    require(isinstance(found, FlowResult), f"track() gave a {type(found).__name__}, not a FlowResult")
    require(
        found.xy.dtype == np.float32 and found.xy.shape == (count, 2),
        f"xy is {found.xy.dtype} {found.xy.shape}, expected float32 {(count, 2)}",
        "one row a point, in the order of the points",
    )
    require(
        found.valid.dtype == np.bool_ and found.valid.shape == (count,),
        f"valid is {found.valid.dtype} {found.valid.shape}, expected bool {(count,)}",
    )
    require(
        found.cost.dtype == np.float32 and found.cost.shape == (count,),
        f"cost is {found.cost.dtype} {found.cost.shape}, expected float32 {(count,)}",
    )
    require(np.isfinite(found.xy[found.valid]).all(), "a valid row is not finite", "mark it as not valid")
    require(not np.isnan(found.cost[found.valid]).any(), "a valid row has no cost")
    missing = [name for name in names if name not in found.stats]
    require(not missing, f"stats lack '{missing[0] if missing else ''}'", "stats_names declares it")


def _grid(shape: tuple[int, ...], points: int) -> NDArray[np.float32]:
    across = max(2, int(np.sqrt(points * shape[1] / shape[0])))
    down = max(2, points // across)
    x, y = np.meshgrid(np.linspace(40, shape[1] - 41, across), np.linspace(40, shape[0] - 41, down))
    return np.stack([x, y], -1).reshape(-1, 2).astype(np.float32)


def _construct_flow(construct: Callable[[], FlowEstimator]) -> None:
    flow = construct()
    for name in ("prepare", "track"):
        require(callable(getattr(flow, name, None)), f"a {type(flow).__name__} lacks {name}()")


def _flow_results(
    flow: FlowEstimator, first: NDArray[np.uint8], second: NDArray[np.uint8], points: NDArray[np.float32]
) -> None:
    found = flow.track(flow.prepare(first.copy()), flow.prepare(second.copy()), points.copy())
    check_flow_result(found, points, stats_names_of(flow))


def _flow_leaves_images(
    flow: FlowEstimator, first: NDArray[np.uint8], second: NDArray[np.uint8], points: NDArray[np.float32]
) -> None:
    given = first.copy(), second.copy(), points.copy()
    flow.track(flow.prepare(given[0]), flow.prepare(given[1]), given[2])
    images = np.array_equal(given[0], first) and np.array_equal(given[1], second)
    require(images, "an image was changed", "an operation in place")
    require(np.array_equal(given[2], points), "the points were changed", "an operation in place")


def _outside(
    flow: FlowEstimator, first: NDArray[np.uint8], second: NDArray[np.uint8], points: NDArray[np.float32]
) -> None:
    strange = np.array([[-5, 5], [1e6, 5], [np.nan, 5]], np.float32)
    both = np.concatenate([points, strange])
    found = flow.track(flow.prepare(first), flow.prepare(second), both)
    check_flow_result(found, both)
    require(not found.valid[-3:].any(), "a point outside the reference image is valid in the target")


def _guesses(
    flow: FlowEstimator, first: NDArray[np.uint8], second: NDArray[np.uint8], points: NDArray[np.float32]
) -> None:
    guess = points.copy()
    guess[::2] = np.nan
    found = flow.track(flow.prepare(first), flow.prepare(second), points, guess=guess)
    check_flow_result(found, points)


def _flow_determinism(
    construct: Callable[[], FlowEstimator],
    first: NDArray[np.uint8],
    second: NDArray[np.uint8],
    points: NDArray[np.float32],
) -> None:
    found = []
    for _ in range(2):
        flow = construct()
        found.append(flow.track(flow.prepare(first), flow.prepare(second), points, seed=7))
    same = np.array_equal(found[0].valid, found[1].valid) and np.array_equal(
        found[0].xy[found[0].valid], found[1].xy[found[1].valid]
    )
    require(same, "the same images and seed give another flow", "unseeded randomness, or state that outlives an image")


def _shift(flow: FlowEstimator, image: NDArray[np.uint8], points: NDArray[np.float32]) -> None:
    matrix = np.array([[1, 0, SHIFT_PX[0]], [0, 1, SHIFT_PX[1]]], np.float64)
    target = cv2.warpAffine(image, matrix, image.shape[::-1], borderMode=cv2.BORDER_REFLECT)
    found = flow.track(flow.prepare(image), flow.prepare(np.asarray(target, np.uint8)), points)
    share = float(found.valid.mean())
    require(share > 0.2, f"only {100 * share:.0f} % of the points are found after a shift of {SHIFT_PX} pixels")
    error = float(np.median(np.linalg.norm(found.xy - points - np.array(SHIFT_PX, np.float32), axis=1)[found.valid]))
    require(
        error < 1.0,
        f"after a shift of {SHIFT_PX} pixels the median error of the valid points is {error:.1f} px",
        "xy are positions in the target, x first, not displacements",
    )


# Conformance of segmenters.


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
    if not report.run("construction", lambda: _construct_segmenter(construct)):
        return report
    if not report.run("results", lambda: _segmenter_results(construct(), images)):
        return report
    report.run("frames are left alone", lambda: _segmenter_leaves_frame(construct(), images[0]))
    report.run("determinism", lambda: _segmenter_determinism(construct, images))
    for name, frame in hard_frames(images[0]).items():
        report.run(f"{name} frame", lambda frame=frame: _segmenter_results(construct(), [frame]))  # type: ignore[misc]
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


def _construct_segmenter(construct: Callable[[], Segmenter]) -> None:
    segmenter = construct()
    require(callable(getattr(segmenter, "segment", None)), f"a {type(segmenter).__name__} lacks segment()")


def _segmenter_results(segmenter: Segmenter, frames: list[Frame]) -> None:
    for frame in frames:
        check_instances(segmenter.segment(frame), frame)


def _segmenter_leaves_frame(segmenter: Segmenter, frame: Frame) -> None:
    rgb, depth = frame.rgb.copy(), frame.depth.copy()
    segmenter.segment(frame)
    require(np.array_equal(frame.rgb, rgb) and np.array_equal(frame.depth, depth), "the frame was changed")


def _segmenter_determinism(construct: Callable[[], Segmenter], frames: list[Frame]) -> None:
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
