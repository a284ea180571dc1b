"""A short round against every reader; `python -m tests.fuzz --minutes 60` is the long one."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from .campaign import attack
from .readers import TARGETS
from .target import Target

INPUTS = 60


@pytest.mark.parametrize("target", TARGETS, ids=lambda target: target.name)
def test_damaged_files_end_in_documented_errors(target: Target) -> None:
    result = attack(target, inputs=INPUTS)
    assert result.inputs == INPUTS and result.coverage.share > 0.5
    assert [finding.what for finding in result.findings] == []


def test_a_reader_that_lets_errors_out_is_found_out() -> None:
    """The round itself: a raw error, a hang of memory and a long message do not pass."""

    def read(data: bytes | None, folder: Path) -> None:
        json.loads(data or b"{}")

    result = attack(Target("bare", read, lambda: [b'{"a": [1, 2]}'], (read,)), inputs=60)
    assert {finding.what.split()[0] for finding in result.findings} >= {"JSONDecodeError", "RecursionError"}
    assert result.coverage.share == 1.0


def test_the_recorded_campaign_is_of_these_readers() -> None:
    figures = json.loads((Path(__file__).parent / "figures.json").read_text())
    assert {row["reader"] for row in figures["readers"]} == {target.name for target in TARGETS}
    assert figures["inputs"] == sum(row["inputs"] for row in figures["readers"]) >= 1_000_000
    assert min(row["coverage"] for row in figures["readers"]) >= 0.9
