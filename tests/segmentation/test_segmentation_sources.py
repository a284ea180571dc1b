"""Settings, classes, oracle and recorded masks, and the choice among the sources."""

import functools
import hashlib
import http.server
import json
import sys
import threading
from contextlib import nullcontext
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from dynslam_bench.contracts.segmenter import Instances
from dynslam_bench.contracts.sequence import Frame, FrameMasks
from dynslam_bench.core.errors import PluginError, SegmentationError, SettingsError
from dynslam_bench.core.folders import WEIGHTS_VARIABLE
from dynslam_bench.core.settings import apply_overrides, build, parameters
from dynslam_bench.segmentation import build_segmenter as building
from dynslam_bench.segmentation.build_segmenter import (
    SegmenterSpec,
    build_segmenter,
    resolve_source,
    weights_digest,
)
from dynslam_bench.segmentation.networks import checkpoints
from dynslam_bench.segmentation.networks import onnx_export as static
from dynslam_bench.segmentation.networks.backbone import NetworkConfig
from dynslam_bench.segmentation.networks.mask_rcnn_segmenter import MaskRCNNSegmenter
from dynslam_bench.segmentation.networks.network import MaskRCNN, box_iou, nms
from dynslam_bench.segmentation.networks.onnx_export import (
    StaticMaskRCNN,
    export_network,
    parse_size,
    unsuppressed,
    write_onnx,
)
from dynslam_bench.segmentation.networks.onnx_segmenter import OnnxSegmenter
from dynslam_bench.segmentation.recorded import OracleSegmenter, RecordedSegmenter, label_image, record_masks
from dynslam_bench.segmentation.settings import COCO_IDS, COCO_NAMES, NMS_IOU, VOC_NAMES, SegmentationSettings
from dynslam_bench.sequences.catalogue import open_sequence


def frame(index=0, stamp=0.0, shape=(24, 32)):
    return Frame(index, stamp, np.zeros((*shape, 3), np.uint8), np.zeros(shape, np.float32))


class Masks:
    """Person 1 left, chair 2 right; the chair moves from frame 1 on."""

    def __getitem__(self, index):
        if not 0 <= index < 3:
            raise IndexError(index)
        labels = np.zeros((24, 32), np.uint8)
        labels[4:20, 2:8] = 1
        labels[10:20, 20:28] = 2
        return FrameMasks(labels, {1: "person", 2: "chair"}, frozenset({2} if index else ()))


# --- settings ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("source", "fault"),
    [
        *((known, "") for known in ("auto", "none", "onnx:a b.onnx", "weights:C:/w.pt", "plugin:p")),
        ("orcale", "did you mean 'oracle'"), ("onnx:", "needs a path"), ("", "not one of auto"),
        ("yolo:x", "not one of auto"),
    ],
)  # fmt: skip
def test_sources(source, fault):
    with pytest.raises(SettingsError, match=fault) if fault else nullcontext():
        assert build(SegmentationSettings, {"source": source}).source == source


def test_classes_are_names_and_presets():
    assert SegmentationSettings().class_names() == {"person"}
    assert len(SegmentationSettings(classes="dynaslam19").class_names()) == 19
    both = apply_overrides(SegmentationSettings(), {"classes": ["person", "chair"]})
    assert both.classes == "person,chair" and both.class_names() == {"person", "chair"}
    assert SegmentationSettings(classes="dynaslam19, chair").class_names() > {"person", "chair", "zebra"}
    for wrong, words in (
        ("persson", r"unknown class 'persson' .did you mean 'person'"),
        (" , ", "empty"),
        ([], "empty"),
    ):
        with pytest.raises(SettingsError, match=words):
            build(SegmentationSettings, {"classes": wrong})


def test_what_studies_tune_and_agents_steer():
    tunable = {parameter.name: parameter.online for parameter in parameters(SegmentationSettings)}
    offline = {"mask_threshold": False}
    assert (
        tunable
        == dict.fromkeys(("confidence", "dilation_px", "schedule", "compensate", "outside_share"), True) | offline
    )


def test_class_tables():
    assert len(COCO_NAMES) == len(set(COCO_NAMES)) == 80 and len(COCO_IDS) == 80
    assert (COCO_IDS[1], COCO_IDS[13], COCO_IDS[62], COCO_IDS[90]) == ("person", "stop sign", "chair", "toothbrush")
    assert VOC_NAMES[15] == "person" and set(VOC_NAMES[1:]) <= set(COCO_NAMES)


