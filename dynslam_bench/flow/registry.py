"""Flows by id: built in or plug-ins (entry-point group ``dynslam_bench.flow``)."""

from __future__ import annotations

from dataclasses import dataclass

from dynslam_bench.core.plugins import Registry


@dataclass(frozen=True)
class FlowSpec:
    """Announces an optical flow; importable without torch or OpenCV.

    Attributes:
        id: Name that `FlowSettings.method` (built in) or `FlowSettings.plugin` takes.
        entry_point: ``"module:factory"``; called as ``factory(settings: FlowSettings, *, device: str, threads: int)``,
            returns an `contracts.flow.FlowEstimator`.
        summary: One line.
        license: SPDX id or remark.
    """

    id: str
    entry_point: str
    summary: str = ""
    license: str = ""


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
