"""All segmenters by id: built in, from entry points ``dynslam_bench.segmenters``, from the environment variable."""

from __future__ import annotations

from collections.abc import Iterable

from dynslam_bench.contracts.segmenter import SegmenterContext, SegmenterSpec
from dynslam_bench.core.plugins import Registry

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
