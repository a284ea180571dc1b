"""RoIAlign, box head and mask head of a Mask R-CNN (He et al. 2017).

RoIAlign over a feature pyramid is one weighted gather. Every output bin is a weighted sum of 4 x S^2 feature vectors
(S^2 bilinear samples of four corners each). An embedding bag over the rows of all levels' feature maps computes it in
one vectorised call for all boxes, levels and channels.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

from dynslam_bench.segmentation.networks.backbone import NetworkConfig
from dynslam_bench.segmentation.networks.boxes import (
    BOX_WEIGHTS,
    clip,
    decode,
    encode,
    grouped_nms,
    match,
    sample,
)

BOX_POOL = 7
MIN_BOX_PX = 1e-2
PROPOSALS_PER_IMAGE = 512
POSITIVE_SHARE = 0.25


def levels_of(boxes: Tensor, canonical: float, count: int) -> Tensor:
    """Index of the pyramid level (0 = finest, stride 4) of each box: a box of side `canonical` goes to index 2.

    Lin et al. 2017, Eq. 1, with k0 = 4 and P2 as the first level.
    """
    side = torch.sqrt((boxes[:, 2] - boxes[:, 0]) * (boxes[:, 3] - boxes[:, 1]))
    level = torch.floor(4 + torch.log2(side / canonical) + 1e-6)
    return (level.clamp(2, count + 1) - 2).long()


def roi_align(
    features: list[Tensor], boxes: list[Tensor], image_height: int, size: int, *, canonical: float, samples: int = 2
) -> Tensor:
    """Features of boxes, each from the pyramid level that fits its size.

    Args:
        features: Levels ``[B, C, H_l, W_l]``, finest first.
        boxes: One ``[K_b, 4]`` an image, input pixels.
        image_height: Of the network's input; gives the levels' scales.
        size: Bins a side.
        canonical: Box side that goes to the third level.
        samples: Sampling points a side of a bin.

    Returns:
        ``[sum K_b, C, size, size]``; samples outside the feature map count as 0 (beyond one cell), as in the original.
    """
    batch, channels = features[0].shape[:2]
    device = features[0].device
    rois = torch.cat(boxes)
    image = torch.repeat_interleave(
        torch.arange(batch, device=device), torch.tensor([len(b) for b in boxes], device=device)
    )
    if not len(rois):
        return features[0].new_zeros((0, channels, size, size))
    table = torch.cat([level.permute(0, 2, 3, 1).reshape(-1, channels) for level in features])
    level = levels_of(rois, canonical, len(features))
    heights = torch.tensor([f.shape[2] for f in features], device=device)[level]
    widths = torch.tensor([f.shape[3] for f in features], device=device)[level]
    cells = torch.tensor([0, *(batch * f.shape[2] * f.shape[3] for f in features[:-1])], device=device)
    base = cells.cumsum(dim=0)[level] + image * heights * widths
    scales = torch.tensor([level_scale(f.shape[2], image_height) for f in features], device=device)[level]
    scaled = rois.to(torch.float32) * scales[:, None]
    rows, row_weights = _axis(scaled[:, 1], scaled[:, 3], heights, size, samples)
    columns, column_weights = _axis(scaled[:, 0], scaled[:, 2], widths, size, samples)
    index = (base[:, None, None] + rows * widths[:, None, None])[:, :, None, :, None] + columns[:, None, :, None, :]
    weight = row_weights[:, :, None, :, None] * column_weights[:, None, :, None, :]
    taps = (2 * samples) ** 2
    bags = functional.embedding_bag(
        index.reshape(-1, taps), table, mode="sum", per_sample_weights=weight.reshape(-1, taps).to(table.dtype)
    )
    return bags.reshape(len(rois), size, size, channels).permute(0, 3, 1, 2)


def level_scale(level_height: int, image_height: int) -> float:
    """The power of two nearest to the level's height over the image's."""
    return float(2.0 ** torch.tensor(level_height / image_height).log2().round().item())


def _axis(low: Tensor, high: Tensor, length: Tensor, size: int, samples: int) -> tuple[Tensor, Tensor]:
    """Cells ``[K, size, 2 samples]`` along one axis that each bin's samples touch, and their weights."""
    extent = (high - low).clamp(min=1.0)
    step = (torch.arange(size * samples, device=low.device, dtype=torch.float32) + 0.5) / (size * samples)
    # bin by bin, as the original adds them up: start + bin * bin_size + (sample + .5) * bin_size / samples
    at = low[:, None] + step * extent[:, None]
    last = (length - 1)[:, None].to(torch.float32)
    inside = (at >= -1.0) & (at <= last + 1.0)
    at = torch.minimum(at.clamp(min=0.0), last)
    floor = at.floor()
    fraction = at - floor
    upper = torch.minimum(floor + 1, last)
    scale = inside / samples
    cells = torch.stack([floor, upper], dim=2).long()
    weights = torch.stack([(1 - fraction) * scale, fraction * scale], dim=2)
    count = len(low)
    return cells.reshape(count, size, 2 * samples), weights.reshape(count, size, 2 * samples)


