"""Resident memory and frame time of systems over 10,000 frames of a rendered room, walked to and fro.

    python tests/benchmarks/backend_memory.py [--tracker orb-slam2 ...] [--frames 10000] [--loop
    300] [--size 640 480]

A Markdown table. Each tracker runs whole (features, masks, culling, tracking, mapping) in a process
of its own. The sequence's first `loop` frames are held in memory and played forwards and backwards
in turn, so that nothing but the tracker grows. Masks are the exact ones. With
``--size 160 120 --loop 60`` a frame costs a tenth, and what is kept of each frame shows just as
well.

Bars: less than 1 MB of growth a 1,000 frames after the first fifth, and in the end at most 1.2
times the frame time (processor time, median of a tenth of the frames) that it was at a tenth of the
way.
"""

import one_thread  # noqa: F401  # before all others

# isort: split
import multiprocessing
import os
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from command_line import parser_of

from dynslam_bench.contracts.sequence import FrameMasks, Sequence
from dynslam_bench.core.settings import field_names
from dynslam_bench.sequences import PreprocessingSettings, open_sequence
from dynslam_bench.trackers import TRACKERS, TrackerContext, build_tracker


class ToAndFro:
    """Frames and masks of a sequence, forwards and backwards without end."""

    def __init__(self, sequence: Sequence) -> None:
        self.frames = [sequence[index] for index in range(len(sequence))]
        self.masks = [sequence.masks[index] for index in range(len(sequence))]
        self.turns = [*range(len(self.frames)), *range(len(self.frames) - 2, 0, -1)]

    def __getitem__(self, index: int) -> FrameMasks:
        return self.masks[self.turns[index % len(self.turns)]]

    def frame(self, index: int) -> Any:
        """The frame of that number, stamped at 30 Hz."""
        return replace(
            self.frames[self.turns[index % len(self.turns)]], index=index, timestamp=index / 30
        )


def resident_mb() -> float:
    """Resident memory of this process in MB (Linux)."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6


def walk(tracker_id: str, sequence: Sequence, frames: int) -> None:
    """Track so many frames, print the memory twenty times, and a row of the table."""
    cv2.setNumThreads(1)
    torch.set_num_threads(1)
    source = ToAndFro(sequence)
    has_masks = "segmentation.source" in field_names(TRACKERS.get(tracker_id).settings)
    overrides = {"segmentation.source": "oracle"} if has_masks else {}
    tracker = build_tracker(
        tracker_id, overrides, TrackerContext(sequence_id=sequence.id, masks=source)
    )
    tracker.reset(sequence.camera, rng=np.random.default_rng(0))
    marks: list[tuple[int, float]] = []
    lost = 0
    spent = np.zeros(frames)
    step = max(1, frames // 20)
    for index in range(frames):
        frame = source.frame(index)
        begin = time.process_time()
        lost += tracker.track(frame).state != "ok"
        spent[index] = 1e3 * (time.process_time() - begin)
        if index % step == step - 1:
            marks.append((index + 1, resident_mb()))
            sys.stderr.write(
                f"{tracker_id}  frame {index + 1:6d}  {marks[-1][1]:7.1f} MB  {lost} lost  "
                f"{np.median(spent[index + 1 - step : index + 1]):.1f} ms a frame\n"
            )
    late = np.array([mark for mark in marks if mark[0] >= frames / 5])
    slope = 1e3 * float(np.polyfit(late[:, 0], late[:, 1], 1)[0])
    early, late_ms = (
        float(np.median(spent[end - 2 * step : end]))
        for end in (max(frames // 10, 2 * step), frames)
    )
    print(
        f"| {tracker_id} | {frames} | {lost} | {marks[-1][1]:.1f} | {slope:.3f} | {early:.2f} | {late_ms:.2f} "
        f"| {late_ms / early:.3f} |",
        flush=True,
    )


def main() -> None:
    """Print a row a tracker."""
    parser = parser_of(__doc__, tracker=["orb-slam2"], frames=10000, loop=300)
    parser.add_argument("--size", type=int, nargs=2, default=(640, 480))
    options = parser.parse_args()
    sequence = open_sequence(
        "synthetic/sitting_xyz",
        frames=(0, options.loop),
        preprocessing=PreprocessingSettings(width=options.size[0], height=options.size[1]),
    )
    head = (
        "tracker",
        "frames",
        "lost",
        "MB in the end",
        "MB per 1,000 frames",
        "ms early",
        "ms late",
        "late : early",
    )
    # before the processes copy it
    print(f"| {' | '.join(head)} |\n| ---{' | ---:' * (len(head) - 1)} |", flush=True)
    for tracker in options.tracker:
        process = multiprocessing.get_context("fork").Process(
            target=walk, args=(tracker, sequence, options.frames)
        )
        process.start()
        process.join()


if __name__ == "__main__":
    main()
