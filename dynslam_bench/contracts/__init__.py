"""Protocols of plug-ins and the types they exchange; a plug-in imports from here, from settings and errors only.

Importing this package loads neither torch nor OpenCV, numba, scipy, Gymnasium or Optuna.

| plug-in | its spec | its heavy part | what it is given and gives |
| --- | --- | --- | --- |
| tracker | `TrackerSpec` | `Tracker` | `Frame`, `TrackerContext`; `TrackResult`, `Trajectory`, `MapOutputs` |
| data set | `DatasetSpec` | `Sequence` | `Frame`, `FrameMasks`, `Camera` |
| segmenter | `SegmenterSpec` | `Segmenter` | `Frame`, `SegmenterContext`; `Instances` |
| flow | `FlowSpec` | `FlowEstimator` | grey images and points; `FlowResult` |
| features | `FeatureSpec` | `FeatureExtractor` | a grey image; `Keypoints` |
| filter | none: a tracker is composed of filters | `DynamicFilter` | `FrameBundle`, `FilterState`; `FilterResult` |

`docs/reference/plugins.md` lists them, the pages in `docs/how-to/` show one of each. The
registries, which find plug-ins by id, are in the packages of their kind.

Example:
    >>> from dynslam_bench.contracts import TrackerSpec
    >>> TrackerSpec("my-slam", "my_package.slam:MySlam", label="My SLAM").missing()
    []
"""

from dynslam_bench.contracts.checks import TrackerContractError
from dynslam_bench.contracts.features import (
    FeatureExtractor,
    FeatureSpec,
    Keypoints,
    MaskedExtractor,
)
from dynslam_bench.contracts.filter import (
    DynamicFilter,
    FilterResult,
    FilterState,
    FrameBundle,
    KeyframeView,
    Need,
)
from dynslam_bench.contracts.flow import FlowEstimator, FlowResult, FlowSpec
from dynslam_bench.contracts.segmenter import (
    ForgetsFrames,
    Instances,
    Segmenter,
    SegmenterContext,
    SegmenterSpec,
)
from dynslam_bench.contracts.sequence import (
    DatasetSpec,
    Frame,
    FrameMasks,
    MaskSource,
    Sequence,
    exact_stamps,
    timestamps_ns,
)
from dynslam_bench.contracts.tracker import (
    KeyframeRecord,
    MapOutputs,
    Provenance,
    Tracker,
    TrackerContext,
    TrackerSpec,
    TrackingState,
    TrackResult,
    stage_seconds,
)
from dynslam_bench.geometry import Camera, Trajectory

__all__ = [
    "Camera",
    "DatasetSpec",
    "DynamicFilter",
    "FeatureExtractor",
    "FeatureSpec",
    "FilterResult",
    "FilterState",
    "FlowEstimator",
    "FlowResult",
    "FlowSpec",
    "ForgetsFrames",
    "Frame",
    "FrameBundle",
    "FrameMasks",
    "Instances",
    "KeyframeRecord",
    "KeyframeView",
    "Keypoints",
    "MapOutputs",
    "MaskSource",
    "MaskedExtractor",
    "Need",
    "Provenance",
    "Segmenter",
    "SegmenterContext",
    "SegmenterSpec",
    "Sequence",
    "TrackResult",
    "Tracker",
    "TrackerContext",
    "TrackerContractError",
    "TrackerSpec",
    "TrackingState",
    "Trajectory",
    "exact_stamps",
    "stage_seconds",
    "timestamps_ns",
]
