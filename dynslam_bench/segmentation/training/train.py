"""``segmenter train``: train a Mask R-CNN, resumably."""

import copy
import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch
from torch import nn

from dynslam_bench.core import (
    SegmentationError,
    read_json,
    replacing,
    translate_errors,
    write_atomic,
)
from dynslam_bench.evaluation import MaskCounts, compare_masks
from dynslam_bench.segmentation.networks import pinned_threads
from dynslam_bench.segmentation.networks.backbone import EMBEDDED, RESNET18, NetworkConfig
from dynslam_bench.segmentation.networks.loading import (
    load_strictly,
    read_checkpoint,
    read_weights,
    save_network,
)
from dynslam_bench.segmentation.networks.mask_rcnn_segmenter import paste
from dynslam_bench.segmentation.networks.network import MaskRCNN
from dynslam_bench.segmentation.settings import COCO_NAMES, PRESETS
from dynslam_bench.segmentation.training.labelled_images import (
    Example,
    PreparedImages,
    batch_of,
    open_labelled,
    prepare,
)
from dynslam_bench.segmentation.training.settings import TrainProgress, TrainResult, TrainSettings

LOSSES = ("objectness", "anchor", "class", "box", "mask")
"""The losses of Mask R-CNN: two of the proposals, three of the heads."""
LARGEST_GRADIENT = 5.0
"""Gradients are scaled down to this norm."""
FROZEN_STATISTICS = 0.8
"""Share of the steps after which batch statistics stay fixed, so that the weights settle to them."""


def train(
    settings: TrainSettings,
    output: Path,
    *,
    data_cache: Path | None = None,
    device: str = "cpu",
    threads: int = 1,
    resume: bool = True,
    progress: Callable[[TrainProgress], object] = lambda _: None,
) -> TrainResult:
    """Train a network.

    `output` receives ``best.pt`` (weights), ``best-half.pt`` (the same in float16, for packaging),
    ``last.pt`` (the whole state of the run), ``curve.csv``, ``curve.html`` and ``settings.json``. A
    run that is started again with the same settings continues from ``last.pt``.

    Args:
        settings: Network, data and schedule.
        output: Folder of the run.
        data_cache: Folder of images at the network's size; None means ``output / "data"``.
        device: ``cpu`` or ``cuda:N``.
        threads: Threads torch may use.
        resume: False starts a new run.
        progress: Called after each prepared image, step and evaluation.

    Raises:
        SegmentationError: The data or the initial weights do not fit, or `output` holds a run with
            other settings.
    """
    # the network's input has the proportions 4:3 of most sequences' frames
    config = network_config(settings)
    width = round(config.min_side * 4 / 3)
    height = config.min_side
    output.mkdir(parents=True, exist_ok=True)
    if resume:
        _check_settings(settings, output / "settings.json")
    write_atomic(output / "settings.json", settings.model_dump_json(indent=2) + "\n")

    def load(text: str) -> PreparedImages:
        """A set of images at the network's size, of which one at least shows an object to learn."""
        folder = prepare(
            open_labelled(text),
            data_cache or output / "data",
            height,
            width,
            lambda done, total: progress(TrainProgress("data", done, total, {})),
        )
        images = PreparedImages(folder, config.classes)
        labelled = {name for names in images.names for name in names}
        if labelled.isdisjoint(config.classes):
            raise SegmentationError(
                f"none of {len(images)} images of {text} shows an object of the classes {settings.classes}",
                f"labelled are: {', '.join(sorted(labelled)) or 'none'}",
            )
        return images

    # prepare the images at that size, then learn
    sets = [load(text) for text in settings.data]
    validation = load(settings.validation)
    with pinned_threads(torch.get_num_threads, torch.set_num_threads, threads):
        run = TrainingRun(settings, config, output, device)
        if resume and (output / "last.pt").is_file():
            run.restore()
        return run.run(sets, validation, progress)


