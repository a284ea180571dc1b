"""Mask R-CNN (He et al. 2017) with a CFPN mask branch, in plain torch: proposals, heads, and the whole network.

RoIAlign over a feature pyramid is one weighted gather. Every output bin is a weighted sum of 4 x
S^2 feature vectors (S^2 bilinear samples of four corners each). An embedding bag over the rows of
all levels' feature maps computes it in one vectorised call for all boxes, levels and channels.
"""

from __future__ import annotations

import math
from collections import OrderedDict
from itertools import pairwise
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

from dynslam_bench.segmentation.networks.backbone import Backbone, NetworkConfig, initialise

MIN_PROPOSAL_PX = 1e-3
"""Smallest side of a proposal."""
MIN_BOX_PX = 1e-2
"""Smallest side of a detection."""
BOX_POOL = 7
"""Bins a side of the features of a box."""
SAMPLES = 2
"""Sampling points a side of a bin of `roi_align`."""


def anchor_cells(config: NetworkConfig) -> list[Tensor]:
    """Anchors ``[A, 4]`` of each level around the origin, rounded to pixels as the published models have them."""
    # of each ratio the height and width of an anchor with the area 1
    ratios = torch.tensor(config.anchor_ratios, device="cpu")
    heights = ratios.sqrt()
    widths = 1 / ratios.sqrt()
    sides = [torch.stack([widths * size, heights * size], dim=1) for size in config.anchor_sizes]
    return [torch.cat([-side, side], dim=1).div(2).round() for side in sides]


