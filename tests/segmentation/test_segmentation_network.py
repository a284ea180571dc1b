"""The Mask R-CNN: its building blocks against slow references, its checkpoints, its behaviour as a segmenter."""

import copy
import re

import cv2
import numpy as np
import pytest
import torch

from dynslam_bench.contracts.sequence import Frame
from dynslam_bench.core.errors import SegmentationError
from dynslam_bench.segmentation.build_segmenter import (
    build_segmenter,
    resolve_source,
    weights_digest,
)
from dynslam_bench.segmentation.networks import network as box_ops
from dynslam_bench.segmentation.networks.backbone import RESNET18, NetworkConfig
from dynslam_bench.segmentation.networks.checkpoints import embedded_weights
from dynslam_bench.segmentation.networks.loading import load_network, save_network
from dynslam_bench.segmentation.networks.mask_rcnn_segmenter import MaskRCNNSegmenter, paste
from dynslam_bench.segmentation.networks.network import MaskRCNN, levels_of, roi_align
from dynslam_bench.segmentation.settings import SegmentationSettings
from dynslam_bench.sequences.catalogue import open_sequence

SMALL = NetworkConfig(
    blocks=(1, 1, 1, 1), bottleneck=False, stem=8, channels=16, classes=("person", "chair"), box_hidden=16,
    mask_channels=8, mask_layers=1, min_side=64, max_side=128, pre_nms=50, post_nms=20, norm="batch",
)  # fmt: skip


