"""Settings, classes, oracle and recorded masks, and the choice among the sources."""

import hashlib
import json
import sys
import threading
import time
from concurrent.futures import wait
from contextlib import nullcontext
from copy import deepcopy
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from helpers.fetch_server import Server

from dynslam_bench.contracts.segmenter import Instances
from dynslam_bench.contracts.sequence import Frame, FrameMasks
from dynslam_bench.core.errors import PluginError, SegmentationError, SettingsError
from dynslam_bench.core.folders import WEIGHTS_VARIABLE
from dynslam_bench.core.settings import Settings, apply_overrides, build
from dynslam_bench.core.stage_cache import StageCache
from dynslam_bench.segmentation import schedule
from dynslam_bench.segmentation.build_segmenter import (
    CachedSegmenter,
    ConfiguredSegmenter,
    NetworkNotFetched,
    SegmenterSpec,
    build_segmenter,
    resolve_source,
    segmentation_source,
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
from dynslam_bench.segmentation.postprocess import (
    boxes_of,
    dilate,
    dynamic_mask,
    fill_holes,
    repair,
    select,
)
from dynslam_bench.segmentation.record import label_image, record_masks
from dynslam_bench.segmentation.recorded import OracleSegmenter, RecordedSegmenter
from dynslam_bench.segmentation.schedule import MaskScheduler, MissedDetections
from dynslam_bench.segmentation.settings import (
    COCO_IDS,
    COCO_NAMES,
    NMS_IOU,
    VOC_NAMES,
    SegmentationSettings,
)
from dynslam_bench.segmentation.training.evaluate_masks import MaskTally, average_precision
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
    assert both.classes == "person,chair"
    assert both.class_names() == {"person", "chair"}
    assert SegmentationSettings(classes="dynaslam19, chair").class_names() > {
        "person",
        "chair",
        "zebra",
    }
    for wrong, words in (
        ("persson", r"unknown class 'persson' .did you mean 'person'"),
        (" , ", "empty"),
        ([], "empty"),
    ):
        with pytest.raises(SettingsError, match=words):
            build(SegmentationSettings, {"classes": wrong})


def test_the_case_of_class_names_does_not_matter():
    assert SegmentationSettings(classes="Person, Traffic_Light").class_names() == {
        "person",
        "traffic light",
    }
    assert build(
        SegmentationSettings, {"source": "onnx:a", "classes": ["Fork Lift", "person"]}
    ).class_names() == {
        "fork lift",
        "person",
    }
    for empty in ("", " , ", []):
        with pytest.raises(SettingsError, match="empty"):
            build(SegmentationSettings, {"source": "onnx:a", "classes": empty})


def test_class_tables():
    assert len(COCO_NAMES) == len(set(COCO_NAMES)) == 80
    assert len(COCO_IDS) == 80
    assert (COCO_IDS[1], COCO_IDS[13], COCO_IDS[62], COCO_IDS[90]) == (
        "person",
        "stop sign",
        "chair",
        "toothbrush",
    )
    assert VOC_NAMES[15] == "person"
    assert set(VOC_NAMES[1:]) <= set(COCO_NAMES)


# --- oracle ------------------------------------------------------------------------------------------------------


def test_oracle_gives_everything_and_the_stage_what_is_dynamic():
    found = OracleSegmenter(Masks()).segment(frame(1))
    assert found.class_names == ("person", "chair")
    assert found.moving.tolist() == [False, True]
    assert found.boxes.tolist() == [[2, 4, 8, 20], [20, 10, 28, 20]]
    assert found.masks.sum() == 16 * 6 + 10 * 8
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
        (Masks(), frame(shape=(30, 40)), "the frame is 40x30"),
    ):
        with pytest.raises(SegmentationError, match=words):
            build_segmenter(SegmentationSettings(source="oracle"), masks=masks).segment(wrong)


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
    assert [len(segmenter.segment(frame(5, stamp))) for stamp in (100.001, 100.04, 100.07)] == [
        1,
        2,
        0,
    ]
    with pytest.raises(
        SegmentationError, match=r"within 0.02 s of frame 5 .* 100.066667.png, 0.933 s away"
    ):
        segmenter.segment(frame(5, 101.0))
    indexed = tmp_path / "indexed"
    indexed.mkdir()
    record(indexed, "000000.png", [1])
    record(indexed, "000010.png", [1, 300], dtype=np.uint16)
    segmenter = build_segmenter(SegmentationSettings(source=f"recorded:{indexed}"))
    assert len(segmenter.segment(frame(10, 55.0))) == 2
    assert segmenter.source == f"recorded:{indexed}"
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
    assert resolve_source(auto, "synthetic/walking_xyz?scene=3&frames=60", Masks()) == "embedded"
    # the small network is offered with its licence, and never taken unasked
    (tmp_path / checkpoints.SELFIE.file).write_bytes(b"small")
    with pytest.raises(NetworkNotFetched, match=r"'bonn/crowd'.*170 MB") as caught:
        resolve_source(auto, "bonn/crowd")
    assert any("0.25 MB, Apache-2.0" in option for option in caught.value.options)
    assert any("BSD-3-Clause" in option for option in caught.value.options)
    small = SegmentationSettings(source="selfie")
    assert weights_digest(small, "bonn/crowd") == hashlib.sha256(b"small").hexdigest()[:12]
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
        return Instances(
            masks, boxes_of(masks), ("person", "person"), np.array([0.9, 0.2], np.float32)
        )


