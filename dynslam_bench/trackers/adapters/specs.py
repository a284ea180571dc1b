"""Specs of the control trackers and of the adapters to foreign systems; imports neither torch nor OpenCV."""

from __future__ import annotations

from dataclasses import replace

from dynslam_bench.contracts.tracker import TrackerSpec
from dynslam_bench.core.version import install_hint

from .settings import (
    ConstantVelocitySettings,
    Open3dOdometrySettings,
    OpenCvOdometrySettings,
    OrbSlam3Settings,
    ReplaySettings,
    SubprocessSettings,
)

_HERE = "dynslam_bench.trackers.adapters"

NEVER_MOVE = TrackerSpec(
    id="never-move",
    entry_point=f"{_HERE}.never_move:NeverMove",
    label="never move",
    summary="Control: claims that the camera stands still, on every frame.",
    provenance="control",
    ranked=False,
    license="MIT",
    remarks="Its error is the spread of the ground truth; a tracker above it is worse than none.",
)

CONSTANT_VELOCITY = TrackerSpec(
    id="constant-velocity",
    entry_point=f"{_HERE}.constant_velocity:ConstantVelocity",
    label="constant velocity",
    settings=ConstantVelocitySettings,
    summary="Control: measures the camera's velocity over the first frames, then only extrapolates it.",
    provenance="control",
    ranked=False,
    license="MIT",
    remarks="The motion model of a SLAM system without its measurements; drifts without bound.",
)

REPLAY = TrackerSpec(
    id="replay",
    entry_point=f"{_HERE}.replay:Replay",
    label="replay",
    settings=ReplaySettings,
    summary="Gives each frame its pose in a trajectory file (TUM format): replay:FILE.",
    provenance="external",
    parameter="file",
    remarks="A frame without a pose within the tolerance is lost; frame times mean nothing.",
)

SUBPROCESS = TrackerSpec(
    id="subprocess",
    entry_point=f"{_HERE}.subprocess_tracker:build",
    label="program",
    settings=SubprocessSettings,
    summary="A tracker in a program of its own, in any language, over JSON lines: subprocess:COMMAND.",
    deterministic=False,
    provenance="external",
    parameter="command",
    files=f"{_HERE}.subprocess_tracker:files",
    remarks=(
        "The program, its libraries, the files and folders among its arguments and what scripts and configurations "
        "name are part of a run's identity; change the setting `version` when something else that it opens has changed."
    ),
)

ORBSLAM3 = TrackerSpec(
    id="orbslam3",
    entry_point=f"{_HERE}.orbslam3:OrbSlam3",
    label="ORB-SLAM3",
    settings=OrbSlam3Settings,
    summary="The real ORB-SLAM3 (RGB-D), untouched, in a process of its own.",
    deterministic=False,
    provenance="external",
    license="GPL-3.0-only",
    citation=(
        "C. Campos, R. Elvira, J. J. Gomez Rodriguez, J. M. M. Montiel, J. D. Tardos, ORB-SLAM3: An Accurate "
        "Open-Source Library for Visual, Visual-Inertial, and Multimap SLAM, IEEE T-RO 37(6), 2021"
    ),
    files=f"{_HERE}.vocabulary:files",
    requires={"pyorbslam3": f"{install_hint('orbslam3')} (Linux x86-64)"},
    remarks=(
        "Assumes a static world and marks nothing as lost on dynamic scenes: it follows the people, coverage 100 %. "
        "After a real loss it starts a new map with an origin of its own; its poses are taken as they come. Runs three "
        "threads of its own whatever --threads says, so two runs of one seed differ. Needs an ORB vocabulary: "
        "--set vocabulary=FILE or $DYNSLAM_BENCH_ORB_VOCABULARY."
    ),
)

ORBSLAM3_MONO = replace(
    ORBSLAM3,
    id="orbslam3-mono",
    entry_point=f"{_HERE}.orbslam3:OrbSlam3Monocular",
    label="ORB-SLAM3, monocular",
    summary="The real ORB-SLAM3 in its monocular mode, untouched, in a process of its own.",
    sensors="rgb",
    remarks=(
        "Assumes a static world. Its scale is free, and another after each loss that begins a new map; its poses are "
        "taken as they come, and it saves none of single frames at the end. Threads and vocabulary: see orbslam3."
    ),
)

OPENCV_ODOMETRY = TrackerSpec(
    id="opencv-odometry",
    entry_point=f"{_HERE}.opencv_odometry:OpenCvOdometry",
    label="OpenCV RGB-D odometry",
    settings=OpenCvOdometrySettings,
    summary="OpenCV's dense frame-to-frame RGB-D odometry.",
    provenance="external",
    license="Apache-2.0",
    citation="F. Steinbruecker, J. Sturm, D. Cremers, Real-time visual odometry from dense RGB-D images, ICCV-W 2011",
    requires={"cv2": "pip install opencv-python-headless"},
    check=f"{_HERE}.opencv_odometry:unavailable",
    remarks="No map and no loop closing: it drifts. Assumes a static world.",
)

OPEN3D_ODOMETRY = TrackerSpec(
    id="open3d-odometry",
    entry_point=f"{_HERE}.open3d_odometry:Open3dOdometry",
    label="Open3D RGB-D odometry",
    settings=Open3dOdometrySettings,
    summary="Open3D's dense multi-scale frame-to-frame RGB-D odometry.",
    provenance="external",
    license="MIT",
    citation="Q.-Y. Zhou, J. Park, V. Koltun, Open3D: A modern library for 3D data processing, arXiv:1801.09847",
    requires={"open3d": install_hint("open3d")},
    remarks="No map and no loop closing: it drifts. Assumes a static world.",
)


def adapter_specs() -> list[TrackerSpec]:
    """The control trackers and the adapters."""
    return [
        NEVER_MOVE,
        CONSTANT_VELOCITY,
        REPLAY,
        SUBPROCESS,
        ORBSLAM3,
        ORBSLAM3_MONO,
        OPENCV_ODOMETRY,
        OPEN3D_ODOMETRY,
    ]
