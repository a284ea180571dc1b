"""The Mask R-CNN: its building blocks against slow references, its checkpoints, its behaviour as a segmenter."""

import copy
import pickle
import re
from copy import deepcopy
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from dynslam_bench.contracts.sequence import Frame
from dynslam_bench.core.errors import SegmentationError
from dynslam_bench.segmentation.build_segmenter import build_segmenter, resolve_source, weights_digest
from dynslam_bench.segmentation.networks import network as box_ops
from dynslam_bench.segmentation.networks.backbone import RESNET18, NetworkConfig
from dynslam_bench.segmentation.networks.checkpoints import embedded_weights
from dynslam_bench.segmentation.networks.loading import load_network, save_network
from dynslam_bench.segmentation.networks.mask_rcnn_segmenter import MaskRCNNSegmenter, paste
from dynslam_bench.segmentation.networks.network import MaskRCNN, levels_of, roi_align
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
from dynslam_bench.sequences.catalogue import open_sequence

SMALL = NetworkConfig(
    blocks=(1, 1, 1, 1), bottleneck=False, stem=8, channels=16, classes=("person", "chair"), box_hidden=16,
    mask_channels=8, mask_layers=1, min_side=64, max_side=128, pre_nms=50, post_nms=20, norm="batch",
)  # fmt: skip


def random_boxes(count, rng, side=100.0):
    corner = rng.uniform(0, side, (count, 2))
    return torch.tensor(
        np.concatenate([corner, corner + rng.uniform(1, side / 2, (count, 2))], axis=1), dtype=torch.float32
    )


def network(config=SMALL, seed=0):
    torch.manual_seed(seed)
    made = MaskRCNN(config)
    with torch.no_grad():
        made.roi_heads.box_predictor.cls_score.weight.mul_(20)
        made.rpn.head.cls_logits.weight.mul_(100)
        for module in made.modules():
            if isinstance(module, torch.nn.BatchNorm2d):
                module.running_mean.normal_(0, 0.1)
                module.running_var.uniform_(0.5, 2)
                module.weight.uniform_(0.5, 1.5)
    return made.eval()


# --- building blocks ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("threshold", [0.0, 0.3, 0.5, 0.9])
@pytest.mark.parametrize("count", [0, 1, 2, 60, 300])
def test_nms_equals_opencv(count, threshold):
    rng = np.random.default_rng(count)
    boxes = random_boxes(count, rng)
    scores = torch.tensor((rng.permutation(count) + 1).astype(np.float32) / max(count, 1))
    as_xywh = torch.cat([boxes[:, :2], boxes[:, 2:] - boxes[:, :2]], dim=1).double().tolist()
    expected = cv2.dnn.NMSBoxes(as_xywh, scores.double().tolist(), 0.0, threshold) if count else []
    assert box_ops.nms(boxes, scores, threshold).tolist() == np.asarray(expected, int).reshape(-1).tolist()


def test_suppression_of_a_long_chain_is_greedy_and_by_group():
    starts = torch.arange(40, dtype=torch.float32) * 4
    boxes = torch.stack([starts, torch.zeros(40), starts + 10, torch.full((40,), 10.0)], dim=1)
    scores = torch.linspace(1, 0, 40)
    assert box_ops.nms(boxes, scores, 0.3).tolist() == list(range(0, 40, 2))
    assert box_ops.grouped_nms(boxes, scores, torch.arange(40) % 2, 0.3).tolist() == list(range(40))


def test_codes_are_inverse():
    rng = np.random.default_rng(0)
    boxes, references = random_boxes(50, rng), random_boxes(50, rng)
    codes = box_ops.encode(boxes, references, box_ops.BOX_WEIGHTS)
    assert torch.allclose(box_ops.decode(codes, references, box_ops.BOX_WEIGHTS)[:, 0], boxes, atol=1e-3)
    assert torch.isfinite(box_ops.decode(torch.full((50, 4), 1e4), references, box_ops.RPN_WEIGHTS)).all()


