"""Choice of the DAISY Filter Flow that the settings ask for: at sparse points or dense.

It lies apart from the registry of flows, so that a run with another flow does not depend on this
one's code.
"""

from __future__ import annotations

from dynslam_bench.contracts.flow import FlowEstimator
from dynslam_bench.flow.settings import DenseFlowSettings, FlowMethodSettings, FlowSettings


def build_daisy(
    settings: FlowMethodSettings, *, device: str = "cpu", threads: int = 1
) -> FlowEstimator:
    """DAISY Filter Flow, sparse or dense; on the processor, whatever the device."""
    if isinstance(settings, DenseFlowSettings):
        from dynslam_bench.flow.dense_flow import DenseDaisyFlow

        return DenseDaisyFlow(settings, threads=threads)
    from dynslam_bench.flow.sparse import SparseDaisyFlow

    # a system with another flow by default: DAISY's own options are absent
    if not isinstance(settings, FlowSettings):
        settings = FlowSettings(**settings.model_dump())
    return SparseDaisyFlow(settings, threads=threads)
