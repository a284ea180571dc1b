"""Hooks of MkDocs for the site: pages that the repository holds elsewhere, or that the code itself is."""

from __future__ import annotations

import atexit
import re
import shutil
import sys
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT), str(Path(__file__).parent)]

from generated import docstring_pages  # noqa: E402
from mkdocs.plugins import event_priority  # noqa: E402
from mkdocs.structure.files import File  # noqa: E402

from dynslam_bench.core.toml import read_toml  # noqa: E402

if TYPE_CHECKING:
    from mkdocs.config.defaults import MkDocsConfig
    from mkdocs.structure.files import Files
    from mkdocs.structure.pages import Page

ELSEWHERE = {
    "index.md": "README.md",
    "project/contributing.md": "CONTRIBUTING.md",
    "project/changelog.md": "CHANGELOG.md",
    "project/security.md": "SECURITY.md",
}
"""Pages of the site that are files of the repository's top level."""
SHIM = "https://unpkg.com/iframe-worker/shim"
LINK = re.compile(r"(?<=\]\()(?![a-z]+:|#)([^)#\s]+)")
NAMED = re.compile(r"(?<![\[`])`(?P<name>(?:docs/)?[\w/-]+\.md)`(?!\])")


@event_priority(100)  # before mkdocstrings reads where to look
def on_config(config: MkDocsConfig) -> None:
    """Show the reader of docstrings the package as it is installed: `envs/` and its like lie inside of it."""
    staged = Path(tempfile.mkdtemp(prefix="dynslam-docs-"))
    atexit.register(shutil.rmtree, staged, ignore_errors=True)
    folders = read_toml(ROOT / "pyproject.toml")["tool"]["setuptools"]["package-dir"]
    for name, folder in sorted(folders.items()):
        _stage(ROOT / folder, staged / name.replace(".", "/"))
    config.plugins["mkdocstrings"].config.handlers["python"]["paths"] = [str(staged)]


def _stage(source: Path, target: Path) -> None:
    """Copy a package's Python files, with `Example:` in docstrings as the reader of docstrings calls that section."""
    for file in source.rglob("*.py"):
        copy = target / file.relative_to(source)
        copy.parent.mkdir(parents=True, exist_ok=True)
        copy.write_text(
            re.sub(r"^( *)Example:$", r"\1Examples:", file.read_text(encoding="utf-8"), flags=re.M)
        )


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages of the top level, those of docstrings, and what pages link to outside of `docs/`."""
    for page, source in ELSEWHERE.items():
        files.append(
            File.generated(config, page, content=(ROOT / source).read_text(encoding="utf-8"))
        )
    for page, text in docstring_pages().items():
        files.append(File.generated(config, page, content=text))
    for source in sorted({path for file in files.documentation_pages() for path in _outside(file)}):
        files.append(
            File.generated(config, f"files/{source.as_posix()}", abs_src_path=str(ROOT / source))
        )
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Lead links to where their targets lie on the site, and pages that are named in backticks to the pages."""
    here = page.file.src_uri

    def lead(found: re.Match[str]) -> str:
        return _relative(_on_site(_target(here, found.group(1)), found.group(1)), here)

    def link(found: re.Match[str]) -> str:
        named = found["name"].removeprefix("docs/")
        named = next(
            (page for page, source in ELSEWHERE.items() if source == named and page != "index.md"),
            named,
        )
        if named == here or files.get_file_from_path(named) is None:
            return found.group()
        return f"[{found.group()}]({_relative(named, here)})"

    return _outside_of_fences(NAMED, link, _outside_of_fences(LINK, lead, markdown))


def on_post_page(output: str, page: Page, config: MkDocsConfig) -> str:
    """The search works from a folder by a script of our own; the theme would fetch one."""
    return output.replace(SHIM, _relative("site/worker.js", page.file.src_uri))


def on_post_template(output_content: str, template_name: str, config: MkDocsConfig) -> str:
    """The page that servers show for missing ones searches by our own script, too."""
    return output_content.replace(SHIM, "/site/worker.js")


def _outside_of_fences(pattern: re.Pattern[str], change, text: str) -> str:
    parts = re.split(r"(^```.*?^```$)", text, flags=re.S | re.M)
    return "".join(part if part.startswith("```") else pattern.sub(change, part) for part in parts)


def _target(page: str, link: str) -> Path | None:
    """Target of a page's link as a path from the repository's root; None outside of it."""
    folder = Path(ELSEWHERE[page]).parent if page in ELSEWHERE else Path("docs") / Path(page).parent
    path = (ROOT / folder / link).resolve()
    return path.relative_to(ROOT) if path.is_relative_to(ROOT) else None


def _outside(file: File) -> list[Path]:
    """Files, no pages, that a page links to and that do not lie in `docs/`."""
    targets = [_target(file.src_uri, link) for link in LINK.findall(file.content_string)]
    held = set(ELSEWHERE.values())
    return [
        t
        for t in targets
        if t and (ROOT / t).is_file() and t.parts[0] != "docs" and t.as_posix() not in held
    ]


def _on_site(target: Path | None, link: str) -> str:
    """Where a file of the repository is on the site, from its top; the link as it stands where it is nowhere."""
    # on the site its HTML, on GitHub its README
    if target is not None and target.parts[:2] == ("docs", "example"):
        target = target.with_name(target.name.replace("README.md", "index.html"))
    if target is None or not (ROOT / target).is_file():
        return (
            link
            if target is None or target.parts[:1] != ("docs",)
            else target.relative_to("docs").as_posix()
        )
    name = target.as_posix()
    page = next((page for page, source in ELSEWHERE.items() if source == name), None)
    return page or (name.removeprefix("docs/") if target.parts[0] == "docs" else f"files/{name}")


def _relative(target: str, page: str) -> str:
    return Path(*[".."] * (len(Path(page).parts) - 1), target).as_posix()