def random_boxes(count, rng, side=100.0):
    corner = rng.uniform(0, side, (count, 2))
    return torch.tensor(
        np.concatenate([corner, corner + rng.uniform(1, side / 2, (count, 2))], axis=1),
        dtype=torch.float32,
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
    assert (
        box_ops.nms(boxes, scores, threshold).tolist()
        == np.asarray(expected, int).reshape(-1).tolist()
    )


def test_suppression_of_a_long_chain_is_greedy_and_by_group():
    starts = torch.arange(40, dtype=torch.float32) * 4
    boxes = torch.stack([starts, torch.zeros(40), starts + 10, torch.full((40,), 10.0)], dim=1)
    scores = torch.linspace(1, 0, 40)
    assert box_ops.nms(boxes, scores, 0.3).tolist() == list(range(0, 40, 2))
    assert box_ops.grouped_nms(boxes, scores, torch.arange(40) % 2, 0.3).tolist() == list(range(40))


def test_codes_are_inverse():
    rng = np.random.default_rng(0)
    references = random_boxes(50, rng)
    boxes = random_boxes(50, rng)
    codes = box_ops.encode(boxes, references, box_ops.BOX_WEIGHTS)
    assert torch.allclose(
        box_ops.decode(codes, references, box_ops.BOX_WEIGHTS)[:, 0], boxes, atol=1e-3
    )
    assert torch.isfinite(
        box_ops.decode(torch.full((50, 4), 1e4), references, box_ops.RPN_WEIGHTS)
    ).all()


def slow_roi_align(feature, box, scale, size, samples):
    """RoIAlign by its definition, one sample at a time."""
    channels, height, width = feature.shape
    x0, y0, x1, y1 = (float(value) * scale for value in box)
    step_y = max(y1 - y0, 1.0) / size
    step_x = max(x1 - x0, 1.0) / size
    out = np.zeros((channels, size, size))
    for i in range(size):
        for j in range(size):
            for a in range(samples):
                for b in range(samples):
                    y = y0 + (i + (a + 0.5) / samples) * step_y
                    x = x0 + (j + (b + 0.5) / samples) * step_x
                    if y < -1 or y > height or x < -1 or x > width:
                        continue
                    y = min(max(y, 0), height - 1)
                    x = min(max(x, 0), width - 1)
                    r = min(int(y), height - 1)
                    c = min(int(x), width - 1)
                    r1 = min(r + 1, height - 1)
                    c1 = min(c + 1, width - 1)
                    fy = y - r
                    fx = x - c
                    out[:, i, j] += (1 - fy) * (
                        (1 - fx) * feature[:, r, c] + fx * feature[:, r, c1]
                    ) + fy * ((1 - fx) * feature[:, r1, c] + fx * feature[:, r1, c1])
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
        expected = slow_roi_align(
            features[level][0 if k < 12 else 1].numpy(), box, 1 / (4 * 2**level), 7, 2
        )
        assert np.allclose(found[k].numpy(), expected, atol=1e-4)
    assert roi_align(features, [boxes[0][:0], boxes[1][:0]], 256, 7, canonical=60.0).shape == (
        0,
        5,
        7,
        7,
    )


def test_box_levels_follow_the_paper():
    sides = torch.tensor([10.0, 111.9, 112.0, 223.9, 224.0, 447.9, 448.0, 5000.0])
    boxes = torch.stack([sides * 0, sides * 0, sides, sides], dim=1)
    assert levels_of(boxes, 224.0, 4).tolist() == [0, 0, 1, 1, 2, 2, 3, 3]


def test_a_fresh_cfpn_changes_nothing_and_a_trained_one_the_masks_only():
    plain = network(SMALL.model_copy(update={"cfpn": False}))
    fused = network()
    fused.load_state_dict(plain.state_dict(), strict=False)
    image = torch.rand(3, 60, 80)
    before = plain.detect(image)
    after = fused.detect(image)
    assert len(before.boxes) > 0
    names = ("boxes", "labels", "scores", "masks")
    assert [
        name for name in names if not torch.equal(getattr(before, name), getattr(after, name))
    ] == []
    with torch.no_grad():
        for smooth in fused.backbone.cfpn.smooth:
            smooth.weight.normal_(0, 0.1)
    trained = fused.detect(image)
    assert torch.equal(before.boxes, trained.boxes)
    assert not torch.allclose(before.masks, trained.masks)


def test_fusing_batch_norm_changes_no_output():
    for config in (
        SMALL,
        SMALL.model_copy(update={"norm": "frozen", "bottleneck": True, "blocks": (1, 2, 1, 1)}),
    ):
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
    state = {
        k: v.clone()
        for k, v in network(config).state_dict().items()
        if not k.startswith("backbone.cfpn.")
    }
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
    # narrow: same keys
    config = NetworkConfig(norm="batch", stem=8, channels=16, box_hidden=16, mask_channels=16)
    state = published(config, layout)
    assert len(state) == keys
    torch.save(state, tmp_path / "coco.pth")
    loaded = load_network(tmp_path / "coco.pth")
    assert loaded.config.blocks == (3, 4, 6, 3)
    assert loaded.config.bottleneck
    assert len(loaded.config.classes) == 90
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
"""Settings of a network with fewer channels, by the names of `NetworkConfig`."""


def test_a_resnet18_checkpoint_is_recognised(tmp_path):
    torch.save(published(RESNET18.model_copy(update=NARROW), "counted"), tmp_path / "r18.pth")
    with pytest.warns(UserWarning, match="does not name its only class: it is taken for person"):
        config = load_network(tmp_path / "r18.pth").config
    assert (config.blocks, config.bottleneck, config.stem, config.classes) == (
        (2, 2, 2, 2),
        False,
        8,
        ("person",),
    )


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
        assert [text for text in (str(path), *texts) if text not in str(error.value)] == [], (
            error.value
        )

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
    refused(
        {**good, "rpn.head.bbox_pred.bias": torch.full((12,), float("nan"))},
        "rpn.head.bbox_pred.bias holds NaN",
    )
    refused(
        {"fc.weight": torch.zeros(3, 3)},
        "is no Mask R-CNN",
        "backbone.body.conv1.weight is missing",
    )
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
    assert found.masks.shape[1:] == shape[:2]
    assert found.masks.dtype == bool
    assert len(found.masks) == len(found) == len(found.boxes) == len(found.scores)
    assert not len(found) or floor < 1
    assert (found.boxes[:, [0, 1]] >= 0).all()
    assert (found.boxes[:, 2] <= shape[1]).all()


def test_a_weights_file_as_source(tmp_path):
    save_network(network(), tmp_path / "own.pt")
    settings = SegmentationSettings(
        source=f"weights:{tmp_path / 'own.pt'}", confidence=0.05, network_side=0
    )
    first, second = (
        build_segmenter(settings, threads=1).segment(frame((48, 64, 3))) for _ in range(2)
    )
    assert len(first) > 0
    assert set(first.class_names) == {"person"}
    assert np.array_equal(first.masks, second.masks)
    assert np.array_equal(first.scores, second.scores)
    with pytest.raises(
        SegmentationError,
        match=r"none of the 2 classes of the network is among the dynamic ones: dog",
    ):
        build_segmenter(settings.model_copy(update={"classes": "dog"}))
    with pytest.raises(SegmentationError, match="sees no GPU"):
        build_segmenter(settings, device="cuda:99" if not torch.cuda.is_available() else "cuda")
        pytest.skip("there is a GPU")


def test_pasted_masks_fill_their_box():
    plane = np.ones((28, 28), np.float32)
    box = np.array([10, 20, 50, 80], np.float32)
    exact = paste(plane, box, 100, 100, 0.5, exact=True)
    assert exact[20:80, 10:50].all()
    assert exact.sum() == 40 * 60
    rows, columns = np.nonzero(paste(plane, box, 100, 100, 0.5))
    assert (columns.min(), rows.min(), columns.max() + 1, rows.max() + 1) == pytest.approx(
        (10, 20, 50, 80), abs=1.01
    )
    moved = paste(
        np.tile(np.repeat(np.float32([0, 1]), 14), (28, 1)),
        box + np.float32(0.4),
        100,
        100,
        0.5,
        exact=True,
    )
    assert not moved[:, :30].any()
    assert moved[21:80, 31:50].all()
    assert not paste(plane, np.array([-30, -30, -5, -5], np.float32), 100, 100, 0.5).any()


# The network in the package: it is found, small, runs offline, and sees rendered people.


AUTO = SegmentationSettings()


def test_auto_means_embedded_on_rendered_sequences():
    assert embedded_weights().stat().st_size < 15e6
    assert resolve_source(AUTO, "synthetic/walking_xyz?scene=0&frames=60") == "embedded"
    assert len(weights_digest(AUTO, "synthetic/walking_xyz")) == 12
    assert (
        f'"{weights_digest(AUTO, "synthetic/walking_xyz")}"'
        in embedded_weights().with_suffix(".json").read_text()
    )


@pytest.mark.slow
def test_it_finds_people_of_a_held_out_instance(tmp_path):
    segmenter = build_segmenter(AUTO, sequence_id="synthetic/walking_xyz", threads=1)
    sequence = open_sequence("synthetic/sitting_xyz?scene=120&frames=30", data_root=tmp_path)
    frame = sequence[5]
    masks = sequence.masks[5]
    people = np.isin(
        masks.instances, [k for k, name in masks.class_names.items() if name == "person"]
    )
    found = segmenter.segment(frame)
    again = segmenter.segment(frame)
    union = found.union()
    assert set(found.class_names) == {"person"}
    assert len(found) == 2
    assert (union & people).sum() / (union | people).sum() > 0.85
    assert np.array_equal(found.masks, again.masks)
    assert np.array_equal(found.scores, again.scores)


# Whole models against torchvision's own, on random weights; skipped where torchvision cannot be
# imported.


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


@pytest.mark.parametrize(
    ("seed", "shape", "size"), [(0, (120, 160), (128, 171)), (1, (100, 90), (96, 128))]
)
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
