"""Mask R-CNN checkpoints: torchvision's in every published key layout, and this project's format.

Loading is strict and never unpickles.
"""

import math
import re
import warnings
import zipfile
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import torch
from pydantic import ValidationError
from torch import Tensor

from dynslam_bench.core import SegmentationError, replacing, translate_errors
from dynslam_bench.segmentation.networks.backbone import COCO_CLASSES, NetworkConfig
from dynslam_bench.segmentation.networks.network import MaskRCNN

FORMAT = "dynslam-bench/mask-rcnn/1"
"""Marks this project's files."""
CFPN_PREFIX = "backbone.cfpn."
"""Begins the names of the weights that torchvision's network does not have."""
_RENAMES = (
    (re.compile(r"^(backbone\.fpn\.(?:inner|layer)_blocks\.\d+)\.(weight|bias)$"), r"\1.0.\2"),
    (re.compile(r"^(rpn\.head\.conv)\.(weight|bias)$"), r"\1.0.0.\2"),
    *(
        (
            re.compile(rf"^roi_heads\.mask_head\.mask_fcn{layer + 1}\.(weight|bias)$"),
            rf"roi_heads.mask_head.{layer}.0.\1",
        )
        for layer in range(4)
    ),
)
"""Names of the file published in 2019, and today's."""
_WRAPPERS = ("model", "state_dict", "model_state_dict")
"""Keys under which training scripts store the weights."""
MAX_EXPANSION = 4
"""Largest ratio of a checkpoint's unpacked size to its file size; torch stores weights uncompressed."""
KEYS_SHOWN = 4
"""Keys that an error names; the rest is counted."""


def load_network(path: Path) -> MaskRCNN:
    """Build the network of a checkpoint file, in inference mode.

    Three layouts of torchvision's keys are understood: 307 keys (frozen batch norm), 360 (with
    ``num_batches_tracked``, which is dropped) and 307 with the names of the file published in 2019
    (renamed). The network's shape is inferred from the weights; this project's files carry it. A
    plain Mask R-CNN gets a CFPN that starts at zero, so that its output does not change.

    Raises:
        SegmentationError: The file cannot be read, is truncated, or does not fit: says which keys
            are missing or unknown and which shapes differ.
    """
    state, config = read_weights(path)
    config = config or infer_config(state, path)
    # compare the shapes before memory is allocated for them
    with torch.device("meta"):
        _check_fit(MaskRCNN(config), state, path)
    network = MaskRCNN(config)
    load_strictly(network, state, path)
    return network.eval()


def read_checkpoint(path: Path) -> Mapping[str, Any]:
    """The content of a torch file, on the CPU, with ``weights_only``.

    Raises:
        SegmentationError: The file is missing, truncated, or holds anything but tensors and plain
            values.
    """
    path = path.expanduser()
    with translate_errors(SegmentationError, f"cannot read the checkpoint {path}"):
        size = path.stat().st_size
    with translate_errors(
        SegmentationError,
        f"{path} ({size} bytes) is no torch checkpoint of plain weights",
        "it is truncated or of another format",
        of=Exception,
    ):
        # torch raises many types for a damaged file
        if zipfile.is_zipfile(path):
            with zipfile.ZipFile(path) as archive:
                unpacked = sum(entry.file_size for entry in archive.infolist())
            if unpacked > MAX_EXPANSION * size:
                raise ValueError(f"it claims to unpack to {unpacked} bytes")
        content = torch.load(path, map_location="cpu", weights_only=True)
    if not isinstance(content, Mapping):
        raise SegmentationError(f"{path} holds a {type(content).__name__}, not a table of weights")
    return content


def read_weights(path: Path) -> tuple[dict[str, Tensor], NetworkConfig | None]:
    """Weights under today's torchvision names in float32 and, for a file of this project, the network's shape.

    Raises:
        SegmentationError: The file holds no weights, or a shape that is not understood.
    """
    # this project's files carry the network's shape
    content = read_checkpoint(path)
    config = None
    if "config" in content and "format" in content:
        if content["format"] != FORMAT:
            raise SegmentationError(
                f"{path} has the format {content['format']!r}, this version reads {FORMAT!r}"
            )
        with translate_errors(
            SegmentationError, f"{path}: the network's shape is not understood", of=ValidationError
        ):
            config = NetworkConfig.model_validate_json(str(content["config"]))

    # training scripts wrap the weights in a table with more
    for key in _WRAPPERS:
        if isinstance(content.get(key), Mapping):
            content = content[key]
            break

    # tensors alone, each a plain array
    state = {str(key): value for key, value in content.items() if isinstance(value, Tensor)}
    if not state:
        raise SegmentationError(f"{path} holds no weights; its keys: {_some(map(str, content))}")
    for key, value in state.items():
        if not _is_plain(value):
            raise SegmentationError(f"{path}: {key[:100]!r} is no plain array of numbers")
    return _renamed(state), config


def _is_plain(value: Tensor) -> bool:
    """Whether a tensor stores all numbers of its shape: it is no expanded view and not sparse."""
    if value.layout != torch.strided or value.is_quantized or value.is_meta or value.is_complex():
        return False
    return value.numel() * value.element_size() <= value.untyped_storage().nbytes()


