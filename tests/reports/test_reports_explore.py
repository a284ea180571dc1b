"""The exploring table and the pages of runs in a browser: filters, switches, the view in the address, the slider."""

import pandas as pd
import pytest
from reports_browser import needs_browser
from reports_fake_store import add_run, fill
from test_reports_browser import browser, open_page, report, run_of

from dynslam_bench.reports import build_report

__all__ = ["browser", "report"]  # fixtures

pytestmark = needs_browser
ROWS = "all('#explore-table tbody tr').map((row) => row.cells[0].textContent)"
HEADS = "all('#explore-table thead th').map((head) => head.textContent)"


def explore(browser, report, anchor=""):
    browser.open(report.html, anchor=anchor)
    browser.until("one('#explore-table tbody tr')")


@pytest.fixture
def explored(browser, report):
    """The browser at the exploring table."""
    explore(browser, report)
    return browser


def press(browser, place, text):
    browser.run(f"all('#{place} button').find((each) => each.textContent === '{text}').click()")


def test_search_tags_and_ranked_only(explored):
    everybody, columns = explored.run(ROWS), explored.run(HEADS)
    assert len(everybody) == 7 and len(columns) == 3 + 5
    explored.run("$('explore-search').value = 'dyna'; $('explore-search').dispatchEvent(new Event('input'))")
    assert explored.run(ROWS) == ["DynaSLAM N+G (our back end)"]
    assert "q=dyna" in explored.run("location.hash")
    explored.run("$('explore-reset').click()")
    explored.run("$('explore-ranked').click()")
    ranked = explored.run(ROWS)
    assert 2 <= len(ranked) < 7 and "constant velocity" not in ranked
    explored.run("$('explore-reset').click()")
    assert explored.run("all('#explore-tags button').map((each) => each.textContent)") == [
        *("all", "static", "dynamic", "high dynamic", "low dynamic"),
    ]
    for tag, kinds in (("high dynamic", {"walking"}), ("dynamic", {"walking", "sitting"}), ("static", {"toy"})):
        press(explored, "explore-tags", tag)
        assert {name.rpartition("/")[2].partition("_")[0] for name in explored.run(HEADS)[3:]} == kinds
    press(explored, "explore-tags", "dynamic")
    explored.run("$('explore-ranked').click()")
    assert explored.run(ROWS) == ranked and len(explored.run(HEADS)) == 3 + 4


def test_the_view_is_in_the_address(browser, report):
    explore(browser, report)
    press(browser, "explore-kind", "RPE")
    press(browser, "explore-scale", "ratio")
    browser.run("all('#explore-columns input')[1].click()")
    wanted = browser.run("[location.hash, one('#explore-table').innerText]")
    assert "kind=rpe" in wanted[0] and "scale=ratio" in wanted[0] and "extra=" in wanted[0]
    explore(browser, report, wanted[0])
    assert browser.run("one('#explore-table').innerText") == wanted[1]
    assert "ATE ratio" in browser.run(HEADS)
    browser.run("one('nav a[href=\"#s-errors\"]').click()")
    assert browser.run("location.hash").startswith("#s-errors&") and "kind=rpe" in browser.run("location.hash")


