"""Does the ground truth of a recording agree with the motion that its images show?

The motion between frames (`rgbd_motion`) is compared with that of the truth: as stored, shifted
in time, inverted, with its quaternions read in the other order, in other axes. Where the two
agree, camera and depth are measured by them (`camera_checks`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from operator import attrgetter

import numpy as np

from dynslam_bench.geometry import Array, Camera, Trajectory, nearest_gap
from dynslam_bench.geometry.rigs import BONN_R_BODY_CAM, Matrix, in_camera_axes, nearest_rotation
from dynslam_bench.geometry.speeds import impossible_motion
from dynslam_bench.sequences.camera_checks import (
    GOOD,
    LEAST_PAIRS,
    UNLIKE,
    angle_degrees,
    axes_text,
    camera_findings,
)
from dynslam_bench.sequences.findings import Finding, finding_of
from dynslam_bench.sequences.rgbd_motion import (
    READINGS,
    ROTATION_GAIN,
    Match,
    Motions,
    RgbdPair,
    TruthMotion,
    agreement,
    explained_share,
    match,
    motions_of,
    rotation_between,
    weighted_mean,
)

LARGEST_SHIFT_S = 2.0
"""Largest shift of the truth in time that is looked for."""
SAME_FRAME_S = 0.02
"""A frame has a true pose if there is one within this time."""
LEAST_COVERAGE = 0.15
"""Share of the frames that need a true pose."""
REST_PX = 2.0
"""Median displacement of the corners below which the camera rests."""
SURE = 0.86
"""`GOOD` for a shift in time of a recording that is shorter than the range of shifts searched, or has few pairs: one
of 160 shifts fits by chance to 0.84."""
MANY_PAIRS = 25
"""Pairs from which a shift in time needs `GOOD` alone."""
LEAST_TIME_S = 0.05
"""A smaller shift in time is no fault."""
UNRELATED = 0.48
"""The best agreement of a truth of another recording stays below; where moving things fill the view it is 0.55."""
LEAST_UNLIKE = 12
"""Pairs that are needed to say that a truth is of another recording."""
LEAST_SHARE = 0.1
"""Share of the corners that a truth of this recording explains at least, also where people fill the view."""
BEYOND_CHANCE = 1.3
"""Ratio of that share to the largest one with the truth's motions in another order: 1.4 and more on 55 recordings."""
MARKERS: Mapping[str, Matrix] = {"bonn": BONN_R_BODY_CAM}
"""Rotations from a camera's axes to those of the markers on it, of data sets whose truth is that of the markers."""
_STEP_S = 0.025
"""Step of the search for a shift in time."""
_FINE_STEP_S = 0.005
"""Step of the search around the best one."""
_STORED = READINGS[0]
_MISREAD = {
    "inverted": "truth-inverted",
    "w first": "truth-quaternion-order",
    "w first, inverted": "truth-quaternion-order/inverted",
    "rotations inverted": "truth-inverted/rotations",
}
"""The finding of a truth that agrees when it is read in another convention."""

_total = attrgetter("total")


def truth_findings(
    stamps: Array, truth: Trajectory | None, camera: Camera, pairs: list[RgbdPair]
) -> list[Finding]:
    """Findings on what the truth of a recording does not share with its images, then on camera and depth.

    Args:
        stamps: Stamps of the frames.
        truth: Poses at their stamps; None if there are none.
        camera: The stated camera.
        pairs: Pairs of frames and their motions.
    """
    # do truth and images share time?
    if truth is None:
        return [finding_of("no-truth", None)]
    begin, end = truth.timestamps[[0, -1]]
    first = stamps[0]
    last = stamps[-1]
    apart = max(begin - last, first - end)
    if apart > 0:
        case = "truth-other-sequence/time"
        return [finding_of(case, apart, begin=begin, end=end, first=first, last=last)]
    covered = int((nearest_gap(stamps, truth.timestamps) < SAME_FRAME_S).sum())
    if covered < max(LEAST_COVERAGE * len(stamps), 3):
        return [finding_of("truth-sparse", covered, frames=len(stamps), within=SAME_FRAME_S)]

    # a pose that no camera reaches
    motion = impossible_motion(truth, "ground truth")
    if motion is not None and motion.of_single_poses:
        return [finding_of("truth-far", None, text=motion.fault)]

    # a wrong unit of all poses shows in the comparison with the images, if one can be made
    findings = _findings_by_images(stamps, truth, camera, pairs)
    if motion is not None and all(finding.severity == "note" for finding in findings):
        findings.insert(0, finding_of("truth-far/all", None, text=motion.fault))
    return findings


