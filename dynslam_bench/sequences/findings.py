"""The table of findings that a check of a recording can make, with their texts and what to change."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

Severity = Literal["fault", "note"]
"""See `Finding.severity`."""


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
"""The cure of a truth that is not in TUM's format."""
_SO = (
    "so they explain {percent_cured:.0f} % of the images' motion, as stored {percent_stored:.0f} %"
)
"""Words on the shares of the motion that the truth explains after the cure, and before."""
_FINDINGS: dict[str, tuple[str, str, str]] = {
    # Files that cannot be read, and recordings that are too short.
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
    # Single images.
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
    # Colour and depth beside each other.
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
    # Whether images and ground truth can be compared.
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
    "truth-far": ("", "{text}", "correct that line of groundtruth.txt, or remove it"),
    "truth-far/all": (
        "",
        "{text}, and the images tell no other motion",
        "give the positions of groundtruth.txt in metres",
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
    # Conventions of the ground truth.
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
        "the truth is {s:.3f} s late: so it explains {percent_cured:.0f} % of the images' motion, "
        "as stored {percent_stored:.0f} %",
        "subtract {s:.3f} s from the stamps of the truth",
    ),
    "truth-time-shift/early": (
        "s",
        "the truth is {s:.3f} s early: so it explains {percent_cured:.0f} % of the images' motion, "
        "as stored {percent_stored:.0f} %",
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
        "the truth's axes are turned by {value:.0f} degrees against the camera's: so they explain "
        "{percent_cured:.0f} % of the images' rotation, as stored {percent_stored:.0f} %",
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
        "the truth's positions are {how} in the {where}'s axes against its orientations: so they explain "
        "{percent_cured:.0f} % of the images' translation, as stored {percent_stored:.0f} %",
        "use one right-handed frame for both",
    ),
    # Lengths: unit of the truth, lever arm, depth factor.
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
    # Intrinsics.
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
"""Unit, text and cure of every case.

A case is a finding's id; where one id has several texts, a slash and what tells them apart follow.
"""

NOT_COMPARED = {
    "too-short",
    "no-depth",
    "no-truth",
    "motion-unmeasured",
    "no-motion",
    "truth-unclear",
}
"""Notes that say why the ground truth was not compared."""
_NOTES = {
    *NOT_COMPARED,
    "motion-unmeasured/small",
    "truth-unclear/moving",
    "truth-markers",
    "depth-factor-unmeasured",
    "depth-factor-unmeasured/apart",
    "depth-factor-unmeasured/depth",
    "depth-factor-unmeasured/pairs",
    "depth-factor-unmeasured/still",
}
"""Cases that are good to know; all others are faults."""


def finding_of(case: str, value: float | None, **facts: Any) -> Finding:
    """Make the finding of a case.

    Args:
        case: A key of `_FINDINGS`.
        value: The measured number; None where nothing is measured.
        facts: Further numbers and words that the case's text and cure name.
    """
    unit, text, cure = _FINDINGS[case]
    facts = {"value": value, **facts}
    severity: Severity = "note" if case in _NOTES else "fault"
    return Finding(
        id=case.partition("/")[0],
        severity=severity,
        value=None if value is None else float(value),
        unit=unit,
        text=text.format(**facts),
        cure=cure.format(**facts),
    )


def is_fault(finding: Finding) -> bool:
    """Whether results on the recording are wrong until it is mended."""
    return finding.severity == "fault"
