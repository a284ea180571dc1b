"""``segmenter train``: teach a Mask R-CNN, resumably."""

from __future__ import annotations

import copy
import csv
import io
import json
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from dynslam_bench.core.errors import DynslamError, SegmentationError
from dynslam_bench.core.files import replacing, write_atomic
from dynslam_bench.core.reading import read_json
from dynslam_bench.evaluation.masks import MaskCounts, compare_masks
from dynslam_bench.segmentation.networks.backbone import NetworkConfig, embedded_config, resnet18_config
from dynslam_bench.segmentation.networks.loading import (
    canonical_names,
    load_strictly,
    read_checkpoint,
    save_network,
    split,
)
from dynslam_bench.segmentation.networks.mask_rcnn_segmenter import paste, torch_threads
from dynslam_bench.segmentation.networks.network import MaskRCNN
from dynslam_bench.segmentation.settings import COCO_NAMES, PRESETS
from dynslam_bench.segmentation.training.labelled_images import open_labelled
from dynslam_bench.segmentation.training.prepared import Example, PreparedImages, batch_of, prepare
from dynslam_bench.segmentation.training.settings import TrainProgress, TrainResult, TrainSettings

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
    (everything needed to go on), ``csv``, ``png`` and ``settings.json``. A run that is started again with
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


# The state of a training run: network, average, optimiser, scores; a step, and what is needed to go on.

LOSSES = ("objectness", "anchor", "class", "box", "mask")


class TrainingRun:
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
        rate, weight_decay = settings.learning_rate, settings.weight_decay
        self.optimiser = torch.optim.AdamW(groups, lr=rate, weight_decay=weight_decay)
        self.step = 0
        self.rows: list[dict[str, float]] = []
        self.best = {"iou": -1.0, "step": 0.0}
        self.recent: dict[str, list[float]] = {name: [] for name in LOSSES}

    def go(
        self, sets: list[PreparedImages], validation: PreparedImages, tell: Callable[[TrainProgress], None]
    ) -> TrainResult:
        """Learn until the last step, or until validation gains nothing any more."""
        settings = self.settings
        total = sum(len(one) for one in sets)
        if not total or not len(validation):
            raise SegmentationError("there are no images to learn from or to validate on")
        stopped = "finished"
        while self.step < settings.iterations:
            losses = self._learn(batch_of(sets, settings, self.step))
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
            reason = f"training diverged at step {self.step}: the loss is {float(total)}"
            raise SegmentationError(reason, "lower the learning rate")
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
        write_csv(self.rows, self.output / "csv")
        title = f"{self.settings.network}, {'CFPN' if self.settings.cfpn else 'FPN'}: losses and validation scores"
        drawn, scores = ("loss", *LOSSES), ("iou", "pixel_iou", "recall")
        draw(self.rows, self.output / "png", title=title, losses=drawn, scores=scores)

    def save(self) -> None:
        """Write everything needed to go on."""
        content = {
            "format": "dynslam-bench/training/1",
            "step": self.step,
            "network": self.network.state_dict(),
            "average": self.average.state_dict(),
            "optimiser": self.optimiser.state_dict(),
            "rows": json.dumps(self.rows),
            "best": json.dumps(self.best),
            "recent": json.dumps(self.recent),
        }
        with replacing(self.output / "last.pt") as temporary, temporary.open("wb") as file:
            torch.save(content, file)

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
        except (LookupError, RuntimeError, ValueError, TypeError, AttributeError) as error:
            reason = next(iter(str(error).splitlines()), type(error).__name__)
            raise SegmentationError(f"{self.output / 'last.pt'} does not fit these settings: {reason}") from error


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


# Scores of a network on prepared images, as training asks for them now and then.

CONFIDENCE = 0.5


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
            alike = [mask for mask, kind in zip(masks, labels.tolist(), strict=True) if kind == label]
            best.append(max((compare_masks(mask, truth).iou or 0.0 for mask in alike), default=0.0))
        union = np.any(masks, axis=0) if masks else np.zeros((height, width), bool)
        counts = counts + compare_masks(union, np.asarray(example.masks.any(axis=0)))
    return {
        "iou": float(np.mean(best)) if best else 0.0,
        "pixel_iou": counts.iou or 0.0,
        "recall": float(np.mean(np.array(best) >= 0.5)) if best else 0.0,
    }