def _findings_by_images(
    stamps: Array, truth: Trajectory, camera: Camera, pairs: list[RgbdPair]
) -> list[Finding]:
    """Findings on what the truth does not share with the motion that the images show; see `truth_findings`."""
    usable = [
        pair for pair in pairs if pair.T_first_second is not None and pair.inliers.mean() >= 0.5
    ]
    displacement = float(np.median([pair.displacement_px for pair in usable])) if usable else np.inf
    if displacement < REST_PX and len(usable) >= 3:
        motions = motions_of(usable, stamps)
        return [_rest_finding(TruthMotion(truth), camera, motions, displacement)]
    if len(usable) < LEAST_PAIRS:
        return [finding_of("motion-unmeasured", len(usable), pairs=len(pairs), least=LEAST_PAIRS)]
    moving = [pair for pair in usable if pair.displacement_px >= REST_PX]
    return _compare(stamps, truth, camera, moving, len(pairs), MARKERS)


def _rest_finding(
    truth: TruthMotion, camera: Camera, motions: Motions, displacement: float
) -> Finding:
    """Images that do not move beside a truth that does, or does not either."""
    _, relative, turns, valid = truth.between(motions.start, motions.end)
    # angles by which rotation and translation move a pixel at the median depth.
    rotation = np.linalg.norm(turns, axis=1)
    translation = np.linalg.norm(relative[:, :3, 3], axis=1)
    angles = rotation + translation / motions.depth_m
    expected = camera.fx * float(np.median(angles[valid])) if valid.any() else 0.0
    if expected > 10 * REST_PX:
        return finding_of("truth-other-sequence/rest", expected, displacement=displacement)
    return finding_of("no-motion", displacement)


@dataclass(frozen=True)
class _Search:
    """The measured motions, and how well the truth agrees with them in each convention.

    Attributes:
        pairs: Pairs of frames with a motion.
        motions: Motions of these pairs by the images.
        camera: The stated camera.
        readings: The truth read in each convention, by name.
        stated: The best agreement of the truth as it is stored.
        best: The best agreement in any convention and under any shift in time.
    """

    pairs: list[RgbdPair]
    motions: Motions
    camera: Camera
    readings: dict[str, TruthMotion]
    stated: Match
    best: Match

    def relative(self, candidate: Match) -> Array:
        """The truth's motions ``[N, 4, 4]`` under a convention and a shift in time."""
        start = self.motions.start + candidate.shift_s
        end = self.motions.end + candidate.shift_s
        return self.readings[candidate.reading].between(start, end)[1]

    def explained(self, candidate: Match) -> float:
        """Share of the corners that these motions explain."""
        return explained_share(self.pairs, self.relative(candidate), self.camera)


