"""Time of the sparse flow by budget and thread count, or of the dense flow.

    PYTHONPATH=. python tests/benchmarks/flow_speed.py [--repeats 40] [--dense]

1,000 points, 640x480. Minimum and median over repeats; pyramidal Lucas-Kanade on the same points is
the reference for machines that are not idle: the ratio to it survives a busy neighbour, the
milliseconds do not.
"""

from collections.abc import Callable

import cv2
import numpy as np
from command_line import parser_of, timed
from flow_data import DENSE_SEARCHES, corners, synthetic

from dynslam_bench.contracts.flow import FlowEstimator
from dynslam_bench.flow.registry import build_flow
from dynslam_bench.flow.settings import FlowSettings

LUCAS_KANADE = FlowSettings(method="lucas-kanade", forward_backward_px=0.0)


def one_frame(
    flow: FlowEstimator, first: np.ndarray, second: np.ndarray, points: np.ndarray
) -> Callable[[], object]:
    """What a tracker does each frame: prepare the new image, track from the old one."""
    reference = flow.prepare(first)
    return lambda: flow.track(reference, flow.prepare(second), points)


def a_thousand(reference: np.ndarray) -> np.ndarray:
    """1,000 keypoints of an image, repeated where it has fewer."""
    points = corners(reference, 4000)
    return np.concatenate([points] * (1 + 1000 // len(points)))[:1000]


def dense_table(first: np.ndarray, second: np.ndarray, points: np.ndarray, repeats: int) -> None:
    """Time of a frame with each search of the dense flow and with Lucas-Kanade, in turns."""
    flows = {("Lucas-Kanade, 4 levels, one way", 1): build_flow(LUCAS_KANADE)}
    flows |= {
        (name, n): build_flow(each, threads=n)
        for n in (1, 2)
        for name, each in DENSE_SEARCHES.items()
    }
    frames = {key: one_frame(flow, first, second, points) for key, flow in flows.items()}
    taken: dict[tuple[str, int], list[float]] = {key: [] for key in frames}
    for _ in range(repeats):
        for key, frame in frames.items():
            taken[key] += timed(frame, 1)[0]
    print("| dense flow, both ways | threads | min ms | median ms |\n| --- | --- | --- | --- |")
    for (name, threads), wall in taken.items():
        print(f"| {name} | {threads} | {min(wall):.0f} | {np.median(wall):.0f} |")


def main() -> None:
    """Print all tables."""
    options = parser_of(None, repeats=40, dense=False).parse_args()
    cv2.setNumThreads(1)
    pair = synthetic(("similarity",), 3)[-1]
    images = pair.reference, pair.target, a_thousand(pair.reference)
    if options.dense:
        dense_table(*images, options.repeats)
        return
    wall, processor = timed(one_frame(build_flow(LUCAS_KANADE), *images), options.repeats)
    reference = min(processor)
    print(
        "| method, budget | threads | min ms | median ms | processor ms | ratio to LK | % < 1.5 px |"
    )
    print("| --- | --- | --- | --- | --- | --- | --- |")
    print(
        f"| Lucas-Kanade, 4 levels, one way | 1 | {min(wall):.1f} | {np.median(wall):.1f} | {reference:.1f} | 1 | |"
    )
    rows = [FlowSettings(budget=budget) for budget in (24, 48, 64, 96, 192, 384)]
    rows += [
        FlowSettings(search="patchmatch"),
        FlowSettings(forward_backward_px=0.0),
        FlowSettings(refinement="none"),
    ]
    for settings in rows:
        for threads in (1, 2):
            flow = build_flow(settings, threads=threads)
            wall, processor = timed(one_frame(flow, *images), options.repeats)
            good = (
                100
                * (
                    np.hypot(
                        *(
                            flow.track(
                                flow.prepare(pair.reference), flow.prepare(pair.target), pair.points
                            ).xy
                            - pair.truth
                        ).T
                    )
                    < 1.5
                ).mean()
            )
            note = ", ".join(
                f"{k}={v}"
                for k, v in settings.model_dump().items()
                if v != getattr(FlowSettings(), k)
            )
            cost = (
                f"{min(processor):.1f} | {min(processor) / reference:.2f}"
                if threads == 1
                else "- | -"
            )
            print(
                f"| {note or 'default'} | {threads} | {min(wall):.1f} | {np.median(wall):.1f} | {cost} | {good:.1f} |",
                flush=True,
            )


if __name__ == "__main__":
    main()
