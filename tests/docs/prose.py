"""The sentences and tables of a page, without code, headings and markup."""

import re
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
NOTES = ("lab", "decisions", "paper", "example")
"""Folders of `docs/` that are not written for users."""
BLOCKS = re.compile(r"^---\n.*?^---\n|^```.*?^```|<!--.*?-->", re.DOTALL | re.MULTILINE)
CELLS = re.compile(r"(?<!\\)\|")


def user_pages() -> list[Path]:
    """The pages that are written for users, top level and `docs/`; not those made of the code."""
    pages = [*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")]
    written = [page for page in pages if not page.read_text(encoding="utf-8").startswith("<!-- Made by ")]
    return sorted(page for page in written if not set(page.relative_to(ROOT).parts[1:-1]) & set(NOTES))


def paragraphs(text: str) -> list[str]:
    """Paragraphs and list items in plain words; a name in backticks is one word."""
    text = BLOCKS.sub("\n", text)
    text = re.sub(r"^(#|\||\*Made at |!\[|\[!\[).*$", "", text, flags=re.MULTILINE)
    text = re.sub(r"^ *(?:[-*]|\d+\.) ", "\n", text, flags=re.MULTILINE)
    text = re.sub(r"!?\[([^\]]*)\]\([^)]*\)", r"\1", text)
    text = re.sub(r"`[^`]*`", "Name", text)
    return [" ".join(part.replace("*", "").split()) for part in re.split(r"\n\s*\n", text) if part.strip()]


def sentences(text: str) -> list[str]:
    """A page's sentences."""
    return [
        sentence
        for paragraph in paragraphs(text)
        for sentence in re.split(r"(?<=[.!?])\)? +(?=[A-Z0-9(\"])", paragraph)
        if len(words(sentence)) > 1
    ]


def words(sentence: str) -> list[str]:
    """A sentence's words."""
    return [word for word in sentence.split() if re.search(r"\w", word)]


def tables(text: str) -> list[list[list[str]]]:
    """A page's tables as rows of cells, each with its header first and without the rule below it."""
    text = BLOCKS.sub("\n", text)
    blocks = re.findall(r"(?:^ *\|.*\n?)+", text, flags=re.MULTILINE)
    return [
        [[cell.strip() for cell in CELLS.split(row.strip())[1:-1]] for row in block.splitlines() if "| --" not in row]
        for block in blocks
    ]
