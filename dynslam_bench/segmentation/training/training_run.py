"""The state of a training run: network, average, optimiser, scores; a step, and what is needed to go on."""

from __future__ import annotations

import copy
import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from dynslam_bench.core.errors import SegmentationError
from dynslam_bench.core.files import replacing

from ..networks.mask_rcnn.config import NetworkConfig
from ..networks.mask_rcnn.loading import canonical_names, load_strictly, read_checkpoint, save_network, split
from ..networks.mask_rcnn.network import MaskRCNN
from . import curve
from .batches import batch_of
from .prepared import Example, PreparedImages
from .progress import TrainProgress, TrainResult
from .settings import TrainSettings
from .validation import validate

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
        curve.write_csv(self.rows, self.output / "curve.csv")
        title = f"{self.settings.network}, {'CFPN' if self.settings.cfpn else 'FPN'}: losses and validation scores"
        drawn, scores = ("loss", *LOSSES), ("iou", "pixel_iou", "recall")
        curve.draw(self.rows, self.output / "curve.png", title=title, losses=drawn, scores=scores)

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