def anchors_of(cells: list[Tensor], levels: list[Tensor], height: int, width: int) -> list[Tensor]:
    """Anchors ``[H_l * W_l * A, 4]`` of each level, row by row.

    Args:
        cells: Anchors ``[A, 4]`` of each level around the origin, of `anchor_cells`.
        levels: Feature maps ``[B, C, H_l, W_l]``.
        height: Height of the network's input, pixels.
        width: Width of the network's input, pixels.
    """
    result = []
    for cell, level in zip(cells, levels, strict=True):
        rows, columns = level.shape[-2:]
        # the cells' corners, input pixels
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
        self.conv = nn.Sequential(
            nn.Sequential(nn.Conv2d(config.channels, config.channels, 3, padding=1), nn.ReLU())
        )
        self.cls_logits = nn.Conv2d(config.channels, count, 1)
        self.bbox_pred = nn.Conv2d(config.channels, 4 * count, 1)
        initialise(self, lambda weight: nn.init.normal_(weight, std=0.01))

    def forward(self, levels: list[Tensor]) -> tuple[list[Tensor], list[Tensor]]:
        """Objectness logits ``[B, H W A]`` and codes ``[B, H W A, 4]`` of each level, in the anchors' order."""
        maps = [self.conv(level) for level in levels]
        scores = [self.cls_logits(x).permute(0, 2, 3, 1).reshape(x.shape[0], -1) for x in maps]
        codes = [self.bbox_pred(x).permute(0, 2, 3, 1).reshape(x.shape[0], -1, 4) for x in maps]
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
            height: Height of the padded input, pixels.
            width: Width of the padded input, pixels.
            sizes: Height and width of each image inside the padded input.

        Returns:
            Proposals ``[K, 4]`` of each image, best first; anchors, logits and codes of each level
            (for the losses).
        """
        logits, codes = self.head(levels)
        anchors = anchors_of(self._cells, levels, height, width)
        with torch.no_grad():
            proposals = [
                self._propose(anchors, logits, codes, image, size)
                for image, size in enumerate(sizes)
            ]
        return proposals, anchors, logits, codes

    def _propose(
        self,
        anchors: list[Tensor],
        logits: list[Tensor],
        codes: list[Tensor],
        image: int,
        size: tuple[int, int],
    ) -> Tensor:
        """Proposals ``[K, 4]`` of one image of the batch, best first."""
        # decode the best anchors of each level
        level_boxes = []
        level_scores = []
        level_numbers = []
        for level, anchor in enumerate(anchors):
            count = min(self.config.pre_nms, len(anchor))
            best, chosen = logits[level][image].detach().float().topk(count)
            code = codes[level][image].detach().float()[chosen]
            level_boxes.append(decode(code, anchor[chosen], RPN_WEIGHTS)[:, 0])
            level_scores.append(best.sigmoid())
            level_numbers.append(torch.full_like(chosen, level))

        # cut to the image, without those that nothing is left of
        boxes = clip(torch.cat(level_boxes), *size)
        scores = torch.cat(level_scores)
        numbers = torch.cat(level_numbers)
        large = ((boxes[:, 2:] - boxes[:, :2]) >= MIN_PROPOSAL_PX).all(dim=1)
        boxes = boxes[large]

        # non-maximum suppression within each level
        kept = grouped_nms(boxes, scores[large], numbers[large], self.config.rpn_nms)
        return boxes[kept[: self.config.post_nms]]


def rpn_loss(
    anchors: list[Tensor],
    logits: list[Tensor],
    codes: list[Tensor],
    truths: list[Tensor],
    generator: torch.Generator,
) -> tuple[Tensor, Tensor]:
    """Losses of objectness and of box codes (Ren et al. 2015, Eq. 1), 256 anchors an image, half of them positive.

    Args:
        anchors: Anchors ``[N_l, 4]`` of each level, input pixels.
        logits: Objectness logits ``[B, N_l]`` of each level.
        codes: Box codes ``[B, N_l, 4]`` of each level.
        truths: Boxes ``[G, 4]`` of each image.
        generator: Draws the sample.
    """
    all_anchors = torch.cat(anchors)
    all_logits = torch.cat(logits, dim=1).float()
    all_codes = torch.cat(codes, dim=1).float()
    total = 0
    objectness = []
    regression = []
    for image, truth in enumerate(truths):
        # draw positive and negative anchors
        matched = match(all_anchors, truth, high=0.7, low=0.3, keep_best=True)
        positive, negative = sample(matched, count=256, positive_share=0.5, generator=generator)
        index = torch.cat([positive, negative])

        # cross entropy of objectness, smooth L1 of the positive anchors' codes
        label = (matched[index] >= 0).float()
        objectness.append(
            functional.binary_cross_entropy_with_logits(
                all_logits[image, index], label, reduction="sum"
            )
        )
        wanted = encode(truth[matched[positive]], all_anchors[positive], RPN_WEIGHTS)
        regression.append(
            functional.smooth_l1_loss(
                all_codes[image, positive], wanted, beta=1 / 9, reduction="sum"
            )
        )
        total += len(index)
    count = max(total, 1)
    return torch.stack(objectness).sum() / count, torch.stack(regression).sum() / count


def levels_of(boxes: Tensor, canonical: float, count: int) -> Tensor:
    """Index of the pyramid level (0 = finest, stride 4) of each box: a box of side `canonical` goes to index 2.

    Lin et al. 2017, Eq. 1, with k0 = 4 and P2 as the first level.
    """
    side = torch.sqrt((boxes[:, 2] - boxes[:, 0]) * (boxes[:, 3] - boxes[:, 1]))
    level = torch.floor(4 + torch.log2(side / canonical) + 1e-6)
    return (level.clamp(2, count + 1) - 2).long()


def roi_align(
    features: list[Tensor], boxes: list[Tensor], image_height: int, size: int, *, canonical: float
) -> Tensor:
    """Features of boxes, each from the pyramid level that fits its size.

    Args:
        features: Levels ``[B, C, H_l, W_l]``, finest first.
        boxes: One ``[K_b, 4]`` an image, input pixels.
        image_height: Height of the network's input, pixels; gives the levels' scales.
        size: Bins a side.
        canonical: Box side that goes to the third level.

    Returns:
        ``[sum K_b, C, size, size]``; samples outside the feature map count as 0 (beyond one cell),
        as in the original.
    """
    batch, channels = features[0].shape[:2]
    device = features[0].device
    rois = torch.cat(boxes)
    image = torch.repeat_interleave(
        torch.arange(batch, device=device), torch.tensor([len(b) for b in boxes], device=device)
    )
    # the feature vectors of all levels as the rows of one table, level by level, image by image
    table = torch.cat([level.permute(0, 2, 3, 1).reshape(-1, channels) for level in features])

    # each box's level, its size, and its first row of the table
    level = levels_of(rois, canonical, len(features))
    heights = torch.tensor([f.shape[2] for f in features], device=device)[level]
    widths = torch.tensor([f.shape[3] for f in features], device=device)[level]
    rows_before = [0, *(batch * f.shape[2] * f.shape[3] for f in features[:-1])]
    base = torch.tensor(rows_before, device=device).cumsum(dim=0)[level] + image * heights * widths

    # cells that the bins' samples touch and their weights, along both axes
    level_scales = [level_scale(f.shape[2], image_height) for f in features]
    scales = torch.tensor(level_scales, device=device)[level]
    scaled = rois.to(torch.float32) * scales[:, None]
    rows, row_weights = _axis(scaled[:, 1], scaled[:, 3], heights, size)
    columns, column_weights = _axis(scaled[:, 0], scaled[:, 2], widths, size)

    # rows of the table and weights of every tap, [K, bins, bins, 2 SAMPLES, 2 SAMPLES]
    row_start = base[:, None, None] + rows * widths[:, None, None]
    index = row_start[:, :, None, :, None] + columns[:, None, :, None, :]
    weight = row_weights[:, :, None, :, None] * column_weights[:, None, :, None, :]

    # weighted sums of the taps
    taps = (2 * SAMPLES) ** 2
    bags = functional.embedding_bag(
        index.reshape(-1, taps),
        table,
        mode="sum",
        per_sample_weights=weight.reshape(-1, taps).to(table.dtype),
    )
    return bags.reshape(len(rois), size, size, channels).permute(0, 3, 1, 2)


def level_scale(level_height: int, image_height: int) -> float:
    """The power of two nearest to the level's height over the image's."""
    return float(2.0 ** torch.tensor(level_height / image_height).log2().round().item())


def _axis(low: Tensor, high: Tensor, length: Tensor, size: int) -> tuple[Tensor, Tensor]:
    """Cells ``[K, size, 2 SAMPLES]`` along one axis that each bin's samples touch, and their weights."""
    extent = (high - low).clamp(min=1.0)
    step = (torch.arange(size * SAMPLES, device=low.device, dtype=torch.float32) + 0.5) / (
        size * SAMPLES
    )
    # the samples, bin by bin: start + bin * bin_size + (sample + .5) * bin_size / samples
    at = low[:, None] + step * extent[:, None]
    last = (length - 1)[:, None].to(torch.float32)
    inside = (at >= -1.0) & (at <= last + 1.0)
    at = torch.minimum(at.clamp(min=0.0), last)
    # the two cells around each, by linear interpolation; those outside count as 0
    floor = at.floor()
    fraction = at - floor
    scale = inside / SAMPLES
    cells = torch.stack([floor, torch.minimum(floor + 1, last)], dim=2).long()
    weights = torch.stack([(1 - fraction) * scale, fraction * scale], dim=2)
    return cells.reshape(len(low), size, 2 * SAMPLES), weights.reshape(len(low), size, 2 * SAMPLES)


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


