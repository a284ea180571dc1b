"""DAISY Filter Flow with the label search on a torch device, as batched torch code; also the reference of the kernels.

Costs are the same whole numbers as those of `matching_cost`. Random numbers come from a generator on the processor, so
that every device uses the same ones. Orientation maps, descriptors, propagation of labels, photometric refinement and
the forward-backward check are computed on the processor, in `sparse.SparseDaisyFlow`.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from dynslam_bench.core.errors import SettingsError
from dynslam_bench.flow import layout
from dynslam_bench.flow.label_search import Phase, Plan, cauchy_steps
from dynslam_bench.flow.matching_cost import OUTSIDE, CostTables, Reference
from dynslam_bench.flow.moth_flame import MothFlameRules, opposites, population_positions
from dynslam_bench.flow.search_kernels import SearchState
from dynslam_bench.flow.settings import FlowSettings
from dynslam_bench.flow.sparse import Pair, SparseDaisyFlow


class TorchTables(NamedTuple):
    """`matching_cost.CostTables` on a device."""

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


def quantise(labels: Tensor) -> tuple[Tensor, Tensor]:
    """Scale and rotation indices of labels ``[..., 4]``."""
    scale = (labels[..., 2] * 4 + 0.5).floor().long() - layout.SCALE_LOW
    rotation = (labels[..., 3] * 7.639437268410976 + 0.5).floor().long() - layout.ANGLE_LOW
    return scale.clamp(0, layout.SCALES - 1), rotation.clamp(0, layout.ROTATIONS - 1)


def label_costs(points: Tensor, labels: Tensor, descriptors: Tensor, histograms: Tensor, tables: TorchTables) -> Tensor:
    """First term of Eq. 1 for L labels of each point.

    Args:
        points: float32 ``[N, 2]``.
        labels: float32 ``[N, L, 4]``; labels that are not finite or leave the image cost `matching_cost.OUTSIDE`.
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
    """The batched counterpart of `search_kernels.SearchState`."""

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
        """Extend the bounds to 8 px around the best displacement (see `search_kernels.widen`)."""
        best = self.flames[:, :1, :2]
        self.lower[..., :2] = self.lower[..., :2].minimum(best - 8)
        self.upper[..., :2] = self.upper[..., :2].maximum(best + 8)


def random_phase(state: TorchState, candidates: Tensor, end: int, shrink: float) -> None:
    """The batched counterpart of `search_kernels.shrinking_window_phase`."""
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
    """The batched counterpart of `search_kernels.moth_flame_phase` (Eq. 4-22)."""
    count, population = state.costs.shape
    device = state.points.device
    state.evaluate(candidates, end)
    state.widen()
    if phase == 0:
        placed = min(candidates.shape[1], population)
        state.moths = state.lower + (state.upper - state.lower) * state.random((count, population, 4))
        state.evaluate(state.moths[:, placed:], end)
        finite = candidates[:, :placed].isfinite().all(-1, keepdim=True)
        state.moths[:, :placed] = torch.where(finite, candidates[:, :placed], state.moths[:, :placed])
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


class TorchSparseFlow(SparseDaisyFlow):
    """Sparse flow on any torch device; see `contracts.flow.FlowEstimator`.

    Args:
        settings: Search, refinement and checks. The appearance terms of Eq. 1 exist on the processor only.
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

    def _runner(self, plan: Plan, described: Reference, pair: Pair, state: SearchState, seed: int) -> Phase:
        def upload(array: NDArray[Any]) -> Tensor:
            return torch.from_numpy(array).to(self.device)

        tables = torch_tables(pair.tables, pair.target.gray.shape, self.device)
        shape = (len(described.points), len(pair.tables.support), layout.ROTATIONS, layout.HISTOGRAMS, layout.BINS)
        descriptors, target = upload(described.descriptors).view(shape), upload(pair.target.histograms)
        lower, upper, points = upload(state.lower), upload(state.upper), upload(described.points)
        batch = TorchState(points, descriptors, target, tables, lower, upper, plan.population, seed)

        def run(number: int, candidates: NDArray[np.float32]) -> None:
            labels, end = upload(candidates), plan.ends[number]
            if plan.rules is None:
                random_phase(batch, labels, end, plan.shrink)
            else:
                steps = cauchy_steps(self.settings)
                moth_flame_phase(batch, labels, end, number, plan.rules, plan.iterations, steps)
            state.flames[:], state.costs[:] = batch.flames.cpu().numpy(), batch.costs.cpu().numpy()
            state.used[:] = batch.used.cpu().numpy()

        return run
