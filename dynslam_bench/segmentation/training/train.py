"""``segmenter train``: teach a Mask R-CNN, resumably."""

from __future__ import annotations

import copy
import json
import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from dynslam_bench.core.errors import SegmentationError
from dynslam_bench.core.records import write_atomic
from dynslam_bench.core.seeding import stream
from dynslam_bench.evaluation.masks import MaskCounts, compare_masks

from ..classes import COCO_NAMES, PRESETS
from ..networks.mask_rcnn.config import NetworkConfig, embedded_config, resnet18_config
from ..networks.mask_rcnn.loading import canonical_names, load_strictly, read_checkpoint, save_network, split
from ..networks.mask_rcnn.network import MaskRCNN
from ..networks.mask_rcnn.segmenter import paste, torch_threads
from . import curve
from .labelled import open_labelled
from .prepared import Example, PreparedImages, prepare
from .settings import TrainSettings

LOSSES = ("objectness", "anchor", "class", "box", "mask")
CONFIDENCE = 0.5


@dataclass(frozen=True)
class TrainProgress:
    """Where a training run is.

    Attributes:
        stage: ``data`` (images being prepared), ``train`` or ``validation``.
        done: Images or steps done.
        total: Images or steps in all.
        values: Latest losses or scores.
    """

    stage: str
    done: int
    total: int
    values: dict[str, float]


@dataclass(frozen=True)
class TrainResult:
    """What came of a training run.

    Attributes:
        best: The averaged weights with the best validation score, in our checkpoint format.
        step: Step at which they were reached.
        iou: Their mean IoU over the objects of the validation set.
        stopped: Why the run ended: ``finished`` or ``no gain``.
    """

    best: Path
    step: int
    iou: float
    stopped: str


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
        run = _Run(settings, config, output, device)
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
        before = json.loads(path.read_text())
        now = json.loads(settings.model_dump_json())
        changed = sorted(key for key in now if before.get(key) != now[key] and key not in ("iterations", "patience"))
        if changed:
            raise SegmentationError(
                f"{output} holds a training run with another {changed[0]}: {before.get(changed[0])!r}, now "
                f"{now[changed[0]]!r}", "name another folder, or do not resume"
            )  # fmt: skip
        write_atomic(path, settings.model_dump_json(indent=2) + "\n")
        return False
    write_atomic(path, settings.model_dump_json(indent=2) + "\n")
    return True


def _open_data(
    settings: TrainSettings, config: NetworkConfig, cache: Path, tell: Callable[[TrainProgress], None]
) -> tuple[list[PreparedImages], PreparedImages]:
    height, width = input_size(config)

    def load(text: str) -> PreparedImages:
        folder = prepare(open_labelled(text), cache, height, width,
                         lambda done, total: tell(TrainProgress("data", done, total, {})))  # fmt: skip
        return PreparedImages(folder, config.classes)

    return [load(text) for text in settings.data], load(settings.validation)


