"""Networks of probability maps in TensorFlow Lite files, and their maps carried from frame to frame."""

import copy
import pickle
from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers.tflite_files import RELU, UINT8, tflite

from dynslam_bench.contracts import Frame
from dynslam_bench.core import SegmentationError
from dynslam_bench.segmentation.build_segmenter import build_segmenter
from dynslam_bench.segmentation.carried_probability import CarriedProbability
from dynslam_bench.segmentation.networks import checkpoints
from dynslam_bench.segmentation.networks.tflite_header import read_tflite_header
from dynslam_bench.segmentation.networks.tflite_segmenter import TfliteSegmenter
from dynslam_bench.segmentation.schedule import MaskScheduler
from dynslam_bench.segmentation.settings import SegmentationSettings

SELFIE = Path(__file__).parents[3] / "shared/weights/selfie_segmentation.tflite"
SIGMOID_OF_ONE = 1 / (1 + np.exp(-1))


def settings(**changes):
    """The test's network gives 0.5 for black and 0.73 for white."""
    return SegmentationSettings(**{"map_threshold": 0.6, **changes})


def frame(index, *boxes, size=(48, 64)):
    """A dark textured image with white boxes (x0, y0, x1, y1)."""
    rng = np.random.default_rng(0)
    rgb = rng.integers(0, 30, (*size, 3)).astype(np.uint8)
    for x0, y0, x1, y1 in boxes:
        rgb[y0:y1, x0:x1] = 255
    return Frame(index, float(index), rgb, np.zeros(size, np.float32))


@pytest.fixture
def network(tmp_path):
    """Writes a network; returns its path."""

    def write(name="net.tflite", **options):
        path = tmp_path / name
        path.write_bytes(tflite(**options))
        return path

    return write


def test_the_header_of_a_file(network):
    header = read_tflite_header(network())
    assert [tensor.shape for tensor in header.inputs] == [(1, 24, 32, 3)]
    assert [(tensor.shape, tensor.element) for tensor in header.outputs] == [
        ((1, 24, 32, 3), "float32")
    ]
    assert header.made_by == (14,)
    assert header.labels == ("person", "dog", "cat")


def test_objects_are_the_parts_above_the_threshold(network):
    segmenter = TfliteSegmenter(network(), settings(map_decay=0.0))
    found = segmenter.segment(frame(0, (4, 4, 24, 44), (40, 10, 60, 40)))
    assert found.class_names == ("person", "person")
    assert found.scores == pytest.approx([SIGMOID_OF_ONE] * 2, abs=1e-3)
    truth = frame(0, (4, 4, 24, 44), (40, 10, 60, 40)).rgb[:, :, 0] > 200
    overlap = (found.union() & truth).sum() / (found.union() | truth).sum()
    assert overlap > 0.9
    both = TfliteSegmenter(network(), settings(map_decay=0.0, classes="person,dog"))
    assert both.segment(frame(0, (4, 4, 24, 44))).class_names == ("person", "dog")
    assert len(segmenter.segment(frame(1))) == 0


def test_everything_may_be_masked(network):
    segmenter = TfliteSegmenter(network(), settings())
    for index in range(3):
        found = segmenter.segment(frame(index, (0, 0, 64, 48)))
        assert found.union().all()
        assert len(found) == 1


def test_a_network_that_flickers_is_bridged_and_then_forgotten(network):
    # 0.73 x 0.9 is above 0.6, and 0.73 x 0.81 is not
    box = (20, 10, 44, 38)
    segmenter = TfliteSegmenter(network(), settings(map_decay=0.9, map_threshold=0.63))
    shown = frame(0, box)
    assert len(segmenter.segment(shown)) == 1
    dark = frame(1)
    carried = segmenter.segment(dark)
    assert len(carried) == 1
    # dense flow between a box and none is not exact
    assert carried.union()[15:33, 25:39].mean() > 0.4
    assert len(segmenter.segment(frame(2))) == 0
    # without a decay nothing is carried, and a new sequence begins without the old one
    alone = TfliteSegmenter(network(), settings(map_decay=0.0))
    assert [len(alone.segment(f)) for f in (shown, dark)] == [1, 0]
    segmenter.segment(frame(3, box))
    segmenter.reset()
    assert len(segmenter.segment(frame(4))) == 0


def test_a_new_sequence_begins_without_the_maps_of_the_last_one(network):
    chosen = settings(source=f"tflite:{network()}", map_decay=0.9, map_threshold=0.63, compensate=0)
    scheduler = MaskScheduler(chosen, build_segmenter(chosen))
    black = frame(1)
    for resets, expected in ((False, 1), (True, 0)):
        scheduler.reset()
        scheduler.masks_for(frame(0, (20, 10, 44, 38)), frame(0).rgb[:, :, 0], keyframe=True)
        if resets:
            scheduler.reset()
        assert len(scheduler.masks_for(black, black.rgb[:, :, 0], keyframe=True)) == expected


