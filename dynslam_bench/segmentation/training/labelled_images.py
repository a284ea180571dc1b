"""Labelled images for training and evaluation: COCO and YOLO files, sequences with masks, rendered sequences."""

import json
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from dynslam_bench.contracts import Sequence as RgbdSequence
from dynslam_bench.core import (
    TABLE_BYTES,
    SegmentationError,
    atomic_folder,
    did_you_mean,
    path_below,
    read_json,
    read_lines,
    translate_errors,
)
from dynslam_bench.core.images import read_image
from dynslam_bench.core.records import digest
from dynslam_bench.core.seeding import stream
from dynslam_bench.core.settings import apply_overrides
from dynslam_bench.segmentation.postprocess import boxes_of
from dynslam_bench.segmentation.recorded import instances_of
from dynslam_bench.segmentation.settings import COCO_NAMES, canonical_name
from dynslam_bench.segmentation.training.settings import TrainSettings
from dynslam_bench.sequences import open_sequence
from dynslam_bench.sequences.readers.files import read_yaml
from dynslam_bench.sequences.synthetic import REPLICA_IDS, RenderSettings, parse_synthetic_id
from dynslam_bench.sequences.synthetic.sequence import SyntheticSequence
from dynslam_bench.sequences.synthetic.settings import RENDERER_VERSION

FINER = 4
"""Polygons are filled at this many times the image's resolution."""


@dataclass(frozen=True, eq=False)
class LabelledImage:
    """An image and its objects.

    Attributes:
        rgb: uint8 ``[H, W, 3]``.
        masks: bool ``[K, H, W]``.
        class_names: Name of each object as `canonical_name` writes it; COCO's where COCO has the
            class.
    """

    rgb: NDArray[np.uint8]
    masks: NDArray[np.bool_]
    class_names: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class LabelledImages:
    """A set of labelled images, decoded or rendered on access.

    Attributes:
        name: Stands in records.
        version: Changes when the content changes under the same name.
        count: How many images it has.
        read: Reads an image by its index.
    """

    name: str
    version: str
    count: int
    read: Callable[[int], LabelledImage]

    def __len__(self) -> int:
        return self.count

    def __getitem__(self, index: int) -> LabelledImage:
        return self.read(range(self.count)[index])


def coco_images(text: str) -> LabelledImages:
    """Images of a COCO annotation file (``images``, ``annotations``, ``categories``); crowds are left out.

    Polygons and uncompressed and compressed run lengths are understood.

    Args:
        text: ``ANNOTATIONS.json`` or ``ANNOTATIONS.json:IMAGES``, the folder of the images if it is
            another.

    Raises:
        SegmentationError: The file is missing or not in COCO's format.
    """
    annotations, _, images = text.partition(":")
    path = Path(annotations).expanduser()
    folder = Path(images).expanduser() if images else path.parent
    content = read_json(path, limit=TABLE_BYTES, kind=SegmentationError)
    with translate_errors(
        SegmentationError,
        f"{path} is not in COCO's annotation format",
        "it needs images, annotations and categories",
        of=(ValueError, LookupError, TypeError, AttributeError, OverflowError),
    ):
        # class names by their id
        names = {
            int(entry["id"]): canonical_name(str(entry["name"])) for entry in content["categories"]
        }
        # class name and segmentation of the objects of each image, by its id
        shapes: dict[int, list[tuple[str, Any]]] = {
            int(entry["id"]): [] for entry in content["images"]
        }
        for entry in content["annotations"]:
            if not entry.get("iscrowd"):
                name = names[int(entry["category_id"])]
                shapes[int(entry["image_id"])].append((name, entry["segmentation"]))
        files = [(str(entry["file_name"]), shapes[int(entry["id"])]) for entry in content["images"]]
    if not files:
        raise SegmentationError(f"{path} lists no images")

    # images inside the folder, read when they are asked for
    entries = [
        (path_below(folder, name, where=str(path), kind=SegmentationError), objects)
        for name, objects in files
    ]
    version = _files_digest([path, *(image for image, _ in entries)])
    return LabelledImages(
        f"coco:{path.name}", version, len(entries), lambda index: _read_coco(*entries[index])
    )


