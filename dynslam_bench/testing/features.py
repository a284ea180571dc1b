"""Conformance of feature extractors."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.contracts.features import FeatureExtractor, Keypoints, MaskedExtractor
from dynslam_bench.geometry.pixels import inside

from .report import ConformanceReport, NotApplicable, require
from .scenes import CornerSequence, grey, hard_frames


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
    if not report.run("construction", lambda: _construct(construct)):
        return report
    if not report.run("results", lambda: _results(construct(), images[0], descriptor_bytes, least=20)):
        return report
    report.run("images are left alone", lambda: _left_alone(construct(), images[0]))
    report.run("determinism", lambda: _determinism(construct, images))
    report.run("beside a mask", lambda: _beside(construct(), images[0]))
    for name, frame in hard_frames(scene[0]).items():
        image = grey(frame)
        report.run(
            f"{name} image",
            lambda image=image: _results(construct(), image, descriptor_bytes),  # type: ignore[misc]
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


def _construct(construct: Callable[[], FeatureExtractor]) -> None:
    extractor = construct()
    require(callable(getattr(extractor, "extract", None)), f"a {type(extractor).__name__} lacks extract()")


def _results(
    extractor: FeatureExtractor, image: NDArray[np.uint8], descriptor_bytes: int | None, least: int = 0
) -> None:
    found = extractor.extract(image.copy())
    check_keypoints(found, image.shape, descriptor_bytes)
    require(len(found) >= least, f"only {len(found)} keypoints in a textured image")


def _left_alone(extractor: FeatureExtractor, image: NDArray[np.uint8]) -> None:
    given = image.copy()
    extractor.extract(given)
    require(np.array_equal(given, image), "the image was changed", "an operation in place")


def _determinism(construct: Callable[[], FeatureExtractor], images: list[NDArray[np.uint8]]) -> None:
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
        raise NotApplicable("it has no extract_beside(): features on people take the place of others")
    mask = np.zeros(image.shape, bool)
    mask[:, : image.shape[1] * 3 // 4] = True
    found, usual = extractor.extract_beside(image, mask, 1.0), extractor.extract(image)
    check_keypoints(found, image.shape)

    there, before = (int((~inside(mask, points.xy)).sum()) for points in (found, usual))
    require(there >= before, f"{there} keypoints beside the mask, {before} without asking for any")
