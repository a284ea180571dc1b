"""Networks in ONNX files: which layout their outputs have, how they are decoded, what is refused."""

import pickle
import shlex
from copy import deepcopy
from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers.onnx_files import (
    BOX,
    CELLS,
    FLOAT,
    FLOAT16,
    INT64,
    MASKS,
    SIZE,
    UINT8,
    constant_network,
    entries,
    names_of,
    prototypes,
    raw_detections,
    suppressed_detections,
)

from dynslam_bench.contracts.sequence import Frame
from dynslam_bench.core.errors import SegmentationError, SettingsError
from dynslam_bench.core.settings import apply_overrides, build, parse_assignments
from dynslam_bench.core.stage_cache import StageCache
from dynslam_bench.segmentation.build_segmenter import build_segmenter
from dynslam_bench.segmentation.networks.onnx_header import TensorInfo, read_header
from dynslam_bench.segmentation.networks.onnx_layout import Layout, detect_layout
from dynslam_bench.segmentation.networks.onnx_segmenter import OnnxSegmenter, Placement, decode, fit
from dynslam_bench.segmentation.settings import COCO_NAMES, SegmentationSettings

SHARED = Path(__file__).resolve().parents[3] / "shared"
WEIGHTS = SHARED / "weights"
BONN = SHARED / "data" / "bonn" / "rgbd_bonn_crowd"
SETTINGS = SegmentationSettings()


def picture(rgb):
    return Frame(0, 0.0, np.asarray(rgb), np.zeros(np.shape(rgb)[:2], np.float32))


# --- which layout the outputs have -------------------------------------------------------------------------------


def info(**shapes):
    """Outputs by name: a shape, or a shape and the type of the numbers."""
    return [
        TensorInfo(name, *(shape if isinstance(shape[-1], str) else (shape,)))
        for name, shape in shapes.items()
    ]


def detect(outputs, metadata=None, size=(SIZE, SIZE), asked="auto"):
    return detect_layout(info(**outputs), metadata or {}, size, "net.onnx", asked)


def refused(outputs, metadata=None, size=(SIZE, SIZE), asked="auto"):
    with pytest.raises(SegmentationError) as error:
        detect(outputs, metadata, size, asked)
    assert "net.onnx" in error.value.args[0]
    return error.value


PLANES = (1, MASKS, CELLS, CELLS)
ONE = {"names": names_of("person")}
TWO = {"names": names_of("person", "car")}
COCO_80 = {"names": names_of(*COCO_NAMES)}
RAW = {"end2end": "False"}
SUPPRESSED = {"end2end": "True", "task": "segment"}
HD = (640, 640)
AT_HD = (1, 32, 160, 160)
INSTANCES = {"boxes": (None, 4), "labels": (None,), "scores": (None,), "masks": (None, 1, 480, 640)}