def _read_coco(path: Path, objects: list[tuple[str, Any]]) -> LabelledImage:
    """An image and its objects, each a class name and COCO's segmentation."""
    rgb = _read(path)
    masks = [_coco_mask(segmentation, rgb.shape[:2], path) for _, segmentation in objects]
    return _labelled(rgb, masks, [name for name, _ in objects])


def yolo_images(text: str) -> LabelledImages:
    """Images with YOLO polygon labels: ``images/**/NAME.jpg`` beside ``labels/**/NAME.txt``.

    A label's line is ``class x1 y1 x2 y2 ...`` with coordinates in [0, 1]. The classes are numbered
    from 0 as ``names`` in ``data.yaml`` says, in the folder or the one above it; without that file
    they are COCO's. An image without a label file has no objects.

    Args:
        text: The folder that holds ``images`` and ``labels``.

    Raises:
        SegmentationError: The folder or its images are missing, or ``names`` is no table of class
            names.
        SequenceError: ``data.yaml`` cannot be read.
    """
    # the images and their labels
    folder = Path(text).expanduser()
    root = folder / "images"
    labels = folder / "labels"
    images = sorted(
        path for path in root.rglob("*") if path.suffix.lower() in (".jpg", ".jpeg", ".png", ".bmp")
    )
    if not images:
        raise SegmentationError(
            f"there are no images in {root}", "YOLO data has images/ and labels/ side by side"
        )

    # the names of the classes: the nearest description's, else COCO's
    candidates = (folder / "data.yaml", folder.parent / "data.yaml")
    described = [path for path in candidates if path.is_file()]
    classes = _yolo_names(described[0]) if described else dict(enumerate(COCO_NAMES))

    def read(index: int) -> LabelledImage:
        """An image and its label file of the same name."""
        label = labels / images[index].relative_to(root).with_suffix(".txt")
        return _read_yolo(images[index], label, classes)

    version = _files_digest([*images, *sorted(labels.rglob("*.txt")), *described[:1]])
    return LabelledImages(f"yolo:{folder.name}", version, len(images), read)


def _yolo_names(path: Path) -> dict[int, str]:
    """The names of the classes that a YOLO data set's description gives, a list or a mapping."""
    names = read_yaml(path).get("names")
    with translate_errors(
        SegmentationError,
        f"{path}: 'names' is not a table of class names",
        "expected names: [person, ...] or names: {0: person, ...}",
        of=(ValueError, TypeError, OverflowError),
    ):
        if not isinstance(names, (list, Mapping)):
            raise ValueError(f"it is a {type(names).__name__}")
        pairs = names.items() if isinstance(names, Mapping) else enumerate(names)
        return {int(number): canonical_name(str(name)) for number, name in pairs}


def _read_yolo(path: Path, label: Path, classes: Mapping[int, str]) -> LabelledImage:
    """An image and the polygons of its label file, which may be missing."""
    # a polygon a line
    rgb = _read(path)
    masks = []
    names = []
    lines = read_lines(label, kind=SegmentationError) if label.is_file() else []
    for number, line in enumerate(lines, 1):
        if not line.strip():
            continue
        with translate_errors(
            SegmentationError,
            f"{label} line {number} is no polygon label",
            "expected class x1 y1 x2 y2 ...",
            of=(ValueError, LookupError, OverflowError),
        ):
            kind, *points = line.split()
            names.append(classes[int(kind)])
            polygon = _polygon(points) * [rgb.shape[1], rgb.shape[0]]
            masks.append(_fill([polygon], rgb.shape[:2]))
    return _labelled(rgb, masks, names)


def _files_digest(paths: list[Path]) -> str:
    """Digest of the names and sizes of files."""
    return digest([(str(path), path.stat().st_size) for path in paths if path.is_file()])


def _read(path: Path) -> NDArray[np.uint8]:
    """An image file as RGB, uint8 ``[H, W, 3]``."""
    bgr = read_image(path, flags=cv2.IMREAD_COLOR, kind=SegmentationError)
    return np.ascontiguousarray(bgr[:, :, ::-1], np.uint8)


