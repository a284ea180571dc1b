"""Segmentation networks in ONNX files, run by OpenCV's dnn module (4.x and 5.x) on the CPU."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from dynslam_bench.contracts.segmenter import Instances
from dynslam_bench.contracts.sequence import Frame
from dynslam_bench.core.errors import SegmentationError
from dynslam_bench.segmentation.networks.onnx_header import OnnxHeader, TensorInfo, read_header
from dynslam_bench.segmentation.networks.onnx_outputs import Layout, Placement, decode, detect_layout
from dynslam_bench.segmentation.settings import SegmentationSettings

Scaling = Literal["unit", "symmetric", "imagenet"]
_SCALINGS: dict[Scaling, tuple[tuple[float, float, float], tuple[float, float, float]]] = {
    "unit": ((0.0, 0.0, 0.0), (255.0, 255.0, 255.0)),
    "symmetric": ((128.0, 128.0, 128.0), (128.0, 128.0, 128.0)),
    "imagenet": ((123.675, 116.28, 103.53), (58.395, 57.12, 57.375)),
}
"""Mean and divisor of the RGB channels of a 0..255 image."""
PAD = 114
STRIDE = 32
"""An open input size is padded to a multiple of this."""


class OnnxSegmenter:
    """Runs an ONNX network and decodes its outputs; the layout is found from their names and shapes.

    Args:
        path: The file.
        settings: Classes, thresholds and input scaling.
        threads: Threads OpenCV may use while the network runs.
        floor: Least score of a detection that is returned.

    Raises:
        SegmentationError: The file is missing, damaged, not understood by OpenCV, or its outputs fit no known layout.
    """

    def __init__(self, path: Path, settings: SegmentationSettings, *, threads: int = 1, floor: float = 0.1) -> None:
        self.path = path.expanduser()
        self.settings = settings
        self.threads = threads
        self.floor = floor
        header = read_header(self.path)
        self._size = _input_size(header, self.path)
        try:
            self._net = cv2.dnn.readNetFromONNX(str(self.path))
        except (cv2.error, RuntimeError) as error:
            raise SegmentationError(
                f"OpenCV {cv2.__version__} cannot load {self.path}: {_first_line(error)}",
                "export it with static shapes and plain operators",
            ) from error
        self._input = header.inputs[0].name
        self.layout = self._find_layout(header)

    def segment(self, frame: Frame) -> Instances:
        """The objects of the dynamic classes in the frame.

        Raises:
            SegmentationError: The network cannot run on this image, or gives outputs that do not fit its layout.
        """
        height, width = frame.rgb.shape[:2]
        size = self._size or (_ceil(height), _ceil(width))
        image, place = fit(frame.rgb, size, keep_aspect=self.layout.kind != "semantic")
        values = self._forward(image, list(self.layout.outputs))
        return decode(self.layout, values, place, height, width, self.settings, self.floor)

    def _find_layout(self, header: OnnxHeader) -> Layout:
        size = self._size or (480, 640)
        names = [output.name for output in header.outputs]
        available = {str(name) for name in self._net.getUnconnectedOutLayersNames()}
        if set(names) <= available and all(None not in output.shape and output.shape for output in header.outputs):
            return detect_layout(header.outputs, header.metadata, size, str(self.path))
        if not set(names) <= available:  # older OpenCV names outputs by their layers
            names = sorted(available)
        grey = np.full((*size, 3), PAD, np.uint8)
        self.layout = Layout("semantic", tuple(names), {})  # only for the scaling of this image
        shapes = [value.shape for value in self._forward(grey, names)]
        outputs = tuple(TensorInfo(name, tuple(shape)) for name, shape in zip(names, shapes, strict=True))
        return detect_layout(outputs, header.metadata, size, str(self.path))

    def _forward(self, image: NDArray[np.uint8], names: list[str]) -> list[NDArray[np.float32]]:
        mean, divisor = _SCALINGS[self._scaling()]
        scaled = (image.astype(np.float32) - np.array(mean, np.float32)) / np.array(divisor, np.float32)
        blob: NDArray[np.float32] = np.ascontiguousarray(scaled.transpose(2, 0, 1)[None])
        with opencv_threads(self.threads):
            try:
                self._net.setInput(blob, self._input)
                outputs = self._net.forward(names)
            except (cv2.error, RuntimeError) as error:
                raise SegmentationError(
                    f"{self.path} cannot run on a {image.shape[1]}x{image.shape[0]} image: {_first_line(error)}",
                    f"OpenCV {cv2.__version__}",
                ) from error
        return [np.asarray(output, np.float32) for output in outputs]

    def _scaling(self) -> Scaling:
        chosen = self.settings.onnx_normalisation
        if chosen != "auto":
            return chosen
        if self.layout.kind != "semantic":
            return "unit"  # YOLO as it is; torchvision's export normalises by itself
        return "symmetric" if self.layout.aligned else "imagenet"  # TensorFlow's DeepLab; torchvision's models


def fit(rgb: NDArray[np.uint8], size: tuple[int, int], *, keep_aspect: bool) -> tuple[NDArray[np.uint8], Placement]:
    """Resize an image to the network's input, with grey borders if the aspect ratio is kept.

    Args:
        rgb: uint8 ``[H, W, 3]``.
        size: Height and width of the input.
        keep_aspect: Letterbox (YOLO) instead of stretching (semantic networks).
    """
    height, width = rgb.shape[:2]
    if (height, width) == size:
        return rgb, Placement(1.0, 1.0, 0.0, 0.0, width, height)
    if not keep_aspect:
        scaled = cv2.resize(rgb, (size[1], size[0]), interpolation=cv2.INTER_LINEAR)
        return np.asarray(scaled, np.uint8), Placement(size[1] / width, size[0] / height, 0.0, 0.0, size[1], size[0])
    ratio = min(size[0] / height, size[1] / width)
    new_height, new_width = max(1, round(height * ratio)), max(1, round(width * ratio))
    top, left = (size[0] - new_height) // 2, (size[1] - new_width) // 2
    canvas = np.full((*size, 3), PAD, np.uint8)
    canvas[top : top + new_height, left : left + new_width] = cv2.resize(
        rgb, (new_width, new_height), interpolation=cv2.INTER_LINEAR
    ).reshape(new_height, new_width, 3)
    return canvas, Placement(new_width / width, new_height / height, float(left), float(top), size[1], size[0])


@contextmanager
def opencv_threads(threads: int) -> Iterator[None]:
    """Pin OpenCV's thread count while the block runs (it is one number for the whole process)."""
    before = cv2.getNumThreads()
    cv2.setNumThreads(threads)
    try:
        yield
    finally:
        cv2.setNumThreads(before)


def _input_size(header: OnnxHeader, path: Path) -> tuple[int, int] | None:
    if len(header.inputs) != 1:
        raise SegmentationError(
            f"{path} has {len(header.inputs)} inputs: {'; '.join(map(str, header.inputs))}",
            "a segmentation network takes one image",
        )
    shape = header.inputs[0].shape
    if len(shape) != 4 or shape[1] not in (3, None) or shape[0] not in (1, None):
        raise SegmentationError(f"{path}: the input {header.inputs[0]} is no image", "expected 1x3xHxW")
    height, width = shape[2:]
    return None if height is None or width is None else (height, width)


def _ceil(length: int) -> int:
    return -(-length // STRIDE) * STRIDE


def _first_line(error: Exception) -> str:
    return (str(error).strip().splitlines() or [type(error).__name__])[0]
