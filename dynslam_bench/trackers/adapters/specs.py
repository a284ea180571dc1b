"""Settings and specs of the control trackers and of the adapters to external systems.

Imports neither torch nor OpenCV.
"""

import os
import shlex
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Literal

from pydantic import Field

from dynslam_bench.contracts import TrackerSpec
from dynslam_bench.core import SettingsError, translate_errors
from dynslam_bench.core.settings import Settings, names, tunable
from dynslam_bench.core.version import install_hint
from dynslam_bench.trackers.adapters.program_file import BatchSettings, ExitCode, ProgramSettings


class ConstantVelocitySettings(Settings):
    """Settings of the `constant-velocity` control."""

    frames: int = tunable(
        5,
        meaning="frames from which the velocity is measured before it is extrapolated",
        low=2,
        high=30,
        limits=(2, None),
        unit="frames",
    )


class ReplaySettings(Settings):
    """Settings of `replay:FILE`."""

    file: str = names(
        "",
        "file",
        meaning="trajectory file in TUM format (timestamp tx ty tz qx qy qz qw, camera to world)",
    )
    tolerance_s: float = Field(
        0.01,
        gt=0,
        le=1,
        description="largest difference in seconds between a frame's stamp and its pose's",
    )
    covariances: str = names(
        "",
        "file",
        meaning="file of motion covariances (timestamp and 36 numbers a line); empty for none",
    )

    def verify(self) -> None:
        """There must be a file, and a trajectory in it; and covariances of its poses in theirs."""
        from dynslam_bench.geometry import read_tum
        from dynslam_bench.geometry.motion_covariances import at_poses, read_motion_covariances

        if not self.file.strip():
            raise SettingsError(
                "replay needs a trajectory file", "write replay:FILE or --set file=FILE"
            )
        trajectory = read_tum(Path(self.file).expanduser())
        if self.covariances:
            at_poses(read_motion_covariances(self.covariances), trajectory, self.covariances)


class SubprocessSettings(ProgramSettings):
    """Settings of `subprocess:COMMAND`."""

    command: str = Field(
        "", description="program and arguments, split as a shell would; run without a shell"
    )
    images: Literal["raw", "png"] = Field(
        "raw",
        description="raw: one memory-mapped file, overwritten at each frame; png: two PNG files a frame",
    )
    folder: str = Field("", description="working folder of the program; empty for the current one")
    version: str = Field(
        "", description="free text, part of a run's identity; change it with the program"
    )
    final: bool = Field(
        False, description="whether the program answers `finalize` with a final trajectory"
    )
    exit_codes: tuple[ExitCode, ...] = Field(
        (0,),
        min_length=1,
        description="exit codes after `close` that are no failure; -N: killed by signal N",
    )
    environment: tuple[str, ...] = Field(
        (),
        description="names of environment variables that the program gets beside the usual ones; their values count",
    )

    def words(self) -> list[str]:
        """The command's words.

        Raises:
            SettingsError: There are none, or its quotes do not match.
        """
        with translate_errors(
            SettingsError, f"subprocess: cannot split the command '{self.command}'", of=ValueError
        ):
            command = shlex.split(self.command)
        if not command:
            hint = "write 'subprocess:PROGRAM ARGUMENTS' or --set command=..."
            raise SettingsError("subprocess needs a command", hint)
        return command

    @property
    def working_folder(self) -> Path:
        """The working folder of the program."""
        return Path(self.folder).expanduser()

    def verify(self) -> None:
        """The program and its folder must be there."""
        command = self.words()
        folder = self.working_folder
        if not folder.is_dir():
            raise SettingsError(f"subprocess: no folder {folder}")
        # a path counts from the working folder, a bare name is searched in PATH
        program = command[0]
        if os.sep in program:
            program = str((folder / Path(program).expanduser()).absolute())
        if shutil.which(program) is None:
            raise SettingsError(
                f"subprocess: cannot start '{command[0]}': no such program",
                "check its path and mode",
            )


