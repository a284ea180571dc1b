"""Flows by id: built in or plug-ins (entry-point group ``dynslam_bench.flow``)."""

from __future__ import annotations

from dynslam_bench.contracts.flow import FlowEstimator, FlowSpec
from dynslam_bench.core.errors import DynslamError, PluginError
from dynslam_bench.core.plugins import Registry, load_object
from dynslam_bench.flow.settings import FlowSettings

__all__ = ["FLOWS", "FlowSpec"]

BUILT_IN = (
    FlowSpec(
        "daisy",
        "dynslam_bench.flow.registry:build_daisy",
        "DAISY Filter Flow, sparse or dense, with an interchangeable label search",
        "MIT",
    ),
    FlowSpec(
        "lucas-kanade",
        "dynslam_bench.flow.registry:build_lucas_kanade",
        "pyramidal Lucas-Kanade (OpenCV)",
        "Apache-2.0",
    ),
    FlowSpec("dis", "dynslam_bench.flow.registry:build_dis", "dense inverse search (OpenCV)", "Apache-2.0"),
)

FLOWS: Registry[FlowSpec] = Registry("flow", FlowSpec, lambda: BUILT_IN)


# From settings to a flow estimator.


def build_flow(settings: FlowSettings | None = None, *, device: str = "cpu", threads: int = 1) -> FlowEstimator:
    """Load and construct the flow that the settings name.

    Args:
        settings: Which flow, and how; None for the defaults.
        device: ``cpu`` takes the compiled kernels, any other torch device the batched torch path (DAISY only).
        threads: Processor threads; results do not depend on their number.

    Raises:
        PluginError: No such flow, or it cannot be built or is no `FlowEstimator`.
        SettingsError: The flow refuses the settings.
    """
    settings = settings or FlowSettings()
    spec = FLOWS.get(settings.plugin or settings.method)
    factory = load_object(spec.entry_point)
    try:
        flow = factory(settings, device=device, threads=threads)
    except DynslamError:
        raise
    except Exception as error:
        raise PluginError(f"flow '{spec.id}' cannot be built: {type(error).__name__}: {error}") from error
    if not isinstance(flow, FlowEstimator):
        raise PluginError(f"'{spec.entry_point}' gave a {type(flow).__name__} without prepare() and track()")
    return flow


def build_daisy(settings: FlowSettings, *, device: str = "cpu", threads: int = 1) -> FlowEstimator:
    """DAISY Filter Flow, sparse or dense; the dense one on the processor, whatever the device."""
    if settings.mode == "dense":
        from dynslam_bench.flow.dense_flow import DensePointFlow

        return DensePointFlow(settings, threads=threads)
    from dynslam_bench.flow.sparse import SparseDaisyFlow

    if device != "cpu":
        from dynslam_bench.flow.torch_flow import TorchSparseFlow

        return TorchSparseFlow(settings, device=device, threads=threads)
    return SparseDaisyFlow(settings, threads=threads)


def build_lucas_kanade(settings: FlowSettings, *, device: str = "cpu", threads: int = 1) -> FlowEstimator:
    """Pyramidal Lucas-Kanade; OpenCV's own threads, processor only."""
    from dynslam_bench.flow.opencv import LucasKanadeFlow

    return LucasKanadeFlow(settings)


def build_dis(settings: FlowSettings, *, device: str = "cpu", threads: int = 1) -> FlowEstimator:
    """Dense inverse search; OpenCV's own threads, processor only."""
    from dynslam_bench.flow.opencv import DisFlow

    return DisFlow(settings)