def box_head(config: NetworkConfig) -> nn.Sequential:
    """Two fully connected layers on the pooled features of a box: ``[K, C, 7, 7]`` to ``[K, hidden]``."""
    layers = OrderedDict[str, nn.Module](
        flatten=nn.Flatten(),
        fc6=nn.Linear(config.channels * BOX_POOL**2, config.box_hidden),
        relu6=nn.ReLU(),
        fc7=nn.Linear(config.box_hidden, config.box_hidden),
        relu7=nn.ReLU(),
    )
    return nn.Sequential(layers)


class Targets(NamedTuple):
    """Proposals drawn from one image, the positive ones first, with what the heads are to answer.

    Attributes:
        rois: Boxes ``[P + N, 4]`` of the positive and the negative ones, input pixels.
        classes: Class numbers ``[P + N]``, 0 for the negative ones.
        codes: Box codes ``[P, 4]`` from the positive boxes to the true ones.
        positives: Boxes ``[P, 4]`` of the positive ones.
        masks: True masks inside these boxes ``[P, 2m, 2m]``, 0 or 1.
    """

    rois: Tensor
    classes: Tensor
    codes: Tensor
    positives: Tensor
    masks: Tensor


class BoxPredictor(nn.Module):
    """Class scores and one box a class."""

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        self.cls_score = nn.Linear(config.box_hidden, len(config.classes) + 1)
        self.bbox_pred = nn.Linear(config.box_hidden, 4 * (len(config.classes) + 1))

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """``[K, hidden]`` to logits ``[K, n + 1]`` and codes ``[K, 4 (n + 1)]``."""
        return self.cls_score(x), self.bbox_pred(x)


