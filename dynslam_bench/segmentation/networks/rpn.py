"""Region proposal network (Ren et al. 2015) on a feature pyramid."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional

from dynslam_bench.segmentation.networks.backbone import NetworkConfig, initialise
from dynslam_bench.segmentation.networks.boxes import (
    RPN_WEIGHTS,
    clip,
    decode,
    encode,
    grouped_nms,
    match,
    sample,
)

MIN_BOX_PX = 1e-3


def anchor_cells(config: NetworkConfig) -> list[Tensor]:
    """Anchors ``[A, 4]`` of each level around the origin, rounded to pixels as the published models have them."""
    ratios = torch.tensor(config.anchor_ratios, device="cpu")
    heights, widths = ratios.sqrt(), 1 / ratios.sqrt()
    cells = []
    for size in config.anchor_sizes:
        half = torch.stack([widths * size, heights * size], dim=1)
        cells.append(torch.cat([-half, half], dim=1).div(2).round())
    return cells


def anchors_of(cells: list[Tensor], levels: list[Tensor], height: int, width: int) -> list[Tensor]:
    """Anchors ``[H_l * W_l * A, 4]`` of each level, row by row."""
    result = []
    for cell, level in zip(cells, levels, strict=True):
        rows, columns = level.shape[-2:]
        y = torch.arange(rows, device=level.device, dtype=torch.float32) * (height // rows)
        x = torch.arange(columns, device=level.device, dtype=torch.float32) * (width // columns)
        yy, xx = torch.meshgrid(y, x, indexing="ij")
        shifts = torch.stack([xx, yy, xx, yy], dim=2).reshape(-1, 1, 4)
        result.append((shifts + cell.to(level.device)).reshape(-1, 4))
    return result


class RPNHead(nn.Module):
    """Objectness and box codes of every anchor; one 3x3 convolution shared by all levels."""

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        count = len(config.anchor_ratios)
        self.conv = nn.Sequential(nn.Sequential(nn.Conv2d(config.channels, config.channels, 3, padding=1), nn.ReLU()))
        self.cls_logits = nn.Conv2d(config.channels, count, 1)
        self.bbox_pred = nn.Conv2d(config.channels, 4 * count, 1)
        initialise(self, lambda weight: nn.init.normal_(weight, std=0.01))

    def forward(self, levels: list[Tensor]) -> tuple[list[Tensor], list[Tensor]]:
        """Objectness logits ``[B, H W A]`` and codes ``[B, H W A, 4]`` of each level, in the anchors' order."""
        scores, codes = [], []
        for level in levels:
            x = self.conv(level)
            batch = x.shape[0]
            scores.append(self.cls_logits(x).permute(0, 2, 3, 1).reshape(batch, -1))
            codes.append(self.bbox_pred(x).permute(0, 2, 3, 1).reshape(batch, -1, 4))
        return scores, codes


class RPN(nn.Module):
    """Proposes boxes that may hold an object."""

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        self.config = config
        self.head = RPNHead(config)
        self._cells = anchor_cells(config)

    def forward(
        self, levels: list[Tensor], height: int, width: int, sizes: list[tuple[int, int]]
    ) -> tuple[list[Tensor], list[Tensor], list[Tensor], list[Tensor]]:
        """Proposals of a batch.

        Args:
            levels: P2..P6.
            height: Of the padded input.
            width: Of the padded input.
            sizes: Height and width of each image inside the padded input.

        Returns:
            Proposals ``[K, 4]`` of each image, best first; anchors, logits and codes of each level (for the losses).
        """
        logits, codes = self.head(levels)
        anchors = anchors_of(self._cells, levels, height, width)
        with torch.no_grad():
            proposals = [self._propose(anchors, logits, codes, image, size) for image, size in enumerate(sizes)]
        return proposals, anchors, logits, codes

    def _propose(
        self, anchors: list[Tensor], logits: list[Tensor], codes: list[Tensor], image: int, size: tuple[int, int]
    ) -> Tensor:
        boxes, scores, groups = [], [], []
        for level, anchor in enumerate(anchors):
            count = min(self.config.pre_nms, len(anchor))
            best, chosen = logits[level][image].detach().float().topk(count)
            boxes.append(decode(codes[level][image].detach().float()[chosen], anchor[chosen], RPN_WEIGHTS)[:, 0])
            scores.append(best.sigmoid())
            groups.append(torch.full_like(chosen, level))
        box, score, group = clip(torch.cat(boxes), *size), torch.cat(scores), torch.cat(groups)
        large = ((box[:, 2:] - box[:, :2]) >= MIN_BOX_PX).all(dim=1)
        box, score, group = box[large], score[large], group[large]
        return box[grouped_nms(box, score, group, self.config.rpn_nms)[: self.config.post_nms]]


def rpn_loss(
    anchors: list[Tensor], logits: list[Tensor], codes: list[Tensor], truths: list[Tensor], generator: torch.Generator
) -> tuple[Tensor, Tensor]:
    """Losses of objectness and of box codes (Ren et al. 2015, Eq. 1), 256 anchors an image, half of them positive.

    Args:
        anchors: Of each level.
        logits: Of each level ``[B, N_l]``.
        codes: Of each level ``[B, N_l, 4]``.
        truths: Boxes ``[G, 4]`` of each image.
        generator: Draws the sample.
    """
    every = torch.cat(anchors)
    all_logits = torch.cat(logits, dim=1).float()
    all_codes = torch.cat(codes, dim=1).float()
    objectness, regression = [], []
    total = 0
    for image, truth in enumerate(truths):
        matched = match(every, truth, high=0.7, low=0.3, keep_best=True)
        positive, negative = sample(matched, count=256, positive_share=0.5, generator=generator)
        index = torch.cat([positive, negative])
        label = (matched[index] >= 0).float()
        objectness.append(functional.binary_cross_entropy_with_logits(all_logits[image, index], label, reduction="sum"))
        wanted = encode(truth[matched[positive]], every[positive], RPN_WEIGHTS) if len(positive) else every[:0]
        regression.append(functional.smooth_l1_loss(all_codes[image, positive], wanted, beta=1 / 9, reduction="sum"))
        total += len(index)
    return torch.stack(objectness).sum() / max(total, 1), torch.stack(regression).sum() / max(total, 1)
