"""Whole models against torchvision's own, on random weights; skipped where torchvision cannot be imported."""

import numpy as np
import pytest
import torch

from dynslam_bench.segmentation.networks.loading import load_network
from dynslam_bench.segmentation.networks.mask_rcnn_segmenter import paste


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
    state = model.state_dict()
    torch.save(state, tmp_path / "theirs.pth")
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
        unsure = np.abs(soft - 0.5) < 2e-3
        assert ((mask == (soft >= 0.5)) | unsure).all()
