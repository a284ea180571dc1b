"""A short round against every reader; `python -m tests.fuzz --minutes 60` is the long one."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from . import binaries, exchange, layouts, records, texts
from .campaign import Target, attack

TARGETS = [*records.TARGETS, *texts.TARGETS, *binaries.TARGETS, *layouts.TARGETS, *exchange.TARGETS]
INPUTS = 60


@pytest.mark.parametrize("target", TARGETS, ids=lambda target: target.name)
def test_damaged_files_end_in_documented_errors(target: Target) -> None:
    result = attack(target, inputs=INPUTS)
    assert result.inputs == INPUTS and result.findings == {}


def test_a_reader_that_lets_errors_out_is_found_out() -> None:
    """The round itself: a raw error and a long message do not pass."""

    def read(data: bytes | None, folder: Path) -> None:
        json.loads(data or b"{}")

    result = attack(Target("bare", read, lambda: [b'{"a": [1, 2]}']), inputs=60)
    assert {finding.split()[0] for finding in result.findings} >= {"JSONDecodeError", "RecursionError"}
