"""Settings, classes, oracle and recorded masks, and the choice among the sources."""

import functools
import hashlib
import http.server
import json
import subprocess
import sys
import threading
from contextlib import nullcontext

import cv2
import numpy as np
import pytest

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
from dynslam_bench.segmentation.recorded import OracleSegmenter, RecordedSegmenter
from dynslam_bench.segmentation.settings import COCO_IDS, COCO_NAMES, VOC_NAMES, SegmentationSettings


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


def test_settings_need_neither_torch_nor_opencv():
    code = (
        "import sys; import dynslam_bench.segmentation.settings, dynslam_bench.segmentation.build_segmenter, "
        "dynslam_bench.segmentation.training.settings, dynslam_bench.segmentation.networks.checkpoints; "
        "print([m for m in ('torch', 'cv2') if m in sys.modules])"
    )
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == "[]\n"


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
    offline = dict.fromkeys(("mask_threshold", "schedule"), False)
    assert tunable == dict.fromkeys(("confidence", "dilation_px", "compensate", "outside_share"), True) | offline


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
        (Masks(), frame(shape=(30, 40)), "32x24, the frame 40x30"),
        (Masks(), frame(7), "frame 7"),
        (nameless, frame(), "object 9 has no class name"),
    ):
        with pytest.raises(SegmentationError, match=words):
            OracleSegmenter(masks).segment(wrong)


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
