"""The sentences and tables of a page, without code, headings and markup.

python tests/docs/prose.py      # words, median and longest sentence of every page
"""

import re
import statistics
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


def main() -> None:
    """Print every page's figures, and those of all."""
    everything: list[int] = []
    total = 0
    for page in user_pages():
        text = page.read_text(encoding="utf-8")
        lengths = [len(words(sentence)) for sentence in sentences(text)]
        everything += lengths
        total += len(text.split())
        middle = statistics.median(lengths) if lengths else 0
        longest = max(lengths, default=0)
        print(f"{len(text.split()):6} words, median {middle:4}, longest {longest:3}  {page.relative_to(ROOT)}")
    print(f"{total:6} words, median {statistics.median(everything)}, longest {max(everything)}")


if __name__ == "__main__":
    main()