# --- oracle ------------------------------------------------------------------------------------------------------


def test_oracle_gives_everything_and_the_stage_what_is_dynamic():
    found = OracleSegmenter(Masks()).segment(frame(1))
    assert found.class_names == ("person", "chair") and found.moving.tolist() == [False, True]
    assert found.boxes.tolist() == [[2, 4, 8, 20], [20, 10, 28, 20]] and found.masks.sum() == 16 * 6 + 10 * 8
    stage = build_segmenter(SegmentationSettings(source="oracle"), masks=Masks())
    assert stage.segment(frame(0)).class_names == ("person",)
    assert stage.segment(frame(1)).class_names == ("person", "chair")
    by_class = build_segmenter(SegmentationSettings(source="oracle-classes"), masks=Masks())
    assert by_class.segment(frame(1)).class_names == ("person",)


def test_oracle_refuses_what_does_not_fit():
    with pytest.raises(SegmentationError, match="has no exact masks"):
        build_segmenter(SegmentationSettings(source="oracle"), sequence_id="tum/fr3/walking_xyz")
    nameless = [FrameMasks(np.full((24, 32), 9, np.uint8), {1: "person"}, frozenset())]
    for masks, wrong, words in (
        (Masks(), frame(7), "frame 7"),
        (nameless, frame(), "object 9 has no class name"),
    ):
        with pytest.raises(SegmentationError, match=words):
            OracleSegmenter(masks).segment(wrong)
    with pytest.raises(SegmentationError, match="the frame is 40x30"):
        build_segmenter(SegmentationSettings(source="oracle"), masks=Masks()).segment(frame(shape=(30, 40)))


# --- recorded ----------------------------------------------------------------------------------------------------


def record(folder, name, values, shape=(24, 32), dtype=np.uint8):
    labels = np.zeros(shape, dtype)
    for k, value in enumerate(values):
        labels[2:8, 4 * k : 4 * k + 3] = value
    assert cv2.imwrite(str(folder / name), labels)


def test_recorded_by_stamp_and_by_index(tmp_path):
    for stamp, values in ((100.0, [255]), (100.033333, [1, 2]), (100.066667, [])):
        record(tmp_path, f"{stamp:.6f}.png", values)
    segmenter = RecordedSegmenter(tmp_path)
    assert [len(segmenter.segment(frame(5, stamp))) for stamp in (100.001, 100.04, 100.07)] == [1, 2, 0]
    with pytest.raises(SegmentationError, match=r"within 0.02 s of frame 5 .* 100.066667.png, 0.933 s away"):
        segmenter.segment(frame(5, 101.0))
    indexed = tmp_path / "indexed"
    indexed.mkdir()
    record(indexed, "000000.png", [1])
    record(indexed, "000010.png", [1, 300], dtype=np.uint16)
    segmenter = build_segmenter(SegmentationSettings(source=f"recorded:{indexed}"))
    assert len(segmenter.segment(frame(10, 55.0))) == 2 and segmenter.source == f"recorded:{indexed}"
    with pytest.raises(SegmentationError, match=r"frame 3 .*the nearest is 000000.png"):
        segmenter.segment(frame(3))


def test_recorded_classes(tmp_path):
    record(tmp_path, "0.png", [1, 7])
    (tmp_path / "classes.json").write_text(json.dumps({"1": "person", "7": "chair"}))
    assert RecordedSegmenter(tmp_path).segment(frame()).class_names == ("person", "chair")
    record(tmp_path, "0.png", [2])
    with pytest.raises(SegmentationError, match="object 2 has no class"):
        RecordedSegmenter(tmp_path).segment(frame())
    (tmp_path / "classes.json").write_text("{nope")
    with pytest.raises(SegmentationError, match="is no valid JSON"):
        RecordedSegmenter(tmp_path)