def network_config(settings: TrainSettings) -> NetworkConfig:
    """The network's shape that the settings ask for.

    Raises:
        SegmentationError: A class name is unknown or named twice.
    """
    # class names, of which some stand for several
    parts = [part.strip() for part in settings.classes.split(",")]
    names = [name for part in parts for name in PRESETS.get(part, (part,))]
    unknown = [name for name in names if name not in COCO_NAMES]
    if unknown or len(set(names)) != len(names):
        reason = f"'{unknown[0]}' is no COCO class" if unknown else "one is named twice"
        raise SegmentationError(f"the classes '{settings.classes}' cannot be learned: {reason}")

    # the network, at a smaller input than the published one
    shapes = {"embedded": EMBEDDED, "resnet18": RESNET18, "resnet50": NetworkConfig()}
    shape = shapes[settings.network]
    sides = {} if settings.network == "embedded" else {"min_side": 480, "max_side": 800}
    return shape.model_copy(update={"classes": tuple(names), "cfpn": settings.cfpn, **sides})


def _check_settings(settings: TrainSettings, path: Path) -> None:
    """Raise where the folder's run has other settings than its length."""
    before = read_json(path, kind=SegmentationError) if path.is_file() else {}
    if not isinstance(before, dict):
        raise SegmentationError(
            f"{path} holds no settings", "do not resume, or name another folder"
        )
    for key, value in json.loads(settings.model_dump_json()).items():
        if before.get(key, value) != value and key != "iterations":
            raise SegmentationError(
                f"{path.parent} holds a training run with another {key}: {before[key]!r}, now {value!r}",
                "name another folder, or do not resume",
            )


