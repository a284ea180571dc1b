"""Digests of code, weights, machine and content: what changes them, and what must not."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from dynslam_bench.core import fingerprint
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