@pytest.mark.parametrize(
    ("outputs", "metadata", "size", "expected"),
    [
        # YOLOv8 and newer as they are exported: 80 classes without and with names, one and two
        # classes
        ({"a": (1, 116, 6300), "b": (1, 32, 120, 160)}, {}, (480, 640), ("yolo", True)),
        ({"a": (1, 116, 8400), "b": AT_HD}, COCO_80 | RAW | {"task": "segment"}, HD, ("yolo", True)),
        ({"a": (1, 37, 8400), "b": AT_HD}, {}, HD, ("yolo", True)),
        ({"a": (1, 38, 8400), "b": AT_HD}, TWO, HD, ("yolo", True)),
        ({"a": (1, 38, 8400), "b": AT_HD}, TWO | {"args": "{'nms': False, 'batch': 1}"}, HD, ("yolo", True)),
        # swapped outputs, and detections along the first axis
        ({"b": (1, 32, 120, 160), "a": (1, 116, 6300)}, {}, (480, 640), ("yolo", True)),
        ({"a": (1, 6300, 116), "b": (1, 32, 120, 160)}, {}, (480, 640), ("yolo", False)),
        ({"a": (1, 8400, 38), "b": AT_HD}, TWO | RAW, HD, ("yolo", False)),
        # more detections than channels, and fewer
        ({"a": (1, 116, 84), "b": (1, 32, 16, 16)}, COCO_80, (64, 64), ("yolo", True)),
        ({"a": (1, 84, 116), "b": (1, 32, 16, 16)}, COCO_80, (64, 64), ("yolo", False)),
        # YOLOv5: 80 classes and one, which has as many channels as suppressed detections, told by 3
        # anchors a cell
        ({"a": (1, 25200, 117), "b": AT_HD}, {}, HD, ("yolo-objectness", False)),
        ({"a": (1, 25200, 117), "b": AT_HD}, COCO_80 | {"stride": "32"}, HD, ("yolo-objectness", False)),
        ({"a": (1, 25200, 38), "b": AT_HD}, ONE, HD, ("yolo-objectness", False)),
        # suppression inside: said by end2end or by nms, or by a number of classes that fits nothing
        # else
        ({"a": (1, 300, 38), "b": AT_HD}, ONE | SUPPRESSED, HD, ("yolo-nms", False)),
        ({"a": (1, 300, 38), "b": AT_HD}, TWO | {"end2end": "true"}, HD, ("yolo-nms", False)),
        ({"b": AT_HD, "a": (1, 300, 38)}, TWO | RAW | {"args": "{'nms': True}"}, HD, ("yolo-nms", False)),
        ({"a": (1, 300, 38), "b": AT_HD}, COCO_80, HD, ("yolo-nms", False)),
        ({"a": (1, 38, 38), "b": AT_HD}, TWO | SUPPRESSED, HD, ("yolo-nms", False)),
        ({"a": (1, 0, 38), "b": AT_HD}, COCO_80 | SUPPRESSED, HD, ("yolo-nms", False)),
        # semantic networks: VOC's names, own names with and without the background, a label map
        # beside the logits
        ({"logits": (1, 21, 31, 41)}, {}, (481, 641), ("semantic-aligned", True)),
        ({"out": (1, 21, 480, 640)}, {}, (480, 640), ("semantic", True)),
        ({"out": (1, 3, 60, 80)}, {"names": names_of("background", "person", "car")}, (480, 640), ("semantic", True)),
        ({"out": (1, 3, 60, 80)}, {"names": "{1: 'person', 2: 'car'}"}, (480, 640), ("semantic", True)),
        ({"out": (1, 3, 60, 80), "map": ((1, 60, 80), "int64")}, {"names": "['a', 'person', 'b']"}, (480, 640),
         ("semantic", True)),
        ({"out": (1, 3, 60, 80), "map": (1, 480, 640)}, {"names": "['a', 'person', 'b']"}, (480, 640),
         ("semantic", True)),
        ({"aux": (1, 21, 60, 80), "out": (1, 21, 60, 80)}, {}, (480, 640), ("semantic", True)),
        ({"out": (1, 21, 60, 21)}, {}, (480, 168), ("semantic", True)),
        # torchvision's Mask R-CNN
        (INSTANCES, {}, (480, 640), ("instances", True)),
        (INSTANCES, {"names": "['__background__', 'person']"}, (480, 640), ("instances", True)),
    ],
)  # fmt: skip
def test_layouts_are_found(outputs, metadata, size, expected):
    layout = detect(outputs, metadata, size)
    assert (layout.id, layout.channels_first) == expected
    assert "person" in layout.names.values()
    first = {"yolo": "a", "semantic": "out", "instances": "boxes"}[layout.kind]
    assert layout.outputs[0] == (first if "logits" not in outputs else "logits")


