"""Mask R-CNN checkpoints: torchvision's in every published key layout, and this project's format.

Loading is strict and never unpickles.
"""

from __future__ import annotations

import math
import re
import zipfile
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import torch
from pydantic import ValidationError
from torch import Tensor

from dynslam_bench.core.errors import SegmentationError
from dynslam_bench.core.files import replacing
from dynslam_bench.segmentation.networks.backbone import COCO_CLASSES, NetworkConfig
from dynslam_bench.segmentation.networks.network import MaskRCNN

FORMAT = "dynslam-bench/mask-rcnn/1"
CFPN_PREFIX = "backbone.cfpn."
_RENAMES = (
    (re.compile(r"^(backbone\.fpn\.(?:inner|layer)_blocks\.\d+)\.(weight|bias)$"), r"\1.0.\2"),
    (re.compile(r"^(rpn\.head\.conv)\.(weight|bias)$"), r"\1.0.0.\2"),
)
_MASK_FCN = re.compile(r"^roi_heads\.mask_head\.mask_fcn([1-9][0-9]?)\.(weight|bias)$")
_WRAPPERS = ("model", "state_dict", "model_state_dict")
MAX_EXPANSION = 4
"""Largest ratio of a checkpoint's unpacked size to its file size; torch stores weights uncompressed."""
KEYS_SHOWN = 4
"""Keys that an error names; the rest is counted."""


def load_network(path: Path) -> MaskRCNN:
    """Build the network of a checkpoint file, in inference mode.

    Three layouts of torchvision's keys are understood: 307 keys (frozen batch norm), 360 (with
    ``num_batches_tracked``, which is dropped) and 307 with the names of the file published in 2019 (renamed). The
    network's shape is inferred from the weights; this project's files carry it. A plain Mask R-CNN gets a CFPN that
    starts at zero, so that its output does not change.

    Raises:
        SegmentationError: The file cannot be read, is truncated, or does not fit: says which keys are missing or
            unknown and which shapes differ.
    """
    state, config = split(read_checkpoint(path), str(path))
    state = canonical_names(state)
    config = config or infer_config(state, str(path))
    with torch.device("meta"):  # compares the shapes before memory is allocated for them
        _check_fit(MaskRCNN(config), state, str(path))
    network = MaskRCNN(config)
    load_strictly(network, state, str(path))
    return network.eval()


def read_checkpoint(path: Path) -> Mapping[str, Any]:
    """The content of a torch file, on the CPU, with ``weights_only``.

    Raises:
        SegmentationError: The file is missing, truncated, or holds anything but tensors and plain values.
    """
    path = path.expanduser()
    try:
        with path.open("rb") as file:
            size = len(file.read(1)) and path.stat().st_size
    except OSError as error:
        raise SegmentationError(f"cannot read the checkpoint {path}: {error.strerror or error}") from error
    try:
        if zipfile.is_zipfile(path):
            with zipfile.ZipFile(path) as archive:
                unpacked = sum(entry.file_size for entry in archive.infolist())
            if unpacked > MAX_EXPANSION * size:
                raise ValueError(f"it claims to unpack to {unpacked} bytes")
        content = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # torch raises many types for a damaged file
        reason = next(iter(str(error).strip().splitlines()), type(error).__name__)[:160]
        raise SegmentationError(
            f"{path} ({size} bytes) is no torch checkpoint of plain weights: {reason}",
            "it is truncated or of another format",
        ) from error
    if not isinstance(content, Mapping):
        raise SegmentationError(f"{path} holds a {type(content).__name__}, not a table of weights")
    return content


def split(content: Mapping[str, Any], where: str) -> tuple[dict[str, Tensor], NetworkConfig | None]:
    """Weights and, for a file of this project, the network's shape.

    Raises:
        SegmentationError: The file holds no weights, or a shape that is not understood.
    """
    config = None
    if "config" in content and "format" in content:
        if content["format"] != FORMAT:
            raise SegmentationError(f"{where} has the format {content['format']!r}, this version reads {FORMAT!r}")
        try:
            config = NetworkConfig.model_validate_json(str(content["config"]))
        except ValidationError as error:
            raise _not_understood(error, where) from error
    content = next((content[key] for key in _WRAPPERS if isinstance(content.get(key), Mapping)), content)
    state = {str(key): value for key, value in content.items() if isinstance(value, Tensor)}
    if not state:
        raise SegmentationError(f"{where} holds no weights; its keys: {_some(map(str, content))}")
    for key, value in state.items():
        if not _is_plain(value):
            raise SegmentationError(f"{where}: {key[:100]!r} is no plain array of numbers")
    return state, config


def _not_understood(error: ValidationError, where: str) -> SegmentationError:
    first = error.errors()[0]
    return SegmentationError(f"{where}: the network's shape is not understood: {first['loc']}: {first['msg']}")


def _is_plain(value: Tensor) -> bool:
    """Whether a tensor stores all numbers of its shape: it is no expanded view and not sparse."""
    if value.layout != torch.strided or value.is_quantized or value.is_meta or value.is_complex():
        return False
    return value.numel() * value.element_size() <= value.untyped_storage().nbytes()


