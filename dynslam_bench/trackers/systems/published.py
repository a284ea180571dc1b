"""What published systems have in common here, and how it is said in their specs.

The sentences are made from the settings, so that a spec cannot say another number than the one that is in force.
"""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from dynslam_bench.core.settings import tunable
from dynslam_bench.culling.tools.unmatched import Unmatched
from dynslam_bench.flow.settings import FlowSettings
from dynslam_bench.segmentation.settings import SegmentationSettings

CFPN = "the CFPN acts in the embedded network alone: with COCO weights its convolutions are zero (plain Mask R-CNN)"
"""The paper's improved mask branch, as far as it is there."""


class PublishedFlowSettings(FlowSettings):
    """Lucas-Kanade as published systems use it: no source of theirs names a check on the way back, so there is none."""

    method: Literal["daisy", "lucas-kanade", "dis"] = tunable(
        "lucas-kanade", meaning="which flow; the published one is Lucas-Kanade"
    )
    forward_backward_px: float = Field(
        0.0,
        ge=0.0,
        le=100.0,
        description="largest distance in pixels between a point and its way there and back; 0, no check, as published",
    )


LOST: dict[Unmatched, str] = {
    "keep": "a feature that the flow loses is not judged and stays (not stated)",
    "drop": "a feature that the flow loses is dropped",
    "judge": "a feature that the flow loses is judged by the place where it was lost",
}
"""What becomes of features without a match, by the setting `unmatched`."""


def masks_in_words(segmentation: SegmentationSettings, *, boxes: bool = False) -> str:
    """Where a system's masks, or its boxes, come from, and what the shared stage adds to them."""
    what = "boxes are those of the instance masks, which" if boxes else "masks"
    bridged = (
        f"missed detections bridged for {segmentation.compensate} segmented frames"
        if segmentation.compensate
        else "missed detections not bridged"
    )
    return (
        f"{what} come from the stage that all systems share: scores of at least {segmentation.confidence:g}, {bridged}"
    )


def grown_in_words(segmentation: SegmentationSettings) -> str:
    """How far a system's masks are grown, where its source does not say."""
    return f"masks grown by {segmentation.dilation_px} px (not stated)"


def tracks_in_words(flow: FlowSettings) -> str:
    """How a system's flow is computed."""
    check = (
        f"a check of {flow.forward_backward_px:g} px on the way back"
        if flow.forward_backward_px
        else "no check on the way back"
    )
    return f"Lucas-Kanade tracks (window {flow.window_px} px, begun at the motion model's guess, {check})"


def matches_in_words(flow: FlowSettings, unmatched: Unmatched) -> str:
    """How a system that tests matches finds them, and what becomes of the features that have none."""
    return f"matches are {tracks_in_words(flow)}; {LOST[unmatched]}"


def links_in_words(flow: FlowSettings) -> str:
    """How a system with a memory of features follows them, and what becomes of those that have no past."""
    return f"features are followed by {tracks_in_words(flow)}, not by descriptors; one without a past begins at 0.5"
