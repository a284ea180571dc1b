"""The segmentation stage: on which frames the segmenter runs, and how missed detections are bridged.

Between its runs, masks are carried along by optical flow.
"""

from __future__ import annotations

import atexit
import time
import warnings
from concurrent.futures import Future, wait
from copy import copy
from dataclasses import dataclass, replace
from threading import Thread
from typing import Any
from weakref import WeakSet

import cv2
import numpy as np
from numpy.typing import NDArray

from dynslam_bench.contracts import Frame, Instances, Segmenter
from dynslam_bench.geometry import Camera
from dynslam_bench.segmentation.build_segmenter import CachedSegmenter, ConfiguredSegmenter
from dynslam_bench.segmentation.postprocess import boxes_of, region, select
from dynslam_bench.segmentation.settings import MAX_CARRY, SegmentationSettings

ASSOCIATION_IOU = 0.3
"""Least box overlap of a remembered object and a detection that are taken for the same object."""
LEAST_HITS = 2
"""Detections of an object before a miss is bridged, so that a single false detection is not."""
SMOOTHING = 0.5
"""Weight of the newest velocity."""
STAMP_TOLERANCE_S = 1e-3
"""Masks are due so much early: sums of stamps and latencies are rounded."""
EXIT_S = 10.0
"""At its end the process waits so long for a segmenter: a thread that it stops within a network would abort it."""
_working: WeakSet[Future[tuple[Instances, float]]] = WeakSet()
atexit.register(lambda: wait(_working, EXIT_S))


@dataclass(eq=False)
class _Request:
    """A frame that the segmenter works on beside tracking.

    Attributes:
        due: When its masks are taken, seconds of the frames' stamps.
        frames_between: Frames from the one that was segmented before to this one.
        answer: The objects, and the seconds that the segmenter took.
        flow: Dense flow from it to the latest frame, float32 ``[h, w, 2]``.
        age: Frames from it to the latest frame.
    """

    due: float
    frames_between: int
    answer: Future[tuple[Instances, float]]
    flow: NDArray[np.float32]
    age: int = 0

    def follow(self, flow: NDArray[np.float32]) -> None:
        """Append the flow from the latest frame to a new one: ``f(x) + g(x + f(x))``."""
        self.age += 1
        rows, columns = np.mgrid[: flow.shape[0], : flow.shape[1]].astype(np.float32)
        x = columns + self.flow[:, :, 0]
        y = rows + self.flow[:, :, 1]
        self.flow = self.flow + np.asarray(
            cv2.remap(flow, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        )

    def __getstate__(self) -> dict[str, Any]:
        """With the answer, which is waited for: a thread can be neither copied nor pickled."""
        wait([self.answer])
        return vars(self) | {"answer": self.answer.exception() or self.answer.result()}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state, answer=Future())
        if isinstance(state["answer"], BaseException):
            self.answer.set_exception(state["answer"])
        else:
            self.answer.set_result(state["answer"])