def canonical_names(state: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Today's torchvision names in float32, without ``num_batches_tracked`` and the prefix of a parallel wrapper."""
    prefix = "module." if all(key.startswith("module.") for key in state) else ""
    result = {}
    for key, value in state.items():
        name = key[len(prefix) :]
        if name.endswith("num_batches_tracked"):
            continue
        for pattern, replacement in _RENAMES:
            name = pattern.sub(replacement, name)
        if match := _MASK_FCN.match(name):
            name = f"roi_heads.mask_head.{int(match[1]) - 1}.0.{match[2]}"
        result[name] = value.float() if value.is_floating_point() else value
    return result


def infer_config(state: Mapping[str, Tensor], where: str) -> NetworkConfig:
    """The network's shape, inferred from the weights of a torchvision model.

    Raises:
        SegmentationError: Weights that give the shape are missing, or the classes have no names.
    """
    needed = (
        "backbone.body.conv1.weight",
        "roi_heads.box_predictor.cls_score.weight",
        "backbone.fpn.inner_blocks.0.0.weight",
        "rpn.head.cls_logits.weight",
        "roi_heads.mask_head.0.0.weight",
    )
    missing = [key for key in needed if key not in state or state[key].dim() not in (2, 4)]
    if missing:
        raise SegmentationError(
            f"{where} is no Mask R-CNN of torchvision's layout: {missing[0]} is missing ({len(state)} keys, "
            f"for example {_some(state)})"
        )
    bottleneck = "backbone.body.layer1.0.conv3.weight" in state
    blocks = tuple(
        len({key.split(".")[3] for key in state if key.startswith(f"backbone.body.layer{stage}.")})
        for stage in range(1, 5)
    )
    classes = int(state["roi_heads.box_predictor.cls_score.weight"].shape[0]) - 1
    names = {len(COCO_CLASSES): COCO_CLASSES, 1: ("person",)}.get(classes)
    if names is None:
        raise SegmentationError(
            f"{where} has {classes} classes without names",
            "90 (COCO) and 1 (person) are known; others need this project's format",
        )
    ratios = int(state["rpn.head.cls_logits.weight"].shape[0])
    if ratios != 3:
        raise SegmentationError(f"{where} has {ratios} anchors a cell, torchvision's models have 3")
    try:
        return NetworkConfig(
            blocks=blocks,
            bottleneck=bottleneck,
            stem=int(state["backbone.body.conv1.weight"].shape[0]),
            channels=int(state["backbone.fpn.inner_blocks.0.0.weight"].shape[0]),
            classes=names,
            box_hidden=int(state["roi_heads.box_predictor.cls_score.weight"].shape[1]),
            mask_channels=int(state["roi_heads.mask_head.0.0.weight"].shape[0]),
            mask_layers=len({k.split(".")[2] for k in state if k.startswith("roi_heads.mask_head.")}),
            cfpn=True,
        )
    except ValidationError as error:
        raise _not_understood(error, where) from error


def load_strictly(network: MaskRCNN, state: Mapping[str, Tensor], where: str) -> None:
    """Copy weights into a network; only the whole CFPN may be missing, and then it adds nothing.

    Raises:
        SegmentationError: Keys are missing or unknown, shapes differ, or a weight is not finite.
    """
    _check_fit(network, state, where)
    for key, value in state.items():
        if value.is_floating_point() and not math.isfinite(float(value.abs().sum())):
            raise SegmentationError(f"{where}: {key} holds NaN or infinite values")
    network.load_state_dict(dict(state), strict=False)


def _check_fit(network: MaskRCNN, state: Mapping[str, Tensor], where: str) -> None:
    own = _weights(network)
    has_cfpn = any(key.startswith(CFPN_PREFIX) for key in state)
    missing = [key for key in own if key not in state and (has_cfpn or not key.startswith(CFPN_PREFIX))]
    unknown = [key for key in state if key not in own]
    shapes = [
        f"{key} {_shape(state[key])} instead of {_shape(own[key])}"
        for key in own
        if key in state and state[key].shape != own[key].shape
    ]
    checks = (("keys are missing", missing), ("keys are unknown", unknown), ("shapes differ", shapes))
    faults = [f"{len(keys)} {what} ({_some(keys)})" for what, keys in checks if keys]
    if faults:
        raise SegmentationError(f"{where} does not fit the network: " + "; ".join(faults))


def _weights(network: MaskRCNN) -> dict[str, Tensor]:
    return {key: value for key, value in network.state_dict().items() if not key.endswith("num_batches_tracked")}


def save_network(network: MaskRCNN, path: Path, *, half: bool = False) -> None:
    """Write a network with its shape; `half` stores float16."""
    state = {key: value.detach().cpu() for key, value in _weights(network).items()}
    if half:
        state = {key: value.half() if value.is_floating_point() else value for key, value in state.items()}
    content = {"format": FORMAT, "config": network.config.model_dump_json(), "model": state}
    with (
        replacing(path) as temporary,
        temporary.open("wb") as file,
    ):  # an open file: torch.save writes no file name into it
        torch.save(content, file)


def _some(keys: Iterable[str]) -> str:
    listed = list(keys)
    more = f", and {len(listed) - KEYS_SHOWN} more" if len(listed) > KEYS_SHOWN else ""
    return ", ".join(listed[:KEYS_SHOWN]) + more


def _shape(value: Tensor) -> str:
    return "x".join(map(str, value.shape)) or "scalar"