class TrainingRun:
    """The state of a training run: network, averaged weights, optimiser and scores.

    Args:
        settings: Network, data and schedule.
        config: The network's shape.
        output: Folder of the run.
        device: ``cpu`` or ``cuda:N``.
    """

    # attributes that `last.pt` holds: those with a state of their own, and plain ones by their type
    _MODULES = ("network", "average", "optimiser")
    _PLAIN = {"step": int, "rows": list, "best": dict, "recent": dict}  # noqa: RUF012 - a constant

    def __init__(
        self, settings: TrainSettings, config: NetworkConfig, output: Path, device: str
    ) -> None:
        # the network, and the running average of its weights
        torch.manual_seed(settings.seed)
        self.settings = settings
        self.output = output
        self.device = device
        self.network = MaskRCNN(config)
        if settings.init:
            _initialise(self.network, Path(settings.init))
        self.network.to(device).to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        self.average = copy.deepcopy(self.network).eval()

        # weight decay for matrices and kernels, not for biases and normalisation
        matrices = [weight for weight in self.network.parameters() if weight.dim() > 1]
        vectors = [weight for weight in self.network.parameters() if weight.dim() <= 1]
        groups: list[dict[str, Any]] = [
            {"params": matrices},
            {"params": vectors, "weight_decay": 0.0},
        ]
        self.optimiser = torch.optim.AdamW(
            groups, lr=settings.learning_rate, weight_decay=settings.weight_decay
        )
        self.step = 0
        self.rows: list[dict[str, float]] = []
        self.best = {"iou": -1.0, "step": 0.0}
        self.recent: dict[str, list[float]] = {name: [] for name in LOSSES}

    def run(
        self,
        sets: list[PreparedImages],
        validation: PreparedImages,
        report: Callable[[TrainProgress], object],
    ) -> TrainResult:
        """Learn until the last step."""
        # refuse to begin without data
        settings = self.settings
        total = self.settings.iterations
        if not sum(map(len, sets)) or not len(validation):
            raise SegmentationError("there are no images to learn from or to validate on")
        # steps, with an evaluation and a checkpoint now and then
        while self.step < total:
            losses = self._learn(batch_of(sets, settings, self.step))
            self.step += 1
            for name, value in losses.items():
                self.recent[name].append(value)
            report(TrainProgress("train", self.step, total, losses))
            evaluate = self.step % settings.evaluate_every == 0 or self.step == total
            if evaluate:
                report(TrainProgress("validation", self.step, total, self._evaluate(validation)))
            if evaluate or self.step % settings.checkpoint_every == 0:
                self.save()
        return TrainResult(self.output / "best.pt", int(self.best["step"]), self.best["iou"])

    def _learn(self, batch: list[Example]) -> dict[str, float]:
        """One step of the optimiser on a batch; the losses by name."""
        settings = self.settings
        # batch statistics are fixed in the last part of the run; the learning rate follows the schedule
        self.network.train()
        if self.step >= FROZEN_STATISTICS * settings.iterations:
            for module in self.network.modules():
                if isinstance(module, nn.BatchNorm2d):
                    module.eval()
        for group in self.optimiser.param_groups:
            group["lr"] = _rate(self.step, settings)

        # the batch as tensors
        images = torch.from_numpy(np.stack([example.rgb for example in batch])).to(self.device)
        images = images.permute(0, 3, 1, 2).float() / 255
        boxes = [torch.from_numpy(example.boxes).to(self.device) for example in batch]
        labels = [torch.from_numpy(example.labels).to(self.device) for example in batch]
        masks = [torch.from_numpy(example.masks).to(self.device) for example in batch]

        # forward; anchors and proposals are drawn by seed and step
        generator = torch.Generator().manual_seed(settings.seed * 1_000_003 + self.step)
        with torch.autocast(
            self.device.split(":")[0], torch.bfloat16, enabled=settings.precision == "bfloat16"
        ):
            losses = self.network.losses(
                images, boxes, labels, masks, generator, settings.proposals
            )
        total = torch.stack(list(losses.values())).sum()
        if not torch.isfinite(total):
            raise SegmentationError(
                f"training diverged at step {self.step}: the loss is {float(total)}"
            )

        # one step down the clipped gradient, and into the moving average of the weights
        self.optimiser.zero_grad(set_to_none=True)
        total.backward()  # type: ignore[no-untyped-call]
        nn.utils.clip_grad_norm_(self.network.parameters(), LARGEST_GRADIENT)
        self.optimiser.step()
        self._update_average()
        return {name: float(value.detach()) for name, value in losses.items()}

    @torch.no_grad()
    def _update_average(self) -> None:
        """Move the averaged weights, which are evaluated, a little towards the network's."""
        # at first the mean of few steps counts less
        decay = min(self.settings.average, (self.step + 1) / (self.step + 10))
        weights = self.network.state_dict()
        for key, value in self.average.state_dict().items():
            if value.is_floating_point():
                value.lerp_(weights[key], 1 - decay)
            else:
                value.copy_(weights[key])

    def _evaluate(self, validation: PreparedImages) -> dict[str, float]:
        """Score the averaged weights, keep them if they are the best, and write the learning curve."""
        # mean losses since the last evaluation, and the validation scores
        row = {"step": float(self.step)}
        row.update({name: float(np.mean(values)) for name, values in self.recent.items() if values})
        row["loss"] = sum(row[name] for name in LOSSES if name in row)
        row.update(validate(self.average, validation, self.device))
        self.recent = {name: [] for name in LOSSES}
        self.rows.append(row)

        # keep the best, and draw the curve again
        if row["iou"] > self.best["iou"]:
            self.best = {"iou": row["iou"], "step": float(self.step)}
            save_network(self.average, self.output / "best.pt")
            save_network(self.average, self.output / "best-half.pt", half=True)
        table = pd.DataFrame(self.rows)
        write_atomic(self.output / "curve.csv", table.to_csv(index=False, float_format="%.6g"))
        title = f"{self.settings.network}, {'CFPN' if self.settings.cfpn else 'FPN'}: losses and validation scores"
        draw_curve(table, self.output / "curve.html", title)
        return row

    def save(self) -> None:
        """Write the whole state of the run to ``last.pt``."""
        content = {
            "format": "dynslam-bench/training/1",
            **{name: getattr(self, name) for name in self._PLAIN},
        }
        content |= {name: getattr(self, name).state_dict() for name in self._MODULES}
        with replacing(self.output / "last.pt") as temporary, temporary.open("wb") as file:
            torch.save(content, file)

    def restore(self) -> None:
        """Continue from ``last.pt``.

        Raises:
            SegmentationError: The file does not fit.
        """
        content = read_checkpoint(self.output / "last.pt")
        with translate_errors(
            SegmentationError,
            f"{self.output / 'last.pt'} does not fit these settings",
            of=(LookupError, RuntimeError, ValueError, TypeError, AttributeError),
        ):
            for name in self._MODULES:
                getattr(self, name).load_state_dict(content[name])
            for name, kind in self._PLAIN.items():
                setattr(self, name, kind(content[name]))


