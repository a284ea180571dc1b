"""Trackers with masks at several image sizes: coverage, errors, and frames that are `ok` and far off.

    python tests/benchmarks/mask_resolution.py
    python tests/benchmarks/mask_resolution.py --record before.json      # in another checkout, then here:
    python tests/benchmarks/mask_resolution.py --record after.json
    python tests/benchmarks/mask_resolution.py --before before.json --after after.json

Every walking replica is rendered at 640x480, resized by the preprocessing, and run on every frame and on every second
one. Cases:

* plain: the scene as it is;
* false: beside the people, a rectangle of 16 % of the image is masked, at a place that changes every fifth frame;
* filled: for ten frames a person, cut out and enlarged, fills all but the image's right edge, and moves;
* filled first: the same from the first frame on.

The last three have exact masks. A frame is far off if it is `ok` and its camera centre lies more than 100 mm from the
true one, estimate and truth joined at the first frame that is `ok`. ATE is the online one of tracked frames, in mm
under tum-rgbd/v1. With a record of before and after, errors are paired by run; the null pairs runs of `--after` that
begin at the first frame with those that begin at another.
"""

import one_thread  # noqa: F401  # before all others

# isort: split
import argparse
import itertools
import json
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pandas as pd
from command_line import parser_of

from dynslam_bench.contracts.sequence import Frame, FrameMasks
from dynslam_bench.core.settings import parse_assignments
from dynslam_bench.evaluation import evaluate
from dynslam_bench.evaluation.online import OnlineError
from dynslam_bench.geometry import Trajectory
from dynslam_bench.sequences import open_sequence
from dynslam_bench.sequences.preprocessing import resize
from dynslam_bench.trackers import TrackerContext, build_tracker

FAMILIES = ("xyz", "halfsphere", "rpy", "static")
TRACKERS = (
    "mask-rcnn",
    "mask-rcnn segmentation.source=oracle",
    "dynaslam segmentation.source=oracle",
    "emfoa-oft segmentation.source=oracle",
    "orb-slam2",
)
WITHOUT_MASKS = ("orb-slam2", "emfoa-oft?masks=none")
FRAMES = 40
"""Frames of a run."""
FAR_M = 0.1
"""A camera centre farther from the true one is far off."""
FALSE_SIDE = 0.4
"""Sides of the false mask as shares of the image's: 16 % of its area."""
FALSE_FRAMES = 5
"""Frames that a false mask stays at its place."""
FILLED_FRAMES = 10
"""Frames that the enlarged person stays."""
FILLED_FROM = {"filled": 20, "filled first": 0}
"""First frame that shows the enlarged person."""
FILLED_SHARE = 0.95
"""Share of the image's width that the enlarged person covers."""
FILLED_M = 0.7
"""Depth of the enlarged person, metres."""
FILLED_STEP = 0.01
"""Motion of the enlarged person in a frame, as a share of the image's width."""
OTHER_INSTANCE = 250
"""Number of the false or enlarged object."""
CASES = ("plain", "false", *FILLED_FROM)
NO_ERROR_M = 1.0
"""Error of a run without a tracked pose, metres; it bounds all others."""


RUN = ("tracker", "case", "size", "family", "scene", "stride", "start")
"""What names a run."""


class Clip:
    """Frames of a rendered sequence at one size, with their masks; a sequence as trackers take it.

    Args:
        name: Id of the sequence.
        start: First frame.
        stride: Step between frames.
    """

    def __init__(self, name: str, start: int, stride: int) -> None:
        base = open_sequence(name, frames=(start, start + FRAMES * stride), stride=stride)
        assert base.masks is not None
        self.id = base.id
        self.camera = base.camera
        self.truth = base.ground_truth
        self.stamps = base.timestamps
        self.frames = [base[index] for index in range(len(base))]
        self.masks = [base.masks[index] for index in range(len(base))]

    def resized(self, width: int, height: int) -> "Clip":
        """The frames in another size."""
        clip = object.__new__(Clip)
        vars(clip).update(vars(self))
        clip.camera = self.camera.resized(width, height)
        clip.frames = []
        clip.masks = []
        for frame, masks in zip(self.frames, self.masks, strict=True):
            rgb = resize(frame.rgb, width, height, colour=True)
            depth = resize(frame.depth, width, height, colour=False)
            instances = resize(masks.instances, width, height, colour=False)
            clip.frames.append(replace(frame, rgb=rgb, depth=depth))
            clip.masks.append(replace(masks, instances=instances))
        return clip

    def in_case(self, case: str) -> "Clip":
        """The frames with a false mask, or with a person that fills the image."""
        if case == "plain":
            return self
        clip = object.__new__(Clip)
        vars(clip).update(vars(self))
        if case == "false":
            clip.masks = [_with_false_mask(masks, k) for k, masks in enumerate(self.masks)]
            return clip
        clip.frames = list(self.frames)
        clip.masks = list(self.masks)
        person = _largest_person(self.frames, self.masks)
        first = FILLED_FROM[case]
        for k in range(first, first + FILLED_FRAMES):
            clip.frames[k], clip.masks[k] = _filled(self.frames[k], self.masks[k], person, k)
        return clip