class MaskScheduler:
    """The segmentation stage of a `SlamPipeline`: one call a frame, in order.

    With schedule ``async`` the segmenter runs in a thread of its own, on one frame at a time. The
    masks of a frame are taken `latency_s` later by the frames' stamps, carried to the frame of that
    time, and the segmenter begins with that frame; they are at least one frame late. If it is
    slower than `latency_s`, tracking waits for it: the same settings give the same masks
    everywhere. With a `latency_s` of 0 masks are taken when they are done, and nothing waits. The
    segmenter works with the settings of the time when it begins, and without the stage cache, so
    that the wait is measured.

    Args:
        settings: When to segment, how to carry masks, how long to bridge missed detections.
        segmenter: The segmenter.

    Attributes:
        segmented: Whether the segmenter ran on the latest frame.
        async_segmenter_s: Seconds that it took beside tracking for the masks that the latest frame took.
    """

    def __init__(self, settings: SegmentationSettings, segmenter: Segmenter) -> None:
        # first: a copy waits for the segmenter before it copies it
        self._request: _Request | None = None
        self.segmenter = segmenter
        self._missed = MissedDetections(settings.compensate)
        self.reset()
        self.configure(settings)

    def configure(self, settings: SegmentationSettings) -> None:
        """Put other settings with the same source into force."""
        self._settings = settings
        if settings.schedule != "async":
            self.wait_for_segmenter()
        self._missed.limit = settings.compensate
        if isinstance(self.segmenter, ConfiguredSegmenter):
            self.segmenter.settings = settings

    def reset(self, camera: Camera | None = None) -> None:
        """Forget the masks of the previous sequence."""
        self.wait_for_segmenter()
        self._missed.reset()
        if isinstance(self.segmenter, ConfiguredSegmenter):
            self.segmenter.reset()
        self._instances = Instances.empty(0, 0)
        self._gray = np.zeros((0, 0), np.uint8)
        self._age = 0
        self.segmented = False
        self.async_segmenter_s = 0.0

    def wait_for_segmenter(self) -> None:
        """Wait for the segmenter, which works on one frame at a time, and forget its answer; warn of its error."""
        request = self._request
        self._request = None
        if request is not None and (error := request.answer.exception()) is not None:
            warnings.warn(f"no frame took masks that failed: {error}", RuntimeWarning, stacklevel=2)

    def masks_for(self, frame: Frame, gray: NDArray[np.uint8], *, keyframe: bool) -> Instances:
        """The objects in the frame: segmented, or carried over from the previous frame.

        Args:
            frame: The frame.
            gray: uint8 ``[H, W]``, its intensities.
            keyframe: Whether the tracker asks for segmentation: on the first frame, after a
                keyframe, when lost.
        """
        # no masks of this size can be carried to the first frame
        first = self._gray.shape != gray.shape
        self.async_segmenter_s = 0.0
        if self._settings.schedule == "async" and not first:
            self.segmented = self._take(frame, gray)
        elif first or self._due(keyframe):
            # segment this frame, and bridge what was missed
            self.segmented = True
            self._instances = self._missed.update(self.segmenter.segment(frame), max(self._age, 1))
        else:
            # carry the masks of the previous frame by optical flow
            self.segmented = False
            if self._settings.carry == "sparse":
                self._instances = carry_sparse(self._instances, self._gray, gray)
            elif len(self._instances):
                self._instances = carry_dense(self._instances, dense_flow(self._gray, gray))
        self._age = 1 if self.segmented else self._age + 1
        self._gray = gray
        return self._instances

    def _take(self, frame: Frame, gray: NDArray[np.uint8]) -> bool:
        """Take the masks that are due, carried to this frame; False if none are due.

        A segmenter that is idle begins with this frame, whether masks were taken or not.
        """
        flow = dense_flow(self._gray, gray)
        request = self._request
        if request is not None:
            request.follow(flow)

        # masks are due by the frames' stamps, or with a latency of 0 when they are done
        due = request is not None and frame.timestamp >= request.due - STAMP_TOLERANCE_S
        waits = self._settings.latency_s != 0
        taken = due if request is None or waits else request.answer.done()

        # carry to this frame what is due, else the masks of the previous frame
        if request is not None and taken:
            # an error is raised once
            self._request = None
            instances, self.async_segmenter_s = request.answer.result()
            self._instances = carry_dense(
                self._missed.update(instances, request.frames_between), request.flow
            )
        else:
            self._instances = carry_dense(self._instances, flow)

        # a segmenter that is idle begins with this frame
        if request is None or taken:
            answer: Future[tuple[Instances, float]] = Future()
            _working.add(answer)
            Thread(target=_segment, args=(self._frozen(), frame, answer), daemon=True).start()
            # frames from the one that was segmented before to this one
            frames_between = self._age if request is None else request.age
            self._request = _Request(
                frame.timestamp + self._settings.latency_s,
                frames_between,
                answer,
                np.zeros_like(flow),
            )
        return taken

    def _frozen(self) -> Segmenter:
        """The segmenter with the settings of now, which later ones do not change."""
        if isinstance(self.segmenter, ConfiguredSegmenter):
            return copy(self.segmenter)
        return self.segmenter

    def _due(self, keyframe: bool) -> bool:
        """Whether the schedule has the segmenter run on this frame."""
        settings = self._settings
        if settings.schedule == "every":
            return True
        # a crowded view: the masks of the previous frame cover too much
        if settings.crowded_share < 1:
            covered = select(self._instances, settings).union().mean()
            if covered > settings.crowded_share:
                return True
        # every n frames, or with keyframes and after too long a carry
        if settings.schedule == "every_nth":
            return self._age >= settings.n
        return keyframe or self._age >= MAX_CARRY