def mask_predictor(config: NetworkConfig) -> nn.Sequential:
    """Doubles the resolution and gives one logit a class and pixel: ``[K, C, m, m]`` to ``[K, n + 1, 2m, 2m]``."""
    double = nn.ConvTranspose2d(config.mask_channels, config.mask_channels, 2, 2)
    logits = nn.Conv2d(config.mask_channels, len(config.classes) + 1, 1)
    _initialise(double.weight)
    _initialise(logits.weight)
    return nn.Sequential(OrderedDict(conv5_mask=double, relu=nn.ReLU(), mask_fcn_logits=logits))


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
        self.box_head = box_head(config)
        self.box_predictor = BoxPredictor(config)
        self.mask_head = mask_head(config)
        self.mask_predictor = mask_predictor(config)

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
            levels: P2..P5 ``[1, C, H_l, W_l]``.
            mask_levels: m2..m5, the mask branch's levels ``[1, C, H_l, W_l]``.
            proposals: Boxes ``[K, 4]``, input pixels x0 y0 x1 y1.
            image_height: Height of the padded input, pixels.
            size: Height and width of the image inside it.
            score: Least score.
            iou: IoU above which the weaker of two boxes of one class is suppressed.
        """
        # classes and boxes of the proposals
        pooled = roi_align(
            levels, [proposals], image_height, BOX_POOL, canonical=self.config.canonical
        )
        logits, codes = self.box_predictor(self.box_head(pooled))
        scores = functional.softmax(logits, dim=1)[:, 1:]
        boxes = clip(decode(codes, proposals, BOX_WEIGHTS), *size)[:, 1:]
        labels = torch.arange(1, scores.shape[1] + 1, device=scores.device).expand_as(scores)

        # boxes that are confident and not empty, suppressed within each class
        keep = (scores > score) & ((boxes[:, :, 2:] - boxes[:, :, :2]) >= MIN_BOX_PX).all(dim=2)
        box = boxes[keep]
        best = scores[keep]
        label = labels[keep]
        chosen = grouped_nms(box, best, label, iou)[: self.config.max_detections]
        box = box[chosen]
        best = best[chosen]
        label = label[chosen]

        # of each box the mask of its class
        mask_logits = self.masks(mask_levels, [box], image_height)
        masks = mask_logits[torch.arange(len(label), device=label.device), label].sigmoid()
        return Detections(box, label, best, masks)

    def masks(self, mask_levels: list[Tensor], boxes: list[Tensor], image_height: int) -> Tensor:
        """Mask logits ``[sum K, n + 1, 2m, 2m]`` inside boxes."""
        config = self.config
        pooled = roi_align(
            mask_levels, boxes, image_height, config.mask_pool, canonical=config.mask_canonical
        )
        result: Tensor = self.mask_predictor(self.mask_head(pooled))
        return result

    def losses(
        self,
        levels: list[Tensor],
        mask_levels: list[Tensor],
        proposals: list[Tensor],
        truths: list[Tensor],
        labels: list[Tensor],
        truth_masks: list[Tensor],
        image_height: int,
        generator: torch.Generator,
        per_image: int,
    ) -> dict[str, Tensor]:
        """Losses of classes, boxes and masks (He et al. 2017, section 3).

        Args:
            levels: P2..P5.
            mask_levels: m2..m5, the mask branch's levels ``[B, C, H_l, W_l]``.
            proposals: Boxes ``[P, 4]`` of each image, input pixels x0 y0 x1 y1.
            truths: Boxes ``[G, 4]`` of each image.
            labels: Class numbers ``[G]`` of each image.
            truth_masks: Bool ``[G, H, W]`` of each image, at the input's size.
            image_height: Height of the padded input, pixels.
            generator: Draws the sample.
            per_image: How many proposals an image enter the losses.
        """
        # draw proposals of each image, the true boxes among them; positive ones have targets
        images = zip(proposals, truths, labels, truth_masks, strict=True)
        drawn = [self._draw_targets(*image, generator, per_image) for image in images]

        # class and box of all that were drawn; only the codes of the true class are compared
        rois = [image.rois for image in drawn]
        pooled = roi_align(levels, rois, image_height, BOX_POOL, canonical=self.config.canonical)
        logits, predicted = (output.float() for output in self.box_predictor(self.box_head(pooled)))
        wanted = torch.cat([image.classes for image in drawn])
        foreground = torch.nonzero(wanted > 0)[:, 0]
        of_class = predicted.reshape(len(predicted), -1, 4)[foreground, wanted[foreground]]
        class_loss = functional.cross_entropy(logits, wanted)
        codes = torch.cat([image.codes for image in drawn])
        box_sum = functional.smooth_l1_loss(of_class, codes, beta=1 / 9, reduction="sum")
        box_loss = box_sum / max(len(wanted), 1)

        # mask of the true class of the positive ones; without any a zero that has gradients
        target = torch.cat([image.masks for image in drawn])
        mask_loss = mask_levels[0].sum() * 0
        if len(target):
            positives = [image.positives for image in drawn]
            mask_logits = self.masks(mask_levels, positives, image_height).float()
            row = torch.arange(len(target), device=target.device)
            # `wanted[foreground]` has the order of `positives`: they come first in each image
            mask_loss = functional.binary_cross_entropy_with_logits(
                mask_logits[row, wanted[foreground]], target
            )
        return {"class": class_loss, "box": box_loss, "mask": mask_loss}

    def _draw_targets(
        self,
        proposals: Tensor,
        truths: Tensor,
        labels: Tensor,
        truth_masks: Tensor,
        generator: torch.Generator,
        count: int,
    ) -> Targets:
        """Draw `count` proposals of an image, a quarter of them positive at most, and their targets.

        The arguments are those of `losses`, of one image.
        """
        candidates = torch.cat([proposals, truths])
        matched = match(candidates, truths, high=0.5, low=0.5, keep_best=False)
        positive, negative = sample(matched, count=count, positive_share=0.25, generator=generator)
        hits = matched[positive]
        boxes = candidates[positive]
        return Targets(
            rois=torch.cat([boxes, candidates[negative]]),
            classes=torch.cat([labels[hits], labels.new_zeros(len(negative))]),
            codes=encode(truths[hits], boxes, BOX_WEIGHTS),
            positives=boxes,
            masks=crop_masks(truth_masks[hits], boxes, 2 * self.config.mask_pool),
        )


def crop_masks(masks: Tensor, boxes: Tensor, size: int) -> Tensor:
    """Targets of the mask branch: bool ``[K, H, W]`` masks inside their boxes as ``[K, size, size]`` in [0, 1]."""
    height, width = masks.shape[1:]
    # centres of the cells in pixels, then in [-1, 1] as `grid_sample` takes them
    step = (torch.arange(size, device=boxes.device, dtype=torch.float32) + 0.5) / size
    x = boxes[:, 0, None] + step * (boxes[:, 2] - boxes[:, 0])[:, None]
    y = boxes[:, 1, None] + step * (boxes[:, 3] - boxes[:, 1])[:, None]
    grid = torch.stack(
        [
            (2 * x / width - 1)[:, None, :].expand(-1, size, -1),
            (2 * y / height - 1)[:, :, None].expand(-1, -1, size),
        ],
        dim=3,
    )
    planes = functional.grid_sample(masks[:, None].float(), grid, align_corners=False)
    return (planes[:, 0] >= 0.5).float()


class MaskRCNN(nn.Module):
    """The network; its state-dict keys are those of torchvision's ``maskrcnn_resnet50_fpn`` (plus ``backbone.cfpn.*``).

    Args:
        config: Its shape.
    """

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        self.config = config
        self.backbone = Backbone(config)
        self.rpn = RPN(config)
        self.roi_heads = RoIHeads(config)

    def set_input(self, min_side: int) -> None:
        """Work at another input size: the shorter side in pixels; the longest side keeps its proportion to it."""
        longest = round(self.config.max_side * min_side / self.config.min_side)
        self.config = self.config.model_copy(update={"min_side": min_side, "max_side": longest})

    def prepare(self, image: Tensor) -> tuple[Tensor, tuple[int, int]]:
        """Normalise, resize to `min_side` (at most `max_side`) and pad.

        Args:
            image: float ``[3, H, W]`` in [0, 1].

        Returns:
            ``[1, 3, H', W']`` and the height and width of the image inside it.
        """
        # the shorter side becomes `min_side`, unless the longer one exceeds `max_side` then
        config = self.config
        height = int(image.shape[-2])
        width = int(image.shape[-1])
        x = normalise(image[None])
        scale = min(config.min_side / min(height, width), config.max_side / max(height, width))
        size = (max(1, math.floor(height * scale)), max(1, math.floor(width * scale)))
        if size != (height, width):
            x = functional.interpolate(x, size=size, mode="bilinear", align_corners=False)
        return self._pad(x), size

    def _pad(self, x: Tensor) -> Tensor:
        """Pad right and below to a multiple of the divisor."""
        divisor = self.config.divisor
        return functional.pad(x, (0, -int(x.shape[3]) % divisor, 0, -int(x.shape[2]) % divisor))

    @torch.inference_mode()
    def detect(self, image: Tensor, *, score: float = 0.05, iou: float = 0.5) -> Detections:
        """Objects in one image; boxes in its own pixels.

        Args:
            image: float ``[3, H, W]`` in [0, 1], any size.
            score: Least score.
            iou: Overlap of two boxes of one class above which the weaker one is dropped.
        """
        # backbone, proposals, and the heads on them
        x, size = self.prepare(image)
        levels, mask_levels = self.backbone(x.contiguous(memory_format=torch.channels_last))
        height = int(x.shape[2])
        width = int(x.shape[3])
        (proposals,), *_ = self.rpn(levels, height, width, [size])
        detections = self.roi_heads.detect(
            levels[:4], mask_levels, proposals, height, size, score=score, iou=iou
        )
        # boxes back to pixels of the image
        scale_x = image.shape[2] / size[1]
        scale_y = image.shape[1] / size[0]
        scale = detections.boxes.new_tensor([scale_x, scale_y]).repeat(2)
        return detections._replace(boxes=detections.boxes * scale)

    def losses(
        self,
        images: Tensor,
        boxes: list[Tensor],
        labels: list[Tensor],
        masks: list[Tensor],
        generator: torch.Generator,
        per_image: int = 512,
    ) -> dict[str, Tensor]:
        """The five losses of a batch.

        Args:
            images: float ``[B, 3, H, W]`` in [0, 1], already at the network's input size.
            boxes: ``[G, 4]`` of each image, pixels of the input.
            labels: Class numbers ``[G]`` of each image, from 1.
            masks: Bool ``[G, H, W]`` of each image.
            generator: Draws the samples of anchors and proposals.
            per_image: Proposals an image that enter the box losses.
        """
        # backbone on the padded batch
        batch, _, rows, columns = images.shape
        x = self._pad(normalise(images)).contiguous(memory_format=torch.channels_last)
        height = int(x.shape[2])
        width = int(x.shape[3])
        levels, mask_levels = self.backbone(x)
        # proposals and the losses of their network
        proposals, anchors, logits, codes = self.rpn(
            levels, height, width, [(rows, columns)] * batch
        )
        objectness, regression = rpn_loss(anchors, logits, codes, boxes, generator)
        # losses of the heads on a sample of the proposals
        heads = self.roi_heads.losses(
            levels[:4], mask_levels, proposals, boxes, labels, masks, height, generator, per_image
        )
        return {"objectness": objectness, "anchor": regression, **heads}

    def fuse(self) -> MaskRCNN:
        """Fold every batch normalisation into its convolution, in place, for faster inference; outputs stay equal."""
        for module in list(self.backbone.body.modules()):
            for (_, conv), (name, norm) in pairwise(list(module.named_children())):
                if isinstance(conv, nn.Conv2d) and isinstance(norm, nn.BatchNorm2d):
                    _fold(conv, norm)
                    setattr(module, name, nn.Identity())
        return self.to(memory_format=torch.channels_last)  # type: ignore[call-overload,no-any-return]


def normalise(images: Tensor) -> Tensor:
    """Subtract ImageNet's mean and divide by its deviation, ``[B, 3, H, W]``."""
    statistics = images.new_tensor([[0.485, 0.456, 0.406], [0.229, 0.224, 0.225]])
    mean, deviation = statistics.reshape(2, 1, 3, 1, 1).unbind(dim=0)
    return (images - mean) / deviation