def test_every_number_can_be_chosen_and_is_that_of_the_runs(explored, report):
    """ATE, relative and rotational errors, absolute and as ratios: each against the CSV of the runs."""
    runs = pd.read_csv(report.csv["runs"])
    mine = runs[(runs["label"] == "Mask R-CNN (our back end)") & (runs["sequence"] == "synthetic/walking_xyz")]
    base = runs[(runs["label"] == "ORB-SLAM2 (our back end)") & (runs["sequence"] == "synthetic/walking_xyz")]
    cell = """(() => {
      const at = all("#explore-table thead th").findIndex((head) => head.textContent.endsWith("walking_xyz"));
      const row = all("#explore-table tbody tr").find((each) => each.cells[0].textContent.startsWith("Mask R-CNN"));
      return +row.cells[at].dataset.v;
    })()"""
    for kind, column, factor in (
        ("ATE", "score_m", 1000.0),
        ("RPE", "rpe_1s_trans_rmse_m", 1000.0),
        ("Rotation", "rpe_1s_rot_rmse_deg", 1.0),
    ):
        press(explored, "explore-kind", kind)
        press(explored, "explore-scale", "degrees" if kind == "Rotation" else "mm")
        assert explored.run(cell) == pytest.approx(factor * mine[column].median(), rel=1e-3)
        press(explored, "explore-scale", "ratio")
        assert explored.run(cell) == pytest.approx(mine[column].median() / base[column].median(), rel=1e-3)
    press(explored, "explore-scale", "degrees")
    explored.run("choose($('explore-metric'))")  # the absolute one
    assert explored.run(cell) == pytest.approx(mine["ape_rot_rmse_deg"].median(), rel=1e-3)


def test_final_trajectories_are_a_switch(explored, report):
    final = pd.read_csv(report.csv["runs"]).set_index(["label", "sequence"])["final_ate_m"]
    online = explored.run("one('#explore-table').innerText")
    press(explored, "explore-which", "final")
    assert "which=final" in explored.run("location.hash") and explored.run("one('#explore-table').innerText") != online
    shown = explored.run("all('#explore-table td[data-v] a').map((link) => +link.parentElement.dataset.v)")
    assert sorted(shown) == pytest.approx(sorted(1000 * final.dropna()), rel=1e-3) and len(shown) == 2


def test_columns_are_chosen_one_by_one(explored):
    labels = explored.run("all('#explore-columns label').map((each) => each.textContent.trim())")
    assert labels[:3] == ["rank", "ATE ratio", "success"] and "synthetic/walking_xyz" in labels
    for label, shown in (("synthetic/walking_xyz", False), ("MB", True), ("rank", False)):
        explored.run(f"all('#explore-columns input')[{labels.index(label)}].click()")
        assert (label in explored.run(HEADS)) == shown and explored.run("location.hash") != ""


def test_a_failure_is_hatched_says_how_and_is_never_best(explored):
    failed = explored.run(
        "all('#explore-table tbody small a').filter((each) => each.textContent === '✕').map((each) => each.title)"
    )
    assert failed == ["seed 1, crashed at 30/120"]
    best = explored.run("all('#explore-table .best').map((cell) => cell.parentElement.cells[0].textContent)")
    assert best and not any("DS-SLAM" in name for name in best)


def test_a_cell_leads_to_its_run_and_the_run_to_its_like(explored, report):
    explored.open(report.run, anchor="#" + explored.run("one('#explore-table td a').href").partition("#")[2])
    explored.until("one('.card')")
    assert "DynaSLAM" in explored.run("document.title") and explored.faults == []
    explored.run("choose(one('#run-choice select'))")
    explored.until("!document.title.includes('DynaSLAM')")
    assert explored.run("all('.card').length") >= 4 and explored.faults == []


def test_a_run_shows_its_figures_settings_log_and_command(browser, report):
    open_page(browser, report, "run", 1400)
    assert browser.run("one('h1').textContent") == "Ours <b>&amp;</b> 'quoted' \N{SNOWMAN} on toy"
    for figure in ("over-time", "poses", "spread", "stage-stack"):
        browser.until(f"one('#{figure} svg .line, #{figure} svg .bar')")
    text = browser.run("one('main').innerText")
    assert "dynslam-bench run ours" in text and "a log" in text and "20 of 50 features culled" in text
    assert "image that shows people (%)" in browser.run("one('#over-time svg').textContent")
    assert (
        browser.run("one('#poses svg .line[stroke-width=\"1.8\"]').getAttribute('d').split('M').length - 1") == 2
    )  # the lost frame breaks the line