def _labelled(
    rgb: NDArray[np.uint8], masks: list[NDArray[np.bool_]], names: list[str]
) -> LabelledImage:
    """An image with the objects that have a pixel."""
    stack = np.stack(masks) if masks else np.zeros((0, *rgb.shape[:2]), bool)
    visible = np.asarray(stack.any(axis=(1, 2)))
    return LabelledImage(rgb, stack[visible], tuple(np.array(names, object)[visible]))


def _fill(polygons: list[NDArray[np.float64]], shape: tuple[int, ...]) -> NDArray[np.bool_]:
    """Pixels at least half covered by the union of polygons (x, y in pixels, the image's corner is 0, 0)."""
    mask = np.zeros(shape, bool)
    for polygon in polygons:
        if len(polygon) < 3:
            continue
        # the polygon's box within the image
        low = np.maximum(np.floor(polygon.min(axis=0)), 0).astype(int)
        high = np.minimum(np.ceil(polygon.max(axis=0)), shape[1::-1]).astype(int)
        if (high <= low).any():
            continue
        # fill it at a finer scale, corners in sixteenths of a pixel; OpenCV also fills pixels that
        # the outline touches: at this scale it hardly counts
        size = (high - low) * FINER
        fine = np.zeros((size[1], size[0]), np.uint8)
        corners = np.rint(((polygon - low) * FINER - 0.5) * 16).astype(np.int32)
        cv2.fillPoly(fine, [corners], 255, shift=4)
        whole = cv2.resize(fine, (high - low).tolist(), interpolation=cv2.INTER_AREA)
        mask[low[1] : high[1], low[0] : high[0]] |= whole >= 128
    return mask


def _polygon(points: Any) -> NDArray[np.float64]:
    """Corners ``[N, 2]``; raises ValueError where one is no number or far outside of any image."""
    polygon = np.array(points, np.float64).reshape(-1, 2)
    # also catches NaN; OpenCV counts in 32 bits
    if not (np.abs(polygon) < 1e6).all():
        raise ValueError("a corner is not finite, or more than a million pixels away")
    return polygon


def _coco_mask(segmentation: Any, shape: tuple[int, ...], where: Path) -> NDArray[np.bool_]:
    """A mask from polygons, or from run lengths column by column, which must fill the image exactly."""
    with translate_errors(
        SegmentationError,
        f"{where}: a segmentation is damaged",
        "COCO's are polygons or run lengths",
        of=(ValueError, TypeError, LookupError, OverflowError),
    ):
        # polygons, else run lengths
        if isinstance(segmentation, list):
            return _fill([_polygon(points) for points in segmentation], shape)
        counts = segmentation["counts"]
        runs = decode_runs(counts) if isinstance(counts, str) else [int(count) for count in counts]
        height, width = (int(value) for value in segmentation["size"])
        total = sum(runs)
        if (height, width) != tuple(shape) or total != height * width or min(runs) < 0:
            raise ValueError(
                f"a mask of {width}x{height} with {total} pixels, the image is {shape[1]}x{shape[0]}"
            )
        # runs of background and object in turn, down the columns
        is_object = np.arange(len(runs)) % 2 == 1
        columns = np.repeat(is_object, runs).reshape(width, height)
        return np.ascontiguousarray(columns.T)


# digits of COCO's run lengths, 48 less than the character's code: with bit 32 another digit follows
_NOT_LAST = "[P-o]"
_LAST = "[0-O]"


def decode_runs(text: str) -> list[int]:
    """COCO's compressed run lengths: base-32 digits, least first, differences to the run two before.

    Raises:
        ValueError: The text ends within a number, a number is longer than any image, or a character
            is no digit.
    """
    # the whole text must be numbers of at most 13 digits
    rest = re.sub(rf"\A(?:{_NOT_LAST}{{0,12}}{_LAST})*", "", text, count=1)
    if rest:
        raise ValueError(
            f"the run lengths are damaged at character {len(text) - len(rest)} of {len(text)}"
        )
    # each number from its digits, then from a difference to a run
    runs: list[int] = []
    for number in re.findall(f"{_NOT_LAST}*{_LAST}", text):
        digits = [ord(character) - 48 for character in number]
        value = sum((digit & 31) << 5 * place for place, digit in enumerate(digits))
        # two's complement: the highest bit of the last digit is the sign
        value -= (digits[-1] & 16) << (5 * len(digits) - 4)
        runs.append(value + (runs[-2] if len(runs) > 2 else 0))
    return runs


