"""The orientation maps on any torch device.

`quantised_maps` computes what `maps` computes for the processor, in the same arrangement, so that both index it with
the same tables.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from dynslam_bench.core.errors import SettingsError
from dynslam_bench.flow import layout
from dynslam_bench.flow.label_search import Phase, Plan, cauchy_steps
from dynslam_bench.flow.layout import MapGeometry, map_geometry
from dynslam_bench.flow.matching_cost import OUTSIDE, CostTables, Reference
from dynslam_bench.flow.moth_flame import MothFlameRules, opposites, population_positions
from dynslam_bench.flow.orientation_maps import FIXED_POINT, NORM_FLOOR, OrientationMaps, framed, half_image
from dynslam_bench.flow.search_kernels import SearchState
from dynslam_bench.flow.settings import FlowSettings
from dynslam_bench.flow.simd import COSINES, DERIVATIVE_SHIFT
from dynslam_bench.flow.sparse import Pair, SparseDaisyFlow


def quantised_maps(gray: Tensor) -> tuple[Tensor, MapGeometry]:
    """The orientation maps of `maps.orientation_maps` on any device.

    Args:
        gray: uint8 ``[H, W]``.

    Returns:
        uint8 ``[total, 8]`` histograms, equal to those of the processor's kernels, and their arrangement.
    """
    height, width = int(gray.shape[0]), int(gray.shape[1])
    geometry = map_geometry(height, width)
    histograms = torch.zeros((geometry.total, layout.BINS), dtype=torch.uint8, device=gray.device)
    maps = _whole_derivatives(gray)
    step = layout.LEVEL_STEPS[0]
    for level, (level_step, (taps, distance)) in enumerate(zip(layout.LEVEL_STEPS, layout.LEVEL_BLURS, strict=True)):
        if level_step != step:
            maps, step = _halve(maps), level_step
        for axis in (1, 2):
            maps = _binomial(maps, axis, taps, distance)
        norm = maps.square().sum(dim=0, keepdim=True).float().sqrt()
        gain = torch.full_like(norm, 255) / (norm + torch.full_like(norm, NORM_FLOOR * FIXED_POINT))
        cells = (maps.float() * gain + 0.5).to(torch.uint8).permute(1, 2, 0)
        margin = layout.MARGIN // step
        base, stride = int(geometry.base[level]), int(geometry.stride[level])
        rows, columns = cells.shape[:2]
        area = histograms[base : base + (rows + 2 * margin) * stride].view(rows + 2 * margin, stride, layout.BINS)
        area[margin : margin + rows, margin : margin + columns] = cells
    return histograms, geometry


def _whole_derivatives(gray: Tensor) -> Tensor:
    """Rectified derivatives int32 ``[8, h, w]`` of the half-resolution image, 256ths of a level a full-image pixel."""
    pixels = _even(gray.int())
    sums = (pixels[::2, ::2] + pixels[::2, 1::2]) + (pixels[1::2, ::2] + pixels[1::2, 1::2])
    gx = _moved(sums, 1, 1) - _moved(sums, 1, -1)
    gy = _moved(sums, 0, 1) - _moved(sums, 0, -1)
    bins = [gx * COSINES[b] + gy * COSINES[(b - 2) % 8] for b in range(layout.BINS)]
    return ((torch.stack(bins) + (1 << (DERIVATIVE_SHIFT - 1))) >> DERIVATIVE_SHIFT).clamp(min=0)


def _binomial(maps: Tensor, axis: int, taps: int, distance: int) -> Tensor:
    """One blur of `smoothing.smooth_line` along an axis, edges repeated."""
    near = _mean(_moved(maps, axis, -distance), _moved(maps, axis, distance))
    if taps == 3:
        return _mean(maps, near)
    far = _mean(_moved(maps, axis, -2 * distance), _moved(maps, axis, 2 * distance))
    return _mean(near, _mean(maps, _mean(maps, far)))


def _mean(first: Tensor, second: Tensor) -> Tensor:
    return (first + second + 1) >> 1


def _moved(maps: Tensor, axis: int, by: int) -> Tensor:
    """The neighbour `by` places on along an axis, the edge's own value beyond it."""
    last = maps.shape[axis] - 1
    return maps.index_select(axis, (torch.arange(last + 1, device=maps.device) + by).clamp(0, last))


