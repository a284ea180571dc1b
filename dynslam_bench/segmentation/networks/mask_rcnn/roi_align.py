"""RoIAlign over a feature pyramid (He et al. 2017), as one weighted gather.

Every output bin is a weighted sum of 4 x S^2 feature vectors (S^2 bilinear samples of four corners each). Written as an
embedding bag over the rows of all levels' feature maps, it is one vectorised call for all boxes, levels and channels.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional


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
    starts = [0]
    for feature in features:
        starts.append(starts[-1] + batch * feature.shape[2] * feature.shape[3])
    base = torch.tensor(starts[:-1], device=device)[level] + image * heights * widths
    scales = torch.tensor([_scale(f.shape[2], image_height) for f in features], device=device)[level]
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


def _scale(level_height: int, image_height: int) -> float:
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
