"""Pages are written in short sentences, say at their top what they are for, and stay short."""

import ast
import inspect
import re
import statistics
from pathlib import Path

import pytest
from helpers.documented_names import PAGES as WRITTEN
from helpers.documented_names import ROOT, read, sources

import results

LONGEST = 35
MEDIAN = 18
"""Words of a sentence."""
ALL_PAGES = 32_500
README = 700
CHANGELOG_LINES = 40
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
NOTES = ("lab", "decisions", "paper", "example")
"""Folders of `docs/` that are not written for users."""
BLOCKS = re.compile(r"^---\n.*?^---\n|^```.*?^```|<!--.*?-->", re.DOTALL | re.MULTILINE)
CELLS = re.compile(r"(?<!\\)\|")
PAGES = [page for page in WRITTEN if not set(page.relative_to(ROOT).parts[1:-1]) & set(NOTES)]
"""The pages that are written for users."""


def paragraphs(text: str) -> list[str]:
    """Paragraphs and list items in plain words; a name in backticks is one word."""
    text = BLOCKS.sub("\n", text)
    for pattern, plain in (
        (r"^(#|\||\*Made at |!\[|\[!\[).*$", ""),
        (r"^ *(?:[-*]|\d+\.) ", "\n"),
        (r"!?\[([^\]]*)\]\([^)]*\)", r"\1"),
        (r"`[^`]*`", "Name"),
    ):
        text = re.sub(pattern, plain, text, flags=re.MULTILINE)
    return [
        " ".join(part.replace("*", "").split())
        for part in re.split(r"\n\s*\n", text)
        if part.strip()
    ]


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
    return [
        [
            [cell.strip() for cell in CELLS.split(row.strip())[1:-1]]
            for row in block.splitlines()
            if "| --" not in row
        ]
        for block in re.findall(r"(?:^ *\|.*\n?)+", text, flags=re.MULTILINE)
    ]


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
        (word, better)
        for word, better in WORDS.items()
        if re.search(word, "\n".join(paragraphs(text)), re.I)
    ] == []


def test_a_page_begins_with_one_sentence_that_says_what_it_is_for(text: str) -> None:
    assert text.startswith("# ")
    assert len(sentences(text.partition("\n")[2].strip().partition("\n\n")[0] + "\n")) == 1


def test_all_pages_are_short() -> None:
    texts = {page: page.read_text(encoding="utf-8") for page in PAGES}
    counted = [
        paragraphs(text) if page.parent.name == "results" else [text]
        for page, text in texts.items()
    ]
    assert sum(len(part.split()) for parts in counted for part in parts) <= ALL_PAGES
    assert len((ROOT / "README.md").read_text(encoding="utf-8").split()) <= README
    changes = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    assert max(len(part.splitlines()) for part in changes.split("\n## ")[1:]) <= CHANGELOG_LINES


# The product is written in the field's terms: these words of our own dialect appear in no
# identifier or text of it.


OUR_WORDS = (
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


@pytest.mark.slow
def test_our_words_are_not_used() -> None:
    words = "|".join("[ _]?".join(word.split()) for word in OUR_WORDS)
    text = re.compile(rf"(?<![A-Za-z])(?:{words})(?![a-z])", re.IGNORECASE)
    assert text.search("of_piece_index") is not None
    used = [
        (str(file.relative_to(ROOT)), text.findall(file.read_text(encoding="utf-8")))
        for file in sources()
    ]
    assert [(file, found) for file, found in used if found] == []


@pytest.mark.slow
def test_variables_are_named_by_what_they_hold() -> None:
    places = [
        f"{file.relative_to(ROOT)}:{node.lineno}"
        for file in sources()
        for function in ast.walk(ast.parse(file.read_text(encoding="utf-8")))
        if isinstance(function, ast.FunctionDef)
        for node in ast.walk(function)
        if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store) and node.id in VARIABLES
    ]
    assert places == []


# A docstring, and each entry of its sections, begins with the thing itself: a reader who looks up one
# entry has not read those before it.


REFERS_BACK = re.compile(
    r"(?:Of|Likewise|Ditto|Same|Those|That of|The same|The others?|As (?:in|for)|As `)(?=\W)"
)
"""How texts begin that leave out their noun."""
SECTION = re.compile(r"(?:Args|Attributes|Raises|Returns|Yields):")
ENTRY = re.compile(r"[*\w.]+: (.*)")