VARIANTS: tuple[dict[str, object], ...] = (
    {"lighting_change": True},
    {"glare": True},
    {"shadow": True},
    {"color.read_noise": 6.0, "color.shot_noise": 0.1},
    {"color.shutter": 0.9},
    {"color.shutter": 0.0, "color.read_noise": 0.0, "color.shot_noise": 0.0},
)
"""Renderer options that a share of the training frames is rendered with."""


def sequence_frames(sequence_id: str) -> LabelledImages:
    """Every frame of a sequence that has masks.

    Args:
        sequence_id: Id or folder of the sequence.

    Raises:
        SegmentationError: It has no masks.
    """
    sequence = open_sequence(sequence_id)
    if sequence.masks is None:
        raise SegmentationError(
            f"sequence '{sequence.id}' has no masks to train on or compare with"
        )
    return LabelledImages(
        sequence.id, sequence.digest(), len(sequence), partial(_labelled_frame, sequence)
    )


def rendered_frames(text: str = "") -> LabelledImages:
    """Frames drawn at random from rendered sequences.

    Args:
        text: ``scenes=0-99,frames=4,length=600,options=0.3,seed=0``, where what is left out keeps
            its default: scenes (0-99 are for training, 100-199 held out), frames drawn from each of
            a scene's eight sequences, frames of a sequence that are drawn from, share of the frames
            rendered with one of `VARIANTS`, seed of the draws.

    Raises:
        SegmentationError: Unknown option, or a value that does not fit.
    """
    # the options, by their defaults
    values = {"scenes": "0-99", "frames": "2", "length": "600", "options": "0", "seed": "0"}
    for part in filter(None, text.split(",")):
        key, separator, value = part.partition("=")
        if key not in values or not separator:
            raise SegmentationError(
                f"synthetic: unknown option '{part}'", "known: " + ", ".join(values)
            )
        values[key] = value

    # turn the texts of the options into numbers
    with translate_errors(
        SegmentationError, f"synthetic: '{text}' is not understood", of=ValueError
    ):
        first, _, last = values["scenes"].partition("-")
        scenes = range(int(first), int(last or first) + 1)
        frames, length, seed = (int(values[key]) for key in ("frames", "length", "seed"))
        options = float(values["options"])
    if not scenes or scenes[0] < 0 or scenes[-1] > 199 or not 1 <= frames <= length:
        raise SegmentationError(
            f"synthetic: '{text}' asks for scenes or frames that do not exist",
            "scenes 0-199, at least one frame",
        )
    name = f"scenes={scenes[0]}-{scenes[-1]},frames={frames},length={length},options={options:g},seed={seed}"

    def read(index: int) -> LabelledImage:
        """Render the `index`-th frame that is drawn."""
        # scene, then motion, then draw; what is drawn depends on seed, sequence and draw alone
        order, draw = divmod(index, frames)
        scene, motion = divmod(order, len(REPLICA_IDS))
        sequence_id = f"{REPLICA_IDS[motion]}@{scenes[scene]}?frames={length}"
        frame = int(stream(seed, "frames", sequence_id).choice(length, frames, replace=False)[draw])
        rng = stream(seed, "variant", sequence_id, draw)
        variant = int(rng.integers(len(VARIANTS))) if rng.random() < options else None
        return _labelled_frame(_rendered(sequence_id, variant), frame)

    count = len(scenes) * len(REPLICA_IDS) * frames
    return LabelledImages(f"synthetic:{name}", f"renderer {RENDERER_VERSION}", count, read)


# neighbours in the order share a sequence
@lru_cache(maxsize=1)
def _rendered(sequence_id: str, variant: int | None) -> SyntheticSequence:
    """A rendered sequence, with one of `VARIANTS` or none."""
    settings = apply_overrides(RenderSettings(), {} if variant is None else VARIANTS[variant])
    return SyntheticSequence(parse_synthetic_id(sequence_id), None, settings, threads=1)


