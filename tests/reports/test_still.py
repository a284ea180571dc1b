"""Static pictures of plotly's figures."""

import optuna
import plotly.graph_objects as go
import pytest

from dynslam_bench.reports.html.still import still

PICTURE = "data:image/svg+xml;base64,"


@pytest.mark.parametrize("colour", ["#1f77b4", "rgb(8.0, 61.129, 126.5)", "steelblue", None])
@pytest.mark.parametrize("make", [go.Scatter, go.Bar])
def test_any_colour_of_a_trace_is_drawn(make, colour):
    figure = go.Figure(make(x=[1, 2], y=[3, 4], marker={"color": colour}))
    assert still(figure).startswith(PICTURE)


def test_points_with_a_colour_each_are_drawn_in_one():
    figure = go.Figure(go.Scatter(x=[1, 2], y=[3, 4], mode="markers", marker={"color": [0.1, 0.9]}))
    assert still(figure).startswith(PICTURE)


@pytest.fixture(autouse=True)
def silent_optuna():
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    yield
    optuna.logging.set_verbosity(optuna.logging.INFO)


def test_plots_of_optuna_are_drawn_or_left_out():
    study = optuna.create_study()
    study.optimize(
        lambda trial: trial.suggest_float("a", 0, 1) + trial.suggest_int("b", 0, 3), n_trials=5
    )
    plots = optuna.visualization
    for plot in (plots.plot_optimization_history, plots.plot_edf):
        assert still(plot(study)).startswith(PICTURE), plot.__name__
    evaluator = optuna.importance.PedAnovaImportanceEvaluator()
    importances = plots.plot_param_importances(study, evaluator=evaluator)
    assert still(importances).startswith(PICTURE)
    # several panels, and areas
    assert still(plots.plot_slice(study)) == ""
    assert still(plots.plot_contour(study)) == ""


def test_the_front_of_two_objectives_is_drawn():
    study = optuna.create_study(directions=["minimize", "minimize"])
    study.optimize(lambda trial: (trial.suggest_float("a", 0, 1), trial.number), n_trials=5)
    assert still(optuna.visualization.plot_pareto_front(study)).startswith(PICTURE)