class Detections(NamedTuple):
    """Objects found in one image, in pixels of the network's input, best first.

    Attributes:
        boxes: ``[K, 4]``.
        labels: ``[K]`` class numbers from 1.
        scores: ``[K]``.
        masks: ``[K, M, M]`` probabilities inside the box.
    """

    boxes: Tensor
    labels: Tensor
    scores: Tensor
    masks: Tensor


def _initialise(weight: Tensor) -> None:
    """Initialise as He et al. 2015 for a ReLU, by the outputs; nothing on the ``meta`` device, see `initialise`."""
    if not weight.is_meta:
        nn.init.kaiming_normal_(weight, mode="fan_out", nonlinearity="relu")


class TwoMLPHead(nn.Module):
    """Two fully connected layers on the pooled features of a box."""

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        self.fc6 = nn.Linear(config.channels * BOX_POOL**2, config.box_hidden)
        self.fc7 = nn.Linear(config.box_hidden, config.box_hidden)

    def forward(self, x: Tensor) -> Tensor:
        """``[K, C, 7, 7]`` to ``[K, hidden]``."""
        return functional.relu(self.fc7(functional.relu(self.fc6(x.flatten(1)))))


class BoxPredictor(nn.Module):
    """Class scores and one box a class."""

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        self.cls_score = nn.Linear(config.box_hidden, len(config.classes) + 1)
        self.bbox_pred = nn.Linear(config.box_hidden, 4 * (len(config.classes) + 1))

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """``[K, hidden]`` to logits ``[K, n + 1]`` and codes ``[K, 4 (n + 1)]``."""
        return self.cls_score(x), self.bbox_pred(x)


class MaskPredictor(nn.Module):
    """Doubles the resolution and gives one logit a class and pixel."""

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        self.conv5_mask = nn.ConvTranspose2d(config.mask_channels, config.mask_channels, 2, 2)
        self.mask_fcn_logits = nn.Conv2d(config.mask_channels, len(config.classes) + 1, 1)
        _initialise(self.conv5_mask.weight)
        _initialise(self.mask_fcn_logits.weight)

    def forward(self, x: Tensor) -> Tensor:
        """``[K, C, m, m]`` to logits ``[K, n + 1, 2m, 2m]``."""
        result: Tensor = self.mask_fcn_logits(functional.relu(self.conv5_mask(x)))
        return result


def mask_head(config: NetworkConfig) -> nn.Sequential:
    """The mask branch's 3x3 convolutions."""
    layers: list[nn.Module] = []
    inputs = config.channels
    for _ in range(config.mask_layers):
        conv = nn.Conv2d(inputs, config.mask_channels, 3, padding=1)
        _initialise(conv.weight)
        layers.append(nn.Sequential(conv, nn.ReLU(inplace=True)))
        inputs = config.mask_channels
    return nn.Sequential(*layers)