class _Run:
    """The state of a training run."""

    def __init__(self, settings: TrainSettings, config: NetworkConfig, output: Path, device: str) -> None:
        torch.manual_seed(settings.seed)
        self.settings = settings
        self.output = output
        self.device = device
        self.network = MaskRCNN(config)
        if settings.init:
            _initialise(self.network, Path(settings.init))
        self.network.to(device).to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        self.average = copy.deepcopy(self.network).eval()
        decay: list[nn.Parameter] = []
        plain: list[nn.Parameter] = []
        for parameter in self.network.parameters():
            (decay if parameter.dim() > 1 else plain).append(parameter)
        groups: list[dict[str, Any]] = [{"params": decay}, {"params": plain, "weight_decay": 0.0}]
        self.optimiser = torch.optim.AdamW(
            groups,
            lr=settings.learning_rate, weight_decay=settings.weight_decay,
        )  # fmt: skip
        self.step = 0
        self.rows: list[dict[str, float]] = []
        self.best = {"iou": -1.0, "step": 0.0}
        self.recent: dict[str, list[float]] = {name: [] for name in LOSSES}

    def go(
        self, sets: list[PreparedImages], validation: PreparedImages, tell: Callable[[TrainProgress], None]
    ) -> TrainResult:
        settings = self.settings
        total = sum(len(one) for one in sets)
        if not total or not len(validation):
            raise SegmentationError("there are no images to learn from or to validate on")
        stopped = "finished"
        while self.step < settings.iterations:
            losses = self._learn(_batch(sets, settings, self.step))
            self.step += 1
            for name, value in losses.items():
                self.recent[name].append(value)
            tell(TrainProgress("train", self.step, settings.iterations, losses))
            evaluate = self.step % settings.evaluate_every == 0 or self.step == settings.iterations
            if evaluate:
                row = {"step": float(self.step)}
                row.update({name: float(np.mean(values)) for name, values in self.recent.items() if values})
                row["loss"] = sum(row[name] for name in LOSSES if name in row)
                row.update(validate(self.average, validation, self.device))
                self._record(row)
                self.recent = {name: [] for name in LOSSES}
                tell(TrainProgress("validation", self.step, settings.iterations, row))
            if evaluate or self.step % settings.checkpoint_every == 0:
                self.save()
            waited = (self.step - self.best["step"]) / settings.evaluate_every
            if evaluate and settings.patience and waited >= settings.patience:
                stopped = "no gain"
                break
        return TrainResult(self.output / "best.pt", int(self.best["step"]), self.best["iou"], stopped)

    def _learn(self, batch: list[Example]) -> dict[str, float]:
        settings = self.settings
        self.network.train()
        _freeze_statistics(self.network, self.step, settings)
        rate = _rate(self.step, settings)
        for group in self.optimiser.param_groups:
            group["lr"] = rate
        images = torch.from_numpy(np.stack([one.rgb for one in batch])).to(self.device)
        images = images.permute(0, 3, 1, 2).float() / 255
        boxes = [torch.from_numpy(one.boxes).to(self.device) for one in batch]
        labels = [torch.from_numpy(one.labels).to(self.device) for one in batch]
        masks = [torch.from_numpy(one.masks).to(self.device) for one in batch]
        generator = torch.Generator().manual_seed(settings.seed * 1_000_003 + self.step)
        with torch.autocast(self.device.split(":")[0], torch.bfloat16, enabled=settings.precision == "bfloat16"):
            losses = self.network.losses(images, boxes, labels, masks, generator, settings.proposals)
        total = torch.stack(list(losses.values())).sum()
        if not torch.isfinite(total):
            raise SegmentationError(f"training diverged at step {self.step}: the loss is {float(total)}",
                                    "lower the learning rate")  # fmt: skip
        self.optimiser.zero_grad(set_to_none=True)
        total.backward()  # type: ignore[no-untyped-call]
        nn.utils.clip_grad_norm_(self.network.parameters(), 5.0)
        self.optimiser.step()
        self._update_average()
        return {name: float(value.detach()) for name, value in losses.items()}

    @torch.no_grad()
    def _update_average(self) -> None:
        decay = min(self.settings.average, (self.step + 1) / (self.step + 10))
        own = self.network.state_dict()
        for key, value in self.average.state_dict().items():
            if value.is_floating_point():
                value.lerp_(own[key], 1 - decay)
            else:
                value.copy_(own[key])

    def _record(self, row: dict[str, float]) -> None:
        self.rows.append(row)
        if row["iou"] > self.best["iou"]:
            self.best = {"iou": row["iou"], "step": float(self.step)}
            save_network(self.average, self.output / "best.pt")
            save_network(self.average, self.output / "best-half.pt", half=True)
        curve.write_csv(self.rows, self.output / "curve.csv")
        title = f"{self.settings.network}, {'CFPN' if self.settings.cfpn else 'FPN'}: losses and validation scores"
        curve.draw(self.rows, self.output / "curve.png", title=title, losses=("loss", *LOSSES),
                   scores=("iou", "pixel_iou", "recall"))  # fmt: skip

    def save(self) -> None:
        """Write everything needed to go on."""
        content = {
            "format": "dynslam-bench/training/1", "step": self.step, "network": self.network.state_dict(),
            "average": self.average.state_dict(), "optimiser": self.optimiser.state_dict(),
            "rows": json.dumps(self.rows), "best": json.dumps(self.best), "recent": json.dumps(self.recent),
        }  # fmt: skip
        temporary = self.output / ".last.pt.tmp"
        torch.save(content, temporary)
        temporary.replace(self.output / "last.pt")

    def restore(self) -> None:
        """Go on from ``last.pt``.

        Raises:
            SegmentationError: The file does not fit.
        """
        content: dict[str, Any] = dict(read_checkpoint(self.output / "last.pt"))
        try:
            self.network.load_state_dict(content["network"])
            self.average.load_state_dict(content["average"])
            self.optimiser.load_state_dict(content["optimiser"])
            self.step, self.rows = int(content["step"]), json.loads(content["rows"])
            self.best, self.recent = json.loads(content["best"]), json.loads(content["recent"])
        except (KeyError, RuntimeError, ValueError) as error:
            reason = str(error).splitlines()[0]
            raise SegmentationError(f"{self.output / 'last.pt'} does not fit these settings: {reason}") from error