def _with_false_mask(masks: FrameMasks, index: int) -> FrameMasks:
    """The masks of a frame and the false one, which lies behind them."""
    height, width = masks.instances.shape
    x, y = np.random.default_rng(index // FALSE_FRAMES).random(2) * (1 - FALSE_SIDE)
    rows = slice(round(y * height), round((y + FALSE_SIDE) * height))
    columns = slice(round(x * width), round((x + FALSE_SIDE) * width))
    instances = masks.instances.copy()
    part = instances[rows, columns]
    part[part == 0] = OTHER_INSTANCE
    return FrameMasks(
        instances, masks.class_names | {OTHER_INSTANCE: "person"}, masks.moving | {OTHER_INSTANCE}
    )


def _largest_person(frames: list[Frame], masks: list[FrameMasks]) -> np.ndarray:
    """The colours of the largest person of all frames, in its box without the border."""
    best = np.zeros((0, 0, 3), np.uint8)
    for frame, frame_masks in zip(frames, masks, strict=True):
        for number, name in frame_masks.class_names.items():
            rows, columns = np.nonzero(frame_masks.instances == number)
            if name != "person" or len(rows) < 100:
                continue
            # the middle half of its box is nearly all person
            top, bottom = np.quantile(rows, (0.25, 0.75)).astype(int)
            left, right = np.quantile(columns, (0.25, 0.75)).astype(int)
            patch = frame.rgb[top : bottom + 1, left : right + 1]
            if patch.size > best.size:
                best = patch
    assert best.size
    return best


def _filled(
    frame: Frame, masks: FrameMasks, person: np.ndarray, index: int
) -> tuple[Frame, FrameMasks]:
    """The frame with the person before all of it but its right edge; the person moves with the index."""
    height, width = masks.instances.shape
    # enlarged to more than the image, so that it can move
    wide = round(1.5 * width)
    cloth = cv2.resize(person, (wide, height), interpolation=cv2.INTER_LINEAR)
    grain = np.random.default_rng(0).integers(-12, 13, (height, wide, 1))
    cloth = np.clip(
        cloth.astype(int) + cv2.resize(grain.astype(float), (wide, height))[..., None], 0, 255
    )
    left = round(index * FILLED_STEP * width)
    covered = round(FILLED_SHARE * width)
    rgb = frame.rgb.copy()
    rgb[:, :covered] = cloth[:, left : left + covered]
    depth = frame.depth.copy()
    depth[:, :covered] = FILLED_M
    instances = masks.instances.copy()
    instances[:, :covered] = OTHER_INSTANCE
    names = masks.class_names | {OTHER_INSTANCE: "person"}
    filled = FrameMasks(instances, names, masks.moving | {OTHER_INSTANCE})
    return replace(frame, rgb=rgb, depth=depth), filled


def run(label: str, clip: Clip, cache: str) -> dict[str, float]:
    """Coverage, ATE in metres, frames that are `ok` and far off or on which the guard acted, a checksum of poses."""
    tracker_id, *assignments = label.split()
    context = TrackerContext(sequence_id=clip.id, masks=clip.masks, cache=cache or None)  # type: ignore[arg-type]
    tracker = build_tracker(tracker_id, parse_assignments(assignments), context)
    tracker.reset(clip.camera, rng=np.random.default_rng(0))
    follower = OnlineError(clip.truth)
    poses: dict[float, np.ndarray] = {}
    far = 0
    guarded = 0
    for frame in clip.frames:
        result = tracker.track(frame)
        pose = result.T_world_cam if result.state == "ok" else None
        guarded += result.stats.get("guard_undone", 0) + result.stats.get("guard_returned", 0) > 0
        sample = follower.update(frame.timestamp, pose)
        if pose is not None:
            poses[frame.timestamp] = pose
            far += sample is not None and sample.trans_m > FAR_M
    ate = NO_ERROR_M
    if len(poses) >= 3:
        online = Trajectory(np.array([*poses]), np.array([*poses.values()]))
        ate = evaluate(online, clip.truth, input_timestamps=clip.stamps).metrics["ate_rmse_m"]
    return {
        "coverage": len(poses) / len(clip.frames),
        "ate": float(ate),
        "far": far,
        "guarded": guarded,
        "sum": float(np.sum([*poses.values()])),
    }


def measure(chosen: argparse.Namespace) -> pd.DataFrame:
    """A row a run."""
    rows: list[dict[str, object]] = []
    clips = itertools.product(chosen.scenes, chosen.families, chosen.strides, chosen.starts)
    for scene, family, stride, start in clips:
        name = f"synthetic/walking_{family}?scene={scene}"
        whole = Clip(name, start, stride)
        print(name, stride, start, flush=True, file=sys.stderr)
        for size, case in itertools.product(chosen.sizes, chosen.cases):
            width, height = map(int, size.split("x"))
            clip = whole.resized(width, height).in_case(case)
            for tracker in chosen.trackers:
                # where a case changes the masks, they are exact
                exact = "segmentation.source=" in tracker or tracker in WITHOUT_MASKS
                if case != "plain" and not exact:
                    continue
                keys = (tracker, case, size, family, scene, stride, start)
                rows.append(dict(zip(RUN, keys, strict=True)) | run(tracker, clip, chosen.cache))
        # what there is so far: the whole takes long
        if chosen.record:
            Path(chosen.record).write_text(json.dumps(rows))
    return pd.DataFrame(rows)


def ratio(first: pd.Series, second: pd.Series) -> str:
    """Geometric mean of paired ratios of errors, with a 95 % interval over pairs (bootstrap)."""
    logs = np.log((second / first).dropna().to_numpy())
    if not len(logs):
        return "-"
    draws = np.random.default_rng(0).choice(logs, (2000, len(logs))).mean(axis=1)
    low, high = np.exp(np.quantile(draws, (0.025, 0.975)))
    return f"{np.exp(logs.mean()):.2f} [{low:.2f}, {high:.2f}]"


def summary(runs: pd.DataFrame) -> pd.DataFrame:
    """Figures of all runs of a tracker in a case at a size."""
    groups = runs.groupby(["case", "tracker", "size"], sort=False)
    return pd.DataFrame(
        {
            "coverage": groups["coverage"].mean(),
            "least": groups["coverage"].min(),
            "ate": groups["ate"].median(),
            "worst": groups["ate"].max(),
            "far": groups["far"].sum(),
        }
    )


def table(before: pd.DataFrame | None, after: pd.DataFrame) -> str:
    """The table; with figures of before, both stand in a cell."""
    lines = [
        "| case | tracker | size | coverage %, least | median ATE mm (worst) | ok and far off | to 640x480 "
        + ("| to before | runs that differ |" if before is not None else "|"),
        "| --- | --- | --- | --- | ---: | ---: | ---: |"
        + (" ---: | ---: |" if before is not None else ""),
    ]
    shown = [figures for figures in (before, after) if figures is not None]
    summaries = [summary(figures) for figures in shown]
    for (case, tracker, size), _ in summaries[-1].iterrows():
        cells = []
        for figures in summaries:
            row = figures.loc[(case, tracker, size)]
            cells.append(
                (
                    f"{100 * row.coverage:.1f}, {100 * row.least:.0f}",
                    f"{1e3 * row.ate:.1f} ({1e3 * row.worst:.0f})",
                    f"{row.far:.0f}",
                )
            )
        part = [" -> ".join(values) for values in zip(*cells, strict=True)]
        keys = ["family", "scene", "stride", "start"]
        mine = [
            figures[(figures.case == case) & (figures.tracker == tracker)].set_index("size")
            for figures in shown
        ]
        to_full = "-"
        if size != "640x480" and "640x480" in mine[-1].index:
            to_full = " -> ".join(
                ratio(
                    of_tracker.loc[["640x480"]].set_index(keys).ate,
                    of_tracker.loc[[size]].set_index(keys).ate,
                )
                for of_tracker in mine
            )
        line = f"| {case} | `{tracker}` | {size} | {' | '.join(part)} | {to_full} |"
        if before is not None:
            old, new = (of_tracker.loc[[size]].set_index(keys) for of_tracker in mine)
            differ = int((old["sum"] != new["sum"]).sum())
            line += f" {ratio(old.ate, new.ate)} | {differ} of {len(new)} |"
        lines.append(line)
    return "\n".join(lines)


def null(runs: pd.DataFrame) -> str:
    """Errors from other starts, paired with those from the first start."""
    keys = ["tracker", "size", "family", "scene", "stride"]
    plain = runs[runs.case == "plain"]
    starts = sorted(plain.start.unique())
    lines = ["| tracker | size | ATE from another start |", "| --- | --- | ---: |"]
    for (tracker, size), group in plain.groupby(["tracker", "size"], sort=False):
        by_start = [group[group.start == start].set_index(keys).ate for start in starts]
        others = [ratio(by_start[0], other) for other in by_start[1:]]
        lines.append(f"| `{tracker}` | {size} | {', '.join(others)} |")
    return "\n".join(lines)


def main() -> None:
    """Make the runs, or read them; print the tables."""
    parser = parser_of(
        __doc__,
        trackers=TRACKERS,
        sizes=("640x480", "320x240", "160x120"),
        families=FAMILIES,
        scenes=(100, 101, 102, 103, 104, 105),
        strides=(1, 2),
        starts=(0, 4),
        cases=CASES,
        record="",
        before="",
        after="",
        cache="",
    )
    chosen = parser.parse_args()
    cv2.setNumThreads(1)
    before = pd.DataFrame(json.loads(Path(chosen.before).read_text())) if chosen.before else None
    if chosen.after:
        runs = pd.DataFrame(json.loads(Path(chosen.after).read_text()))
    else:
        runs = measure(chosen)
    print(table(before, runs))
    if runs.start.nunique() > 1:
        print("\n" + null(runs))


if __name__ == "__main__":
    main()
