"""All segmenters by id: built in, from entry points ``dynslam_bench.segmenters``, from the environment variable."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from dynslam_bench.contracts.sequence import MaskSource
from dynslam_bench.core.plugins import Registry


@dataclass(frozen=True)
class SegmenterContext:
    """What a segmenter is told of where it runs.

    Attributes:
        sequence_id: Id of the sequence.
        masks: Exact masks of the sequence, for oracles only; None where there are none.
        device: ``cpu`` or ``cuda:N``.
        threads: Threads it may use.
        argument: What stands after the colon of the source, e.g. a path.
        floor: Least score of a detection that is returned; the settings' confidence is applied afterwards.
    """

    sequence_id: str = ""
    masks: MaskSource | None = None
    device: str = "cpu"
    threads: int = 1
    argument: str = ""
    floor: float = 0.1


@dataclass(frozen=True)
class SegmenterSpec:
    """Announces a segmenter; importable without torch or OpenCV.

    Attributes:
        id: For example ``embedded``; users write ``segmentation.source = plugin:ID`` for those that are not built in.
        entry_point: ``"module:factory"``, called as ``factory(settings, context)`` with `SegmentationSettings` and
            `SegmenterContext`; returns a `Segmenter`.
        summary: One line.
        license: Of code and weights, SPDX id or remark.
        citation: What to cite.
    """

    id: str
    entry_point: str
    summary: str = ""
    license: str = ""
    citation: str = ""


def _builtin() -> Iterable[SegmenterSpec]:
    here = "dynslam_bench.segmentation.build_segmenter"
    mask_rcnn = "He et al., Mask R-CNN, ICCV 2017"
    return (
        SegmenterSpec("oracle", f"{here}:build_oracle", "exact masks of rendered sequences"),
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