def test_maps_move_with_the_image():
    rng = np.random.default_rng(3)
    texture = cv2.GaussianBlur(rng.integers(0, 255, (240, 360)).astype(np.uint8), (0, 0), 3)
    first = np.ascontiguousarray(texture[:, 20:340])
    second = np.ascontiguousarray(texture[:, 10:330])
    maps = np.zeros((1, 64, 64), np.float32)
    maps[0, 20:40, 20:30] = 1
    carried = CarriedProbability(0.5)
    assert carried.join(maps, first, 5) is maps
    joined = carried.join(np.zeros_like(maps), second, 6)
    # ten of 320 pixels to the right are two of 64
    assert joined.max() == pytest.approx(0.5, abs=0.02)
    columns = joined[0, 30] > 0.25
    assert np.flatnonzero(columns)[[0, -1]] == pytest.approx([22, 31], abs=1)
    # two frames later it counts a quarter of that; an earlier frame begins a sequence
    assert carried.join(np.zeros_like(maps), second, 8).max() == pytest.approx(0.125, abs=0.02)
    assert carried.join(np.zeros_like(maps), second, 2).max() == 0


def test_a_copy_remembers_the_same_frames(network):
    segmenter = TfliteSegmenter(network(), settings(map_decay=0.9, map_threshold=0.63))
    segmenter.segment(frame(0, (20, 10, 44, 38)))
    copies = [copy.deepcopy(segmenter), pickle.loads(pickle.dumps(segmenter)), segmenter]
    found = [one.segment(frame(1)) for one in copies]
    assert all(len(one) == 1 for one in found)
    assert (found[0].masks == found[2].masks).all()
    assert (found[1].masks == found[2].masks).all()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"inputs": [(1, 24, 32, 4)]}, r"of another task: it takes tensor_0 1x24x32x4 float32"),
        ({"inputs": [(1, 24, 32, 3)] * 2}, r"of another task: it takes tensor_0 .*; tensor_1"),
        ({"elements": UINT8}, r"of another task: it takes tensor_0 1x24x32x3 uint8"),
        ({"outputs": [(1, 1000)]}, r"of another task: it gives tensor_1 1x1000"),
        (
            {"outputs": [(1, 24, 32, 3), (1, 10, 4)]},
            r"of another task: it gives tensor_1 .*; tensor_2",
        ),
        ({"outputs": [(1, 1, 1, 1001)]}, r"of another task: it gives tensor_1 1x1x1x1001"),
        # a network of depth has the shapes of one of people
        ({"operator": RELU}, r"made by operator 19, which gives no probabilities"),
        ({"labels": ()}, r"0 labels for 3 maps"),
        ({"labels": ("a", "b")}, r"2 labels for 3 maps"),
        ({"labels": ("cat", "dog", "cow")}, r"none of the 3 classes of the network is among"),
    ],
)
def test_a_file_of_another_task_is_refused_in_one_line(network, options, words):
    with pytest.raises(SegmentationError, match=words) as caught:
        TfliteSegmenter(network(**options), settings())
    assert "\n" not in caught.value.args[0]


@pytest.mark.parametrize("content", [b"", b"TFL3", b"\0" * 64, b"\x08\0\0\0TFL3" + b"\xff" * 40])
def test_a_damaged_file_is_refused(tmp_path, content):
    path = tmp_path / "net.tflite"
    path.write_bytes(content)
    with pytest.raises(SegmentationError, match="is not a TensorFlow Lite model"):
        TfliteSegmenter(path, settings())
    with pytest.raises(SegmentationError, match="cannot read the network"):
        TfliteSegmenter(tmp_path / "none.tflite", settings())


def test_every_cut_of_a_file_is_refused(network, tmp_path):
    whole = network(labels=()).read_bytes()
    for length in range(0, len(whole), 7):
        path = tmp_path / "cut.tflite"
        path.write_bytes(whole[:length])
        with pytest.raises(SegmentationError):
            TfliteSegmenter(path, settings())


def test_the_named_network_is_downloaded_as_it_was_published(monkeypatch, tmp_path):
    assert checkpoints.SELFIE.license == "Apache-2.0"
    assert len(checkpoints.SELFIE.sha256_prefix) == 64
    monkeypatch.setenv("DYNSLAM_BENCH_WEIGHTS", str(tmp_path))
    if not SELFIE.is_file():
        pytest.skip("the network is not here")
    (tmp_path / checkpoints.SELFIE.file).write_bytes(SELFIE.read_bytes())
    # no warning: it is known that its only map shows people
    segmenter = build_segmenter(SegmentationSettings(source="selfie"))
    assert segmenter is not None
    assert segmenter.segment(frame(0, size=(240, 320))).masks.shape[1:] == (240, 320)
