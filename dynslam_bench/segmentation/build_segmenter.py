"""All segmenters by id: built in, from entry points ``dynslam_bench.segmenters``, from the environment variable."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path

from dynslam_bench.contracts.segmenter import Instances, Segmenter, SegmenterContext, SegmenterSpec
from dynslam_bench.contracts.sequence import Frame, MaskSource
from dynslam_bench.core.errors import DynslamError, SegmentationError
from dynslam_bench.core.fingerprint import path_digest
from dynslam_bench.core.plugins import Registry, load_object
from dynslam_bench.segmentation.networks.checkpoints import (
    COCO,
    Checkpoint,
    cached_checkpoint,
    embedded_weights,
    fetch_checkpoint,
)
from dynslam_bench.segmentation.postprocess import select
from dynslam_bench.segmentation.settings import SegmentationSettings

__all__ = ["SEGMENTERS", "SegmenterContext", "SegmenterSpec"]


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


# Choose and construct the segmenter that the settings ask for.

SYNTHETIC = "synthetic/"
LOWEST_CONFIDENCE = 0.1
"""Networks report detections down to this score, so that the confidence may be changed while a run lasts."""


class NetworkNotFetched(SegmentationError):
    """``auto`` needs a network that is not in the cache: fetching it cures that, and is to be agreed to first."""

    checkpoint: Checkpoint = COCO


def resolve_source(
    settings: SegmentationSettings, sequence_id: str = "", masks: MaskSource | None = None, *, optional: bool = False
) -> str:
    """What `settings.source` means for a sequence; the label stored with results.

    Args:
        settings: Whose `source` is resolved.
        sequence_id: Id of the sequence, for ``auto``.
        masks: Its exact masks, if it has them.
        optional: Whether who asks also works without masks, for the hint.

    Returns:
        ``auto`` becomes ``embedded``, ``oracle`` or ``coco``; everything else stays as it is.

    Raises:
        NetworkNotFetched: ``auto`` needs the COCO checkpoint, which is not in the cache; says what else there is.
    """
    if settings.source != "auto":
        return settings.source
    if sequence_id.startswith(SYNTHETIC):
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
    without = (
        "segmentation.source=none" if optional else "a system that needs none, e.g. emfoa-oft-no-masks or orb-slam2"
    )
    options.append(f"without masks: {without}")
    what = f"'{sequence_id}'" if sequence_id else "this sequence"
    raise NetworkNotFetched(
        f"no masks for {what}: segmentation.source=auto needs "
        f"the COCO checkpoint ({COCO.megabytes} MB), which is not in the cache",
        options=options,
    )


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
        also: Names of further classes whose objects are wanted, though nobody holds them for dynamic by themselves.
        deferred: Load a network whose file is there only once a frame needs it; with the stage cache none may.

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
            built = load_object(spec.entry_point)(settings, context)
        except DynslamError:
            raise
        except Exception as error:  # a foreign factory may raise anything; our own raise DynslamError
            raise SegmentationError(
                f"segmenter '{spec.id}' cannot be built: {type(error).__name__}: {error}"
            ) from error
        if not isinstance(built, Segmenter):
            raise SegmentationError(f"'{spec.entry_point}' gave a {type(built).__name__} without segment()")
        return built

    waits = deferred and prefix in ("embedded", "coco", "onnx", "weights") and weights_digest(settings, sequence_id)
    return ConfiguredSegmenter(DeferredSegmenter(load) if waits else load(), settings, source, also)


class DeferredSegmenter:
    """A segmenter that is loaded when the first frame asks for it.

    Args:
        load: Loads it.
    """

    def __init__(self, load: Callable[[], Segmenter]) -> None:
        self._load = load
        self._segmenter: Segmenter | None = None

    def loaded(self) -> Segmenter:
        """The segmenter itself, loaded now if it was not before.

        Raises:
            SegmentationError: The network's file does not fit.
        """
        if self._segmenter is None:
            self._segmenter = self._load()
        return self._segmenter

    def segment(self, frame: Frame) -> Instances:
        """The objects in the frame."""
        return self.loaded().segment(frame)


class ConfiguredSegmenter:
    """A segmenter whose objects are selected by the settings in force.

    Args:
        inner: Finds objects.
        settings: Selects among them; the attribute `settings` may be replaced while a run lasts.
        source: Label stored with results.
        also: Names of further classes that are let through.
    """

    def __init__(
        self, inner: Segmenter, settings: SegmentationSettings, source: str, also: frozenset[str] = frozenset()
    ) -> None:
        self.inner = inner
        self.settings = settings
        self.source = source
        self.also = also

    def segment(self, frame: Frame) -> Instances:
        """The objects of the frame that count: see `select`.

        Raises:
            SegmentationError: The segmenter gave masks of another size than the frame.
        """
        found = self.inner.segment(frame)
        if found.masks.shape[1:] != frame.rgb.shape[:2] or len(found.masks) != len(found):
            raise SegmentationError(
                f"{self.source} gave {len(found)} objects with masks of shape {found.masks.shape}, the frame is "
                f"{frame.rgb.shape[1]}x{frame.rgb.shape[0]}",
                "masks must be [K, H, W] at the frame's size",
            )
        return select(found, self.settings, self.also)


def weights_digest(settings: SegmentationSettings, sequence_id: str = "", masks: MaskSource | None = None) -> str:
    """Digest of the file that decides what the segmenter sees; part of a run's identity.

    Returns:
        The first 12 hexadecimal digits of the SHA-256 of the network's file, or of the names and contents of recorded
        masks; empty for sources without a file.

    Raises:
        SegmentationError: The file cannot be read.
    """
    source = resolve_source(settings, sequence_id, masks)
    prefix, _, argument = source.partition(":")
    path: Path | None = Path(argument).expanduser()
    if prefix == "embedded":
        path = embedded_weights()
    elif prefix == "coco":
        path = cached_checkpoint(COCO)
        if path is None:
            return COCO.sha256_prefix
    elif prefix not in ("onnx", "weights", "recorded"):
        return ""
    if path is None or not path.exists():
        return ""
    try:
        return path_digest(path)[:12]
    except OSError as error:
        raise SegmentationError(f"cannot read {error.filename}: {error.strerror}") from error


def build_oracle(settings: SegmentationSettings, context: SegmenterContext) -> Segmenter:
    """Exact masks of the sequence; with ``oracle`` also of what moves, whatever its class.

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
    """The small network in this package.

    Raises:
        SegmentationError: This installation lacks its weights.
    """
    path = embedded_weights()
    if path is None:
        raise SegmentationError("the embedded network's weights are missing from this installation", "reinstall it")
    return _mask_rcnn(path, settings.model_copy(update={"network_side": 0}), context)


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
