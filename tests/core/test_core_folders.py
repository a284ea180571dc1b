"""Where data, stages, weights and vocabularies lie: the environment's word, else the user's cache folder."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from dynslam_bench.core import folders

FOLDERS = {
    "data": folders.find_data_root,
    "stages": folders.stage_cache_folder,
    "weights": folders.weights_folder,
    "vocabularies": folders.vocabularies_folder,
}
VARIABLES = {"data": folders.DATA_VARIABLE, "stages": folders.STAGES_VARIABLE, "weights": folders.WEIGHTS_VARIABLE}


@pytest.fixture(autouse=True)
def home(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    for variable in (*VARIABLES.values(), "XDG_CACHE_HOME"):
        monkeypatch.delenv(variable, raising=False)
    monkeypatch.setattr(Path, "home", lambda: tmp_path)
    return tmp_path


@pytest.mark.parametrize(("platform", "cache"), [("linux", ".cache"), ("darwin", "Library/Caches")])
@pytest.mark.parametrize("name", FOLDERS)
def test_everything_lies_in_one_cache_folder(name: str, platform: str, cache: str, home: Path, monkeypatch) -> None:
    monkeypatch.setattr(sys, "platform", platform)
    assert FOLDERS[name]() == home / cache / "dynslam-bench" / name
    monkeypatch.setenv("XDG_CACHE_HOME", str(home / "elsewhere"))
    assert FOLDERS[name]() == home / "elsewhere" / "dynslam-bench" / name


@pytest.mark.parametrize("name", VARIABLES)
def test_a_variable_moves_one_of_them(name: str, home: Path, monkeypatch) -> None:
    monkeypatch.setenv(VARIABLES[name], str(home / "mine"))
    assert FOLDERS[name]() == (home / "mine" / "stages" if name == "stages" else home / "mine")
    for other in FOLDERS.keys() - {name}:
        assert FOLDERS[other]() == folders.user_cache() / other
