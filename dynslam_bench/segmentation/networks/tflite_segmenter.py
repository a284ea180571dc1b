"""Segmentation networks in TensorFlow Lite files that give probability maps, run by OpenCV's dnn module on the CPU."""

from __future__ import annotations

import warnings
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from dynslam_bench.contracts import Frame, Instances, SegmenterContext
from dynslam_bench.core import SegmentationError, file_sha256, translate_errors
from dynslam_bench.geometry import at_width
from dynslam_bench.segmentation.carried_probability import CarriedProbability, Maps
from dynslam_bench.segmentation.networks import pinned_threads
from dynslam_bench.segmentation.networks.checkpoints import SELFIE, fetch_checkpoint
from dynslam_bench.segmentation.networks.onnx_header import TensorInfo
from dynslam_bench.segmentation.networks.onnx_segmenter import MIN_COMPONENT_SIDE_PX
from dynslam_bench.segmentation.networks.tflite_header import (
    PROBABILITY_OPERATORS,
    TfliteHeader,
    read_tflite_header,
)
from dynslam_bench.segmentation.postprocess import boxes_of
from dynslam_bench.segmentation.settings import (
    VOC_NAMES,
    SegmentationSettings,
    canonical_name,
    check_classes,
)

USUAL_NAMES: dict[int, tuple[str, ...]] = {
    1: ("person",),
    2: ("background", "person"),
    len(VOC_NAMES): VOC_NAMES,
}
"""Names of the maps of a file without labels, by their number."""
BACKGROUND = "background"
GREY = 114
"""Level of the image that a network is tried with when it is loaded."""
TOLERANCE = 1e-3
"""A probability may miss 0 to 1 by so much, by rounding."""
_WANTED = (
    "a network of probability maps has one image 1xHxWx3 of float32 as input and one output 1xhxwxC"
)


class TfliteSegmenter:
    """Runs a network with one probability map a class; carries the maps from frame to frame, see `CarriedProbability`.

    Objects are the connected parts of the pixels above `map_threshold`; an object's score is its
    highest probability.

    Args:
        path: The file.
        settings: Classes, threshold and decay.
        threads: Threads OpenCV may use while the network runs.
        floor: Least score of an object that is returned.

    Raises:
        SegmentationError: The file is missing, damaged or of another task, or OpenCV cannot run it.
    """

    def __init__(
        self, path: Path, settings: SegmentationSettings, *, threads: int = 1, floor: float = 0.1
    ) -> None:
        self.path = path.expanduser()
        self.settings = settings
        self.threads = threads
        self.floor = floor
        header = read_tflite_header(self.path)
        self._size = _input_size(header, self.path)
        self._output = _map_output(header, self.path)
        self.names = self._name_maps(header)
        check_classes(
            [name for name in self.names if canonical_name(name) != BACKGROUND],
            settings,
            str(self.path),
            "the network",
        )
        self._wanted = [
            number
            for number, name in enumerate(self.names)
            if canonical_name(name) in settings.class_names()
        ]
        self._carried = CarriedProbability(settings.map_decay)

        # load it, and try it
        with translate_errors(
            SegmentationError,
            f"OpenCV {cv2.__version__} cannot load {self.path}",
            "a newer OpenCV may know its operators",
            of=(cv2.error, RuntimeError),
        ):
            self._net = cv2.dnn.readNetFromTFLite(str(self.path))
        self._probabilities(np.full((*self._size, 3), GREY, np.uint8))

    def __reduce__(self) -> tuple[Any, ...]:
        """Copied and pickled by its arguments and carried maps: OpenCV's network cannot be."""
        load = partial(TfliteSegmenter, threads=self.threads, floor=self.floor)
        return load, (self.path, self.settings), {"_carried": self._carried}

    def reset(self) -> None:
        """Forget the frames before."""
        self._carried.reset()

    def segment(self, frame: Frame) -> Instances:
        """The objects of the dynamic classes in the frame.

        Raises:
            SegmentationError: The network cannot run, or gives something else than probabilities.
        """
        # probabilities of the dynamic classes, joined with those of the frames before
        maps = self._probabilities(frame.rgb)[self._wanted]
        gray = np.asarray(cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2GRAY), np.uint8)
        maps = self._carried.join(maps, gray, frame.index)

        # at the frame's size
        height, width = gray.shape
        least_area = at_width(MIN_COMPONENT_SIDE_PX, width) ** 2
        masks = [np.zeros((0, height, width), bool)]
        names = []
        scores = []
        for number, plane in zip(self._wanted, maps, strict=True):
            full = np.asarray(cv2.resize(plane, (width, height), interpolation=cv2.INTER_LINEAR))
            above = (full > self.settings.map_threshold).astype(np.uint8)
            _, labels, stats, _ = cv2.connectedComponentsWithStats(above, connectivity=8)
            for component in range(1, len(stats)):
                if stats[component, cv2.CC_STAT_AREA] < least_area:
                    continue
                mask = labels == component
                score = float(full[mask].max())
                if score >= self.floor:
                    masks.append(mask[None])
                    names.append(canonical_name(self.names[number]))
                    scores.append(score)
        stack = np.concatenate(masks)
        return Instances(stack, boxes_of(stack), tuple(names), np.array(scores, np.float32))

    def _probabilities(self, rgb: NDArray[np.uint8]) -> Maps:
        """The network's maps float32 ``[C, h, w]`` of an image.

        Raises:
            SegmentationError: It cannot run, or gives something else than the file declares.
        """
        height, width = self._size
        blob = cv2.dnn.blobFromImage(rgb, 1 / 255, (width, height))
        with (
            pinned_threads(cv2.getNumThreads, cv2.setNumThreads, self.threads),
            translate_errors(
                SegmentationError,
                f"{self.path} cannot run on a {width}x{height} image",
                f"OpenCV {cv2.__version__}",
                of=(cv2.error, RuntimeError),
            ),
        ):
            self._net.setInput(blob)
            output = np.asarray(self._net.forward(), np.float32)

        # OpenCV gives channels first, as [1, C, h, w]
        _, rows, columns, channels = self._output.shape
        if output.shape == self._output.shape and output.shape != (1, channels, rows, columns):
            output = np.ascontiguousarray(output.transpose(0, 3, 1, 2))
        if output.shape != (1, channels, rows, columns):
            raise SegmentationError(
                f"{self.path}: OpenCV {cv2.__version__} gives an output of shape {output.shape}, the file declares "
                f"{self._output}"
            )
        low = float(output.min())
        high = float(output.max())
        # NaN fails both comparisons
        if not (low >= -TOLERANCE and high <= 1 + TOLERANCE):
            raise SegmentationError(
                f"{self.path}: the output {self._output} holds values from {low:.4g} to {high:.4g}, a probability lies "
                "between 0 and 1"
            )
        return np.asarray(output[0])

    def _name_maps(self, header: TfliteHeader) -> tuple[str, ...]:
        """The class of each map; a file without labels has the usual ones, with a warning."""
        count = int(self._output.shape[3] or 0)
        if len(header.labels) == count:
            return header.labels
        names = USUAL_NAMES.get(count)
        if names is None:
            raise SegmentationError(
                f"{self.path}: {len(header.labels)} labels for {count} maps",
                "append a file of labels with TensorFlow's metadata writer; 1, 2 and 21 maps need none",
            )
        if file_sha256(self.path) != SELFIE.sha256_prefix:
            shows = "its map is" if count == 1 else f"its {count} maps are"
            warnings.warn(
                f"{self.path} has no labels: {shows} taken for {', '.join(names[:3])}", stacklevel=2
            )
        return names