def draw_curve(table: pd.DataFrame, path: Path, title: str) -> None:
    """Draw losses (log scale) and scores over the step as a page.

    Args:
        table: Columns ``step`` and some of the curves.
        path: The page; plotly's script lies beside it.
        title: Above it.
    """
    from plotly.subplots import make_subplots

    figure = make_subplots(cols=2, subplot_titles=("losses", "validation scores"))
    for column, names in enumerate((("loss", *LOSSES), ("iou", "pixel_iou", "recall")), start=1):
        for name in table.columns.intersection(list(names)):
            figure.add_scatter(x=table["step"], y=table[name], name=name, row=1, col=column)
    figure.update_layout(title=title, yaxis_type="log", yaxis2_range=[0, 1])
    figure.write_html(path, include_plotlyjs="directory")


def _rate(step: int, settings: TrainSettings) -> float:
    """Learning rate of a step: linear warm-up, then a cosine down to 1 %."""
    if step < settings.warmup:
        return settings.learning_rate * (step + 1) / settings.warmup
    share = (step - settings.warmup) / max(settings.iterations - settings.warmup, 1)
    return settings.learning_rate * (0.01 + 0.99 * 0.5 * (1 + math.cos(math.pi * min(share, 1.0))))


def _initialise(network: MaskRCNN, path: Path) -> None:
    """Start from a checkpoint; heads whose class count differs keep their random start."""
    state, _ = read_weights(path)
    per_class = ("roi_heads.box_predictor.", "roi_heads.mask_predictor.mask_fcn_logits.")
    for key, value in network.state_dict().items():
        if key.startswith(per_class) and key in state and state[key].shape != value.shape:
            state[key] = value
    load_strictly(network, state, path)


@torch.no_grad()
def validate(network: MaskRCNN, images: PreparedImages, device: str = "cpu") -> dict[str, float]:
    """Scores of a network on prepared images, detections from score 0.5.

    Returns:
        ``iou`` (mean over objects of the best detection's IoU), ``pixel_iou`` (all classes' pixels
        together) and ``recall`` (share of objects with IoU >= 0.5).
    """
    network.eval()
    best: list[float] = []
    counts = MaskCounts()
    for index in range(len(images)):
        # the network's objects, with masks in the whole image
        example = images.example(index)
        height, width = example.rgb.shape[:2]
        image = torch.from_numpy(example.rgb).to(device).permute(2, 0, 1).float() / 255
        boxes, labels, _, planes = (part.cpu().numpy() for part in network.detect(image, score=0.5))
        masks = [
            paste(plane, box, height, width, 0.5, exact=True)
            for plane, box in zip(planes, boxes, strict=True)
        ]

        # the best IoU of each object with a detection of its class
        for truth, label in zip(example.masks, example.labels.tolist(), strict=True):
            same_class = [
                mask for mask, kind in zip(masks, labels.tolist(), strict=True) if kind == label
            ]
            ious = [compare_masks(mask, truth).iou or 0.0 for mask in same_class]
            best.append(max(ious, default=0.0))

        # pixels of all objects together
        union = np.any(masks, axis=0) if masks else np.zeros((height, width), bool)
        counts = counts + compare_masks(union, np.asarray(example.masks.any(axis=0)))
    return {
        "iou": float(np.mean(best)) if best else 0.0,
        "pixel_iou": counts.iou or 0.0,
        "recall": float(np.mean(np.array(best) >= 0.5)) if best else 0.0,
    }
