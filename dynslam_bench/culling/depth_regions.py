"""Rules that tell a person from the background by depth: depth RANSAC (B6), blocks of depth (B9), depth of a box."""

import cv2
import numpy as np
from numpy.typing import NDArray

from dynslam_bench.contracts import FilterResult, FilterState, FrameBundle, Need
from dynslam_bench.core.seeding import stream
from dynslam_bench.culling import ObjectFilter
from dynslam_bench.culling.semantic import dynamic_boxes, in_boxes
from dynslam_bench.culling.settings import BoxDepthSettings, DepthBlockSettings, DepthRansacSettings
from dynslam_bench.geometry import at_width, inside
from dynslam_bench.segmentation.postprocess import dilate, select

MIN_POINTS = 3
"""Fewest features with depth in a box for depth RANSAC."""


class DepthRansacFilter(ObjectFilter[DepthRansacSettings]):
    """B6, YOLO-SLAM: in each dynamic box the largest set of features of similar depth is dropped, the rest is kept.

    Stats: ``dropped``, ``objects``, ``in_boxes``.
    """

    name = "depth_ransac"
    needs: frozenset[Need] = frozenset({"boxes", "depth"})
    stats_names = ("dropped", "objects", "in_boxes")

    def apply(self, frame: FrameBundle, state: FilterState) -> FilterResult:
        """Find the person among the features of every box; features without depth are dropped too."""
        # the dynamic boxes, and the features in each
        keep = np.ones(len(frame.xy), dtype=bool)
        boxes = dynamic_boxes(frame, self.segmentation)
        member = in_boxes(frame.keypoints.xy, boxes)
        for number, in_box in enumerate(member):
            # the largest set of similar depth is the person; RANSAC draws the same in every run
            measured = np.flatnonzero(in_box & (frame.z > 0))
            rng = stream(state.seed, self.name, number)
            person = person_set(frame.z[measured], self.settings, rng)
            keep[measured[person]] = False
            keep[in_box & ~(frame.z > 0)] = False
        return self.verdict(keep, objects=len(boxes), in_boxes=np.count_nonzero(member.any(axis=0)))


def person_set(
    z: NDArray[np.floating], settings: DepthRansacSettings, rng: np.random.Generator
) -> NDArray[np.bool_]:
    """The largest set of features whose depth variance stays below the limit.

    From each drawn pair, the set grows by the nearest depths while its variance stays below the
    limit. The paper does not state the order; nearest first gives the largest set from that pair.

    Args:
        z: Depths ``[N]`` of the features in one box, metres, all valid.
        settings: Variance limit and number of draws.
        rng: Source of the draws.

    Returns:
        Bool ``[N]``.
    """
    count = len(z)
    draws = settings.max_draws
    drawn = 0
    best = np.zeros(count, dtype=bool)
    while drawn < draws and count >= MIN_POINTS:
        # a pair, then all others by their distance from its mean depth
        drawn += 1
        pair = rng.choice(count, 2, replace=False)
        order = np.argsort(np.abs(z - z[pair].mean()), kind="stable")
        order = np.concatenate([pair, order[~np.isin(order, pair)]])

        # variance of the first n depths, for every n; the set ends before the limit
        chosen = z[order].astype(np.float64)
        n = np.arange(1, count + 1)
        variance = np.cumsum(chosen**2) / n - np.square(np.cumsum(chosen) / n)
        size = int(np.argmax(np.append(variance, np.inf) >= settings.variance_m2))
        if size > np.count_nonzero(best):
            best = np.isin(np.arange(count), order[:size])

            # RANSAC's number of draws for a pair of inliers
            share = size / count
            needed = 0.0
            if share < 1:
                needed = np.log(1 - settings.confidence) / np.log(max(1 - share**2, 1e-12))
            draws = min(draws, max(drawn, int(np.ceil(needed))))
    return best


class BoxDepthFilter(ObjectFilter[BoxDepthSettings]):
    """NGD-SLAM's masks: drops the features on the largest connected region at the depth of a box's middle.

    A box with too little depth, or whose region would cover most of the image, is ignored.
    Stats: ``dropped``, ``objects``, ``ignored``, ``mask_fraction``.
    """

    name = "box_depth"
    needs: frozenset[Need] = frozenset({"boxes", "depth"})
    stats_names = ("dropped", "objects", "ignored", "mask_fraction")

    def apply(self, frame: FrameBundle, state: FilterState) -> FilterResult:
        """Segment the person in every box and drop the features on them."""
        # a person's mask in each box; those that are ignored have none
        depth = np.nan_to_num(frame.depth)
        boxes = dynamic_boxes(frame, self.segmentation)
        segmented = [self._segment(box, depth) for box in boxes]
        people = [mask for mask in segmented if mask is not None]
        union = np.logical_or.reduce([np.zeros(depth.shape, bool), *people])
        # the features on the people, with a border, are dropped
        mask = dilate(union, at_width(self.settings.dilation_px, depth.shape[1]))
        keep = ~inside(mask, frame.keypoints.xy)
        ignored = len(boxes) - len(people)
        return self.verdict(
            keep, mask, objects=len(boxes), ignored=ignored, mask_fraction=float(mask.mean())
        )

    def _segment(
        self, box: NDArray[np.float32], depth: NDArray[np.float32]
    ) -> NDArray[np.bool_] | None:
        """The mask ``[H, W]`` of the person in a box; None where the box is ignored."""
        # median depth of the box's middle
        x0, y0, x1, y1 = box.astype(np.float64)
        shrink = (1 - self.settings.core) / 2
        core = depth[_window(box, -shrink * (x1 - x0), -shrink * (y1 - y0), depth.shape)]
        valid = core[core > 0]
        if not core.size or len(valid) < max(self.settings.min_valid * core.size, 1):
            return None

        # the largest connected region at that depth, in the box with a margin
        margin = at_width(self.settings.margin_px, depth.shape[1])
        place = _window(box, margin, margin, depth.shape)
        window = depth[place]
        near = (window > 0) & (np.abs(window - np.median(valid)) <= self.settings.depth_m)
        count, label, stats, _ = cv2.connectedComponentsWithStats(
            near.astype(np.uint8), connectivity=8
        )
        if count < 2:
            return None
        person = np.zeros(depth.shape, bool)
        person[place] = label == 1 + int(np.argmax(stats[1:, cv2.CC_STAT_AREA]))
        return person if person.mean() <= self.settings.max_cover else None


