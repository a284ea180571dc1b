"""Assign anchors or proposals to ground-truth boxes and draw a balanced sample of them, for training."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

from .box_ops import box_iou

NEGATIVE, IGNORED = -1, -2


@dataclass(frozen=True)
class Sampled:
    """Indices of the boxes that enter a loss."""

    positive: Tensor
    negative: Tensor


def match(boxes: Tensor, truth: Tensor, *, high: float, low: float, keep_best: bool) -> Tensor:
    """Index of the truth that each box stands for, or `NEGATIVE`, or `IGNORED` for overlaps in between.

    Args:
        boxes: ``[N, 4]``.
        truth: ``[G, 4]``.
        high: IoU from which a box is positive.
        low: IoU below which it is negative.
        keep_best: Also make positive whatever overlaps a truth best, however little.
    """
    if not len(truth):
        return torch.full((len(boxes),), NEGATIVE, device=boxes.device)
    overlap = box_iou(truth, boxes)
    best, index = overlap.max(dim=0)
    result = index.clone()
    result[best < high] = IGNORED
    result[best < low] = NEGATIVE
    if keep_best:
        top = overlap.max(dim=1, keepdim=True).values
        forced = ((overlap == top) & (overlap > 0)).any(dim=0)
        result[forced] = index[forced]
    return result


def sample(matched: Tensor, *, count: int, positive_share: float, generator: torch.Generator) -> Sampled:
    """Draw at most `count` boxes, at most `positive_share` of them positive."""
    positive = torch.nonzero(matched >= 0)[:, 0]
    negative = torch.nonzero(matched == NEGATIVE)[:, 0]
    positives = min(len(positive), int(count * positive_share))
    negatives = min(len(negative), count - positives)
    return Sampled(_draw(positive, positives, generator), _draw(negative, negatives, generator))


def smooth_l1(values: Tensor, wanted: Tensor, *, beta: float) -> Tensor:
    """Summed smooth L1 loss; zero (with a gradient path) for no rows."""
    return functional.smooth_l1_loss(values, wanted, beta=beta, reduction="sum")


def _draw(index: Tensor, count: int, generator: torch.Generator) -> Tensor:
    if count == len(index):
        return index
    return index[torch.randperm(len(index), generator=generator)[:count].to(index.device)]
