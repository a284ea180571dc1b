"""The segmentation stage: on which frames the segmenter runs, and how missed detections are bridged.

Between its runs, masks are carried along by optical flow (`carry`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.contracts.segmenter import Instances, Segmenter
from dynslam_bench.contracts.sequence import Frame
from dynslam_bench.geometry.camera import Camera
from dynslam_bench.segmentation.build_segmenter import ConfiguredSegmenter
from dynslam_bench.segmentation.carry import carry_dense, carry_sparse, shift_mask
from dynslam_bench.segmentation.postprocess import boxes_of, select
from dynslam_bench.segmentation.settings import MAX_CARRY, SegmentationSettings

ASSOCIATION_IOU = 0.3
"""Least box overlap of a remembered object and a detection that are taken for the same object."""
LEAST_HITS = 2
"""Detections of an object before a miss is bridged, so that a single false detection is not."""
SMOOTHING = 0.5
"""Weight of the newest velocity."""


class MaskScheduler:
    """The segmentation stage of a `SlamPipeline`: one call a frame, in order.

    Args:
        settings: When to segment, how to carry masks, how long to bridge missed detections.
        segmenter: The segmenter.

    Attributes:
        segmented: Whether the segmenter ran on the latest frame.
    """

    def __init__(self, settings: SegmentationSettings, segmenter: Segmenter) -> None:
        self.segmenter = segmenter
        self._missed = MissedDetections(settings.compensate)
        self.reset()
        self.configure(settings)

    def configure(self, settings: SegmentationSettings) -> None:
        """Put other settings with the same source into force."""
        self._settings = settings
        self._missed.limit = settings.compensate
        if isinstance(self.segmenter, ConfiguredSegmenter):
            self.segmenter.settings = settings

    def reset(self, camera: Camera | None = None) -> None:
        """Forget the masks of the previous sequence."""
        self._missed.reset()
        self._instances = Instances.empty(0, 0)
        self._gray = np.zeros((0, 0), np.uint8)
        self._age = 0
        self.segmented = False

    def masks_for(self, frame: Frame, gray: NDArray[np.uint8], *, keyframe: bool) -> Instances:
        """The objects in the frame: segmented, or carried over from the previous frame.

        Args:
            frame: The frame.
            gray: uint8 ``[H, W]``, its intensities.
            keyframe: Whether the tracker asks for segmentation: on the first frame, after a keyframe, when lost.
        """
        self.segmented = self._gray.shape != gray.shape or self._due(keyframe)
        if self.segmented:
            self._instances = self._missed.update(self.segmenter.segment(frame), max(self._age, 1))
            self._age = 0
        else:
            carry = carry_dense if self._settings.carry == "dis" else carry_sparse
            self._instances = carry(self._instances, self._gray, gray)
        self._age += 1
        self._gray = gray
        return self._instances

    def _due(self, keyframe: bool) -> bool:
        settings = self._settings
        if settings.schedule == "every":
            return True
        if settings.crowded_share < 1 and select(self._instances, settings).union().mean() > settings.crowded_share:
            return True  # the masks of the previous frame cover too much
        if settings.schedule == "every_nth":
            return self._age >= settings.n
        return keyframe or self._age >= MAX_CARRY


@dataclass
class _Track:
    box: NDArray[np.float32]
    mask: NDArray[np.bool_]
    name: str
    score: float
    velocity: NDArray[np.float32]
    hits: int = 1
    missed: int = 0

    def see(self, detections: Instances, index: int, frames: int) -> None:
        """Take over a detection of the object, `frames` frames after the last update."""
        box = detections.boxes[index]
        velocity = (box - self.box) / np.float32(max(frames * (self.missed + 1), 1))
        self.velocity = np.asarray(SMOOTHING * velocity + (1 - SMOOTHING) * self.velocity, np.float32)
        self.box, self.mask, self.score = box, detections.masks[index], float(detections.scores[index])
        self.hits, self.missed = self.hits + 1, 0

    def move(self, box: NDArray[np.float32]) -> bool:
        """Move a missed object to its predicted box; False if it left the image."""
        shift = (box[:2] + box[2:] - self.box[:2] - self.box[2:]) / 2
        before = np.maximum(self.box[2:] - self.box[:2], 1)
        scale = float(np.clip(np.mean((box[2:] - box[:2]) / before), 0.8, 1.25))
        mask = shift_mask(self.mask, float(shift[0]), float(shift[1]), scale)
        if np.count_nonzero(mask) < 0.2 * np.count_nonzero(self.mask):
            return False
        height, width = mask.shape
        self.mask, self.box = mask, np.clip(box, 0, np.array([width, height] * 2)).astype(np.float32)
        self.missed += 1
        return True


class MissedDetections:
    """Remembers objects and adds those that the segmenter missed, moved at constant velocity.

    Args:
        limit: Segmented frames in a row that are bridged; 0 turns it off.
    """

    def __init__(self, limit: int) -> None:
        self.limit = limit
        self.reset()

    def reset(self) -> None:
        """Forget all objects."""
        self._tracks: list[_Track] = []

    def update(self, detections: Instances, frames: int = 1) -> Instances:
        """Add the objects that are missing.

        Args:
            detections: The objects that the segmenter returned.
            frames: Frames since the last update.

        Returns:
            The detections, followed by the bridged objects with the scores of their last detections: `limit` alone says
            how long an object is bridged, not a falling score. Exact masks (with `Instances.moving`) miss nothing and
            are returned as they are.
        """
        if self.limit <= 0 or detections.moving is not None:
            self.reset()
            return detections
        predicted = [np.asarray(track.box + track.velocity * frames, np.float32) for track in self._tracks]
        matches = dict(associate(predicted, [track.name for track in self._tracks], detections))
        for index, detection in matches.items():
            self._tracks[index].see(detections, detection, frames)
        missed = [(track, predicted[index]) for index, track in enumerate(self._tracks) if index not in matches]
        bridged = [
            track for track, box in missed if track.hits >= LEAST_HITS and track.missed < self.limit and track.move(box)
        ]
        self._tracks = [track for index, track in enumerate(self._tracks) if index in matches] + bridged
        for new in sorted(set(range(len(detections.scores))) - set(matches.values())):
            box, mask, score = detections.boxes[new], detections.masks[new], float(detections.scores[new])
            self._tracks.append(_Track(box, mask, detections.class_names[new], score, np.zeros(4, np.float32)))
        if not bridged:
            return detections
        masks = np.stack([track.mask for track in bridged])
        return Instances(
            np.concatenate([detections.masks, masks]),
            np.concatenate([detections.boxes, boxes_of(masks)]),
            (*detections.class_names, *(track.name for track in bridged)),
            np.concatenate([detections.scores, np.array([track.score for track in bridged], np.float32)]),
        )


def associate(predicted: list[NDArray[np.float32]], names: list[str], detections: Instances) -> list[tuple[int, int]]:
    """Greedy one-to-one pairs (track, detection) of one class by falling box IoU, at least `ASSOCIATION_IOU`."""
    if not predicted or not detections.class_names:
        return []
    same = np.array([[name == other for other in detections.class_names] for name in names], dtype=bool)
    overlap = np.where(same, box_iou(np.stack(predicted), detections.boxes), 0.0)
    pairs = []
    while overlap.max() >= ASSOCIATION_IOU:
        track, detection = (int(value) for value in np.unravel_index(int(np.argmax(overlap)), overlap.shape))
        pairs.append((track, detection))
        overlap[track, :] = overlap[:, detection] = 0.0
    return pairs


def box_iou(a: NDArray[np.float32], b: NDArray[np.float32]) -> NDArray[np.float64]:
    """Intersection over union ``[N, M]`` of boxes."""
    low = np.maximum(a[:, None, :2], b[None, :, :2])
    high = np.minimum(a[:, None, 2:], b[None, :, 2:])
    inter = np.clip(high - low, 0, None).prod(axis=2).astype(np.float64)
    areas = [np.clip(x[:, 2:] - x[:, :2], 0, None).prod(axis=1).astype(np.float64) for x in (a, b)]
    union = areas[0][:, None] + areas[1][None] - inter
    return np.asarray(inter / np.maximum(union, 1e-9))