def _labelled_frame(sequence: RgbdSequence, index: int) -> LabelledImage:
    """A frame and its exact masks."""
    assert sequence.masks is not None
    instances = instances_of(sequence.masks[index], where=f"{sequence.id} frame {index}")
    names = tuple(map(canonical_name, instances.class_names))
    return LabelledImage(np.ascontiguousarray(sequence[index].rgb), instances.masks, names)


FORMS = "synthetic[:OPTIONS], sequence:ID, coco:ANNOTATIONS.json[:IMAGES], yolo:DIR"
"""Forms in which a set of labelled images is named."""


def open_labelled(text: str) -> LabelledImages:
    """The set that a text names.

    ``synthetic:scenes=0-99,frames=4,seed=0,options=0.3`` is frames of rendered sequences
    (`rendered_frames`), ``sequence:ID`` every frame of one sequence that has masks,
    ``coco:FILE[:IMAGES]`` a COCO annotation file, ``yolo:DIR`` a folder with ``images/`` and
    ``labels/``.

    Raises:
        SegmentationError: Another form, or the set does not exist.
    """
    kind, _, rest = text.partition(":")
    kinds: dict[str, Callable[[str], LabelledImages]] = {
        "synthetic": rendered_frames,
        "sequence": sequence_frames,
        "coco": coco_images,
        "yolo": yolo_images,
    }
    if kind in kinds and (rest or kind == "synthetic"):
        return kinds[kind](rest)
    raise SegmentationError(
        f"'{text}' names no set of labelled images; the forms are {FORMS}",
        did_you_mean(kind, list(kinds)),
    )


# Labelled images at the network's input size, kept in one file on disk, and their random variation
# for training.

MIN_VISIBLE_PX = 16
"""Objects with fewer pixels at the network's input size are not learned."""


@dataclass(frozen=True, eq=False)
class Example:
    """One training image.

    Attributes:
        rgb: uint8 ``[H, W, 3]``.
        masks: bool ``[G, H, W]``.
        boxes: float32 ``[G, 4]``.
        labels: int64 ``[G]``, class numbers from 1.
    """

    rgb: NDArray[np.uint8]
    masks: NDArray[np.bool_]
    boxes: NDArray[np.float32]
    labels: NDArray[np.int64]


class PreparedImages:
    """Images of one size with label images, memory-mapped from a folder.

    Where objects overlap, the smaller one is in front.

    Args:
        folder: Written by `prepare`.
        classes: The names to learn, in order; other objects become background.

    Raises:
        SegmentationError: The folder is damaged.
    """

    def __init__(self, folder: Path, classes: Sequence[str]) -> None:
        with translate_errors(
            SegmentationError,
            f"the prepared images in {folder} are damaged",
            "delete the folder, they are prepared again",
            of=Exception,
        ):
            # numpy raises many types for a damaged header
            self.images, self.labels = (
                np.load(folder / f"{name}.npy", mmap_mode="r", allow_pickle=False)
                for name in ("images", "labels")
            )
            names = read_json(folder / "names.json", limit=TABLE_BYTES, kind=SegmentationError)
            self.names = [[canonical_name(name) for name in present] for present in names]
            if not len(self.images) == len(self.labels) == len(self.names):
                raise ValueError("their numbers differ")
        self.classes = tuple(classes)

    def __len__(self) -> int:
        return len(self.images)

    def example(self, index: int, rng: np.random.Generator | None = None) -> Example:
        """An image; with a generator at random scale, place, mirror image, colour, noise and blur."""
        # the image and its label image, varied
        rgb = np.array(self.images[index])
        labels = np.array(self.labels[index])
        names = self.names[index]
        if rng is not None:
            rgb, labels = vary(rgb, labels, rng)

        # a mask for each object of the classes that is large enough
        numbers = [k + 1 for k, name in enumerate(names) if name in self.classes]
        masks = labels[None] == np.array(numbers, np.uint8).reshape(-1, 1, 1)
        visible = np.count_nonzero(masks, axis=(1, 2)) >= MIN_VISIBLE_PX
        classes = np.array(
            [self.classes.index(names[number - 1]) + 1 for number in numbers], np.int64
        )
        return Example(rgb, masks[visible], boxes_of(masks[visible]), classes[visible])


