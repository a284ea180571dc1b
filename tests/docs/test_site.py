"""The documentation site: built strictly, complete, and nothing in it is fetched from elsewhere."""

import re
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import urlsplit

import pytest
from helpers.documented_names import ROOT

pytest.importorskip("mkdocstrings", reason="the extra [docs] is not installed")

pytestmark = pytest.mark.slow
LOADING = {"script": "src", "img": "src", "link": "href", "iframe": "src", "source": "src"}


class Page(HTMLParser):
    """What a page loads, and its anchors."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.loads, self.anchors = list[str](), set[str]()
        self.feed(text)

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        given = {name: value or "" for name, value in attributes}
        self.anchors |= {given[name] for name in ("id", "name") if name in given}
        if LOADING.get(tag) in given and given.get("rel") != "canonical":
            self.loads.append(given[LOADING[tag]])


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("site")
    built = subprocess.run(
        [
            sys.executable,
            "-m",
            "mkdocs",
            "build",
            "--strict",
            "-f",
            ROOT / "mkdocs.yml",
            "-d",
            folder,
        ],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=600,
    )
    assert built.returncode == 0, built.stderr[-4000:]
    return folder


@pytest.fixture(scope="module")
def pages(site: Path) -> dict[Path, Page]:
    written = [
        path for path in site.rglob("*.html") if "example" not in path.relative_to(site).parts
    ]
    assert len(written) > 40
    return {
        path: Page(path.read_text(encoding="utf-8")) for path in written if path.name != "404.html"
    }


def test_nothing_is_loaded_from_elsewhere(site: Path, pages: dict[Path, Page]) -> None:
    loaded = [(path, load) for path, page in pages.items() for load in page.loads]
    assert len(loaded) > 100
    assert [(path.name, load) for path, load in loaded if urlsplit(load).netloc] == []
    assert [
        load
        for path, load in loaded
        if not load.startswith("data:") and not (path.parent / load).exists()
    ] == []
    assert [path.name for path in site.glob("*.html") if "unpkg.com" in path.read_text()] == []
    assert not re.search(r"url\(\s*['\"]?https?:", (site / "site" / "style.css").read_text())


def test_every_door_setting_command_and_tracker_is_on_a_page(
    site: Path, pages: dict[Path, Page]
) -> None:
    from dynslam_bench import contracts
    from dynslam_bench.core.settings import flatten
    from dynslam_bench.trackers import TRACKERS

    contracts_page = pages[site / "reference" / "python" / "contracts.html"].anchors
    assert [
        name
        for name in contracts.__all__
        if f"dynslam_bench.contracts.{name}" not in contracts_page
    ] == []
    specs = [found.spec for found in TRACKERS.all()]
    assert [
        s.id
        for s in specs
        if re.sub("[?=&]", "-", s.id) not in pages[site / "reference" / "systems.html"].anchors
    ] == []
    settings = (site / "reference" / "settings.html").read_text()
    leaves = {
        name.partition(".")[2] for spec in specs for name in flatten(spec.settings()) if "." in name
    }
    assert len(leaves) > 100
    assert [name for name in leaves if f"<code>{name}</code>" not in settings] == []
    commands = pages[site / "reference" / "commands.html"].anchors
    assert {"dynslam-bench-demo", "dynslam-bench-tune-run", "dynslam-bench-report"} <= commands
