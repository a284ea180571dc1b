"""Callbacks for studies: trials as runs in TensorBoard (for MLflow Optuna has its own, see docs/tuning.md)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import optuna
from optuna.trial import FrozenTrial

from dynslam_bench.core.errors import StudyError
from dynslam_bench.core.version import install_hint


class TensorBoard:
    """Writes each complete trial as a run of TensorBoard: its settings as hyper-parameters, its values as metrics.

    Example:
        ``Study(..., callbacks=[TensorBoard("board")]).run()``, then point TensorBoard at that folder

    Args:
        folder: Where; one folder a trial is made in it.

    Raises:
        StudyError: The package ``tensorboard`` is not installed.
    """

    def __init__(self, folder: Path | str) -> None:
        self._folder = Path(folder).expanduser()
        try:
            from torch.utils.tensorboard import SummaryWriter
        except ImportError as error:
            raise StudyError("the callback needs the package tensorboard", install_hint("tensorboard")) from error
        self._writer: Any = SummaryWriter

    def __call__(self, study: optuna.Study, trial: FrozenTrial) -> None:
        """Take in a trial; those that failed or were stopped have no values and are left out."""
        if trial.values is None or trial.state != optuna.trial.TrialState.COMPLETE:
            return
        names = study.metric_names or [f"value_{index}" for index in range(len(trial.values))]
        settings = {key: value if isinstance(value, int | float) else str(value) for key, value in trial.params.items()}
        with self._writer(str(self._folder / f"trial-{trial.number:04d}")) as writer:
            writer.add_hparams(settings, dict(zip(names, trial.values, strict=True)), run_name=".")
            for name, value in zip(names, trial.values, strict=True):
                writer.add_scalar(f"study/{name}", value, trial.number)
