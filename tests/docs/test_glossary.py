"""The product is written in the field's terms: these words of our own dialect appear in no identifier or text of it."""

from __future__ import annotations

import ast
import re

import pytest
from documented_names import ROOT, sources

WORDS = (
    "anew", "buried", "crew", "heir", "heirs", "island", "islands", "keeper", "lookalike", "nowhere",
    "somebody", "steered", "steering", "straightening", "surroundings", "twin", "twins", "unheard", "whoever",
    "yardstick",
)  # fmt: skip
"""In identifiers, messages, docstrings and comments."""
VARIABLES = ("each", "found", "known", "seen", "told")
"""As names of variables: they do not say what they hold."""


@pytest.mark.parametrize("word", WORDS)
def test_the_word_is_not_used(word: str) -> None:
    used = re.compile(rf"(?<![A-Za-z]){word}(?![a-z])", re.IGNORECASE)
    assert [str(file.relative_to(ROOT)) for file in sources() if used.search(file.read_text(encoding="utf-8"))] == []


@pytest.mark.parametrize("name", VARIABLES)
def test_variables_are_named_by_what_they_hold(name: str) -> None:
    places = [
        f"{file.relative_to(ROOT)}:{node.lineno}"
        for file in sources()
        for function in ast.walk(ast.parse(file.read_text(encoding="utf-8")))
        if isinstance(function, ast.FunctionDef)
        for node in ast.walk(function)
        if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store) and node.id == name
    ]
    assert places == []
