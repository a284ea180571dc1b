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
        self._gray: NDArray[np.uint8] | None = None
        self._age = 0
        self.segmented = False

    def masks_for(self, frame: Frame, gray: NDArray[np.uint8], *, keyframe: bool) -> Instances:
        """The objects in the frame: segmented, or carried over from the previous frame.

        Args:
            frame: The frame.
            gray: uint8 ``[H, W]``, its intensities.
            keyframe: Whether the tracker asks for segmentation: on the first frame, after a keyframe, when lost.
        """
        if self._gray is None or self._gray.shape != gray.shape or self._due(keyframe):
            self._instances = self._missed.update(self.segmenter.segment(frame), max(self._age, 1))
            self._age = 0
            self.segmented = True
        else:
            carry = carry_dense if self._settings.carry == "dis" else carry_sparse
            self._instances = carry(self._instances, self._gray, gray)
            self.segmented = False
        self._age += 1
        self._gray = gray
        return self._instances

    def _due(self, keyframe: bool) -> bool:
        if self._settings.schedule == "every" or self._crowded():
            return True
        if self._settings.schedule == "every_nth":
            return self._age >= self._settings.n
        return keyframe or self._age >= MAX_CARRY

    def _crowded(self) -> bool:
        """Whether the masks of the previous frame covered more of the view than `crowded_share`."""
        if self._settings.crowded_share >= 1:
            return False
        chosen = select(self._instances, self._settings)
        return len(chosen) > 0 and float(chosen.union().mean()) > self._settings.crowded_share


@dataclass
class _Track:
    box: NDArray[np.float32]
    mask: NDArray[np.bool_]
    name: str
    score: float
    velocity: NDArray[np.float32]
    hits: int = 1
    missed: int = 0


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
        height, width = detections.masks.shape[1:]
        tracks: list[_Track] = []
        bridged: list[_Track] = []
        for index, track in enumerate(self._tracks):
            if index in matches:
                _update_track(track, detections, matches[index], frames)
                tracks.append(track)
            elif self._bridge(track, predicted[index], height, width):
                bridged.append(track)
        self._tracks = tracks + bridged
        for new in sorted(set(range(len(detections))) - set(matches.values())):
            self._tracks.append(
                _Track(detections.boxes[new], detections.masks[new], detections.class_names[new],
                       float(detections.scores[new]), np.zeros(4, np.float32))
            )  # fmt: skip
        return _extend(detections, bridged) if bridged else detections

    def _bridge(self, track: _Track, box: NDArray[np.float32], height: int, width: int) -> bool:
        """Move a missed object to its predicted box; False if it is given up."""
        if track.hits < LEAST_HITS or track.missed >= self.limit:
            return False
        shift = (box[:2] + box[2:] - track.box[:2] - track.box[2:]) / 2
        before = np.maximum(track.box[2:] - track.box[:2], 1)
        scale = float(np.clip(np.mean((box[2:] - box[:2]) / before), 0.8, 1.25))
        mask = shift_mask(track.mask, float(shift[0]), float(shift[1]), scale)
        if np.count_nonzero(mask) < 0.2 * np.count_nonzero(track.mask):
            return False  # it left the image
        track.mask, track.box = mask, np.clip(box, 0, np.array([width, height] * 2)).astype(np.float32)
        track.missed += 1
        return True


def _update_track(track: _Track, detections: Instances, index: int, frames: int) -> None:
    box = detections.boxes[index]
    velocity = (box - track.box) / np.float32(max(frames * (track.missed + 1), 1))
    track.velocity = np.asarray(SMOOTHING * velocity + (1 - SMOOTHING) * track.velocity, np.float32)
    track.box, track.mask, track.score = box, detections.masks[index], float(detections.scores[index])
    track.hits += 1
    track.missed = 0


def associate(predicted: list[NDArray[np.float32]], names: list[str], detections: Instances) -> list[tuple[int, int]]:
    """Greedy one-to-one pairs (track, detection) of one class by falling box IoU, at least `ASSOCIATION_IOU`."""
    if not predicted or not len(detections):
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


def _extend(detections: Instances, bridged: list[_Track]) -> Instances:
    masks = np.stack([track.mask for track in bridged])
    return Instances(
        np.concatenate([detections.masks, masks]),
        np.concatenate([detections.boxes, boxes_of(masks)]),
        (*detections.class_names, *(track.name for track in bridged)),
        np.concatenate([detections.scores, np.array([track.score for track in bridged], np.float32)]),
    )
