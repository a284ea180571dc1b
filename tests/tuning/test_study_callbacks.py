"""Callbacks: trials come back from TensorBoard's own reader, and from MLflow's through Optuna's callback."""

from __future__ import annotations

import sys
from pathlib import Path

import optuna
import pytest

from dynslam_bench.core.errors import StudyError
from dynslam_bench.tuning.study import TensorBoard

VALUES = [(0.1, 30.0), (0.2, 20.0), (0.3, 10.0)]


def run(callback: object, named: bool = True) -> optuna.Study:
    """Three trials of two objectives, and one that fails."""
    study = optuna.create_study(directions=["minimize", "minimize"])
    if named:
        study.set_metric_names(["accuracy", "speed"])

    def objective(trial: optuna.Trial) -> tuple[float, float]:
        trial.suggest_float("epipolar.threshold_px", 0.5, 3.0)
        trial.suggest_categorical("flow.search", ["emfoa", "random"])
        if trial.number == len(VALUES):
            raise ArithmeticError("on purpose")
        return VALUES[trial.number]

    study.optimize(objective, n_trials=4, catch=ArithmeticError, callbacks=[callback])
    return study


@pytest.mark.parametrize("named", [True, False])
def test_tensorboard_reads_the_trials(tmp_path: Path, named: bool) -> None:
    reading = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
    study = run(TensorBoard(tmp_path), named)
    names = ["accuracy", "speed"] if named else ["value_0", "value_1"]
    folders = sorted(tmp_path.iterdir())
    assert [folder.name for folder in folders] == [f"trial-{number:04d}" for number in range(3)]
    for number, folder in enumerate(folders):
        events = reading.EventAccumulator(str(folder))
        events.Reload()
        found = [events.Scalars(f"study/{name}")[0] for name in names]
        assert [event.value for event in found] == pytest.approx(VALUES[number]) and found[0].step == number
        assert events.Scalars(names[0])[0].value == pytest.approx(VALUES[number][0])
        plugin = pytest.importorskip("tensorboard.plugins.hparams.plugin_data_pb2").HParamsPluginData
        told = plugin.FromString(events.SummaryMetadata("_hparams_/session_start_info").plugin_data.content)
        settings = told.session_start_info.hparams
        assert settings["epipolar.threshold_px"].number_value == study.trials[number].params["epipolar.threshold_px"]
        assert settings["flow.search"].string_value == study.trials[number].params["flow.search"]


def test_without_tensorboard_one_line_says_what_to_install(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setitem(sys.modules, "torch.utils.tensorboard", None)
    with pytest.raises(StudyError, match=r"needs the package tensorboard \(pip install '\.\[tensorboard\]'"):
        TensorBoard(tmp_path)


def test_optunas_callback_tells_mlflow(tmp_path: Path) -> None:
    mlflow = pytest.importorskip("mlflow", reason="mlflow is not installed")
    integration = pytest.importorskip("optuna_integration", reason="optuna-integration is not installed")
    uri = f"sqlite:///{tmp_path / 'mlflow.db'}"
    study = run(integration.MLflowCallback(tracking_uri=uri, metric_name=["accuracy", "speed"]))
    client = mlflow.MlflowClient(uri)
    (experiment,) = [each for each in client.search_experiments() if each.name == study.study_name]
    rows = {row.info.run_name: row.data for row in client.search_runs([experiment.experiment_id])}
    assert [(rows[str(n)].metrics["accuracy"], rows[str(n)].metrics["speed"]) for n in range(3)] == VALUES
    assert rows["0"].params["flow.search"] == study.trials[0].params["flow.search"]
