"""Conformance of dynamic feature filters."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, get_args

import cv2
import numpy as np
from numpy.typing import NDArray

from dynslam_bench.contracts import (
    DynamicFilter,
    FilterResult,
    FilterState,
    FlowResult,
    FrameBundle,
    Instances,
    KeyframeView,
    Keypoints,
    Need,
    Provenance,
)
from dynslam_bench.geometry import se3
from dynslam_bench.testing.report import ConformanceReport, require
from dynslam_bench.testing.scenes import CornerSequence

NEEDS: frozenset[str] = frozenset(get_args(Need))


@dataclass(frozen=True, eq=False)
class FilterScene:
    """Consecutive frames of the built-in scene with everything that a filter may be told.

    Attributes:
        steps: Frame and state, in order; the first has no past.
        moving: For each step, which keypoints lie on the moving panel, bool ``[N]``.
    """

    steps: list[tuple[FrameBundle, FilterState]]
    moving: list[NDArray[np.bool_]]


def check_filter(construct: Callable[[], DynamicFilter]) -> None:
    """Check that a filter keeps its contract, with everything it may be told and with much of it missing.

    Args:
        construct: Builds a filter.

    Raises:
        ConformanceError: Names every failed check, what was found and the likely cause.
    """
    filter_report(construct).raise_for_failures()


def filter_report(construct: Callable[[], DynamicFilter]) -> ConformanceReport:
    """Run all checks of `check_filter` and report each."""
    scene = filter_scene()
    report = ConformanceReport(f"filter {getattr(construct, '__name__', type(construct).__name__)!r}")
    if not report.run("declaration", lambda: _declaration(construct())):
        return report
    if not report.run("results", lambda: _apply_all(construct(), scene.steps)):
        return report
    report.run("declared stats", lambda: _declared_stats(construct(), scene.steps))
    report.run("same keys on every frame", lambda: _keys(construct(), scene.steps))
    report.run("frames are left alone", lambda: _left_alone(construct(), scene.steps))
    report.run("determinism", lambda: _determinism(construct, scene.steps))
    report.run("two resets", lambda: _two_resets(construct(), scene.steps))
    for name, change in _DEGENERATE.items():
        steps = [change(frame, state) for frame, state in scene.steps]
        report.run(name, lambda steps=steps: _apply_all(construct(), steps))  # type: ignore[misc]
    return report


@lru_cache(maxsize=2)
def filter_scene(frames: int = 4, *, points: int = 400, seed: int = 0) -> FilterScene:
    """Frames, exact flow, exact masks and true poses of the built-in scene; one object for equal arguments.

    Args:
        frames: How many frames.
        points: Keypoints a frame.
        seed: Where they lie.
    """
    sequence = CornerSequence(frames)
    camera, truth, source = sequence.camera, sequence.ground_truth, sequence.masks
    assert truth is not None and source is not None
    rng = np.random.default_rng(seed)
    bundles, moving = [], []
    for index in range(frames):
        frame = sequence[index]
        xy = rng.uniform((20, 20), (camera.width - 20, camera.height - 20), (points, 2))
        column, row = np.rint(xy).astype(int).T
        mask = source[index].instances == 1
        box = np.array([[*np.argwhere(mask).min(0)[::-1], *(np.argwhere(mask).max(0)[::-1] + 1)]], np.float32)
        bundles.append(
            FrameBundle(
                index,
                frame.timestamp,
                frame.rgb,
                cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2GRAY).astype(np.uint8),
                frame.depth,
                _keypoints(xy, rng),
                xy,
                frame.depth[row, column],
                Instances(mask[None], box, ("person",), np.ones(1, np.float32)),
            )
        )
        moving.append(mask[row, column])
    steps = []
    for index, bundle in enumerate(bundles):
        state = FilterState(camera, np.ones(points, dtype=bool), seed=index)
        pose = truth.T_world_cam[index]
        if index:
            before = bundles[index - 1]
            world = se3.transform(pose, camera.unproject(bundle.xy, bundle.z))
            world[moving[index], 0] -= 0.03  # the panel's own motion
            xy = camera.project(se3.transform(se3.inverse(truth.T_world_cam[index - 1]), world))
            inside = np.asarray(((xy > 2) & (xy < (camera.width - 3, camera.height - 3))).all(axis=1))
            state.flow = FlowResult(xy.astype(np.float32), inside, np.zeros(points, np.float32), {})
            state.previous, state.previous_keep = before, np.ones(points, dtype=bool)
            state.T_world_prev, state.T_world_pred = truth.T_world_cam[index - 1], pose
            state.keyframes = tuple(
                KeyframeView(truth.T_world_cam[k], bundles[k].keypoints, bundles[k].xy, bundles[k].z, bundles[k].depth)
                for k in range(index - 1, -1, -1)
            )
            points_world = se3.transform(truth.T_world_cam[0], camera.unproject(bundles[0].xy, bundles[0].z))
            state.map_points = (np.arange(points, dtype=np.int64), points_world)
        steps.append((bundle, state))
    return FilterScene(steps, moving)


def check_result(result: FilterResult, frame: FrameBundle) -> None:
    """Check a filter's verdict on one frame.

    Raises:
        ConformanceError: Something in it breaks the contract.
    """
    at, count = f"frame {frame.index}", len(frame)
    require(isinstance(result, FilterResult), f"{at}: apply() gave a {type(result).__name__}, not a FilterResult")
    keep, weight = result.keep, result.weight
    found = f"{at}: keep is {keep.dtype} {keep.shape}, expected bool {(count,)}"
    cause = "the verdict is on all keypoints, not only on those that earlier filters kept"
    require(keep.dtype == np.bool_ and keep.shape == (count,), found, cause)
    found = f"{at}: weight is {weight.dtype} {weight.shape}, expected float32 {(count,)}"
    require(weight.dtype == np.float32 and weight.shape == (count,), found)
    require(((weight >= 0) & (weight <= 1)).all(), f"{at}: a weight lies outside [0, 1] or is no number")
    bad = {key: value for key, value in result.stats.items() if not np.isfinite(value)}
    require(not bad, f"{at}: stats hold values that are not finite: {bad}")
    mask = result.mask
    if mask is not None:
        found = f"{at}: the mask is {mask.dtype} {mask.shape}, expected bool {frame.depth.shape}"
        require(mask.dtype == np.bool_ and mask.shape == frame.depth.shape, found)


def _declaration(candidate: DynamicFilter) -> None:
    require(isinstance(candidate.name, str) and candidate.name, f"the name is {candidate.name!r}")
    unknown = set(candidate.needs) - NEEDS
    require(not unknown, f"unknown needs {sorted(unknown)}", f"known are {', '.join(sorted(NEEDS))}")
    known = get_args(Provenance)
    require(candidate.provenance in known, f"provenance is {candidate.provenance!r}", f"one of {', '.join(known)}")


def _run(candidate: DynamicFilter, steps: list[tuple[FrameBundle, FilterState]]) -> list[FilterResult]:
    candidate.reset(steps[0][1].camera)
    results = []
    for frame, state in steps:
        result = candidate.apply(frame, state)
        check_result(result, frame)
        results.append(result)
    return results


def _apply_all(candidate: DynamicFilter, steps: list[tuple[FrameBundle, FilterState]]) -> None:
    _run(candidate, steps)


def _declared_stats(candidate: DynamicFilter, steps: list[tuple[FrameBundle, FilterState]]) -> None:
    declared = set(getattr(candidate, "stats_names", DynamicFilter.stats_names))
    for result, (frame, _) in zip(_run(candidate, steps), steps, strict=True):
        for found, wrong in (("not declared", set(result.stats) - declared), ("missing", declared - set(result.stats))):
            require(not wrong, f"frame {frame.index}: stats {found}: {sorted(wrong)}", "list them all in stats_names")


def _keys(candidate: DynamicFilter, steps: list[tuple[FrameBundle, FilterState]]) -> None:
    results = _run(candidate, steps)
    for result, (frame, _) in zip(results, steps, strict=True):
        changed = set(result.stats) ^ set(results[0].stats)
        require(not changed, f"frame {frame.index}: stats have other keys than on frame 0: {sorted(changed)}")


def _left_alone(candidate: DynamicFilter, steps: list[tuple[FrameBundle, FilterState]]) -> None:
    candidate.reset(steps[0][1].camera)
    for frame, state in steps:
        after: list[NDArray[Any]] = [frame.rgb, frame.depth, frame.xy, frame.z, state.keep]
        before = [array.copy() for array in after]
        candidate.apply(frame, state)
        same = all(np.array_equal(a, b) for a, b in zip(before, after, strict=True))
        require(same, f"frame {frame.index} or its state was changed", "work on a copy, return the verdict")


def _determinism(construct: Callable[[], DynamicFilter], steps: list[tuple[FrameBundle, FilterState]]) -> None:
    _same(
        _run(construct(), steps),
        _run(construct(), steps),
        "two runs differ",
        "all randomness has to come from state.seed",
    )


def _two_resets(candidate: DynamicFilter, steps: list[tuple[FrameBundle, FilterState]]) -> None:
    first = _run(candidate, steps)
    _same(
        first, _run(candidate, steps), "the verdict changes after a second reset()", "reset() leaves something behind"
    )


def _same(first: list[FilterResult], second: list[FilterResult], found: str, cause: str) -> None:
    for index, (a, b) in enumerate(zip(first, second, strict=True)):
        same = np.array_equal(a.keep, b.keep) and np.array_equal(a.weight, b.weight)
        require(same, f"{found} at frame {index}", cause)


def _keypoints(xy: NDArray[np.float64], rng: np.random.Generator) -> Keypoints:
    count = len(xy)
    return Keypoints(
        xy.astype(np.float32),
        np.zeros(count, np.int32),
        np.zeros(count, np.float32),
        np.ones(count, np.float32),
        rng.integers(0, 256, (count, 32), dtype=np.uint8),
    )


Change = Callable[[FrameBundle, FilterState], tuple[FrameBundle, FilterState]]


def _without_past(frame: FrameBundle, state: FilterState) -> tuple[FrameBundle, FilterState]:
    return frame, FilterState(state.camera, state.keep, seed=state.seed)


def _without_flow(frame: FrameBundle, state: FilterState) -> tuple[FrameBundle, FilterState]:
    if state.flow is None:
        return frame, state
    lost = np.full_like(state.flow.xy, np.nan)
    return frame, replace(state, flow=FlowResult(lost, np.zeros(len(lost), bool), state.flow.cost, {}))


def _without_depth(frame: FrameBundle, state: FilterState) -> tuple[FrameBundle, FilterState]:
    return replace(frame, depth=np.zeros_like(frame.depth), z=np.zeros_like(frame.z)), state


def _without_masks(frame: FrameBundle, state: FilterState) -> tuple[FrameBundle, FilterState]:
    return replace(frame, instances=None), state


def _with_empty_masks(frame: FrameBundle, state: FilterState) -> tuple[FrameBundle, FilterState]:
    return replace(frame, instances=Instances.empty(*frame.depth.shape)), state


def _all_masked(frame: FrameBundle, state: FilterState) -> tuple[FrameBundle, FilterState]:
    height, width = frame.depth.shape
    box = np.array([[0, 0, width, height]], np.float32)
    whole = Instances(np.ones((1, height, width), bool), box, ("person",), np.ones(1, np.float32))
    return replace(frame, instances=whole), state


def _select(frame: FrameBundle, index: NDArray[np.intp]) -> FrameBundle:
    return replace(frame, keypoints=frame.keypoints.select(index), xy=frame.xy[index], z=frame.z[index])


def _few(count: int) -> Change:
    def change(frame: FrameBundle, state: FilterState) -> tuple[FrameBundle, FilterState]:
        index = np.arange(count)
        flow = state.flow
        if flow is not None:
            flow = FlowResult(flow.xy[index], flow.valid[index], flow.cost[index], flow.stats)
        previous = None if state.previous is None else _select(state.previous, index)
        kept = None if previous is None else np.ones(count, dtype=bool)
        return _select(frame, index), replace(
            state, keep=np.ones(count, dtype=bool), flow=flow, previous=previous, previous_keep=kept
        )

    return change


def _nothing_kept(frame: FrameBundle, state: FilterState) -> tuple[FrameBundle, FilterState]:
    return frame, replace(state, keep=np.zeros_like(state.keep))


_DEGENERATE: dict[str, Change] = {
    "nothing known of the past": _without_past,
    "no valid flow": _without_flow,
    "no depth": _without_depth,
    "no segmenter": _without_masks,
    "no objects": _with_empty_masks,
    "the whole image masked": _all_masked,
    "no keypoints": _few(0),
    "one keypoint": _few(1),
    "seven keypoints": _few(7),
    "nothing kept by earlier filters": _nothing_kept,
}