@torch.no_grad()
def _fold(conv: nn.Conv2d, norm: nn.BatchNorm2d) -> None:
    """Fold a batch normalisation into the convolution before it, in place."""
    assert norm.running_mean is not None
    assert norm.running_var is not None
    scale = norm.weight * (norm.running_var + norm.eps).rsqrt()
    conv.weight.mul_(scale.reshape(-1, 1, 1, 1))
    conv.bias = nn.Parameter(norm.bias - norm.running_mean * scale)


# Boxes (x0, y0, x1, y1 in pixels): overlap, coding against anchors, non-maximum suppression,
# assignment to objects.

MAX_LOG_RATIO = math.log(1000.0 / 16)
"""Decoded boxes grow by at most this (log), so that exp() cannot overflow."""
RPN_WEIGHTS = (1.0, 1.0, 1.0, 1.0)
"""Factors of the codes (dx, dy, log dw, log dh) of the anchors."""
BOX_WEIGHTS = (10.0, 10.0, 5.0, 5.0)
"""Factors of the codes of the proposals."""
NEGATIVE = -1
"""Value of `match` for a box without an object."""
IGNORED = -2
"""Value of `match` for a box that is neither positive nor negative."""


def box_iou(a: Tensor, b: Tensor) -> Tensor:
    """Intersection over union ``[N, M]`` of boxes ``[N, 4]`` and ``[M, 4]``; 0 where both are empty."""
    shared = torch.minimum(a[:, None, 2:], b[None, :, 2:]) - torch.maximum(
        a[:, None, :2], b[None, :, :2]
    )
    width, height = shared.clamp(min=0).unbind(dim=2)
    inter = width * height
    area_a = (a[:, 2] - a[:, 0]) * (a[:, 3] - a[:, 1])
    area_b = (b[:, 2] - b[:, 0]) * (b[:, 3] - b[:, 1])
    return inter / (area_a[:, None] + area_b[None] - inter).clamp(min=1e-12)