@torch.no_grad()
def validate(network: MaskRCNN, images: PreparedImages, device: str = "cpu") -> dict[str, float]:
    """Scores of a network on prepared images, detections from score 0.5.

    Returns:
        ``iou`` (mean over objects of the best detection's IoU), ``pixel_iou`` (all classes' pixels together) and
        ``recall`` (share of objects with IoU >= 0.5).
    """
    network.eval()
    best: list[float] = []
    counts = MaskCounts()
    for index in range(len(images)):
        example = images[index]
        height, width = example.rgb.shape[:2]
        image = torch.from_numpy(example.rgb).to(device).permute(2, 0, 1).float() / 255
        found = network.detect(image, score=CONFIDENCE)
        boxes, planes = found.boxes.cpu().numpy(), found.masks.float().cpu().numpy()
        labels = found.labels.cpu().numpy()
        masks = [paste(plane, box, height, width, 0.5, exact=True) for plane, box in zip(planes, boxes, strict=True)]
        for truth, label in zip(example.masks, example.labels.tolist(), strict=True):
            ious = [compare_masks(mask, truth).iou or 0.0
                    for mask, kind in zip(masks, labels.tolist(), strict=True) if kind == label]  # fmt: skip
            best.append(max(ious, default=0.0))
        union = np.any(masks, axis=0) if masks else np.zeros((height, width), bool)
        counts = counts + compare_masks(union, np.asarray(example.masks.any(axis=0)))
    return {
        "iou": float(np.mean(best)) if best else 0.0,
        "pixel_iou": counts.iou or 0.0,
        "recall": float(np.mean(np.array(best) >= 0.5)) if best else 0.0,
    }


def _batch(sets: list[PreparedImages], settings: TrainSettings, step: int) -> list[Example]:
    """The step's images: sets in proportion to their size, every image once an epoch, in random order."""
    sizes = [len(one) for one in sets]
    total = sum(sizes)
    batch = []
    for position in range(step * settings.batch, (step + 1) * settings.batch):
        epoch, place = divmod(position, total)
        number = _permuted(place, total, settings.seed, epoch)
        chosen = 0
        while number >= sizes[chosen]:
            number -= sizes[chosen]
            chosen += 1
        batch.append(sets[chosen].varied(number, stream(settings.seed, "vary", position)))
    return batch


_ORDER: dict[tuple[int, int, int], np.ndarray[Any, np.dtype[np.int64]]] = {}


def _permuted(place: int, total: int, seed: int, epoch: int) -> int:
    key = (total, seed, epoch)
    if key not in _ORDER:
        _ORDER.clear()
        _ORDER[key] = stream(seed, "order", epoch).permutation(total)
    return int(_ORDER[key][place])


def _rate(step: int, settings: TrainSettings) -> float:
    """Learning rate of a step: linear warm-up, then a cosine down to 1 %."""
    if step < settings.warmup:
        return settings.learning_rate * (step + 1) / settings.warmup
    share = (step - settings.warmup) / max(settings.iterations - settings.warmup, 1)
    return settings.learning_rate * (0.01 + 0.99 * 0.5 * (1 + math.cos(math.pi * min(share, 1.0))))


def _freeze_statistics(network: MaskRCNN, step: int, settings: TrainSettings) -> None:
    """Keep batch statistics fixed in the last fifth of the run, so that the weights settle to them."""
    if step >= 0.8 * settings.iterations:
        for module in network.modules():
            if isinstance(module, nn.BatchNorm2d):
                module.eval()


def _initialise(network: MaskRCNN, path: Path) -> None:
    """Start from a checkpoint; heads whose class count differs keep their random start."""
    state: dict[str, Tensor] = canonical_names(split(read_checkpoint(path), str(path))[0])
    own = network.state_dict()
    per_class = ("roi_heads.box_predictor.", "roi_heads.mask_predictor.mask_fcn_logits.")
    for key in [
        key for key in state if key.startswith(per_class) and key in own and state[key].shape != own[key].shape
    ]:
        state[key] = own[key]
    load_strictly(network, state, str(path))