def prepare(
    source: LabelledImages,
    folder: Path,
    height: int,
    width: int,
    progress: Callable[[int, int], object] = lambda *_: None,
) -> Path:
    """Write a set at one size; an existing set is not written again.

    Args:
        source: The images.
        folder: Under which a folder is made, named by the digest of the set's name, content and
            size.
        height: Rows of the network's input.
        width: Columns.
        progress: Called with (images done, images in all).

    Returns:
        The folder for `PreparedImages`.
    """
    # one folder a content and size
    key = digest(
        {
            "name": source.name,
            "version": source.version,
            "count": len(source),
            "size": [height, width],
        }
    )
    target = folder / f"prepared-{key}"
    if (target / "names.json").is_file():
        return target

    # written on disk image by image; the folder appears whole
    with atomic_folder(target) as work:
        images = np.lib.format.open_memmap(
            work / "images.npy", "w+", np.uint8, (len(source), height, width, 3)
        )
        labels = np.lib.format.open_memmap(
            work / "labels.npy", "w+", np.uint8, (len(source), height, width)
        )
        names: list[list[str]] = []
        for index in range(len(source)):
            images[index], labels[index], present = shrink(source[index], height, width)
            names.append(present)
            progress(index + 1, len(source))
        (work / "names.json").write_text(json.dumps(names))
    return target


def shrink(
    image: LabelledImage, height: int, width: int
) -> tuple[NDArray[np.uint8], NDArray[np.uint8], list[str]]:
    """An image at another size with grey borders where the aspect ratio differs; objects as a label image.

    Returns:
        uint8 ``[height, width, 3]``, label image uint8 ``[height, width]`` (0 = background) and the
        objects' names.
    """
    # the largest size of these proportions, in the middle of a grey image
    rows, columns = image.rgb.shape[:2]
    ratio = min(height / rows, width / columns)
    size = (max(1, round(columns * ratio)), max(1, round(rows * ratio)))
    how = cv2.INTER_AREA if ratio < 1 else cv2.INTER_LINEAR
    rgb = np.full((height, width, 3), 114, np.uint8)
    labels = np.zeros((height, width), np.uint8)
    top = (height - size[1]) // 2
    left = (width - size[0]) // 2
    rgb[top : top + size[1], left : left + size[0]] = cv2.resize(image.rgb, size, interpolation=how)

    # objects from the largest to the smallest, so that smaller ones are in front; 255 at most
    patch = labels[top : top + size[1], left : left + size[0]]
    order = np.argsort([-int(np.count_nonzero(mask)) for mask in image.masks], kind="stable")[:255]
    for number, index in enumerate(order, 1):
        share = cv2.resize(image.masks[index].astype(np.float32), size, interpolation=how)
        patch[share >= 0.5] = number
    return rgb, labels, [image.class_names[index] for index in order]


def vary(
    rgb: NDArray[np.uint8], labels: NDArray[np.uint8], rng: np.random.Generator
) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """A random variation of an image and its label image, of the same size."""
    # draw mirror image, scale, shift and rotation
    height, width = labels.shape
    mirror = -1.0 if rng.random() < 0.5 else 1.0
    scale = float(np.exp(rng.uniform(np.log(0.7), np.log(1.5)))) if rng.random() < 0.7 else 1.0
    slack = np.abs(np.array([width, height]) * (scale - 1)) / 2 + 0.05 * np.array([width, height])
    shift = rng.uniform(-slack, slack) if scale != 1.0 else np.zeros(2)
    angle = float(rng.normal(0, 4.0)) if rng.random() < 0.5 else 0.0

    # as one affine motion about the image's middle, [2, 3]
    cosine = scale * np.cos(np.deg2rad(angle))
    sine = scale * np.sin(np.deg2rad(angle))
    linear = np.array([[cosine * mirror, -sine], [sine * mirror, cosine]])
    middle = np.array([(width - 1) / 2, (height - 1) / 2])
    move = np.column_stack([linear, middle + shift - linear @ middle])

    # colours are interpolated, labels are not
    rgb = np.asarray(
        cv2.warpAffine(
            rgb, move, (width, height), flags=cv2.INTER_LINEAR, borderValue=(114, 114, 114)
        ),
        np.uint8,
    )
    labels = np.asarray(
        cv2.warpAffine(labels, move, (width, height), flags=cv2.INTER_NEAREST), np.uint8
    )
    return _photometric(rgb, rng), labels


