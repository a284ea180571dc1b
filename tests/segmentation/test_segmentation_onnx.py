"""ONNX networks: layouts found from shapes, decoding checked by hand-made outputs, clear errors."""

from copy import deepcopy
from pathlib import Path

import cv2
import numpy as np
import onnx_writer
import pytest

from dynslam_bench.contracts.sequence import Frame
from dynslam_bench.core.errors import SegmentationError
from dynslam_bench.segmentation.build_segmenter import build_segmenter
from dynslam_bench.segmentation.networks.onnx_segmenter import (
    Layout,
    OnnxSegmenter,
    Placement,
    TensorInfo,
    decode,
    detect_layout,
    fit,
    read_header,
)
from dynslam_bench.segmentation.settings import COCO_NAMES, SegmentationSettings

SHARED = Path(__file__).resolve().parents[3] / "shared"
WEIGHTS = SHARED / "weights"
BONN = SHARED / "data" / "bonn" / "rgbd_bonn_crowd"
SETTINGS = SegmentationSettings()


def frame(rgb):
    return Frame(0, 0.0, np.asarray(rgb), np.zeros(np.shape(rgb)[:2], np.float32))


def info(**shapes):
    return [TensorInfo(name, shape) for name, shape in shapes.items()]


YOLO = {"kind": "yolo", "channels_first": True, "objectness": 0}
SHAPES = {"boxes": (None, 4), "labels": (None,), "scores": (None,), "masks": (None, 1, 480, 640)}


@pytest.mark.parametrize(
    ("outputs", "size", "person", "expected"),
    [
        ({"output0": (1, 116, 6300), "output1": (1, 32, 120, 160)}, (480, 640), 0, YOLO),
        (
            {"output0": (1, 6300, 116), "output1": (1, 32, 120, 160)},
            (480, 640),
            0,
            YOLO | {"channels_first": False},
        ),
        (
            {"output0": (1, 25200, 117), "output1": (1, 32, 160, 160)},
            (640, 640),
            0,
            YOLO | {"channels_first": False, "objectness": 1},
        ),
        ({"logits": (1, 21, 31, 41)}, (481, 641), 15, {"kind": "semantic", "aligned": True}),
        ({"out": (1, 21, 480, 640)}, (480, 640), 15, {"kind": "semantic", "aligned": False}),
        (SHAPES, (480, 640), 1, {"kind": "instances"}),
    ],
)
def test_layouts_are_found_from_shapes(outputs, size, person, expected):
    layout = detect_layout(info(**outputs), {}, size, "f")
    assert {name: getattr(layout, name) for name in expected} == expected and layout.names[person] == "person"


def test_names_come_from_the_metadata():
    own = detect_layout(info(a=(1, 38, 2100), b=(1, 32, 60, 80)), {"names": "{0: 'person', 1: 'cat'}"}, (240, 320), "f")
    assert own.names == {0: "person", 1: "cat"}


@pytest.mark.parametrize(
    "outputs",
    [
        {"output0": (1, 1000)},
        {"logits": (1, 7, 60, 80)},
        {"output0": (1, 300, 6)},
        {"output0": (1, 50, 6300), "output1": (1, 32, 120, 160)},
        {},
    ],
)
def test_unknown_outputs_are_named(outputs):
    with pytest.raises(SegmentationError) as error:
        detect_layout(info(**outputs), {}, (480, 640), "net.onnx")
    assert "net.onnx" in str(error.value) and "known: YOLO" in str(error.value)
    for name in outputs:
        assert name in str(error.value)


COCO = Layout("yolo", ("a", "b"), dict(enumerate(COCO_NAMES)))


def yolo_values(boxes, scores, labels, cells=(12, 16), count=50, coefficients=3):
    """Detections of 80 classes whose masks are the first prototype, positive everywhere."""
    rows = np.zeros((count, 84 + coefficients), np.float32)
    for k, (box, score, label) in enumerate(zip(boxes, scores, labels, strict=True)):
        x0, y0, x1, y1 = box
        rows[k, :4] = (x0 + x1) / 2, (y0 + y1) / 2, x1 - x0, y1 - y0
        rows[k, 4 + label] = score
        rows[k, 84] = 5.0
    prototypes = np.zeros((1, coefficients, *cells), np.float32)
    prototypes[0, 0] = 1.0
    return rows.T[None], prototypes


def test_yolo_decoding_cuts_masks_to_boxes_and_suppresses_per_class():
    outputs = yolo_values(
        [(8, 8, 40, 56), (9, 8, 41, 56), (8, 8, 40, 56), (50, 4, 60, 20)], [0.9, 0.8, 0.7, 0.2], [0, 0, 16, 0]
    )
    place = Placement((96, 128), (96, 128))
    found = decode(COCO, outputs, place, SETTINGS, 0.1)
    assert found.class_names == ("person", "person") and found.scores == pytest.approx([0.9, 0.2])
    assert found.boxes[0] == pytest.approx([8, 8, 40, 56])
    assert found.masks[0].sum() == 32 * 48 and found.masks[0][8:56, 8:40].all()
    both = decode(COCO, outputs, place, SegmentationSettings(classes="person,dog"), 0.5)
    assert both.class_names == ("person", "dog")


def test_yolo_letterbox_is_undone():
    outputs = yolo_values([(16, 32, 48, 64)], [0.9], [0], cells=(32, 32))
    image, place = fit(np.zeros((240, 320, 3), np.uint8), (128, 128), keep_aspect=True)
    assert image.shape == (128, 128, 3) and (image[:16] == 114).all() and (image[16:112] == 0).all()
    found = decode(COCO, outputs, place, SETTINGS, 0.1)
    assert found.boxes[0] == pytest.approx([40, 40, 120, 120])
    assert found.masks[0][41:119, 41:119].all() and found.masks[0].sum() == 80 * 80