@pytest.mark.parametrize(
    ("outputs", "metadata", "layouts"),
    [
        # one and two classes after suppression, without a word of it
        ({"a": (1, 300, 38), "b": AT_HD}, ONE, ["yolo-objectness", "yolo-nms"]),
        ({"a": (1, 300, 38), "b": AT_HD}, TWO, ["yolo", "yolo-nms"]),
        ({"a": (1, 8400, 38), "b": AT_HD}, TWO, ["yolo", "yolo-nms"]),
        # cells beside each other or from corner to corner
        ({"out": (1, 21, 16, 16)}, {}, ["semantic", "semantic-aligned"]),
    ],
)
def test_what_fits_two_layouts_is_refused_and_the_setting_decides(outputs, metadata, layouts):
    size = (256, 256) if "out" in outputs else HD
    error = refused(outputs, metadata, size)
    assert f"fit {len(layouts)} layouts" in error.args[0]
    for name in layouts:
        assert f"'{name}'" in error.args[0]
        assert f"--set segmentation.onnx_layout={name}" in error.hint
        assert detect(outputs, metadata, size, name).id == name
    assert ("end2end" in error.hint) == ("yolo-nms" in layouts)


@pytest.mark.parametrize(
    ("detections", "usable", "layouts"),
    [
        ((1, 300, 38), "yolo-objectness", ["'yolo-nms'", "'yolo' [1, N, 4+C+M] with C = 2"]),
        ((1, 116, 500), "yolo", ["C = 80", "'yolo-objectness' [1, 5+C+M, N] with C = 79"]),
        ((1, 117, 500), "yolo-objectness", ["C = 80", "'yolo' [1, 4+C+M, N] with C = 81"]),
    ],
)
def test_without_names_the_number_of_classes_is_open(detections, usable, layouts):
    outputs = {"a": detections, "b": AT_HD}
    error = refused(outputs, size=HD)
    assert [text for text in layouts if text not in error.args[0]] == []
    assert "'names' of the file tells" in error.hint
    assert f"onnx_layout={usable} decides" in error.hint
    assert detect(outputs, size=HD, asked=usable).id == usable


