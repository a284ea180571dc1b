"""The report in a real browser: nothing is fetched, nothing faults, everything fits and can be read."""

import sys
from pathlib import Path

import pytest
from reports_browser import Browser, needs_browser
from reports_fake_store import add_frames, add_run, fill
from reports_rows import page_data

from dynslam_bench.envs.arguments import open_frames
from dynslam_bench.reports import build_report
from dynslam_bench.sequences.view import part_of

sys.path.append(str(Path(__file__).parents[1] / "envs"))
from envs_toys import write_folder

pytestmark = needs_browser
WIDTHS = (1400, 768, 360)


@pytest.fixture(scope="module")
def report(tmp_path_factory):
    """A report with failures, an import, names that are markup, and runs whose frames are known."""
    root = tmp_path_factory.mktemp("browser")
    store = fill(root / "results", seeds=(0, 1))
    place = write_folder(root / "toy", 40)
    held = part_of(open_frames(str(place), None, None, (0, None), 1), 0).content
    for name, label in (("ours", "Ours <b>&amp;</b> 'quoted' \N{SNOWMAN}"), ("orb-slam2", "ORB-SLAM2 (our back end)")):
        settings = {"features.options": "one long word after the other " * 40, "features.levels": 8}
        run_id = add_run(
            store, name, "toy", n=40, label=label, place=str(place), content=held, lost=(20,), tags=("static",),
            final_error=0.004, settings=settings,
        )  # fmt: skip
        add_frames(store.folder(run_id), 40)
    add_run(store, "elsewhere", "synthetic/walking_xyz", kind="imported", label="Elsewhere", frame_s=None)
    return build_report(store, root / "report")


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    page = Browser(tmp_path_factory.mktemp("profile"))
    yield page
    page.close()


def run_of(report, label, sequence):
    explore = page_data(report.html.parent, "explore")
    tracker = next(at for at, each in enumerate(explore["trackers"]) if each["label"].startswith(label))
    column = next(at for at, each in enumerate(explore["sequences"]) if each["name"].startswith(sequence))
    return next(run[0] for run in explore["runs"] if run[1:3] == [tracker, column])


def see_everything(browser):
    browser.run("all('main details:not(.toolbar details)').forEach((fold) => { fold.open = true; })")
    browser.run("all('.figure').forEach(draw)")
    browser.settle()


PAGES = ("report", "run")


def open_page(browser, report, page, width):
    if page == "report":
        browser.open(report.html, width)
        browser.until("one('#explore-table tbody tr')")
    else:
        browser.open(report.run, width, anchor="#" + run_of(report, "Ours", "toy"))
        browser.until("one('.thumb canvas')")
    see_everything(browser)


@pytest.mark.parametrize("page", PAGES)
def test_nothing_faults_nothing_is_fetched_and_nothing_runs_over(browser, report, page):
    for width in WIDTHS:
        open_page(browser, report, page, width)
        assert browser.faults == []
        folder = report.html.parent.absolute().as_uri()
        assert browser.fetched and all(url.startswith((folder, "data:")) for url in browser.fetched)
        assert browser.run("document.documentElement.scrollWidth") == width
        figures = browser.run("[...all('.chart svg')].map((each) => each.getBoundingClientRect().right)")
        assert len(figures) >= 4 and max(figures) <= width


CONTRAST = (Path(__file__).parent / "contrast.js").read_text().partition("\n")[2]


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_everything_that_is_written_can_be_read(browser, report, scheme):
    browser.prefer(scheme)
    for page in PAGES:
        open_page(browser, report, page, 1400)
        seen, bad = browser.run(CONTRAST.replace("DARK", "true" if scheme == "dark" else "false"))
        assert seen > 100 and bad == []


def test_the_theme_can_be_chosen_and_stays(browser, report):
    browser.prefer("light")
    browser.open(report.html)
    ground = "getComputedStyle(document.body).backgroundColor"
    light = browser.run(ground)
    for label in ("Light", "Dark"):
        browser.run("one('.theme').click()")
        assert label in browser.run("one('.theme').textContent")
    dark = browser.run(ground)
    assert dark != light
    browser.open(report.run)
    assert browser.run(ground) == dark
    browser.run("one('.theme').click()")
    assert browser.run(ground) == light


def test_tables_sort_with_what_is_missing_last(browser, report):
    browser.open(report.html)
    ratios = "[...all('#leaderboard tbody tr')].map((row) => row.cells[3].dataset.v ?? null)"
    before = browser.run(ratios)
    for up in (True, False):
        browser.run("all('#leaderboard thead tr:last-child button')[3].click()")
        found = browser.run(ratios)
        numbers = [float(value) for value in found if value is not None]
        assert numbers == sorted(numbers, reverse=not up) and len(numbers) >= 6
        assert sorted(map(str, found)) == sorted(map(str, before)) and None not in found[: len(numbers)]