def _window(
    box: NDArray[np.float32], grow_x: float, grow_y: float, shape: tuple[int, ...]
) -> tuple[slice, slice]:
    """Rows and columns of a box that is grown on all sides, within an image of a shape.

    Args:
        box: Corners x0, y0, x1, y1 in pixels.
        grow_x: Pixels added on the left and on the right; negative to shrink.
        grow_y: Pixels added above and below.
        shape: Height and width of the image.
    """
    x0, y0, x1, y1 = box.astype(np.float64)
    low = np.clip((y0 - grow_y, x0 - grow_x), 0, shape).astype(int)
    high = np.clip(np.ceil((y1 + grow_y, x1 + grow_x)), 0, shape).astype(int)
    return slice(low[0], high[0]), slice(low[1], high[1])


class DepthBlockFilter(ObjectFilter[DepthBlockSettings]):
    """B9, Blitz-SLAM: drops the features on people, whose masks depth completes, and on movable objects they touch.

    The depth image is divided into blocks along its edges. A block of which enough lies on the mask
    is added to the mask as a whole. A person in front of a wall is a block; a person on a floor
    forms one block with the floor. Stats: ``dropped``, ``objects``, ``touched`` (movable objects
    that a person touches), ``blocks`` (added as a whole), ``mask_fraction``.
    """

    name = "depth_blocks"
    needs: frozenset[Need] = frozenset({"masks", "depth"})
    stats_names = ("dropped", "objects", "touched", "blocks", "mask_fraction")

    def apply(self, frame: FrameBundle, state: FilterState) -> FilterResult:
        """Complete the masks and drop what lies on them."""
        if frame.instances is None or not len(frame.instances):
            return self.verdict(np.ones(len(frame.xy), dtype=bool))

        # people, and movable objects that a person touches
        people = select(frame.instances, self.segmentation)
        mask = people.union()
        movable_classes = self.segmentation.model_copy(update={"classes": self.settings.movable})
        movable = select(frame.instances, movable_classes)
        neighbourhood = dilate(mask, 1) if len(movable) else mask
        touched: list[NDArray[np.bool_]] = []
        for movable_mask in movable.masks:
            if (movable_mask & neighbourhood).any() and (movable_mask & ~mask).any():
                touched.append(movable_mask)
        mask = np.logical_or.reduce([mask, *touched])

        # complete the masks by blocks of depth
        blocks = 0
        if mask.any():
            whole, blocks = covered_blocks(mask, frame.depth, self.settings)
            radius = at_width(self.segmentation.dilation_px, mask.shape[1])
            mask = dilate(mask | whole, radius)
        keep = ~inside(mask, frame.keypoints.xy)
        objects = len(people)
        share = float(mask.mean())
        return self.verdict(
            keep, mask, objects=objects, touched=len(touched), blocks=blocks, mask_fraction=share
        )


def covered_blocks(
    mask: NDArray[np.bool_], depth: NDArray[np.float32], settings: DepthBlockSettings
) -> tuple[NDArray[np.bool_], int]:
    """The blocks of continuous depth of which a mask covers enough.

    Args:
        mask: Bool ``[H, W]``.
        depth: float32 ``[H, W]`` metres, 0 or not finite where missing.
        settings: Depth range, step at an edge and the share that must be covered.

    Returns:
        Bool ``[H, W]`` of the pixels in such blocks, and the number of blocks.
    """
    # edges: pixels whose depth differs from a neighbour's
    valid = (depth > 0) & (depth <= settings.max_depth_m)
    z = np.where(valid, depth, 0).astype(np.float32)
    square = np.ones((2, 2), np.uint8)
    edge = cv2.dilate(z, square) - cv2.erode(z, square) > settings.edge_m

    # connected components between the edges, and which of them the mask covers enough
    count, label = cv2.connectedComponents((valid & ~edge).view(np.uint8), connectivity=4)
    size = np.bincount(label.ravel(), minlength=count)
    whole = np.bincount(label[mask], minlength=count) >= np.maximum(settings.min_share * size, 1)
    # label 0 are edges and pixels without depth
    whole[0] = False
    return np.asarray(whole[label]), int(np.count_nonzero(whole))
