"""Compare a recording's images with each other, with its camera and with its truth, and name what does not fit."""

from __future__ import annotations

import itertools
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from operator import attrgetter
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from dynslam_bench.contracts import Frame, Sequence
from dynslam_bench.core import DynslamError, TrajectoryError
from dynslam_bench.geometry import Array, Camera, Trajectory, nearest_gap, se3
from dynslam_bench.geometry.rigs import BONN_R_BODY_CAM, Matrix, in_camera_axes, nearest_rotation
from dynslam_bench.sequences.catalogue import open_sequence
from dynslam_bench.sequences.depth_scale import DepthScale, depth_scale
from dynslam_bench.sequences.rgbd_motion import (
    READINGS,
    ROTATION_GAIN,
    ROTATION_NOISE,
    Match,
    Motions,
    RgbdPair,
    TruthMotion,
    agreement,
    explained_share,
    match,
    motions_of,
    rgbd_pairs,
    rotation_between,
    weighted_mean,
)

MOST_FRAMES = 240
FEWEST = 10
"""Frames below which only single images are checked."""
STRETCH = 40
"""Frames that are read one after the other: more than a second, for delays and shifts in time."""

Progress = Callable[[int, int], None]
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
        return not any(map(is_fault, self.findings))

    @property
    def verdict(self) -> str:
        """What was found in one phrase, which ends with *ready*, or with *not ready* if there is a fault."""
        faults = sum(map(is_fault, self.findings))
        if faults:
            return f"{faults} fault{'s' * (faults != 1)}: not ready"
        ids = {finding.id for finding in self.findings}
        if "no-truth" in ids:
            return "no fault found in the images; there is no ground truth to compare: ready"
        if ids & _NOT_COMPARED:
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
        return Diagnosis(str(name), 0, (_unopened(error),))
    return replace(examine(sequence, most_frames=most_frames, progress=progress), id=str(name))


def examine(
    sequence: Sequence,
    *,
    most_frames: int = MOST_FRAMES,
    progress: Progress = lambda done, total: None,
) -> Diagnosis:
    """The same of an opened sequence.

    Args:
        sequence: The sequence.
        most_frames: Frames that are read at most.
        progress: Called with the frames done and the frames to do.
    """
    indices = [range(*stretch) for stretch in stretches(len(sequence), most_frames)]
    done = 0
    todo = sum(map(len, indices))
    interval_s = np.median(np.diff(sequence.timestamps)) if len(sequence) > 1 else 1 / 30
    streams = Streams(sequence.camera.written_depth_factor, float(interval_s))
    pairs = list[RgbdPair]()
    unreadable = list[str]()
    with_depth = bool(getattr(sequence, "has_depth", True))
    for stretch in indices:
        frames = []
        for index in stretch:
            try:
                frames.append(sequence[index])
            except _UNREADABLE as error:
                unreadable.append(f"frame {index}: {_message(error)}")
            done += 1
            progress(done, todo)
        if frames:
            streams.add(frames)
            pairs += rgbd_pairs(frames, sequence.camera) if with_depth else ()
    findings = (
        [finding_of("unreadable", len(unreadable), todo=todo, first=unreadable[0])]
        if unreadable
        else []
    )
    if streams.frames:
        findings += [finding_of("too-short", streams.frames)] if streams.frames < FEWEST else []
        in_streams = stream_findings(streams, with_depth)
        findings += in_streams
        if streams.frames >= FEWEST and not any(map(is_fault, in_streams)):
            findings += truth_findings(
                sequence.timestamps, sequence.ground_truth, sequence.camera, pairs
            )
    return Diagnosis(
        sequence.id, streams.frames, tuple(sorted(findings, key=is_fault, reverse=True))
    )


