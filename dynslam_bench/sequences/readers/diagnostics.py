"""What was dropped on the way from list files to frames, and why."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Dropped:
    """Counts of one sequence's opening.

    Attributes:
        colour_listed: Usable entries of ``rgb.txt``.
        depth_listed: Usable entries of ``depth.txt``.
        pairs: Frames: colour images with a depth image.
        colour_unpaired: Colour images without a depth image within the tolerance.
        depth_unpaired: Depth images that no colour image took.
        bad_stamps: Entries whose stamp was not finite.
        duplicate_stamps: Entries whose stamp came again later.
        unsorted: Entries whose stamp lay before the one above it; put in order.
        unnamed: Entries without a file name.
        absent: Entries whose file does not exist (tolerated up to 2 % of a list).
        max_time_difference_s: The tolerance of the pairing, seconds.
        ground_truth_poses: Usable poses of ``groundtruth.txt``; 0 where there is none.
        ground_truth_dropped: Lines of ``groundtruth.txt`` that hold no usable pose, with the reasons.
        frames_without_ground_truth: Frames with no pose within 0.02 s.
        largest_hole_s: Longest time between consecutive poses within the frames' span, seconds; 0 without poses.
    """

    colour_listed: int
    depth_listed: int
    pairs: int
    colour_unpaired: int
    depth_unpaired: int
    bad_stamps: int = 0
    duplicate_stamps: int = 0
    unsorted: int = 0
    unnamed: int = 0
    absent: int = 0
    max_time_difference_s: float = 0.02
    ground_truth_poses: int = 0
    ground_truth_dropped: str = ""
    frames_without_ground_truth: int = 0
    largest_hole_s: float = 0.0

    @property
    def any(self) -> bool:
        """Whether anything at all was dropped or put in order."""
        counts = (
            self.colour_unpaired,
            self.bad_stamps,
            self.duplicate_stamps,
            self.unsorted,
            self.unnamed,
            self.absent,
        )
        return any(counts) or bool(self.ground_truth_dropped)

    def describe(self) -> str:
        """One line: the frames, and all counts that are not zero."""
        parts = [
            f"{self.pairs} frames of {self.colour_listed} colour and {self.depth_listed} depth images "
            f"(|dt| < {self.max_time_difference_s:g} s)"
        ]
        for count, what in (
            (self.colour_unpaired, "colour images without depth"),
            (self.depth_unpaired, "depth images unused"),
            (self.bad_stamps, "stamps not finite"),
            (self.duplicate_stamps, "duplicate stamps"),
            (self.unsorted, "stamps out of order"),
            (self.unnamed, "lines without a file name"),
            (self.absent, "listed files that do not exist"),
        ):
            if count:
                parts.append(f"{count} {what}")
        if self.ground_truth_poses:
            parts.append(f"{self.ground_truth_poses} ground-truth poses")
            if self.frames_without_ground_truth:
                parts.append(
                    f"{self.frames_without_ground_truth} frames without ground truth within 0.02 s "
                    f"(largest hole {self.largest_hole_s:.2f} s)"
                )
        else:
            parts.append("no ground truth")
        if self.ground_truth_dropped:
            parts.append(self.ground_truth_dropped)
        return "; ".join(parts)