def _photometric(rgb: NDArray[np.uint8], rng: np.random.Generator) -> NDArray[np.uint8]:
    """A random variation of an image's colours, sharpness and noise; each step is drawn by itself."""
    value: NDArray[np.float32] = rgb.astype(np.float32) / np.float32(255)

    # gamma, contrast, brightness and white balance
    if rng.random() < 0.8:
        value = value ** np.float32(np.exp(rng.normal(0, 0.25)))
        value = (value - 0.5) * np.float32(rng.uniform(0.7, 1.3)) + np.float32(
            0.5 + rng.uniform(-0.15, 0.15)
        )
        value = value * rng.uniform(0.85, 1.15, 3).astype(np.float32)

    # change the saturation: 0 is grey, 1.6 is vivid
    if rng.random() < 0.3:
        grey = value.mean(axis=2, keepdims=True)
        value = grey + (value - grey) * np.float32(rng.uniform(0.0, 1.6))

    # a veil, brighter to one side
    if rng.random() < 0.2:
        direction = rng.normal(size=2)
        y, x = np.mgrid[-1 : 1 : value.shape[0] * 1j, -1 : 1 : value.shape[1] * 1j]
        ramp = np.clip(0.5 + (direction[0] * x + direction[1] * y) * 0.5, 0, 1)[:, :, None].astype(
            np.float32
        )
        value = value * (1 - ramp * np.float32(rng.uniform(0, 0.6))) + ramp * np.float32(
            rng.uniform(0, 0.5)
        )

    # motion blur along a line, or defocus
    if rng.random() < 0.25:
        angle = rng.uniform(0, np.pi)
        length = int(rng.integers(3, 10))
        kernel = np.zeros((length, length), np.float32)
        half = (length - 1) / 2
        for t in np.linspace(-half, half, 4 * length):
            kernel[round(half + t * np.sin(angle)), round(half + t * np.cos(angle))] = 1
        value = np.asarray(cv2.filter2D(value, -1, kernel / kernel.sum()), np.float32)
    elif rng.random() < 0.2:
        value = np.asarray(
            cv2.GaussianBlur(value, (0, 0), float(rng.uniform(0.4, 1.5))), np.float32
        )

    # add the noise of a sensor, at most 5 % of white
    if rng.random() < 0.4:
        value = value + rng.standard_normal(value.shape, np.float32) * np.float32(
            rng.uniform(0, 0.05)
        )
    return np.asarray(np.rint(np.clip(value, 0, 1) * 255), np.uint8)


def batch_of(sets: list[PreparedImages], settings: TrainSettings, step: int) -> list[Example]:
    """The step's images: sets in proportion to their size, every image once an epoch, in random order."""
    ends = np.cumsum([len(images) for images in sets])
    total = int(ends[-1])
    examples = []
    for position in range(step * settings.batch, (step + 1) * settings.batch):
        # a place in the epoch's order of all images, and the set that the image is of
        epoch, place = divmod(position, total)
        number = int(_permutation(total, settings.seed, epoch)[place])
        chosen = int(np.searchsorted(ends, number, side="right"))
        number -= int(ends[chosen]) - len(sets[chosen])
        examples.append(sets[chosen].example(number, stream(settings.seed, "vary", position)))
    return examples


@lru_cache(maxsize=1)
def _permutation(total: int, seed: int, epoch: int) -> NDArray[np.int64]:
    """The order of all images in an epoch, ``[total]``."""
    return np.asarray(stream(seed, "order", epoch).permutation(total))