class OrbSlam3Settings(ProgramSettings):
    """Settings of `orbslam3`: those of its own settings file that matter for RGB-D."""

    vocabulary: str = names(
        "",
        "file",
        otherwise="DYNSLAM_BENCH_ORB_VOCABULARY",
        meaning="DBoW2 text vocabulary (.txt or .txt.xz); empty for $DYNSLAM_BENCH_ORB_VOCABULARY",
    )
    features: int = tunable(
        1000,
        meaning="ORB features a frame",
        low=500,
        high=2500,
        scale="log",
        limits=(100, 10000),
        unit="features",
    )
    levels: int = tunable(
        8, meaning="levels of the image pyramid", low=4, high=12, limits=(1, 16), unit="levels"
    )
    scale_factor: float = tunable(
        1.2, meaning="scale between levels of the pyramid", low=1.1, high=1.5, limits=(1.01, 3.0)
    )
    fast_threshold: int = tunable(
        20, meaning="first FAST threshold of a cell", low=7, high=40, limits=(1, 255)
    )
    min_fast_threshold: int = tunable(
        7,
        meaning="FAST threshold of a cell where the first finds nothing",
        low=3,
        high=20,
        limits=(1, 255),
    )
    close_depth_baselines: float = tunable(
        40.0,
        meaning="points nearer than this many baselines count as close",
        low=20,
        high=80,
        limits=(1, 1000),
    )


class SvoSettings(ProgramSettings):
    """Settings of `svo`."""

    features: int = tunable(
        120, meaning="features a frame", low=60, high=400, scale="log", limits=(20, 5000)
    )
    init_disparity_px: float = tunable(
        50.0,
        meaning="median disparity at which the map begins",
        low=10,
        high=80,
        scale="log",
        limits=(1, None),
        unit="px",
    )
    max_lost_features: int = tunable(
        40,
        meaning="a frame that loses more features is lost",
        low=20,
        high=400,
        scale="log",
        limits=(1, None),
    )


class OpenCvOdometrySettings(Settings):
    """Settings of `opencv-odometry`."""

    method: Literal["rgbd", "icp", "rgb"] = tunable(
        "rgbd", meaning="what is aligned: colour and depth, depth alone, or colour alone"
    )
    min_depth_m: float = tunable(
        0.1, meaning="nearest depth that is used", low=0.05, high=1.0, unit="m"
    )
    max_depth_m: float = tunable(
        8.0, meaning="farthest depth that is used", low=3.0, high=10.0, unit="m"
    )
    max_depth_difference_m: float = tunable(
        0.07,
        meaning="largest depth difference of corresponding pixels",
        low=0.02,
        high=0.3,
        scale="log",
        unit="m",
    )


class Open3dOdometrySettings(Settings):
    """Settings of `open3d-odometry`."""

    method: Literal["hybrid", "intensity", "point-to-plane"] = tunable(
        "hybrid", meaning="cost: colour and depth, colour alone, or point to plane"
    )
    max_depth_m: float = tunable(
        8.0, meaning="farthest depth that is used", low=3.0, high=10.0, unit="m"
    )
    max_depth_difference_m: float = tunable(
        0.07,
        meaning="largest depth difference of corresponding pixels",
        low=0.02,
        high=0.3,
        scale="log",
        unit="m",
    )
    iterations_coarse: int = tunable(
        10, meaning="iterations at a quarter of the resolution", low=5, high=40
    )
    iterations_middle: int = tunable(5, meaning="iterations at half the resolution", low=2, high=40)
    iterations_fine: int = tunable(3, meaning="iterations at full resolution", low=1, high=40)


_HERE = "dynslam_bench.trackers.adapters"

NEVER_MOVE = TrackerSpec(
    id="never-move",
    entry_point=f"{_HERE}.controls:NeverMove",
    label="never move",
    summary="Control: claims that the camera stands still, on every frame.",
    provenance="control",
    ranked=False,
    license="MIT",
    remarks="Its error is the spread of the ground truth; a tracker above it is worse than none.",
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
    files=f"{_HERE}.orbslam3:files",
    requires={"pyorbslam3": f"{install_hint('orbslam3')} (Linux x86-64)"},
    remarks=(
        "Assumes a static world and marks nothing as lost on dynamic scenes: it follows the people, coverage 100 %. "
        "After a real loss it starts a new map with an origin of its own; its poses are taken as they come. Runs three "
        "threads of its own whatever --threads says, so two runs of one seed differ. Needs an ORB vocabulary: "
        "--set vocabulary=FILE or $DYNSLAM_BENCH_ORB_VOCABULARY."
    ),
)