class SmallMasks(FixedSegmenter):
    def segment(self, frame):
        return Instances.empty(12, 16)


class OwnNames(FixedSegmenter):
    def segment(self, frame):
        masks = np.zeros((1, *frame.rgb.shape[:2]), bool)
        masks[0, 5:50, 5:50] = True
        return Instances(masks, boxes_of(masks), ("Pedestrian",), np.ones(1, np.float32))


class RemembersFrames(FixedSegmenter):
    seen = 0

    def reset(self):
        self.seen = 0

    def segment(self, frame):
        self.seen += 1
        return super().segment(frame)


REMEMBERS = SegmenterSpec("remembers", f"{__name__}:RemembersFrames")
OWN = SegmenterSpec("own", f"{__name__}:OwnNames")
FIXED = SegmenterSpec("fixed", f"{__name__}:FixedSegmenter")
SMALL = SegmenterSpec("small", f"{__name__}:SmallMasks")
BROKEN = SegmenterSpec("broken", "operator:eq")


@pytest.mark.parametrize(("spec", "is_cached"), [("FIXED", True), ("REMEMBERS", False)])
def test_masks_of_a_segmenter_that_remembers_frames_are_not_stored(
    tmp_path, monkeypatch, spec, is_cached
):
    monkeypatch.setattr(
        "dynslam_bench.segmentation.build_segmenter.stage_code", lambda _: lambda: "known"
    )
    sys.modules.setdefault(__name__, sys.modules[__name__])
    settings = SegmentationSettings(source=f"plugin:{__file__}:{spec}")
    built = build_segmenter(settings, cache=StageCache(tmp_path))
    assert isinstance(built.inner, CachedSegmenter) == is_cached
    for _ in range(2):
        built.reset()
        for _ in range(3):
            built.segment(frame())
    if not is_cached:
        assert built.inner.seen == 3


@pytest.mark.slow
def test_plugins():
    def source(name):
        return SegmentationSettings(source=f"plugin:{__file__}:{name}")

    sys.modules.setdefault(__name__, sys.modules[__name__])
    built = build_segmenter(source("FIXED"), threads=2)
    assert built.inner.context.threads == 2
    assert built.segment(frame()).scores == pytest.approx([0.9])
    built.settings = built.settings.model_copy(update={"confidence": 0.15})
    assert len(built.segment(frame())) == 2
    with pytest.raises(
        SegmentationError, match=r"masks of shape \(0, 12, 16\).* the frame is 32x24"
    ):
        build_segmenter(source("SMALL")).segment(frame())
    built.inner.segment = lambda frame: None
    with pytest.raises(SegmentationError, match="gave NoneType instead of Instances"):
        built.segment(frame())
    with pytest.raises(SegmentationError, match="gave a bool, not a Segmenter"):
        build_segmenter(source("BROKEN"))
    with pytest.raises(PluginError, match=r"unknown segmenter 'oracel'.*'oracle'"):
        build_segmenter(SegmentationSettings(source="plugin:oracel"))


# --- downloads ---------------------------------------------------------------------------------------------------


@pytest.fixture
def server(monkeypatch, tmp_path):
    """Publishes a checkpoint at an address of this machine."""
    monkeypatch.setenv(WEIGHTS_VARIABLE, str(tmp_path / "cache"))
    made = Server(bytes(range(256)) * 3000)
    yield made
    made.close()


def published(server, sha256):
    return checkpoints.Checkpoint("test", "test.pth", server.url, sha256, 1, "MIT", "nothing")


def test_a_checkpoint_is_fetched_once_and_verified(server, tmp_path):
    checkpoint = published(server, hashlib.sha256(server.data).hexdigest()[:8])
    told = []
    path = checkpoints.fetch_checkpoint(checkpoint, told.append)
    assert path.read_bytes() == server.data
    whole = [(state.done, state.total) for state in told if state.stage == "download"]
    assert whole[-1] == (len(server.data), len(server.data))
    assert len(whole) > 1
    assert checkpoints.fetch_checkpoint(checkpoint) == path
    assert len(server.requests) == 1
    assert [entry.name for entry in (tmp_path / "cache").iterdir()] == ["test.pth"]


