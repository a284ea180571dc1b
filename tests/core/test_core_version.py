"""The version: that of the installed distribution; what identifies runs does not change with every commit."""

from importlib import metadata

import pytest

import dynslam_bench
from dynslam_bench.core import version as versions


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


def test_other_names_of_the_package_are_missing_as_ever() -> None:
    with pytest.raises(AttributeError, match="has no attribute 'nonsense'"):
        dynslam_bench.nonsense  # noqa: B018