@pytest.mark.parametrize(
    ("outputs", "metadata", "size", "words"),
    [
        # two orders of the axes, two outputs, two beginnings of the numbers
        ({"a": (1, 38, 38), "b": AT_HD}, TWO | RAW, HD, "[1, 4+C+M, N] with C = 2, M = 32 and 'yolo' [1, N, 4+C+M]"),
        ({"x": (1, 21, 60, 80), "y": (1, 21, 60, 80)}, {}, (480, 640), "in output x and 'semantic' [1, C, h, w]"),
        (INSTANCES, {"names": "['person', 'car']"}, (480, 640), "label 0 for 'person' and 'instances' with label 1"),
        ({"out": (1, 21, 21, 21)}, {}, (168, 168), "with C = 21 in output out and 'semantic' [1, h, w, C]"),
        ({"a": (1, 116, 336), "b": (1, 32, 32, 32)}, {}, (128, 128), "'yolo' [1, 4+C+M, N] with C = 80, M = 32 and"),
        ({"a": (1, 46, 46), "b": (1, 21, 46, 46)}, {"names": names_of(*"abcdefghijklmnopqrstu")}, (368, 368),
         "'semantic' [1, C, h, w] with C = 21 in output b"),
        # channels last
        ({"a": (1, 116, 8400), "b": (1, 160, 160, 32)}, COCO_80, HD, "whose channels come last"),
        ({"out": (1, 60, 80, 21)}, {}, (480, 640), "whose channels come last"),
        # the metadata say one thing, the shapes another
        ({"a": (1, 37, 8400), "b": AT_HD}, ONE | SUPPRESSED, HD, "that suppression is inside (end2end, nms)"),
        ({"a": (1, 300, 38), "b": AT_HD}, ONE | RAW, HD, "that none is suppressed"),
        ({"a": (1, 300, 38), "b": AT_HD}, ONE | {"task": "segment"} | RAW, HD, "fit 'yolo-objectness'"),
        ({"a": (1, 116, 8400), "b": AT_HD}, TWO, HD, "2 classes numbered 0 to 1"),
        ({"a": (1, 116, 8400), "b": AT_HD}, COCO_80 | {"task": "semantic"}, HD, "'task' = semantic"),
        ({"out": (1, 21, 60, 80)}, {"task": "segment"}, (480, 640), "'task' = segment"),
        ({"out": (1, 3, 60, 80)}, TWO, (480, 640), "2 classes numbered 0 to 1"),
        ({"a": (1, 38, 8400), "b": AT_HD}, {"names": "{1: 'person', 2: 'car'}"}, HD, "numbered 1 to 2"),
        # no masks: detection, poses, boxes that turn, after a transformer
        ({"a": (1, 84, 8400)}, {"task": "detect"}, HD, "'task' = detect"),
        ({"a": (1, 56, 8400)}, {"task": "pose"}, HD, "'task' = pose"),
        ({"a": (1, 116, 8400), "b": AT_HD}, COCO_80 | {"task": "obb"}, HD, "'task' = obb"),
        ({"a": (1, 300, 84)}, {}, HD, "no known layout fits"),
        ({"a": (1, 300, 6)}, {}, HD, "no known layout fits"),
        ({"dets": (1, 300, 4), "labels": (1, 300, 91), "masks": (1, 300, 108, 108)}, {}, (432, 432), "no known layout"),
        ({"out": (1, 1000)}, {}, HD, "no known layout fits"),
        ({}, {}, HD, "none"),
        # labels in place of scores
        ({"out": ((1, 480, 640), "int64")}, TWO, (480, 640), "class numbers: export the scores"),
        ({"out": ((1, 1, 480, 640), "int32")}, TWO, (480, 640), "class numbers: export the scores"),
        ({"out": (1, 1, 480, 640)}, ONE, (480, 640), "logits or probabilities"),
        # classes without names
        ({"out": (1, 7, 60, 80)}, {}, (480, 640), "7 semantic classes without names"),
        ({"a": (1, 50, 8400), "b": AT_HD}, {}, HD, "C = 14, M = 32, whose classes have no names"),
        ({"a": (1, 300, 38), "b": AT_HD}, SUPPRESSED, HD, "[1, N, 6+M] with M = 32, whose classes have no names"),
        # entries that are damaged
        ({"a": (1, 37, 8400), "b": AT_HD}, {"names": "{'person', 'car'}"}, HD, "it is a set"),
        ({"a": (1, 37, 8400), "b": AT_HD}, {"names": "'person'"}, HD, "it is a str"),
        ({"a": (1, 37, 8400), "b": AT_HD}, {"names": "{1e999: 'person'}"}, HD, "not a table of class names"),
        ({"a": (1, 37, 8400), "b": AT_HD}, {"end2end": "maybe"}, HD, "'end2end' is 'maybe'"),
    ],
)  # fmt: skip
def test_what_is_not_understood_is_refused(outputs, metadata, size, words):
    error = refused(outputs, metadata, size)
    assert words in error.args[0]
    assert error.hint
    for name in outputs:
        assert name in error.args[0] or "entry" in error.args[0]


def test_the_setting_outweighs_the_metadata_but_not_the_shapes():
    outputs = {"a": (1, 300, 38), "b": AT_HD}
    assert detect(outputs, TWO | RAW, HD, "yolo-nms").suppressed
    assert detect({"a": (1, 37, 8400), "b": AT_HD}, ONE | SUPPRESSED, HD, "yolo").id == "yolo"
    error = refused(outputs, TWO, HD, "semantic")
    assert "onnx_layout is semantic" in error.args[0]
    assert "'yolo-nms'" in error.args[0]


def test_names_come_from_the_metadata():
    own = detect(
        {"a": (1, 38, 2100), "b": (1, 32, 60, 80)}, {"names": "{0: 'person', 1: 'cat'}"}, (240, 320)
    )
    assert own.names == {0: "person", 1: "cat"}


# --- what the values mean --------------------------------------------------------------------------------------


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
        [(8, 8, 40, 56), (9, 8, 41, 56), (8, 8, 40, 56), (50, 4, 60, 20)],
        [0.9, 0.8, 0.7, 0.2],
        [0, 0, 16, 0],
    )
    place = Placement((96, 128), (96, 128))
    found = decode(COCO, outputs, place, SETTINGS, 0.1)
    assert found.class_names == ("person", "person")
    assert found.scores == pytest.approx([0.9, 0.2])
    assert found.boxes[0] == pytest.approx([8, 8, 40, 56])
    assert found.masks[0].sum() == 32 * 48
    assert found.masks[0][8:56, 8:40].all()
    both = decode(COCO, outputs, place, SegmentationSettings(classes="person,dog"), 0.5)
    assert both.class_names == ("person", "dog")


