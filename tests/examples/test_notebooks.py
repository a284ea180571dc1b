"""The notebooks run from the first cell to the last, on less data, and are stored without outputs."""

from __future__ import annotations

from pathlib import Path

import pytest
from notebooks import NOTEBOOKS, cells, play

SHORTER = {
    "leaderboard": {"FRAMES = 60": "FRAMES = 4", "range(100, 106)": "range(100, 102)", ', "mask-rcnn"': ""},
    "culling": {},
    "study": {"FRAMES, ROOMS, TRIALS = 40, 6, 12": "FRAMES, ROOMS, TRIALS = 8, 1, 2"},
}
SHOWN = {
    "leaderboard": ["never move", "droid-w/v1", "'ok': 4"],
    "culling": ["epipolar_f_judged", "precision 70%, recall 35%"],
    "study": ["features.fast_threshold", "default"],
}
"""Texts in the outputs of a notebook, from its first cells to its last one."""


@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=lambda notebook: notebook.stem)
def test_they_hold_no_outputs(notebook: Path) -> None:
    code = [cell for cell in cells(notebook) if cell["cell_type"] == "code"]
    assert len(code) >= 5
    assert [(cell["outputs"], cell["execution_count"]) for cell in code] == [([], None)] * len(code)


@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=lambda notebook: notebook.stem)
def test_they_run(
    notebook: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    shown = play(notebook, SHORTER[notebook.stem])
    output = capsys.readouterr().out + "".join(v.to_json() if hasattr(v, "to_json") else repr(v) for v in shown)
    output = output.replace("\\/", "/")  # as JSON writes it
    assert [text for text in SHOWN[notebook.stem] if text not in output] == []
