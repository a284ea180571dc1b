"""When the segmenter runs; between its runs, masks are carried over by optical flow."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.contracts.segmenter import Instances, Segmenter
from dynslam_bench.contracts.sequence import Frame, MaskSource
from dynslam_bench.geometry.camera import Camera
from dynslam_bench.segmentation.build_segmenter import ConfiguredSegmenter, build_segmenter
from dynslam_bench.segmentation.carry import carry_dense, carry_sparse, shift_mask
from dynslam_bench.segmentation.postprocess import boxes_of, select
from dynslam_bench.segmentation.settings import SegmentationSettings


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


# Bridge missed detections: an object that was there and is missed lives on for a few frames at constant velocity.

ASSOCIATION_IOU = 0.3
LEAST_HITS = 2
"""An object must have been seen this often before a miss is bridged: single false detections die at once."""
SMOOTHING = 0.5
"""Weight of the newest velocity."""


@dataclass
class _Track:
    box: NDArray[np.float32]
    mask: NDArray[np.bool_]
    name: str
    score: float
    velocity: NDArray[np.float32]
    hits: int = 1
    missed: int = 0

    def predicted(self, frames: int) -> NDArray[np.float32]:
        return np.asarray(self.box + self.velocity * frames, np.float32)


class MissedDetections:
    """Remembers objects and gives back those that the segmenter missed.

    Args:
        limit: Segmented frames in a row that are bridged; 0 turns it off.
    """

    def __init__(self, limit: int) -> None:
        self.limit = limit
        self._tracks: list[_Track] = []

    def reset(self) -> None:
        """Forget all objects."""
        self._tracks = []

    def update(self, found: Instances, frames: int = 1) -> Instances:
        """Add the objects that are missing.

        Args:
            found: What the segmenter found.
            frames: Frames since the last update.

        Returns:
            The found objects, followed by the bridged ones with the scores that they had when they were last seen: how
            long an object is bridged is `limit`'s to say, and a score that fell with every miss would end it earlier,
            at the confidence that filters select by. Oracles miss nothing: results with `Instances.moving` are
            returned as they are.
        """
        if self.limit <= 0 or found.moving is not None:
            self._tracks = []
            return found
        predicted = [track.predicted(frames) for track in self._tracks]
        pairs = associate(predicted, [track.name for track in self._tracks], found)
        taken = {detection for _, detection in pairs}
        for index, detection in pairs:
            self._hit(self._tracks[index], found, detection, frames)
        height, width = found.masks.shape[1:]
        matched = {index for index, _ in pairs}
        bridged = []
        for index, track in enumerate(self._tracks):
            if index not in matched and self._bridge(track, predicted[index], height, width):
                bridged.append(track)
        self._tracks = [track for index, track in enumerate(self._tracks) if index in matched] + bridged
        for detection in range(len(found)):
            if detection not in taken:
                self._tracks.append(
                    _Track(found.boxes[detection], found.masks[detection], found.class_names[detection],
                           float(found.scores[detection]), np.zeros(4, np.float32))
                )  # fmt: skip
        return found if not bridged else _extend(found, bridged)

    def _hit(self, track: _Track, found: Instances, detection: int, frames: int) -> None:
        box = found.boxes[detection]
        velocity = (box - track.box) / np.float32(max(frames * (track.missed + 1), 1))
        track.velocity = np.asarray(SMOOTHING * velocity + (1 - SMOOTHING) * track.velocity, np.float32)
        track.box, track.mask, track.score = box, found.masks[detection], float(found.scores[detection])
        track.hits += 1
        track.missed = 0

    def _bridge(self, track: _Track, box: NDArray[np.float32], height: int, width: int) -> bool:
        """Move a missed object to where it should be; False if it is given up."""
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


def associate(predicted: list[NDArray[np.float32]], names: list[str], found: Instances) -> list[tuple[int, int]]:
    """Greedy one-to-one pairs (track, detection) of one class by falling box IoU, at least `ASSOCIATION_IOU`."""
    if not predicted or not len(found):
        return []
    overlap = box_iou(np.stack(predicted), found.boxes)
    same = np.array([[name == other for other in found.class_names] for name in names], dtype=bool)
    overlap = np.where(same, overlap, 0.0)
    pairs = []
    while overlap.size and overlap.max() >= ASSOCIATION_IOU:
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


def _extend(found: Instances, bridged: list[_Track]) -> Instances:
    masks = np.concatenate([found.masks, np.stack([track.mask for track in bridged])])
    added = masks[len(found) :]
    return Instances(
        masks,
        np.concatenate([found.boxes, boxes_of(added)]),
        (*found.class_names, *(track.name for track in bridged)),
        np.concatenate([found.scores, np.array([track.score for track in bridged], np.float32)]),
    )