def test_a_damaged_or_missing_download_leaves_nothing(server, tmp_path):
    for server.plan, words in (
        ([], r"has the checksum .* expected 00000000 .put the file of .*1 MB"),
        ([{"status": 404}], r"cannot fetch the checkpoint 'test': .* 404.*test.pth"),
    ):
        with pytest.raises(SegmentationError, match=words):
            checkpoints.fetch_checkpoint(published(server, "00000000"))
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
        found = recorded.segment(sequence[index]).of_classes(["person"])
        exact = sequence.masks[index]
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


# A selection that is empty is said before the run.


class Tracked(Settings):
    segmentation: SegmentationSettings = SegmentationSettings()


def checked(sequence, source, **changes):
    return segmentation_source(
        build(Tracked, {"segmentation": {"source": source, **changes}}), sequence
    )


def record_stamps(folder, sequence, values, classes=None):
    """Label images of all frames with an object of each value, and the names of the values."""
    for stamp in sequence.timestamps:
        record(folder, f"{stamp:.6f}.png", values, shape=sequence[0].rgb.shape[:2])
    if classes is not None:
        (folder / "classes.json").write_text(json.dumps(classes))
    return f"recorded:{folder}"


@pytest.mark.parametrize(
    ("classes", "asked", "named", "count"),
    [
        (None, "dog", "person", 1),
        ({"1": "chair"}, "person", "chair", 1),
        ({"1": "chair", "2": "pedestrian"}, "dynaslam19", "chair, pedestrian", 2),
    ],
)
def test_recorded_classes_none_of_which_is_dynamic_are_refused(
    sequence, tmp_path, classes, asked, named, count
):
    source = record_stamps(tmp_path, sequence, range(1, count + 1), classes)
    with pytest.raises(SegmentationError) as error:
        checked(sequence, source, classes=asked)
    fault = f"none of the {count} classes of the folder of recorded masks is among the dynamic ones: {asked}"
    assert fault in error.value.args[0]
    assert f"it has {named};" in error.value.hint
    name = error.value.hint.rpartition("segmentation.classes=")[2]
    assert checked(sequence, source, classes=name) == source


@pytest.mark.parametrize("values", [[], [7]])
def test_recorded_masks_that_show_nobody_are_said(sequence, tmp_path, values):
    source = record_stamps(tmp_path, sequence, values, {"1": "Person", "7": "chair"})
    with pytest.warns(
        UserWarning, match=f"no object of the classes person in any of {len(sequence)} frames of"
    ):
        assert checked(sequence, source) == source
    last = f"{sequence.timestamps[-1]:.6f}.png"
    record(tmp_path, last, [1], shape=sequence[0].rgb.shape[:2])
    assert (
        RecordedSegmenter(tmp_path).first_object(sequence.timestamps, frozenset({"person"}))
        == len(sequence) - 1
    )


def test_a_misspelled_recorded_class_is_said(sequence, tmp_path):
    record_stamps(tmp_path, sequence, [1], {"1": "person", "2": "chiar", "3": "pedestrian"})
    with pytest.warns(
        UserWarning, match="'chiar' is no COCO class; did you mean 'chair'"
    ) as warned:
        RecordedSegmenter(tmp_path)
    assert len(warned) == 1


@pytest.mark.slow
def test_masks_of_own_names_are_recorded_and_used(sequence, tmp_path):
    source = f"plugin:{__file__}:OWN"
    with pytest.warns(UserWarning) as warned:
        record_masks(sequence, tmp_path / "person", SegmentationSettings(source=source))
    assert not (tmp_path / "person" / "classes.json").exists()
    said = [str(warning.message) for warning in warned]
    assert sum("found 'pedestrian', which is no COCO class" in text for text in said) == 1
    assert sum("no object of the classes person in any of 3 frames" in text for text in said) == 1
    record_masks(
        sequence, tmp_path / "pedestrian", SegmentationSettings(source=source, classes="Pedestrian")
    )
    recorded = f"recorded:{tmp_path / 'pedestrian'}"
    assert checked(sequence, recorded, classes="PEDESTRIAN") == recorded
    stage = build_segmenter(SegmentationSettings(source=recorded, classes="PEDESTRIAN"))
    assert stage.segment(sequence[0]).masks.sum() == 45 * 45


def test_exact_masks_of_nobody_dynamic_are_said(sequence):
    assert checked(sequence, "oracle-classes") == "oracle-classes"
    with pytest.warns(
        UserWarning, match="classes of the sequence is among the dynamic ones: zebra"
    ):
        checked(sequence, "oracle-classes", classes="zebra")
    for source in ("oracle", "oracle-classes"):
        with pytest.raises(
            SegmentationError, match=r"the sequence has no class 'persson'.*'person'"
        ):
            checked(sequence, source, classes="persson")


