"""The gate in pytest: a test that takes the fixture `dynslam_gate` fails unless the gate passes.

    def test_gate(dynslam_gate):
        assert dynslam_gate.verdict != "undecided"

The entry point ``pytest11`` makes pytest load this module, so it imports nothing heavy before the
fixture is used.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from dynslam_bench.core import DynslamError

if TYPE_CHECKING:
    from dynslam_bench.gate import GateResult


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the options of the gate."""
    group = parser.getgroup("dynslam-bench", "checks of dynslam-bench")
    group.addoption(
        "--dynslam-gate",
        metavar="FILE",
        default="gate.toml",
        help="the question of the fixture dynslam_gate, below pytest's root folder",
    )


@pytest.fixture(scope="session")
def dynslam_gate(pytestconfig: pytest.Config) -> GateResult:
    """Result of the gate in the working tree, beside its baseline file; whatever does not pass fails here."""
    from dynslam_bench import gate

    path = pytestconfig.rootpath / pytestconfig.getoption("--dynslam-gate")
    try:
        result = gate.check(path, results=Path(pytestconfig.rootpath) / "results" / "gate")
    except DynslamError as error:
        pytest.fail(f"the gate cannot be judged: {error}", pytrace=False)
    if not result.passed:
        pytest.fail(result.markdown(), pytrace=False)
    return result
