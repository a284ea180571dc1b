"""Segmenters: the registry, the choice of a source for a sequence, and construction."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import cached_property, lru_cache
from pathlib import Path

from dynslam_bench.contracts.segmenter import Instances, Segmenter, SegmenterContext, SegmenterSpec
from dynslam_bench.contracts.sequence import Frame, MaskSource, Sequence
from dynslam_bench.core.errors import DynslamError, SegmentationError
from dynslam_bench.core.fingerprint import path_digest
from dynslam_bench.core.plugins import Registry, load_object
from dynslam_bench.core.settings import Settings
from dynslam_bench.segmentation.networks.checkpoints import (
    COCO,
    Checkpoint,
    cached_checkpoint,
    embedded_weights,
    fetch_checkpoint,
    require_embedded_weights,
)
from dynslam_bench.segmentation.settings import SegmentationSettings

__all__ = ["SEGMENTERS", "SegmenterContext", "SegmenterSpec"]

LOWEST_CONFIDENCE = 0.1
"""Networks report detections down to this score, so that the confidence may be changed while a run lasts."""


def _builtin() -> Iterable[SegmenterSpec]:
    here = "dynslam_bench.segmentation.build_segmenter"
    mask_rcnn = "He et al., Mask R-CNN, ICCV 2017"
    return (
        SegmenterSpec("oracle", f"{here}:build_oracle", "exact masks of rendered sequences"),
        SegmenterSpec("oracle-classes", f"{here}:build_oracle",
                      "exact masks of rendered sequences, by class alone: a perfect network"),
        SegmenterSpec("recorded", f"{here}:build_recorded", "PNG masks from a folder (recorded:DIR)"),
        SegmenterSpec("onnx", f"{here}:build_onnx", "YOLO-seg, semantic or torchvision networks (onnx:PATH)"),
        SegmenterSpec("embedded", f"{here}:build_embedded", "small CFPN Mask R-CNN trained on rendered sequences",
                      "MIT", mask_rcnn),
        SegmenterSpec("coco", f"{here}:build_coco", "Mask R-CNN, ResNet-50 FPN, with torchvision's COCO weights",
                      "BSD-3-Clause (weights)", mask_rcnn),
        SegmenterSpec("weights", f"{here}:build_weights", "Mask R-CNN with weights of your own (weights:PATH)",
                      "", mask_rcnn),
    )  # fmt: skip


SEGMENTERS: Registry[SegmenterSpec] = Registry("segmenters", SegmenterSpec, _builtin)
"""Segmenters by id: built in, from entry points ``dynslam_bench.segmenters``, from the environment variable."""


class NetworkNotFetched(SegmentationError):
    """``auto`` needs a network that is not in the cache; the user is asked before it is downloaded."""

    checkpoint: Checkpoint = COCO


def resolve_source(
    settings: SegmentationSettings, sequence_id: str = "", masks: MaskSource | None = None, *, optional: bool = False
) -> str:
    """What `settings.source` means for a sequence; the label stored with results.

    Args:
        settings: The settings with the source.
        sequence_id: Id of the sequence, for ``auto``.
        masks: Exact masks of the sequence, if it has them.
        optional: Whether the tracker also works without masks, for the hint.

    Returns:
        ``auto`` becomes ``embedded``, ``oracle`` or ``coco``; everything else stays as it is.

    Raises:
        NetworkNotFetched: ``auto`` needs the COCO checkpoint, which is not in the cache; lists the alternatives.
    """
    if settings.source != "auto":
        return settings.source
    if sequence_id.startswith("synthetic/"):
        if embedded_weights() is not None:
            return "embedded"
        if masks is not None:
            return "oracle"
    if cached_checkpoint(COCO) is not None:
        return "coco"
    options = [
        "--yes (run, bench) or segmentation.source=coco downloads it once",
        "segmentation.source=onnx:PATH takes your export of a network, e.g. of YOLO-seg",
        "segmentation.source=recorded:DIR takes masks that were stored before",
    ]
    if masks is not None:
        options.append("segmentation.source=oracle takes the sequence's exact masks")
    without = "segmentation.source=none" if optional else "a tracker such as 'emfoa-oft?masks=none' or orb-slam2"
    options.append(f"without masks: {without}")
    raise NetworkNotFetched(
        f"no masks for '{sequence_id or 'this sequence'}': segmentation.source=auto needs "
        f"the COCO checkpoint ({COCO.megabytes} MB), which is not in the cache",
        options=options,
    )


def segmentation_source(settings: Settings, sequence: Sequence, *, fetch: bool = True) -> str:
    """The source of a tracker's masks on a sequence, checked before anything runs.

    Args:
        settings: A tracker's settings.
        sequence: The sequence it will run on.
        fetch: Download the COCO checkpoint now if that is the source and it is not in the cache.

    Returns:
        The resolved source; empty for a tracker without a semantic stage.

    Raises:
        SegmentationError: The file is missing or holds no network, masks of frames are missing, the sequence has no
            exact masks, or ``auto`` has no source.
        PluginError: ``plugin:ID`` names no segmenter.
    """
    group = getattr(settings, "segmentation", None)
    if not isinstance(group, SegmentationSettings):
        return ""
    default = type(settings).model_fields["segmentation"].get_default(call_default_factory=True)
    optional = isinstance(default, SegmentationSettings) and default.source == "none"
    source = resolve_source(group, sequence.id, sequence.masks, optional=optional)
    kind, _, argument = source.partition(":")
    path = Path(argument).expanduser()
    if kind in ("oracle", "oracle-classes"):
        build_oracle(group, SegmenterContext(sequence.id, sequence.masks))
    elif kind == "recorded":
        _check_recorded(path, group, sequence)
    elif kind in ("onnx", "weights"):
        stat = path.stat() if path.is_file() else None
        _check_network(kind, path, group, stat and (stat.st_size, stat.st_mtime_ns))
    elif kind == "embedded":
        require_embedded_weights()
    elif kind == "coco" and fetch:
        fetch_checkpoint(COCO)
    elif kind == "plugin":
        SEGMENTERS.get(argument)
    return source


def _check_recorded(folder: Path, settings: SegmentationSettings, sequence: Sequence) -> None:
    from dynslam_bench.segmentation.recorded import RecordedSegmenter

    missing = RecordedSegmenter(folder).missing(sequence.timestamps)
    if settings.schedule == "every_nth" and settings.crowded_share >= 1:  # the only schedule that is known beforehand
        missing = [index for index in missing if index % settings.n == 0]
    if missing:
        raise SegmentationError(
            f"the folder of recorded masks {folder} has none for {len(missing)} of {len(sequence)} frames of "
            f"'{sequence.id}', the first is frame {missing[0]} ({sequence.timestamps[missing[0]]:.6f} s)",
            "is it of another sequence, or of another part?",
        )


@lru_cache(maxsize=16)
def _check_network(kind: str, path: Path, settings: SegmentationSettings, stamp: tuple[int, int] | None) -> None:
    """Load a network once a process, as long as size and time of its file (`stamp`) stay."""
    if kind == "onnx":
        from dynslam_bench.segmentation.networks.onnx_segmenter import OnnxSegmenter

        OnnxSegmenter(path, settings)
    else:
        from dynslam_bench.segmentation.networks.loading import load_network

        load_network(path)


def build_segmenter(
    settings: SegmentationSettings,
    *,
    sequence_id: str = "",
    masks: MaskSource | None = None,
    device: str = "cpu",
    threads: int = 1,
    deferred: bool = False,
    also: frozenset[str] = frozenset(),
) -> ConfiguredSegmenter | None:
    """The segmenter that the settings ask for; None for source ``none``.

    Args:
        settings: Source, classes and thresholds.
        sequence_id: Id of the sequence, for ``auto`` and messages.
        masks: Exact masks of the sequence, for ``oracle``.
        device: ``cpu`` or ``cuda:N``, for networks that run in torch.
        threads: Threads a network may use.
        deferred: Load a network whose file exists only when a frame needs it: with the stage cache none may.
        also: Further classes whose objects are returned, although they are not dynamic by themselves.

    Raises:
        SegmentationError: The source is not available here, or its file does not fit.
        PluginError: ``plugin:ID`` names no segmenter.
    """
    source = resolve_source(settings, sequence_id, masks)
    if source == "none":
        return None
    prefix, _, argument = source.partition(":")
    name, argument = (argument, "") if prefix == "plugin" else (prefix, argument)
    spec = SEGMENTERS.get(name)
    context = SegmenterContext(
        sequence_id, masks, device, threads, argument, min(LOWEST_CONFIDENCE, settings.confidence)
    )

    def load() -> Segmenter:
        try:
            segmenter = load_object(spec.entry_point)(settings, context)
        except DynslamError:
            raise
        except Exception as error:  # a plug-in's factory may raise anything
            raise SegmentationError(
                f"segmenter '{spec.id}' cannot be built: {type(error).__name__}: {error}"
            ) from error
        if not isinstance(segmenter, Segmenter):
            raise SegmentationError(f"'{spec.entry_point}' gave a {type(segmenter).__name__} without segment()")
        return segmenter

    waits = deferred and prefix in ("embedded", "coco", "onnx", "weights") and weights_digest(settings, sequence_id)
    return ConfiguredSegmenter(DeferredSegmenter(load) if waits else load(), settings, source, also)


class DeferredSegmenter:
    """A segmenter that is loaded when the first frame asks for it.

    Args:
        load: Loads it; raises `SegmentationError` if the network's file does not fit.
    """

    def __init__(self, load: Callable[[], Segmenter]) -> None:
        self._load = load

    @cached_property
    def segmenter(self) -> Segmenter:
        """The segmenter itself."""
        return self._load()

    def segment(self, frame: Frame) -> Instances:
        """The objects in the frame."""
        return self.segmenter.segment(frame)


class ConfiguredSegmenter:
    """A segmenter whose objects are selected by the settings in force.

    Args:
        inner: Segments.
        settings: Selects among the objects; may be replaced while a run lasts.
        source: Label stored with results.
        also: Names of further classes that pass.
    """

    def __init__(
        self, inner: Segmenter, settings: SegmentationSettings, source: str, also: frozenset[str] = frozenset()
    ) -> None:
        self.inner, self.settings, self.source, self.also = inner, settings, source, also

    def segment(self, frame: Frame) -> Instances:
        """The objects of the frame that count: see `postprocess.select`.

        Raises:
            SegmentationError: The segmenter gave masks of another size than the frame.
        """
        from dynslam_bench.segmentation.postprocess import select  # needs OpenCV, which the registry does not

        instances = self.inner.segment(frame)
        if instances.masks.shape[1:] != frame.rgb.shape[:2] or len(instances.masks) != len(instances):
            raise SegmentationError(
                f"{self.source} gave {len(instances)} objects with masks of shape {instances.masks.shape}, the frame "
                f"is {frame.rgb.shape[1]}x{frame.rgb.shape[0]}",
                "masks must be [K, H, W] at the frame's size",
            )
        return select(instances, self.settings, self.also)


def weights_digest(settings: SegmentationSettings, sequence_id: str = "", masks: MaskSource | None = None) -> str:
    """Digest of the segmenter's file; part of a run's identity.

    Returns:
        The first 12 hexadecimal digits of the SHA-256 of the network's file, or of the names and contents of recorded
        masks; empty for sources without a file.

    Raises:
        SegmentationError: The file cannot be read.
    """
    prefix, _, argument = resolve_source(settings, sequence_id, masks).partition(":")
    path: Path | None = None
    if prefix == "embedded":
        path = embedded_weights()
    elif prefix == "coco":
        path = cached_checkpoint(COCO)
        if path is None:
            return COCO.sha256_prefix
    elif prefix in ("onnx", "weights", "recorded"):
        path = Path(argument).expanduser()
    try:
        return path_digest(path)[:12] if path is not None and path.exists() else ""
    except OSError as error:
        raise SegmentationError(f"cannot read {error.filename}: {error.strerror}") from error


def build_oracle(settings: SegmentationSettings, context: SegmenterContext) -> Segmenter:
    """Exact masks of the sequence; ``oracle`` also returns what moves, whatever its class.

    Raises:
        SegmentationError: The sequence has no exact masks.
    """
    from dynslam_bench.segmentation.recorded import OracleSegmenter

    if context.masks is None:
        raise SegmentationError(
            f"segmentation.source={settings.source}: sequence '{context.sequence_id}' has no exact masks",
            "only synthetic/* has them; use coco, onnx:PATH or recorded:DIR",
        )
    return OracleSegmenter(context.masks, motion=settings.source != "oracle-classes")


def build_recorded(settings: SegmentationSettings, context: SegmenterContext) -> Segmenter:
    """Masks from a folder."""
    from dynslam_bench.segmentation.recorded import RecordedSegmenter

    return RecordedSegmenter(Path(context.argument))


def build_onnx(settings: SegmentationSettings, context: SegmenterContext) -> Segmenter:
    """A network from an ONNX file."""
    from dynslam_bench.segmentation.networks.onnx_segmenter import OnnxSegmenter

    return OnnxSegmenter(Path(context.argument), settings, threads=context.threads, floor=context.floor)


def build_embedded(settings: SegmentationSettings, context: SegmenterContext) -> Segmenter:
    """The small network in this package, at the input size that it was trained with."""
    return _mask_rcnn(require_embedded_weights(), settings.model_copy(update={"network_side": 0}), context)


def build_coco(settings: SegmentationSettings, context: SegmenterContext) -> Segmenter:
    """Torchvision's COCO checkpoint, downloaded on first use."""
    return _mask_rcnn(fetch_checkpoint(COCO), settings, context)


def build_weights(settings: SegmentationSettings, context: SegmenterContext) -> Segmenter:
    """A Mask R-CNN checkpoint of the user's."""
    return _mask_rcnn(Path(context.argument), settings, context)


def _mask_rcnn(path: Path, settings: SegmentationSettings, context: SegmenterContext) -> Segmenter:
    from dynslam_bench.segmentation.networks.mask_rcnn_segmenter import MaskRCNNSegmenter

    return MaskRCNNSegmenter.from_file(
        path, settings, device=context.device, threads=context.threads, floor=context.floor
    )
