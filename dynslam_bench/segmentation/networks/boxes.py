"""Boxes in torch: overlap, coding against anchors, non-maximum suppression, assignment to objects for training.

Boxes are x0, y0, x1, y1 in pixels.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

MAX_LOG_RATIO = math.log(1000.0 / 16)
"""Decoded boxes grow by at most this (log), so that exp() cannot overflow."""
RPN_WEIGHTS = (1.0, 1.0, 1.0, 1.0)
BOX_WEIGHTS = (10.0, 10.0, 5.0, 5.0)
NEGATIVE, IGNORED = -1, -2
"""Values of `match` for boxes without an object."""


def box_iou(a: Tensor, b: Tensor) -> Tensor:
    """Intersection over union ``[N, M]`` of boxes ``[N, 4]`` and ``[M, 4]``; 0 where both are empty."""
    shared = torch.minimum(a[:, None, 2:], b[None, :, 2:]) - torch.maximum(a[:, None, :2], b[None, :, :2])
    width, height = shared.clamp(min=0).unbind(dim=2)
    inter = width * height
    area_a, area_b = ((boxes[:, 2] - boxes[:, 0]) * (boxes[:, 3] - boxes[:, 1]) for boxes in (a, b))
    return inter / (area_a[:, None] + area_b[None] - inter).clamp(min=1e-12)


def nms(boxes: Tensor, scores: Tensor, threshold: float) -> Tensor:
    """Greedy non-maximum suppression.

    The greedy rule is "a box stays if no better box that stays overlaps it by more than `threshold`". It is solved
    exactly, by fixed-point iteration over the whole overlap matrix. That needs as many rounds as the longest chain of
    suppressions, usually a handful.

    Args:
        boxes: ``[N, 4]``.
        scores: ``[N]``; among equal scores the earlier box counts as better.
        threshold: IoU above which the weaker box goes.

    Returns:
        Indices of the boxes that stay, best first.
    """
    order = scores.argsort(descending=True, stable=True)
    over = torch.triu(box_iou(boxes[order], boxes[order]) > threshold, diagonal=1).to(torch.float32)
    keep = over.new_ones(len(order))
    for _ in range(len(order)):
        new = ((keep @ over) == 0).to(torch.float32)
        if torch.equal(new, keep):
            break
        keep = new
    return order[keep > 0]


def grouped_nms(boxes: Tensor, scores: Tensor, groups: Tensor, threshold: float) -> Tensor:
    """Suppression within each group (class or level); indices of all that stay, best first."""
    kept = []
    for group in sorted(set(groups.tolist())):
        members = torch.nonzero(groups == group)[:, 0]
        kept.append(members[nms(boxes[members], scores[members], threshold)])
    if not kept:
        return torch.zeros(0, dtype=torch.long, device=boxes.device)
    together = torch.cat(kept)
    return together[scores[together].argsort(descending=True, stable=True)]


def clip(boxes: Tensor, height: int, width: int) -> Tensor:
    """Boxes ``[..., 4]`` cut to the image."""
    limits = boxes.new_tensor([width, height, width, height])
    return torch.minimum(boxes.clamp(min=0), limits)


def encode(targets: Tensor, references: Tensor, weights: tuple[float, float, float, float]) -> Tensor:
    """Regression targets ``[N, 4]`` (dx, dy, log dw, log dh) that move references onto targets."""
    size, centre = _size_centre(references)
    target_size, target_centre = _size_centre(targets)
    offset = (target_centre - centre) / size
    ratio = torch.log(target_size / size)
    return torch.cat([offset, ratio], dim=1) * targets.new_tensor(weights)


def decode(codes: Tensor, references: Tensor, weights: tuple[float, float, float, float]) -> Tensor:
    """Boxes ``[N, C, 4]`` from codes ``[N, C * 4]`` and references ``[N, 4]``."""
    size, centre = _size_centre(references)
    scaled = codes.reshape(len(codes), -1, 4) / codes.new_tensor(weights)
    new_centre = scaled[:, :, :2] * size[:, None] + centre[:, None]
    half = 0.5 * torch.exp(scaled[:, :, 2:].clamp(max=MAX_LOG_RATIO)) * size[:, None]
    return torch.cat([new_centre - half, new_centre + half], dim=2)


def _size_centre(boxes: Tensor) -> tuple[Tensor, Tensor]:
    size = boxes[:, 2:] - boxes[:, :2]
    return size, boxes[:, :2] + 0.5 * size


def match(boxes: Tensor, truth: Tensor, *, high: float, low: float, keep_best: bool) -> Tensor:
    """Index of the object that each box is assigned to, or `NEGATIVE`, or `IGNORED` for overlaps in between.

    Args:
        boxes: ``[N, 4]``.
        truth: ``[G, 4]``.
        high: IoU from which a box is positive.
        low: IoU below which it is negative.
        keep_best: Also make positive the boxes that overlap an object most, however little.
    """
    if not len(truth):
        return torch.full((len(boxes),), NEGATIVE, device=boxes.device)
    overlap = box_iou(truth, boxes)
    best, index = overlap.max(dim=0)
    result = index.masked_fill(best < high, IGNORED).masked_fill(best < low, NEGATIVE)
    if keep_best:
        top = overlap.max(dim=1, keepdim=True).values
        forced = ((overlap == top) & (overlap > 0)).any(dim=0)
        result[forced] = index[forced]
    return result


def sample(matched: Tensor, *, count: int, positive_share: float, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Indices of the positive and of the negative boxes that enter a loss, drawn at random.

    Args:
        matched: Result of `match`.
        count: How many boxes at most.
        positive_share: Largest share of positive ones.
        generator: Draws.
    """
    positive = _draw(matched >= 0, int(count * positive_share), generator)
    return positive, _draw(matched == NEGATIVE, count - len(positive), generator)


def _draw(candidates: Tensor, count: int, generator: torch.Generator) -> Tensor:
    """Indices of at most `count` of the boxes where `candidates` is true."""
    index = torch.nonzero(candidates)[:, 0]
    if count >= len(index):
        return index
    return index[torch.randperm(len(index), generator=generator)[:count].to(index.device)]