def _even(maps: Tensor) -> Tensor:
    """The last two axes cut to even lengths; a single row or column is doubled."""
    for axis in (-2, -1):
        count = maps.shape[axis]
        index = torch.arange(2 * max(1, count // 2), device=maps.device).clamp(max=count - 1)
        maps = maps.index_select(axis, index)
    return maps


def _halve(maps: Tensor) -> Tensor:
    """Mean of 2 x 2 histograms, rounded as in `smoothing.fine_levels`: rows first, then columns."""
    maps = _even(maps)
    tall = _mean(maps[:, ::2], maps[:, 1::2])
    return _mean(tall[..., ::2], tall[..., 1::2])


# Matching cost and label searches as batched torch code: the reference of the kernels, and the path for GPUs.


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
        position = population_positions(
            torch, state.moths, state.flames, iteration + 1, iterations, rules, scale, state.random
        )
        state.moths = position.maximum(state.lower).minimum(state.upper)
        state.evaluate(state.moths, end)


# Sparse DAISY Filter Flow with maps, costs and search on a torch device.


@dataclass(frozen=True, eq=False)
class DeviceMaps(OrientationMaps):
    """`OrientationMaps` whose histograms also lie on a device, as uint8 ``[total, 8]``."""

    on_device: Tensor


class TorchSparseFlow(SparseDaisyFlow):
    """Sparse flow on any torch device; see `contracts.flow.FlowEstimator`.

    Args:
        settings: How. The appearance terms of Eq. 1 exist on the processor only.
        device: For example ``cuda:0``; ``cpu`` runs the same code as a reference.
        threads: For the part on the processor.

    Raises:
        SettingsError: The settings ask for the terms of appearance, or the device cannot be used.
    """

    def __init__(self, settings: FlowSettings | None = None, *, device: str = "cpu", threads: int = 1) -> None:
        super().__init__(settings, threads=threads)
        if self.settings.terms != 1:
            raise SettingsError(
                f"flow.terms is {self.settings.terms}: a torch device computes the first term of Eq. 1 only",
                "flow.terms=1, or device='cpu' for all three",
            )
        try:
            self.device = torch.device(device)
            torch.zeros(1, device=self.device)
        except (RuntimeError, AssertionError) as error:
            reason = str(error).strip().splitlines()[0]
            raise SettingsError(f"device '{device}' cannot be used: {reason}", "device='cpu' always works") from None

    def prepare(self, gray: NDArray[np.uint8]) -> DeviceMaps:
        """The orientation maps of a uint8 ``[H, W]`` image."""
        gray = np.ascontiguousarray(gray)
        histograms, geometry = quantised_maps(torch.from_numpy(gray.copy()).to(self.device))
        half = half_image(gray)
        return DeviceMaps(gray, framed(gray), framed(half), histograms.cpu().numpy(), geometry, histograms)

    def _runner(self, plan: Plan, described: Reference, pair: Pair, state: SearchState, seed: int) -> Phase:
        reference, target = pair.reference, pair.target
        assert isinstance(reference, DeviceMaps) and isinstance(target, DeviceMaps)
        device_tables = torch_tables(pair.tables, reference.gray.shape, self.device)
        points = torch.from_numpy(described.points).to(self.device)
        descriptors = rotated_descriptors(reference.on_device, points, device_tables)
        lower, upper = torch.from_numpy(state.lower).to(self.device), torch.from_numpy(state.upper).to(self.device)
        batch = TorchState(points, descriptors, target.on_device, device_tables, lower, upper, plan.population, seed)

        def run(number: int, candidates: NDArray[np.float32]) -> None:
            labels, end = torch.from_numpy(candidates).to(self.device), plan.ends[number]
            if plan.rules is None:
                random_phase(batch, labels, end, plan.shrink)
            else:
                steps = cauchy_steps(self.settings)
                moth_flame_phase(batch, labels, end, number, plan.rules, plan.iterations, steps)
            state.flames[:], state.costs[:] = batch.flames.cpu().numpy(), batch.costs.cpu().numpy()
            state.used[:] = batch.used.cpu().numpy()

        return run