def _segment(segmenter: Segmenter, frame: Frame, answer: Future[tuple[Instances, float]]) -> None:
    """Segment a frame in a thread of its own; the answer holds the objects and the seconds, or the error."""
    try:
        # without the stage cache, so that the wait is measured
        if isinstance(segmenter, ConfiguredSegmenter) and isinstance(
            segmenter.inner, CachedSegmenter
        ):
            segmenter.inner = segmenter.inner.network()
        # the time counts only the network's work
        start = time.perf_counter()
        answer.set_result((segmenter.segment(frame), time.perf_counter() - start))
    # raised again where the masks are taken
    except BaseException as error:
        answer.set_exception(error)


@dataclass
class _Track:
    """An object that is remembered from frame to frame.

    Attributes:
        box: float32 ``[4]``, x0, y0, x1, y1, pixels.
        mask: bool ``[H, W]``.
        name: Its class.
        score: Score of its last detection, 0 to 1.
        velocity: float32 ``[4]``, change of the box, pixels a frame.
        hits: How often it was detected.
        missed: Segmented frames in a row without a detection of it.
    """

    box: NDArray[np.float32]
    mask: NDArray[np.bool_]
    name: str
    score: float
    velocity: NDArray[np.float32]
    hits: int = 1
    missed: int = 0

    def see(self, detections: Instances, index: int, frames: int) -> None:
        """Take over a detection of the object, `frames` frames after the last update."""
        # velocity of the box, smoothed exponentially
        box = detections.boxes[index]
        velocity = (box - self.box) / np.float32(max(frames, 1))
        self.velocity = np.asarray(
            SMOOTHING * velocity + (1 - SMOOTHING) * self.velocity, np.float32
        )
        # the detection replaces what was predicted
        self.score = float(detections.scores[index])
        self.box = box
        self.mask = detections.masks[index]
        self.hits += 1
        self.missed = 0

    def move(self, box: NDArray[np.float32]) -> bool:
        """Move a missed object to its predicted box; False if it left the image."""
        # shift of the box's centre, scale of its sides
        shift = (box[:2] + box[2:] - self.box[:2] - self.box[2:]) / 2
        before = np.maximum(self.box[2:] - self.box[:2], 1)
        scale = float(np.clip(np.mean((box[2:] - box[:2]) / before), 0.8, 1.25))
        mask = shift_mask(self.mask, float(shift[0]), float(shift[1]), scale)
        if np.count_nonzero(mask) < 0.2 * np.count_nonzero(self.mask):
            return False
        # within the image; the mask has moved too
        height, width = mask.shape
        self.box = np.clip(box, 0, np.array([width, height] * 2)).astype(np.float32)
        self.mask = mask
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
            The detections, followed by the bridged objects with the scores of their last
            detections: `limit` alone says how long an object is bridged, not a falling score. Exact
            masks (with `Instances.moving`) miss nothing and are returned as they are.
        """
        if self.limit <= 0 or detections.moving is not None:
            self.reset()
            return detections
        # match detections with the boxes predicted at constant velocity
        predicted = [
            np.asarray(track.box + track.velocity * frames, np.float32) for track in self._tracks
        ]
        names = [track.name for track in self._tracks]
        matches = dict(associate(predicted, names, detections))
        detected = []
        bridged = []
        for index, track in enumerate(self._tracks):
            if index in matches:
                track.see(detections, matches[index], frames)
                detected.append(track)
            # one that was missed moves to its predicted box, or is forgotten
            elif (
                track.hits >= LEAST_HITS
                and track.missed < self.limit
                and track.move(predicted[index])
            ):
                bridged.append(track)

        # detections without a match are new objects
        unmatched = sorted(set(range(len(detections.scores))) - set(matches.values()))
        new = [
            _Track(
                box=detections.boxes[index],
                mask=detections.masks[index],
                name=detections.class_names[index],
                score=float(detections.scores[index]),
                velocity=np.zeros(4, np.float32),
            )
            for index in unmatched
        ]
        self._tracks = [*detected, *bridged, *new]

        # return the bridged objects behind the detections
        if not bridged:
            return detections
        masks = np.stack([track.mask for track in bridged])
        return Instances(
            np.concatenate([detections.masks, masks]),
            np.concatenate([detections.boxes, boxes_of(masks)]),
            (*detections.class_names, *(track.name for track in bridged)),
            np.concatenate(
                [detections.scores, np.array([track.score for track in bridged], np.float32)]
            ),
        )


def associate(
    predicted: list[NDArray[np.float32]], names: list[str], detections: Instances
) -> list[tuple[int, int]]:
    """Greedy one-to-one pairs (track, detection) of one class by falling box IoU, at least `ASSOCIATION_IOU`."""
    if not predicted or not detections.class_names:
        return []
    # overlap of all pairs of one class
    same_class = np.array(names)[:, None] == np.array(detections.class_names)[None]
    overlap = np.where(same_class, box_iou(np.stack(predicted), detections.boxes), 0.0)
    pairs = []
    while overlap.max() >= ASSOCIATION_IOU:
        # the largest overlap left; its track and its detection take part no more
        row, column = np.unravel_index(int(np.argmax(overlap)), overlap.shape)
        track = int(row)
        detection = int(column)
        pairs.append((track, detection))
        overlap[track, :] = overlap[:, detection] = 0.0
    return pairs


def box_iou(a: NDArray[np.float32], b: NDArray[np.float32]) -> NDArray[np.float64]:
    """Intersection over union ``[N, M]`` of boxes x0, y0, x1, y1, ``[N, 4]`` and ``[M, 4]``."""
    # corners of the intersections
    low = np.maximum(a[:, None, :2], b[None, :, :2])
    high = np.minimum(a[:, None, 2:], b[None, :, 2:])
    inter = np.clip(high - low, 0, None).prod(axis=2).astype(np.float64)
    # areas, 0 for reversed corners
    area_a = np.clip(a[:, 2:] - a[:, :2], 0, None).prod(axis=1).astype(np.float64)
    area_b = np.clip(b[:, 2:] - b[:, :2], 0, None).prod(axis=1).astype(np.float64)
    union = area_a[:, None] + area_b[None] - inter
    return np.asarray(inter / np.maximum(union, 1e-9))


# Masks carried from one image to the next by optical flow.

Gray = NDArray[np.uint8]
WORK_SIDE = 240
"""Dense flow is computed on images whose shorter side is this many pixels."""
CORNERS = 40
"""Corners that are tracked on each object in sparse mode."""
LEAST_CORNERS = 6
"""Consistent corners that a similarity is fitted to; with fewer an object keeps its place."""
ROUND_TRIP_PX = 1.0
"""Largest forward-backward error of a corner that is used."""


def dense_flow(previous: Gray, current: Gray, work_side: int = WORK_SIDE) -> NDArray[np.float32]:
    """Dense flow from the previous image to the current one, by DIS (Kroeger et al. 2016).

    Args:
        previous: uint8 ``[H, W]``.
        current: uint8 ``[H, W]``.
        work_side: Shorter side of the images that it is computed on, pixels.

    Returns:
        float32 ``[h, w, 2]`` at the reduced size and in its pixels.
    """
    height, width = current.shape
    ratio = min(1.0, work_side / min(height, width))
    size = (max(16, round(width * ratio)), max(16, round(height * ratio)))
    small = [cv2.resize(image, size, interpolation=cv2.INTER_AREA) for image in (previous, current)]
    dis = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_ULTRAFAST)
    dis.setFinestScale(1)
    return np.asarray(
        dis.calc(small[0], small[1], np.zeros((size[1], size[0], 2), np.float32)), np.float32
    )


def object_flow(mask: NDArray[np.bool_], flow: NDArray[np.float32]) -> NDArray[np.float32]:
    """The flow of one object, smoothed and continued beyond its edge.

    Dense flow blurs across the edge of a moving object and would leave a trail of its mask. Only
    the flow inside the object is used; its local means are continued outwards.

    Args:
        mask: bool ``[h, w]``.
        flow: float32 ``[h, w, 2]``.
    """
    # the object's inside, away from its blurred edge; a thin object counts whole
    core = cv2.erode(mask.view(np.uint8), np.ones((3, 3), np.uint8)).astype(np.float32)
    if np.count_nonzero(core) < 0.2 * np.count_nonzero(mask):
        core = mask.astype(np.float32)
    # the median flow everywhere; near the object its local means, of the smaller window where it reaches
    inside = flow[core > 0]
    field = np.broadcast_to(np.median(inside, axis=0), flow.shape).astype(np.float32)
    for window in (31, 7):
        kernel = (window, window)
        weight = cv2.boxFilter(core, -1, kernel, normalize=False, borderType=cv2.BORDER_CONSTANT)
        total = cv2.boxFilter(
            flow * core[:, :, None], -1, kernel, normalize=False, borderType=cv2.BORDER_CONSTANT
        )
        near = np.asarray(weight >= 2)
        field = np.where(near[:, :, None], total / np.maximum(weight, 1)[:, :, None], field).astype(
            np.float32
        )
    return field


def push_mask(mask: NDArray[np.bool_], field: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Move a mask along a smooth flow.

    Args:
        mask: bool ``[H, W]``.
        field: Flow ``[h, w, 2]`` from the mask's image to the next, in its own pixels; a smaller
            field is interpolated.

    Returns:
        Bool ``[H, W]``; an object that the image's edge cuts is continued when it moves in.
    """
    height, width = mask.shape
    rows, columns = np.mgrid[: field.shape[0], : field.shape[1]].astype(np.float32)
    # the flow at the place a pixel came from: x = x' - f(x), by fixed-point iteration
    back = field
    for _ in range(3):
        back = np.asarray(
            cv2.remap(
                field,
                columns - back[:, :, 0],
                rows - back[:, :, 1],
                cv2.INTER_LINEAR,
                borderMode=cv2.BORDER_REPLICATE,
            ),
            np.float32,
        )
    # interpolated to the mask's size, and in its pixels
    scaled = back * np.array([width / field.shape[1], height / field.shape[0]], np.float32)
    full = np.asarray(
        cv2.resize(scaled, (width, height), interpolation=cv2.INTER_LINEAR), np.float32
    )
    # read the mask where each pixel came from
    at_x = np.arange(width, dtype=np.float32)[None] - full[:, :, 0]
    at_y = np.arange(height, dtype=np.float32)[:, None] - full[:, :, 1]
    moved = cv2.remap(
        mask.view(np.uint8) * np.uint8(255),
        at_x,
        at_y,
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REPLICATE,
    )
    return np.asarray(np.asarray(moved) >= 128)


