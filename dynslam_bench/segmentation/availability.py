"""Whether the masks that the settings ask for can be had, asked before anything runs."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

from dynslam_bench.contracts.sequence import Sequence
from dynslam_bench.core.errors import SegmentationError
from dynslam_bench.core.settings import Settings
from dynslam_bench.segmentation.build_segmenter import SEGMENTERS, SegmenterContext, build_oracle, resolve_source
from dynslam_bench.segmentation.networks.checkpoints import COCO, embedded_weights, fetch_checkpoint
from dynslam_bench.segmentation.recorded import RecordedSegmenter
from dynslam_bench.segmentation.settings import SegmentationSettings


def segmentation_source(settings: Settings, sequence: Sequence, *, fetch: bool = True) -> str:
    """Where a tracker's masks come from on a sequence, after making sure that they can be had.

    Args:
        settings: A tracker's settings.
        sequence: What it will run on.
        fetch: Download the COCO checkpoint now if that is the source and it is not there yet.

    Returns:
        The resolved source; empty for a tracker without a semantic stage.

    Raises:
        SegmentationError: There is no such file, it holds no network, masks of frames are missing, the sequence has no
            exact masks, or ``auto`` finds nothing.
        PluginError: ``plugin:ID`` names no segmenter.
    """
    group = getattr(settings, "segmentation", None)
    if not isinstance(group, SegmentationSettings):
        return ""
    source = resolve_source(group, sequence.id, sequence.masks, optional=masks_are_optional(settings))
    kind, _, argument = source.partition(":")
    path = Path(argument).expanduser()
    if kind in ("oracle", "oracle-classes"):
        build_oracle(group, SegmenterContext(sequence.id, sequence.masks))
    elif kind == "recorded":
        _check_recorded(path, group, sequence)
    elif kind in ("onnx", "weights"):
        stat = path.stat() if path.is_file() else None
        _check_network(kind, path, group, stat and (stat.st_size, stat.st_mtime_ns))
    elif kind == "embedded" and embedded_weights() is None:
        raise SegmentationError("the embedded network's weights are missing from this installation", "reinstall it")
    elif kind == "coco" and fetch:
        fetch_checkpoint(COCO)
    elif kind == "plugin":
        SEGMENTERS.get(argument)
    return source


def masks_are_optional(settings: Settings) -> bool:
    """Whether a tracker also works with the source ``none``, because that is its own default."""
    field = type(settings).model_fields.get("segmentation")
    default = None if field is None else field.get_default(call_default_factory=True)
    return isinstance(default, SegmentationSettings) and default.source == "none"


def _check_recorded(folder: Path, settings: SegmentationSettings, sequence: Sequence) -> None:
    missing = RecordedSegmenter(folder).missing(sequence.timestamps)
    if settings.schedule == "every_nth" and settings.crowded_share >= 1:  # else nobody knows which it will ask for
        missing = [index for index in missing if index % settings.n == 0]
    if missing:
        raise SegmentationError(
            f"the folder of recorded masks {folder} has none for {len(missing)} of {len(sequence)} frames of "
            f"'{sequence.id}', the first is frame {missing[0]} ({sequence.timestamps[missing[0]]:.6f} s)",
            "is it of another sequence, or of another part?",
        )


@lru_cache(maxsize=16)
def _check_network(kind: str, path: Path, settings: SegmentationSettings, stamp: tuple[int, int] | None) -> None:
    """Load it once in a process, as long as size and time of the file stay."""
    if kind == "onnx":
        from dynslam_bench.segmentation.networks.onnx_segmenter import OnnxSegmenter

        OnnxSegmenter(path, settings)
    else:
        from dynslam_bench.segmentation.networks.loading import load_network

        load_network(path)
