"""The shape of a Mask R-CNN: everything that must be known before its weights can be loaded."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

from ...classes import COCO_IDS

COCO_CLASSES: tuple[str, ...] = tuple(COCO_IDS.get(number, "") for number in range(1, 91))
"""Names of classes 1..90 as torchvision's COCO models number them; unused numbers are empty."""

Count = Annotated[int, Field(ge=1, le=4096)]
"""Of channels, layers or pixels; a file's shape may not ask for more than any such network has."""
Blocks = Annotated[int, Field(ge=1, le=64)]
Side = Annotated[float, Field(gt=0, le=1e5)]


class NetworkConfig(BaseModel):
    """A Mask R-CNN.

    The defaults are torchvision's ``maskrcnn_resnet50_fpn``.

    Attributes:
        blocks: Residual blocks of the four stages, e.g. (3, 4, 6, 3) for ResNet-50.
        bottleneck: Bottleneck blocks (ResNet-50 and deeper) or basic ones (ResNet-18 and -34).
        stem: Channels of the stem; 64 is full width, the stages have 1, 2, 4, 8 times as many.
        channels: Of the feature pyramid and the RPN.
        cfpn: Whether the mask branch takes cross-layer fused features.
        classes: Names of classes 1..n; 0 is background.
        anchor_sizes: One a pyramid level (P2..P6), input pixels.
        anchor_ratios: Height over width.
        box_hidden: Width of the box head's two layers.
        mask_channels: Of the mask head's convolutions.
        mask_layers: How many convolutions the mask head has.
        mask_pool: RoI resolution of the mask branch; masks have twice as many pixels a side.
        canonical: Box side (input pixels) that is assigned to P4.
        mask_canonical: The same for the mask branch; a larger value gives masks finer features.
        min_side: Shorter side of the network's input; the frame is resized to it.
        max_side: Longest side of the network's input.
        divisor: The input is padded to multiples of this.
        pre_nms: Proposals a level before suppression.
        post_nms: Proposals an image after it.
        rpn_nms: IoU of the RPN's suppression.
        max_detections: Objects an image.
        exact_paste: Masks are placed to the fraction of a pixel instead of as the published models place them.
        norm: ``frozen`` batch norm (published checkpoints) or ``batch`` (trained from scratch).
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    blocks: tuple[Blocks, Blocks, Blocks, Blocks] = (3, 4, 6, 3)
    bottleneck: bool = True
    stem: Count = 64
    channels: Count = 256
    cfpn: bool = True
    classes: tuple[str, ...] = Field(default=COCO_CLASSES, max_length=4096)
    anchor_sizes: tuple[Side, ...] = Field(default=(32.0, 64.0, 128.0, 256.0, 512.0), min_length=5, max_length=5)
    anchor_ratios: tuple[Side, ...] = Field(default=(0.5, 1.0, 2.0), min_length=1, max_length=16)
    box_hidden: Count = 1024
    mask_channels: Count = 256
    mask_layers: Blocks = 4
    mask_pool: Count = 14
    canonical: Side = 224.0
    mask_canonical: Side = 224.0
    min_side: Count = 800
    max_side: Count = 1333
    divisor: Count = 32
    pre_nms: Count = 1000
    post_nms: Count = 1000
    rpn_nms: float = 0.7
    max_detections: Count = 100
    exact_paste: bool = False
    norm: Literal["frozen", "batch"] = "frozen"

    @property
    def stages(self) -> tuple[int, int, int, int]:
        """Output channels of the four residual stages."""
        expansion = 4 if self.bottleneck else 1
        return (self.stem * expansion, 2 * self.stem * expansion, 4 * self.stem * expansion, 8 * self.stem * expansion)


def embedded_config(*, cfpn: bool = True) -> NetworkConfig:
    """The small network of this package: half-width ResNet-18, 64-channel pyramid, 320 x 240 input, persons only."""
    return NetworkConfig(
        blocks=(2, 2, 2, 2), bottleneck=False, stem=32, channels=64, cfpn=cfpn, classes=("person",),
        anchor_sizes=(16.0, 32.0, 64.0, 128.0, 224.0), anchor_ratios=(1.0, 2.0, 3.0), box_hidden=256,
        mask_channels=64, mask_layers=4, mask_pool=14, canonical=112.0, mask_canonical=224.0, min_side=240,
        max_side=427, pre_nms=200, post_nms=100, max_detections=20, exact_paste=True, norm="batch",
    )  # fmt: skip


def resnet18_config(classes: tuple[str, ...] = ("person",), *, cfpn: bool = True) -> NetworkConfig:
    """Mask R-CNN on a full-width ResNet-18."""
    return NetworkConfig(blocks=(2, 2, 2, 2), bottleneck=False, cfpn=cfpn, classes=classes, norm="batch")