def carry_dense(instances: Instances, flow: NDArray[np.float32]) -> Instances:
    """The objects moved by the dense flow from their image (see `dense_flow`); lost objects are left out.

    The flow within an object is smooth: every other of its pixels suffices.
    """
    coarse = np.ascontiguousarray(flow[::2, ::2]) / np.float32(2)
    return _moved(instances, [_carry_object(mask, coarse) for mask in instances.masks])


def _carry_object(mask: NDArray[np.bool_], flow: NDArray[np.float32]) -> NDArray[np.bool_]:
    """One object's moved mask, computed in a window around the object only."""
    # the mask at the size of the flow
    moved = np.zeros_like(mask)
    height, width = flow.shape[:2]
    step_y = mask.shape[0] / height
    step_x = mask.shape[1] / width
    small = cv2.resize(mask.view(np.uint8), (width, height), interpolation=cv2.INTER_NEAREST) > 0
    inside = region(small, 0)
    if inside is None:
        return moved
    # a window that the object cannot leave: its box grown by the largest flow in it
    largest_flow = min(float(np.abs(flow[inside]).max()), max(height, width))
    part = region(small, 2 + int(np.ceil(largest_flow)))
    assert part is not None
    field = object_flow(np.ascontiguousarray(small[part]), np.ascontiguousarray(flow[part]))
    # the same window at the mask's size
    rows, columns = part
    whole = (
        slice(round(rows.start * step_y), round(rows.stop * step_y)),
        slice(round(columns.start * step_x), round(columns.stop * step_x)),
    )
    moved[whole] = push_mask(np.ascontiguousarray(mask[whole]), field)
    return moved


