"""Conformance of optical flows."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray

from dynslam_bench.contracts.flow import FlowEstimator, FlowResult, stats_names_of

from .report import ConformanceReport, require
from .scenes import CornerSequence, grey, hard_frames

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
    if not report.run("construction", lambda: _construct(construct)):
        return report
    if not report.run("results", lambda: _results(construct(), first, second, grid)):
        return report
    report.run("images are left alone", lambda: _left_alone(construct(), first, second, grid))
    report.run("no points", lambda: _results(construct(), first, second, grid[:0]))
    report.run("points outside", lambda: _outside(construct(), first, second, grid))
    report.run("guesses", lambda: _guesses(construct(), first, second, grid))
    report.run("determinism", lambda: _determinism(construct, first, second, grid))
    report.run("a small shift is found", lambda: _shift(construct(), first, grid))
    for name, frame in hard_frames(scene[0]).items():
        image = grey(frame)
        report.run(f"{name} image", lambda image=image: _results(construct(), first, image, grid))  # type: ignore[misc]
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


def _construct(construct: Callable[[], FlowEstimator]) -> None:
    flow = construct()
    for name in ("prepare", "track"):
        require(callable(getattr(flow, name, None)), f"a {type(flow).__name__} lacks {name}()")


def _results(
    flow: FlowEstimator, first: NDArray[np.uint8], second: NDArray[np.uint8], points: NDArray[np.float32]
) -> None:
    found = flow.track(flow.prepare(first.copy()), flow.prepare(second.copy()), points.copy())
    check_flow_result(found, points, stats_names_of(flow))


def _left_alone(
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


def _determinism(
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
