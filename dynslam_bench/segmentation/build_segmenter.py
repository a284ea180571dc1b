"""Segmenters: the registry, the choice of a source for a sequence, construction, and masks from the stage cache.

What reads or cleans masks needs OpenCV and is imported where it is used, so that the registry can be
listed without it.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from dynslam_bench.contracts import (
    ForgetsFrames,
    Frame,
    Instances,
    MaskSource,
    Segmenter,
    SegmenterContext,
    SegmenterSpec,
    Sequence,
)
from dynslam_bench.core import SegmentationError, translate_errors
from dynslam_bench.core.fingerprint import content_digest, machine_digest, path_digest
from dynslam_bench.core.plugins import Registry, build_plugin
from dynslam_bench.core.records import digest
from dynslam_bench.core.settings import Settings
from dynslam_bench.core.stage_cache import Arrays, ReadsSoFar, StageCache, stage_code
from dynslam_bench.segmentation.networks.checkpoints import (
    CHECKPOINTS,
    COCO,
    SELFIE,
    Checkpoint,
    cached_checkpoint,
    embedded_weights,
    fetch_checkpoint,
)
from dynslam_bench.segmentation.settings import (
    COCO_NAMES,
    SegmentationSettings,
    canonical_name,
    check_classes,
)

__all__ = ["SEGMENTERS", "SegmenterContext", "SegmenterSpec"]

LOWEST_CONFIDENCE = 0.1
"""Networks report detections down to this score, so that the confidence may be changed while a run lasts."""
NETWORKS = frozenset({"embedded", "coco", "onnx", "weights", "plugin"})
"""Sources whose masks depend on the colour image alone; those of a network of maps also depend on earlier ones."""


def _builtin() -> Iterable[SegmenterSpec]:
    """The specs of the segmenters in this package."""
    recorded = "dynslam_bench.segmentation.recorded"
    networks = "dynslam_bench.segmentation.networks"
    mask_rcnn = "He et al., Mask R-CNN, ICCV 2017"
    return (
        SegmenterSpec("oracle", f"{recorded}:build_oracle", "exact masks of rendered sequences"),
        SegmenterSpec(
            "oracle-classes",
            f"{recorded}:build_oracle",
            "exact masks of rendered sequences, by class alone: a perfect network",
        ),
        SegmenterSpec(
            "recorded", f"{recorded}:build_recorded", "PNG masks from a folder (recorded:DIR)"
        ),
        SegmenterSpec(
            "onnx",
            f"{networks}.onnx_segmenter:build",
            "YOLO-seg, semantic or torchvision networks (onnx:PATH)",
        ),
        SegmenterSpec(
            "tflite",
            f"{networks}.tflite_segmenter:build",
            "networks of probability maps in TensorFlow Lite files (tflite:PATH)",
        ),
        SegmenterSpec(
            "selfie",
            f"{networks}.tflite_segmenter:build_selfie",
            "MediaPipe's selfie segmentation: people indoors, 0.25 MB",
            "Apache-2.0 (weights)",
        ),
        SegmenterSpec(
            "embedded",
            f"{networks}.mask_rcnn_segmenter:build_embedded",
            "small CFPN Mask R-CNN trained on rendered sequences",
            "MIT",
            mask_rcnn,
        ),
        SegmenterSpec(
            "coco",
            f"{networks}.mask_rcnn_segmenter:build_coco",
            "Mask R-CNN, ResNet-50 FPN, with torchvision's COCO weights",
            "BSD-3-Clause (weights)",
            mask_rcnn,
        ),
        SegmenterSpec(
            "weights",
            f"{networks}.mask_rcnn_segmenter:build_weights",
            "Mask R-CNN with weights of your own (weights:PATH)",
            "",
            mask_rcnn,
        ),
    )


SEGMENTERS: Registry[SegmenterSpec] = Registry("segmenters", SegmenterSpec, _builtin)
"""Segmenters by id: built in, from entry points ``dynslam_bench.segmenters``, from the environment variable."""


class NetworkNotFetched(SegmentationError):
    """``auto`` needs a network that is not in the cache; the user is asked before it is downloaded."""

    checkpoint: Checkpoint = COCO


def resolve_source(
    settings: SegmentationSettings,
    sequence_id: str = "",
    masks: MaskSource | None = None,
    *,
    optional: bool = False,
) -> str:
    """Resolve `settings.source` for a sequence to the label that is stored with results.

    Args:
        settings: The settings with the source.
        sequence_id: Id of the sequence, for ``auto``.
        masks: Exact masks of the sequence, if it has them.
        optional: Whether the tracker also works without masks, for the hint.

    Returns:
        ``auto`` becomes ``embedded`` or ``coco``; everything else stays as it is.

    Raises:
        NetworkNotFetched: ``auto`` needs the COCO checkpoint, which is not in the cache; lists the
            alternatives with their sizes and licences.
    """
    if settings.source != "auto":
        return settings.source

    # auto: the embedded network on what it was trained for, else the COCO checkpoint if it is there;
    # the small network is worse than no masks on some recordings: the user has to name it
    if sequence_id.startswith("synthetic/"):
        return "embedded"
    if cached_checkpoint(COCO) is not None:
        return "coco"

    # neither: list what the user may choose
    options = [
        f"--yes (run, bench) or segmentation.source=coco downloads it once ({COCO.license})",
        f"segmentation.source=selfie downloads a small network of people indoors ({SELFIE.megabytes:g} MB, "
        f"{SELFIE.license})",
        "segmentation.source=onnx:PATH takes your export of a network, e.g. of YOLO-seg",
        "segmentation.source=recorded:DIR takes masks that were stored before",
    ]
    if masks is not None:
        options.append("segmentation.source=oracle takes the sequence's exact masks")
    if optional:
        options.append("without masks: segmentation.source=none")
    else:
        options.append("without masks: a tracker such as 'emfoa-oft?masks=none' or orb-slam2")
    raise NetworkNotFetched(
        f"no masks for '{sequence_id or 'this sequence'}': segmentation.source=auto needs "
        f"the COCO checkpoint ({COCO.megabytes:g} MB), which is not in the cache",
        options=options,
    )


def segmentation_source(settings: Settings, sequence: Sequence, *, fetch: bool = True) -> str:
    """The source of a tracker's masks on a sequence, checked before anything runs.

    Args:
        settings: A tracker's settings.
        sequence: The sequence it will run on.
        fetch: Download a published checkpoint now if it is the source and not in the cache.

    Returns:
        The resolved source; empty for a tracker without a semantic stage.

    Raises:
        SegmentationError: The file is missing or holds no network, masks of frames are missing, the
            sequence has no exact masks, or ``auto`` has no source.
        PluginError: ``plugin:ID`` names no segmenter.
    """
    group = getattr(settings, "segmentation", None)
    if not isinstance(group, SegmentationSettings):
        return ""

    # masks are optional for a tracker that has none by default
    default = type(settings).model_fields["segmentation"].get_default(call_default_factory=True)
    optional = isinstance(default, SegmentationSettings) and default.source == "none"
    source = resolve_source(group, sequence.id, sequence.masks, optional=optional)

    # check what the source needs
    kind, _, argument = source.partition(":")
    if kind in ("oracle", "oracle-classes"):
        _load(kind, group, SegmenterContext(sequence.id, sequence.masks))
        _check_oracle(kind, group, sequence)
    elif kind == "recorded":
        _check_recorded(Path(argument), group, sequence)
    elif kind in ("onnx", "tflite", "weights"):
        path = Path(argument).expanduser()
        stat = path.stat() if path.is_file() else None
        _check_network(kind, argument, group, stat and (stat.st_size, stat.st_mtime_ns))
    elif kind == "embedded" and not embedded_weights().is_file():
        raise SegmentationError(
            "the embedded network's weights are missing from this installation", "reinstall it"
        )
    elif kind in CHECKPOINTS and fetch:
        fetch_checkpoint(CHECKPOINTS[kind])
    elif kind == "plugin":
        SEGMENTERS.get(argument)
    return source


def _check_recorded(folder: Path, settings: SegmentationSettings, sequence: Sequence) -> None:
    """Compare a folder of recorded masks with the dynamic classes and the frames; warn where it shows no object.

    Raises:
        SegmentationError: No class is a dynamic one, or masks of frames are missing.
    """
    # the module needs OpenCV
    from dynslam_bench.segmentation.recorded import RecordedSegmenter

    recorded = RecordedSegmenter(folder)
    check_classes(
        recorded.class_names, settings, str(recorded.folder), "the folder of recorded masks"
    )

    # every frame that is segmented needs a file: all, but for the only schedule known beforehand
    missing = recorded.missing(sequence.timestamps)
    if settings.schedule == "every_nth" and settings.crowded_share >= 1:
        missing = [index for index in missing if index % settings.n == 0]
    if missing:
        raise SegmentationError(
            f"the folder of recorded masks {folder} has none for {len(missing)} of {len(sequence)} frames of "
            f"'{sequence.id}', the first is frame {missing[0]} ({sequence.timestamps[missing[0]]:.6f} s)",
            "is it of another sequence, or of another part?",
        )

    changed = recorded.folder.stat().st_mtime_ns
    stamps = tuple(sequence.timestamps.tolist())
    if not _shows_objects(recorded.folder, changed, settings.class_names(), stamps):
        warnings.warn(
            f"the recorded masks in {recorded.folder} show no object of the classes {settings.classes} in any of "
            f"{len(sequence)} frames of '{sequence.id}'",
            stacklevel=2,
        )


@lru_cache(maxsize=16)
def _shows_objects(
    folder: Path, changed: int, classes: frozenset[str], stamps: tuple[float, ...]
) -> bool:
    """Whether recorded masks show an object; read once a process, as long as no file comes or goes (`changed`)."""
    # the module needs OpenCV
    from dynslam_bench.segmentation.recorded import RecordedSegmenter

    return RecordedSegmenter(folder).first_object(np.array(stamps), classes) is not None


def _check_oracle(kind: str, settings: SegmentationSettings, sequence: Sequence) -> None:
    """Compare the dynamic classes with the names of the exact masks, where nothing else selects objects.

    Raises:
        SegmentationError: A dynamic class that COCO does not have is none of the sequence's, too.
    """
    not_coco = settings.class_names().difference(COCO_NAMES)
    if sequence.masks is None or not (not_coco or kind == "oracle-classes"):
        return
    # the module needs OpenCV
    from dynslam_bench.segmentation.recorded import exact_masks

    names = exact_masks(sequence.masks, 0).class_names.values()
    try:
        check_classes(names, settings, sequence.id, "the sequence")
    except SegmentationError as error:
        if not_coco:
            raise
        # a scene without people is no fault
        warnings.warn(str(error), stacklevel=2)


@lru_cache(maxsize=16)
def _check_network(
    kind: str, argument: str, settings: SegmentationSettings, stamp: tuple[int, int] | None
) -> None:
    """Load a network once a process, as long as size and time of its file (`stamp`) stay."""
    _load(kind, settings, SegmenterContext(argument=argument))


def build_segmenter(
    settings: SegmentationSettings,
    *,
    sequence_id: str = "",
    masks: MaskSource | None = None,
    device: str = "cpu",
    threads: int = 1,
    cache: StageCache | None = None,
    also: frozenset[str] = frozenset(),
) -> ConfiguredSegmenter | None:
    """The segmenter that the settings ask for; None for source ``none``.

    Args:
        settings: Source, classes and thresholds.
        sequence_id: Id of the sequence, for ``auto`` and messages.
        masks: Exact masks of the sequence, for ``oracle``.
        device: ``cpu`` or ``cuda:N``, for networks that run in torch.
        threads: Threads a network may use.
        cache: Where the masks of networks are stored; selection by class and confidence comes after
            it, so that studies over them share its entries. A network whose file exists is loaded
            only when a frame needs it.
        also: Further classes whose objects are returned, although they are not dynamic by
            themselves.

    Raises:
        SegmentationError: The source is not available here, or its file does not fit.
        PluginError: ``plugin:ID`` names no segmenter.
    """
    source = resolve_source(settings, sequence_id, masks)
    if source == "none":
        return None
    kind, _, argument = source.partition(":")
    name = kind
    if kind == "plugin":
        name = argument
        argument = ""
    floor = min(LOWEST_CONFIDENCE, settings.confidence)
    context = SegmenterContext(sequence_id, masks, device, threads, argument, floor)
    # a network looks for the further classes, too
    sought = settings.model_copy(
        update={"classes": ",".join(sorted(settings.class_names() | also))}
    )

    # masks of networks are stored, if their code is known
    code = None
    if cache is not None and kind in NETWORKS:
        code = stage_code(SEGMENTERS.get(name).entry_point)
    if cache is None or code is None:
        return ConfiguredSegmenter(_load(name, sought, context), settings, source, also)

    # what the stored masks and their cost depend on besides the image and the code
    identity = {
        "source": source,
        "weights": weights_digest(settings, sequence_id),
        "confidence": floor,
        "settings": sought.model_dump(
            include={
                "mask_threshold",
                "classes",
                "network_side",
                "onnx_normalisation",
                "onnx_layout",
            }
        ),
        "device": device,
        "threads": threads,
    }
    cached = CachedSegmenter(partial(_load, name, sought, context), identity, cache, code)
    # without a file there is nothing to wait for; masks that depend on earlier frames are not stored
    if not identity["weights"]:
        network = cached.network()
        if isinstance(network, ForgetsFrames):
            return ConfiguredSegmenter(network, settings, source, also)
    return ConfiguredSegmenter(cached, settings, source, also)


def _load(name: str, settings: SegmentationSettings, context: SegmenterContext) -> Segmenter:
    """Construct a registered segmenter."""
    spec = SEGMENTERS.get(name)
    protocol: type[Segmenter] = Segmenter  # type: ignore[type-abstract]
    return build_plugin(
        "segmenter", spec, protocol, SegmentationError, lambda build: build(settings, context)
    )


class SharedNetwork:
    """Loads a network at its first call; copies share it, and what was pickled loads it again.

    Args:
        load: Returns the network.
    """

    def __init__(self, load: Callable[[], Segmenter]) -> None:
        self._load = load
        self._network: Segmenter | None = None

    def __call__(self) -> Segmenter:
        """The network."""
        if self._network is None:
            self._network = self._load()
        return self._network

    def __deepcopy__(self, memo: dict[int, Any]) -> SharedNetwork:
        return self

    def __reduce__(self) -> tuple[Any, ...]:
        return SharedNetwork, (self._load,)


class CachedSegmenter:
    """A network whose masks are stored in the stage cache, addressed by the image and by the network's identity.

    Args:
        load: Loads the network, when a frame needs it.
        identity: JSON-able description of network, weights and settings that change its masks, and
            of its cost.
        cache: Where results are stored.
        code: Gives the digest of its code, see `stage_code`.

    Attributes:
        network: Loads the network at its first call and returns it.
        hit: Whether the result of the last call came from the cache.
        saved_s: Seconds to add to the last call's wall time to get its cost without the cache.
    """

    def __init__(
        self, load: Callable[[], Segmenter], identity: object, cache: StageCache, code: ReadsSoFar
    ) -> None:
        self.network = SharedNetwork(load)
        self._cache = cache
        self._code = code
        self._prefix = digest([identity, machine_digest()])
        self.hit = False
        self.saved_s = 0.0

    def segment(self, frame: Frame) -> Instances:
        """The objects in the frame."""
        begin = time.perf_counter()
        # look the image up
        code = self._code()
        key = digest([code, self._prefix, content_digest(frame.rgb)], 32)
        entry = self._cache.get("masks", key)
        self.hit = entry is not None
        if entry is not None:
            instances = _unpack(entry.arrays)
            cost = entry.cost_s
        else:
            # loading the network is no part of the frame's cost
            network = self.network()
            start = time.perf_counter()
            instances = network.segment(frame)
            cost = time.perf_counter() - start
            # store it, unless the network read further code while it ran
            if self._code() == code:
                self._cache.put("masks", key, _pack(instances), cost)
        self.saved_s = cost - (time.perf_counter() - begin)
        return instances


def _pack(instances: Instances) -> Arrays:
    """Objects as arrays for the stage cache, a bit a pixel."""
    arrays: Arrays = {
        "masks": np.packbits(instances.masks),
        "shape": np.array(instances.masks.shape),
        "boxes": instances.boxes,
        "class_names": np.array(instances.class_names, dtype=np.str_),
        "scores": instances.scores,
    }
    return arrays if instances.moving is None else {**arrays, "moving": instances.moving}


def _unpack(stored: Arrays) -> Instances:
    """The objects that `_pack` stored."""
    shape = tuple(stored["shape"].tolist())
    masks = np.unpackbits(stored["masks"], count=int(np.prod(shape))).astype(bool).reshape(shape)
    names = tuple(stored["class_names"].tolist())
    return Instances(masks, stored["boxes"], names, stored["scores"], stored.get("moving"))


class ConfiguredSegmenter:
    """A segmenter whose objects are selected by the settings in force.

    Args:
        inner: The segmenter.
        settings: Selects among the objects; may be replaced while a run lasts.
        source: Label stored with results.
        also: Names of further classes that pass.
    """

    def __init__(
        self,
        inner: Segmenter,
        settings: SegmentationSettings,
        source: str,
        also: frozenset[str] = frozenset(),
    ) -> None:
        self.inner = inner
        self.settings = settings
        self.source = source
        self.also = also
        self._unknown_classes: set[str] = set()

    def reset(self) -> None:
        """Begin a new sequence: a segmenter that remembers frames forgets them."""
        if isinstance(self.inner, ForgetsFrames):
            self.inner.reset()

    def segment(self, frame: Frame) -> Instances:
        """The objects of the frame that count: see `postprocess.select`.

        Raises:
            SegmentationError: The segmenter gave no `Instances`, or masks of another size than the
                frame.
        """
        # the module needs OpenCV
        from dynslam_bench.segmentation.postprocess import select

        # check what a plug-in may get wrong
        instances = self.inner.segment(frame)
        if not isinstance(instances, Instances):
            raise SegmentationError(
                f"{self.source} gave {type(instances).__name__} instead of Instances"
            )
        count = len(instances.class_names)
        size = frame.rgb.shape[:2]
        shapes = [np.shape(part) for part in (instances.masks, instances.boxes, instances.scores)]
        if shapes != [(count, *size), (count, 4), (count,)] or not isinstance(
            instances.masks, np.ndarray
        ):
            raise SegmentationError(
                f"{self.source} gave {count} objects with masks of shape {shapes[0]}, boxes of shape {shapes[1]} and "
                f"scores of shape {shapes[2]}, the frame is {size[1]}x{size[0]}",
                "masks must be an array [K, H, W] at the frame's size, boxes [K, 4], scores [K]",
            )
        if not np.isfinite(instances.boxes).all():
            raise SegmentationError(
                f"{self.source} gave boxes that are not finite", "give every object a finite box"
            )

        # class names as the settings write them, then the selection
        names = tuple(canonical_name(str(name)) for name in instances.class_names)
        instances = replace(instances, class_names=names)
        self._warn_of_unknown_classes(names)
        return select(instances, self.settings, self.also)

    def _warn_of_unknown_classes(self, names: Iterable[str]) -> None:
        """Warn once of each name of a plug-in's that is neither COCO's nor asked for."""
        if not self.source.startswith("plugin:"):
            return
        expected = self.settings.class_names().union(self.also, COCO_NAMES, self._unknown_classes)
        for name in sorted(set(names) - expected):
            self._unknown_classes.add(name)
            warnings.warn(
                f"{self.source} found '{name}', which is no COCO class and not among segmentation.classes "
                f"({self.settings.classes}): its objects are not masked",
                stacklevel=2,
            )


def weights_digest(
    settings: SegmentationSettings, sequence_id: str = "", masks: MaskSource | None = None
) -> str:
    """Digest of the segmenter's file; part of a run's identity.

    Returns:
        The first 12 hexadecimal digits of the SHA-256 of the network's file, or of the names and
        contents of recorded masks; empty for sources without a file.

    Raises:
        SegmentationError: The file cannot be read.
    """
    kind, _, argument = resolve_source(settings, sequence_id, masks).partition(":")
    path = None
    if kind == "embedded":
        path = embedded_weights()
    elif kind in CHECKPOINTS:
        path = cached_checkpoint(CHECKPOINTS[kind])
        if path is None:
            return CHECKPOINTS[kind].sha256_prefix[:12]
    elif kind in ("onnx", "tflite", "weights", "recorded"):
        path = Path(argument).expanduser()
    with translate_errors(SegmentationError, f"cannot read {path}"):
        return path_digest(path)[:12] if path is not None and path.exists() else ""
