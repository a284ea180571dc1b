"""Pages are written in short sentences, say at their top what they are for, and stay short."""

from __future__ import annotations

import re
import statistics
from pathlib import Path

import pytest
from prose import ROOT, paragraphs, sentences, user_pages, words

LONGEST, MEDIAN = 35, 18
"""Words of a sentence."""
ALL_PAGES, README, CHANGELOG_LINES = 25_000, 700, 40
"""Words of all pages for users (of results the prose alone) and of the README; lines of a version's changes."""
WORDS = {
    r"\bheir\b": "replacement",
    r"\bislands?\b": "submap",
    r"\blookalikes?\b": "perceptual aliasing",
    r"\byardstick\b": "reference system",
    r"\btwins?\b": "replica",
    r"\bwhoever asks\b": "caller, user",
    r"\bone's own\b": "your",
    r"\bof somebody else's\b": "of another user",
    r"\bstraightened\b": "rolling-shutter compensation",
    r"\bsteer(?:s|ed|ing)?\b": "change online settings",
}
"""Words of no reader's field, and what to write in their place."""
PAGES = user_pages()


@pytest.fixture(params=PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def text(request: pytest.FixtureRequest) -> str:
    page: Path = request.param
    return page.read_text(encoding="utf-8")


def test_sentences_are_short(text: str) -> None:
    lengths = {sentence: len(words(sentence)) for sentence in sentences(text)}
    assert [sentence for sentence, length in lengths.items() if length > LONGEST] == []
    assert statistics.median(lengths.values()) <= MEDIAN


def test_words_are_the_field_s(text: str) -> None:
    assert [
        (word, better) for word, better in WORDS.items() if re.search(word, "\n".join(paragraphs(text)), re.I)
    ] == []


def test_a_page_begins_with_one_sentence_that_says_what_it_is_for(text: str) -> None:
    assert text.startswith("# ")
    assert len(sentences(text.partition("\n")[2].strip().partition("\n\n")[0] + "\n")) == 1


def test_all_pages_are_short() -> None:
    total = 0
    for page in user_pages():
        text = page.read_text(encoding="utf-8")
        total += sum(len(part.split()) for part in (paragraphs(text) if page.parent.name == "results" else [text]))
    assert total <= ALL_PAGES
    assert len((ROOT / "README.md").read_text(encoding="utf-8").split()) <= README
    changes = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    assert max(len(part.splitlines()) for part in changes.split("\n## ")[1:]) <= CHANGELOG_LINES
