"""Compare a recording's images with each other, with its camera and with its truth, and name what does not fit."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from dynslam_bench.contracts import Frame, Sequence
from dynslam_bench.core import DynslamError, TrajectoryError
from dynslam_bench.geometry import Camera
from dynslam_bench.sequences.catalogue import open_sequence
from dynslam_bench.sequences.findings import (
    NOT_COMPARED,
    RESAVE,
    Finding,
    finding_of,
    is_fault,
)
from dynslam_bench.sequences.image_checks import ImageStatistics, image_findings
from dynslam_bench.sequences.rgbd_motion import RgbdPair, rgbd_pairs
from dynslam_bench.sequences.truth_checks import truth_findings

__all__ = [
    "FEWEST",
    "MOST_FRAMES",
    "STRETCH",
    "Diagnosis",
    "Finding",
    "diagnose",
    "examine",
    "stretches",
    "truth_findings",
]

MOST_FRAMES = 240
"""Frames that are read by default, at most."""
FEWEST = 10
"""Frames below which only single images are checked."""
STRETCH = 40
"""Frames that are read one after the other: more than a second, for delays and shifts in time."""

Progress = Callable[[int, int], None]
_UNREADABLE = (DynslamError, OSError, ValueError)
"""Errors of a recording that cannot be read."""


@dataclass(frozen=True)
class Diagnosis:
    """The result of checking a recording.

    Attributes:
        id: What the caller named: an id or the path of a folder.
        frames: Frames that were read.
        findings: What was found, faults first.
    """

    id: str
    frames: int
    findings: tuple[Finding, ...]

    @property
    def ok(self) -> bool:
        """Whether no fault was found."""
        return not any(map(is_fault, self.findings))

    @property
    def verdict(self) -> str:
        """The findings in one phrase, which ends with *ready*, or with *not ready* if there is a fault."""
        faults = sum(map(is_fault, self.findings))
        if faults:
            return f"{faults} fault{'s' * (faults != 1)}: not ready"
        ids = {finding.id for finding in self.findings}
        if "no-truth" in ids:
            return "no fault found in the images; there is no ground truth to compare: ready"
        if ids & NOT_COMPARED:
            return "no fault found in the images, but the ground truth could not be compared: ready"
        if "depth-factor-unmeasured" in ids:
            return "no fault found, but the depth factor could not be compared: ready"
        return "no fault found: ready"


def diagnose(
    name: str | Path,
    *,
    data_root: str | Path | None = None,
    camera: str | Path | Camera | None = None,
    most_frames: int = MOST_FRAMES,
    progress: Progress = lambda done, total: None,
) -> Diagnosis:
    """Check a recording: never raises for what is wrong with it.

    Args:
        name: Id of a sequence or path of its folder.
        data_root: Folder of the sequences.
        camera: In place of what the catalogue or the folder says.
        most_frames: Frames that are read at most, in stretches spread over the recording.
        progress: Called with the frames done and the frames to do.
    """
    try:
        sequence = open_sequence(name, data_root=data_root, camera=camera)
    except _UNREADABLE as error:
        return Diagnosis(str(name), 0, (_unopened_finding(error),))
    return replace(examine(sequence, most_frames=most_frames, progress=progress), id=str(name))


def examine(
    sequence: Sequence,
    *,
    most_frames: int = MOST_FRAMES,
    progress: Progress = lambda done, total: None,
) -> Diagnosis:
    """Check an opened sequence: never raises for what is wrong with it.

    Args:
        sequence: The sequence.
        most_frames: Frames that are read at most.
        progress: Called with the frames done and the frames to do.
    """
    # read the frames, and measure images and motion
    with_depth = bool(getattr(sequence, "has_depth", True))
    measurement = _measure(sequence, with_depth, most_frames, progress)
    statistics = measurement.statistics

    # files, single images, then the truth
    findings = []
    if measurement.unreadable:
        count = len(measurement.unreadable)
        first = measurement.unreadable[0]
        findings.append(finding_of("unreadable", count, todo=measurement.tried, first=first))
    if statistics.frames:
        if statistics.frames < FEWEST:
            findings.append(finding_of("too-short", statistics.frames))
        of_images = image_findings(statistics, with_depth)
        findings += of_images
        # the truth is compared with the motion of sound images only
        if statistics.frames >= FEWEST and not any(map(is_fault, of_images)):
            findings += truth_findings(
                sequence.timestamps, sequence.ground_truth, sequence.camera, measurement.pairs
            )
    faults_first = tuple(sorted(findings, key=is_fault, reverse=True))
    return Diagnosis(sequence.id, statistics.frames, faults_first)


@dataclass(frozen=True, eq=False)
class _Measurement:
    """Measurements in the frames of a recording.

    Attributes:
        statistics: Statistics of the images.
        pairs: Pairs of frames and the motion between them.
        unreadable: A message for each frame that cannot be read.
        tried: How many frames were to be read.
    """

    statistics: ImageStatistics
    pairs: list[RgbdPair]
    unreadable: list[str]
    tried: int


def _measure(
    sequence: Sequence, with_depth: bool, most_frames: int, progress: Progress
) -> _Measurement:
    """Read stretches of a recording and measure its images and its camera's motion."""
    # stretches of the recording, and the interval of its stamps (30 Hz for a single frame)
    parts = [range(*stretch) for stretch in stretches(len(sequence), most_frames)]
    tried = sum(map(len, parts))
    interval_s = np.median(np.diff(sequence.timestamps)) if len(sequence) > 1 else 1 / 30
    statistics = ImageStatistics(sequence.camera.written_depth_factor, float(interval_s))

    # one stretch at a time is in memory
    pairs = list[RgbdPair]()
    unreadable = list[str]()
    done = 0
    for part in parts:
        frames = list[Frame]()
        for index in part:
            try:
                frames.append(sequence[index])
            except _UNREADABLE as error:
                unreadable.append(f"frame {index}: {_message(error)}")
            done += 1
            progress(done, tried)
        if frames:
            statistics.add(frames)
        if frames and with_depth:
            pairs += rgbd_pairs(frames, sequence.camera)
    return _Measurement(statistics, pairs, unreadable, tried)