def _compare(
    stamps: Array,
    truth: Trajectory,
    camera: Camera,
    pairs: list[RgbdPair],
    tried: int,
    markers: Mapping[str, Matrix],
) -> list[Finding]:
    """Compare a truth with images that move and share time with it.

    Args:
        stamps: Stamps of the frames.
        truth: Poses at their stamps.
        camera: The stated camera.
        pairs: Pairs of frames with a motion, in which the image moves.
        tried: How many pairs there are with those whose motion is not known.
        markers: Rotations of rigs whose markers' poses the truth may hold.
    """
    search = _search(stamps, truth, camera, pairs)
    if search is None:
        return [finding_of("motion-unmeasured/small", len(pairs))]
    stated = search.stated

    # a truth of published markers is compared in the camera's axes.
    for rig, R_body_cam in markers.items():
        in_axes = truth.with_poses(in_camera_axes(truth.T_world_cam, R_body_cam))
        if _agrees_instead(search.motions, in_axes, stated):
            angle = angle_degrees(nearest_rotation(R_body_cam))
            note = finding_of("truth-markers", angle, rig=rig, name=rig.capitalize())
            return [note, *_compare(stamps, in_axes, camera, pairs, tried, {})]

    # a truth that agrees in another convention or under a shift in time; where people fill the
    # view, another reading may fit their motion, but not that of the background.
    if _is_clearly_better(search) and search.explained(search.best) > search.explained(stated):
        in_other_axes = None
        if search.best.reading != _STORED:
            in_other_axes = _other_axes_finding(search)
        return _misread_findings(search) if in_other_axes is None else [in_other_axes]

    # a truth that agrees as it is stored measures camera and depth.
    if stated.rotation >= UNLIKE and stated.weights[0] >= 0.3:
        return camera_findings(search.motions, search.readings[_STORED], stated, camera, pairs)

    # a truth of this recording whose motion is not the one on which most corners agree.
    share, by_chance = _shares_by_order(search)
    if share > max(LEAST_SHARE, BEYOND_CHANCE * by_chance):
        case = "truth-unclear/moving"
        return [finding_of(case, share, share=100 * share, by_chance=100 * by_chance)]
    return _disagreement_findings(search, tried)


def _search(
    stamps: Array, truth: Trajectory, camera: Camera, pairs: list[RgbdPair]
) -> _Search | None:
    """Compare the truth with the motions in all conventions and under all shifts in time; None where they are small."""
    # every convention under every shift, where the truth has poses for half of the motions
    motions = motions_of(pairs, stamps)
    readings = {reading: TruthMotion(truth, reading) for reading in READINGS}
    steps = round(LARGEST_SHIFT_S / _STEP_S)
    # exact multiples: the same limits early and late
    shifts = _STEP_S * np.arange(-steps, steps + 1)
    matches = []
    for name in READINGS:
        for shift in shifts:
            candidate = match(motions, readings[name], name, float(shift))
            if candidate.share >= 0.5:
                matches.append(candidate)

    # as it is stored, with a small shift at most
    as_stored = [
        candidate
        for candidate in matches
        if candidate.reading == _STORED and abs(candidate.shift_s) < LEAST_TIME_S
    ]
    if not as_stored or sum(as_stored[0].weights) < 0.4:
        return None

    # the unshifted truth, unless a small shift fits better.
    stated = max(as_stored, key=_total)
    unshifted = min(as_stored, key=lambda candidate: abs(candidate.shift_s))
    if unshifted.total > stated.total - 0.02:
        stated = unshifted
    return _Search(pairs, motions, camera, readings, stated, max(matches, key=_total))


def _agrees_instead(motions: Motions, turned: Trajectory, stated: Match) -> bool:
    """Whether the rotations agree with a turned truth, and do not with the truth as it is stated."""
    if stated.rotation >= UNLIKE or stated.weights[0] < 0.3:
        return False
    alike = match(motions, TruthMotion(turned), _STORED, stated.shift_s).rotation
    return alike >= UNLIKE and 1 - alike < 0.65 * (1 - stated.rotation)


def _is_clearly_better(search: _Search) -> bool:
    """Whether the truth agrees in another convention or under a shift in time, and much worse as it is stored."""
    best = search.best
    shifted = abs(best.shift_s) >= LEAST_TIME_S
    if best.reading == _STORED and not shifted:
        return False

    # a shift of a short recording may fit by chance
    duration_s = float((search.motions.end - search.motions.start).sum())
    long = len(search.pairs) >= MANY_PAIRS and duration_s >= 2 * LARGEST_SHIFT_S
    needed = GOOD if long or not shifted else SURE

    # the best agreement is good, and much better than that of the truth as it is stored
    as_stored = search.stated.clearest
    otherwise = best.clearest
    much_better = 1 - otherwise < 0.65 * (1 - as_stored) and as_stored < otherwise - 0.05
    return otherwise >= needed and much_better