def _renamed(state: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Today's torchvision names in float32, without ``num_batches_tracked`` and the prefix of a parallel wrapper."""
    prefix = "module." if all(key.startswith("module.") for key in state) else ""
    result = {}
    for key, value in state.items():
        name = key.removeprefix(prefix)
        for pattern, replacement in _RENAMES:
            name = pattern.sub(replacement, name)
        if not name.endswith("num_batches_tracked"):
            result[name] = value.float() if value.is_floating_point() else value
    return result


def infer_config(state: Mapping[str, Tensor], path: Path) -> NetworkConfig:
    """The network's shape, inferred from the weights of a torchvision model.

    Raises:
        SegmentationError: Weights that give the shape are missing, or the classes have no names.
    """
    # the weights whose first dimension tells a part of the shape
    needed = {
        "stem": "backbone.body.conv1.weight",
        "classes": "roi_heads.box_predictor.cls_score.weight",
        "channels": "backbone.fpn.inner_blocks.0.0.weight",
        "ratios": "rpn.head.cls_logits.weight",
        "mask_channels": "roi_heads.mask_head.0.0.weight",
    }
    missing = [key for key in needed.values() if key not in state or state[key].dim() not in (2, 4)]
    if missing:
        raise SegmentationError(
            f"{path} is no Mask R-CNN of torchvision's layout: {missing[0]} is missing ({len(state)} keys, "
            f"for example {_some(state)})"
        )
    rows = {what: int(state[key].shape[0]) for what, key in needed.items()}

    # class names, by their number (without the background)
    names = {len(COCO_CLASSES): COCO_CLASSES, 1: ("person",)}.get(rows["classes"] - 1)
    if names is None:
        raise SegmentationError(
            f"{path} has {rows['classes'] - 1} classes without names",
            "90 (COCO) and 1 (person) are known; others need this project's format",
        )
    if names == ("person",):
        warnings.warn(f"{path} does not name its only class: it is taken for person", stacklevel=2)
    if rows["ratios"] != 3:
        raise SegmentationError(
            f"{path} has {rows['ratios']} anchors a cell, torchvision's models have 3"
        )

    # blocks of the four stages: the different numbers after "backbone.body.layerN."
    blocks = []
    for stage in range(1, 5):
        prefix = f"backbone.body.layer{stage}."
        numbers = {key.split(".")[3] for key in state if key.startswith(prefix)}
        blocks.append(len(numbers))

    # the shape, with layers counted by their numbers in the keys
    mask_layers = {key.split(".")[2] for key in state if key.startswith("roi_heads.mask_head.")}
    shape = {
        "blocks": blocks,
        "bottleneck": "backbone.body.layer1.0.conv3.weight" in state,
        "stem": rows["stem"],
        "channels": rows["channels"],
        "classes": names,
        "box_hidden": int(state[needed["classes"]].shape[1]),
        "mask_channels": rows["mask_channels"],
        "mask_layers": len(mask_layers),
        "cfpn": True,
    }
    with translate_errors(
        SegmentationError, f"{path}: the network's shape is not understood", of=ValidationError
    ):
        return NetworkConfig(**shape)


def load_strictly(network: MaskRCNN, state: Mapping[str, Tensor], path: Path) -> None:
    """Copy weights into a network; only the whole CFPN may be missing, and then it adds nothing.

    Raises:
        SegmentationError: Keys are missing or unknown, shapes differ, or a weight is not finite.
    """
    _check_fit(network, state, path)
    for key, value in state.items():
        if value.is_floating_point() and not math.isfinite(float(value.abs().sum())):
            raise SegmentationError(f"{path}: {key} holds NaN or infinite values")
    network.load_state_dict(dict(state), strict=False)


def _check_fit(network: MaskRCNN, state: Mapping[str, Tensor], path: Path) -> None:
    """Raise a SegmentationError where keys are missing or unknown, or shapes differ."""
    # a file without any CFPN is a plain Mask R-CNN's
    own = _weights(network)
    has_cfpn = any(key.startswith(CFPN_PREFIX) for key in state)
    missing = [
        key for key in own if key not in state and (has_cfpn or not key.startswith(CFPN_PREFIX))
    ]
    unknown = [key for key in state if key not in own]
    shapes = [
        f"{key} {list(state[key].shape)} instead of {list(own[key].shape)}"
        for key in own
        if key in state and state[key].shape != own[key].shape
    ]
    checks = (
        ("keys are missing", missing),
        ("keys are unknown", unknown),
        ("shapes differ", shapes),
    )
    faults = [f"{len(keys)} {what} ({_some(keys)})" for what, keys in checks if keys]
    if faults:
        raise SegmentationError(f"{path} does not fit the network: " + "; ".join(faults))


def _weights(network: MaskRCNN) -> dict[str, Tensor]:
    """The network's state without the counters of batch normalisation."""
    return {
        key: value
        for key, value in network.state_dict().items()
        if not key.endswith("num_batches_tracked")
    }


def save_network(network: MaskRCNN, path: Path, *, half: bool = False) -> None:
    """Write a network with its shape; `half` stores float16."""
    state = {}
    for key, value in _weights(network).items():
        stored = value.detach().cpu()
        state[key] = stored.half() if half and value.is_floating_point() else stored
    content = {"format": FORMAT, "config": network.config.model_dump_json(), "model": state}
    # an open file: torch.save writes no file name into it
    with replacing(path) as temporary, temporary.open("wb") as file:
        torch.save(content, file)


def _some(keys: Iterable[str]) -> str:
    """The first keys for an error message, and how many more there are."""
    listed = list(keys)
    more = f", and {len(listed) - KEYS_SHOWN} more" if len(listed) > KEYS_SHOWN else ""
    return ", ".join(listed[:KEYS_SHOWN]) + more
