"""Where data, stages, weights and vocabularies lie, and the version of the package."""

from __future__ import annotations

import sys
from importlib import metadata
from pathlib import Path

import pytest

import dynslam_bench
from dynslam_bench.core import folders
from dynslam_bench.core import version as versions

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


@pytest.fixture(autouse=True)
def fresh(monkeypatch: pytest.MonkeyPatch):
    versions.version.cache_clear()
    yield
    monkeypatch.undo()
    versions.version.cache_clear()


@pytest.mark.parametrize(
    ("installed", "release"),
    [
        ("0.1.0", "0.1.0"),
        ("0.1.1.dev5+g1a2b3c4.d20261122", "0.1.1"),
        ("0.1.dev1520+gabc", "0.1.0"),
        ("2.0", "2.0.0"),
        ("1.2rc1", "1.2.0"),
    ],
)
def test_the_release_of_a_version(installed: str, release: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(metadata, "version", lambda name: installed)
    assert (dynslam_bench.__version__, versions.release()) == (installed, release)


def test_a_checkout_that_is_not_installed_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(name: str) -> str:
        raise metadata.PackageNotFoundError(name)

    monkeypatch.setattr(metadata, "version", missing)
    assert (dynslam_bench.__version__, versions.release()) == ("0+unknown", "0.0.0")
