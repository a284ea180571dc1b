"""The notebooks run from the first cell to the last, on less data, and are stored without outputs."""

from __future__ import annotations

import json
from pathlib import Path

import pandas as pd
import plotly.graph_objects as go
import pytest
from notebooks import NOTEBOOKS, cells, play, play_in_a_kernel

SHORTER = {
    "leaderboard": {"FRAMES = 60": "FRAMES = 4", "range(100, 106)": "range(100, 102)", ', "mask-rcnn"': ""},
    "culling": {},
    "study": {"FRAMES, ROOMS, TRIALS = 40, 6, 12": "FRAMES, ROOMS, TRIALS = 8, 1, 2"},
}
IN_A_KERNEL = {
    "leaderboard": ["ranks", "error over the error of not moving", "droid-w/v1"],
    "culling": ["epipolar_f_judged", "distance to the epipolar line", "precision 70%, recall 35%"],
    "study": ["features.fast_threshold", "params.backend.tracking.map_radius_px", "default"],
}
"""What the outputs of a notebook hold, from its first cells to its last one."""


def test_there_are_three() -> None:
    assert {notebook.stem for notebook in NOTEBOOKS} == set(SHORTER) == set(IN_A_KERNEL)


@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=lambda notebook: notebook.stem)
def test_they_hold_no_outputs(notebook: Path) -> None:
    code = [cell for cell in cells(notebook) if cell["cell_type"] == "code"]
    assert len(code) >= 5
    assert [(cell["outputs"], cell["execution_count"]) for cell in code] == [([], None)] * len(code)
    assert len({cell["id"] for cell in cells(notebook)}) == len(cells(notebook)), "notebook format 4.5"


def test_the_leaderboard(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.chdir(tmp_path)
    (notebook,) = (each for each in NOTEBOOKS if each.stem == "leaderboard")
    outcomes, errors, strip, protocols = play(notebook, SHORTER["leaderboard"])
    assert outcomes == {"ok": 4, "lost": 0, "crashed": 0}
    assert errors.shape == (2, 2) and isinstance(strip, go.Figure) and isinstance(protocols, pd.DataFrame)
    assert "never move" in capsys.readouterr().out


def test_the_anatomy_of_culling(capsys: pytest.CaptureFixture[str]) -> None:
    (notebook,) = (each for each in NOTEBOOKS if each.stem == "culling")
    (state, stats), flow, distances, histogram, culled = play(notebook)
    assert state == "ok" and stats["epipolar_f_judged"] == 1, "the frame shows what it is for"
    assert distances["median distance on people, px"] > 1.5 * distances["median distance in the room, px"]
    assert all(isinstance(each, go.Figure) for each in (flow, histogram, culled))
    assert "precision 70%, recall 35%" in capsys.readouterr().out, "the text speaks of these"


@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=lambda notebook: notebook.stem)
def test_they_run_in_a_jupyter_kernel(notebook: Path, tmp_path: Path) -> None:
    pytest.importorskip("nbclient", reason="nbclient is not installed")
    pytest.importorskip("ipykernel", reason="ipykernel is not installed")
    outputs = play_in_a_kernel(notebook, tmp_path, SHORTER[notebook.stem])
    shown = json.dumps([{name: output.get(name) for name in ("text", "data")} for output in outputs])
    assert [text for text in IN_A_KERNEL[notebook.stem] if text not in shown] == []
