"""``segmenter train``: teach a Mask R-CNN, resumably."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

from dynslam_bench.core.errors import SegmentationError
from dynslam_bench.core.files import write_atomic
from dynslam_bench.core.reading import read_json

from ..classes import COCO_NAMES, PRESETS
from ..networks.mask_rcnn.config import NetworkConfig, embedded_config, resnet18_config
from ..networks.mask_rcnn.segmenter import torch_threads
from .open_labelled import open_labelled
from .prepared import PreparedImages, prepare
from .progress import TrainProgress, TrainResult
from .settings import TrainSettings
from .training_run import TrainingRun

__all__ = ["TrainProgress", "TrainResult", "input_size", "network_config", "train"]


def train(
    settings: TrainSettings,
    output: Path,
    *,
    data_cache: Path | None = None,
    device: str = "cpu",
    threads: int = 1,
    resume: bool = True,
    progress: Callable[[TrainProgress], None] | None = None,
) -> TrainResult:
    """Train a network.

    `output` receives ``best.pt`` (weights), ``best-half.pt`` (the same in float16, for packaging), ``last.pt``
    (everything needed to go on), ``curve.csv``, ``curve.png`` and ``settings.json``. A run that is started again with
    the same settings goes on where it stopped.

    Args:
        settings: Network, data and schedule.
        output: Folder of the run.
        data_cache: Folder of images at the network's size; None means ``output / "data"``.
        device: ``cpu`` or ``cuda:N``.
        threads: Threads torch may use.
        resume: False starts anew.
        progress: Told after each prepared image, step and evaluation.

    Raises:
        SegmentationError: The data or the initial weights do not fit, or `output` holds a run with other settings.
    """
    tell = progress or (lambda _: None)
    config = network_config(settings)
    output.mkdir(parents=True, exist_ok=True)
    fresh = _check_settings(settings, output, resume)
    sets, validation = _open_data(settings, config, data_cache or output / "data", tell)
    with torch_threads(threads):
        run = TrainingRun(settings, config, output, device)
        if not fresh and (output / "last.pt").is_file():
            run.restore()
        return run.go(sets, validation, tell)


def network_config(settings: TrainSettings) -> NetworkConfig:
    """The network's shape that the settings ask for.

    Raises:
        SegmentationError: A class name is unknown or named twice.
    """
    names: list[str] = []
    for part in (part.strip() for part in settings.classes.split(",")):
        names.extend(PRESETS.get(part, (part,)))
    unknown = [name for name in names if name not in COCO_NAMES]
    if unknown or len(set(names)) != len(names) or not names:
        reason = f"'{unknown[0]}' is no COCO class" if unknown else "one is named twice"
        raise SegmentationError(f"the classes '{settings.classes}' cannot be learned: {reason}")
    if settings.network == "embedded":
        return embedded_config(cfpn=settings.cfpn).model_copy(update={"classes": tuple(names)})
    config = resnet18_config(tuple(names), cfpn=settings.cfpn)
    if settings.network == "resnet50":
        config = config.model_copy(update={"blocks": (3, 4, 6, 3), "bottleneck": True, "norm": "frozen"})
    return config.model_copy(update={"min_side": 480, "max_side": 800})


def input_size(config: NetworkConfig) -> tuple[int, int]:
    """Height and width of training images: 4:3, as the frames of most sequences."""
    return config.min_side, round(config.min_side * 4 / 3)


def _check_settings(settings: TrainSettings, output: Path, resume: bool) -> bool:
    """Write down the settings of a new run; True if this is one."""
    path = output / "settings.json"
    if resume and path.is_file():
        before = read_json(path, kind=SegmentationError)
        if not isinstance(before, dict):
            raise SegmentationError(f"{path} holds no settings", "do not resume, or name another folder")
        now = json.loads(settings.model_dump_json())
        changed = sorted(key for key in now if before.get(key) != now[key] and key not in ("iterations", "patience"))
        if changed:
            values = f"{before.get(changed[0])!r}, now {now[changed[0]]!r}"
            raise SegmentationError(
                f"{output} holds a training run with another {changed[0]}: {values}",
                "name another folder, or do not resume",
            )
        write_atomic(path, settings.model_dump_json(indent=2) + "\n")
        return False
    write_atomic(path, settings.model_dump_json(indent=2) + "\n")
    return True


def _open_data(
    settings: TrainSettings, config: NetworkConfig, cache: Path, tell: Callable[[TrainProgress], None]
) -> tuple[list[PreparedImages], PreparedImages]:
    height, width = input_size(config)

    def prepared(done: int, total: int) -> None:
        tell(TrainProgress("data", done, total, {}))

    def load(text: str) -> PreparedImages:
        return PreparedImages(prepare(open_labelled(text), cache, height, width, prepared), config.classes)

    return [load(text) for text in settings.data], load(settings.validation)
