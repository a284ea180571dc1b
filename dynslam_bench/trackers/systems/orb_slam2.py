"""The shared back end alone, in the manner of ORB-SLAM2 (Mur-Artal and Tardos 2017), with depth and without.

No dynamic handling beyond the robust kernel and the chi-square tests of the pose optimiser.
"""

from __future__ import annotations

from dataclasses import replace

from dynslam_bench.contracts.tracker import TrackerSpec
from dynslam_bench.slam.settings import MonocularBackendSettings
from dynslam_bench.trackers.systems.composition import BACKEND, UnfilteredSystemSettings, composed


class UnfilteredMonocularSettings(UnfilteredSystemSettings):
    """Settings of a system without depth and without any filter."""

    backend: MonocularBackendSettings = MonocularBackendSettings()


build = composed()
SHARED = (
    "features spread by the cells of a grid, not by a quadtree",
    "relocalisation and matching without a bag of words",
    "mapping in step with tracking, in one thread",
    "the rolling shutter of a camera whose readout is known is undone, which ORB-SLAM2 does not do",
)
"""Deviations with depth and without."""

SPEC = TrackerSpec(
    id="orb-slam2",
    entry_point=f"{__name__}:build",
    label="ORB-SLAM2 style (our back end)",
    settings=UnfilteredSystemSettings,
    summary="the shared RGB-D back end without dynamic handling: the reference of every ratio",
    provenance="own",
    published_as=("ORB-SLAM2",),
    license="MIT (our code; ORB-SLAM2 itself is GPL-3.0 and not used)",
    citation="Mur-Artal and Tardos, ORB-SLAM2, IEEE T-RO 2017",
    assumptions=(
        "no loop closing unless asked for (backend.loop_closing.enabled), and no global bundle adjustment",
        *SHARED,
    ),
    remarks="the identity filter on our own back end, not the ORB-SLAM2 program",
)

MONOCULAR_SPEC = replace(
    SPEC,
    id="orb-slam2-mono",
    label="ORB-SLAM2 style, monocular (our back end)",
    settings=UnfilteredMonocularSettings,
    summary="the shared back end without depth and without dynamic handling",
    sensors="rgb",
    published_as=(),
    citation=(
        "Mur-Artal, Montiel and Tardos, ORB-SLAM, IEEE T-RO 2015; Mur-Artal and Tardos, ORB-SLAM2, IEEE T-RO 2017"
    ),
    assumptions=(BACKEND, *SHARED),
)
SPECS = [SPEC, MONOCULAR_SPEC]