def test_yolo_letterbox_is_undone():
    outputs = yolo_values([(16, 32, 48, 64)], [0.9], [0], cells=(32, 32))
    image, place = fit(np.zeros((240, 320, 3), np.uint8), (128, 128), keep_aspect=True)
    assert image.shape == (128, 128, 3)
    assert (image[:16] == 114).all()
    assert (image[16:112] == 0).all()
    found = decode(COCO, outputs, place, SETTINGS, 0.1)
    assert found.boxes[0] == pytest.approx([40, 40, 120, 120])
    assert found.masks[0][41:119, 41:119].all()
    assert found.masks[0].sum() == 80 * 80


def test_semantic_decoding_is_argmax_split_into_parts():
    logits = np.zeros((1, 21, 480, 640), np.float32)
    logits[0, 0] = 1.0
    logits[0, 15, 100:200, 50:150] = 4.0
    logits[0, 15, 300:400, 400:600] = 4.0
    logits[0, 9, 250:280, 10:40] = 4.0
    layout = detect_layout(info(out=logits.shape), {}, (480, 640), "f")
    found = decode(layout, [logits], Placement((480, 640), (480, 640)), SETTINGS, 0.1)
    assert found.class_names == ("person", "person")
    assert found.masks[0][100:200, 50:150].all()
    assert found.masks.sum() == 100 * 100 + 100 * 200
    assert found.scores == pytest.approx([1 / (1 + np.exp(-3.0))] * 2, abs=1e-5)


def test_aligned_logits_are_interpolated_between_corners():
    logits = np.zeros((1, 21, 31, 41), np.float32)
    logits[0, 0] = 1.0
    logits[0, 15] = np.linspace(-1, 3, 41)[None]
    layout = detect_layout(info(out=logits.shape), {}, (481, 641), "f")
    found = decode(layout, [logits], Placement((481, 641), (481, 641)), SETTINGS, 0.1)
    assert found.masks[0][:, 321:].all()
    assert not found.masks[0][:, :320].any()


def test_torchvision_instances():
    masks = np.zeros((3, 1, 96, 128), np.float32)
    masks[0, 0, 10:50, 20:60] = 0.9
    masks[1, 0, 60:90, 70:100] = 0.8
    masks[2, 0, 0:9, 0:9] = 0.9
    boxes = np.array([[20, 10, 60, 50], [70, 60, 100, 90], [0, 0, 9, 9]], np.float32)
    values = [
        boxes,
        np.array([1, 62, 1], np.float32),
        np.array([0.9, 0.8, 0.05], np.float32),
        masks,
    ]
    layout = detect_layout(
        info(boxes=(3, 4), labels=(3,), scores=(3,), masks=(3, 1, 96, 128)), {}, (96, 128), "f"
    )
    place = Placement((96, 128), (96, 128))
    found = decode(layout, values, place, SETTINGS, 0.1)
    assert found.class_names == ("person",)
    assert (found.masks[0] == (masks[0, 0] > 0.5)).all()
    assert decode(
        layout, values, place, SegmentationSettings(classes="chair"), 0.1
    ).class_names == ("chair",)
    fewer = [boxes, values[1][:2], *values[2:]]
    small = [*values[:3], np.ones((3, 1, 28, 28), np.float32)]
    unknown = [*values[:3], np.full_like(masks, np.nan)]
    for wrong, words in (
        (fewer, "disagree: 3 boxes, 2 labels"),
        (small, "28x28"),
        (unknown, "'masks' holds NaN"),
    ):
        with pytest.raises(SegmentationError, match=words):
            decode(layout, wrong, place, SETTINGS, 0.1)
    assert len(decode(layout, [value[:0] for value in values], place, SETTINGS, 0.1)) == 0


# Tiny ONNX files whose outputs are constants.


def write(tmp_path, *arguments, **options):
    path = tmp_path / "net.onnx"
    path.write_bytes(constant_network(*arguments, **options))
    return path