def test_angles_that_only_the_alignment_made_are_called_unreliable(store, browser, tmp_path, monkeypatch):
    add_run(store, "ours", "s/a")
    add_run(store, "imported", "s/a", kind="imported")
    captions = []
    for least in (10.0, -1.0):  # no uncertainty is as small as the second
        monkeypatch.setattr("dynslam_bench.reports.model.row.RELIABLE_DEG", least)
        made = build_report(store, tmp_path / str(least), picture_seconds=0)
        browser.open(made.run, anchor="#" + run_of(made, "ours", "s/a"))
        browser.until("one('#poses')")
        captions.append(browser.run("one('#poses').parentElement.querySelector('figcaption').textContent"))
    assert "truth in grey." in captions[0] and "unreliable" not in captions[0]
    assert "‡ Rotation is unreliable: the path hardly determines the alignment's rotation" in captions[1]


def test_the_slider_moves_image_track_and_cursor(browser, report):
    open_page(browser, report, "run", 1400)
    state = "[one('#annotations .caption').textContent, one('#over-time .cursor').outerHTML]"
    browser.until("one('#over-time .cursor')")
    last = browser.run(state)
    browser.run("slide(one('#annotations input[type=range]'), 0)")
    browser.settle()
    first = browser.run(state)
    assert "frame 0" in first[0] and "frame 39" in last[0]
    assert first[1] != last[1]
    assert {"0.webp", "39.webp"} <= {url.rpartition("/")[2] for url in browser.fetched if "/frames/" in url}
    compare = "all('#frames .view')[all('#frames .view').length - 1].style.clipPath"
    browser.run("slide(all('#frames input[type=range]').at(-1), 80)")
    assert "80%" in browser.run(compare)


def test_an_unknown_run_and_a_missing_file_are_said(browser, report):
    victim = report.html.parent / "data" / f"run-{run_of(report, 'constant', 'synthetic/sitting_xyz')}.js"
    victim.rename(victim.with_suffix(".away"))
    for run_id, said in (
        ("0" * 16, f"There is no run {'0' * 16} in this report."),
        (victim.stem.removeprefix("run-"), "is missing beside this page"),
    ):
        browser.open(report.run, anchor=f"#{run_id}")
        browser.until("one('main .note')")
        assert said in browser.run("one('main .note').textContent")
    victim.with_suffix(".away").rename(victim)


def test_of_too_many_runs_some_have_no_page_and_that_is_said(browser, tmp_path):
    store = fill(tmp_path / "results", sequences=["synthetic/walking_xyz"], seeds=(0, 1))
    paths = build_report(store, tmp_path / "report", most_pages=6, picture_seconds=0)
    pages = {path.stem.removeprefix("run-") for path in (tmp_path / "report" / "data").glob("run-*.js")}
    text = paths.markdown.read_text()
    assert len(pages) == 6 < len(store.ids()) and f"{len(store.ids()) - 6} of {len(store.ids())} runs have no" in text
    assert "--most-pages 6" in paths.html.read_text() and len(pd.read_csv(paths.csv["runs"])) == len(store.ids())
    explore(browser, paths)
    linked = set(browser.run("all('#explore-table a').map((link) => link.hash.slice(1))"))
    assert linked and linked <= pages  # the typical run of every cell comes first
    (pageless, *_) = sorted(set(store.ids()) - pages)
    browser.open(paths.run, anchor=f"#{pageless}")
    browser.until("one('#run .note')")
    said = browser.run("one('#run .note').textContent")
    assert f"Run {pageless} has no page here" in said and "--most-pages" in said


def test_print_shows_all(browser, report, tmp_path):
    open_page(browser, report, "report", 1400)
    browser.pdf(tmp_path / "report.pdf")
    data = (tmp_path / "report.pdf").read_bytes()
    assert data.startswith(b"%PDF") and len(data) > 50_000
    browser.call("Emulation.setEmulatedMedia", media="print")
    browser.size(1045)
    browser.run("preparePrint()")
    wide = browser.run("all('main table').map((each) => Math.round(each.getBoundingClientRect().right))")
    browser.call("Emulation.setEmulatedMedia", media="")
    assert len(wide) >= 8 and max(wide) <= 1046
