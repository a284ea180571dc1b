"""Export of a Mask R-CNN to ONNX, with fixed shapes and plain operators that light runtimes understand."""

import logging
import re
import warnings
from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path

import torch
from torch import Tensor, nn
from torch.nn import functional

from dynslam_bench.core import SegmentationError, replacing, translate_errors
from dynslam_bench.core.version import install_hint
from dynslam_bench.segmentation.networks.checkpoints import COCO, embedded_weights, fetch_checkpoint
from dynslam_bench.segmentation.networks.loading import load_network
from dynslam_bench.segmentation.networks.network import (
    BOX_POOL,
    BOX_WEIGHTS,
    MIN_BOX_PX,
    MIN_PROPOSAL_PX,
    RPN_WEIGHTS,
    SAMPLES,
    MaskRCNN,
    anchors_of,
    box_iou,
    clip,
    decode,
    level_scale,
    levels_of,
)
from dynslam_bench.segmentation.settings import NMS_IOU, SegmentationSettings

OPSET = 18
"""Version of ONNX's operators."""
SIZE = (480, 640)
"""Height and width of the images, unless others are asked for: those of TUM and Bonn."""
FLOOR = 0.1
"""Least score of an object that an exported network gives."""
SMALLEST = 32
"""Shortest side of an image in pixels."""
LARGEST = 4096
"""Longest side of an image in pixels."""
ROUNDS = 24
"""Rounds of suppression: the longest chain of boxes that suppress each other."""
CANDIDATES = 400
"""Classified boxes that enter the last suppression, the best first."""
CHUNK = 100
"""Boxes whose features are gathered at a time, which bounds the memory."""


def export_network(
    source: str, path: Path, *, size: tuple[int, int] = SIZE, side: int | None = None
) -> dict[int, str]:
    """Write a Mask R-CNN checkpoint as an ONNX file that ``onnx:PATH`` takes.

    The input ``image [1, 3, H, W]`` is RGB in [0, 1]. The outputs are those of torchvision's
    exports: boxes, labels, scores, masks in the whole image. They have as many rows as the network
    finds objects at most; unused rows have the score 0.

    Args:
        source: ``embedded``, ``coco`` (fetched if need be) or ``weights:PATH``.
        path: The file to write.
        size: Height and width of the images; others are fitted in when it is used.
        side: Shorter side in pixels at which the network works; 0 for its own, None for that of a
            run.

    Returns:
        The names of what the network finds, by number.

    Raises:
        SegmentationError: There is no such checkpoint, it cannot be fetched or read, `onnx` or
            `onnxscript` is missing, or torch cannot export it.
        OSError: The file cannot be written.
    """
    kind, _, argument = source.partition(":")
    if source == "embedded":
        weights = embedded_weights()
    elif source == "coco":
        weights = fetch_checkpoint(COCO)
    elif kind == "weights" and argument:
        weights = Path(argument).expanduser()
    else:
        raise SegmentationError(
            f"'{source}' is no network of this project", "export embedded, coco or weights:PATH"
        )
    if side is None:
        side = 0 if source == "embedded" else SegmentationSettings().network_side
    network = load_network(weights)
    if side > 0:
        network.set_input(side)
    return write_onnx(network.fuse(), path, size=size)


def parse_size(text: str) -> tuple[int, int]:
    """Height and width of ``640x480``, which names the width first.

    Raises:
        SegmentationError: It is no such text, or a side is outside 32 to 4096 pixels.
    """
    match = re.fullmatch(r"(\d{1,4})x(\d{1,4})", text)
    width, height = map(int, match.groups()) if match else (0, 0)
    if not (SMALLEST <= width <= LARGEST and SMALLEST <= height <= LARGEST):
        raise SegmentationError(
            f"'{text}' is no size of an image",
            f"for example 640x480; sides from {SMALLEST} to {LARGEST} pixels",
        )
    return height, width