def test_a_written_network_runs_through_opencv(tmp_path):
    logits = np.zeros((1, 21, 60, 80), np.float32)
    logits[0, 0] = 1.0
    logits[0, 15, 10:30, 20:40] = 5.0
    path = write(tmp_path, (1, 3, 240, 320), {"out": logits})
    assert [str(i) for i in read_header(path)[0]] == ["image 1x3x240x320"]
    segmenter = OnnxSegmenter(path, SETTINGS)
    assert segmenter.layout.kind == "semantic"
    for shape in ((480, 640, 3), (240, 320, 3), (100, 333, 3), (37, 21, 3)):
        found = segmenter.segment(picture(np.zeros(shape, np.uint8)))
        assert found.masks.shape == (1, *shape[:2])
        assert found.masks.mean() == pytest.approx(20 * 20 / (60 * 80), rel=0.35)
        for other in (deepcopy(segmenter), pickle.loads(pickle.dumps(segmenter))):
            assert (other.segment(picture(np.zeros(shape, np.uint8))).masks == found.masks).all()


@pytest.mark.parametrize(
    ("shape", "output", "words"),
    [((1, 3, 32, 32), (1, 1000), "out 1x1000"), ((1, 8), (1, 21, 4, 4), "image 1x8 is no image")],
)
def test_unknown_networks_are_refused(tmp_path, shape, output, words):
    path = write(tmp_path, shape, {"out": np.zeros(output, np.float32)})
    with pytest.raises(SegmentationError, match=words):
        build_segmenter(SegmentationSettings(source=f"onnx:{path}"))


# --- networks whose outputs come before or after suppression --------------------------------------------------------


def yolo(tmp_path, detections, metadata, **options):
    """A file with these detections and the prototypes, and the segmenter of a run that takes it."""
    path = tmp_path / "net.onnx"
    outputs = {"output0": detections, "output1": prototypes()}
    path.write_bytes(constant_network((1, 3, SIZE, SIZE), outputs, metadata, **options))
    return SegmentationSettings(source=f"onnx:{path}")


def objects(settings):
    """Names, boxes and areas of the objects in a black image."""
    found = build_segmenter(settings).segment(picture(np.zeros((SIZE, SIZE, 3), np.uint8)))
    return [
        (name, tuple(box), int(mask.sum()))
        for name, box, mask in zip(
            found.class_names, found.boxes.tolist(), found.masks, strict=True
        )
    ]


PERSON = [("person", BOX, 360)]
PEOPLE_AND = {"names": names_of("car", "person", "dog")}


@pytest.mark.parametrize(
    ("detections", "metadata"),
    [
        (raw_detections(1), ONE),
        (raw_detections(2), TWO),
        (raw_detections(3, 1), PEOPLE_AND),
        (raw_detections(2).swapaxes(1, 2), TWO | RAW),
        (raw_detections(3, 1, objectness=1).swapaxes(1, 2), PEOPLE_AND),
        (suppressed_detections(), ONE | SUPPRESSED),
        (suppressed_detections(), TWO | SUPPRESSED),
        (suppressed_detections(1), PEOPLE_AND | SUPPRESSED),
        (suppressed_detections(1), PEOPLE_AND),
        (suppressed_detections(), TWO | {"args": "{'nms': True}"}),
    ],
)
@pytest.mark.parametrize("options", [{}, {"open_shapes": True}, {"input_kind": FLOAT16}])
def test_the_same_object_before_and_after_suppression(tmp_path, detections, metadata, options):
    assert objects(yolo(tmp_path, detections, metadata, **options)) == PERSON


def test_suppressed_detections_are_not_suppressed_again(tmp_path):
    detections = suppressed_detections()
    detections[0, 1] = detections[0, 0]
    detections[0, 1, 1:5] += (1, 0, 1, -0.1)  # a row lower: 29 of 31 rows are common
    assert objects(yolo(tmp_path, detections, ONE | SUPPRESSED)) == [
        *PERSON,
        ("person", (26, 10, 38, 40), 360),
    ]