def test_numbers_stand_for_classes_in_every_frame() -> None:
    def objects(*names: str) -> Instances:
        columns = np.tile(np.arange(8), (2, 1))
        masks = np.stack([np.isin(columns, (place, place + 1)) for place in range(len(names))])
        scores = np.linspace(0.9, 0.5, len(names)).astype(np.float32)
        return Instances(masks, np.zeros((len(names), 4), np.float32), names, scores)

    table: dict[int, str] = {}
    first = label_image(objects("person", "chair", "person"), table)
    again = label_image(objects("chair", "person"), table)
    assert table == {1: "person", 2: "chair", 3: "person"}
    assert [table[int(v)] for v in first[0, :4]] == ["person", "person", "chair", "person"], (
        "the surest is on top"
    )
    assert [table[int(v)] for v in again[0, :3]] == ["chair", "chair", "person"]
    assert len(np.unique(first)) == 4


# Our networks for other runtimes: fixed shapes give the same objects, and so does the ONNX file, if
# it can be made.


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


def objects(
    found: tuple[torch.Tensor, ...], threshold: float
) -> list[tuple[str, float, np.ndarray, np.ndarray]]:
    rows = [
        (CLASSES[int(label) - 1], float(score), box.numpy(), mask[0].numpy() >= threshold)
        for box, label, score, mask in zip(*found, strict=True)
        if score > 0
    ]
    return [row for row in rows if row[3].any()]


@pytest.mark.parametrize("exact", [True, False])
def test_fixed_shapes_give_the_same_objects(exact: bool) -> None:
    network = tiny(exact_paste=exact)
    settings = SETTINGS.model_copy(update={"classes": ",".join(CLASSES)})
    image = noise(120, 160)
    expected = MaskRCNNSegmenter(network, settings).segment(
        Frame(0, 0.0, image, np.zeros((120, 160), np.float32))
    )
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
        # OpenCV interpolates at 32nds of a pixel
        assert np.logical_xor(row[3], mask).sum() < 0.03 * max(mask.sum(), 20)


def test_suppression_in_rounds_is_the_greedy_one() -> None:
    generator = torch.Generator().manual_seed(0)
    corner = torch.rand(120, 2, generator=generator) * 60
    boxes = torch.cat([corner, corner + 5 + 20 * torch.rand(120, 2, generator=generator)], dim=1)
    scores = torch.linspace(1, 0.1, 120)
    for first in (0, 1):
        kept = unsuppressed(box_iou(boxes, boxes) > 0.3, (torch.arange(120) >= first).float())
        assert (
            torch.nonzero(kept)[:, 0].tolist()
            == (first + nms(boxes[first:], scores[first:], 0.3)).tolist()
        )