def _input_size(header: TfliteHeader, path: Path) -> tuple[int, int]:
    """Height and width of the image that a network takes.

    Raises:
        SegmentationError: It takes something else.
    """
    tensor = header.inputs[0] if len(header.inputs) == 1 else None
    shape = () if tensor is None else tensor.shape
    if tensor is None or tensor.element != "float32" or len(shape) != 4:
        raise _another_task(path, "takes", header.inputs)
    _, height, width, channels = shape
    if channels != 3 or not height or not width:
        raise _another_task(path, "takes", header.inputs)
    return height, width


def _map_output(header: TfliteHeader, path: Path) -> TensorInfo:
    """The output that holds the maps.

    Raises:
        SegmentationError: There is none, or another one beside it, or it holds no probabilities.
    """
    tensor = header.outputs[0] if len(header.outputs) == 1 else None
    is_map = tensor is not None and len(tensor.shape) == 4 and None not in tensor.shape
    if tensor is None or not is_map or tensor.element != "float32" or 1 in tensor.shape[1:3]:
        raise _another_task(path, "gives", header.outputs)
    if header.made_by[0] not in PROBABILITY_OPERATORS:
        raise SegmentationError(
            f"{path}: the output {tensor} is made by operator {header.made_by[0]}, which gives no probabilities: it is "
            "a network of another task, or of logits",
            f"its last operator must be {' or '.join(PROBABILITY_OPERATORS.values())}",
        )
    return tensor


def _another_task(path: Path, does: str, tensors: tuple[TensorInfo, ...]) -> SegmentationError:
    """The error that a file is of another task, with what it takes or gives."""
    listed = "; ".join(f"{tensor} {tensor.element}" for tensor in tensors[:4]) or "nothing"
    return SegmentationError(f"{path} is a network of another task: it {does} {listed}", _WANTED)


def build(settings: SegmentationSettings, context: SegmenterContext) -> TfliteSegmenter:
    """A network from a TensorFlow Lite file."""
    return TfliteSegmenter(
        Path(context.argument), settings, threads=context.threads, floor=context.floor
    )


def build_selfie(settings: SegmentationSettings, context: SegmenterContext) -> TfliteSegmenter:
    """MediaPipe's selfie segmentation, downloaded on first use."""
    return TfliteSegmenter(
        fetch_checkpoint(SELFIE), settings, threads=context.threads, floor=context.floor
    )
