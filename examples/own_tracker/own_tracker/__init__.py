"""A tracker for dynslam-bench; this module is read whenever trackers are listed, so it imports nothing heavy."""

from dynslam_bench.contracts import TrackerSpec
from dynslam_bench.core.settings import Settings, tunable


class ShiftSettings(Settings):
    """Settings that users, studies and agents may change."""

    min_response: float = tunable(
        0.05, low=0.01, high=0.5, scale="log", meaning="peak below which a frame is lost"
    )


SPEC = TrackerSpec(
    id="shift-odometry",
    entry_point="own_tracker.slam:ShiftOdometry",
    label="Shift odometry",
    settings=ShiftSettings,
    summary="the shift between two images, times the median depth",
    provenance="own",
    license="MIT",
    remarks="knows no rotation and no motion along the optical axis",
)
