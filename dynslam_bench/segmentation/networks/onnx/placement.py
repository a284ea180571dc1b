"""Where the frame lies in a network's input, and masks and boxes brought from there into the frame."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from dynslam_bench.contracts.segmenter import Instances

Float: TypeAlias = "np.ndarray[Any, np.dtype[np.float32]]"


@dataclass(frozen=True)
class Placement:
    """Where the frame lies in the network's input: ``x_input = x_frame * scale_x + offset_x``, likewise y."""

    scale_x: float
    scale_y: float
    offset_x: float
    offset_y: float
    input_width: int
    input_height: int


def _frame_box(corner: Float, place: Placement, width: int, height: int) -> tuple[int, int, int, int]:
    x0 = (float(corner[0]) - place.offset_x) / place.scale_x
    y0 = (float(corner[1]) - place.offset_y) / place.scale_y
    x1 = (float(corner[2]) - place.offset_x) / place.scale_x
    y1 = (float(corner[3]) - place.offset_y) / place.scale_y
    return (max(0, math.floor(x0)), max(0, math.floor(y0)), min(width, math.ceil(x1)), min(height, math.ceil(y1)))


def paste_plane(mask: NDArray[np.bool_], plane: Float, corner: Float, place: Placement, level: float) -> None:
    """Sample a prototype mask (a plane over the whole input) at the frame's pixels inside the box."""
    x0, y0, x1, y1 = _frame_box(corner, place, mask.shape[1], mask.shape[0])
    if x1 <= x0 or y1 <= y0:
        return
    ratio_x, ratio_y = plane.shape[1] / place.input_width, plane.shape[0] / place.input_height
    first_x = ((x0 + 0.5) * place.scale_x + place.offset_x) * ratio_x - 0.5
    first_y = ((y0 + 0.5) * place.scale_y + place.offset_y) * ratio_y - 0.5
    # pixel centres of the frame's patch -> pixel centres of the plane
    to_plane = np.array([[place.scale_x * ratio_x, 0, first_x], [0, place.scale_y * ratio_y, first_y]])
    size, flags = (x1 - x0, y1 - y0), cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    patch = cv2.warpAffine(plane, to_plane, size, flags=flags, borderMode=cv2.BORDER_REPLICATE)
    mask[y0:y1, x0:x1] = patch > level


def assemble(masks: NDArray[np.bool_], corners: Float, names: list[str], scores: Float, place: Placement) -> Instances:
    """Instances in frame coordinates, without the objects whose mask came out empty."""
    full = np.asarray(masks.any(axis=(1, 2)))
    shift = np.array([place.offset_x, place.offset_y] * 2, np.float32)
    scale = np.array([place.scale_x, place.scale_y] * 2, np.float32)
    boxes = np.clip((corners - shift) / scale, 0, np.array([masks.shape[2], masks.shape[1]] * 2)).astype(np.float32)
    kept = tuple(name for name, there in zip(names, full.tolist(), strict=True) if there)
    return Instances(masks[full], boxes[full], kept, scores[full].astype(np.float32))
