"""Settings of the control trackers and of the adapters to foreign systems; light, as every settings module."""

from __future__ import annotations

import os
import shlex
import shutil
from pathlib import Path
from typing import Literal

from pydantic import Field

from dynslam_bench.core.errors import SettingsError
from dynslam_bench.core.settings import Settings, names, tunable


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
        "", "file", meaning="trajectory file in TUM format (timestamp tx ty tz qx qy qz qw, camera to world)"
    )
    tolerance_s: float = Field(
        0.01, gt=0, le=1, description="largest difference in seconds between a frame's stamp and its pose's"
    )

    def verify(self) -> None:
        """There must be a file, and a trajectory in it."""
        from dynslam_bench.geometry.tum_file import read_tum

        if not self.file.strip():
            raise SettingsError("replay needs a trajectory file", "write replay:FILE or --set file=FILE")
        read_tum(Path(self.file).expanduser())


class ProgramSettings(Settings):
    """How long a foreign program may take."""

    start_timeout_s: float = Field(120.0, gt=0, description="seconds for starting and answering `reset`")
    frame_timeout_s: float = Field(30.0, gt=0, description="seconds for answering one `track`")
    final_timeout_s: float = Field(120.0, gt=0, description="seconds for answering `finalize`")
    close_timeout_s: float = Field(5.0, gt=0, description="seconds for ending after `close` before it is killed")


class SubprocessSettings(ProgramSettings):
    """Settings of `subprocess:COMMAND`."""

    command: str = Field("", description="program and arguments, split as a shell would; run without a shell")
    images: Literal["raw", "png"] = Field(
        "raw", description="raw: one memory-mapped file, overwritten at each frame; png: two PNG files a frame"
    )
    folder: str = Field("", description="working folder of the program; empty for the current one")
    version: str = Field("", description="free text, part of a run's identity; change it with the program")
    final: bool = Field(False, description="whether the program answers `finalize` with a final trajectory")

    def words(self) -> list[str]:
        """The command's words.

        Raises:
            SettingsError: There are none, or its quotes do not match.
        """
        try:
            command = shlex.split(self.command)
        except ValueError as error:
            raise SettingsError(f"subprocess: cannot split the command '{self.command}': {error}") from None
        if not command:
            hint = "write 'subprocess:PROGRAM ARGUMENTS' or --set command=..."
            raise SettingsError("subprocess needs a command", hint)
        return command

    def verify(self) -> None:
        """The program and its folder must be there."""
        command, folder = self.words(), Path(self.folder or ".").expanduser()
        if not folder.is_dir():
            raise SettingsError(f"subprocess: no folder {folder}")
        program = command[0] if os.sep not in command[0] else str((folder / Path(command[0]).expanduser()).absolute())
        if shutil.which(program) is None:
            raise SettingsError(f"subprocess: cannot start '{command[0]}': no such program", "check its path and mode")


class OrbSlam3Settings(ProgramSettings):
    """Settings of `orbslam3`: those of its own settings file that matter for RGB-D."""

    vocabulary: str = names(
        "",
        "file",
        otherwise="DYNSLAM_BENCH_ORB_VOCABULARY",
        meaning="DBoW2 text vocabulary (.txt or .txt.xz); empty for $DYNSLAM_BENCH_ORB_VOCABULARY",
    )
    features: int = tunable(
        1000, meaning="ORB features a frame", low=500, high=2500, scale="log", limits=(100, 10000), unit="features"
    )
    levels: int = tunable(8, meaning="levels of the image pyramid", low=4, high=12, limits=(1, 16), unit="levels")
    scale_factor: float = tunable(
        1.2, meaning="scale between levels of the pyramid", low=1.1, high=1.5, limits=(1.01, 3.0)
    )
    fast_threshold: int = tunable(20, meaning="first FAST threshold of a cell", low=7, high=40, limits=(1, 255))
    min_fast_threshold: int = tunable(
        7, meaning="FAST threshold of a cell where the first finds nothing", low=3, high=20, limits=(1, 255)
    )
    close_depth_baselines: float = tunable(
        40.0, meaning="points nearer than this many baselines count as close", low=20, high=80, limits=(1, 1000)
    )


class OpenCvOdometrySettings(Settings):
    """Settings of `opencv-odometry`."""

    method: Literal["rgbd", "icp", "rgb"] = tunable(
        "rgbd", meaning="what is aligned: colour and depth, depth alone, or colour alone"
    )
    min_depth_m: float = tunable(0.1, meaning="nearest depth that is used", low=0.05, high=1.0, unit="m")
    max_depth_m: float = tunable(8.0, meaning="farthest depth that is used", low=3.0, high=10.0, unit="m")
    max_depth_difference_m: float = tunable(
        0.07, meaning="largest depth difference of corresponding pixels", low=0.02, high=0.3, scale="log", unit="m"
    )


class Open3dOdometrySettings(Settings):
    """Settings of `open3d-odometry`."""

    method: Literal["hybrid", "intensity", "point-to-plane"] = tunable(
        "hybrid", meaning="cost: colour and depth, colour alone, or point to plane"
    )
    max_depth_m: float = tunable(8.0, meaning="farthest depth that is used", low=3.0, high=10.0, unit="m")
    max_depth_difference_m: float = tunable(
        0.07, meaning="largest depth difference of corresponding pixels", low=0.02, high=0.3, scale="log", unit="m"
    )
    iterations_coarse: int = tunable(10, meaning="iterations at a quarter of the resolution", low=5, high=40)
    iterations_middle: int = tunable(5, meaning="iterations at half the resolution", low=2, high=40)
    iterations_fine: int = tunable(3, meaning="iterations at full resolution", low=1, high=40)