def test_recorded_refuses_what_does_not_fit(tmp_path):
    def refused(words, folder=tmp_path):
        with pytest.raises(SegmentationError, match=words):
            RecordedSegmenter(folder).segment(frame())

    refused("does not exist", tmp_path / "none")
    refused("holds no PNG files")
    record(tmp_path, "0.png", [1], shape=(12, 16))
    refused(r"is 16x12, but the frame is 32x24")
    (tmp_path / "0.png").write_bytes(b"\x89PNG nothing")
    refused("cannot be decoded")
    cv2.imwrite(str(tmp_path / "0.png"), np.full((24, 32, 3), (1, 2, 3), np.uint8))
    refused("is a colour image")
    record(tmp_path, "1.5.png", [1])
    refused("1 of 2 mask files are named by stamp")


# --- choice ------------------------------------------------------------------------------------------------------


def test_auto(monkeypatch, tmp_path):
    monkeypatch.setenv(WEIGHTS_VARIABLE, str(tmp_path))
    auto = SegmentationSettings()
    monkeypatch.setattr(building, "embedded_weights", lambda: tmp_path / "embedded.pt")
    assert resolve_source(auto, "synthetic/walking_xyz?scene=3&frames=60", Masks()) == "embedded"
    monkeypatch.setattr(building, "embedded_weights", lambda: None)
    assert resolve_source(auto, "synthetic/walking_xyz?scene=3&frames=60", Masks()) == "oracle"
    with pytest.raises(building.NetworkNotFetched, match="'bonn/crowd'"):
        resolve_source(auto, "bonn/crowd")
    (tmp_path / checkpoints.COCO.file).write_bytes(b"weights")
    assert resolve_source(auto, "bonn/crowd") == "coco"
    assert weights_digest(auto, "bonn/crowd") == hashlib.sha256(b"weights").hexdigest()[:12]
    assert build_segmenter(SegmentationSettings(source="none")) is None
    assert weights_digest(SegmentationSettings(source="oracle"), masks=Masks()) == ""


class FixedSegmenter:
    def __init__(self, settings, context):
        self.context = context

    def segment(self, frame):
        masks = np.zeros((2, 24, 32), bool)
        masks[:, 3:9, 3:9] = True
        boxes = np.array([[3, 3, 9, 9]] * 2, np.float32)
        return Instances(masks, boxes, ("person", "person"), np.array([0.9, 0.2], np.float32))


class SmallMasks(FixedSegmenter):
    def segment(self, frame):
        return Instances.empty(12, 16)


FIXED = SegmenterSpec("fixed", f"{__name__}:FixedSegmenter")
SMALL = SegmenterSpec("small", f"{__name__}:SmallMasks")
BROKEN = SegmenterSpec("broken", "operator:eq")


def test_plugins():
    def source(name):
        return SegmentationSettings(source=f"plugin:{__file__}:{name}")

    sys.modules.setdefault(__name__, sys.modules[__name__])
    built = build_segmenter(source("FIXED"), threads=2)
    assert built.inner.context.threads == 2
    assert built.segment(frame()).scores == pytest.approx([0.9])
    built.settings = built.settings.model_copy(update={"confidence": 0.15})
    assert len(built.segment(frame())) == 2
    with pytest.raises(SegmentationError, match=r"masks of shape \(0, 12, 16\), the frame is 32x24"):
        build_segmenter(source("SMALL")).segment(frame())
    with pytest.raises(SegmentationError, match="gave a bool, not a Segmenter"):
        build_segmenter(source("BROKEN"))
    with pytest.raises(PluginError, match=r"unknown segmenter 'oracel'.*'oracle'"):
        build_segmenter(SegmentationSettings(source="plugin:oracel"))


# --- downloads ---------------------------------------------------------------------------------------------------


@pytest.fixture
def published(tmp_path):
    """Publishes content at an address of this machine; returns its checkpoint."""
    handler = functools.partial(QuietHandler, directory=str(tmp_path))
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler)
    threading.Thread(target=server.serve_forever, args=(0.02,), daemon=True).start()

    def publish(content, prefix=None):
        (tmp_path / "published.pth").write_bytes(content)
        url = f"http://127.0.0.1:{server.server_port}/published.pth"
        sha256 = prefix or hashlib.sha256(content).hexdigest()[:8]
        return checkpoints.Checkpoint("test", "test.pth", url, sha256, 1, "MIT", "nothing")

    yield publish
    server.shutdown()
    server.server_close()


class QuietHandler(http.server.SimpleHTTPRequestHandler):
    def log_message(self, *args):
        pass


