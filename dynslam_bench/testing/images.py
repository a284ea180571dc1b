"""Conformance of what is done to an image: feature extractors, optical flows and segmenters."""

from collections.abc import Callable
from functools import partial

import cv2
import numpy as np
from numpy.typing import NDArray

from dynslam_bench.contracts import (
    FeatureExtractor,
    FlowEstimator,
    FlowResult,
    Frame,
    Instances,
    Keypoints,
    MaskedExtractor,
    Segmenter,
    Sequence,
)
from dynslam_bench.contracts.flow import stats_names_of
from dynslam_bench.geometry import inside
from dynslam_bench.testing.report import (
    ConformanceReport,
    NotApplicable,
    require,
    require_all,
    require_arrays,
    require_equal,
    require_methods,
    require_unchanged,
)
from dynslam_bench.testing.scenes import CornerSequence, grey, hard_frames

Image = NDArray[np.uint8]
SHIFT_PX = (3, -2)
"""The shift of the flow's accuracy check: small, so that any flow finds it, and not zero."""


def check_features(
    construct: Callable[[], FeatureExtractor], *, descriptor_bytes: int | None = None
) -> None:
    """Check that a feature extractor keeps its contract.

    Args:
        construct: Builds an extractor.
        descriptor_bytes: The length of a descriptor in its spec; None without a spec.

    Raises:
        ConformanceError: Names every failed check, the fault and the likely cause.
    """
    features_report(construct, descriptor_bytes=descriptor_bytes).raise_for_failures()


def features_report(
    construct: Callable[[], FeatureExtractor], *, descriptor_bytes: int | None = None
) -> ConformanceReport:
    """Run all checks of `check_features` and report each."""
    scene = CornerSequence(2)
    image = grey(scene[0])
    other = grey(scene[1])

    def results(frame: Frame, least: int = 0) -> None:
        keypoints = construct().extract(grey(frame))
        check_keypoints(keypoints, image.shape, descriptor_bytes)
        require(len(keypoints) >= least, f"only {len(keypoints)} keypoints in a textured image")

    return ConformanceReport.of("extractor", construct).run_all(
        {
            "construction": lambda: require_methods(construct(), "extract"),
            "results": lambda: results(scene[0], least=20),
        },
        {
            "beside a mask": lambda: _masked_extraction(construct(), image),
            "images are left alone": lambda: require_unchanged(
                lambda: construct().extract(image), image, what="the image"
            ),
            "determinism": lambda: _extractor_determinism(construct, image, other),
            **_on_hard_images(scene[0], results),
        },
    )


def _on_hard_images(
    frame: Frame, results: Callable[[Frame], object]
) -> dict[str, Callable[[], object]]:
    """The checks on images that have nothing to find, by name.

    Args:
        frame: A usual frame, from which these are made.
        results: Checks what a segmenter, extractor or flow gives for a frame.
    """
    return {f"{name} image": partial(results, hard) for name, hard in hard_frames(frame).items()}


def check_keypoints(
    keypoints: Keypoints, shape: tuple[int, ...], descriptor_bytes: int | None = None
) -> None:
    """Check the keypoints of one image.

    Args:
        keypoints: The extractor's result.
        shape: Shape of the image, ``(H, W)``.
        descriptor_bytes: The length that the spec states, if it is known.

    Raises:
        ConformanceError: Something in it breaks the contract.
    """
    require(
        isinstance(keypoints, Keypoints),
        f"extract() gave a {type(keypoints).__name__}, not Keypoints",
    )
    # types and shapes first: all that follows relies on them
    xy = keypoints.xy
    angle = keypoints.angle
    descriptors = keypoints.descriptors
    count = len(keypoints.xy)
    require_arrays(
        keypoints,
        {
            "xy": (np.float32, (count, 2)),
            "octave": (np.int32, (count,)),
            "angle": (np.float32, (count,)),
            "response": (np.float32, (count,)),
        },
    )
    # a pixel's square reaches half a pixel beyond its centre
    outside = ((xy < -0.5) | (xy > np.array(shape[::-1]) - 0.5)).any(axis=1)
    require_all(
        (
            descriptors.dtype == np.uint8 and descriptors.ndim == 2 and len(descriptors) == count,
            f"descriptors are {descriptors.dtype} {descriptors.shape}, expected uint8 [{count}, bytes]",
            "bits are packed: eight in a byte",
        ),
        (
            descriptor_bytes is None or not count or descriptors.shape[1:] == (descriptor_bytes,),
            f"descriptors have {descriptors.shape[-1]} bytes, the spec says {descriptor_bytes}",
        ),
        (np.isfinite(xy).all(), "a keypoint is not finite"),
        (
            not outside.any(),
            f"{int(outside.sum())} of {count} keypoints lie outside the image",
            "pixels of the full resolution, x first",
        ),
        ((keypoints.octave >= 0).all(), "a pyramid level is negative"),
        (
            ((angle >= 0) & (angle < 360)).all(),
            "an angle lies outside [0, 360)",
            "degrees, not radians",
        ),
    )