def carry_sparse(instances: Instances, previous: Gray, current: Gray) -> Instances:
    """The objects of the previous image in the current one, each moved by the similarity of its tracked corners.

    Corners on each object are tracked there and back by pyramidal Lucas-Kanade; RANSAC fits a
    similarity. An object with fewer than six consistent corners keeps its place.
    """
    masks = []
    for mask in instances.masks:
        motion = _similarity(mask, previous, current)
        masks.append(mask if motion is None else _warp(mask, motion))
    return _moved(instances, masks)


def shift_mask(
    mask: NDArray[np.bool_], dx: float, dy: float, scale: float = 1.0
) -> NDArray[np.bool_]:
    """A mask scaled about the centre of its box and moved by `dx`, `dy` pixels.

    Args:
        mask: bool ``[H, W]``.
        dx: Pixels to the right.
        dy: Pixels downwards.
        scale: Factor on its size.
    """
    rows, columns = np.nonzero(mask)
    if not rows.size:
        return mask
    centre = np.array([(columns.min() + columns.max()) / 2, (rows.min() + rows.max()) / 2])
    move = np.array(
        [[scale, 0, centre[0] * (1 - scale) + dx], [0, scale, centre[1] * (1 - scale) + dy]]
    )
    return _warp(mask, move)


def _warp(mask: NDArray[np.bool_], motion: NDArray[np.float64]) -> NDArray[np.bool_]:
    """A mask under an affine motion ``[2, 3]``."""
    moved = cv2.warpAffine(
        mask.view(np.uint8) * np.uint8(255), motion, mask.shape[::-1], flags=cv2.INTER_LINEAR
    )
    return np.asarray(np.asarray(moved) >= 128)


