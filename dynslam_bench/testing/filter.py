"""Conformance of dynamic feature filters."""

from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache, partial
from typing import get_args

import numpy as np

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
)
from dynslam_bench.geometry import se3
from dynslam_bench.testing.report import (
    ConformanceReport,
    require,
    require_all,
    require_arrays,
    require_equal,
    require_unchanged,
)
from dynslam_bench.testing.scenes import CornerSequence, grey

Steps = list[tuple[FrameBundle, FilterState]]
"""The frames of a sequence and the state that a filter gets with each."""
Change = Callable[[FrameBundle, FilterState], tuple[FrameBundle, FilterState]]
"""Makes a degenerate case of a frame and its state."""


def check_filter(construct: Callable[[], DynamicFilter]) -> None:
    """Check that a filter keeps its contract, with all its inputs and with many of them missing.

    Args:
        construct: Builds a filter.

    Raises:
        ConformanceError: Names every failed check, the fault and the likely cause.
    """
    filter_report(construct).raise_for_failures()


def filter_report(construct: Callable[[], DynamicFilter]) -> ConformanceReport:
    """Run all checks of `check_filter` and report each."""
    steps = filter_scene()

    def determinism() -> None:
        cause = "all randomness has to come from state.seed"
        _repeated(construct(), construct(), steps, "two runs differ", cause)

    def two_resets() -> None:
        candidate = construct()
        fault = "the verdict changes after a second reset()"
        cause = "reset() keeps something of the sequence before"
        _repeated(candidate, candidate, steps, fault, cause)

    degenerate = {
        name: partial(_run_changed, construct, steps, change)
        for name, change in _DEGENERATE.items()
    }
    return ConformanceReport.of("filter", construct).run_all(
        {
            "declaration": lambda: _declaration(construct()),
            "results": lambda: _run(construct(), steps),
        },
        {
            "declared stats": lambda: _declared_stats(construct(), steps),
            "frames are left alone": lambda: _left_alone(construct(), steps),
            "determinism": determinism,
            "two resets": two_resets,
            **degenerate,
        },
    )


@lru_cache(maxsize=2)
def filter_scene(frames: int = 4, *, points: int = 400) -> Steps:
    """Frames of the built-in scene with all inputs that a filter may use: exact flow, masks, poses and map points.

    Args:
        frames: How many frames.
        points: Keypoints a frame.

    Returns:
        Frame and state, in order; the first has no past. One object for equal arguments.
    """
    sequence = CornerSequence(frames)
    camera = sequence.camera
    truth = sequence.ground_truth
    masks = sequence.masks
    assert truth is not None
    assert masks is not None
    rng = np.random.default_rng(0)
    steps: Steps = []
    for index, pose in enumerate(truth.T_world_cam):
        frame = sequence[index]

        # keypoints at random positions; random descriptors, as filters do not match them
        xy = rng.uniform((20, 20), (camera.width - 20, camera.height - 20), (points, 2))
        column, row = np.rint(xy).astype(int).T
        keypoints = Keypoints(
            xy.astype(np.float32),
            np.zeros(points, np.int32),
            np.zeros(points, np.float32),
            np.ones(points, np.float32),
            rng.integers(0, 256, (points, 32), dtype=np.uint8),
        )

        # the panel as a person; its box is x0, y0, x1, y1
        mask = masks[index].instances == 1
        pixels = np.argwhere(mask)
        box = np.array([[*pixels.min(0)[::-1], *(pixels.max(0)[::-1] + 1)]], np.float32)
        instances = Instances(mask[None], box, ("person",), np.ones(1, np.float32))

        z = frame.depth[row, column]
        bundle = FrameBundle(
            index, frame.timestamp, frame.rgb, grey(frame), frame.depth, keypoints, xy, z, instances
        )
        state = FilterState(camera, np.ones(points, dtype=bool), seed=index)
        if steps:
            # flow into the frame before: each point, moved back with the panel, seen from there
            T_world_prev = truth.T_world_cam[index - 1]
            world = se3.transform(pose, camera.unproject(xy, z))
            world[mask[row, column], 0] -= 0.03  # metres that the panel moves in a frame
            flow = camera.project(se3.transform(se3.inverse(T_world_prev), world))
            inside = np.asarray(
                ((flow > 2) & (flow < (camera.width - 3, camera.height - 3))).all(axis=1)
            )
            cost = np.zeros(points, np.float32)
            state.flow = FlowResult(flow.astype(np.float32), inside, cost, {})

            # the past: the frame before, keyframes from the newest on, map points of the first
            state.previous_keep = np.ones(points, dtype=bool)
            state.previous = steps[-1][0]
            state.T_world_prev = T_world_prev
            state.T_world_pred = pose
            state.keyframes = tuple(
                KeyframeView(
                    truth.T_world_cam[past.index], past.keypoints, past.xy, past.z, past.depth
                )
                for past, _ in reversed(steps)
            )
            first = steps[0][0]
            map_xyz = se3.transform(truth.T_world_cam[0], camera.unproject(first.xy, first.z))
            state.map_points = (np.arange(points, dtype=np.int64), map_xyz)
        steps.append((bundle, state))
    return steps