def _misread_findings(search: _Search) -> list[Finding]:
    """The convention in which the truth agrees, and its shift in time to a few milliseconds."""
    # the shift in finer steps
    best = search.best
    fine = [
        match(search.motions, search.readings[best.reading], best.reading, best.shift_s + offset)
        for offset in np.arange(-5, 6) * _FINE_STEP_S
    ]
    shift = max(fine, key=_total).shift_s
    # how much of the images' motion the truth explains: in the best convention, and as it is stored
    shares = {"percent_cured": 100 * best.clearest, "percent_stored": 100 * search.stated.clearest}

    # both may be found
    findings = []
    if best.reading != _STORED:
        findings.append(finding_of(_MISREAD[best.reading], best.total, **shares))
    if abs(shift) >= LEAST_TIME_S:
        case = "truth-time-shift/late" if shift > 0 else "truth-time-shift/early"
        findings.append(finding_of(case, shift, s=abs(shift), **shares))
    return findings


def _other_axes_finding(search: _Search) -> Finding | None:
    """Other axes, where these explain rotations and translations better than another reading of the file."""
    # agreement after the axes are turned as rotations and translations fit best
    motions = search.motions
    truth = search.readings[_STORED]
    _, relative, turns, valid = truth.between(motions.start, motions.end)
    X = rotation_between(motions.rotation[valid], turns[valid])
    rotation = agreement(motions.rotation[valid] @ X.T, turns[valid], ROTATION_GAIN)
    translation = agreement(motions.translation[valid] @ X.T, relative[valid, :3, 3])
    total = weighted_mean(rotation, translation, search.stated.weights)
    if total > search.best.total + 0.03:
        return _axes_finding(X, rotation, search.stated)
    return None


def _axes_finding(X: Array, alike: float, stated: Match) -> Finding:
    """A truth whose axes are turned by `X` ``[3, 3]`` against the camera's."""
    return finding_of(
        "truth-axes",
        angle_degrees(X),
        percent_cured=100 * alike,
        percent_stored=100 * stated.rotation,
        matrix=axes_text(X),
    )


def _shares_by_order(search: _Search) -> tuple[float, float]:
    """The share of corners that the truth explains, and the largest one with its motions in another order.

    Of a truth of another recording all orders explain as much.
    """
    pairs = search.pairs
    relative = search.relative(search.stated)
    others = [
        explained_share(pairs, np.roll(relative, by, axis=0), search.camera)
        for by in range(1, len(pairs))
    ]
    return explained_share(pairs, relative, search.camera), max(others, default=1.0)


def _disagreement_findings(search: _Search, tried: int) -> list[Finding]:
    """A truth that agrees with the motion in no convention: in other axes, or not at all."""
    motions = search.motions
    stated = search.stated
    # The best agreement in other axes of the file as it is, and these axes.
    best_alike = 0.0
    best_axes = np.eye(3)
    closest = search.best.total
    for reading in READINGS[:3]:
        shifts = np.arange(-4, 5) * _STEP_S if reading == _STORED else (0.0,)
        for shift in shifts:
            _, _, turns, valid = search.readings[reading].between(
                motions.start + shift, motions.end + shift
            )
            if valid.mean() < 0.5:
                continue
            # the axes in which the rotations agree best, and how well they do
            measured = motions.rotation[valid]
            true = turns[valid]
            X = rotation_between(measured, true)
            alike = agreement(measured @ X.T, true, ROTATION_GAIN)
            closest = max(closest, alike)
            if alike > best_alike and reading == _STORED:
                best_alike = alike
                best_axes = X
    if best_alike >= GOOD:
        return [_axes_finding(best_axes, best_alike, stated)]

    # a truth of another recording agrees in no axes; else too little is seen to tell
    count = len(motions.start)
    enough = stated.weights[0] >= 0.5 and count >= LEAST_UNLIKE and count >= 0.5 * tried
    if enough and closest < UNRELATED:
        facts = {"share": 100 * closest, "pairs": count, "limit": LARGEST_SHIFT_S}
        return [finding_of("truth-other-sequence", closest, **facts)]
    return [finding_of("truth-unclear", stated.total, share=100 * stated.total)]
