"""Flows by id: built in or plug-ins (entry-point group ``dynslam_bench.flow``), and how settings become a flow."""

from __future__ import annotations

from dynslam_bench.contracts.flow import FlowEstimator, FlowSpec
from dynslam_bench.core.errors import PluginError
from dynslam_bench.core.plugins import Registry, build_plugin
from dynslam_bench.flow.settings import FlowMethodSettings, FlowSettings

__all__ = ["FLOWS", "FlowSpec"]

BUILT_IN = (
    FlowSpec(
        "daisy",
        "dynslam_bench.flow.daisy:build_daisy",
        "DAISY Filter Flow, sparse or dense, with an interchangeable label search",
        "MIT",
    ),
    FlowSpec(
        "lucas-kanade",
        "dynslam_bench.flow.opencv:LucasKanadeFlow",
        "pyramidal Lucas-Kanade (OpenCV)",
        "Apache-2.0",
    ),
    FlowSpec(
        "dis", "dynslam_bench.flow.opencv:DisFlow", "dense inverse search (OpenCV)", "Apache-2.0"
    ),
)

FLOWS: Registry[FlowSpec] = Registry("flow", FlowSpec, lambda: BUILT_IN)
"""Flows by id, built in and of plug-ins."""


def spec_of(settings: FlowMethodSettings) -> FlowSpec:
    """The flow that settings name.

    Raises:
        PluginError: No such flow.
    """
    return FLOWS.get(settings.plugin or settings.method)


def build_flow(
    settings: FlowMethodSettings | None = None, *, device: str = "cpu", threads: int = 1
) -> FlowEstimator:
    """Load and construct the flow that the settings name.

    Args:
        settings: Which flow, and its options; None for the defaults.
        device: Where a plug-in may compute; the built-in flows use the processor.
        threads: Processor threads; results do not depend on their number.

    Raises:
        PluginError: No such flow, or it cannot be built or is no `FlowEstimator`.
        SettingsError: The flow refuses the settings.
    """
    settings = settings or FlowSettings()
    return build_plugin(
        "flow",
        spec_of(settings),
        FlowEstimator,  # type: ignore[type-abstract]
        PluginError,
        lambda build: build(settings, device=device, threads=threads),
    )