def check_result(result: FilterResult, frame: FrameBundle) -> FilterResult:
    """Check a filter's verdict on one frame.

    Returns:
        The verdict.

    Raises:
        ConformanceError: Something in it breaks the contract.
    """
    where = f"frame {frame.index}: "
    count = (len(frame),)
    require(
        isinstance(result, FilterResult),
        f"{where}apply() gave a {type(result).__name__}, not a FilterResult",
    )
    require_arrays(
        result,
        {"keep": (np.bool_, count), "weight": (np.float32, count)},
        where,
        "the verdict is on all keypoints, not only on those that earlier filters kept",
    )
    weight = result.weight
    bad = {key: value for key, value in result.stats.items() if not np.isfinite(value)}
    require_all(
        (
            ((weight >= 0) & (weight <= 1)).all(),
            f"{where}a weight lies outside [0, 1] or is no number",
        ),
        (not bad, f"{where}stats hold values that are not finite: {bad}"),
    )
    if result.mask is not None:
        require_arrays(result, {"mask": (np.bool_, frame.depth.shape)}, where)
    return result


def _declaration(candidate: DynamicFilter) -> None:
    """A filter has a name and needs only what there is."""
    needs = get_args(Need)
    unknown = sorted(candidate.needs - set(needs))
    require_all(
        (isinstance(candidate.name, str) and candidate.name, f"the name is {candidate.name!r}"),
        (not unknown, f"unknown needs {unknown}", f"known are {', '.join(sorted(needs))}"),
    )


def _run(candidate: DynamicFilter, steps: Steps) -> list[FilterResult]:
    """Reset a filter, apply it frame by frame, and check every verdict."""
    candidate.reset(steps[0][1].camera)
    return [check_result(candidate.apply(frame, state), frame) for frame, state in steps]


def _run_changed(construct: Callable[[], DynamicFilter], steps: Steps, change: Change) -> None:
    _run(construct(), [change(frame, state) for frame, state in steps])


def _declared_stats(candidate: DynamicFilter, steps: Steps) -> None:
    """Every verdict has the statistics that the filter declares, and no others."""
    declared = set(getattr(candidate, "stats_names", DynamicFilter.stats_names))
    for index, result in enumerate(_run(candidate, steps)):
        given = set(result.stats)
        for fault, names in (("not declared", given - declared), ("missing", declared - given)):
            require(
                not names,
                f"frame {index}: stats {fault}: {sorted(names)}",
                "list them all in stats_names",
            )


def _left_alone(candidate: DynamicFilter, steps: Steps) -> None:
    """A filter changes neither images nor keypoints nor what earlier filters kept."""
    candidate.reset(steps[0][1].camera)
    for frame, state in steps:
        require_unchanged(
            partial(candidate.apply, frame, state),
            frame.rgb,
            frame.depth,
            frame.xy,
            frame.z,
            state.keep,
            what=f"frame {frame.index} or its state",
        )


def _repeated(
    first: DynamicFilter, second: DynamicFilter, steps: Steps, fault: str, cause: str
) -> None:
    """Run two filters, or one twice, which have to give the same."""
    verdicts = zip(_run(first, steps), _run(second, steps), strict=True)
    for index, (a, b) in enumerate(verdicts):
        require_equal(a, b, ("keep", "weight"), f"{fault} at frame {index}", cause)


def _without_flow(frame: FrameBundle, state: FilterState) -> tuple[FrameBundle, FilterState]:
    """A frame of which the flow has lost every keypoint."""
    if state.flow is None:
        return frame, state
    lost = np.full_like(state.flow.xy, np.nan)
    flow = FlowResult(lost, np.zeros(len(lost), bool), state.flow.cost, {})
    return frame, replace(state, flow=flow)


def _all_masked(frame: FrameBundle, state: FilterState) -> tuple[FrameBundle, FilterState]:
    """A frame with one person whose mask covers the image."""
    height, width = frame.depth.shape
    box = np.array([[0, 0, width, height]], np.float32)
    whole = Instances(np.ones((1, height, width), bool), box, ("person",), np.ones(1, np.float32))
    return replace(frame, instances=whole), state


def _few(count: int) -> Change:
    """Only the first keypoints of every frame."""

    def select(frame: FrameBundle) -> FrameBundle:
        return replace(
            frame,
            keypoints=frame.keypoints.select(np.arange(count)),
            xy=frame.xy[:count],
            z=frame.z[:count],
        )

    def change(frame: FrameBundle, state: FilterState) -> tuple[FrameBundle, FilterState]:
        keep = np.ones(count, dtype=bool)
        if state.flow is None or state.previous is None:
            return select(frame), replace(state, keep=keep)
        flow = FlowResult(
            state.flow.xy[:count],
            state.flow.valid[:count],
            state.flow.cost[:count],
            state.flow.stats,
        )
        return select(frame), replace(
            state, keep=keep, flow=flow, previous=select(state.previous), previous_keep=keep.copy()
        )

    return change


_DEGENERATE: dict[str, Change] = {
    "nothing known of the past": lambda frame, state: (
        frame,
        FilterState(state.camera, state.keep, seed=state.seed),
    ),
    "no valid flow": _without_flow,
    "no depth": lambda frame, state: (
        replace(frame, depth=np.zeros_like(frame.depth), z=np.zeros_like(frame.z)),
        state,
    ),
    "no segmenter": lambda frame, state: (replace(frame, instances=None), state),
    "no objects": lambda frame, state: (
        replace(frame, instances=Instances.empty(*frame.depth.shape)),
        state,
    ),
    "the whole image masked": _all_masked,
    "no keypoints": _few(0),
    "one keypoint": _few(1),
    "seven keypoints": _few(7),
    "nothing kept by earlier filters": lambda frame, state: (
        frame,
        replace(state, keep=np.zeros_like(state.keep)),
    ),
}
