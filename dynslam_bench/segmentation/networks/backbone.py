"""Shape, residual trunk and feature pyramids of a Mask R-CNN; state-dict keys as torchvision's.

Trunk: He et al. 2016, with the stride in the 3x3 convolution of a bottleneck (v1.5). FPN: Lin et
al. 2017. CFPN: the paper's section on semantic segmentation; see `CFPN`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field
from torch import Tensor, nn
from torch.nn import functional

from dynslam_bench.segmentation.settings import COCO_IDS

COCO_CLASSES: tuple[str, ...] = tuple(COCO_IDS.get(number, "") for number in range(1, 91))
"""Names of classes 1..90 as torchvision's COCO models number them; unused numbers are empty."""

Count = Annotated[int, Field(ge=1, le=4096)]
"""A number of channels, layers or pixels; the upper bound refuses files with an absurd shape."""
Blocks = Annotated[int, Field(ge=1, le=64)]
"""A number of residual blocks or layers."""
Side = Annotated[float, Field(gt=0, le=1e5)]
"""Side of a box, pixels; also the ratio of an anchor's sides."""


class NetworkConfig(BaseModel):
    """A Mask R-CNN.

    The defaults are torchvision's ``maskrcnn_resnet50_fpn``.

    Attributes:
        blocks: Residual blocks of the four stages, e.g. (3, 4, 6, 3) for ResNet-50.
        bottleneck: Bottleneck blocks (ResNet-50 and deeper) or basic ones (ResNet-18 and -34).
        stem: Channels of the stem; 64 is full width, the stages have 1, 2, 4, 8 times as many.
        channels: Channels of the feature pyramid and the RPN.
        cfpn: Whether the mask branch takes cross-layer fused features.
        classes: Names of classes 1..n; 0 is background.
        anchor_sizes: One a pyramid level (P2..P6), input pixels.
        anchor_ratios: Height over width.
        box_hidden: Width of the box head's two layers.
        mask_channels: Channels of the mask head's convolutions.
        mask_layers: How many convolutions the mask head has.
        mask_pool: RoI resolution of the mask branch; masks have twice as many pixels a side.
        canonical: Box side (input pixels) that is assigned to P4.
        mask_canonical: Box side that is assigned to P4 in the mask branch; a larger value gives
            masks finer features.
        min_side: Shorter side of the network's input; the frame is resized to it.
        max_side: Longest side of the network's input.
        divisor: The input is padded to multiples of this.
        pre_nms: Proposals a level before suppression.
        post_nms: Proposals an image after it.
        rpn_nms: IoU of the RPN's suppression.
        max_detections: Objects an image.
        exact_paste: Masks are placed to the fraction of a pixel instead of as the published models
            place them.
        norm: ``frozen`` batch norm (published checkpoints) or ``batch`` (trained from scratch).
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    blocks: tuple[Blocks, Blocks, Blocks, Blocks] = (3, 4, 6, 3)
    bottleneck: bool = True
    stem: Count = 64
    channels: Count = 256
    cfpn: bool = True
    classes: tuple[str, ...] = Field(default=COCO_CLASSES, max_length=4096)
    anchor_sizes: tuple[Side, ...] = Field(
        default=(32.0, 64.0, 128.0, 256.0, 512.0), min_length=5, max_length=5
    )
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
        return (
            self.stem * expansion,
            2 * self.stem * expansion,
            4 * self.stem * expansion,
            8 * self.stem * expansion,
        )


EMBEDDED = NetworkConfig(
    blocks=(2, 2, 2, 2),
    bottleneck=False,
    stem=32,
    channels=64,
    classes=("person",),
    anchor_sizes=(16.0, 32.0, 64.0, 128.0, 224.0),
    anchor_ratios=(1.0, 2.0, 3.0),
    box_hidden=256,
    mask_channels=64,
    canonical=112.0,
    min_side=240,
    max_side=427,
    pre_nms=200,
    post_nms=100,
    max_detections=20,
    exact_paste=True,
    norm="batch",
)
"""The small network of this package: half-width ResNet-18, 64-channel pyramid, 320 x 240 input, persons only."""
RESNET18 = NetworkConfig(blocks=(2, 2, 2, 2), bottleneck=False, classes=("person",), norm="batch")
"""Mask R-CNN on a full-width ResNet-18."""


def initialise(module: nn.Module, weights: Callable[[Tensor], object]) -> None:
    """Initialise the weights of all convolutions in a module, and their biases with zero.

    Nothing on torch's ``meta`` device, on which a network lies whose shapes are only compared with
    a file: drawing numbers there has no effect, but loads torch's compiler (1.6 s of processor,
    once a process).
    """
    for conv in module.modules():
        if isinstance(conv, nn.Conv2d) and not conv.weight.is_meta:
            weights(conv.weight)
            assert conv.bias is not None
            nn.init.zeros_(conv.bias)


class FrozenBatchNorm2d(nn.BatchNorm2d):
    """Batch normalisation with constant statistics and affine parameters."""

    def __init__(self, channels: int) -> None:
        super().__init__(channels)
        self.requires_grad_(False)

    def train(self, mode: bool = True) -> FrozenBatchNorm2d:
        """Stay in inference mode."""
        return super().train(False)


def _norm(channels: int, config: NetworkConfig) -> nn.BatchNorm2d:
    """The batch normalisation that `NetworkConfig.norm` asks for."""
    return nn.BatchNorm2d(channels) if config.norm == "batch" else FrozenBatchNorm2d(channels)


def _conv(inputs: int, outputs: int, kernel: int, stride: int = 1) -> nn.Conv2d:
    """A convolution without bias, padded so that a stride of 1 keeps the size."""
    return nn.Conv2d(inputs, outputs, kernel, stride, kernel // 2, bias=False)


class ResidualBlock(nn.Module):
    """Convolutions around a shortcut: two of 3x3, or as a bottleneck 1x1, 3x3 (with the stride) and 1x1."""

    def __init__(self, inputs: int, outputs: int, stride: int, config: NetworkConfig) -> None:
        super().__init__()
        # output channels, kernel and stride of the convolutions
        width = outputs // 4 if config.bottleneck else outputs
        shapes = [(width, 3, stride), (width, 3, 1)]
        if config.bottleneck:
            shapes = [(width, 1, 1), (width, 3, stride), (outputs, 1, 1)]
        self.convolutions = len(shapes)
        channels = inputs
        for number, (wanted, kernel, step) in enumerate(shapes, start=1):
            self.add_module(f"conv{number}", _conv(channels, wanted, kernel, step))
            self.add_module(f"bn{number}", _norm(wanted, config))
            channels = wanted
        # a shortcut of another size is projected
        self.downsample: nn.Module = nn.Identity()
        if stride > 1 or inputs != outputs:
            projection = _conv(inputs, outputs, 1, stride)
            self.downsample = nn.Sequential(projection, _norm(outputs, config))

    def forward(self, x: Tensor) -> Tensor:
        """``[B, inputs, H, W]`` to ``[B, outputs, H / stride, W / stride]``."""
        # no activation between the last convolution and the sum
        y = x
        for number in range(1, self.convolutions + 1):
            y = self.get_submodule(f"bn{number}")(self.get_submodule(f"conv{number}")(y))
            if number < self.convolutions:
                y = functional.relu(y, inplace=True)
        return functional.relu(y + self.downsample(x), inplace=True)


class Trunk(nn.Module):
    """The residual network up to C5, without the classifier."""

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        # stem: 7x7 with stride 2; forward pools it by 2 again
        self.conv1 = nn.Conv2d(3, config.stem, 7, 2, 3, bias=False)
        self.bn1 = _norm(config.stem, config)
        # stages C2..C5: the first block of each but C2 halves the resolution
        inputs = config.stem
        for stage, (count, outputs) in enumerate(zip(config.blocks, config.stages, strict=True)):
            blocks = [ResidualBlock(inputs, outputs, 1 if stage == 0 else 2, config)]
            blocks += [ResidualBlock(outputs, outputs, 1, config) for _ in range(count - 1)]
            self.add_module(f"layer{stage + 1}", nn.Sequential(*blocks))
            inputs = outputs

    def forward(self, x: Tensor) -> list[Tensor]:
        """``[B, 3, H, W]`` to C2..C5, strides 4, 8, 16, 32."""
        x = functional.relu(self.bn1(self.conv1(x)), inplace=True)
        x = functional.max_pool2d(x, 3, 2, 1)
        stages = []
        for stage in range(1, 5):
            x = self.get_submodule(f"layer{stage}")(x)
            stages.append(x)
        return stages


class FPN(nn.Module):
    """Feature pyramid: 1x1 laterals, nearest-neighbour top-down sums, 3x3 smoothing, and a subsampled P6."""

    def __init__(self, stages: tuple[int, ...], channels: int) -> None:
        super().__init__()
        self.inner_blocks = nn.ModuleList(
            nn.Sequential(nn.Conv2d(width, channels, 1)) for width in stages
        )
        self.layer_blocks = nn.ModuleList(
            nn.Sequential(nn.Conv2d(channels, channels, 3, padding=1)) for _ in stages
        )
        initialise(self, lambda weight: nn.init.kaiming_uniform_(weight, a=1))

    def forward(self, stages: list[Tensor]) -> list[Tensor]:
        """C2..C5 to P2..P6."""
        # laterals, sums from coarse to fine, smoothing; P6 is every second pixel of P5
        fused = top_down([block(x) for block, x in zip(self.inner_blocks, stages, strict=True)])
        levels = [block(x) for block, x in zip(self.layer_blocks, fused, strict=True)]
        return [*levels, levels[-1][:, :, ::2, ::2]]


class CFPN(nn.Module):
    """Cross-layer feature pyramid of the mask branch (paper, Figure 3 and its text).

    C2..C5 are reduced by 1x1 convolutions; m5 comes from C5 directly, m4..m2 from fusing the
    upsampled higher levels with the level itself; a 3x3 convolution against aliasing ends each
    level. Only the mask branch takes the result; RPN and box head keep the FPN's.

    Deviation: the mask branch takes the FPN's level *plus* the CFPN's, and the 3x3 convolutions
    start at zero. A plain Mask R-CNN checkpoint therefore gives exactly its own output until the
    CFPN is trained (the paper is silent on initialisation; it fine-tunes from COCO weights).
    """

    def __init__(self, stages: tuple[int, ...], channels: int) -> None:
        super().__init__()
        self.reduce = nn.ModuleList(nn.Conv2d(width, channels, 1) for width in stages)
        self.smooth = nn.ModuleList(nn.Conv2d(channels, channels, 3, padding=1) for _ in stages)
        initialise(self.reduce, lambda weight: nn.init.kaiming_uniform_(weight, a=1))
        initialise(self.smooth, nn.init.zeros_)

    def forward(self, stages: list[Tensor], levels: list[Tensor]) -> list[Tensor]:
        """C2..C5 and P2..P5 (a longer list is cut) to the mask branch's m2..m5."""
        # m5..m2, added to the FPN's levels
        fused = top_down([reduce(x) for reduce, x in zip(self.reduce, stages, strict=True)])
        smoothed = [smooth(x) for smooth, x in zip(self.smooth, fused, strict=True)]
        return [level + extra for level, extra in zip(levels[: len(stages)], smoothed, strict=True)]


def top_down(laterals: list[Tensor]) -> list[Tensor]:
    """Add each level, upsampled to the size below, to the level below; from coarse to fine."""
    fused = [laterals[-1]]
    for lateral in reversed(laterals[:-1]):
        coarser = functional.interpolate(fused[0], size=lateral.shape[-2:], mode="nearest")
        fused.insert(0, lateral + coarser)
    return fused


class Backbone(nn.Module):
    """Trunk and pyramids."""

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        self.body = Trunk(config)
        self.fpn = FPN(config.stages, config.channels)
        self.cfpn = CFPN(config.stages, config.channels) if config.cfpn else None

    def forward(self, x: Tensor) -> tuple[list[Tensor], list[Tensor]]:
        """``[B, 3, H, W]`` to P2..P6 (for proposals and boxes) and m2..m5 (for masks)."""
        stages = self.body(x)
        levels = self.fpn(stages)
        mask_levels = levels[:4] if self.cfpn is None else self.cfpn(stages, levels)
        return levels, mask_levels