# The learning curve of a training run: a CSV file and a picture.

COLOURS = ((180, 119, 31), (14, 127, 255), (44, 160, 44), (40, 39, 214), (189, 103, 148), (75, 86, 140))
"""BGR."""


def write_csv(rows: Sequence[Mapping[str, float]], path: Path) -> None:
    """Write one row a step; columns are the union of the rows' keys in order of appearance."""
    columns = list(dict.fromkeys(key for row in rows for key in row))
    text = io.StringIO()
    writer = csv.DictWriter(text, columns, lineterminator="\n")
    writer.writeheader()
    for row in rows:
        writer.writerow({key: f"{value:.6g}" for key, value in row.items()})
    write_atomic(path, text.getvalue())


def draw(
    rows: Sequence[Mapping[str, float]], path: Path, *, title: str, losses: Sequence[str], scores: Sequence[str]
) -> None:
    """Draw losses (log scale, left) and scores (0 to 1, right) over the step as a PNG.

    Args:
        rows: Each with ``step`` and some of the curves.
        path: The picture.
        title: Above it.
        losses: Names of the curves of the left half.
        scores: Names of the curves of the right half.
    """
    canvas = np.full((420, 1120, 3), 255, np.uint8)
    cv2.putText(canvas, title, (20, 26), cv2.FONT_HERSHEY_SIMPLEX, 0.55, (0, 0, 0), 1, cv2.LINE_AA)
    _panel(canvas, 70, rows, losses, logarithmic=True)
    _panel(canvas, 630, rows, scores, logarithmic=False)
    done, data = cv2.imencode(".png", canvas)
    if not done:
        raise DynslamError(f"cannot encode the learning curve {path}")
    write_atomic(path, data.tobytes())


def _panel(
    canvas: NDArray[np.uint8],
    left: int,
    rows: Sequence[Mapping[str, float]],
    names: Sequence[str],
    *,
    logarithmic: bool,
) -> None:
    top, width, height = 50, 440, 320
    last = max((row["step"] for row in rows), default=1.0) or 1.0
    values = [row[name] for row in rows for name in names if name in row and row[name] > 0]
    low, high = (np.log10([min(values), max(values)]) if values else (-1.0, 0.0)) if logarithmic else (0.0, 1.0)
    low, high = (np.floor(low * 2) / 2, np.ceil(high * 2) / 2) if logarithmic else (low, high)
    high = max(high, low + 0.5)

    def place(step: float, value: float) -> tuple[int, int]:
        y = np.log10(max(value, 1e-9)) if logarithmic else value
        share = float(np.clip((y - low) / (high - low), 0, 1))
        return left + round(width * step / last), top + height - round(height * share)

    cv2.rectangle(canvas, (left, top), (left + width, top + height), (160, 160, 160), 1)
    for k in range(5):
        tick = low + (high - low) * k / 4
        y = top + height - height * k // 4
        cv2.line(canvas, (left, y), (left + width, y), (225, 225, 225), 1)
        label = f"{10**tick:.3g}" if logarithmic else f"{tick:.2f}"
        cv2.putText(canvas, label, (left - 58, y + 4), cv2.FONT_HERSHEY_SIMPLEX, 0.4, (60, 60, 60), 1, cv2.LINE_AA)
        step, at = f"{last * k / 4:.0f}", (left + width * k // 4 - 12, top + height + 18)
        cv2.putText(canvas, step, at, cv2.FONT_HERSHEY_SIMPLEX, 0.4, (60, 60, 60), 1, cv2.LINE_AA)
    for number, name in enumerate(names):
        points = [place(row["step"], row[name]) for row in rows if name in row]
        colour = COLOURS[number % len(COLOURS)]
        if points:
            cv2.polylines(canvas, [np.array(points, np.int32)], False, colour, 1, cv2.LINE_AA)
        at = (left + 8 + 85 * number, top + height + 38)
        cv2.putText(canvas, name, at, cv2.FONT_HERSHEY_SIMPLEX, 0.45, colour, 1, cv2.LINE_AA)
