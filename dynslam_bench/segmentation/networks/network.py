"""Mask R-CNN (He et al. 2017) with a CFPN mask branch, in plain torch."""

from __future__ import annotations

import math
from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn import functional

from dynslam_bench.segmentation.networks.backbone import Backbone, FrozenBatchNorm2d, NetworkConfig
from dynslam_bench.segmentation.networks.roi_heads import Detections, RoIHeads
from dynslam_bench.segmentation.networks.rpn import RPN, rpn_loss

MEAN = (0.485, 0.456, 0.406)
DEVIATION = (0.229, 0.224, 0.225)


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
        config = self.config
        height, width = int(image.shape[-2]), int(image.shape[-1])
        x = normalise(image[None])
        scale = min(config.min_side / min(height, width), config.max_side / max(height, width))
        size = (max(1, math.floor(height * scale)), max(1, math.floor(width * scale)))
        if size != (height, width):
            x = functional.interpolate(x, size=size, mode="bilinear", align_corners=False)
        return self._pad(x), size

    def _pad(self, x: Tensor) -> Tensor:
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
        x, size = self.prepare(image)
        levels, mask_levels = self.backbone(x.contiguous(memory_format=torch.channels_last))
        height, width = int(x.shape[2]), int(x.shape[3])
        proposals = self.rpn(levels, height, width, [size])[0][0]
        detections = self.roi_heads.detect(levels[:4], mask_levels, proposals, height, size, score=score, iou=iou)
        back = detections.boxes.new_tensor([image.shape[2] / size[1], image.shape[1] / size[0]]).repeat(2)
        return detections._replace(boxes=detections.boxes * back)

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
        batch, _, rows, columns = images.shape
        x = self._pad(normalise(images)).contiguous(memory_format=torch.channels_last)
        height, width = int(x.shape[2]), int(x.shape[3])
        levels, mask_levels = self.backbone(x)
        proposals, anchors, logits, codes = self.rpn(levels, height, width, [(rows, columns)] * batch)
        objectness, regression = rpn_loss(anchors, logits, codes, boxes, generator)
        heads = self.roi_heads.losses(
            levels[:4], mask_levels, proposals, boxes, labels, masks, height, generator, per_image
        )
        return {"objectness": objectness, "anchor": regression, **heads}

    def fuse(self) -> MaskRCNN:
        """Fold every batch normalisation into its convolution, in place, for faster inference; outputs stay equal."""
        for module in list(self.backbone.body.modules()):
            children = list(module.named_children())
            for (_, conv), (name, norm) in pairwise(children):
                if isinstance(conv, nn.Conv2d) and isinstance(norm, (nn.BatchNorm2d, FrozenBatchNorm2d)):
                    _fold(conv, norm)
                    setattr(module, name, nn.Identity())
        return self.to(memory_format=torch.channels_last)  # type: ignore[call-overload,no-any-return]


def normalise(images: Tensor) -> Tensor:
    """Subtract ImageNet's mean and divide by its deviation, ``[B, 3, H, W]``."""
    mean = images.new_tensor(MEAN).reshape(1, 3, 1, 1)
    return (images - mean) / images.new_tensor(DEVIATION).reshape(1, 3, 1, 1)


def _fold(conv: nn.Conv2d, norm: nn.BatchNorm2d | FrozenBatchNorm2d) -> None:
    assert norm.running_mean is not None and norm.running_var is not None
    with torch.no_grad():
        scale = norm.weight * (norm.running_var + norm.eps).rsqrt()
        conv.weight.mul_(scale.reshape(-1, 1, 1, 1))
        conv.bias = nn.Parameter(norm.bias - norm.running_mean * scale)
