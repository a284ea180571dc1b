"""When the segmenter runs; between its runs, masks are carried over by optical flow."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.contracts.segmenter import Instances, Segmenter
from dynslam_bench.contracts.sequence import Frame, MaskSource
from dynslam_bench.geometry.camera import Camera

from ..build_segmenter import ConfiguredSegmenter, build_segmenter
from ..settings import SegmentationSettings
from .carry import carry_dense, carry_sparse
from .compensation import MissedDetections
from .postprocess import select


class MaskScheduler:
    """The segmentation stage of a pipeline (`slam.pipeline.MaskStage`): one call a frame, in order.

    Args:
        settings: When to segment, how to carry masks, how long to bridge misses.
        segmenter: Who segments.

    Attributes:
        segmented: Whether the segmenter ran on the latest frame.
        runs: On how many frames it ran since the last reset.
    """

    def __init__(self, settings: SegmentationSettings, segmenter: Segmenter) -> None:
        self._segmenter = segmenter
        self._missed = MissedDetections(settings.compensate)
        self._found = Instances.empty(0, 0)
        self._gray: NDArray[np.uint8] | None = None
        self._age = 0
        self.segmented = False
        self.runs = 0
        self.configure(settings)

    @property
    def segmenter(self) -> Segmenter:
        """Who segments."""
        return self._segmenter

    def configure(self, settings: SegmentationSettings) -> None:
        """Put other settings with the same source into force."""
        self._settings = settings
        self._missed.limit = settings.compensate
        if isinstance(self._segmenter, ConfiguredSegmenter):
            self._segmenter.settings = settings

    def reset(self, camera: Camera) -> None:
        """Forget the masks of the previous sequence."""
        self._forget()

    def masks_for(self, frame: Frame, gray: NDArray[np.uint8], *, keyframe: bool) -> Instances:
        """The objects in the frame: segmented afresh, or carried over from the previous frame.

        Args:
            frame: The frame to segment.
            gray: uint8 ``[H, W]``, its intensities.
            keyframe: True if a fresh segmentation is asked for: on the first frame, after a keyframe, when lost.
        """
        if self._due(keyframe) or self._gray is None or self._gray.shape != gray.shape:
            found = self._missed.update(self._segmenter.segment(frame), max(self._age, 1))
            self._age = 0
            self.segmented = True
            self.runs += 1
        else:
            move = carry_dense if self._settings.carry == "dis" else carry_sparse
            found = move(self._found, self._gray, gray)
            self.segmented = False
        self._age += 1
        self._found, self._gray = found, gray
        return found

    def _due(self, keyframe: bool) -> bool:
        if self._settings.schedule == "every" or self._crowded():
            return True
        if self._settings.schedule == "every_nth":
            return self._age >= self._settings.n
        return keyframe or self._age >= self._settings.max_carry

    def _crowded(self) -> bool:
        """Whether so much of the previous view was covered that carried masks would leave too little to trust."""
        if self._settings.crowded_share >= 1:
            return False
        chosen = select(self._found, self._settings)
        return len(chosen) > 0 and float(chosen.union().mean()) > self._settings.crowded_share

    def _forget(self) -> None:
        self._missed.reset()
        self._found = Instances.empty(0, 0)
        self._gray = None
        self._age = 0
        self.segmented = False
        self.runs = 0


def build_mask_stage(
    settings: SegmentationSettings,
    *,
    sequence_id: str = "",
    masks: MaskSource | None = None,
    device: str = "cpu",
    threads: int = 1,
    deferred: bool = False,
    also: frozenset[str] = frozenset(),
) -> MaskScheduler | None:
    """The segmentation stage that the settings ask for; None for source ``none``.

    The arguments are those of `build_segmenter`.

    Raises:
        SegmentationError: The source is not available here.
    """
    segmenter = build_segmenter(
        settings, sequence_id=sequence_id, masks=masks, device=device, threads=threads, deferred=deferred, also=also
    )
    return None if segmenter is None else MaskScheduler(settings, segmenter)