def stretches(frames: int, most: int) -> list[tuple[int, int]]:
    """First and one past the last frame of stretches of `STRETCH` frames, spread evenly, of `most` frames in all."""
    if frames <= most:
        return [(start, min(start + STRETCH, frames)) for start in range(0, frames, STRETCH)]
    length = min(STRETCH, most)
    starts = np.linspace(0, frames - length, max(1, most // length)).round().astype(int)
    return [(int(start), int(start) + length) for start in starts]


def _unopened_finding(error: Exception) -> Finding:
    """Why a recording cannot be opened: no depth, or depth of another size or form; the rest is said as it is."""
    # a depth image of another size than the colour image, by the message's numbers
    text = _message(error)
    other_size = re.search(r"is (\d+)x(\d+), but its colour image is (\d+)x(\d+)", text)
    if other_size:
        columns, rows, width, height = map(int, other_size.groups())
        facts = {"columns": columns, "rows": rows, "width": width, "height": height}
        return finding_of("depth-size", columns / width, **facts)

    # no depth, depth of another form, or anything else
    if re.search("nor a folder depth$", text):
        case = "no-depth/opening"
    elif re.search("^depth image ", text):
        case = "depth-format"
    else:
        case = "unreadable/opening"
    if isinstance(error, TrajectoryError):
        usual_cure = RESAVE
    else:
        usual_cure = "docs/reference/sequences.md says what a folder holds"
    return finding_of(case, None, text=text, cure=getattr(error, "hint", "") or usual_cure)


def _message(error: Exception) -> str:
    """The message of an error on one line, without the hint."""
    return " ".join(str(error.args[0] if error.args else error).split())