def slow_roi_align(feature, box, scale, size, samples):
    """RoIAlign by its definition, one sample at a time."""
    channels, height, width = feature.shape
    x0, y0, x1, y1 = (float(value) * scale for value in box)
    step_y, step_x = max(y1 - y0, 1.0) / size, max(x1 - x0, 1.0) / size
    out = np.zeros((channels, size, size))
    for i in range(size):
        for j in range(size):
            for a in range(samples):
                for b in range(samples):
                    y = y0 + (i + (a + 0.5) / samples) * step_y
                    x = x0 + (j + (b + 0.5) / samples) * step_x
                    if y < -1 or y > height or x < -1 or x > width:
                        continue
                    y, x = min(max(y, 0), height - 1), min(max(x, 0), width - 1)
                    r, c = min(int(y), height - 1), min(int(x), width - 1)
                    r1, c1, fy, fx = min(r + 1, height - 1), min(c + 1, width - 1), y - r, x - c
                    out[:, i, j] += (1 - fy) * ((1 - fx) * feature[:, r, c] + fx * feature[:, r, c1]) + fy * (
                        (1 - fx) * feature[:, r1, c] + fx * feature[:, r1, c1]
                    )
    return out / samples**2


def test_roi_align_equals_its_definition():
    rng = np.random.default_rng(1)
    features = [torch.randn(2, 5, 64 // 2**k, 96 // 2**k) for k in range(4)]
    boxes = [random_boxes(12, rng, 250), random_boxes(9, rng, 250) - 20]
    found = roi_align(features, boxes, 256, 7, canonical=60.0)
    assert found.shape == (21, 5, 7, 7)
    levels = levels_of(torch.cat(boxes), 60.0, 4)
    assert len(set(levels.tolist())) >= 3
    for k, box in enumerate(torch.cat(boxes)):
        level = int(levels[k])
        expected = slow_roi_align(features[level][0 if k < 12 else 1].numpy(), box, 1 / (4 * 2**level), 7, 2)
        assert np.allclose(found[k].numpy(), expected, atol=1e-4)
    assert roi_align(features, [boxes[0][:0], boxes[1][:0]], 256, 7, canonical=60.0).shape == (0, 5, 7, 7)


def test_box_levels_follow_the_paper():
    sides = torch.tensor([10.0, 111.9, 112.0, 223.9, 224.0, 447.9, 448.0, 5000.0])
    boxes = torch.stack([sides * 0, sides * 0, sides, sides], dim=1)
    assert levels_of(boxes, 224.0, 4).tolist() == [0, 0, 1, 1, 2, 2, 3, 3]


def test_a_fresh_cfpn_changes_nothing_and_a_trained_one_the_masks_only():
    plain, fused = network(SMALL.model_copy(update={"cfpn": False})), network()
    fused.load_state_dict(plain.state_dict(), strict=False)
    image = torch.rand(3, 60, 80)
    before, after = plain.detect(image), fused.detect(image)
    assert len(before.boxes) > 0
    names = ("boxes", "labels", "scores", "masks")
    assert [name for name in names if not torch.equal(getattr(before, name), getattr(after, name))] == []
    with torch.no_grad():
        for smooth in fused.backbone.cfpn.smooth:
            smooth.weight.normal_(0, 0.1)
    trained = fused.detect(image)
    assert torch.equal(before.boxes, trained.boxes) and not torch.allclose(before.masks, trained.masks)


def test_fusing_batch_norm_changes_no_output():
    for config in (SMALL, SMALL.model_copy(update={"norm": "frozen", "bottleneck": True, "blocks": (1, 2, 1, 1)})):
        made = network(config)
        x, _ = made.prepare(torch.rand(3, 60, 80))
        before = made.backbone(x)[0]
        after = copy.deepcopy(made).fuse().backbone(x)[0]
        assert len(before) > 1
        for a, b in zip(before, after, strict=True):
            assert torch.allclose(a, b, atol=1e-4 * float(a.detach().abs().max()))


# --- checkpoints -------------------------------------------------------------------------------------------------


def published(config, layout):
    """A state dict with torchvision's names: 'frozen' (no counters), 'counted', or '2019'."""
    state = {k: v.clone() for k, v in network(config).state_dict().items() if not k.startswith("backbone.cfpn.")}
    if layout != "counted":
        state = {k: v for k, v in state.items() if not k.endswith("num_batches_tracked")}
    if layout == "2019":
        for pattern, new in (
            (r"(fpn\.(?:inner|layer)_blocks\.\d)\.0\.", r"\1."),
            (r"rpn\.head\.conv\.0\.0\.", "rpn.head.conv."),
            (r"mask_head\.(\d)\.0\.", lambda m: f"mask_head.mask_fcn{int(m[1]) + 1}."),
        ):
            state = {re.sub(pattern, new, key): value for key, value in state.items()}
    return state


@pytest.mark.parametrize(("layout", "keys"), [("frozen", 307), ("counted", 360), ("2019", 307)])
def test_the_three_published_layouts_load_strictly(tmp_path, layout, keys):
    config = NetworkConfig(norm="batch", stem=8, channels=16, box_hidden=16, mask_channels=16)  # narrow: same keys
    state = published(config, layout)
    assert len(state) == keys
    torch.save(state, tmp_path / "coco.pth")
    loaded = load_network(tmp_path / "coco.pth")
    assert loaded.config.blocks == (3, 4, 6, 3) and loaded.config.bottleneck and len(loaded.config.classes) == 90
    own = loaded.state_dict()
    assert all(torch.equal(own[key], value) for key, value in published(config, "frozen").items())
    assert all(not key.startswith("backbone.cfpn.smooth") or not own[key].any() for key in own)


def test_our_own_format_carries_the_shape(tmp_path):
    made = network()
    save_network(made, tmp_path / "own.pt")
    save_network(made, tmp_path / "half.pt", half=True)
    loaded = load_network(tmp_path / "own.pt")
    assert loaded.config == SMALL
    assert all(
        torch.equal(value, loaded.state_dict()[key])
        for key, value in made.state_dict().items()
        if not key.endswith("num_batches_tracked")
    )
    assert (tmp_path / "half.pt").stat().st_size < 0.7 * (tmp_path / "own.pt").stat().st_size
    assert next(load_network(tmp_path / "half.pt").parameters()).dtype == torch.float32


NARROW = {"stem": 8, "channels": 16, "box_hidden": 16, "mask_channels": 16}
"""The same keys, fewer numbers."""


def test_a_resnet18_checkpoint_is_recognised(tmp_path):
    torch.save(published(RESNET18.model_copy(update=NARROW), "counted"), tmp_path / "r18.pth")
    config = load_network(tmp_path / "r18.pth").config
    assert (config.blocks, config.bottleneck, config.stem, config.classes) == ((2, 2, 2, 2), False, 8, ("person",))


def test_foreign_checkpoints_say_what_is_wrong(tmp_path):
    path = tmp_path / "bad.pth"
    good = published(RESNET18.model_copy(update=NARROW), "frozen")

    def refused(content, *texts):
        if isinstance(content, bytes):
            path.write_bytes(content)
        else:
            torch.save(content, path)
        with pytest.raises(SegmentationError) as error:
            load_network(path)
        assert [text for text in (str(path), *texts) if text not in str(error.value)] == [], error.value

    refused(
        {k: v for k, v in good.items() if "mask_predictor" not in k},
        "4 keys are missing",
        "roi_heads.mask_predictor.conv5_mask.weight",
    )
    refused({**good, "extra.weight": torch.zeros(1)}, "1 keys are unknown (extra.weight)")
    refused(
        {**good, "rpn.head.bbox_pred.bias": torch.zeros(8)},
        "1 shapes differ (rpn.head.bbox_pred.bias [8] instead of [12])",
    )
    refused({**good, "rpn.head.bbox_pred.bias": torch.full((12,), float("nan"))}, "rpn.head.bbox_pred.bias holds NaN")
    refused({"fc.weight": torch.zeros(3, 3)}, "is no Mask R-CNN", "backbone.body.conv1.weight is missing")
    refused({"epoch": 3}, "holds no weights")
    refused([1, 2, 3], "holds a list")
    refused(b"", "it is truncated")
    refused(b"\x80\x02garbage", "it is truncated")
    torch.save(good, path)
    refused(path.read_bytes()[:5000], "(5000 bytes)", "it is truncated")
    with pytest.raises(SegmentationError, match="cannot read the checkpoint"):
        load_network(tmp_path / "none.pth")


# --- as a segmenter ----------------------------------------------------------------------------------------------


def picture(rgb):
    return Frame(0, 0.0, np.asarray(rgb), np.zeros(np.shape(rgb)[:2], np.float32))


def frame(shape, seed=0):
    return picture(np.random.default_rng(seed).integers(0, 255, shape, dtype=np.uint8))


@pytest.mark.parametrize("shape", [(480, 640, 3), (7, 9, 3), (600, 80, 3), (48, 64, 3)])
def test_images_of_any_size(shape):
    """In the smallest one nothing is found."""
    floor = 1.0 if shape == (48, 64, 3) else 0.01
    settings = SegmentationSettings(classes="person,chair")
    found = MaskRCNNSegmenter(network(), settings, floor=floor).segment(frame(shape))
    assert found.masks.shape[1:] == shape[:2] and found.masks.dtype == bool
    assert len(found.masks) == len(found) == len(found.boxes) == len(found.scores) and (not len(found) or floor < 1)
    assert (found.boxes[:, [0, 1]] >= 0).all() and (found.boxes[:, 2] <= shape[1]).all()


def test_a_weights_file_as_source(tmp_path):
    save_network(network(), tmp_path / "own.pt")
    settings = SegmentationSettings(source=f"weights:{tmp_path / 'own.pt'}", confidence=0.05, network_side=0)
    first, second = (build_segmenter(settings, threads=1).segment(frame((48, 64, 3))) for _ in range(2))
    assert len(first) > 0 and set(first.class_names) == {"person"}
    assert np.array_equal(first.masks, second.masks) and np.array_equal(first.scores, second.scores)
    with pytest.raises(SegmentationError, match=r"knows none of the classes dog \(it knows chair, person\)"):
        build_segmenter(settings.model_copy(update={"classes": "dog"}))
    with pytest.raises(SegmentationError, match="sees no GPU"):
        build_segmenter(settings, device="cuda:99" if not torch.cuda.is_available() else "cuda")
        pytest.skip("there is a GPU")


def test_pasted_masks_fill_their_box():
    plane = np.ones((28, 28), np.float32)
    box = np.array([10, 20, 50, 80], np.float32)
    exact = paste(plane, box, 100, 100, 0.5, exact=True)
    assert exact[20:80, 10:50].all() and exact.sum() == 40 * 60
    rows, columns = np.nonzero(paste(plane, box, 100, 100, 0.5))
    assert (columns.min(), rows.min(), columns.max() + 1, rows.max() + 1) == pytest.approx((10, 20, 50, 80), abs=1.01)
    moved = paste(np.tile(np.repeat(np.float32([0, 1]), 14), (28, 1)), box + np.float32(0.4), 100, 100, 0.5, exact=True)
    assert not moved[:, :30].any() and moved[21:80, 31:50].all()
    assert not paste(plane, np.array([-30, -30, -5, -5], np.float32), 100, 100, 0.5).any()


# The network in the package: it is found, small, runs offline, and sees rendered people.


AUTO = SegmentationSettings()


def test_auto_means_embedded_on_rendered_sequences():
    assert embedded_weights().stat().st_size < 15e6
    assert resolve_source(AUTO, "synthetic/walking_xyz?scene=0&frames=60") == "embedded"
    assert len(weights_digest(AUTO, "synthetic/walking_xyz")) == 12
    assert f'"{weights_digest(AUTO, "synthetic/walking_xyz")}"' in embedded_weights().with_suffix(".json").read_text()


def test_it_finds_people_of_a_held_out_instance(tmp_path):
    segmenter = build_segmenter(AUTO, sequence_id="synthetic/walking_xyz", threads=1)
    sequence = open_sequence("synthetic/sitting_xyz?scene=120&frames=30", data_root=tmp_path)
    frame, masks = sequence[5], sequence.masks[5]
    people = np.isin(masks.instances, [k for k, name in masks.class_names.items() if name == "person"])
    found, again = segmenter.segment(frame), segmenter.segment(frame)
    union = found.union()
    assert set(found.class_names) == {"person"} and len(found) == 2
    assert (union & people).sum() / (union | people).sum() > 0.85
    assert np.array_equal(found.masks, again.masks) and np.array_equal(found.scores, again.scores)


# Whole models against torchvision's own, on random weights; skipped where torchvision cannot be imported.


@pytest.fixture(scope="module")
def torchvision():
    """Torchvision, with Python operators where its compiled ones do not load beside this torch."""
    library = torch.library.Library("torchvision", "DEF")
    try:
        torch.ops.torchvision.nms  # noqa: B018  # asks whether the compiled operators are there
    except (AttributeError, RuntimeError):
        library.define("nms(Tensor dets, Tensor scores, float iou_threshold) -> Tensor")
        library.define("qnms(Tensor dets, Tensor scores, float iou_threshold) -> Tensor")
    module = pytest.importorskip("torchvision", reason="torchvision is not installed")
    from torchvision.ops import boxes

    def nms(dets, scores, threshold):
        iou = boxes.box_iou(dets, dets)
        kept: list[int] = []
        for index in scores.argsort(descending=True, stable=True).tolist():
            kept += [] if (iou[index, kept] > threshold).any() else [index]
        return torch.tensor(kept, dtype=torch.long)

    boxes.nms = nms
    return module


def make(torchvision, seed, size):
    import torch._dynamo

    torch._dynamo.config.disable = True
    torch.manual_seed(seed)
    model = torchvision.models.detection.maskrcnn_resnet50_fpn(
        weights=None, weights_backbone=None, min_size=size[0], max_size=size[1], rpn_pre_nms_top_n_test=60,
        rpn_post_nms_top_n_test=40, box_score_thresh=0.008,
    ).eval()  # fmt: skip
    with torch.no_grad():
        for name, module in model.named_modules():
            if "bn" in name or "downsample.1" in name:
                module.running_var.uniform_(0.8, 1.5)
                module.running_mean.normal_(0, 0.1)
                module.weight.mul_(0.5 if "bn3" in name else 1.0)
        model.rpn.head.cls_logits.weight.mul_(20)
        model.rpn.head.bbox_pred.weight.mul_(5)
        model.roi_heads.box_predictor.bbox_pred.weight.mul_(3)
    return model


@pytest.mark.parametrize(("seed", "shape", "size"), [(0, (120, 160), (128, 171)), (1, (100, 90), (96, 128))])
def test_outputs_equal_torchvisions(torchvision, tmp_path, seed, shape, size):
    model = make(torchvision, seed, size)
    torch.save(model.state_dict(), tmp_path / "theirs.pth")
    ours = load_network(tmp_path / "theirs.pth")
    ours.config = ours.config.model_copy(update={"min_side": size[0], "max_side": size[1]})
    ours.rpn.config = ours.rpn.config.model_copy(update={"pre_nms": 60, "post_nms": 40})
    image = torch.rand(3, *shape, generator=torch.Generator().manual_seed(seed))
    with torch.inference_mode():
        theirs = model([image])[0]
        levels = model.backbone(model.transform([image])[0].tensors)
    x, _ = ours.prepare(image)
    for mine, level in zip(ours.backbone(x)[0], levels.values(), strict=True):
        assert torch.allclose(mine, level, atol=1e-4)
    found = ours.detect(image, score=0.008)
    assert len(found.boxes) == len(theirs["boxes"]) >= 20
    assert torch.equal(found.labels, theirs["labels"])
    assert torch.allclose(found.scores, theirs["scores"], atol=1e-4)
    assert torch.allclose(found.boxes, theirs["boxes"], atol=1e-3)
    for k in range(len(found.boxes)):
        mask = paste(found.masks[k].numpy(), found.boxes[k].numpy(), *shape, 0.5)
        soft = theirs["masks"][k, 0].numpy()
        assert ((mask == (soft >= 0.5)) | (np.abs(soft - 0.5) < 2e-3)).all()


SHARED = Path(__file__).resolve().parents[3] / "shared"
WEIGHTS = SHARED / "weights"
BONN = SHARED / "data" / "bonn" / "rgbd_bonn_crowd"
SETTINGS = SegmentationSettings()


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
    assert [text for text in ("net.onnx", "known: YOLO", *outputs) if text not in str(error.value)] == []


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
    assert len(decode(layout, [value[:0] for value in values], place, SETTINGS, 0.1)) == 0


# Tiny ONNX files whose outputs are constants, written without the onnx package.


FLOAT, INT64 = 1, 7


def varint(value: int) -> bytes:
    out = b""
    while True:
        value, low = value >> 7, value & 127
        out += bytes([low | (128 if value else 0)])
        if not value:
            return out


def number(field: int, value: int) -> bytes:
    return varint(field << 3) + varint(value)


def text(field: int, value: str | bytes) -> bytes:
    data = value.encode() if isinstance(value, str) else value
    return varint(field << 3 | 2) + varint(len(data)) + data


def tensor(name: str, value: np.ndarray) -> bytes:
    kind = INT64 if value.dtype == np.int64 else FLOAT
    dims = b"".join(number(1, size) for size in value.shape)
    return dims + number(2, kind) + text(8, name) + text(9, value.tobytes())


def value_info(name: str, shape, kind: int = FLOAT) -> bytes:
    dims = b"".join(text(1, number(1, size) if isinstance(size, int) else text(2, size)) for size in shape)
    return text(1, name) + text(2, text(1, number(1, kind) + text(2, dims)))


def node(operator: str, inputs, outputs, name: str) -> bytes:
    data = b"".join(text(1, i) for i in inputs) + b"".join(text(2, o) for o in outputs)
    return data + text(3, name) + text(4, operator)


def constant_network(input_shape, outputs: dict[str, np.ndarray]) -> bytes:
    """A network that ignores its image (but for adding its zero-scaled mean) and gives constants.

    Each output is ``constant + 0 * mean(image)``.
    """
    graph = text(1, node("ReduceMean", ["image"], ["mean"], "mean_node"))
    graph += text(1, node("Mul", ["mean", "zero"], ["nothing"], "mul_node"))
    inits = text(5, tensor("zero", np.zeros(1, np.float32))) + text(5, tensor("one_dim", np.array([1], np.int64)))
    outs = b""
    for name, value in outputs.items():
        inits += text(5, tensor(f"const_{name}", value.astype(np.float32)))
        graph += text(1, node("Reshape", ["nothing", "one_dim"], [f"flat_{name}"], f"flatten_{name}"))
        graph += text(1, node("Add", [f"const_{name}", f"flat_{name}"], [name], f"add_{name}"))
        outs += text(12, value_info(name, value.shape))
    graph += text(2, "tiny") + inits + text(11, value_info("image", input_shape)) + outs
    return number(1, 8) + text(7, graph) + text(8, text(1, "") + number(2, 13))


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


@pytest.mark.skipif(not (WEIGHTS.is_dir() and BONN.is_dir()), reason="needs ../shared/weights and ../shared/data")
def test_yolo_and_deeplab_agree_on_bonn():
    names = ("yolov8n-seg_480x640_fp32.onnx", "deeplabv3_mnv2_voc_481x641.onnx")
    segmenters = [build_segmenter(SegmentationSettings(source=f"onnx:{WEIGHTS / name}")) for name in names]
    lines = [line.split() for line in (BONN / "rgb.txt").read_text().splitlines() if line and line[0] != "#"]
    for index, least in ((60, 0.93), (110, 0.93), (150, 0.85)):
        rgb = np.ascontiguousarray(cv2.imread(str(BONN / lines[index][1]))[:, :, ::-1])
        yolo, deeplab = (segmenter.segment(picture(rgb)).union() for segmenter in segmenters)
        assert (yolo & deeplab).sum() / (yolo | deeplab).sum() > least
