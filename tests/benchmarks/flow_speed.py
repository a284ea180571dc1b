"""Time of the sparse flow by budget and thread count, and of the dense flow.

    PYTHONPATH=. python tests/benchmarks/flow_speed.py [--repeats 40]

1,000 points, 640x480. Minimum and median over repeats; pyramidal Lucas-Kanade on the same points is the yardstick
for machines that are not idle: the ratio to it survives a busy neighbour, the milliseconds do not.
"""

import time
from collections.abc import Callable

import cv2
import numpy as np
from command_line import parser_of
from flow_data import corners, synthetic

from dynslam_bench.contracts.flow import FlowEstimator
from dynslam_bench.flow.dense_flow import DenseDaisyFlow
from dynslam_bench.flow.registry import build_flow
from dynslam_bench.flow.settings import FlowSettings


def timed(function: Callable[[], object], repeats: int) -> tuple[float, float, float, float]:
    """Minimum and median wall time, minimum and median processor time of the calling thread, in milliseconds."""
    wall, processor = [], []
    function()
    for _ in range(repeats):
        start, used = time.perf_counter(), time.thread_time()
        function()
        wall.append(time.perf_counter() - start)
        processor.append(time.thread_time() - used)
    return 1e3 * min(wall), 1e3 * float(np.median(wall)), 1e3 * min(processor), 1e3 * float(np.median(processor))


def one_frame(flow: FlowEstimator, first: np.ndarray, second: np.ndarray, points: np.ndarray) -> Callable[[], object]:
    """What a tracker does each frame: prepare the new image, track from the old one."""
    reference = flow.prepare(first)
    return lambda: flow.track(reference, flow.prepare(second), points)


def a_thousand(reference: np.ndarray) -> np.ndarray:
    """1,000 keypoints of an image, repeated where it has fewer."""
    points = corners(reference, 4000)
    return np.concatenate([points] * (1 + 1000 // len(points)))[:1000]


def main() -> None:
    """Print all tables."""
    parser = parser_of(None, repeats=40)
    options = parser.parse_args()
    repeats = options.repeats
    cv2.setNumThreads(1)
    pair = synthetic(("similarity",), 3)[-1]
    first, second = pair.reference, pair.target
    points = a_thousand(first)
    lucas_kanade = FlowSettings(method="lucas-kanade", forward_backward_px=0.0)
    yardstick = timed(one_frame(build_flow(lucas_kanade), first, second, points), repeats)
    print("| method, budget | threads | min ms | median ms | processor ms | ratio to LK | % < 1.5 px |")
    print("| --- | --- | --- | --- | --- | --- | --- |")
    print(
        f"| Lucas-Kanade, 4 levels, one way | 1 | {yardstick[0]:.1f} | {yardstick[1]:.1f} | {yardstick[2]:.1f} | 1 | |"
    )
    rows = [FlowSettings(budget=budget) for budget in (24, 48, 64, 96, 192, 384)]
    rows += [FlowSettings(search="patchmatch"), FlowSettings(forward_backward_px=0.0), FlowSettings(refinement="none")]
    for settings in rows:
        for threads in (1, 2):
            flow = build_flow(settings, threads=threads)
            took = timed(one_frame(flow, first, second, points), repeats)
            result = flow.track(flow.prepare(first), flow.prepare(second), pair.points)
            good = 100 * (np.hypot(*(result.xy - pair.truth).T) < 1.5).mean()
            note = (
                "default"
                if settings == FlowSettings()
                else ", ".join(f"{k}={v}" for k, v in settings.model_dump().items() if v != getattr(FlowSettings(), k))
            )
            cost = f"{took[2]:.1f} | {took[2] / yardstick[2]:.2f}" if threads == 1 else "- | -"
            print(f"| {note} | {threads} | {took[0]:.1f} | {took[1]:.1f} | {cost} | {good:.1f} |", flush=True)
    print("\n| dense, both ways | min ms | median ms |\n| --- | --- | --- |")
    for threads in (1, 2):
        dense = DenseDaisyFlow(threads=threads)
        took = timed(lambda dense=dense: dense.flow(dense.prepare(first), dense.prepare(second)), 3)
        print(f"| {threads} thread{'s'[: threads - 1]} | {took[0]:.0f} | {took[1]:.0f} |", flush=True)


if __name__ == "__main__":
    main()