def test_a_checkpoint_is_fetched_once_and_verified(monkeypatch, tmp_path, published):
    monkeypatch.setenv(WEIGHTS_VARIABLE, str(tmp_path / "cache"))
    content = bytes(range(256)) * 3000
    checkpoint = published(content)
    told = []
    path = checkpoints.fetch_checkpoint(checkpoint, told.append)
    assert path.read_bytes() == content
    whole = [(state.done, state.total) for state in told if state.stage == "download"]
    assert whole[-1] == (len(content), len(content)) and len(whole) > 1
    (tmp_path / "published.pth").unlink()
    assert checkpoints.fetch_checkpoint(checkpoint) == path
    assert [entry.name for entry in (tmp_path / "cache").iterdir()] == ["test.pth"]


def test_a_damaged_or_missing_download_leaves_nothing(monkeypatch, tmp_path, published):
    monkeypatch.setenv(WEIGHTS_VARIABLE, str(tmp_path / "cache"))
    checkpoint = published(b"something else", prefix="00000000")
    for words in (
        r"has the checksum .* expected 00000000 .put the file of .*1 MB",
        r"cannot fetch the checkpoint 'test': .* 404.*test.pth",
    ):
        with pytest.raises(SegmentationError, match=words):
            checkpoints.fetch_checkpoint(checkpoint)
        (tmp_path / "published.pth").unlink(missing_ok=True)
    assert not list((tmp_path / "cache").iterdir())


# Masks that were recorded come back as they were found.


ORACLE = SegmentationSettings(source="oracle")


@pytest.fixture(scope="module")
def sequence():
    return open_sequence("synthetic/walking_xyz?scene=0&frames=60", frames=(0, 3))


def test_recorded_masks_are_the_segmenters(sequence, tmp_path: Path) -> None:
    assert record_masks(sequence, tmp_path / "masks", ORACLE) == 3
    assert record_masks(sequence, tmp_path / "masks", ORACLE) == 0, "what is there is kept"
    recorded = RecordedSegmenter(tmp_path / "masks")
    assert recorded.missing(sequence.timestamps) == []
    for index in range(len(sequence)):
        found, exact = recorded.segment(sequence[index]).of_classes(["person"]), sequence.masks[index]
        people = {label for label, name in exact.class_names.items() if name == "person"}
        assert len(found) == len(people & set(np.unique(exact.instances).tolist())) > 0
        np.testing.assert_array_equal(found.union(), np.isin(exact.instances, list(people)))


def test_a_folder_of_other_masks_is_refused(sequence, tmp_path: Path) -> None:
    record_masks(sequence, tmp_path, ORACLE)
    (tmp_path / "other").mkdir()
    cv2.imwrite(str(tmp_path / "other" / "000000.png"), np.zeros((4, 4), np.uint8))
    for folder, change, words in (
        ("", {"confidence": 0.5}, r"holds other masks: confidence is '0\.3' there and '0\.5' now"),
        ("other", {}, "holds something else"),
        ("none", {"source": "none"}, "source=none has no masks to record"),
    ):
        with pytest.raises(SegmentationError, match=words):
            record_masks(sequence, tmp_path / folder, ORACLE.model_copy(update=change))


def test_numbers_stand_for_classes_in_every_frame() -> None:
    def objects(*names: str) -> Instances:
        masks = np.zeros((len(names), 2, 8), bool)
        for place in range(len(names)):
            masks[place, :, place : place + 2] = True
        scores = np.linspace(0.9, 0.5, len(names)).astype(np.float32)
        return Instances(masks, np.zeros((len(names), 4), np.float32), names, scores)

    table: dict[int, str] = {}
    first = label_image(objects("person", "chair", "person"), table)
    again = label_image(objects("chair", "person"), table)
    assert table == {1: "person", 2: "chair", 3: "person"}
    assert [table[int(v)] for v in first[0, :4]] == ["person", "person", "chair", "person"], "the surest is on top"
    assert [table[int(v)] for v in again[0, :3]] == ["chair", "chair", "person"]
    assert len(np.unique(first)) == 4


# Our networks for other runtimes: fixed shapes give the same objects, and so does the ONNX file, if it can be made.


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
    hint = r"\(pip install '\.\[onnx\]' in the checkout of dynslam-bench\)"
    with pytest.raises(SegmentationError, match=f"onnx and onnxscript.* {hint}"):
        write_onnx(tiny(), tmp_path / "x.onnx")
