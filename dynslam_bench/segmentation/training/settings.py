"""Settings, progress and result of ``segmenter train``; imports no torch."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from pydantic import Field

from dynslam_bench.core.settings import Settings


class TrainSettings(Settings):
    """Training of a Mask R-CNN."""

    network: Literal["embedded", "resnet18", "resnet50"] = Field(
        "embedded",
        description="half-width ResNet-18 at 320 x 240 for persons, or a full-width trunk",
    )
    classes: str = Field(
        "person", description="classes to learn: comma-separated COCO names or presets"
    )
    cfpn: bool = Field(
        True,
        description="cross-layer feature pyramid in the mask branch; false is plain Mask R-CNN",
    )
    data: tuple[str, ...] = Field(
        ("synthetic:scenes=0-89,frames=2,options=0.3,seed=1",),
        description="sets of labelled images to learn from",
    )
    validation: str = Field(
        "synthetic:scenes=90-99,frames=1,seed=2", description="set that chooses the best checkpoint"
    )
    init: str = Field(
        "", description="checkpoint to start from: of the same shape, or a file of torchvision's"
    )
    iterations: int = Field(4000, ge=1, description="training steps")
    batch: int = Field(8, ge=1, description="images a step")
    proposals: int = Field(64, ge=8, description="proposals an image in the box losses")
    learning_rate: float = Field(
        1e-3, gt=0, description="of AdamW, after warm-up; falls as a cosine to 1 %"
    )
    weight_decay: float = Field(1e-4, ge=0, description="of AdamW")
    warmup: int = Field(200, ge=0, description="steps of linear warm-up")
    average: float = Field(
        0.998, ge=0, lt=1, description="decay of the averaged weights that are evaluated and kept"
    )
    precision: Literal["float32", "bfloat16"] = Field("float32", description="of the convolutions")
    evaluate_every: int = Field(
        500, ge=1, description="steps between evaluations on the validation set"
    )
    checkpoint_every: int = Field(100, ge=1, description="steps between resumable checkpoints")
    seed: int = Field(0, ge=0, description="of weights, order and augmentation")


@dataclass(frozen=True)
class TrainProgress:
    """Progress of a training run.

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
    """Result of a training run.

    Attributes:
        best: The averaged weights with the best validation score, in this project's checkpoint
            format.
        step: Step at which they were reached.
        iou: Mean IoU of these weights over the objects of the validation set.
    """

    best: Path
    step: int
    iou: float
