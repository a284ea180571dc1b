"""A short round against every reader; ``FUZZ_INPUTS=20000 FUZZ_SEED=1`` in the environment make a long one."""

import json
import os
from pathlib import Path

import pytest

from .campaign import Target, attack
from .targets import TARGETS

INPUTS, SEED = int(os.environ.get("FUZZ_INPUTS", "60")), int(os.environ.get("FUZZ_SEED", "0"))


@pytest.mark.parametrize("target", TARGETS, ids=lambda target: target.name)
def test_damaged_files_end_in_documented_errors(target: Target) -> None:
    assert attack(target, INPUTS, SEED) == {}


def test_a_reader_that_lets_errors_out_is_found_out() -> None:
    """The round itself: a raw error and a long message do not pass."""

    def read(data: bytes | None, folder: Path) -> None:
        json.loads(data or b"{}")

    findings = attack(Target("bare", read, lambda: [b'{"a": [1, 2]}']), 60)
    assert {finding.split()[0] for finding in findings} >= {"JSONDecodeError", "RecursionError"}
