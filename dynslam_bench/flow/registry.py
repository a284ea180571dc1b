"""Flows by id: built in or plug-ins (entry-point group ``dynslam_bench.flow``)."""

from __future__ import annotations

from dynslam_bench.contracts.flow import FlowSpec
from dynslam_bench.core.plugins import Registry

__all__ = ["FLOWS", "FlowSpec"]

BUILT_IN = (
    FlowSpec(
        "daisy",
        "dynslam_bench.flow.build_flow:build_daisy",
        "DAISY Filter Flow, sparse or dense, with an interchangeable label search",
        "MIT",
    ),
    FlowSpec(
        "lucas-kanade",
        "dynslam_bench.flow.build_flow:build_lucas_kanade",
        "pyramidal Lucas-Kanade (OpenCV)",
        "Apache-2.0",
    ),
    FlowSpec("dis", "dynslam_bench.flow.build_flow:build_dis", "dense inverse search (OpenCV)", "Apache-2.0"),
)

FLOWS: Registry[FlowSpec] = Registry("flow", FlowSpec, lambda: BUILT_IN)
