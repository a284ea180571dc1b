"""A short, small excerpt on which nearly every online setting of every tracker shows, and a segmenter that errs."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace

import numpy as np

from dynslam_bench.contracts import Frame, FrameMasks, Instances, TrackResult
from dynslam_bench.core.settings import Settings, parameters
from dynslam_bench.flow.settings import DenseFlowSettings
from dynslam_bench.segmentation.build_segmenter import SegmenterContext, SegmenterSpec
from dynslam_bench.segmentation.recorded import instances_of
from dynslam_bench.sequences.catalogue import open_sequence
from dynslam_bench.testing.tracker import first_difference
from dynslam_bench.trackers import TrackerContext, TrackerSpec, build_tracker
from dynslam_bench.trackers.registry import resolve_settings
from dynslam_bench.trackers.systems.composition import SemanticSystemSettings

QUICK_DENSE = {
    "flow.budget": 16,
    "flow.sweeps": 1,
    "flow.candidates": 2,
    "flow.second_round": False,
    "flow.superpixel_px": 24,
    "flow.filter_radius_px": 2,
}


def quick(settings: type[Settings]) -> dict[str, object]:
    """Overrides with which a system's flow costs little; none where it has no dense flow."""
    return (
        dict(QUICK_DENSE)
        if isinstance(getattr(settings(), "flow", None), DenseFlowSettings)
        else {}
    )


STRIDE = 3
FRAMES = 14


class SmallScene:
    """Every third frame of a rendered sequence at half the resolution, in memory.

    Attributes:
        id: Id of the whole sequence.
        frames: Numbered from 0.
        camera: At half the resolution.
    """

    def __init__(
        self,
        name: str = "synthetic/walking_xyz?scene=103",
        frames: int = FRAMES,
        stride: int = STRIDE,
    ) -> None:
        whole = open_sequence(f"{name}&frames={frames * stride}")
        self.id = whole.id
        self.camera = whole.camera.resized(whole.camera.width // 2, whole.camera.height // 2)
        self.frames = []
        self._masks = []
        for number in range(frames):
            frame = whole[number * stride]
            masks = whole.masks[number * stride]
            rgb = frame.rgb.reshape(self.camera.height, 2, self.camera.width, 2, 3).mean(
                axis=(1, 3)
            )
            self.frames.append(
                Frame(number, frame.timestamp, rgb.astype(np.uint8), frame.depth[::2, ::2].copy())
            )
            self._masks.append(
                FrameMasks(masks.instances[::2, ::2].copy(), masks.class_names, masks.moving)
            )

    def __getitem__(self, index: int) -> FrameMasks:
        """The masks of a frame: the scene is its own `MaskSource`."""
        return self._masks[index]


class Erring:
    """Sees the true objects with scores of all sizes, the same for the same frame, and misses some."""

    def __init__(self, masks: SmallScene) -> None:
        self._masks = masks

    def segment(self, frame: Frame) -> Instances:
        """The objects of a frame."""
        true = instances_of(self._masks[frame.index], where="the scene")
        draw = np.random.default_rng([3, frame.index]).uniform(size=(2, len(true)))
        scores = np.where(draw[0] < 0.25, 0.15 + 0.3 * draw[1], 0.55 + 0.4 * draw[1])
        return replace(true, scores=scores.astype(np.float32), moving=None).select(draw[1] > 0.15)


def build_erring(settings: Settings, context: SegmenterContext) -> Erring:
    """The factory of the segmenter plug-in."""
    return Erring(context.masks)


SEGMENTER = SegmenterSpec("erring", f"{__file__}:build_erring")


def settings_for(spec: TrackerSpec, **settings: object) -> Settings:
    """All settings of a tracker for the scene, with fewer features as its images are smaller."""
    given: dict[str, object] = {"features.n_features": 500, "features.levels": 4} | quick(
        spec.settings
    )
    if (
        issubclass(spec.settings, SemanticSystemSettings)
        and spec.settings().segmentation.source == "auto"
    ):
        given["segmentation.source"] = f"plugin:{__file__}:SEGMENTER"
        if "segmentation.dilation_px" in {each.name for each in parameters(spec.settings)}:
            given["segmentation.dilation_px"] = 4
    return resolve_settings(spec, given | settings)


def construct(spec: TrackerSpec, scene: SmallScene, **settings: object):
    """A tracker for the scene."""
    return build_tracker(
        spec, settings_for(spec, **settings), TrackerContext(sequence_id=scene.id, masks=scene)
    )


def play(
    tracker, scene: SmallScene, frames: int = FRAMES, before: Callable[[int], None] | None = None
) -> Iterator[TrackResult]:
    """Reset a tracker and track the scene, a frame at a time; `before` is called before each, with its number."""
    tracker.reset(scene.camera, rng=np.random.default_rng(0))
    for frame in scene.frames[:frames]:
        if before is not None:
            before(frame.index)
        yield tracker.track(frame)


def difference(first: Iterable[TrackResult], second: Iterable[TrackResult]) -> str:
    """The first thing in which two episodes differ, bit for bit; empty if in none."""
    return first_difference(list(first), list(second))