def test_other_runtimes_give_the_same(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The file of a small network in ONNX Runtime, and in OpenCV where that can load it."""
    runtime = pytest.importorskip("onnxruntime", reason="onnxruntime is not installed")
    pytest.importorskip("onnxscript", reason="onnxscript (extra [onnx]) is not installed")
    monkeypatch.setattr(static, "ROUNDS", 4)
    network = tiny(exact_paste=True)
    path = tmp_path / "tiny.onnx"
    assert write_onnx(network.fuse(), path, size=(120, 160)) == {1: "person", 2: "chair", 3: "dog"}
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
    assert segmenter.layout.kind == "instances"
    assert sorted(seen.class_names) == sorted(row[0] for row in rows)
    assert np.abs(np.sort(seen.scores) - np.sort([row[1] for row in rows])).max() < 1e-3


def test_what_cannot_be_exported(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    with pytest.raises(
        SegmentationError, match=r"'yolo' is no network of this project \(export embedded, coco or"
    ):
        export_network("yolo", tmp_path / "x.onnx")
    for text in ("640", "640x8", "x480"):
        with pytest.raises(
            SegmentationError, match=rf"'{text}' is no size of an image \(for example 640x480"
        ):
            parse_size(text)
    assert parse_size("640x480") == (480, 640)
    monkeypatch.setitem(sys.modules, "onnx", None)
    with pytest.raises(
        SegmentationError,
        match=r"onnx and onnxscript.* \(pip install '\.\[onnx\]' in the checkout of",
    ):
        write_onnx(tiny(), tmp_path / "x.onnx")


H = 120
W = 160


def block(y0, y1, x0, x1):
    mask = np.zeros((H, W), bool)
    mask[y0:y1, x0:x1] = True
    return mask


def instances(*masks, names=None, scores=None, moving=None):
    stack = np.stack(masks) if masks else np.zeros((0, H, W), bool)
    return Instances(
        stack,
        boxes_of(stack),
        tuple(names or ["person"] * len(stack)),
        np.array(scores if scores is not None else [0.9] * len(stack), np.float32),
        None if moving is None else np.array(moving, bool),
    )


def frame_of(gray, index=0):
    return Frame(index, index / 30, gray[:, :, None].repeat(3, 2), np.zeros(gray.shape, np.float32))


def iou(a, b):
    return (a & b).sum() / (a | b).sum()


# --- post-processing ---------------------------------------------------------------------------------------------


def test_selection_by_class_score_and_motion():
    masks = [block(0, 20, 0, 20), block(30, 50, 0, 20), block(60, 80, 0, 20), block(90, 92, 0, 2)]
    found = instances(
        *masks, names=["person", "chair", "person", "person"], scores=[0.9, 0.9, 0.2, 0.9]
    )
    changes = ({}, {"confidence": 0.1}, {"classes": "person,chair"})
    assert [len(select(found, SegmentationSettings(**change))) for change in changes] == [2, 3, 3]
    oracle = instances(*masks[:2], names=["person", "chair"], moving=[False, True])
    assert select(oracle, SegmentationSettings()).class_names == ("person", "chair")


@pytest.mark.parametrize("radius", [0, 1, 7, 15, 200])
def test_dilation_is_a_disc_of_that_radius(radius):
    mask = np.zeros((H, W), bool)
    mask[50, 60] = mask[0, 0] = True
    yy, xx = np.mgrid[:H, :W]
    expected = ((yy - 50) ** 2 + (xx - 60) ** 2 <= radius**2) | (yy**2 + xx**2 <= radius**2)
    assert np.array_equal(dilate(mask, radius), expected)
    assert not dilate(np.zeros((H, W), bool), radius).any()


@pytest.mark.parametrize("size", [(640, 480), (320, 240), (160, 120), (400, 300), (1242, 375)])
@pytest.mark.parametrize("repair", ["none", "depth"])
def test_masks_grow_by_the_same_share_of_an_image_of_any_size(size, repair):
    width, height = size
    rows, columns = np.mgrid[:height, :width]
    away = np.hypot(rows - height // 2, columns - width // 2)
    disc = away <= 0.1 * width
    depth = np.where(disc, 1.5, 3.0).astype(np.float32)
    settings = SegmentationSettings(dilation_px=15, repair=repair)
    grown = dynamic_mask(instances(disc), settings, depth)
    radius = away[grown].max()
    assert radius == pytest.approx((0.1 + 15 / 640) * width, abs=1.0)
    assert iou(grown, away <= radius) > 0.97


@pytest.mark.parametrize(
    "nothing", [Instances.empty(H, W), instances(block(10, 50, 10, 50), scores=[0.05])]
)
def test_dynamic_mask_of_nothing(nothing):
    assert not dynamic_mask(nothing, SegmentationSettings()).any()


def test_holes_are_filled_and_bays_stay():
    mask = block(10, 110, 20, 100)
    assert np.array_equal(fill_holes(mask & ~block(40, 60, 40, 60)), mask)
    bay = mask & ~block(40, 80, 60, 100)
    assert np.array_equal(fill_holes(bay)[45:75, 65:100], bay[45:75, 65:100])
    assert fill_holes(np.ones((H, W), bool)).all()
    assert not fill_holes(np.zeros((H, W), bool)).any()


def test_depth_repair_fits_the_border_to_the_depth_edge():
    # a border of 8 pixels decides, of images that are 640 pixels wide
    truth, *wrong = (
        np.pad(block(*place), ((0, 0), (0, 640 - W)))
        for place in (
            (20, 100, 50, 110),
            (25, 95, 55, 105),
            (15, 105, 45, 115),
            (20, 100, 54, 114),
        )
    )
    depth = np.where(truth, 1.5, 3.0).astype(np.float32)
    depth[::7] = 0  # missing rows decide nothing
    settings = SegmentationSettings(repair="depth", dilation_px=0)
    for mask in wrong:
        assert iou(dynamic_mask(instances(mask), settings, depth), truth) > 0.93 > iou(mask, truth)
    assert np.array_equal(dynamic_mask(instances(wrong[0]), settings), wrong[0])
    assert np.array_equal(repair(wrong[0], np.zeros_like(depth), 0.2), wrong[0])


# --- carrying ----------------------------------------------------------------------------------------------------


def scene(shift_x, shift_y=0, scale=1.0, seed=0):
    """A textured square that moves over another texture; the image and the square's mask."""
    rng = np.random.default_rng(seed)
    background = cv2.GaussianBlur(rng.integers(0, 255, (480, 640)).astype(np.uint8), (0, 0), 2.5)
    texture = cv2.GaussianBlur(rng.integers(0, 255, (480, 640)).astype(np.uint8), (0, 0), 2.5)
    stretch = [
        cv2.normalize(image, None, 0, 255, cv2.NORM_MINMAX) for image in (background, texture)
    ]
    square = np.zeros((480, 640), np.uint8)
    square[150:330, 200:360] = 255
    move = np.array(
        [[scale, 0, 280 * (1 - scale) + shift_x], [0, scale, 240 * (1 - scale) + shift_y]]
    )
    mask = cv2.warpAffine(square, move, (640, 480)) >= 128
    image = np.where(mask, cv2.warpAffine(stretch[1], move, (640, 480)), stretch[0]).astype(
        np.uint8
    )
    return image, mask


def carry_dense(found, before, after):
    return schedule.carry_dense(found, schedule.dense_flow(before, after))


@pytest.mark.parametrize("move", [carry_dense, schedule.carry_sparse])
@pytest.mark.parametrize("motion", [(0, 0, 1.0), (9, 3, 1.0), (-14, 6, 1.05)])
def test_masks_follow_the_motion(move, motion):
    before, mask = scene(0)
    after, moved = scene(*motion)
    carried = move(instances(mask, scores=[0.8]), before, after)
    assert iou(carried.masks[0], moved) > 0.93
    assert carried.boxes[0] == pytest.approx(boxes_of(moved[None])[0], abs=8)
    assert carried.class_names == ("person",)
    assert carried.scores == pytest.approx([0.8])


@pytest.mark.parametrize("move", [carry_dense, schedule.carry_sparse])
def test_carrying_nothing_and_carrying_over_black_images(move):
    black = np.zeros((H, W), np.uint8)
    assert len(move(Instances.empty(H, W), black, black)) == 0
    assert (
        iou(move(instances(block(20, 80, 30, 90)), black, black).masks[0], block(20, 80, 30, 90))
        > 0.95
    )


def test_an_exact_flow_moves_masks_exactly():
    mask = block(30, 60, 40, 80)
    flow = np.full((H, W, 2), (7, -4), np.float32)
    assert np.array_equal(schedule.push_mask(mask, flow), block(26, 56, 47, 87))
    assert not schedule.push_mask(mask, flow + 500).any()
    assert np.array_equal(schedule.push_mask(mask, flow[::2, ::2] / 2), block(26, 56, 47, 87))


# --- missed detections -------------------------------------------------------------------------------------------


def walker(k):
    return block(30, 90, 20 + 5 * k, 50 + 5 * k)


def test_a_missed_detection_is_bridged_at_constant_velocity():
    bridge = MissedDetections(2)
    for k in range(4):
        assert len(bridge.update(instances(walker(k)))) == 1
    for k in (4, 5):
        bridged = bridge.update(instances())
        assert len(bridged) == 1
        assert bridged.scores[0] == np.float32(0.9)
        assert iou(bridged.masks[0], walker(k)) > 0.75
    assert len(bridge.update(instances())) == 0


def test_an_object_that_is_seen_again_keeps_its_speed():
    bridge = MissedDetections(5)
    for k in range(9):
        bridge.update(instances() if k in (5, 6) else instances(walker(k)))
    (bridged,) = bridge.update(instances()).boxes
    assert bridged[0] == pytest.approx(20 + 5 * 9, abs=0.5)


@pytest.mark.parametrize("when", ["every", "every_nth"])
@pytest.mark.parametrize("promised", [0, 1, 3, 5])
def test_a_miss_is_bridged_for_as_many_segmented_frames_as_promised_however_weak_the_detection(
    promised, when
):
    class Weak:
        def segment(self, frame):
            return instances(walker(1), scores=[0.31]) if frame.index < 6 else instances()

    settings = SegmentationSettings(compensate=promised, schedule=when, n=2, confidence=0.3)
    stage = MaskScheduler(settings, Weak())
    seen = []
    gray = np.random.default_rng(0).integers(0, 255, (H, W), dtype=np.uint8)
    for index in range(20):
        used = select(stage.masks_for(frame_of(gray, index), gray, keyframe=False), settings)
        seen += [len(used)] if stage.segmented and index >= 6 else []
    assert seen == [1] * promised + [0] * (len(seen) - promised)


def test_single_detections_leaving_objects_and_oracles_are_not_bridged():
    bridge = MissedDetections(5)
    bridge.update(instances(walker(0)))
    assert len(bridge.update(instances())) == 0
    for k in range(4):
        bridge.update(instances(block(30, 90, max(0, 30 - 12 * k), 60 - 12 * k)))
    assert [len(bridge.update(instances())) for _ in range(3)][-1] == 0
    assert len(MissedDetections(0).update(instances(walker(0)))) == 1
    oracle = MissedDetections(5)
    for k in range(3):
        oracle.update(instances(walker(k), moving=[True]))
    assert len(oracle.update(instances(moving=[]))) == 0


# --- schedule ----------------------------------------------------------------------------------------------------


class Square:
    """Finds the square of `scene` where it is, after some time, but in a broken frame."""

    def __init__(self, takes_s=0.0, broken=None):
        self.calls = []
        self.takes_s = takes_s
        self.broken = broken

    def segment(self, frame):
        time.sleep(self.takes_s)
        if frame.index == self.broken:
            raise RuntimeError(f"frame {self.broken}")
        self.calls.append(frame.index)
        return instances(scene(3 * frame.index)[1])


def feed(stage, index, *, keyframe=False):
    """The objects in a frame of the moving square, and how well they cover it."""
    gray, truth = scene(3 * index)
    found = stage.masks_for(frame_of(gray, index), gray, keyframe=keyframe)
    return found, iou(found.union(), truth)


def run(settings, count=10, keyframes=()):
    stage = MaskScheduler(settings, Square())
    quality = []
    for index in range(count):
        quality.append(feed(stage, index, keyframe=index in keyframes)[1])
        assert stage.segmented == (stage.segmenter.calls[-1] == index)
    return stage.segmenter.calls, quality


@pytest.mark.slow
def test_every_frame_every_nth_and_keyframes(monkeypatch):
    assert run(SegmentationSettings())[0] == list(range(10))
    calls, quality = run(SegmentationSettings(schedule="every_nth", n=4))
    assert calls == [0, 4, 8]
    assert min(quality) > 0.9
    calls, quality = run(SegmentationSettings(schedule="keyframes"), keyframes=(0, 7))
    assert calls == [0, 7]
    assert min(quality) > 0.88
    monkeypatch.setattr(schedule, "MAX_CARRY", 3)
    assert run(SegmentationSettings(schedule="keyframes"))[0] == [0, 3, 6, 9]
    assert min(run(SegmentationSettings(schedule="every_nth", n=5, carry="sparse"))[1]) > 0.9


@pytest.mark.slow
@pytest.mark.parametrize(("when", "rests"), [("every_nth", [0, 4, 8]), ("keyframes", [0])])
def test_where_masks_cover_much_of_the_view_every_frame_is_segmented(when, rests):
    covered = scene(0)[1].mean()  # carried masks may cover a little less or more
    settings = SegmentationSettings(schedule=when, n=4)
    less, more = (
        settings.model_copy(update={"crowded_share": factor * covered}) for factor in (0.5, 1.5)
    )
    assert run(less, keyframes=(0,))[0] == list(range(10))
    assert run(more, keyframes=(0,))[0] == rests
    assert run(less.model_copy(update={"confidence": 0.95}), keyframes=(0,))[0] == rests, (
        "masks that do not count"
    )


ASYNC = SegmentationSettings(schedule="async", latency_s=0.09)


@pytest.mark.parametrize("takes_s", [0.0, 0.05])
def test_beside_tracking_masks_come_late_by_the_stamps_and_are_carried_to_the_frame(takes_s):
    stage = MaskScheduler(ASYNC, Square(takes_s))
    taken = []
    quality = []
    for index in range(14):
        if index == 8:
            stage = deepcopy(stage)
        quality.append(feed(stage, index, keyframe=True)[1])
        taken += [index] * stage.segmented
    stage.reset()
    assert stage.segmenter.calls == [0, 1, 4, 7, 10, 13]
    assert taken == [0, 4, 7, 10, 13]
    assert min(quality) > 0.85
    feed(stage, 0)
    assert stage.segmented, "a sequence begins with masks"


def test_without_a_latency_masks_are_taken_when_they_are_done():
    class Held(Square):
        released = threading.Event()

        def segment(self, frame):
            assert frame.index == 0 or self.released.wait(30)
            return super().segment(frame)

    stage = MaskScheduler(ASYNC.model_copy(update={"latency_s": 0.0}), Held())
    for index in range(5):
        feed(stage, index)
        assert stage.segmented == (index == 0)
    Held.released.set()
    wait([stage._request.answer])
    assert feed(stage, 5)[1] > 0.85
    assert stage.segmented


def test_beside_tracking_missed_detections_count_the_frames_between_those_segmented(monkeypatch):
    stage = MaskScheduler(ASYNC, Square())
    apart = []
    update = stage._missed.update
    monkeypatch.setattr(
        stage._missed, "update", lambda found, frames: apart.append(frames) or update(found, frames)
    )
    for index in range(11):
        feed(stage, index)
    assert stage.segmenter.calls[:4] == [0, 1, 4, 7]
    assert apart == [1, 1, 3, 3]


@pytest.mark.slow
@pytest.mark.parametrize("epoch", [0.0, 1311868164.3])
def test_beside_tracking_masks_are_due_at_the_same_frames_from_any_first_stamp(epoch):
    """A latency of three frames is three frames, however the sum of stamp and latency is rounded."""
    stage = MaskScheduler(SegmentationSettings(schedule="async", latency_s=0.1), Square())
    taken = []
    for index in range(20):
        frame = frame_of(scene(3 * index)[0], index)
        stage.masks_for(
            replace(frame, timestamp=epoch + index / 30), frame.rgb[:, :, 0], keyframe=False
        )
        taken += [index] * stage.segmented
    assert taken == [0, 4, 7, 10, 13, 16, 19]


def test_beside_tracking_the_segmenter_keeps_the_settings_that_it_began_with():
    strict = ASYNC.model_copy(update={"confidence": 0.95})  # its objects have less
    stage = MaskScheduler(ASYNC, ConfiguredSegmenter(Square(0.05), ASYNC, "test"))
    found = []
    for index in range(8):
        found.append(len(feed(stage, index)[0]))
        stage.configure(strict if index in (1, 2, 3) else ASYNC)
    assert found == [1] * 8


def test_beside_tracking_nothing_comes_from_the_stage_cache(tmp_path):
    network = Square()
    cached = CachedSegmenter(lambda: network, "test", StageCache(tmp_path), lambda: "code")
    for _ in range(2):
        stage = MaskScheduler(ASYNC, ConfiguredSegmenter(cached, ASYNC, "test"))
        for index in range(5):
            feed(stage, index)
        stage.reset()
    assert network.calls == [0, 1, 4, 1, 4], (
        "the first frame is segmented before it is tracked, and stored"
    )


@pytest.mark.parametrize(
    "end", ["masks are taken", "wait_for_segmenter", "reset", "configure", "a copy's wait"]
)
def test_an_error_of_the_segmenter_beside_tracking_is_raised_where_its_masks_are_taken_else_warned_of(
    end,
):
    stage = MaskScheduler(ASYNC, Square(broken=4))
    for index in range(7):
        feed(stage, index)
    if end.startswith("a copy"):
        stage = deepcopy(stage)
    ends = {
        "masks are taken": lambda: feed(stage, 7),
        "configure": lambda: stage.configure(SegmentationSettings()),
        "reset": stage.reset,
    }
    with (
        pytest.raises(RuntimeError, match="frame 4")
        if end == "masks are taken"
        else pytest.warns(RuntimeWarning, match="frame 4")
    ):
        ends.get(end, stage.wait_for_segmenter)()
    stage.wait_for_segmenter()


def test_the_schedule_may_change_while_the_segmenter_runs_beside_tracking():
    """It finishes first, what it was asked before is forgotten, and masks stay those of the frame."""
    stage = MaskScheduler(ASYNC, Square())
    taken = []
    for index in range(12):
        stage.configure(SegmentationSettings() if index in (3, 4) else ASYNC)
        assert feed(stage, index)[1] > 0.85
        taken += [index] * stage.segmented
    stage.reset()
    assert taken == [0, 3, 4, 8, 11]
    assert stage.segmenter.calls == [0, 1, 3, 4, 5, 8, 11]


def test_settings_may_change_while_a_run_lasts_and_reset_forgets():
    settings = SegmentationSettings(schedule="every_nth", n=10)
    stage = MaskScheduler(settings, Square())
    changes = {2: settings.model_copy(update={"n": 1}), 3: settings}
    for index in range(5):
        stage.configure(changes.get(index, settings))
        if index == 4:
            stage.reset()
        feed(stage, index)
    assert stage.segmenter.calls == [0, 2, 4]


# --- metrics -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("scores", "hits", "truths", "expected"),
    [
        # recall .5 at precision 1, recall 1 at precision 2/3: 51 points at 1, 50 at 2/3
        ([0.9, 0.8, 0.7], [True, False, True], 2, (51 + 50 * 2 / 3) / 101),
        ([0.9], [True], 2, 51 / 101),
        ([], [], 3, 0.0),
        ([0.5], [False], 0, np.nan),
    ],
)
def test_average_precision_by_hand(scores, hits, truths, expected):
    precision = pytest.approx(expected, rel=1e-6, abs=0.0, nan_ok=True)
    assert average_precision(np.array(scores), np.array(hits, bool), truths) == precision