class RoIHeads(nn.Module):
    """Everything behind the proposals."""

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        self.config = config
        self.box_head = TwoMLPHead(config)
        self.box_predictor = BoxPredictor(config)
        self.mask_head = mask_head(config)
        self.mask_predictor = MaskPredictor(config)

    def detect(
        self,
        levels: list[Tensor],
        mask_levels: list[Tensor],
        proposals: Tensor,
        image_height: int,
        size: tuple[int, int],
        *,
        score: float,
        iou: float,
    ) -> Detections:
        """Objects of one image (inference).

        Args:
            levels: P2..P5 ``[1, C, H, W]``.
            mask_levels: m2..m5.
            proposals: ``[K, 4]``.
            image_height: Of the padded input.
            size: Height and width of the image inside it.
            score: Least score.
            iou: Of the suppression within a class.
        """
        pooled = roi_align(levels, [proposals], image_height, BOX_POOL, canonical=self.config.canonical)
        logits, codes = self.box_predictor(self.box_head(pooled))
        scores = functional.softmax(logits, dim=1)[:, 1:]
        boxes = clip(decode(codes, proposals, BOX_WEIGHTS), *size)[:, 1:]
        labels = torch.arange(1, scores.shape[1] + 1, device=scores.device).expand_as(scores)
        keep = (scores > score) & ((boxes[:, :, 2:] - boxes[:, :, :2]) >= MIN_BOX_PX).all(dim=2)
        box, best, label = boxes[keep], scores[keep], labels[keep]
        chosen = grouped_nms(box, best, label, iou)[: self.config.max_detections]
        box, best, label = box[chosen], best[chosen], label[chosen]
        mask_logits = self.masks(mask_levels, [box], image_height)
        masks = mask_logits[torch.arange(len(label), device=label.device), label].sigmoid()
        return Detections(box, label, best, masks)

    def masks(self, mask_levels: list[Tensor], boxes: list[Tensor], image_height: int) -> Tensor:
        """Mask logits ``[sum K, n + 1, 2m, 2m]`` inside boxes."""
        config = self.config
        pooled = roi_align(mask_levels, boxes, image_height, config.mask_pool, canonical=config.mask_canonical)
        result: Tensor = self.mask_predictor(self.mask_head(pooled))
        return result

    def losses(
        self,
        levels: list[Tensor],
        mask_levels: list[Tensor],
        proposals: list[Tensor],
        truths: list[Tensor],
        labels: list[Tensor],
        masks: list[Tensor],
        image_height: int,
        generator: torch.Generator,
        per_image: int = PROPOSALS_PER_IMAGE,
    ) -> dict[str, Tensor]:
        """Losses of classes, boxes and masks (He et al. 2017, section 3).

        Args:
            levels: P2..P5.
            mask_levels: m2..m5.
            proposals: Of each image.
            truths: Boxes ``[G, 4]`` of each image.
            labels: Class numbers ``[G]`` of each image.
            masks: Bool ``[G, H, W]`` of each image, at the input's size.
            image_height: Of the padded input.
            generator: Draws the sample.
            per_image: How many proposals an image enter the losses.
        """
        rois, classes, codes, positives, targets = [], [], [], [], []
        for proposal, truth, label, mask in zip(proposals, truths, labels, masks, strict=True):
            candidates = torch.cat([proposal, truth])
            matched = match(candidates, truth, high=0.5, low=0.5, keep_best=False)
            positive, negative = sample(matched, count=per_image, positive_share=POSITIVE_SHARE, generator=generator)
            hits, boxes = matched[positive], candidates[positive]
            rois.append(torch.cat([boxes, candidates[negative]]))
            classes.append(torch.cat([label[hits], label.new_zeros(len(negative))]))
            codes.append(encode(truth[hits], boxes, BOX_WEIGHTS) if len(hits) else truth[:0])
            positives.append(boxes)
            targets.append(crop_masks(mask[hits], boxes, 2 * self.config.mask_pool))
        pooled = roi_align(levels, rois, image_height, BOX_POOL, canonical=self.config.canonical)
        logits, predicted = (output.float() for output in self.box_predictor(self.box_head(pooled)))
        wanted = torch.cat(classes)
        foreground = torch.nonzero(wanted > 0)[:, 0]
        own = predicted.reshape(len(predicted), -1, 4)[foreground, wanted[foreground]]
        losses = {
            "class": functional.cross_entropy(logits, wanted),
            "box": functional.smooth_l1_loss(own, torch.cat(codes), beta=1 / 9, reduction="sum") / max(len(wanted), 1),
        }
        target = torch.cat(targets)
        losses["mask"] = mask_levels[0].sum() * 0
        if len(target):
            mask_logits = self.masks(mask_levels, positives, image_height).float()
            mine = mask_logits[torch.arange(len(target), device=target.device), wanted[foreground]]
            losses["mask"] = functional.binary_cross_entropy_with_logits(mine, target)
        return losses


def crop_masks(masks: Tensor, boxes: Tensor, size: int) -> Tensor:
    """Targets of the mask branch: bool ``[K, H, W]`` masks inside their boxes as ``[K, size, size]`` in [0, 1]."""
    if not len(masks):
        return torch.zeros((0, size, size), device=masks.device)
    height, width = masks.shape[1:]
    step = (torch.arange(size, device=boxes.device, dtype=torch.float32) + 0.5) / size
    x = boxes[:, 0, None] + step * (boxes[:, 2] - boxes[:, 0])[:, None]
    y = boxes[:, 1, None] + step * (boxes[:, 3] - boxes[:, 1])[:, None]
    grid = torch.stack(
        [(2 * x / width - 1)[:, None, :].expand(-1, size, -1), (2 * y / height - 1)[:, :, None].expand(-1, -1, size)],
        dim=3,
    )
    planes = functional.grid_sample(masks[:, None].float(), grid, align_corners=False)
    return (planes[:, 0] >= 0.5).float()