def _extractor_determinism(
    construct: Callable[[], FeatureExtractor], image: Image, other: Image
) -> None:
    """An image gives the same keypoints from a fresh extractor and from one that has seen another image."""
    first = construct()
    # one extractor has seen another image before
    first.extract(other)  # an earlier image has no influence
    cause = "unseeded randomness, or state that outlives an image"
    again = construct().extract(image)
    require_equal(
        first.extract(image),
        again,
        ("xy", "descriptors"),
        "the same image gives other keypoints",
        cause,
    )


def _masked_extraction(extractor: FeatureExtractor, image: Image) -> None:
    """With a mask over three quarters of the image, no fewer keypoints lie beside it than without."""
    if not isinstance(extractor, MaskedExtractor):
        raise NotApplicable(
            "it has no extract_masked(): features on people take the place of others"
        )
    # the left three quarters are masked
    mask = np.zeros(image.shape, bool)
    mask[:, : image.shape[1] * 3 // 4] = True
    # keypoints that lie beside the mask, with and without asking for them
    masked = extractor.extract_masked(image, mask, 1.0)
    plain = extractor.extract(image)
    check_keypoints(masked, image.shape)
    beside_masked = int((~inside(mask, masked.xy)).sum())
    beside_plain = int((~inside(mask, plain.xy)).sum())
    require(
        beside_masked >= beside_plain,
        f"{beside_masked} keypoints beside the mask, {beside_plain} without asking for any",
    )


def check_flow(construct: Callable[[], FlowEstimator], *, points: int = 200) -> None:
    """Check that an optical flow keeps its contract.

    Args:
        construct: Builds a flow.
        points: How many points are tracked.

    Raises:
        ConformanceError: Names every failed check, the fault and the likely cause.
    """
    flow_report(construct, points=points).raise_for_failures()


def flow_report(construct: Callable[[], FlowEstimator], *, points: int = 200) -> ConformanceReport:
    """Run all checks of `check_flow` and report each."""
    scene = CornerSequence(2)
    first = grey(scene[0])
    second = grey(scene[1])
    # points with a guess, and without one
    grid = _grid(first.shape, points)
    guess = _grid(first.shape, points)
    guess[::2] = np.nan  # every other point has no guess

    def results(
        target: Image, points: NDArray[np.float32], guess: NDArray[np.float32] | None = None
    ) -> FlowResult:
        flow = construct()
        reference = flow.prepare(first.copy())
        result = flow.track(reference, flow.prepare(target.copy()), points.copy(), guess=guess)
        check_flow_result(result, points, stats_names_of(flow))
        return result

    def left_alone() -> None:
        flow = construct()
        reference, target = first.copy(), second.copy()
        require_unchanged(
            lambda: flow.track(flow.prepare(reference), flow.prepare(target), grid),
            reference,
            target,
            grid,
            what="an image, or the points,",
        )

    def outside() -> None:
        # beside the image, far from it, and at no place
        strange = np.array([[-5, 5], [1e6, 5], [np.nan, 5]], np.float32)
        valid = results(second, np.concatenate([grid, strange])).valid
        require(not valid[-3:].any(), "a point outside the reference image is valid in the target")

    return ConformanceReport.of("flow", construct).run_all(
        {
            "construction": lambda: require_methods(construct(), "prepare", "track"),
            "results": lambda: results(second, grid),
        },
        {
            "no points": lambda: results(second, grid[:0]),
            "points outside": outside,
            "guesses": lambda: results(second, grid, guess),
            "a small shift is found": lambda: _flow_finds_shift(results, first, grid),
            "images are left alone": left_alone,
            "determinism": lambda: _flow_determinism(construct, first, second, grid),
            **_on_hard_images(scene[0], lambda frame: results(grey(frame), grid)),
        },
    )


def check_flow_result(
    result: FlowResult, points: NDArray[np.float32], names: tuple[str, ...] = ()
) -> None:
    """Check the result of a flow.

    Args:
        result: What ``track`` returned.
        points: float32 ``[N, 2]``, the points in the reference image.
        names: The stats that the flow declares.

    Raises:
        ConformanceError: Something in it breaks the contract.
    """
    count = len(points)
    require(
        isinstance(result, FlowResult), f"track() gave a {type(result).__name__}, not a FlowResult"
    )
    require_arrays(
        result,
        {
            "xy": (np.float32, (count, 2)),
            "valid": (np.bool_, (count,)),
            "cost": (np.float32, (count,)),
        },
        cause="one row a point, in the order of the points",
    )
    missing = [name for name in names if name not in result.stats]
    require_all(
        (
            np.isfinite(result.xy[result.valid]).all(),
            "a valid row is not finite",
            "mark it as not valid",
        ),
        (not np.isnan(result.cost[result.valid]).any(), "a valid row has no cost"),
        (not missing, f"stats lack {missing}", "stats_names declares them"),
    )


def _grid(shape: tuple[int, ...], points: int) -> NDArray[np.float32]:
    """About so many points ``[N, 2]``, evenly spread, 40 pixels away from the image's edges."""
    across = max(2, int(np.sqrt(points * shape[1] / shape[0])))
    x, y = np.meshgrid(
        np.linspace(40, shape[1] - 41, across),
        np.linspace(40, shape[0] - 41, max(2, points // across)),
    )
    return np.stack([x, y], -1).reshape(-1, 2).astype(np.float32)


def _flow_determinism(
    construct: Callable[[], FlowEstimator], first: Image, second: Image, points: NDArray[np.float32]
) -> None:
    """Check that two flows with one seed give the same; rows that are not valid may differ."""
    # only valid rows are compared: the others mean nothing
    flows = construct(), construct()
    a, b = (flow.track(flow.prepare(first), flow.prepare(second), points, seed=7) for flow in flows)
    same_valid = np.array_equal(a.valid, b.valid)
    require(
        same_valid and np.array_equal(a.xy[a.valid], b.xy[b.valid]),
        "the same images and seed give another flow",
        "unseeded randomness, or state that outlives an image",
    )


def _flow_finds_shift(
    results: Callable[..., FlowResult], image: Image, points: NDArray[np.float32]
) -> None:
    """A flow from an image to the shifted image is that shift, for the median of its valid points."""
    # the image, moved by a known shift
    matrix = np.array([[1, 0, SHIFT_PX[0]], [0, 1, SHIFT_PX[1]]], np.float64)
    target = cv2.warpAffine(image, matrix, image.shape[::-1], borderMode=cv2.BORDER_REFLECT)
    result = results(np.asarray(target, np.uint8), points)
    # most of the points are found
    share = float(result.valid.mean())
    require(
        share > 0.2,
        f"only {100 * share:.0f} % of the points are found after a shift of {SHIFT_PX} pixels",
    )
    # and end where the shift has moved them
    errors = np.linalg.norm(result.xy - points - np.array(SHIFT_PX, np.float32), axis=1)
    error = float(np.median(errors[result.valid]))
    require(
        error < 1.0,
        f"after a shift of {SHIFT_PX} pixels the median error of the valid points is {error:.1f} px",
        "xy are positions in the target, x first, not displacements",
    )


def check_segmenter(
    construct: Callable[[], Segmenter], *, sequence: Sequence | None = None, frames: int = 2
) -> None:
    """Check that a segmenter keeps its contract.

    Args:
        construct: Builds a segmenter.
        sequence: Sequence whose frames are segmented; the built-in scene by default.
        frames: Number of frames.

    Raises:
        ConformanceError: Names every failed check, the fault and the likely cause.
    """
    segmenter_report(construct, sequence=sequence, frames=frames).raise_for_failures()


def segmenter_report(
    construct: Callable[[], Segmenter], *, sequence: Sequence | None = None, frames: int = 2
) -> ConformanceReport:
    """Run all checks of `check_segmenter` and report each."""
    scene = sequence if sequence is not None else CornerSequence(frames)
    inputs = [scene[index] for index in range(min(frames, len(scene)))]
    first = inputs[0]

    def results(*frames: Frame) -> None:
        segmenter = construct()
        for frame in frames:
            check_instances(segmenter.segment(frame), frame)

    return ConformanceReport.of("segmenter", construct).run_all(
        {
            "construction": lambda: require_methods(construct(), "segment"),
            "results": lambda: results(*inputs),
        },
        {
            "images are left alone": lambda: require_unchanged(
                lambda: construct().segment(first), first.rgb, first.depth, what="the frame"
            ),
            "determinism": lambda: _segmenter_determinism(construct, inputs),
            **_on_hard_images(first, results),
        },
    )


def check_instances(instances: Instances, frame: Frame) -> None:
    """Check the objects that a segmenter gave for one frame.

    Raises:
        ConformanceError: Something in it breaks the contract.
    """
    require(
        isinstance(instances, Instances),
        f"frame {frame.index}: segment() gave a {type(instances).__name__}, not Instances",
        "a frame without objects is Instances.empty(height, width)",
    )
    # masks, boxes and scores, one each an object
    where = f"frame {frame.index}: "
    boxes = instances.boxes
    scores = instances.scores
    count = len(instances.class_names)
    shape = frame.depth.shape
    require_arrays(
        instances,
        {"masks": (np.bool_, (count, *shape))},
        where,
        "masks have to be at the frame's resolution and thresholded",
    )
    require_arrays(
        instances, {"boxes": (np.float32, (count, 4)), "scores": (np.float32, (count,))}, where
    )
    require_all(
        (
            ((scores >= 0) & (scores <= 1)).all(),
            f"{where}a score lies outside [0, 1]",
            "logits, not scores",
        ),
        (
            all(isinstance(name, str) and name for name in instances.class_names),
            f"{where}a class has no name",
        ),
        (np.isfinite(boxes).all(), f"{where}a box is not finite"),
        (
            (boxes[:, :2] <= boxes[:, 2:]).all(),
            f"{where}a box ends before it begins",
            "boxes are x0, y0, x1, y1, not x, y, w, h",
        ),
        (
            instances.moving is None or instances.moving.shape == (count,),
            f"{where}moving does not fit the objects",
        ),
    )
    # the share of each mask's pixels that lie more than a pixel outside its box
    for mask, box, name in zip(instances.masks, boxes, instances.class_names, strict=True):
        rows, columns = np.nonzero(mask)
        within = (
            (columns >= box[0] - 1)
            & (columns <= box[2] + 1)
            & (rows >= box[1] - 1)
            & (rows <= box[3] + 1)
        )
        outside = 100 * (1 - float(within.mean())) if len(rows) else 0.0
        require(
            outside < 10,
            f"{where}{outside:.0f} % of the mask of a {name} lie outside its box",
            "boxes of another resolution, or y before x",
        )


def _segmenter_determinism(construct: Callable[[], Segmenter], frames: list[Frame]) -> None:
    """Two segmenters give the same objects on every frame."""
    first = construct()
    second = construct()
    for frame in frames:
        require_equal(
            first.segment(frame),
            second.segment(frame),
            ("masks", "scores", "class_names"),
            f"frame {frame.index} gives other objects when it is segmented again",
            "a network in training mode, or unseeded randomness",
        )