def _similarity(
    mask: NDArray[np.bool_], previous: Gray, current: Gray
) -> NDArray[np.float64] | None:
    """The similarity ``[2, 3]`` of the corners within a mask; None with too few."""
    # corners on the object, tracked there and back
    corners = cv2.goodFeaturesToTrack(previous, CORNERS, 0.01, 5, mask=mask.view(np.uint8))
    if corners is None or len(corners) < LEAST_CORNERS:
        return None
    there, ok, _ = cv2.calcOpticalFlowPyrLK(previous, current, corners, np.empty_like(corners))
    back, ok_back, _ = cv2.calcOpticalFlowPyrLK(current, previous, there, np.empty_like(corners))
    consistent = np.linalg.norm((back - corners).reshape(-1, 2), axis=1) <= ROUND_TRIP_PX
    consistent &= (ok.reshape(-1) > 0) & (ok_back.reshape(-1) > 0)
    if np.count_nonzero(consistent) < LEAST_CORNERS:
        return None
    # similarity by RANSAC
    motion, _ = cv2.estimateAffinePartial2D(
        corners.reshape(-1, 2)[consistent],
        there.reshape(-1, 2)[consistent],
        method=cv2.RANSAC,
        ransacReprojThreshold=2.0,
    )
    return None if motion is None else np.asarray(motion, np.float64)


def _moved(instances: Instances, masks: list[NDArray[np.bool_]]) -> Instances:
    """Objects under new masks, without those that left the image."""
    stack = np.array(masks, bool).reshape(instances.masks.shape)
    return replace(instances, masks=stack, boxes=boxes_of(stack)).visible()
