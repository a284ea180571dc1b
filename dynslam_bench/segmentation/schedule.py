"""When the segmenter runs; between its runs, masks are carried over by optical flow."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.geometry.camera import Camera
from dynslam_bench.sequences.frame import Frame, MaskSource

from .build import build_segmenter
from .instances import Instances, Segmenter
from .settings import SegmentationSettings


class MaskScheduler:
    """The segmentation stage of a pipeline (`slam.pipeline.MaskStage`): one call a frame, in order.

    Args:
        settings: When to segment.
        segmenter: Who segments.
    """

    def __init__(self, settings: SegmentationSettings, segmenter: Segmenter) -> None:
        self.settings = settings
        self._segmenter = segmenter

    def reset(self, camera: Camera) -> None:
        """Forget the masks of the previous sequence."""

    def masks_for(self, frame: Frame, gray: NDArray[np.uint8], *, keyframe: bool) -> Instances:
        """The objects in the frame.

        Args:
            frame: The frame to segment.
            gray: uint8 ``[H, W]``, its intensities.
            keyframe: True if a fresh segmentation is asked for: on the first frame, after a keyframe, when lost.
        """
        return self._segmenter.segment(frame)


def build_mask_stage(
    settings: SegmentationSettings,
    *,
    sequence_id: str = "",
    masks: MaskSource | None = None,
    device: str = "cpu",
    threads: int = 1,
) -> MaskScheduler | None:
    """The segmentation stage that the settings ask for; None for source ``none``.

    Raises:
        SegmentationError: The source is not available here.
    """
    segmenter = build_segmenter(settings, sequence_id=sequence_id, masks=masks, device=device, threads=threads)
    return None if segmenter is None else MaskScheduler(settings, segmenter)
