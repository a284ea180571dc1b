"""The segmentation stage of a system: a segmenter, the frames on which it runs, and what is carried between them."""

from collections.abc import Sequence

from dynslam_bench.contracts import DynamicFilter, TrackerContext
from dynslam_bench.core.stage_cache import StageCache
from dynslam_bench.segmentation.build_segmenter import CachedSegmenter, build_segmenter
from dynslam_bench.segmentation.schedule import MaskScheduler
from dynslam_bench.segmentation.settings import SegmentationSettings, expand_classes


def build_mask_stage(
    settings: SegmentationSettings,
    context: TrackerContext,
    filters: Sequence[DynamicFilter],
    cache: StageCache | None,
) -> tuple[MaskScheduler | None, CachedSegmenter | None]:
    """The mask stage that settings ask for.

    Args:
        settings: The source of the masks and the schedule.
        context: Where the system runs.
        filters: The system's filters, some of which watch classes that are not dynamic by
            themselves.
        cache: The stage cache; None to compute each mask.

    Returns:
        The stage, None where the source is ``none``; and its network if that answers from the stage
        cache.

    Raises:
        SegmentationError: The semantic source is not available.
    """
    segmenter = build_segmenter(
        settings,
        sequence_id=context.sequence_id,
        masks=context.masks,
        device=context.device,
        threads=context.threads,
        cache=cache,
        also=movable_classes(filters),
    )
    if segmenter is None:
        return None, None
    cached = segmenter.inner if isinstance(segmenter.inner, CachedSegmenter) else None
    return MaskScheduler(settings, segmenter), cached


def movable_classes(filters: Sequence[DynamicFilter]) -> frozenset[str]:
    """The classes that filters watch although they are not dynamic by themselves: their setting ``movable``."""
    classes: frozenset[str] = frozenset()
    for dynamic_filter in filters:
        names = getattr(getattr(dynamic_filter, "settings", None), "movable", "")
        if names:
            classes |= expand_classes(names)
    return classes