def nms(boxes: Tensor, scores: Tensor, threshold: float) -> Tensor:
    """Greedy non-maximum suppression.

    The greedy rule is "a box stays if no better box that stays overlaps it by more than
    `threshold`". It is solved exactly, by fixed-point iteration over the whole overlap matrix. That
    needs as many rounds as the longest chain of suppressions, usually a handful.

    Args:
        boxes: ``[N, 4]``.
        scores: ``[N]``; among equal scores the earlier box counts as better.
        threshold: IoU above which the weaker box goes.

    Returns:
        Indices of the boxes that stay, best first.
    """
    # overlaps [N, N] of each box with the weaker ones
    order = scores.argsort(descending=True, stable=True)
    over = torch.triu(box_iou(boxes[order], boxes[order]) > threshold, diagonal=1).to(torch.float32)
    # a box stays where none that stays overlaps it
    keep = over.new_ones(len(order))
    for _ in range(len(order)):
        new = ((keep @ over) == 0).to(torch.float32)
        if torch.equal(new, keep):
            break
        keep = new
    return order[keep > 0]


def grouped_nms(boxes: Tensor, scores: Tensor, groups: Tensor, threshold: float) -> Tensor:
    """Suppression within each group (class or level); indices of all that stay, best first.

    Args:
        boxes: ``[N, 4]``: x0, y0, x1, y1.
        scores: ``[N]``.
        groups: Number of each box's group ``[N]``.
        threshold: IoU above which the weaker of two boxes is dropped.
    """
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


def encode(
    targets: Tensor, references: Tensor, weights: tuple[float, float, float, float]
) -> Tensor:
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
    """Width and height ``[N, 2]``, and centre ``[N, 2]`` of boxes."""
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
    # the object that each box overlaps most
    overlap = box_iou(truth, boxes)
    best, index = overlap.max(dim=0)
    result = index.masked_fill(best < high, IGNORED).masked_fill(best < low, NEGATIVE)
    # every object that is overlapped at all gets the boxes that overlap it most
    if keep_best:
        top = overlap.max(dim=1, keepdim=True).values
        forced = ((overlap == top) & (overlap > 0)).any(dim=0)
        result[forced] = index[forced]
    return result


def sample(
    matched: Tensor, *, count: int, positive_share: float, generator: torch.Generator
) -> tuple[Tensor, Tensor]:
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
