"""What a training run tells while it runs, and at its end."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path


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
