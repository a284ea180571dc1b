"""Compare a recording's images with each other, with its camera and with its truth, and name what does not fit."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from dynslam_bench.contracts.sequence import Frame, Sequence
from dynslam_bench.core.errors import DynslamError, SequenceError, TrajectoryError
from dynslam_bench.geometry.camera import Camera
from dynslam_bench.sequences.catalogue import open_sequence
from dynslam_bench.sequences.rgbd_motion import RgbdPair, rgbd_pairs
from dynslam_bench.sequences.settings import PreprocessingSettings
from dynslam_bench.sequences.stream_checks import Finding, Streams, fault, stream_findings
from dynslam_bench.sequences.truth_checks import RESAVE, truth_findings

MOST_FRAMES = 240
FEWEST = 10
"""Frames below which only single images are checked."""
STRETCH = 40
"""Frames that are read one after the other: more than a second, for delays and shifts in time."""

_UNREADABLE = (DynslamError, OSError, ValueError)
"""What a recording raises that cannot be read."""


@dataclass(frozen=True)
class Diagnosis:
    """What the check of a recording found.

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
        return not any(finding.severity == "fault" for finding in self.findings)

    @property
    def verdict(self) -> str:
        """A phrase for the first line of a report; every note stands for a comparison that was not made."""
        faults = sum(finding.severity == "fault" for finding in self.findings)
        if faults:
            return f"{faults} fault{'s' * (faults != 1)}"
        if not self.findings:
            return "no fault found"
        if any(finding.id == "no-truth" for finding in self.findings):
            return "no fault found in the images; there is no ground truth to compare"
        return "no fault found in the images, but the ground truth could not be compared"


def diagnose(
    name: str | Path,
    *,
    data_root: str | Path | None = None,
    camera: str | Path | Camera | None = None,
    most_frames: int = MOST_FRAMES,
    progress: Callable[[int, int], None] | None = None,
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
        return Diagnosis(str(name), 0, (_unopened(name, data_root, camera, error),))
    return replace(examine(sequence, most_frames=most_frames, progress=progress), id=str(name))


def examine(
    sequence: Sequence, *, most_frames: int = MOST_FRAMES, progress: Callable[[int, int], None] | None = None
) -> Diagnosis:
    """The same of an opened sequence.

    Args:
        sequence: The sequence.
        most_frames: Frames that are read at most.
        progress: Called with the frames done and the frames to do.
    """
    starts = stretches(len(sequence), most_frames)
    todo = sum(stop - start for start, stop in starts)
    intervals = np.diff(sequence.timestamps)
    streams = Streams(sequence.camera.depth_factor, float(np.median(intervals)) if len(intervals) else 1 / 30)
    pairs: list[RgbdPair] = []
    unreadable: list[str] = []
    with_depth = bool(getattr(sequence, "has_depth", True))
    done = 0
    for start, stop in starts:
        frames: list[Frame] = []
        for index in range(start, stop):
            try:
                frames.append(sequence[index])
            except _UNREADABLE as error:
                unreadable.append(f"frame {index}: {_message(error)}")
            done += 1
            if progress is not None:
                progress(done, todo)
        if frames:
            streams.add(frames)
            if with_depth:
                pairs.extend(rgbd_pairs(frames, sequence.camera))
    findings = []
    if unreadable:
        text = f"{len(unreadable)} of {todo} frames cannot be read; {unreadable[0]}"
        cure = "export or fetch these files again, or remove them from the lists"
        findings.append(fault("unreadable", len(unreadable), "frames", text, cure))
    if not streams.frames:
        return Diagnosis(sequence.id, 0, tuple(findings))
    if streams.frames < FEWEST:
        text = f"too few frames ({streams.frames}): motion, delays and truth cannot be compared"
        findings.append(Finding("too-short", "note", float(streams.frames), "frames", text, "check a longer part"))
    in_streams = stream_findings(streams, with_depth)
    findings += in_streams
    if streams.frames >= FEWEST and not any(finding.severity == "fault" for finding in in_streams):
        findings += truth_findings(sequence.timestamps, sequence.ground_truth, sequence.camera, pairs)
    findings.sort(key=lambda finding: finding.severity != "fault")
    return Diagnosis(sequence.id, streams.frames, tuple(findings))


def stretches(frames: int, most: int) -> list[tuple[int, int]]:
    """First and one past the last frame of stretches of `STRETCH` frames, spread evenly, of `most` frames in all."""
    if frames <= most:
        return [(start, min(start + STRETCH, frames)) for start in range(0, frames, STRETCH)]
    length = min(STRETCH, most)
    starts = np.linspace(0, frames - length, max(1, most // length)).round().astype(int)
    return [(int(start), int(start) + length) for start in starts]


def _unopened(
    name: str | Path, data_root: str | Path | None, camera: str | Path | Camera | None, error: Exception
) -> Finding:
    """Why a recording cannot be opened: depth of another size is a fault of its own, the rest is said as it is."""
    any_size = PreprocessingSettings(width=64, height=48)
    try:
        loose: Any = open_sequence(name, data_root=data_root, camera=camera, preprocessing=any_size)
        frame = getattr(loose, "base", loose)[0]
    except _UNREADABLE:
        text, cure = _message(error), getattr(error, "hint", "")
        if isinstance(error, TrajectoryError):
            return fault("unreadable", None, "", text, cure or RESAVE)
        kind = "unreadable"
        if isinstance(error, SequenceError) and text.startswith("depth image"):
            kind = "depth-format"
        elif text.endswith("nor a folder depth"):
            kind, cure = "no-depth", "record or export depth images: a folder is read only with depth"
        return fault(kind, None, "", text, cure or "docs/reference/sequences.md says what a folder holds")
    (height, width), (rows, columns) = frame.rgb.shape[:2], frame.depth.shape
    text = f"depth images are {columns}x{rows}, colour images {width}x{height}"
    cure = "register the depth to the colour images, pixel by pixel; resizing serves only if both have one view"
    return fault("depth-size", columns / width, "", text, cure)


def _message(error: Exception) -> str:
    """The message of an error on one line, without the hint."""
    return " ".join(str(error.args[0] if error.args else error).split())
