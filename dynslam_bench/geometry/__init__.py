"""Camera model, SE(3), association of stamps, and trajectories with their file formats."""

from dynslam_bench.geometry import se3
from dynslam_bench.geometry.camera import Camera, at_width, feature_scale, inside, pixel_index
from dynslam_bench.geometry.se3 import Array
from dynslam_bench.geometry.stamp_units import (
    are_frame_numbers,
    describe_frame_numbers,
    median_step,
)
from dynslam_bench.geometry.stamps import (
    associate,
    format_ns,
    from_seconds,
    nearest_gap,
    ns_of,
    parse_ns,
    refuse_close,
    to_seconds,
)
from dynslam_bench.geometry.trajectory import RepeatedStamps, Trajectory
from dynslam_bench.geometry.trajectory_files import (
    FileNotes,
    LoadedTrajectory,
    format_tum,
    is_number,
    load_trajectory,
    load_tum,
    ordered_file,
    read_kitti,
    read_stamps,
    read_table,
    read_tum,
    write_kitti,
    write_tum,
)

__all__ = [
    "Array",
    "Camera",
    "FileNotes",
    "LoadedTrajectory",
    "RepeatedStamps",
    "Trajectory",
    "are_frame_numbers",
    "associate",
    "at_width",
    "describe_frame_numbers",
    "feature_scale",
    "format_ns",
    "format_tum",
    "from_seconds",
    "inside",
    "is_number",
    "load_trajectory",
    "load_tum",
    "median_step",
    "nearest_gap",
    "ns_of",
    "ordered_file",
    "parse_ns",
    "pixel_index",
    "read_kitti",
    "read_stamps",
    "read_table",
    "read_tum",
    "refuse_close",
    "se3",
    "to_seconds",
    "write_kitti",
    "write_tum",
]
