"""Our networks for other runtimes: fixed shapes give the same objects, and so does the ONNX file, if it can be made."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from dynslam_bench.contracts.sequence import Frame
from dynslam_bench.core.errors import SegmentationError
from dynslam_bench.segmentation.networks import onnx_export as static
from dynslam_bench.segmentation.networks.backbone import NetworkConfig
from dynslam_bench.segmentation.networks.boxes import box_iou, nms
from dynslam_bench.segmentation.networks.mask_rcnn_segmenter import MaskRCNNSegmenter
from dynslam_bench.segmentation.networks.network import MaskRCNN
from dynslam_bench.segmentation.networks.onnx_export import (
    StaticMaskRCNN,
    export_network,
    parse_size,
    unsuppressed,
    write_onnx,
)
from dynslam_bench.segmentation.networks.onnx_segmenter import OnnxSegmenter
from dynslam_bench.segmentation.settings import NMS_IOU, SegmentationSettings

SETTINGS = SegmentationSettings(network_side=0)
CLASSES = ("person", "chair", "dog")


def tiny(**changes: object) -> MaskRCNN:
    """A random network of three classes that finds some things in noise."""
    torch.manual_seed(3)
    config = NetworkConfig(
        blocks=(1, 1, 1, 1), bottleneck=False, stem=8, channels=16, classes=CLASSES, box_hidden=32, mask_channels=8,
        mask_layers=1, mask_pool=7, min_side=96, max_side=160, pre_nms=60, post_nms=40, max_detections=8, norm="batch",
        anchor_sizes=(16.0, 24.0, 32.0, 64.0, 96.0), **changes,
    )  # fmt: skip
    network = MaskRCNN(config).eval()
    with torch.no_grad():
        network.roi_heads.box_predictor.cls_score.weight.mul_(40)
        network.rpn.head.cls_logits.weight.mul_(40)
    return network


def noise(height: int, width: int) -> np.ndarray:
    coarse = torch.rand(1, 3, 6, 8, generator=torch.Generator().manual_seed(5))
    smooth = torch.nn.functional.interpolate(coarse, size=(height, width), mode="bilinear")
    return (smooth[0].permute(1, 2, 0).numpy() * 255).astype(np.uint8)


def objects(found: tuple[torch.Tensor, ...], threshold: float) -> list[tuple[str, float, np.ndarray, np.ndarray]]:
    boxes, labels, scores, masks = found
    rows = [
        (CLASSES[int(label) - 1], float(score), box.numpy(), mask[0].numpy() >= threshold)
        for box, label, score, mask in zip(boxes, labels, scores, masks, strict=True)
        if score > 0
    ]
    return [row for row in rows if row[3].any()]


@pytest.mark.parametrize("exact", [True, False])
def test_fixed_shapes_give_the_same_objects(exact: bool) -> None:
    network = tiny(exact_paste=exact)
    settings = SETTINGS.model_copy(update={"classes": ",".join(CLASSES)})
    image = noise(120, 160)
    expected = MaskRCNNSegmenter(network, settings).segment(Frame(0, 0.0, image, np.zeros((120, 160), np.float32)))
    with torch.no_grad():
        found = StaticMaskRCNN(network, 120, 160, score=0.1, iou=NMS_IOU)(
            torch.from_numpy(image).permute(2, 0, 1)[None].float() / 255
        )
    rows = objects(found, settings.mask_threshold)
    assert len(rows) == len(expected.scores) >= 3
    assert [row[0] for row in rows] == list(expected.class_names)
    assert np.abs(np.array([row[1] for row in rows]) - expected.scores).max() < 1e-5
    assert np.abs(np.array([row[2] for row in rows]) - expected.boxes).max() < 1e-3
    for row, mask in zip(rows, expected.masks, strict=True):
        assert np.logical_xor(row[3], mask).sum() < 0.03 * max(
            mask.sum(), 20
        )  # OpenCV interpolates at 32nds of a pixel


def test_suppression_in_rounds_is_the_greedy_one() -> None:
    generator = torch.Generator().manual_seed(0)
    corner = torch.rand(120, 2, generator=generator) * 60
    boxes = torch.cat([corner, corner + 5 + 20 * torch.rand(120, 2, generator=generator)], dim=1)
    scores = torch.linspace(1, 0.1, 120)
    kept = unsuppressed(box_iou(boxes, boxes) > 0.3, torch.ones(120))
    assert torch.nonzero(kept)[:, 0].tolist() == nms(boxes, scores, 0.3).tolist()
    valid = (torch.arange(120) > 0).float()
    without = unsuppressed(box_iou(boxes, boxes) > 0.3, valid)
    assert torch.nonzero(without)[:, 0].tolist() == [1 + i for i in nms(boxes[1:], scores[1:], 0.3).tolist()]


def test_other_runtimes_give_the_same(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The file of a small network in ONNX Runtime, and in OpenCV where that can load it."""
    runtime = pytest.importorskip("onnxruntime", reason="onnxruntime is not installed")
    pytest.importorskip("onnxscript", reason="onnxscript (extra [onnx]) is not installed")
    monkeypatch.setattr(static, "ROUNDS", 4)
    network, path = tiny(exact_paste=True), tmp_path / "tiny.onnx"
    assert write_onnx(network.fuse(), path, size=(120, 160)).classes == {1: "person", 2: "chair", 3: "dog"}
    image = noise(120, 160)
    tensor = torch.from_numpy(image).permute(2, 0, 1)[None].float() / 255
    with torch.no_grad():
        expected = StaticMaskRCNN(network, 120, 160, score=0.1, iou=0.5)(tensor)
    found = runtime.InferenceSession(str(path)).run(None, {"image": tensor.numpy()})
    assert float(expected[2].max()) > 0.1
    for ours, theirs in zip(expected, found, strict=True):
        assert np.abs(ours.numpy() - theirs).max() < 1e-3
    try:
        segmenter = OnnxSegmenter(path, SETTINGS.model_copy(update={"classes": ",".join(CLASSES)}))
    except SegmentationError as error:
        pytest.skip(f"this OpenCV cannot load it: {error}")
    seen = segmenter.segment(Frame(0, 0.0, image, np.zeros((120, 160), np.float32)))
    rows = objects(expected, SETTINGS.mask_threshold)
    assert segmenter.layout.kind == "instances" and sorted(seen.class_names) == sorted(row[0] for row in rows)
    assert np.abs(np.sort(seen.scores) - np.sort([row[1] for row in rows])).max() < 1e-3


def test_what_cannot_be_exported(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    with pytest.raises(SegmentationError, match=r"'yolo' is no network of this project \(export embedded, coco or"):
        export_network("yolo", tmp_path / "x.onnx")
    for text in ("640", "640x8", "x480"):
        with pytest.raises(SegmentationError, match=rf"'{text}' is no size of an image \(for example 640x480"):
            parse_size(text)
    assert parse_size("640x480") == (480, 640)
    monkeypatch.setitem(sys.modules, "onnx", None)
    with pytest.raises(
        SegmentationError, match=r"onnx is not installed \(pip install '\.\[onnx\]' in the checkout of dynslam-bench\)"
    ):
        write_onnx(tiny(), tmp_path / "x.onnx")