def write_onnx(network: MaskRCNN, path: Path, *, size: tuple[int, int] = SIZE) -> dict[int, str]:
    """`export_network` of a network in memory.

    Raises:
        SegmentationError: `onnx` or `onnxscript` is missing, or torch cannot export it.
        OSError: The file cannot be written.
    """
    missing = "networks are exported with onnx and onnxscript, which are not both installed"
    with translate_errors(SegmentationError, missing, install_hint("onnx"), of=ImportError):
        import onnx
        import onnxscript  # noqa: F401 - torch's exporter asks for it

    # the network at one size, the example that it is traced with, and its classes' names
    static = StaticMaskRCNN(network, *size, score=FLOOR, iou=NMS_IOU).eval()
    image = torch.rand(1, 3, *size, generator=torch.Generator().manual_seed(0))
    classes = {number: name for number, name in enumerate(network.config.classes, start=1) if name}
    logging.getLogger("torch.onnx").setLevel(logging.ERROR)
    with replacing(path) as temporary:
        with translate_errors(
            SegmentationError,
            f"torch {torch.__version__} cannot export the network",
            "torch >= 2.6",
            of=(torch.onnx.errors.OnnxExporterError, TypeError),
        ):
            # TypeError: options of a newer torch
            with torch.no_grad(), warnings.catch_warnings(), redirect_stdout(StringIO()):
                warnings.simplefilter("ignore")
                torch.onnx.export(
                    static,
                    (image,),
                    str(temporary),
                    dynamo=True,
                    external_data=False,
                    opset_version=OPSET,
                    input_names=["image"],
                    output_names=["boxes", "labels", "scores", "masks"],
                    verbose=False,
                )

        # the class names go into the file; the file appears if it is sound
        model = onnx.load(str(temporary))
        onnx.helper.set_model_props(model, {"names": repr(classes), "producer": "dynslam-bench"})
        onnx.checker.check_model(model)
        onnx.save(model, str(temporary))
    return classes


