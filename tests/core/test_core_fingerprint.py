"""Digests of code, weights, machine and content: what changes them, and what must not."""

import sys
from importlib import metadata
from pathlib import Path

import numpy as np
import pytest

import dynslam_bench
from dynslam_bench.core import fingerprint, folders
from dynslam_bench.core import version as versions
from dynslam_bench.core.errors import PluginError
from dynslam_bench.core.fingerprint import (
    code_digest,
    content_digest,
    machine_digest,
    named_digests,
    opencv_version,
    plugin_digest,
)
from dynslam_bench.core.settings import Settings, names, tunable


def write(path: Path, text: str) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
    return path


def test_content_digest_sees_type_shape_and_value() -> None:
    base = np.zeros((2, 3), np.uint8)
    others = [base.reshape(3, 2), base.astype(np.int8), base + 1]
    assert len({content_digest(each) for each in (base, *others)}) == 4
    assert content_digest(base) == content_digest(np.zeros((2, 6), np.uint8)[:, ::2])


def test_a_plug_in_counts_with_the_code_of_its_folder_and_nothing_else(tmp_path: Path) -> None:
    plugin = write(tmp_path / "mine.py", "a = 1\n")
    helper = write(tmp_path / "helper.py", "b = 1\n")
    before = plugin_digest(f"{plugin}:SPEC")
    write(tmp_path / "notes.txt", "not code")
    assert plugin_digest(f"{plugin}:SPEC") == before
    helper.write_text("b = 2\n")
    assert plugin_digest(f"{plugin}:SPEC") != before
    assert plugin_digest("dynslam_bench.features.orb:OrbExtractor") == ""
    with pytest.raises(PluginError, match=r"cannot read the code.*No such file"):
        plugin_digest(f"{tmp_path}/none/none.py:SPEC")


def test_packages_with_and_without_init_count_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(tmp_path))
    write(tmp_path / "fp_regular" / "__init__.py", "")
    for package in ("fp_regular", "fp_namespace"):
        inner = write(tmp_path / package / "deep" / "inner.py", "a = 1\n")
        before = plugin_digest(f"{package}.deep.inner:SPEC")
        inner.write_text("a = 2\n")
        changed = plugin_digest(f"{package}.deep.inner:SPEC")
        inner.rename(inner.with_name("other.py"))
        assert len({before, changed, plugin_digest(f"{package}.deep.inner:SPEC")}) == 3
    with pytest.raises(PluginError, match="code of 'fp_nowhere' cannot be found"):
        plugin_digest("fp_nowhere.module:SPEC")


def test_own_rooms_count_each_by_itself() -> None:
    orb = "dynslam_bench.features.orb:OrbExtractor"
    assert code_digest(orb, ("core", "features")) == code_digest(orb, ("core", "features"))
    assert code_digest(orb, ("core", "features")) != code_digest(orb, ("core", "segmentation"))


class Inner(Settings):
    source: str = "auto"
    options: dict[str, object] = {}  # noqa: RUF012


class Whole(Settings):
    extractor: str = names("orb", "features", meaning="an id")
    vocabulary: str = names("", "file", meaning="a file", otherwise="FP_TEST_VOCABULARY")
    word: str = "orb"
    weights: Path | None = None
    gain: float = tunable(1.0, low=0, high=2, meaning="a number")
    inner: Inner = Inner()


def test_only_what_names_a_file_counts_as_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "orb").mkdir()
    write(tmp_path / "auto", "a file called like a setting")
    assert named_digests(Whole()) == {}, "a folder called like a word changes nothing"
    net = write(tmp_path / "net.onnx", "one")
    write(tmp_path / "voc.txt", "words")
    settings = Whole(
        vocabulary="voc.txt",
        word=str(net),
        weights=Path("net.onnx"),
        inner=Inner(source="onnx:net.onnx", options={"network": {"file": str(net)}, "side": 3}),
    )
    found = named_digests(settings)
    assert set(found) == {"vocabulary", "word", "weights", "inner.source", "inner.options.network.file"}
    assert len(set(found.values())) == 2
    net.write_text("three")
    assert named_digests(settings)["inner.source"] != found["inner.source"]
    monkeypatch.setenv("FP_TEST_VOCABULARY", str(tmp_path / "voc.txt"))
    assert named_digests(Whole())["vocabulary"] == found["vocabulary"], "named by the environment"


@pytest.mark.parametrize("name", fingerprint.OPENCV)
def test_every_distribution_of_opencv_is_versioned(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def only(version: str):
        monkeypatch.setattr(fingerprint, "distribution_version", lambda asked: version if asked == name else "")
        for cached in (opencv_version, machine_digest):
            cached.cache_clear()
        return opencv_version(), machine_digest()

    try:
        (first, machine), (second, other) = only("4.10.0"), only("4.11.0")
        assert first == f"{name} 4.10.0" and second == f"{name} 4.11.0" and machine != other
        monkeypatch.setattr(fingerprint, "distribution_version", lambda asked: "")
        opencv_version.cache_clear()
        assert opencv_version().startswith("cv2 "), "a build of one's own tells its version itself"
    finally:
        for cached in (opencv_version, machine_digest):
            cached.cache_clear()


def test_a_link_to_a_folder_above_it_is_not_followed(tmp_path):
    from dynslam_bench.core.code_files import files_below

    inner = tmp_path / "inner"
    inner.mkdir()
    (inner / "code.py").touch()
    (inner / "up").symlink_to(tmp_path)
    assert list(files_below(tmp_path)) == [inner / "code.py"]


# Where data, stages, weights and vocabularies lie, and the version of the package.


FOLDERS = {
    "data": folders.find_data_root,
    "stages": folders.stage_cache_folder,
    "weights": folders.weights_folder,
    "vocabularies": folders.vocabularies_folder,
}
VARIABLES = {"data": folders.DATA_VARIABLE, "stages": folders.STAGES_VARIABLE, "weights": folders.WEIGHTS_VARIABLE}


@pytest.fixture
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


@pytest.fixture
def fresh_version(monkeypatch: pytest.MonkeyPatch):
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
@pytest.mark.usefixtures("fresh_version")
def test_the_release_of_a_version(installed: str, release: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(metadata, "version", lambda name: installed)
    assert (dynslam_bench.__version__, versions.release()) == (installed, release)


@pytest.mark.usefixtures("fresh_version")
def test_a_checkout_that_is_not_installed_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(name: str) -> str:
        raise metadata.PackageNotFoundError(name)

    monkeypatch.setattr(metadata, "version", missing)
    assert (dynslam_bench.__version__, versions.release()) == ("0+unknown", "0.0.0")