def stretches(frames: int, most: int) -> list[tuple[int, int]]:
    """First and one past the last frame of stretches of `STRETCH` frames, spread evenly, of `most` frames in all."""
    if frames <= most:
        return [(start, min(start + STRETCH, frames)) for start in range(0, frames, STRETCH)]
    length = min(STRETCH, most)
    starts = np.linspace(0, frames - length, max(1, most // length)).round().astype(int)
    return [(int(start), int(start) + length) for start in starts]


def _unopened(error: Exception) -> Finding:
    """Why a recording cannot be opened: no depth, or depth of another size or form; the rest is said as it is."""
    text = _message(error)
    cure = getattr(error, "hint", "")
    other_size = re.search(r"is (\d+)x(\d+), but its colour image is (\d+)x(\d+)", text)
    if other_size:
        columns, rows, width, height = map(int, other_size.groups())
        return finding_of(
            "depth-size", columns / width, columns=columns, rows=rows, width=width, height=height
        )
    cases = {"nor a folder depth$": "no-depth/opening", "^depth image ": "depth-format"}
    case = next(
        (case for pattern, case in cases.items() if re.search(pattern, text)), "unreadable/opening"
    )
    usual = (
        RESAVE
        if isinstance(error, TrajectoryError)
        else "docs/reference/sequences.md says what a folder holds"
    )
    return finding_of(case, None, text=text, cure=cure or usual)


def _message(error: Exception) -> str:
    """The message of an error on one line, without the hint."""
    return " ".join(str(error.args[0] if error.args else error).split())


# Do the colour and depth images of a recording fit together? Statistics of single frames and of
# short stretches.
#
# Contours of depth are contours in the colour image, too, at the same place and time. Their
# correlation over shifts, mirrorings and delays says whether the depth is registered, which way up
# the images are, and whether the two streams are synchronous.


Severity = Literal["fault", "note"]


@dataclass(frozen=True)
class Finding:
    """One thing that a check of a recording found.

    Attributes:
        id: Stable name, for example ``truth-time-shift``.
        severity: ``fault``: results on the recording are wrong until it is mended; ``note``: good
            to know.
        value: The measured number; None where nothing is measured.
        unit: Its unit, for example ``s``; empty for a ratio or where nothing is measured.
        text: One line that says what was measured.
        cure: What to change, and in which file.
    """

    id: str
    severity: Severity
    value: float | None
    unit: str
    text: str
    cure: str


RESAVE = (
    "write each line of groundtruth.txt as: timestamp tx ty tz qx qy qz qw, camera to world, metres"
)
_SO = "so they explain {then:.0f} % of the images' motion, as stored {now:.0f} %"
_FINDINGS: dict[str, tuple[str, str, str]] = {
    "unreadable": (
        "frames",
        "{value:.0f} of {todo} frames cannot be read; {first}",
        "export or fetch these files again, or remove them from the lists",
    ),
    "unreadable/opening": ("", "{text}", "{cure}"),
    "too-short": (
        "frames",
        "too few frames ({value:.0f}): motion, delays and truth cannot be compared",
        "check a longer part",
    ),
    "no-depth": (
        "",
        "the sequence has no depth images: only the colour images were checked",
        "add depth images to check more",
    ),
    "no-depth/opening": (
        "",
        "{text}",
        "record or export depth images: a folder is read only with depth",
    ),
    "depth-format": ("", "{text}", "{cure}"),
    "depth-size": (
        "",
        "depth images are {columns}x{rows}, colour images {width}x{height}",
        "register the depth to the colour images, pixel by pixel; resizing serves only if both have one view",
    ),
    "colour-blank": (
        "",
        "{count} of {frames} colour images hold one brightness only",
        "record or export the colour again",
    ),
    "depth-empty": (
        "",
        "{count} of {frames} depth images hold no depth",
        "record or export the depth again, or use trackers that need none",
    ),
    "colour-frozen": (
        "frames",
        "one colour image is repeated in {value:.0f} or more successive frames while the depth changes",
        "export the colour images again",
    ),
    "depth-frozen": (
        "frames",
        "one depth image is repeated in {value:.0f} or more successive frames while the colour changes",
        "export the depth images again",
    ),
    "depth-byte-order": (
        "",
        "neighbouring depths differ by {stated:.0f} % on average, by {swapped:.1f} % with the bytes of each value "
        "swapped",
        "write the 16-bit depth images in the machine's byte order (PNG stores big-endian by itself)",
    ),
    "depth-units": (
        "m",
        "the median depth is {value:.3g} m with {factor:g} raw units a metre",
        "set depth_factor in camera.toml (here perhaps {likely:g}), or store arrays in metres",
    ),
    "colour-flipped": (
        "sigma",
        "the colour images are {how} relative to the depth: contours agree by {value:.0f} standard deviations so, by "
        "{stored:.0f} as stored",
        "turn the colour images as the depth images are",
    ),
    "depth-delay": (
        "s",
        "the depth images fit the colour images of {delay:.1f} frames {side} ({s:.2f} s): their contours agree "
        "{better:.1f} times as well",
        "make the depth's stamps {s:.3f} s {change} in depth.txt",
    ),
    "depth-not-registered": (
        "px",
        "the depth lies {value:.0f} pixels beside the colour ({right:+d} right, {down:+d} down)",
        "register the depth to the colour camera",
    ),
    "no-truth": (
        "",
        "there is no ground truth: units of the depth, intrinsics and time were not compared with any",
        "add groundtruth.txt to check more",
    ),
    "truth-other-sequence": (
        "",
        "the truth explains at most {share:.0f} % of the motion that {pairs} pairs of frames show, under any shift to "
        "{limit:g} s, inverse, order of quaternions or axes",
        "take the truth of this recording",
    ),
    "truth-other-sequence/time": (
        "s",
        "truth and images share no time: {begin:.3f} to {end:.3f} s and {first:.3f} to {last:.3f} s, {value:.3f} s "
        "apart",
        "take the groundtruth.txt of this recording, or put its stamps on the images' clock",
    ),
    "truth-other-sequence/rest": (
        "px",
        "the truth moves the image by {value:.0f} pixels between frames that move by {displacement:.1f}",
        "take the truth of this recording",
    ),
    "truth-sparse": (
        "frames",
        "{value:.0f} of {frames} frames have a true pose within {within} s",
        "export the truth of all frames again",
    ),
    "motion-unmeasured": (
        "pairs",
        "the images give a motion for {value:.0f} of {pairs} pairs of frames, fewer than {least}: truth and camera "
        "were not compared",
        "check a part with more texture",
    ),
    "motion-unmeasured/small": (
        "pairs",
        "only {value:.0f} pairs of frames with a small motion share time with the truth: it cannot be compared",
        "check a longer part",
    ),
    "no-motion": (
        "px",
        "the camera rests (the image moves by {value:.1f} pixels): truth and intrinsics cannot be compared",
        "check a part in which the camera moves",
    ),
    "truth-inverted": (
        "",
        f"the poses are world-to-camera: {_SO}",
        "invert them: p -> -R^T p, R -> R^T",
    ),
    "truth-inverted/rotations": (
        "",
        f"the rotations are world-to-camera while the positions are the camera's: {_SO}",
        "invert the rotations: conjugate the quaternions",
    ),
    "truth-quaternion-order": ("", f"the quaternions are in the order qw qx qy qz: {_SO}", RESAVE),
    "truth-quaternion-order/inverted": (
        "",
        f"the quaternions are in the order qw qx qy qz, and the poses are world-to-camera: {_SO}",
        RESAVE,
    ),
    "truth-time-shift/late": (
        "s",
        "the truth is {s:.3f} s late: so it explains {then:.0f} % of the images' motion, as stored {now:.0f} %",
        "subtract {s:.3f} s from the stamps of the truth",
    ),
    "truth-time-shift/early": (
        "s",
        "the truth is {s:.3f} s early: so it explains {then:.0f} % of the images' motion, as stored {now:.0f} %",
        "add {s:.3f} s to the stamps of the truth",
    ),
    "truth-unclear": (
        "",
        "the truth explains {share:.0f} % of the motion between the frames, too little to compare more: it may belong "
        "to another recording",
        "make sure that groundtruth.txt is this recording's, or check a part with a clearer motion",
    ),
    "truth-unclear/moving": (
        "",
        "the truth explains {share:.0f} % of the corners, with its motions in another order at most {by_chance:.0f} %: "
        "it is of this recording, but moving things fill the view, and camera and depth factor were not compared",
        "check a part with fewer people",
    ),
    "truth-axes": (
        "degrees",
        "the truth's axes are turned by {value:.0f} degrees against the camera's: so they explain {then:.0f} % of the "
        "images' rotation, as stored {now:.0f} %",
        "multiply each rotation of groundtruth.txt from the right by [{matrix}]",
    ),
    "truth-markers": (
        "degrees",
        "the truth's orientations are those of {name}'s markers, as published, {value:.0f} degrees from the camera's: "
        "positions and ATE are right, RPE and errors of rotation are not",
        "--camera {rig}, or name = '{rig}' beside the other lines of camera.toml, turns them",
    ),
    "truth-axes/fit": (
        "degrees",
        "the truth's axes are turned by {value:.1f} degrees against the camera's: {errors}",
        "multiply each rotation of groundtruth.txt from the right by [{matrix}]",
    ),
    "truth-axes/positions": (
        "degrees",
        "the truth's positions are {how} in the {where}'s axes against its orientations: so they explain {then:.0f} % "
        "of the images' translation, as stored {now:.0f} %",
        "use one right-handed frame for both",
    ),
    "truth-scale": (
        "",
        "the truth's translations are {value:.4g} times the measured ones (median depth {depth_m:.2f} m): they are in "
        "{unit}",
        "divide the positions of groundtruth.txt by {divisor}",
    ),
    "truth-lever-arm": (
        "m",
        "the camera is {value:.3f} m (+- {sigma:.3f}) from the point that the truth tracks: {errors}",
        "move each position by R ({lever}), R being the pose's rotation",
    ),
    "depth-factor": (
        "",
        "{new:.4g} raw units of depth are a metre of the truth (95 % interval {low} to {high}), not {old:g}",
        "depth_factor = {likely:.5g} in camera.toml{why}, unless the truth is not in metres",
    ),
    "depth-factor/depth": (
        "",
        "about {new:.2g} raw units of depth are a metre of the truth, not {old:g}; no interval, as {percent:.0f} % of "
        "the image has depth, perhaps on moving people alone",
        "depth_factor in camera.toml as the camera's maker states it: 1000 for millimetres, 5000 for TUM's files",
    ),
    "depth-factor-unmeasured": (
        "",
        "the depth factor was not compared: by the truth's translations {low} to {high} raw units are a metre",
        "check a part in which the camera moves farther from place to place",
    ),
    "depth-factor-unmeasured/still": (
        "",
        "the depth factor was not compared: the truth's positions rest",
        "check a part in which the camera moves from place to place",
    ),
    "depth-factor-unmeasured/pairs": (
        "pairs",
        "the rotations of {value:.0f} of {pairs} pairs of frames agree with the truth, fewer than {least}: camera and "
        "depth factor were not compared",
        "check a part with fewer people",
    ),
    "depth-factor-unmeasured/apart": (
        "",
        "the depth factor was not compared: by the truth's translations {low} to {high} raw units are a metre, "
        "but reprojection errors do not agree, perhaps as people fill the view",
        "check a part with fewer people",
    ),
    "depth-factor-unmeasured/depth": (
        "",
        "the depth factor was not compared: {percent:.0f} % of the image has depth, perhaps on moving people alone",
        "check a part with more depth",
    ),
    "camera-focal-length": (
        "",
        "the focal length is {value:.3f} times the stated one (+- {percent:.1f} %): {errors}",
        "fx = {fx:.1f}, fy = {fy:.1f} in camera.toml, or name the right camera",
    ),
    "camera-principal-point": (
        "px",
        "the principal point is {dx:+.0f}, {dy:+.0f} px from the stated one (+- {sigma:.0f}): {errors}",
        "cx = {cx:.1f}, cy = {cy:.1f} in camera.toml, or name the right camera",
    ),
}
"""Unit, text and cure of every finding, by its id and, where an id has several texts, what it was found by."""


_NOT_COMPARED = {
    "too-short",
    "no-depth",
    "no-truth",
    "motion-unmeasured",
    "no-motion",
    "truth-unclear",
}
"""Notes on a truth that was not compared."""
_NOTES = {
    *_NOT_COMPARED,
    "motion-unmeasured/small",
    "truth-unclear/moving",
    "truth-markers",
    "depth-factor-unmeasured",
    "depth-factor-unmeasured/apart",
    "depth-factor-unmeasured/depth",
    "depth-factor-unmeasured/pairs",
    "depth-factor-unmeasured/still",
}
"""The cases that are good to know and no faults."""


def finding_of(case: str, value: float | None, **facts: Any) -> Finding:
    """A row of `_FINDINGS`, with the numbers filled in."""
    unit, text, cure = _FINDINGS[case]
    facts = {"value": value, **facts}
    severity: Severity = "note" if case in _NOTES else "fault"
    number = None if value is None else float(value)
    return Finding(
        case.partition("/")[0], severity, number, unit, text.format(**facts), cure.format(**facts)
    )


def is_fault(finding: Finding) -> bool:
    """Whether results on the recording are wrong until it is mended."""
    return finding.severity == "fault"


Map = NDArray[np.float32]

MAP_WIDTH = 160
"""Width of the maps of contours, in cells; of an image 640 pixels wide a cell is 4 pixels."""
MOST_DELAY = 10
"""Largest delay between colour and depth that is looked for, in frames."""
FLIPS = {"": (1, 1), "upside down": (-1, 1), "mirrored": (1, -1), "turned by 180 degrees": (-1, -1)}


@dataclass(eq=False)
class Streams:
    """What is kept of the frames that were read, stretch by stretch.

    Attributes:
        depth_factor: Raw units a metre.
        seconds_a_frame: Median interval of the stamps.
        dark: How many frames have a colour image without contrast.
        empty: How many have no depth.
        medians: Median depth of each frame that has any, metres.
        colour_run: Most equal colour images in a row.
        depth_run: Most equal depth images in a row.
        rough: Median step between neighbouring raw depths relative to the depth, and the same with
            swapped bytes.
        contours: Of each stretch the maps of contours of its colour and of its depth images, both
            ``[N, H, W]``.
        cell_px: Pixels a cell of the maps.
    """

    depth_factor: float
    seconds_a_frame: float
    dark: int = 0
    empty: int = 0
    medians: list[float] = field(default_factory=list)
    colour_run: int = 1
    depth_run: int = 1
    rough: list[tuple[float, float]] = field(default_factory=list)
    contours: list[tuple[Map, Map]] = field(default_factory=list)
    cell_px: int = 1

    @property
    def frames(self) -> int:
        """How many frames were added."""
        return sum(len(colour) for colour, _ in self.contours)

    def add(self, stretch: list[Frame]) -> None:
        """Add consecutive frames of one size."""
        grays = [
            np.asarray(cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2GRAY), np.uint8) for frame in stretch
        ]
        depths = [frame.depth for frame in stretch]
        measured = [depth[::4, ::4][depth[::4, ::4] > 0] for depth in depths]
        deep = [len(values) >= 100 for values in measured]
        self.dark += sum(bool(gray.std() < 1.0) for gray in grays)
        self.empty += deep.count(False)
        self.medians += [
            float(np.median(values))
            for values, enough in zip(measured, deep, strict=True)
            if enough
        ]
        self.rough += [
            _roughness(depths[i], self.depth_factor) for i in range(0, len(stretch), 5) if deep[i]
        ]
        self.colour_run = max(self.colour_run, _longest_run([frame.rgb for frame in stretch]))
        self.depth_run = max(self.depth_run, _longest_run(depths))
        self.cell_px = max(1, round(stretch[0].rgb.shape[1] / MAP_WIDTH))
        colour_maps = np.stack(
            [_standardised(_colour_contours(gray, self.cell_px)) for gray in grays]
        )
        depth_maps = np.stack(
            [_standardised(_depth_contours(depth, self.cell_px)) for depth in depths]
        )
        self.contours.append((colour_maps, depth_maps))


def _longest_run(images: list[NDArray[Any]]) -> int:
    """Most equal images in a row."""
    repeated = itertools.groupby(
        np.array_equal(before, after) for before, after in itertools.pairwise(images)
    )
    return 1 + max((len([*run]) for equal, run in repeated if equal), default=0)


def _correlation(colour: Map, depth: Map) -> Map:
    """Sum of the circular correlations ``[H, W]`` of maps of the colour with maps of the depth, both ``[N, H, W]``."""
    spectrum = (np.fft.rfft2(colour) * np.conj(np.fft.rfft2(depth))).sum(axis=0)
    return np.fft.irfft2(spectrum, s=colour.shape[1:]).astype(np.float32)


def _by_delay(streams: Streams, delays: range) -> tuple[Map, NDArray[np.intp]]:
    """Correlation of every second colour image with the depth so many frames later.

    Returns:
        Sums over all pairs ``[D, H, W]``, and how many pairs each sums ``[D]``.
    """
    shape = streams.contours[0][0].shape[1:]
    surfaces = np.zeros((len(delays), *shape), np.float32)
    pairs = np.zeros(len(delays), np.intp)
    for colour, depth in streams.contours:
        colours = np.fft.rfft2(colour)
        depths = np.conj(np.fft.rfft2(depth))
        for row, delay in enumerate(delays):
            index = np.arange(0, len(colour), 2)
            index = index[(index + delay >= 0) & (index + delay < len(depth))]
            spectrum = (colours[index] * depths[index + delay]).sum(axis=0)
            surfaces[row] += np.fft.irfft2(spectrum, s=shape).astype(np.float32)
            pairs[row] += len(index)
    return surfaces, pairs


def _roughness(depth: Map, factor: float) -> tuple[float, float]:
    raw = np.clip(np.round(depth[::2].astype(np.float64) * factor), 0, 65535).astype(np.uint16)
    both = (raw[:, 1:] > 0) & (raw[:, :-1] > 0)
    if both.sum() < 100:
        return np.nan, np.nan
    wide = np.stack([raw, raw.byteswap()]).astype(np.float64)
    steps = np.minimum(np.abs(np.diff(wide, axis=2)) / np.maximum(wide[:, :, 1:], 1), 1)[
        :, both
    ].mean(axis=1)
    return float(steps[0]), float(steps[1])


def _colour_contours(gray: NDArray[np.uint8], cell: int) -> Map:
    small = cv2.resize(
        gray, (gray.shape[1] // cell, gray.shape[0] // cell), interpolation=cv2.INTER_AREA
    )
    wide = small.astype(np.float32)
    return np.asarray(
        np.sqrt(np.hypot(cv2.Sobel(wide, -1, 1, 0), cv2.Sobel(wide, -1, 0, 1))), np.float32
    )


def _depth_contours(depth: Map, cell: int) -> Map:
    """The step in depth around each cell, as a logarithm; missing depth is no contour."""
    rows = depth.shape[0] // cell
    columns = depth.shape[1] // cell
    blocks = depth[: rows * cell, : columns * cell].reshape(rows, cell, columns, cell)
    around = np.ones((3, 3), np.uint8)
    least = np.where(blocks > 0, blocks, np.inf).min(axis=(1, 3))
    far = cv2.dilate(blocks.max(axis=(1, 3)), around)
    near = cv2.erode(least.astype(np.float32), around)
    valid = (far > 0) & np.isfinite(near)
    steps = np.log(np.where(valid, far / np.where(valid, near, 1), 1))
    return np.where(valid, np.minimum(steps, 0.3), 0).astype(np.float32)


def _standardised(values: Map) -> Map:
    """Without slow changes across the image, with zero mean and unit length."""
    sharp = values - cv2.blur(values, (25, 25))
    sharp -= sharp.mean()
    return np.asarray(sharp / max(float(np.linalg.norm(sharp)), 1e-9), np.float32)


FROZEN_FRAMES = 4
LEAST_SHIFT_PX = 14.0
"""A shift of the depth below this occurs in published data: 7-Scenes' depth is not registered to its colour."""
LEAST_DELAY = 2
"""In frames; the first Kinect's depth lags by nearly one."""
CLEAR_PEAK = 7.0
"""Of a correlation, in standard deviations over all shifts: what has nothing in common stays below 6."""
DEPTH_RANGE_M = (0.1, 60.0)
USUAL_FACTORS = (1.0, 100.0, 1000.0, 5000.0)
"""Raw units a metre of public data: metres, centimetres, millimetres, TUM's."""


def stream_findings(streams: Streams, with_depth: bool = True) -> list[Finding]:
    """What is wrong with the images alone, the most basic fault first; what follows from a fault is not repeated.

    Args:
        streams: Statistics of the frames that were read.
        with_depth: Whether the sequence announces depth images.
    """
    for check in (
        (_empty, _frozen, _swapped, _units, _flipped, _asynchronous, _shifted)
        if with_depth
        else (_empty,)
    ):
        finding = check(streams)
        if finding is not None and (with_depth or finding.id == "colour-blank"):
            return [finding]
    return [] if with_depth else [finding_of("no-depth", None)]


def _empty(streams: Streams) -> Finding | None:
    for id, count in (("colour-blank", streams.dark), ("depth-empty", streams.empty)):
        if count >= 0.5 * streams.frames:
            return finding_of(id, count / streams.frames, count=count, frames=streams.frames)
    return None


def _frozen(streams: Streams) -> Finding | None:
    colour = streams.colour_run >= FROZEN_FRAMES
    depth = streams.depth_run >= FROZEN_FRAMES
    if colour == depth:  # a rendered camera at rest repeats both; the truth says whether it rests
        return None
    return (
        finding_of("colour-frozen", streams.colour_run)
        if colour
        else finding_of("depth-frozen", streams.depth_run)
    )


def _swapped(streams: Streams) -> Finding | None:
    stated, swapped = np.nanmedian(np.array(streams.rough or [(np.nan, np.nan)]), axis=0)
    if not swapped < stated / 3:
        return None
    return finding_of("depth-byte-order", stated, stated=100 * stated, swapped=100 * swapped)


def _units(streams: Streams) -> Finding | None:
    median = float(np.median(streams.medians))
    factor = streams.depth_factor
    if DEPTH_RANGE_M[0] <= median <= DEPTH_RANGE_M[1]:
        return None
    likely = next((usual for usual in USUAL_FACTORS if 0.4 < median * factor / usual < 8), factor)
    return finding_of("depth-units", median, factor=factor, likely=likely)


def _flipped(streams: Streams) -> Finding | None:
    peaks = {}
    for name, (rows, columns) in FLIPS.items():
        parts = [
            _correlation(colour[::4], depth[::4, ::rows, ::columns])
            for colour, depth in streams.contours
        ]
        peaks[name] = _peak(np.sum(parts, axis=0), 8)[0]
    best = max(peaks, key=lambda name: peaks[name])
    if best == "" or peaks[best] < CLEAR_PEAK or peaks[best] < 1.4 * peaks[""]:
        return None
    return finding_of("colour-flipped", peaks[best], how=best, stored=peaks[""])


def _asynchronous(streams: Streams) -> Finding | None:
    rows = np.concatenate([_agreements(colour, depth) for colour, depth in streams.contours])
    pairs = np.isfinite(rows).sum(axis=0)
    usable = pairs >= max(10, 0.3 * len(rows))
    surfaces, _ = _by_delay(streams, range(-MOST_DELAY, MOST_DELAY + 1))
    peaks = np.array(
        [
            _peak(surface, 30)[0] if good else 0.0
            for surface, good in zip(surfaces, usable, strict=True)
        ]
    )
    mean = np.where(usable, np.nansum(rows, axis=0) / np.maximum(pairs, 1), -np.inf)
    column = int(np.argmax(mean))
    delay = float(column - MOST_DELAY)
    if abs(delay) < LEAST_DELAY or peaks[column] < CLEAR_PEAK:
        return None
    near = slice(MOST_DELAY - 1, MOST_DELAY + 2)
    reference = MOST_DELAY - 1 + int(np.argmax(mean[near]))
    better = rows[:, column] - rows[:, reference]
    better = better[np.isfinite(better)]
    sure = float(better.mean() / max(better.std() / np.sqrt(len(better) / 5), 1e-9))
    if (
        sure < 4
        or mean[column] < 1.25 * max(mean[reference], 0)
        or peaks[column] < 1.1 * peaks[near].max()
    ):
        return None
    around = mean[max(column - 1, 0) : column + 2]
    # the vertex of the parabola through the peak
    if len(around) == 3 and np.isfinite(around).all():
        delay += float((around[0] - around[2]) / (2 * (around[0] - 2 * around[1] + around[2])))
    seconds = delay * streams.seconds_a_frame
    better = mean[column] / max(mean[MOST_DELAY], 0.01)
    side, change = ("before", "earlier") if delay > 0 else ("after", "later")
    return finding_of(
        "depth-delay",
        seconds,
        delay=abs(delay),
        s=abs(seconds),
        side=side,
        change=change,
        better=better,
    )


def _agreements(colour_maps: Map, depth_maps: Map) -> NDArray[np.float64]:
    """Correlation of the contours of each colour image with those of depth images before and after it.

    ``[N, 2 * MOST_DELAY + 1]``; NaN beyond the stretch.
    """
    colour, depth = (
        np.stack([cv2.GaussianBlur(contours, (0, 0), 1.0).ravel() for contours in maps])
        for maps in (colour_maps, depth_maps)
    )
    products = colour @ depth.T
    scores = np.full((len(colour), 2 * MOST_DELAY + 1), np.nan)
    for column, delay in enumerate(range(-MOST_DELAY, MOST_DELAY + 1)):
        diagonal = np.diagonal(products, delay)
        first = max(0, -delay)
        scores[first : first + len(diagonal), column] = diagonal
    return scores


def _shifted(streams: Streams) -> Finding | None:
    sums, pairs = _by_delay(streams, range(-1, 2))
    middle = sums / np.maximum(pairs, 1)[:, None, None]
    peaks = [(*_peak(surface, 30), surface) for surface in middle]
    clear, (row, column), surface = max(peaks, key=lambda peak: float(peak[2][peak[1]]))
    shape = middle.shape[1:]
    down = (row + shape[0] // 2) % shape[0] - shape[0] // 2
    right = (column + shape[1] // 2) % shape[1] - shape[1] // 2
    size = float(np.hypot(down, right)) * streams.cell_px
    rolled = np.roll(middle, (2, 2), (1, 2))[:, :5, :5]
    if size < LEAST_SHIFT_PX or clear < CLEAR_PEAK or surface[row, column] < 1.4 * rolled.max():
        return None
    return finding_of(
        "depth-not-registered", size, right=-right * streams.cell_px, down=-down * streams.cell_px
    )


def _peak(surface: Map, reach: int) -> tuple[float, tuple[int, int]]:
    """Height in standard deviations and place of the peak within `reach` cells of no shift."""
    height, width = surface.shape
    reach_y = min(reach, height // 2 - 1)
    reach_x = min(reach, width // 2 - 1)
    near = np.roll(surface, (reach_y, reach_x), (0, 1))[: 2 * reach_y + 1, : 2 * reach_x + 1]
    y, x = np.unravel_index(int(near.argmax()), near.shape)
    deviation = (float(near[y, x]) - float(surface.mean())) / max(float(surface.std()), 1e-12)
    return deviation, ((int(y) - reach_y) % height, (int(x) - reach_x) % width)


# Does the ground truth of a recording agree with the motion that its images show?
#
# The motion between frames (`rgbd_motion`) is compared with that of the truth: as stored, shifted
# in time, inverted, with its quaternions read in the other order, in other axes. Where the two
# agree, camera and depth are measured by them.

total = attrgetter("total")

LARGEST_SHIFT_S = 2.0
SAME_FRAME_S = 0.02
LEAST_COVERAGE = 0.15
LEAST_PAIRS = 8
REST_PX = 2.0
GOOD = 0.75
"""`Match.total` of a truth that agrees with the motion; 0.78 to 0.98 in healthy recordings, else up to 0.5."""
SURE = 0.86
"""The same for a shift in time of a recording that is shorter than the range of shifts searched, or has few pairs: one
of 160 shifts fits by chance to 0.84."""
MANY_PAIRS = 25
UNLIKE = 0.6
LEAST_TIME_S = 0.05
UNRELATED = 0.48
"""The best agreement of a truth of another recording stays below; where moving things fill the view it is 0.55."""
LEAST_UNLIKE = 12
LEAST_SHARE = 0.1
BEYOND_CHANCE = 1.3
"""Share of the corners that a truth of this recording explains at least, also where people fill the view, and its ratio
to the largest share with the truth's motions in another order: 1.4 and more on 55 recordings."""
LEAST_UNIT = 30.0
"""Ratio of true to measured translations from which the truth's unit is no metre: no depth factor is that wrong."""
_STEP_S = 0.025
MARKERS: Mapping[str, Matrix] = {"bonn": BONN_R_BODY_CAM}
"""Rotations from a camera's axes to those of the markers on it, of data sets whose truth is that of the markers."""
_MISREAD = {
    "inverted": "truth-inverted",
    "w first": "truth-quaternion-order",
    "w first, inverted": "truth-quaternion-order/inverted",
    "rotations inverted": "truth-inverted/rotations",
}


def truth_findings(
    stamps: Array, truth: Trajectory | None, camera: Camera, pairs: list[RgbdPair]
) -> list[Finding]:
    """What the truth of a recording does not share with its images, then what camera and depth do not.

    Args:
        stamps: Stamps of the frames.
        truth: Poses at their stamps; None if there are none.
        camera: The stated camera.
        pairs: Pairs of frames and their motions.
    """
    if truth is None:
        return [finding_of("no-truth", None)]
    begin, end = truth.timestamps[[0, -1]]
    apart = max(begin - stamps[-1], stamps[0] - end)
    if apart > 0:
        return [
            finding_of(
                "truth-other-sequence/time",
                apart,
                begin=begin,
                end=end,
                first=stamps[0],
                last=stamps[-1],
            )
        ]
    covered = int((nearest_gap(stamps, truth.timestamps) < SAME_FRAME_S).sum())
    if covered < max(LEAST_COVERAGE * len(stamps), 3):
        return [finding_of("truth-sparse", covered, frames=len(stamps), within=SAME_FRAME_S)]
    usable = [
        pair for pair in pairs if pair.T_first_second is not None and pair.inliers.mean() >= 0.5
    ]
    displacement = float(np.median([pair.displacement_px for pair in usable])) if usable else np.inf
    if displacement < REST_PX and len(usable) >= 3:
        return [_at_rest(TruthMotion(truth), camera, motions_of(usable, stamps), displacement)]
    if len(usable) < LEAST_PAIRS:
        return [finding_of("motion-unmeasured", len(usable), pairs=len(pairs), least=LEAST_PAIRS)]
    return _compared(
        stamps,
        truth,
        camera,
        [pair for pair in usable if pair.displacement_px >= REST_PX],
        len(pairs),
    )


def _at_rest(truth: TruthMotion, camera: Camera, motions: Motions, displacement: float) -> Finding:
    """Images that do not move beside a truth that does, or does not either."""
    _, relative, turns, valid = truth.between(motions.start, motions.end)
    moves = (
        np.linalg.norm(turns, axis=1) + np.linalg.norm(relative[:, :3, 3], axis=1) / motions.depth_m
    )
    expected = camera.fx * float(np.median(moves[valid])) if valid.any() else 0.0
    if expected > 10 * REST_PX:
        return finding_of("truth-other-sequence/rest", expected, displacement=displacement)
    return finding_of("no-motion", displacement)


def _compared(
    stamps: Array,
    truth: Trajectory,
    camera: Camera,
    pairs: list[RgbdPair],
    tried: int,
    markers: Mapping[str, Matrix] = MARKERS,
) -> list[Finding]:
    """What is found of a truth that shares time with images that move; its poses may be those of `markers`."""
    motions = motions_of(pairs, stamps)
    readings = {reading: TruthMotion(truth, reading) for reading in READINGS}
    steps = round(LARGEST_SHIFT_S / _STEP_S)
    # exact multiples: the same limits early and late
    shifts = _STEP_S * np.arange(-steps, steps + 1)
    every = [
        match(motions, readings[name], name, float(shift)) for name in READINGS for shift in shifts
    ]
    matches = [candidate for candidate in every if candidate.share >= 0.5]
    near = [
        one for one in matches if one.reading == READINGS[0] and abs(one.shift_s) < LEAST_TIME_S
    ]
    if not near or sum(near[0].weights) < 0.4:
        return [finding_of("motion-unmeasured/small", len(pairs))]
    stated = max(near, key=total)
    best = max(matches, key=total)
    unshifted = min(near, key=lambda one: abs(one.shift_s))
    if unshifted.total > stated.total - 0.02:
        stated = unshifted
    for rig, R_body_cam in markers.items():
        in_axes = truth.with_poses(in_camera_axes(truth.T_world_cam, R_body_cam))
        if _is_turned(motions, in_axes, stated):
            angle = _degrees(nearest_rotation(R_body_cam))
            note = finding_of("truth-markers", angle, rig=rig, name=rig.capitalize())
            return [note, *_compared(stamps, in_axes, camera, pairs, tried, {})]
    differs = best.reading != READINGS[0] or abs(best.shift_s) >= LEAST_TIME_S
    long = (
        len(pairs) >= MANY_PAIRS
        and float((motions.end - motions.start).sum()) >= 2 * LARGEST_SHIFT_S
    )
    needed = GOOD if long or abs(best.shift_s) < LEAST_TIME_S else SURE
    now = stated.clearest
    then = best.clearest
    if differs and then >= needed and 1 - then < 0.65 * (1 - now) and now < then - 0.05:
        as_stated = readings[stated.reading].between(
            motions.start + stated.shift_s, motions.end + stated.shift_s
        )[1]
        as_best = readings[best.reading].between(
            motions.start + best.shift_s, motions.end + best.shift_s
        )[1]
        # where people fill the view, another reading may fit their motion, but not that of the
        # background
        if explained_share(pairs, as_best, camera) > explained_share(pairs, as_stated, camera):
            turned = (
                None
                if best.reading == READINGS[0]
                else _turned(motions, readings[READINGS[0]], stated, best)
            )
            return _misread(motions, readings, stated, best) if turned is None else [turned]
    if stated.rotation >= UNLIKE and stated.weights[0] >= 0.3:
        return _measured(motions, readings[READINGS[0]], stated, camera, pairs)
    share, by_chance = _in_other_orders(motions, readings[READINGS[0]], stated, camera, pairs)
    if share > max(LEAST_SHARE, BEYOND_CHANCE * by_chance):
        return [
            finding_of("truth-unclear/moving", share, share=100 * share, by_chance=100 * by_chance)
        ]
    return _otherwise(motions, readings, stated, best, tried)


def _in_other_orders(
    motions: Motions, truth: TruthMotion, stated: Match, camera: Camera, pairs: list[RgbdPair]
) -> tuple[float, float]:
    """The share of corners that the truth explains, and the largest one with its motions in another order.

    Of a truth of another recording all orders explain as much.
    """
    relative = truth.between(motions.start + stated.shift_s, motions.end + stated.shift_s)[1]
    others = [
        explained_share(pairs, np.roll(relative, by, axis=0), camera) for by in range(1, len(pairs))
    ]
    return explained_share(pairs, relative, camera), max(others, default=1.0)


def _is_turned(motions: Motions, turned: Trajectory, stated: Match) -> bool:
    """Whether the rotations agree with a turned truth, and do not with the truth as it is stated."""
    if stated.rotation >= UNLIKE or stated.weights[0] < 0.3:
        return False
    alike = match(motions, TruthMotion(turned), READINGS[0], stated.shift_s).rotation
    return alike >= UNLIKE and 1 - alike < 0.65 * (1 - stated.rotation)


def _misread(
    motions: Motions, readings: dict[str, TruthMotion], stated: Match, best: Match
) -> list[Finding]:
    findings = []
    fine = [
        match(motions, readings[best.reading], best.reading, best.shift_s + d)
        for d in np.arange(-5, 6) * 0.005
    ]
    shift = max(fine, key=total).shift_s
    shares = {"then": 100 * best.clearest, "now": 100 * stated.clearest}
    if best.reading != READINGS[0]:
        findings.append(finding_of(_MISREAD[best.reading], best.total, **shares))
    if abs(shift) >= LEAST_TIME_S:
        case = "truth-time-shift/late" if shift > 0 else "truth-time-shift/early"
        findings.append(finding_of(case, shift, s=abs(shift), **shares))
    return findings


def _otherwise(
    motions: Motions, readings: dict[str, TruthMotion], stated: Match, best: Match, tried: int
) -> list[Finding]:
    """A truth that agrees with the motion in no convention: in other axes, or not at all."""
    closest = best.total
    turned = 0.0, np.eye(3)  # the best agreement in other axes of the file as it is, and these axes
    for reading in READINGS[:3]:
        for shift in np.arange(-4, 5) * 0.025 if reading == READINGS[0] else (0.0,):
            _, _, turns, valid = readings[reading].between(
                motions.start + shift, motions.end + shift
            )
            if valid.mean() < 0.5:
                continue
            measured = motions.rotation[valid]
            true = turns[valid]
            X = rotation_between(measured, true)
            alike = agreement(measured @ X.T, true, ROTATION_GAIN)
            closest = max(closest, alike)
            if alike > turned[0] and reading == READINGS[0]:
                turned = alike, X
    if turned[0] >= GOOD:
        return [_axes(turned[1], turned[0], stated)]
    enough = (
        stated.weights[0] >= 0.5
        and len(motions.start) >= LEAST_UNLIKE
        and len(motions.start) >= 0.5 * tried
    )
    if enough and closest < UNRELATED:
        facts = {"share": 100 * closest, "pairs": len(motions.start), "limit": LARGEST_SHIFT_S}
        return [finding_of("truth-other-sequence", closest, **facts)]
    return [finding_of("truth-unclear", stated.total, share=100 * stated.total)]


def _turned(motions: Motions, truth: TruthMotion, stated: Match, best: Match) -> Finding | None:
    """Other axes, where these explain rotations and translations better than another reading of the file."""
    _, relative, turns, valid = truth.between(motions.start, motions.end)
    X = rotation_between(motions.rotation[valid], turns[valid])
    rotation = agreement(motions.rotation[valid] @ X.T, turns[valid], ROTATION_GAIN)
    translation = agreement(motions.translation[valid] @ X.T, relative[valid, :3, 3])
    total = weighted_mean(rotation, translation, stated.weights)
    return _axes(X, rotation, stated) if total > best.total + 0.03 else None


def _degrees(X: Array) -> float:
    """The angle of an orthogonal matrix."""
    return float(np.degrees(np.arccos(np.clip((np.trace(X) - 1) / 2, -1, 1))))


def _axes(X: Array, alike: float, stated: Match) -> Finding:
    return finding_of(
        "truth-axes", _degrees(X), then=100 * alike, now=100 * stated.rotation, matrix=_turn(X)
    )


def _turn(R_body_cam: Array) -> str:
    """The rotation that gives a truth the camera's axes; one within 20 degrees of swapped axes is written as such."""
    swapped = np.round(R_body_cam)
    is_rotation = np.array_equal(swapped @ swapped.T, np.eye(3)) and not np.array_equal(
        swapped, np.eye(3)
    )
    near = is_rotation and np.trace(swapped.T @ R_body_cam) > 1 + 2 * np.cos(np.radians(20))
    rows = [
        ", ".join(f"{value:g}" for value in row)
        for row in (swapped if near else R_body_cam.round(3)) + 0.0
    ]
    return "; ".join(rows)


def _measured(
    motions: Motions, truth: TruthMotion, stated: Match, camera: Camera, pairs: list[RgbdPair]
) -> list[Finding]:
    """Of a truth whose rotations are the camera's: units, positions' axes, then camera, depth and lever arm."""
    start = motions.start + stated.shift_s
    end = motions.end + stated.shift_s
    first, relative, turns, valid = truth.between(start, end)
    size = (
        np.linalg.norm(motions.rotation, axis=1)
        + np.linalg.norm(turns, axis=1)
        + 2 * ROTATION_NOISE
    )
    agreeing = valid & (np.linalg.norm(motions.rotation - turns, axis=1) < 0.5 * size)
    if agreeing.sum() < LEAST_PAIRS:
        return [
            finding_of(
                "depth-factor-unmeasured/pairs", agreeing.sum(), pairs=len(pairs), least=LEAST_PAIRS
            )
        ]
    if 1 / stated.gain > LEAST_UNIT and 0.15 < motions.depth_m < 20:
        unit, divisor = ("millimetres", 1000) if 1 / stated.gain > 300 else ("centimetres", 100)
        return [
            finding_of(
                "truth-scale", 1 / stated.gain, depth_m=motions.depth_m, unit=unit, divisor=divisor
            )
        ]
    used = [pair for pair, use in zip(pairs, agreeing, strict=True) if use]
    relative = relative[agreeing]
    before = fit_camera(used, relative, camera, ())
    fits = {name: fit_camera(used, relative, camera, names) for name, names in _GROUPS.items()}
    best = min(fits, key=lambda group: fits[group].cost)
    explained = _explains(best, fits[best], before, used)
    if explained and best != "scale":
        return [_fitted(best, fits[best], before, camera)]
    if not explained and stated.weights[1] >= 0.4 and stated.translation < UNLIKE:
        in_other_axes = _positions(
            motions.translation[agreeing], first[agreeing, :3, :3], relative, stated
        )
        if in_other_axes is not None:
            finding, turned = in_other_axes
            if explained_share(used, turned, camera) > explained_share(used, relative, camera):
                return [finding]
    first_guess = float(np.exp(-fits["scale"].value["scale"][0]))
    share = float(np.median([pair.depth_share for pair in used]))
    if share < _LEAST_DEPTH:
        facts = {
            "percent": 100 * share,
            "new": first_guess * camera.written_depth_factor,
            "old": camera.depth_factor,
        }
        case = "depth-factor/depth" if explained else "depth-factor-unmeasured/depth"
        return [finding_of(case, 1 / first_guess, **facts)]
    scale = depth_scale(used, truth, start[agreeing], end[agreeing], camera, first_guess)
    if scale is None:
        return [finding_of("depth-factor-unmeasured/still", None)]
    return _scale(scale, camera, sure=explained or scale.low <= first_guess <= scale.high)


def _scale(scale: DepthScale, camera: Camera, *, sure: bool) -> list[Finding]:
    """A depth factor that the truth's translations exclude, or a note that they leave it open.

    Args:
        scale: Lengths that the depth images give, as multiples of the truth's.
        camera: The stated camera.
        sure: Whether the reprojection errors agree.
    """
    old = camera.written_depth_factor
    interval = {"low": _three_digits(scale.low * old), "high": _three_digits(scale.high * old)}
    if scale.excludes(_LIMITS["scale"]) and sure:
        new = scale.value * old
        usual = [factor for factor in USUAL_FACTORS if scale.low <= factor / old <= scale.high]
        likely = min(usual, key=lambda factor: abs(np.log(factor / new)), default=new)
        why = ", the usual value within the interval" if usual else ""
        return [
            finding_of(
                "depth-factor",
                1 / scale.value,
                new=new,
                old=old,
                likely=likely,
                why=why,
                **interval,
            )
        ]
    if scale.excludes(_LIMITS["scale"]):
        return [finding_of("depth-factor-unmeasured/apart", None, **interval)]
    if scale.high > _WIDEST * scale.low:
        return [finding_of("depth-factor-unmeasured", None, **interval)]
    return []


def _three_digits(value: float) -> str:
    """A number with three significant digits and no exponent."""
    return f"{float(f'{value:.3g}'):g}"


def _positions(
    steps: Array, R_world_first: Array, relative: Array, stated: Match
) -> tuple[Finding, Array] | None:
    """Positions in other axes than the orientations, or mirrored.

    Args:
        steps: Measured translations in the first camera's axes ``[N, 3]``.
        R_world_first: The truth's rotations at the first frames ``[N, 3, 3]``.
        relative: The truth's motions ``[N, 4, 4]``.
        stated: How well the truth agrees as it is.

    Returns:
        The finding, and the motions with positions in the orientations' axes; None where these
        explain little.
    """
    to_world = R_world_first, np.swapaxes(R_world_first, 1, 2)
    stays = np.broadcast_to(np.eye(3), R_world_first.shape)
    for where, (R, back) in (("world", to_world), ("camera", (stays, stays))):
        measured = np.einsum("nij,nj->ni", R, steps)
        true = np.einsum("nij,nj->ni", R, relative[:, :3, 3])
        W = rotation_between(measured, true, proper=False)
        alike = agreement(measured @ W.T, true)
        angle = _degrees(W)
        if (
            alike >= GOOD
            and alike > stated.translation + 0.2
            and (np.linalg.det(W) < 0 or angle > 15)
        ):
            how = "mirrored" if np.linalg.det(W) < 0 else f"turned by {angle:.0f} degrees"
            shares = {"then": 100 * alike, "now": 100 * stated.translation}
            turned = relative.copy()
            turned[:, :3, 3] = np.einsum("nij,nj->ni", back, true @ W)
            return finding_of("truth-axes/positions", angle, how=how, where=where, **shares), turned
    return None


def _explains(name: str, fit: Fit, before: Fit, pairs: list[RgbdPair]) -> bool:
    """Whether a fitted value explains the reprojection errors so well that it is at fault."""
    size = float(np.linalg.norm([fit.value[part] for part in _GROUPS[name]]))
    sigma = float(np.linalg.norm([fit.sigma[part] for part in _GROUPS[name]]))
    left = fit.cost / before.cost
    rules = _EXPLAINED if name != "lever" else _EXPLAINED_BY_LEVER
    if name == "lever" and float(np.median([pair.depth_share for pair in pairs])) < _LEAST_DEPTH:
        return False
    return size >= _LIMITS[name] and any(
        size >= sigmas * sigma and left <= share for sigmas, share in rules
    )


def _fitted(name: str, fit: Fit, before: Fit, camera: Camera) -> Finding:
    """A wrong focal length, principal point, axes or lever arm."""
    size = float(np.linalg.norm([fit.value[part] for part in _GROUPS[name]]))
    sigma = float(np.linalg.norm([fit.sigma[part] for part in _GROUPS[name]]))
    errors = f"reprojection errors {before.residual_px:.1f} px -> {fit.residual_px:.1f} px"
    if name == "focal":
        by = float(np.exp(fit.value["focal"][0]))
        facts = {"percent": 100 * sigma, "fx": camera.fx * by, "fy": camera.fy * by}
        return finding_of("camera-focal-length", by, errors=errors, **facts)
    if name == "centre":
        dx = float(fit.value["cx"][0])
        dy = float(fit.value["cy"][0])
        facts = {"sigma": sigma, "dx": dx, "dy": dy, "cx": camera.cx + dx, "cy": camera.cy + dy}
        return finding_of("camera-principal-point", size, errors=errors, **facts)
    if name == "turn":
        turn = se3.exp(np.concatenate([np.zeros(3), fit.value["turn"]]))[:3, :3]
        return finding_of("truth-axes/fit", np.degrees(size), errors=errors, matrix=_turn(turn))
    lever = ", ".join(f"{metres:+.3f}" for metres in fit.value["lever"])
    return finding_of("truth-lever-arm", size, errors=errors, sigma=sigma, lever=lever)


_GROUPS = {
    "focal": ("focal",),
    "centre": ("cx", "cy"),
    "scale": ("scale",),
    "turn": ("turn",),
    "lever": ("lever",),
}
_LIMITS = {"focal": 0.08, "centre": 25.0, "scale": 0.1, "turn": np.radians(6), "lever": 0.04}
"""Published recordings differ from their cameras and truths by less: Bonn's lever arm is 0.019 m."""
_EXPLAINED = ((5, 0.75), (8, 0.88))
"""Standard deviations, and the part of the errors that may remain, for one value to be at fault: 0.87 and more remain
in healthy recordings, and no value above its limit is sure to 4."""
_EXPLAINED_BY_LEVER = ((5, 0.62),)
"""People who walk past can feign one: 0.68 remained then."""
_LEAST_DEPTH = 0.5
"""Part of the image that has depth, for a lever arm or a depth factor. With less, the corners may lie on moving people
alone: of the errors that a lever arm explains 0.61 remained then, and lengths came out at 0.43 of
the true ones."""
_WIDEST = 2.0
"""Ratio of the ends of the depth factor's interval above which it counts as not compared."""


# Focal length, principal point, depth scale, axes and lever arm at which a truth fits the images
# best.


@dataclass(frozen=True)
class Fit:
    """Camera and mounting that make the truth's motion carry the corners from image to image.

    Attributes:
        value: ``focal`` and ``scale`` (of the depth) as natural logarithms of the factor, ``cx``
            and ``cy`` as pixels to be added, ``turn`` the rotation vector ``[3]`` in rad and
            ``lever`` the position ``[3]`` in metres of the camera in the frame of the body that the
            truth tracks.
        sigma: Their standard deviations, each pair of frames being one observation.
        residual_px: Median reprojection error.
        cost: Mean robust cost of a corner.
    """

    value: dict[str, Array]
    sigma: dict[str, Array]
    residual_px: float
    cost: float


_PARAMETERS = {
    "focal": slice(0, 1),
    "cx": slice(1, 2),
    "cy": slice(2, 3),
    "scale": slice(3, 4),
    "turn": slice(4, 7),
    "lever": slice(7, 10),
}
_PRIOR = np.array([1.0, 200.0, 200.0, 2.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0])
_SCALES = np.array([0.1, 10, 10, 0.1, 0.1, 0.1, 0.1, 0.1, 0.1, 0.1])
_STEPS = np.array([1e-4, 0.05, 0.05, 1e-4, 1e-4, 1e-4, 1e-4, 1e-4, 1e-4, 1e-4])
_CORNERS_A_PAIR = 25
_OUTLIER_PX = 2.0


def _reprojection_errors(
    x: Array,
    camera: Camera,
    pair: NDArray[np.intp],
    first: Array,
    depth: Array,
    second: Array,
    back: Array,
) -> Array:
    """Reprojection errors ``[N, 2]`` in pixels under the values ``[10]``.

    Args:
        x: The values, in the order of `_PARAMETERS`.
        camera: The stated camera.
        pair: The pair of each corner ``[N]``.
        first: Its pixels in the first frame ``[N, 2]``.
        depth: Its depth there ``[N]``.
        second: Its pixels in the second frame ``[N, 2]``.
        back: The truth's motions back to the second frames, of all pairs ``[M, 4, 4]``.
    """
    focal = np.exp(x[0]) * np.array([camera.fx, camera.fy])
    centre = np.array([camera.cx, camera.cy]) + x[1:3]
    rays = np.concatenate([(first - centre) / focal, np.ones((len(first), 1))], axis=1)
    mount = se3.exp(np.concatenate([np.zeros(3), x[4:7]]))
    mount[:3, 3] = x[7:10]
    moves = (se3.inverse(mount) @ back @ mount)[pair]
    moved = (
        np.einsum("nij,nj->ni", moves[:, :3, :3], np.exp(x[3]) * depth[:, None] * rays)
        + moves[:, :3, 3]
    )
    return np.asarray(moved[:, :2] / np.maximum(moved[:, 2:], 0.05) * focal + centre - second)


def fit_camera(
    pairs: list[RgbdPair], relative: Array, camera: Camera, free: tuple[str, ...]
) -> Fit:
    """Focal length, principal point, depth scale, axes and lever arm at which the truth fits the images best.

    Robust least squares of the reprojection errors of the corners of all pairs, with the truth's
    relative motions held. A weak prior keeps values that the motion does not determine near the
    stated ones.

    Args:
        pairs: Pairs of frames with a motion.
        relative: Motions of the truth between them ``[N, 4, 4]``, in the depth's units.
        camera: The stated camera.
        free: Names of what is fitted, of `Fit.value`; the rest stays as stated.
    """
    chosen = [np.flatnonzero(pair.inliers) for pair in pairs]
    chosen = [index[:: max(1, len(index) // _CORNERS_A_PAIR)][:_CORNERS_A_PAIR] for index in chosen]
    first, depth, second = (
        np.concatenate(
            [getattr(pair, name)[index] for pair, index in zip(pairs, chosen, strict=True)]
        )
        for name in ("pixels_first", "depth_first", "pixels_second")
    )
    number = np.repeat(np.arange(len(pairs)), [len(index) for index in chosen])
    back = se3.inverse(relative)
    errors = partial(
        _reprojection_errors,
        camera=camera,
        pair=number,
        first=first,
        depth=depth,
        second=second,
        back=back,
    )
    index = [number for name in free for number in np.arange(10)[_PARAMETERS[name]].tolist()]

    def filled(part: Array) -> Array:
        x = np.zeros(10)
        x[index] = part
        return x

    def robust(part: Array) -> Array:
        raw = errors(filled(part)) / _OUTLIER_PX
        square = (raw**2).sum(axis=1, keepdims=True)
        shrunk = raw * np.sqrt(2 * (np.sqrt(1 + square) - 1) / np.maximum(square, 1e-12))
        return np.concatenate([shrunk.ravel(), filled(part) / _PRIOR])

    start = np.zeros(len(index))
    part = (
        np.asarray(least_squares(robust, start, x_scale=_SCALES[index]).x, np.float64)
        if index
        else start
    )
    left = errors(filled(part))
    x = filled(part)
    # Standard deviations by a sandwich estimate, each pair of frames being one observation.
    weight = 1 / np.sqrt(1 + ((left / _OUTLIER_PX) ** 2).sum(axis=1))
    slopes = np.stack(
        [(errors(x + s) - errors(x - s)) / (2 * s.sum()) for s in np.diag(_STEPS)], axis=-1
    )
    prior = np.diag(1 / _PRIOR**2) * _OUTLIER_PX**2
    pulls = np.zeros((len(pairs), 10))
    np.add.at(pulls, number, np.einsum("npi,n,np->ni", slopes, weight, left))
    free_part = np.ix_(index, index)
    inverse = np.linalg.inv((np.einsum("npi,n,npj->ij", slopes, weight, slopes) + prior)[free_part])
    spread = inverse @ (pulls.T @ pulls + prior)[free_part] @ inverse
    deviation = np.sqrt(np.maximum(np.diag(spread), 0)) * np.sqrt(
        len(pairs) / max(len(pairs) - len(index), 1)
    )
    return Fit(
        {name: x[where] for name, where in _PARAMETERS.items()},
        {name: filled(deviation)[where] for name, where in _PARAMETERS.items()},
        float(np.median(np.linalg.norm(left, axis=1))),
        float((robust(part) ** 2).sum() / len(first)),
    )