ADAPTERS = (
    NEVER_MOVE,
    TrackerSpec(
        id="constant-velocity",
        entry_point=f"{_HERE}.controls:ConstantVelocity",
        label="constant velocity",
        settings=ConstantVelocitySettings,
        summary="Control: measures the camera's velocity over the first frames, then only extrapolates it.",
        provenance="control",
        ranked=False,
        license="MIT",
        remarks="The motion model of a SLAM system without its measurements; drifts without bound.",
    ),
    TrackerSpec(
        id="replay",
        entry_point=f"{_HERE}.controls:Replay",
        label="replay",
        settings=ReplaySettings,
        summary="Gives each frame its pose in a trajectory file (TUM format): replay:FILE.",
        provenance="external",
        parameter="file",
        remarks="A frame without a pose within the tolerance is lost; frame times mean nothing.",
    ),
    TrackerSpec(
        id="subprocess",
        entry_point=f"{_HERE}.subprocess_tracker:build",
        label="program",
        settings=SubprocessSettings,
        summary="A tracker in a program of its own, in any language, over JSON lines: subprocess:COMMAND or FILE.toml.",
        deterministic=False,
        provenance="external",
        parameter="command",
        files=f"{_HERE}.subprocess_tracker:files",
        describe=f"{_HERE}.program_file:describe_served",
        remarks=(
            "The program, its libraries, the files and folders among its arguments and what scripts and configurations "
            "name are part of a run's identity; change the setting `version` when something else that it opens "
            "has changed."
        ),
    ),
    TrackerSpec(
        id="batch",
        entry_point=f"{_HERE}.batch:BatchTracker",
        label="batch program",
        settings=BatchSettings,
        summary="A program that reads a sequence folder and writes a trajectory at its end: batch:FILE.toml.",
        deterministic=False,
        provenance="external",
        parameter="program",
        files=f"{_HERE}.program_file:files",
        online=False,
        describe=f"{_HERE}.program_file:describe_batch",
        remarks="Only its final trajectory exists. The time of a frame is the program's whole time over the frames.",
    ),
    ORBSLAM3,
    replace(
        ORBSLAM3,
        id="orbslam3-mono",
        entry_point=f"{_HERE}.orbslam3:OrbSlam3Monocular",
        label="ORB-SLAM3, monocular",
        summary="The real ORB-SLAM3 in its monocular mode, untouched, in a process of its own.",
        sensors="rgb",
        remarks=(
            "Assumes a static world. Its scale is free, and another after each loss that begins a new map; its "
            "poses are taken as they come, and it saves none of single frames at the end. Threads and vocabulary: see "
            "orbslam3."
        ),
    ),
    TrackerSpec(
        id="svo",
        entry_point=f"{_HERE}.svo:Svo",
        label="SVO",
        settings=SvoSettings,
        summary="The real SVO (monocular, semi-direct), untouched, in a process of its own.",
        presets={"handheld": {"init_disparity_px": 15.0, "max_lost_features": 200}},
        sensors="rgb",
        deterministic=False,
        provenance="external",
        license="GPL-3.0-or-later",
        citation="C. Forster, M. Pizzoli, D. Scaramuzza, SVO: Fast semi-direct monocular visual odometry, ICRA 2014",
        requires={"svo_cpp": "pip install --no-deps svo-cpp (Linux x86-64)"},
        remarks=(
            "Made for cameras that look down with a wide view. Assumes a static world, and after a loss only "
            "relocalises. Its scale is free. Images are undistorted for it. Its package asks for a second OpenCV, "
            "which it never loads."
        ),
    ),
    TrackerSpec(
        id="opencv-odometry",
        entry_point=f"{_HERE}.odometry:OpenCvOdometry",
        label="OpenCV RGB-D odometry",
        settings=OpenCvOdometrySettings,
        summary="OpenCV's dense frame-to-frame RGB-D odometry.",
        provenance="external",
        license="Apache-2.0",
        citation=(
            "F. Steinbruecker, J. Sturm, D. Cremers, Real-time visual odometry from dense RGB-D images, ICCV-W 2011"
        ),
        requires={"cv2": "pip install opencv-python-headless"},
        check=f"{_HERE}.odometry:unavailable",
        remarks="No map and no loop closing: it drifts. Assumes a static world.",
    ),
    TrackerSpec(
        id="open3d-odometry",
        entry_point=f"{_HERE}.odometry:Open3dOdometry",
        label="Open3D RGB-D odometry",
        settings=Open3dOdometrySettings,
        summary="Open3D's dense multi-scale frame-to-frame RGB-D odometry.",
        provenance="external",
        license="MIT",
        citation="Q.-Y. Zhou, J. Park, V. Koltun, Open3D: A modern library for 3D data processing, arXiv:1801.09847",
        requires={"open3d": install_hint("open3d")},
        remarks="No map and no loop closing: it drifts. Assumes a static world.",
    ),
)
"""The control trackers and the adapters."""