@pytest.mark.parametrize(
    ("column", "value", "words"),
    [
        (5, 2, "class numbers lie between 2 and 2, its names are numbered 0 to 1"),
        (5, 0.5, "the class number 0.5, class numbers are whole"),
        # score and class in each other's place
        (slice(4, 6), (0, 0.9), "the class number 0.9, class numbers are whole"),
        (slice(4, 6), (1, 0.3), "the class number 0.3, class numbers are whole"),
        (4, 26, "scores reach 26, scores end at 1"),
        (2, 12, "boxes end before they begin, for example x 26 to 12"),
        (slice(0, 4), (0.4, 0.1, 0.6, 0.6), "boxes reach 0.6: shares of the image, not pixels"),
    ],
)
def test_values_that_contradict_the_layout_are_refused(tmp_path, column, value, words):
    detections = suppressed_detections()
    detections[0, 0, column] = value
    settings = yolo(tmp_path, detections, TWO | SUPPRESSED)
    with pytest.raises(SegmentationError) as error:
        objects(settings)
    assert words in error.value.args[0]


@pytest.mark.parametrize(
    ("detections", "asked", "words"),
    [
        (suppressed_detections(), "yolo-objectness", "class numbers"),
        (raw_detections(1, objectness=1).swapaxes(1, 2), "yolo-nms", "boxes end before they begin"),
    ],
)
def test_a_layout_that_the_user_took_for_another_is_noticed(tmp_path, detections, asked, words):
    settings = yolo(tmp_path, detections, ONE)
    with pytest.raises(SegmentationError, match="fit 2 layouts"):
        build_segmenter(settings)
    right = {"yolo-nms": "yolo-objectness", "yolo-objectness": "yolo-nms"}[asked]
    assert objects(settings.model_copy(update={"onnx_layout": right})) == PERSON


@pytest.mark.parametrize(
    ("shape", "kind", "words"),
    [
        ((1, SIZE, SIZE, 3), FLOAT, "is no image"),
        ((1, "rows", "columns", 3), FLOAT, "is no image"),
        ((1, 3, SIZE, SIZE), UINT8, "uint8 takes whole numbers"),
        ((1, 3, SIZE, SIZE), INT64, "int64 takes whole numbers"),
        ((2, 3, SIZE, SIZE), FLOAT, "is no image"),
    ],
)
def test_inputs_that_are_no_image_of_real_numbers_are_refused(tmp_path, shape, kind, words):
    path = tmp_path / "net.onnx"
    path.write_bytes(
        constant_network(shape, {"a": raw_detections(1), "b": prototypes()}, ONE, input_kind=kind)
    )
    with pytest.raises(SegmentationError, match=words):
        build_segmenter(SegmentationSettings(source=f"onnx:{path}"))


def test_a_file_that_says_two_things_is_refused(tmp_path):
    settings = yolo(tmp_path, suppressed_detections(), ONE)
    path = Path(settings.source.removeprefix("onnx:"))
    path.write_bytes(
        path.read_bytes() + entries({"end2end": "True"}) + entries({"end2end": "False"})
    )
    with pytest.raises(SegmentationError, match="two different entries 'end2end'"):
        read_header(path)


# --- classes -----------------------------------------------------------------------------------------------------


def test_a_name_that_is_coco_s_but_for_its_case_is_taken_with_a_warning(tmp_path):
    for name in ("Person", " PERSON", "person, individual"):
        settings = yolo(tmp_path, raw_detections(2), {"names": names_of(name, "car")})
        with pytest.warns(
            UserWarning, match=f"the class '{name}' of the network is taken for 'person'"
        ):
            assert objects(settings) == PERSON