def refers_back(docstring: str) -> list[str]:
    """The summary line and the entries of a docstring that begin without their noun."""
    summary, *lines = inspect.cleandoc(docstring).splitlines()
    texts = [summary]
    is_in_section = False
    for line in lines:
        if line and not line.startswith(" "):
            is_in_section = SECTION.fullmatch(line) is not None
        # an entry is indented once, its further lines twice
        elif is_in_section and line and not line.startswith(" " * 5):
            entry = ENTRY.fullmatch(line.strip())
            texts.append(line.strip() if entry is None else entry[1])
    return [text for text in texts if REFERS_BACK.match(text)]


@pytest.mark.parametrize(
    ("docstring", "found"),
    [
        ("Of the window.", ["Of the window."]),
        ("Radius.\n\nArgs:\n    radius: Of the window.\n", ["Of the window."]),
        ("Radius.\n\nReturns:\n    The same in metres.\n", ["The same in metres."]),
        ("Radius.\n\nOf two windows\nthe larger one.\n\nArgs:\n    radius: Office.\n", []),
    ],
)
def test_a_text_without_its_noun_is_found(docstring: str, found: list[str]) -> None:
    assert refers_back(docstring) == found


@pytest.mark.slow
def test_docstrings_begin_with_their_noun() -> None:
    assert [
        f"{file.relative_to(ROOT)}:{line}: {text}"
        for file in [*sources(), *sorted((ROOT / "tests").rglob("*.py"))]
        for line, docstring in read(file)[0]
        for text in refers_back(docstring)
    ] == []


QUESTIONS = ("What", "Which")
"""Words with which a summary line would ask in place of naming what there is."""


@pytest.mark.slow
def test_summary_lines_begin_with_a_noun_or_a_verb() -> None:
    summaries = [
        (f"{file.relative_to(ROOT)}:{line}", inspect.cleandoc(docstring).partition("\n")[0])
        for file in sources()
        for line, docstring in read(file)[0]
    ]
    assert len(summaries) > 1000
    assert [
        (where, summary) for where, summary in summaries if summary.split()[0] in QUESTIONS
    ] == []


# Measured tables lie in `docs/results/`, each with its command, commit, date, machine and data.


RESULTS = sorted(
    {*(ROOT / "docs" / "results").glob("*.md")} - {ROOT / "docs" / "results" / "README.md"}
)

SIGN = r"[\d.,±+~<>/()\[\];:\s-]"
UNIT = r"(?<![A-Za-z])(?:mm|cm|m|ms|s|%|MB|px|fps)(?![A-Za-z])"
NUMBERS = re.compile(rf"(?:{SIGN}|{UNIT}|\bto\b|\bx\b)*")
FIGURE = re.compile(rf"\d\.\d|\d ?{UNIT}|±")


def is_figure(cell: str) -> bool:
    """Whether a cell is a number with a fraction or a unit, or several, and nothing else."""
    plain = cell.replace("*", "")
    return NUMBERS.fullmatch(plain) is not None and FIGURE.search(plain) is not None


def measured(text: str) -> list[str]:
    """The headers of a page's tables in which two cells or more are figures."""
    return [
        " | ".join(table[0])
        for table in tables(text)
        if sum(is_figure(cell) for row in table[1:] for cell in row) >= 2
    ]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_a_page_outside_of_results_holds_no_measured_table(page: Path) -> None:
    if page not in RESULTS:
        assert measured(page.read_text(encoding="utf-8")) == [], "move it: docs/results/README.md"


@pytest.mark.parametrize("page", RESULTS, ids=lambda page: page.stem)
def test_every_table_says_how_it_was_made(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    sections = results.sections(text)
    assert sections, "a table above the first section"
    assert measured(text.partition("\n## ")[0]) == [], "a table above the first section"
    for title, section in sections.items():
        block = results.COMMANDS.search(section)
        made = results.MADE.search(section)
        assert block is not None, title
        assert made is not None, title
        assert section.index(block[0]) < section.index(made[0]), title
        assert re.search(r"^(?:\||```text)", section[section.index(made[0]) :], re.MULTILINE), title
        scripts = re.findall(r"tests/benchmarks/\w+\.py", block[1])
        assert [script for script in scripts if not (ROOT / script).exists()] == [], title


@pytest.mark.slow
def test_a_section_is_made_of_what_its_command_prints(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    section = (
        "## Sums\n\nA sum.\n\n```bash\nprintf '| a |\\n| --- |\\n| %s |\\n' $((2 + 3))\n```\n\n"
    )
    made = results.remade(section, "none")
    assert made.startswith(section)
    assert made.endswith("data: none.*\n\n| a |\n| --- |\n| 5 |\n\n")
    again = results.remade(made.replace("| 5 |", "| 7 |\n\nRemarks on 7."))
    assert again == made
    assert results.sections("# T\n\nx\n\n" + made) == {"Sums": made}
    with pytest.raises(SystemExit, match="--data"):
        results.remade(section)
