"""Sparse DAISY Filter Flow with maps, costs and search on a torch device.

What is small or serial (propagation of labels, photometric refinement, the way back) stays on the processor, in
`sparse.SparseDaisyFlow`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from dynslam_bench.core.errors import SettingsError

from ..searches.common import SearchState
from ..searches.schedule import Phase, Plan, cauchy_steps
from ..searches.torch_search import TorchState, moth_flame_phase, random_phase, rotated_descriptors, torch_tables
from ..settings import FlowSettings
from .cost import Reference
from .maps import OrientationMaps, framed, half_image
from .sparse import Pair, SparseDaisyFlow
from .torch_maps import quantised_maps


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
