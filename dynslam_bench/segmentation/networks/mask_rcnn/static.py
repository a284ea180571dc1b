"""The network without any shape that depends on the image: what other runtimes can take.

The same weights and the same results as `MaskRCNN.detect` with `paste`, written so that every tensor has a known size:
suppression keeps all boxes and sets the scores of suppressed ones to zero, RoIAlign and the pasting of masks are
products with matrices of interpolation weights, one a box and axis. Lists are as long as they may get: whatever has the
score 0 is no object.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional

from .box_ops import BOX_WEIGHTS, RPN_WEIGHTS, clip, decode
from .network import MaskRCNN
from .roi_align import _scale, levels_of
from .roi_heads import BOX_POOL, MIN_BOX_PX
from .rpn import MIN_BOX_PX as MIN_PROPOSAL_PX
from .rpn import anchors_of

ROUNDS = 24
"""Of suppression's fixed-point iteration: as long as the longest chain of boxes that suppress each other may be."""
CANDIDATES = 400
"""Most classified boxes that reach the last suppression; where more have the least score, the best do."""
CHUNK = 100
"""Boxes whose features are gathered at a time, for the memory's sake."""
SAMPLES = 2


class StaticMaskRCNN(nn.Module):
    """A `MaskRCNN` for images of one size.

    Args:
        network: In inference mode; it is not changed.
        height: Of the images.
        width: Of the images.
        score: Least score of an object.
        iou: Overlap of two boxes of one class above which the weaker one is dropped.
    """

    def __init__(self, network: MaskRCNN, height: int, width: int, *, score: float, iou: float) -> None:
        super().__init__()
        self.network, self.height, self.width = network, height, width
        self.score, self.iou = score, iou
        with torch.no_grad():
            x, self.size = network.prepare(torch.zeros(3, height, width))
            levels, _ = network.backbone(x)
        self.padded = (int(x.shape[2]), int(x.shape[3]))
        for level, anchors in enumerate(anchors_of(network.rpn._cells, levels, *self.padded)):
            self.register_buffer(f"anchors{level}", anchors)

    def forward(self, image: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Objects, best first, filled up with objects of score 0 to the network's ``max_detections``.

        Args:
            image: float ``[1, 3, H, W]`` in [0, 1].

        Returns:
            Boxes ``[K, 4]`` in pixels of the image, labels ``[K]`` from 1, scores ``[K]`` and masks ``[K, 1, H, W]``,
            probabilities in the whole image.
        """
        x, _ = self.network.prepare(image[0])
        levels, mask_levels = self.network.backbone(x)
        proposals, valid = self._proposals(levels)
        boxes, labels, scores = self._classified(levels[:4], proposals, valid)
        config = self.network.config
        pooled = self._pooled(mask_levels, boxes, config.mask_pool, config.mask_canonical)
        heads = self.network.roi_heads
        logits = heads.mask_predictor(heads.mask_head(pooled))
        chosen = labels[:, None, None, None].expand(-1, 1, *logits.shape[2:])
        planes = torch.gather(logits, 1, chosen)[:, 0].sigmoid()
        back = boxes.new_tensor([self.width / self.size[1], self.height / self.size[0]]).repeat(2)
        boxes = boxes * back
        return boxes, labels, scores, self._pasted(planes, boxes)[:, None]

    def _proposals(self, levels: list[Tensor]) -> tuple[Tensor, Tensor]:
        """Boxes ``[post_nms, 4]`` that may hold an object, and whether each is one, 0 or 1."""
        config, logits_codes = self.network.config, self.network.rpn.head(levels)
        boxes, scores = [], []
        for level, (logits, codes) in enumerate(zip(*logits_codes, strict=True)):
            anchors: Tensor = getattr(self, f"anchors{level}")
            best, chosen = logits[0].topk(min(config.pre_nms, len(anchors)))
            codes, anchors = codes[0].index_select(0, chosen), anchors.index_select(0, chosen)
            box = clip(decode(codes, anchors, RPN_WEIGHTS)[:, 0], *self.size)
            large = ((box[:, 2:] - box[:, :2]) >= MIN_PROPOSAL_PX).all(dim=1).to(box.dtype)
            boxes.append(box)
            scores.append(best.sigmoid() * unsuppressed(overlap(box) > config.rpn_nms, large))
        count = min(config.post_nms, sum(map(len, scores)))
        score, order = torch.cat(scores).topk(count)
        return torch.cat(boxes).index_select(0, order), (score > 0).to(score.dtype)

    def _classified(self, levels: list[Tensor], proposals: Tensor, valid: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Boxes ``[K, 4]`` in pixels of the input, labels and scores of the objects."""
        config, heads = self.network.config, self.network.roi_heads
        pooled = self._pooled(levels, proposals, BOX_POOL, config.canonical)
        logits, codes = heads.box_predictor(heads.box_head(pooled))
        scores = functional.softmax(logits, dim=1)[:, 1:]
        boxes = clip(decode(codes, proposals, BOX_WEIGHTS), *self.size)[:, 1:]
        classes = scores.shape[1]
        large = ((boxes[:, :, 2:] - boxes[:, :, :2]) >= MIN_BOX_PX).all(dim=2)
        passed = scores * valid[:, None] * ((scores > self.score) & large).to(scores.dtype)
        best, order = passed.reshape(-1).topk(min(CANDIDATES, passed.numel()))
        box, label = boxes.reshape(-1, 4).index_select(0, order), order % classes + 1
        over = (overlap(box) > self.iou) & (label[:, None] == label[None, :])
        kept, order = (best * unsuppressed(over, (best > 0).to(best.dtype))).topk(min(config.max_detections, len(best)))
        return box.index_select(0, order), label.index_select(0, order), kept

    def _pooled(self, levels: list[Tensor], boxes: Tensor, size: int, canonical: float) -> Tensor:
        """RoIAlign ``[K, C, size, size]`` of one image's boxes; see `roi_align`."""
        few = [boxes[start : start + CHUNK] for start in range(0, len(boxes), CHUNK)]
        return torch.cat([self._pooled_few(levels, each, size, canonical) for each in few])

    def _pooled_few(self, levels: list[Tensor], boxes: Tensor, size: int, canonical: float) -> Tensor:
        count, channels = len(boxes), levels[0].shape[1]
        side = (boxes[:, 2:] - boxes[:, :2]).clamp(min=1e-3)  # what is no object may be empty
        level = levels_of(torch.cat([boxes[:, :2], boxes[:, :2] + side], dim=1), canonical, len(levels))
        pooled: list[Tensor] = []
        for index, features in enumerate(levels):
            rows, columns = int(features.shape[2]), int(features.shape[3])
            scaled = boxes * _scale(rows, self.padded[0])
            mine = (level == index).to(boxes.dtype)[:, None, None]
            y = _bins(scaled[:, 1], scaled[:, 3], rows, size) * mine
            x = _bins(scaled[:, 0], scaled[:, 2], columns, size)
            table = features[0].permute(1, 0, 2).reshape(rows, channels * columns)
            by_row = (y.reshape(count * size, rows) @ table).reshape(count, size * channels, columns)
            found = (by_row @ x.transpose(1, 2)).reshape(count, size, channels, size)
            pooled.append(found.permute(0, 2, 1, 3))
        return torch.stack(pooled).sum(dim=0)

    def _pasted(self, planes: Tensor, boxes: Tensor) -> Tensor:
        """Masks ``[K, M, M]`` inside boxes as probabilities ``[K, H, W]`` in the image; see `paste`."""
        if not self.network.config.exact_paste:
            planes, boxes = _grown(planes, boxes)
        rows = _taps(boxes[:, 1], boxes[:, 3], self.height, planes.shape[1])
        columns = _taps(boxes[:, 0], boxes[:, 2], self.width, planes.shape[2])
        return rows @ planes @ columns.transpose(1, 2)


def unsuppressed(over: Tensor, valid: Tensor) -> Tensor:
    """Which boxes stay, 1 or 0, of boxes in order of falling scores: greedy suppression in `ROUNDS` rounds.

    Args:
        over: Bool ``[N, N]``, which overlap too much.
        valid: ``[N]``: 0 for boxes that are none, which stay away and suppress nothing.
    """
    before = torch.ones(len(valid), len(valid)).tril(diagonal=-1)
    better = over.to(valid.dtype) * before
    keep = column = valid[:, None]
    for _ in range(ROUNDS):
        keep = column * (better @ keep < 0.5).to(valid.dtype)
    return keep[:, 0]


def overlap(boxes: Tensor) -> Tensor:
    """IoU ``[N, N]`` of boxes ``[N, 4]``; 0 where neither has an area."""
    low, high, size = boxes[:, :2], boxes[:, 2:], boxes[:, 2:] - boxes[:, :2]
    shared = (torch.minimum(high[:, None], high[None]) - torch.maximum(low[:, None], low[None])).clamp(min=0)
    inter, area = shared[:, :, 0] * shared[:, :, 1], size[:, 0] * size[:, 1]
    return inter / (area[:, None] + area[None] - inter).clamp(min=1e-12)


def _bins(low: Tensor, high: Tensor, length: int, size: int) -> Tensor:
    """Weights ``[K, size, length]`` with which cells along one axis enter the bins of boxes."""
    extent = (high - low).clamp(min=1.0)
    step = (torch.arange(size * SAMPLES, dtype=torch.float32) + 0.5) / (size * SAMPLES)
    at = low[:, None] + step * extent[:, None]
    inside = ((at >= -1.0) & (at <= float(length))).to(at.dtype) / SAMPLES
    weights = _hat(at.clamp(min=0.0, max=float(length - 1)), length) * inside[:, :, None]
    return weights.reshape(len(low), size, SAMPLES, length).sum(dim=2)


def _taps(low: Tensor, high: Tensor, length: int, cells: int) -> Tensor:
    """Weights ``[K, length, cells]`` with which cells of a box enter the pixels along one axis; 0 outside the box."""
    centre = torch.arange(length, dtype=torch.float32) + 0.5
    extent = (high - low).clamp(min=1e-3)
    at = (centre[None] - low[:, None]) * (cells / extent)[:, None] - 0.5
    inside = ((centre[None] >= low[:, None]) & (centre[None] <= high[:, None])).to(at.dtype)
    return _hat(at.clamp(min=0.0, max=float(cells - 1)), cells) * inside[:, :, None]


def _hat(at: Tensor, length: int) -> Tensor:
    """Weights ``[..., length]`` of linear interpolation at places ``[...]`` within 0 and ``length - 1``."""
    distance = (at[..., None] - torch.arange(length, dtype=torch.float32)).abs()
    return (1.0 - distance).clamp(min=0.0)


def _grown(planes: Tensor, boxes: Tensor) -> tuple[Tensor, Tensor]:
    """Masks with a border of one cell, and their boxes grown by the same share and cut to whole pixels."""
    side = planes.shape[1]
    centre, half = (boxes[:, :2] + boxes[:, 2:]) / 2, (boxes[:, 2:] - boxes[:, :2]) / 2 * ((side + 2) / side)
    low, high = torch.trunc(centre - half), torch.trunc(centre + half) + 1
    return functional.pad(planes, (1, 1, 1, 1)), torch.cat([low, torch.maximum(high, low + 1)], dim=1)
