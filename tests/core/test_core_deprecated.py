"""Deprecations: the warning names the version of removal, the caller's line, and is not forgotten when it is due."""

import re
from pathlib import Path

import pytest

from dynslam_bench.core import deprecated
from dynslam_bench.core.deprecated import warn_deprecated
from dynslam_bench.core.version import UNKNOWN, release, version

PACKAGE = Path(deprecated.__file__).resolve().parents[2]


def test_the_warning_says_what_until_when_and_what_instead() -> None:
    def old() -> None:
        warn_deprecated("'old' is called 'new'", "call 'new'", gone_in="9.1")

    with pytest.warns(
        DeprecationWarning, match=r"^'old' is called 'new' and will be gone in 9\.1; call 'new'$"
    ) as seen:
        old()
    assert seen[0].filename == __file__


def test_nothing_stays_longer_than_it_was_promised_to() -> None:
    """Once a release has come, what was to be gone in it has to be gone."""
    files = [file for room in ("dynslam_bench", "envs", "tuning", "reports") for file in (PACKAGE / room).rglob("*.py")]
    promised = re.compile(r"(?:gone_in=|GONE_IN = )\"(\d+)\.(\d+)\"")
    found = {file.name: (int(a), int(b)) for file in files for a, b in promised.findall(file.read_text())}
    assert found.get("moved.py") == (0, 2)
    now = tuple(int(number) for number in release().split(".")[:2])
    assert version() == UNKNOWN or [name for name, gone in found.items() if gone <= now] == []


def test_no_other_way_to_deprecate_is_used() -> None:
    files = [file for room in ("dynslam_bench", "envs", "tuning", "reports") for file in (PACKAGE / room).rglob("*.py")]
    assert [file.name for file in files if "DeprecationWarning" in file.read_text()] == ["deprecated.py"]