def add(tally, true=(), guess=(), scores=None):
    found = instances(*guess, scores=scores)
    tally.add(instances(*true).masks, found.masks, found.scores)


def test_quality_of_perfect_shifted_missed_and_false_detections():
    tally = MaskTally()
    add(tally, [walker(0), walker(10)], [walker(0), walker(10)])
    perfect = tally.quality()
    assert [perfect[name] for name in ("ap", "iou", "instance_iou", "recall", "truths")] == [
        1,
        1,
        1,
        1,
        2,
    ]
    add(tally, [walker(5)])
    add(tally, [], [walker(5)])
    quality = tally.quality()
    assert (quality["truths"], quality["detections"]) == (3, 3)
    assert 0 < quality["ap50"] < 1
    shares = [quality[name] for name in ("recall", "instance_iou", "iou", "frame_iou")]
    assert shares == pytest.approx([2 / 3, 2 / 3, 2 / 4, 1 / 3])
    nothing = MaskTally().quality()
    assert nothing["truths"] == 0
    assert nothing["ap"] is None
    assert nothing["iou"] is None


def test_two_detections_of_one_object_count_once_and_small_objects_are_left_out():
    tally = MaskTally()
    add(tally, [walker(0)], [walker(0), walker(0)], scores=[0.9, 0.8])
    assert tally.quality()["ap50"] == 1.0
    add(tally, [walker(0)], [walker(0)], scores=[0.7])
    assert tally.quality()["ap50"] < 1.0  # the duplicate at .8 lies between the hits
    small = MaskTally(min_area=100)
    add(small, [walker(0), block(0, 5, 0, 5)], [walker(0), block(0, 5, 0, 5)])
    assert (small.quality()["truths"], small.quality()["ap"]) == (1, 1.0)