def test_semantic_decoding_is_argmax_split_into_parts():
    logits = np.zeros((1, 21, 480, 640), np.float32)
    logits[0, 0] = 1.0
    logits[0, 15, 100:200, 50:150] = 4.0
    logits[0, 15, 300:400, 400:600] = 4.0
    logits[0, 9, 250:280, 10:40] = 4.0
    layout = detect_layout(info(out=logits.shape), {}, (480, 640), "f")
    found = decode(layout, [logits], Placement((480, 640), (480, 640)), SETTINGS, 0.1)
    assert found.class_names == ("person", "person")
    assert found.masks[0][100:200, 50:150].all() and found.masks.sum() == 100 * 100 + 100 * 200
    assert found.scores == pytest.approx([1 / (1 + np.exp(-3.0))] * 2, abs=1e-5)


def test_aligned_logits_are_interpolated_between_corners():
    logits = np.zeros((1, 21, 31, 41), np.float32)
    logits[0, 0] = 1.0
    logits[0, 15] = np.linspace(-1, 3, 41)[None]
    layout = detect_layout(info(out=logits.shape), {}, (481, 641), "f")
    found = decode(layout, [logits], Placement((481, 641), (481, 641)), SETTINGS, 0.1)
    assert found.masks[0][:, 321:].all() and not found.masks[0][:, :320].any()


def test_torchvision_instances():
    masks = np.zeros((3, 1, 96, 128), np.float32)
    masks[0, 0, 10:50, 20:60] = 0.9
    masks[1, 0, 60:90, 70:100] = 0.8
    masks[2, 0, 0:9, 0:9] = 0.9
    boxes = np.array([[20, 10, 60, 50], [70, 60, 100, 90], [0, 0, 9, 9]], np.float32)
    values = [boxes, np.array([1, 62, 1], np.float32), np.array([0.9, 0.8, 0.05], np.float32), masks]
    layout = detect_layout(info(boxes=(3, 4), labels=(3,), scores=(3,), masks=(3, 1, 96, 128)), {}, (96, 128), "f")
    place = Placement((96, 128), (96, 128))
    found = decode(layout, values, place, SETTINGS, 0.1)
    assert found.class_names == ("person",) and (found.masks[0] == (masks[0, 0] > 0.5)).all()
    assert decode(layout, values, place, SegmentationSettings(classes="chair"), 0.1).class_names == ("chair",)
    fewer, small = [boxes, values[1][:2], *values[2:]], [*values[:3], np.ones((3, 1, 28, 28), np.float32)]
    unknown = [*values[:3], np.full_like(masks, np.nan)]
    for wrong, words in ((fewer, "disagree: 3 boxes, 2 labels"), (small, "28x28"), (unknown, "'masks' holds NaN")):
        with pytest.raises(SegmentationError, match=words):
            decode(layout, wrong, place, SETTINGS, 0.1)
    none = [np.zeros((0, 4)), np.zeros(0), np.zeros(0), np.zeros((0, 1, 96, 128))]
    assert len(decode(layout, none, place, SETTINGS, 0.1)) == 0


def write(tmp_path, *arguments, **options):
    path = tmp_path / "net.onnx"
    path.write_bytes(onnx_writer.model(*arguments, **options))
    return path


def test_a_written_network_runs_through_opencv(tmp_path):
    logits = np.zeros((1, 21, 60, 80), np.float32)
    logits[0, 0] = 1.0
    logits[0, 15, 10:30, 20:40] = 5.0
    path = write(tmp_path, (1, 3, 240, 320), {"out": logits})
    assert [str(i) for i in read_header(path).inputs] == ["image 1x3x240x320"]
    segmenter = OnnxSegmenter(path, SETTINGS)
    assert segmenter.layout.kind == "semantic"
    for shape in ((480, 640, 3), (240, 320, 3), (100, 333, 3), (37, 21, 3)):
        found = segmenter.segment(frame(np.zeros(shape, np.uint8)))
        assert found.masks.shape == (1, *shape[:2])
        assert found.masks.mean() == pytest.approx(20 * 20 / (60 * 80), rel=0.35)
        assert (deepcopy(segmenter).segment(frame(np.zeros(shape, np.uint8))).masks == found.masks).all()


@pytest.mark.parametrize(
    ("shape", "output", "words"),
    [((1, 3, 32, 32), (1, 1000), "out 1x1000"), ((1, 8), (1, 21, 4, 4), "image 1x8 is no image")],
)
def test_unknown_networks_are_refused(tmp_path, shape, output, words):
    path = write(tmp_path, shape, {"out": np.zeros(output, np.float32)})
    with pytest.raises(SegmentationError, match=words):
        build_segmenter(SegmentationSettings(source=f"onnx:{path}"))


@pytest.mark.skipif(not (WEIGHTS.is_dir() and BONN.is_dir()), reason="needs ../shared/weights and ../shared/data")
def test_yolo_and_deeplab_agree_on_bonn():
    names = ("yolov8n-seg_480x640_fp32.onnx", "deeplabv3_mnv2_voc_481x641.onnx")
    segmenters = [build_segmenter(SegmentationSettings(source=f"onnx:{WEIGHTS / name}")) for name in names]
    lines = [line.split() for line in (BONN / "rgb.txt").read_text().splitlines() if line and line[0] != "#"]
    for index, least in ((60, 0.93), (110, 0.93), (150, 0.85)):
        rgb = np.ascontiguousarray(cv2.imread(str(BONN / lines[index][1]))[:, :, ::-1])
        yolo, deeplab = (segmenter.segment(frame(rgb)).union() for segmenter in segmenters)
        assert (yolo & deeplab).sum() / (yolo | deeplab).sum() > least
