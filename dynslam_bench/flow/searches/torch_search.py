"""Matching cost and label searches as batched torch code: the reference of the kernels, and the path for GPUs.

Costs are the same whole numbers as those of `daisy.cost` (given equal maps). Random numbers come from a generator on
the processor, so that every device sees the same ones.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..daisy import layout
from ..daisy.cost import OUTSIDE, CostTables
from .moth_flame import MothFlameRules, landed, opposites


class TorchTables(NamedTuple):
    """`cost.CostTables` on a device."""

    samples: Tensor
    ring0: Tensor
    ring1: Tensor
    support: Tensor
    truncation: int
    ceiling: int
    width: int
    height: int


def torch_tables(tables: CostTables, shape: tuple[int, ...], device: torch.device) -> TorchTables:
    """Move the tables of the descriptor term to a device (the appearance terms are the kernels' only)."""
    return TorchTables(
        torch.as_tensor(tables.samples // layout.BINS, dtype=torch.int64, device=device),
        torch.as_tensor(tables.ring0, device=device),
        torch.as_tensor(tables.ring1, device=device),
        torch.as_tensor(tables.support, device=device),
        tables.truncation,
        tables.ceiling,
        shape[1],
        shape[0],
    )


def _cells(xy: Tensor, level: Tensor) -> tuple[Tensor, Tensor]:
    """Map cell of positions ``[..., 2]`` under levels ``[..., 4]``, and the quarter of the cell they lie in."""
    quarter = (xy * 4 + 0.5).long() + level[..., 3:4]
    half = quarter >> (level[..., 2:3] - 1)
    cell = level[..., 0] + (half[..., 1] >> 1) * level[..., 1] + (half[..., 0] >> 1)
    return cell, 2 * (half[..., 1] & 1) + (half[..., 0] & 1)


def sample(histograms: Tensor, xy: Tensor, scale: Tensor, rotation: Tensor, tables: TorchTables) -> Tensor:
    """Histograms uint8 ``[..., 17, 8]`` at positions ``[..., 2]`` for scale and rotation indices ``[...]``."""
    cell0, phase0 = _cells(xy, tables.ring0[scale])
    cell1, phase1 = _cells(xy, tables.ring1[scale])
    first = cell0[..., None] + tables.samples[scale, rotation, phase0][..., :9]
    second = cell1[..., None] + tables.samples[scale, rotation, phase1][..., 9:]
    return histograms[torch.cat([first, second], dim=-1)]


def rotated_descriptors(histograms: Tensor, points: Tensor, tables: TorchTables) -> Tensor:
    """Reference descriptors uint8 ``[N, S, ROTATIONS, 17, 8]`` of points float32 ``[N, 2]``."""
    limit = torch.tensor([tables.width - 1, tables.height - 1], dtype=points.dtype, device=points.device)
    xy = (points[:, None] + tables.support.to(points.dtype)).clamp(min=0).minimum(limit)
    neutral = torch.full(xy.shape[:-1], -layout.SCALE_LOW, device=points.device)
    straight = torch.full_like(neutral, -layout.ANGLE_LOW)
    plain = sample(histograms, xy, neutral, straight, tables).int()
    turned = []
    for sixths in range(layout.ANGLE_LOW, layout.ANGLE_HIGH + 1):
        whole, part = divmod(sixths, 6)
        far = part * 171  # of 1026
        near_bins, far_bins = plain.roll(whole, dims=-1), plain.roll(whole + 1, dims=-1)
        turned.append((((1026 - far) * near_bins + far * far_bins + 512) >> 10).to(torch.uint8))
    return torch.stack(turned, dim=2)


def quantise(labels: Tensor) -> tuple[Tensor, Tensor]:
    """Scale and rotation indices of labels ``[..., 4]``."""
    scale = (labels[..., 2] * 4 + 0.5).floor().long() - layout.SCALE_LOW
    rotation = (labels[..., 3] * 7.639437268410976 + 0.5).floor().long() - layout.ANGLE_LOW
    return scale.clamp(0, layout.SCALES - 1), rotation.clamp(0, layout.ROTATIONS - 1)


def label_costs(points: Tensor, labels: Tensor, descriptors: Tensor, histograms: Tensor, tables: TorchTables) -> Tensor:
    """First term of Eq. 1 for L labels of each point.

    Args:
        points: float32 ``[N, 2]``.
        labels: float32 ``[N, L, 4]``; labels that are not finite or leave the image cost `cost.OUTSIDE`.
        descriptors: uint8 ``[N, S, ROTATIONS, 17, 8]``.
        histograms: uint8 ``[total, 8]`` of the target.
        tables: Of the image size.

    Returns:
        int64 ``[N, L]``.
    """
    limit = torch.tensor([tables.width - 1, tables.height - 1], dtype=points.dtype, device=points.device)
    centre = points[:, None] + labels[..., :2]
    inside = ((centre >= 0) & (centre <= limit)).all(-1) & labels.isfinite().all(-1)
    labels = torch.where(inside[..., None], labels, torch.zeros_like(labels))
    centre = points[:, None] + labels[..., :2]
    scale, rotation = quantise(labels)
    size = torch.exp2(labels[..., 2])
    c, s = size * labels[..., 3].cos(), size * labels[..., 3].sin()
    total = torch.zeros(labels.shape[:2], dtype=torch.int64, device=points.device)
    index = torch.arange(len(points), device=points.device)[:, None]
    for q, (dx, dy) in enumerate(tables.support.tolist()):
        xy = torch.stack([centre[..., 0] + c * dx - s * dy, centre[..., 1] + s * dx + c * dy], dim=-1)
        xy = xy.clamp(min=0).minimum(limit)
        theirs = sample(histograms, xy, scale, rotation, tables).short()
        mine = descriptors[index, q, rotation].short()
        total += (theirs - mine).abs().sum(-1).clamp(max=tables.truncation).sum(-1)
    return torch.where(inside, total, torch.full_like(total, OUTSIDE))


class TorchState:
    """The batched counterpart of `searches.common.SearchState`."""

    def __init__(
        self, points: Tensor, descriptors: Tensor, histograms: Tensor, tables: TorchTables, lower: Tensor,
        upper: Tensor, population: int, seed: int,
    ) -> None:  # fmt: skip
        count, device = len(points), points.device
        self.points, self.descriptors, self.histograms, self.tables = points, descriptors, histograms, tables
        self.lower, self.upper = lower[:, None].clone(), upper[:, None].clone()
        self.moths = torch.zeros((count, population, 4), device=device)
        self.flames = ((lower + upper) / 2)[:, None].repeat(1, population, 1)
        self.costs = torch.full((count, population), tables.ceiling, dtype=torch.int64, device=device)
        self.used = torch.zeros(count, dtype=torch.int64, device=device)
        self._generator = torch.Generator().manual_seed(seed % 2**63)

    def random(self, shape: tuple[int, ...]) -> Tensor:
        """Uniform float32 in [0, 1), equal on all devices."""
        return torch.rand(shape, generator=self._generator).to(self.points.device)

    def evaluate(self, labels: Tensor, end: int) -> None:
        """Spend evaluations on labels ``[N, L, 4]`` as far as `end` allows; merge them into the flames."""
        given = labels.isfinite().all(-1)
        order = given.long().cumsum(1) + self.used[:, None]
        tried = given & (order <= end)
        costs = label_costs(self.points, labels, self.descriptors, self.histograms, self.tables)
        costs = torch.where(tried, costs, torch.full_like(costs, OUTSIDE))
        self.used += tried.sum(1)
        merged = torch.cat([self.costs, costs], dim=1)
        best = merged.argsort(dim=1, stable=True)[:, : self.costs.shape[1]]
        self.costs = merged.gather(1, best)
        everything = torch.cat([self.flames, torch.where(tried[..., None], labels, torch.zeros_like(labels))], dim=1)
        self.flames = everything.gather(1, best[..., None].expand(-1, -1, 4))

    def widen(self) -> None:
        """Let each box contain the surroundings of the best displacement (see `searches.common.widen`)."""
        best = self.flames[:, :1, :2]
        self.lower[..., :2] = self.lower[..., :2].minimum(best - 8)
        self.upper[..., :2] = self.upper[..., :2].maximum(best + 8)


def random_phase(state: TorchState, candidates: Tensor, end: int, shrink: float) -> None:
    """The batched counterpart of `searches.patchmatch.shrinking_window_phase`."""
    state.evaluate(candidates, end)
    state.widen()
    window, extent = 0.5, state.upper - state.lower
    while shrink > 0 and int(state.used.min()) < end:
        draw = state.random((len(state.points), 1, 4))
        if shrink == 1:
            labels = state.lower + extent * draw
        else:
            labels = (state.flames[:, :1] + (2 * draw - 1) * window * extent).maximum(state.lower).minimum(state.upper)
        state.evaluate(labels, end)
        window *= shrink
        if window * float(extent[..., 0].max()) < 1:
            window = 0.5


def moth_flame_phase(
    state: TorchState, candidates: Tensor, end: int, phase: int, rules: MothFlameRules, iterations: int,
    steps: NDArray[np.float32],
) -> None:  # fmt: skip
    """The batched counterpart of `searches.moth_flame_kernel.moth_flame_phase` (Eq. 4-22)."""
    count, population = state.costs.shape
    device = state.points.device
    state.evaluate(candidates, end)
    state.widen()
    if phase == 0:
        placed = min(candidates.shape[1], population)
        state.moths = state.lower + (state.upper - state.lower) * state.random((count, population, 4))
        state.evaluate(state.moths[:, placed:], end)
        known = candidates[:, :placed].isfinite().all(-1, keepdim=True)
        state.moths[:, :placed] = torch.where(known, candidates[:, :placed], state.moths[:, :placed])
        if rules.opposition:
            least, greatest = state.moths.amin(1, keepdim=True), state.moths.amax(1, keepdim=True)  # Eq. 20
            state.evaluate(opposites(torch, state.moths, least, greatest, state.lower, state.upper, state.random), end)
            state.moths = torch.where((state.costs < state.tables.ceiling)[..., None], state.flames, state.moths)
    founding = population * (2 if rules.opposition else 1)
    scale = torch.as_tensor(steps, device=device)
    while int(state.used.min()) < end:
        iteration = min(max((int(state.used.min()) - founding) // population, 0), iterations - 1)
        position = landed(torch, state.moths, state.flames, iteration + 1, iterations, rules, scale, state.random)
        state.moths = position.maximum(state.lower).minimum(state.upper)
        state.evaluate(state.moths, end)