@pytest.mark.parametrize(
    ("names", "example"),
    [
        (["pedestrian", "forklift"], "segmentation.classes=pedestrian"),
        (["forklift", "human"], "segmentation.classes=human"),
        (["fork lift"], "'segmentation.classes=fork lift'"),
        (["Fork_lift"], "'segmentation.classes=fork lift'"),
    ],
)
@pytest.mark.parametrize("suppressed", [False, True])
def test_no_class_that_is_dynamic_is_refused_and_the_hint_works(
    tmp_path, names, example, suppressed
):
    label = 1 if "human" in example else 0
    detections = suppressed_detections(label) if suppressed else raw_detections(len(names), label)
    settings = yolo(tmp_path, detections, {"names": names_of(*names), "end2end": str(suppressed)})
    with pytest.raises(SegmentationError) as error:
        build_segmenter(settings)
    fault = f"none of the {len(names)} classes of the network is among the dynamic ones: person"
    assert fault in error.value.args[0]
    assert ", ".join(names) in error.value.hint
    assert error.value.hint.endswith(f"--set {example}")
    assignment = parse_assignments([shlex.split(example)[0].removeprefix("segmentation.")])
    cured = apply_overrides(settings, assignment)
    assert objects(cured) == [(assignment["classes"], BOX, 360)]


def test_a_class_that_neither_coco_nor_the_network_has_is_misspelled(tmp_path):
    settings = yolo(tmp_path, raw_detections(2), {"names": names_of("person", "pedestrian")})
    assert objects(apply_overrides(settings, {"classes": "Person,dog"})) == PERSON
    with pytest.raises(SegmentationError) as error:
        build_segmenter(apply_overrides(settings, {"classes": "person,pedestrain"}))
    assert "the network has no class 'pedestrain'" in error.value.args[0]
    assert "'pedestrian'" in error.value.hint
    for source in ("auto", "coco", "embedded", "none"):
        with pytest.raises(SettingsError, match="unknown class 'pedestrian'"):
            build(SegmentationSettings, {"source": source, "classes": "pedestrian"})


def test_what_is_assumed_of_classes_without_names_is_said(tmp_path):
    with pytest.warns(UserWarning, match="the file names no classes, class 0 is taken for person"):
        assert objects(yolo(tmp_path, raw_detections(1), {})) == PERSON
    logits = np.zeros((1, 2, 60, 80), np.float32)
    logits[0, 1, 10:30, 20:40] = 5
    path = write(tmp_path, (1, 3, 240, 320), {"out": logits})
    with pytest.warns(
        UserWarning, match="class 0 is taken for background, class 1 is taken for person"
    ):
        assert OnnxSegmenter(path, SETTINGS).layout.names[1] == "person"


def test_a_filters_further_classes_are_sought_by_the_network(tmp_path):
    detections = raw_detections(2)
    detections[0, :, 1] = detections[0, :, 0]
    detections[0, 4:6, 1] = 0, 0.8
    settings = yolo(tmp_path, detections, {"names": names_of("person", "chair")})
    assert objects(settings) == PERSON
    black = picture(np.zeros((SIZE, SIZE, 3), np.uint8))
    for cache in (None, StageCache(tmp_path / "cache"), StageCache(tmp_path / "cache")):
        alone = build_segmenter(settings, cache=cache).segment(black)
        found = build_segmenter(settings, cache=cache, also=frozenset({"chair"})).segment(black)
        assert alone.class_names == ("person",)
        assert found.class_names == ("person", "chair")


@pytest.mark.slow
@pytest.mark.skipif(
    not (WEIGHTS.is_dir() and BONN.is_dir()), reason="needs ../shared/weights and ../shared/data"
)
def test_yolo_and_deeplab_agree_on_bonn():
    names = ("yolov8n-seg_480x640_fp32.onnx", "deeplabv3_mnv2_voc_481x641.onnx")
    segmenters = [
        build_segmenter(SegmentationSettings(source=f"onnx:{WEIGHTS / name}")) for name in names
    ]
    lines = [
        line.split()
        for line in (BONN / "rgb.txt").read_text().splitlines()
        if line and line[0] != "#"
    ]
    for index, least in ((60, 0.93), (110, 0.93), (150, 0.85)):
        rgb = np.ascontiguousarray(cv2.imread(str(BONN / lines[index][1]))[:, :, ::-1])
        yolo, deeplab = (segmenter.segment(picture(rgb)).union() for segmenter in segmenters)
        assert (yolo & deeplab).sum() / (yolo | deeplab).sum() > least