class StaticMaskRCNN(nn.Module):
    """A `MaskRCNN` for images of one size, without shapes that depend on the image.

    Args:
        network: In inference mode; it is not changed.
        height: Height of the images, pixels.
        width: Width of the images, pixels.
        score: Least score of an object.
        iou: Overlap of two boxes of one class above which the weaker one is dropped.
    """

    def __init__(
        self, network: MaskRCNN, height: int, width: int, *, score: float, iou: float
    ) -> None:
        super().__init__()
        self.network = network
        self.height = height
        self.width = width
        self.score = score
        self.iou = iou
        with torch.no_grad():
            x, self.size = network.prepare(torch.zeros(3, height, width))
            levels, _ = network.backbone(x)
        self.padded = (int(x.shape[2]), int(x.shape[3]))
        for level, anchors in enumerate(anchors_of(network.rpn._cells, levels, *self.padded)):
            self.register_buffer(f"anchors{level}", anchors)

    def forward(self, image: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Objects, best first, padded with objects of score 0 to the network's ``max_detections``.

        Args:
            image: float ``[1, 3, H, W]`` in [0, 1].

        Returns:
            Boxes ``[K, 4]`` in pixels of the image, labels ``[K]`` from 1, scores ``[K]`` and masks
            ``[K, 1, H, W]``, probabilities in the whole image.
        """
        # objects, in pixels of the input
        levels, mask_levels = self.network.backbone(self.network.prepare(image[0])[0])
        boxes, labels, scores = self._classified(levels[:4], *self._proposals(levels))

        # the mask of each object's class
        config = self.network.config
        heads = self.network.roi_heads
        pooled = self._pooled(mask_levels, boxes, config.mask_pool, config.mask_canonical)
        logits = heads.mask_predictor(heads.mask_head(pooled))
        chosen = labels[:, None, None, None].expand(-1, 1, *logits.shape[2:])
        planes = torch.gather(logits, 1, chosen)[:, 0].sigmoid()

        # to pixels of the image
        scale = [self.width / self.size[1], self.height / self.size[0]]
        boxes = boxes * boxes.new_tensor(scale).repeat(2)
        return boxes, labels, scores, self._pasted(planes, boxes)[:, None]

    def _proposals(self, levels: list[Tensor]) -> tuple[Tensor, Tensor]:
        """Boxes ``[post_nms, 4]`` that may hold an object, and whether each is one, 0 or 1."""
        config = self.network.config
        boxes = []
        scores = []
        for level, (logits, codes) in enumerate(zip(*self.network.rpn.head(levels), strict=True)):
            # the best anchors of a level, decoded and suppressed
            anchors: Tensor = getattr(self, f"anchors{level}")
            best, chosen = logits[0].topk(min(config.pre_nms, len(anchors)))
            codes = codes[0].index_select(0, chosen)
            anchors = anchors.index_select(0, chosen)
            box = clip(decode(codes, anchors, RPN_WEIGHTS)[:, 0], *self.size)
            large = ((box[:, 2:] - box[:, :2]) >= MIN_PROPOSAL_PX).all(dim=1).to(box.dtype)
            boxes.append(box)
            scores.append(best.sigmoid() * unsuppressed(box_iou(box, box) > config.rpn_nms, large))
        # the best boxes of all levels; those with score 0 were suppressed
        count = min(config.post_nms, sum(map(len, scores)))
        score, order = torch.cat(scores).topk(count)
        return torch.cat(boxes).index_select(0, order), (score > 0).to(score.dtype)

    def _classified(
        self, levels: list[Tensor], proposals: Tensor, valid: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Boxes ``[K, 4]`` in pixels of the input, labels and scores of the objects."""
        # class scores without the background, and a box for each class
        config = self.network.config
        heads = self.network.roi_heads
        pooled = self._pooled(levels, proposals, BOX_POOL, config.canonical)
        logits, codes = heads.box_predictor(heads.box_head(pooled))
        scores = functional.softmax(logits, dim=1)[:, 1:]
        boxes = clip(decode(codes, proposals, BOX_WEIGHTS), *self.size)[:, 1:]

        # the best pairs of box and class; those that do not count have score 0
        classes = scores.shape[1]
        large = ((boxes[:, :, 2:] - boxes[:, :, :2]) >= MIN_BOX_PX).all(dim=2)
        passed = scores * valid[:, None] * ((scores > self.score) & large).to(scores.dtype)
        best, order = passed.reshape(-1).topk(min(CANDIDATES, passed.numel()))
        box = boxes.reshape(-1, 4).index_select(0, order)
        label = order % classes + 1

        # suppression within each class
        over = (box_iou(box, box) > self.iou) & (label[:, None] == label[None, :])
        left = best * unsuppressed(over, (best > 0).to(best.dtype))
        kept, order = left.topk(min(config.max_detections, len(best)))
        return box.index_select(0, order), label.index_select(0, order), kept

    def _pooled(self, levels: list[Tensor], boxes: Tensor, size: int, canonical: float) -> Tensor:
        """RoIAlign ``[K, C, size, size]`` of one image's boxes; see `roi_align`."""
        if len(boxes) > CHUNK:
            chunks = torch.split(boxes, CHUNK)
            return torch.cat([self._pooled(levels, chunk, size, canonical) for chunk in chunks])

        # the level of each box; padding may be empty
        count = len(boxes)
        channels = levels[0].shape[1]
        side = (boxes[:, 2:] - boxes[:, :2]).clamp(min=1e-3)
        corners = torch.cat([boxes[:, :2], boxes[:, :2] + side], dim=1)
        level = levels_of(corners, canonical, len(levels))

        # every level pools all boxes with weights that are zero for those of another level
        pooled: list[Tensor] = []
        for index, features in enumerate(levels):
            rows = int(features.shape[2])
            columns = int(features.shape[3])
            scaled = boxes * level_scale(rows, self.padded[0])
            of_level = (level == index).to(boxes.dtype)[:, None, None]
            y = _bins(scaled[:, 1], scaled[:, 3], rows, size) * of_level
            x = _bins(scaled[:, 0], scaled[:, 2], columns, size)
            table = features[0].permute(1, 0, 2).reshape(rows, channels * columns)
            by_row = (y.reshape(count * size, rows) @ table).reshape(
                count, size * channels, columns
            )
            pooled.append(
                (by_row @ x.transpose(1, 2))
                .reshape(count, size, channels, size)
                .permute(0, 2, 1, 3)
            )
        return torch.stack(pooled).sum(dim=0)

    def _pasted(self, planes: Tensor, boxes: Tensor) -> Tensor:
        """Masks ``[K, M, M]`` inside boxes as probabilities ``[K, H, W]`` in the image; see `paste`."""
        # interpolation along rows and columns as two products of matrices
        if not self.network.config.exact_paste:
            planes, boxes = _grown(planes, boxes)
        rows = _taps(boxes[:, 1], boxes[:, 3], self.height, planes.shape[1])
        columns = _taps(boxes[:, 0], boxes[:, 2], self.width, planes.shape[2])
        return rows @ planes @ columns.transpose(1, 2)


def unsuppressed(over: Tensor, valid: Tensor) -> Tensor:
    """Greedy suppression of boxes in order of falling scores, in `ROUNDS` rounds: 1 or 0 for each box.

    Args:
        over: Bool ``[N, N]``, which overlap too much.
        valid: ``[N]``: 0 for padding, which suppresses nothing.
    """
    # [N, N]: the boxes before each that overlap it
    better = over.to(valid.dtype) * torch.ones(len(valid), len(valid)).tril(diagonal=-1)
    keep = column = valid[:, None]
    for _ in range(ROUNDS):
        keep = column * (better @ keep < 0.5).to(valid.dtype)
    return keep[:, 0]


def _bins(low: Tensor, high: Tensor, length: int, size: int) -> Tensor:
    """Weights ``[K, size, length]`` with which cells along one axis enter the bins of boxes."""
    extent = (high - low).clamp(min=1.0)
    step = (torch.arange(size * SAMPLES, dtype=torch.float32) + 0.5) / (size * SAMPLES)
    at = low[:, None] + step * extent[:, None]
    inside = ((at >= -1.0) & (at <= float(length))).to(at.dtype) / SAMPLES
    weights = _hat(at.clamp(min=0.0, max=float(length - 1)), length) * inside[:, :, None]
    return weights.reshape(len(low), size, SAMPLES, length).sum(dim=2)


def _taps(low: Tensor, high: Tensor, length: int, cells: int) -> Tensor:
    """Weights ``[K, length, cells]`` with which cells of a box enter the pixels along one axis; 0 outside the box."""
    centre = torch.arange(length, dtype=torch.float32) + 0.5
    extent = (high - low).clamp(min=1e-3)
    at = (centre[None] - low[:, None]) * (cells / extent)[:, None] - 0.5
    inside = ((centre[None] >= low[:, None]) & (centre[None] <= high[:, None])).to(at.dtype)
    return _hat(at.clamp(min=0.0, max=float(cells - 1)), cells) * inside[:, :, None]


def _hat(at: Tensor, length: int) -> Tensor:
    """Weights ``[..., length]`` of linear interpolation at places ``[...]`` within 0 and ``length - 1``."""
    distance = (at[..., None] - torch.arange(length, dtype=torch.float32)).abs()
    return (1.0 - distance).clamp(min=0.0)


def _grown(planes: Tensor, boxes: Tensor) -> tuple[Tensor, Tensor]:
    """Masks with a border of one cell, and their boxes grown by the same share and cut to whole pixels."""
    side = planes.shape[1]
    centre = (boxes[:, :2] + boxes[:, 2:]) / 2
    half = (boxes[:, 2:] - boxes[:, :2]) / 2 * ((side + 2) / side)
    low = torch.trunc(centre - half)
    high = torch.trunc(centre + half) + 1
    grown = torch.cat([low, torch.maximum(high, low + 1)], dim=1)
    return functional.pad(planes, (1, 1, 1, 1)), grown
