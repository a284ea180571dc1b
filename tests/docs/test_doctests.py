"""The examples in docstrings are true."""

import doctest
import importlib
from pathlib import Path

import pytest
from documented_names import ROOT, sources


def module_of(file: Path) -> str:
    parts = file.relative_to(ROOT).with_suffix("").parts
    inside = parts if parts[0] == "dynslam_bench" else ("dynslam_bench", *parts)
    return ".".join(inside).removesuffix(".__init__")


WITH_EXAMPLES = [module_of(file) for file in sources() if ">>> " in file.read_text(encoding="utf-8")]


@pytest.mark.parametrize("name", WITH_EXAMPLES)
def test_examples_give_what_they_say(name: str) -> None:
    outcome = doctest.testmod(importlib.import_module(name), optionflags=doctest.ELLIPSIS)
    assert outcome.attempted > 0 and outcome.failed == 0
