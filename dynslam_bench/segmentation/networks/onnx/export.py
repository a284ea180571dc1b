"""Our networks as ONNX files: with fixed shapes and plain operators, so that light runtimes can serve them."""

from __future__ import annotations

import logging
import re
import warnings
from contextlib import redirect_stdout
from dataclasses import dataclass
from io import StringIO
from pathlib import Path
from typing import Any, NamedTuple

import torch

from dynslam_bench.core.errors import SegmentationError
from dynslam_bench.core.files import replacing
from dynslam_bench.core.version import install_hint

from ...settings import SegmentationSettings
from ..checkpoints import COCO, embedded_weights, fetch_checkpoint
from ..mask_rcnn.loading import load_network
from ..mask_rcnn.network import MaskRCNN
from ..mask_rcnn.static import StaticMaskRCNN

OPSET = 18
SIZE = (480, 640)
"""Height and width of the images, unless others are asked for: those of TUM and Bonn."""
FLOOR = 0.1
SMALLEST, LARGEST = 32, 4096
"""Sides of an image in pixels."""
OUTPUTS = ("boxes", "labels", "scores", "masks")


@dataclass(frozen=True)
class ExportedNetwork:
    """What `export_network` wrote.

    Attributes:
        path: The file.
        size: Height and width of its input.
        classes: Names of what it finds, by number.
        megabytes: Size of the file.
    """

    path: Path
    size: tuple[int, int]
    classes: dict[int, str]
    megabytes: float


def export_network(
    weights: Path, path: Path, *, size: tuple[int, int] = SIZE, side: int = 0, score: float = FLOOR, iou: float = 0.5
) -> ExportedNetwork:
    """Write a Mask R-CNN checkpoint as an ONNX file that ``onnx:PATH`` takes.

    The input ``image [1, 3, H, W]`` is RGB in [0, 1]; the outputs are those of torchvision's exports (boxes, labels,
    scores, masks in the whole image) with as many rows as the network finds objects at most, unused ones of score 0.

    Args:
        weights: The checkpoint.
        path: The file to write.
        size: Height and width of the images; others are fitted in when it is used.
        side: Shorter side in pixels at which the network works; 0 for its own.
        score: Least score of an object.
        iou: Overlap of two boxes of one class above which the weaker one is dropped.

    Raises:
        SegmentationError: The checkpoint cannot be read, `onnx` or `onnxscript` is missing, or torch cannot export it.
        OSError: The file cannot be written.
    """
    network = load_network(weights).eval()
    if side > 0:
        network.set_input(side)
    return write_onnx(network.fuse(), path, size=size, score=score, iou=iou)


class Weights(NamedTuple):
    """A checkpoint and the shorter side at which it works, 0 for its own."""

    path: Path
    side: int


def weights_of(source: str, side: int | None = None) -> Weights:
    """The checkpoint behind a source of masks, fetched if need be.

    Args:
        source: ``embedded``, ``coco`` or ``weights:PATH``.
        side: Shorter side in pixels; None for that of a run.

    Raises:
        SegmentationError: There is no such checkpoint, or it cannot be fetched.
    """
    kind, _, argument = source.partition(":")
    if kind == "embedded" and not argument:
        path = embedded_weights()
        if path is None:
            raise SegmentationError("the embedded network's weights are missing from this installation", "reinstall it")
        return Weights(path, side or 0)
    if kind == "coco" and not argument:
        return Weights(fetch_checkpoint(COCO), SegmentationSettings().network_side if side is None else side)
    if kind == "weights" and argument:
        return Weights(Path(argument).expanduser(), SegmentationSettings().network_side if side is None else side)
    raise SegmentationError(f"'{source}' is no network of ours", "export embedded, coco or weights:PATH")


def parse_size(text: str) -> tuple[int, int]:
    """Height and width of ``640x480``, which names the width first.

    Raises:
        SegmentationError: It is no such text, or a side is outside 32 to 4096 pixels.
    """
    found = re.fullmatch(r"(\d{1,4})x(\d{1,4})", text)
    width, height = (int(found[1]), int(found[2])) if found else (0, 0)
    if not (SMALLEST <= width <= LARGEST and SMALLEST <= height <= LARGEST):
        raise SegmentationError(
            f"'{text}' is no size of an image", f"for example 640x480; sides from {SMALLEST} to {LARGEST} pixels"
        )
    return height, width


def write_onnx(
    network: MaskRCNN, path: Path, *, size: tuple[int, int] = SIZE, score: float = FLOOR, iou: float = 0.5
) -> ExportedNetwork:
    """`export_network` of a network in memory.

    Raises:
        SegmentationError: `onnx` or `onnxscript` is missing, or torch cannot export it.
        OSError: The file cannot be written.
    """
    onnx = _library()
    static = StaticMaskRCNN(network, *size, score=score, iou=iou).eval()
    classes = {number: name for number, name in enumerate(network.config.classes, start=1) if name}
    with replacing(path) as temporary:
        _export(static, torch.rand(1, 3, *size, generator=torch.Generator().manual_seed(0)), temporary)
        model = onnx.load(str(temporary))
        onnx.helper.set_model_props(model, {"names": repr(classes), "producer": "dynslam-bench"})
        onnx.checker.check_model(model)
        onnx.save(model, str(temporary))
        megabytes = temporary.stat().st_size / 1e6
    return ExportedNetwork(path, size, classes, megabytes)


def _export(static: StaticMaskRCNN, image: torch.Tensor, path: Path) -> None:
    logging.getLogger("torch.onnx").setLevel(logging.ERROR)
    try:
        with torch.no_grad(), warnings.catch_warnings(), redirect_stdout(StringIO()):
            warnings.simplefilter("ignore")
            torch.onnx.export(
                static,
                (image,),
                str(path),
                dynamo=True,
                external_data=False,
                opset_version=OPSET,
                input_names=["image"],
                output_names=list(OUTPUTS),
                verbose=False,
            )
    except (torch.onnx.errors.OnnxExporterError, TypeError) as error:  # TypeError: options of a newer torch
        words = " ".join(str(error).split())[:200]
        raise SegmentationError(
            f"torch {torch.__version__} cannot export the network: {words}", "torch >= 2.6"
        ) from error


def _library() -> Any:
    try:
        import onnx
        import onnxscript  # noqa: F401 - torch's exporter asks for it
    except ImportError as error:
        raise SegmentationError(
            f"networks are exported with onnx and onnxscript: {error.name} is not installed",
            install_hint("onnx"),
        ) from error
    return onnx
