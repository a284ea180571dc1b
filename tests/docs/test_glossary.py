"""The product is written in the field's terms: these words of our own dialect appear in no identifier or text of it."""

from __future__ import annotations

import ast
import re

import pytest
from documented_names import ROOT, sources

WORDS = (
    "anew", "as seen at once", "at home", "black frames", "buried", "crew", "extract beside", "firm",
 "heir", "heirs", "imprecision", "island", "islands", "joined by its beginning", "keeper",
    "likeness", "lookalike", "map of its own", "may be at", "most alike", "nowhere", "old form",
    "piece index", "planted", "put elsewhere", "seen through", "sight", "somebody", "steered", "steering", "straighten",
    "straightened", "straightening", "surroundings", "taker", "takers", "told as", "twin", "twins", "unheard",
    "what holds", "whoever", "yardstick",
)  # fmt: skip
"""In identifiers, messages, docstrings and comments."""
VARIABLES = ("each", "found", "known", "nowhere", "seen", "told")
"""As names of variables: they do not say what they hold."""


def used(word: str) -> list[str]:
    """The files with a word, in prose or in an identifier."""
    text = re.compile(rf"(?<![A-Za-z]){'[ _]?'.join(word.split())}(?![a-z])", re.IGNORECASE)
    return [str(file.relative_to(ROOT)) for file in sources() if text.search(file.read_text(encoding="utf-8"))]


@pytest.mark.parametrize("word", WORDS)
def test_the_word_is_not_used(word: str) -> None:
    assert used(word) == []


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
