"""The pages in a real browser: nothing is fetched, nothing faults, everything fits, can be read, and is linked."""

import json

import pandas as pd
import pytest
from helpers.envs_toys import write_folder
from helpers.reports_browser import Browser, needs_browser
from helpers.reports_fake_store import add_frames, add_run, fill, page_data

from dynslam_bench.envs.slam_env import open_frames
from dynslam_bench.reports import build_report, compare
from dynslam_bench.sequences.view import sequence_part_of

pytestmark = [needs_browser, pytest.mark.slow]
NAME = "Ours <b>&amp;</b> 'quoted' \N{SNOWMAN} \N{HEBREW LETTER ALEF} $x_1$"


@pytest.fixture(scope="module")
def report(tmp_path_factory):
    """A report with failures, an import, names that are markup, and runs whose frames are known."""
    root = tmp_path_factory.mktemp("browser")
    store = fill(root / "results", seeds=(0, 1))
    place = write_folder(root / "toy", 40)
    held = sequence_part_of(open_frames(str(place), None, None, (0, None), 1), 0).content
    for name, label in (("ours", NAME), ("orb-slam2", "ORB-SLAM2 (our back end)")):
        settings = {"features.options": "one long word after the other " * 40, "features.levels": 8}
        run_id = add_run(
            store, name, "toy", n=40, label=label, place=str(place), content=held, lost=(20,), tags=("static",),
            final_error=0.004, settings=settings,
        )  # fmt: skip
        add_frames(store.folder(run_id), 40, stats=("keypoints", "inliers"))
    add_run(
        store,
        "elsewhere",
        "synthetic/walking_xyz",
        kind="imported",
        label="Elsewhere",
        frame_s=None,
    )
    return build_report(store, root / "report")


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    page = Browser(tmp_path_factory.mktemp("profile"))
    yield page
    page.close()


def numbers_of(report, label, sequence):
    """Numbers of a tracker and of a sequence on the pages."""
    board = page_data(report.html.parent, "board")
    lists = (
        [each["label"] for each in board["trackers"]],
        [each["name"] for each in board["sequences"]],
    )
    starts = zip(lists, (label, sequence), strict=True)
    return tuple(
        next(at for at, name in enumerate(names) if name.startswith(start))
        for names, start in starts
    )


def run_of(report, label, sequence):
    """Id of the first run of a tracker on a sequence."""
    place = list(numbers_of(report, label, sequence))
    return next(
        run[0] for run in page_data(report.html.parent, "board")["runs"] if run[1:3] == place
    )


READY = {
    "index": "one('.dt-search input') && one('#speed .main-svg')",
    "errors": "one('#explore-table tbody tr')",
    "run": "one('#time .main-svg') && one('#picture img').complete",
    "compare": "one('#difference .main-svg')",
    "diagnostics": "one('.figure .main-svg')",
    "paper": "one('h2')",
    "reproduce": "one('pre')",
}


def open_page(browser, report, page, width=1440, anchor=""):
    if page == "run" and not anchor:
        anchor = f"#{run_of(report, 'Ours', 'toy')}"
    if page == "compare" and not anchor:
        (a, toy) = numbers_of(report, "ORB-SLAM2", "toy")
        (b, _) = numbers_of(report, "Ours", "toy")
        anchor = f"#a={a}&b={b}&sequence={toy}"
    browser.open(report.html.parent / f"{page}.html", width, anchor=anchor)
    browser.run("all('details').forEach((fold) => { fold.open = true; })")
    browser.run("all('.figure').forEach((figure) => figure.scrollIntoView())")
    browser.until(READY[page])
    browser.settle()


@pytest.mark.parametrize("page", READY)
@pytest.mark.parametrize(("width", "scheme"), [(1440, "light"), (390, "dark")])
def test_nothing_faults_nothing_is_fetched_all_fits_and_is_accessible(
    browser, report, page, width, scheme
):
    browser.prefer(scheme)
    open_page(browser, report, page, width)
    assert browser.faults == []
    folder = report.html.parent.absolute().as_uri()
    assert browser.fetched
    assert all(url.startswith((folder, "data:", "blob:")) for url in browser.fetched)
    assert browser.run("document.documentElement.scrollWidth") == width
    cut = browser.run(
        "all('.dt-layout-table > div').filter((each) => each.scrollWidth > each.clientWidth + 1).length"
    )
    assert cut == browser.run("all('.dt-layout-table > .wide').length"), (
        "tables that are cut say so"
    )
    assert width > 500 or page != "index" or cut
    if page == "run":  # a straight path
        sides = browser.run("Object.values(byId('track')._fullLayout.scene.aspectratio)")
        assert min(sides) > 0.3 * max(sides), "the box of the track fits the view"
    assert (
        max(
            browser.run("all('.figure').map((figure) => figure.getBoundingClientRect().right)"),
            default=0,
        )
        <= width
    )
    assert browser.violations() == []
    browser.prefer("light")


def test_a_page_follows_the_theme_of_the_system(browser, report):
    open_page(browser, report, "run")
    colours = [
        "getComputedStyle(document.body).backgroundColor",
        "byId('time')._fullLayout.font.color",
    ]
    light = {colour: browser.run(colour) for colour in colours}
    browser.prefer("dark")
    for colour, before in light.items():
        browser.until(f"{colour} !== {before!r}")
    browser.prefer("light")


# -- the board

ROWS = "select('[data-panel]:not([hidden]) tbody tr').map((row) => row.querySelector('.name a').textContent)"
HEAD = "select('[data-panel]:not([hidden]) thead th').find((head) => head.textContent.trim().startsWith('{}'))"


def sort(browser, column):
    browser.run(f"{HEAD.format(column)}.querySelector('.dt-column-order').click()")
    browser.settle()


def test_the_board_sorts_within_its_groups_and_back(browser, report):
    browser.open(report.html)
    at_first = browser.run(ROWS)
    assert at_first[-1] == "constant velocity"
    assert len(at_first) == 7
    assert browser.run("document.documentElement.scrollHeight") <= 4 * 900, "four screens"
    ratio = "select('[data-panel]:not([hidden]) tbody tr.group-0 td.n[data-order]').map((cell) => +cell.dataset.order)"
    orders = []
    for _ in range(3):
        sort(browser, "people walk")
        orders.append((browser.run(ROWS), browser.run("location.hash")))
    assert [address for _, address in orders] == ["#sort=6.asc", "#sort=6.desc", ""]
    ranked = len(browser.run("select('[data-panel]:not([hidden]) tbody tr.group-0')"))
    assert orders[1][0][:ranked] == orders[0][0][:ranked][::-1]
    assert orders[1][0][-1] == "constant velocity"
    assert orders[2][0] == at_first
    assert browser.run(ratio)


def test_statistics_stand_behind_one_button(browser, report):
    browser.open(report.html)
    headings = (
        "select('[data-panel]:not([hidden]) thead th').map((head) => head.textContent.trim())"
    )
    first = browser.run(headings)
    assert any(heading.startswith("people walk, mm") for heading in first)
    assert not any(heading.startswith(("ATE ratio", "95 %", "coverage")) for heading in first)
    browser.run("byId('sure').click()")
    shown = browser.run(headings)
    assert sum(heading.startswith(("ATE ratio", "95 %", "coverage")) for heading in shown) == 3
    assert browser.run("location.hash") == "#sure=1"
    assert browser.run("byId('sure').getAttribute('aria-pressed')") == "true"
    browser.run("byId('sure').click()")
    assert browser.run(headings) == first


def test_a_click_on_a_point_opens_its_run(browser, report):
    browser.open(report.html)
    browser.until("one('#errors-0 .main-svg')")
    browser.run("byId('errors-0').scrollIntoView()")
    link = browser.run("byId('errors-0').data[0].customdata[0]")
    assert link.startswith("run.html#")
    browser.run(f"byId('errors-0').emit('plotly_click', {{points: [{{customdata: {link!r}}}]}})")
    browser.until("typeof byId === 'function' && byId('run-title')")
    assert browser.run("location.href").endswith(link)


def test_the_view_of_the_board_is_in_the_address(browser, report):
    browser.open(report.html)
    browser.run("all('[data-tab]').find((tab) => tab.dataset.tab === 'high dynamic').click()")
    browser.run(
        "all('[data-panel]:not([hidden]) input[type=checkbox]').slice(0, 2).forEach((box) => box.click())"
    )
    browser.run("""(() => { const search = one('[data-panel]:not([hidden]) .dt-search input');
        search.value = 'slam'; search.dispatchEvent(new Event('input', {bubbles: true})); })()""")
    sort(browser, "tracker")
    address = browser.run("location.hash")
    rows = browser.run(ROWS)
    assert all(part in address for part in ("tab=high+dynamic", "select=", "q=slam", "sort=3.asc"))
    assert rows == sorted(rows)
    assert all("slam" in name.lower() for name in rows)
    browser.open(report.html, anchor=address)
    assert browser.run(ROWS) == rows
    answer = "one('[data-answers]:not([hidden]) .headline').textContent"
    assert browser.run(answer).startswith("People walk (")
    assert browser.run("byId('compare').disabled") is False
    browser.run("byId('compare').click()")
    ready = "typeof byId === 'function' && byId('sentence') && byId('sentence').textContent.includes('against')"
    browser.until(ready)
    assert browser.faults == []


# -- errors by sequence


def choose(browser, place, text):
    browser.run(f"""(() => {{ const list = byId('{place}');
        list.value = [...list.options].find((option) => option.textContent.startsWith({json.dumps(text)})).value;
        list.dispatchEvent(new Event('change')); }})()""")


def test_every_number_can_be_chosen_and_is_that_of_the_runs(browser, report):
    """ATE, relative and rotational errors, absolute and as ratios: each against the CSV of the runs."""
    runs = pd.read_csv(report.csv["runs"])
    mine = runs[
        (runs["label"] == "Mask R-CNN (our back end)")
        & (runs["sequence"] == "synthetic/walking_xyz")
    ]
    base = runs[
        (runs["label"] == "ORB-SLAM2 (our back end)")
        & (runs["sequence"] == "synthetic/walking_xyz")
    ]
    open_page(browser, report, "errors")
    cell = """(() => { const heads = select('#explore-table thead th');
        const at = heads.findIndex((head) => head.textContent.trim().endsWith('walking_xyz'));
        const row = select('#explore-table tbody tr').find((each) => each.cells[0].textContent.startsWith('Mask'));
        return +row.cells[at].dataset.order; })()"""
    columns = {
        "ATE, online": ("score_m", 1000),
        "RPE over 1 s (TUM pairs), online": ("rpe_1s_trans_rmse_m", 1000),
        "RPE over 1 s (TUM pairs), rotation, online": ("rpe_1s_rot_rmse_deg", 1),
        "absolute rotation, online": ("ape_rot_rmse_deg", 1),
    }
    for name, (column, factor) in columns.items():
        choose(browser, "metric", name)
        choose(browser, "scale", "absolute")
        assert browser.run(cell) == pytest.approx(factor * mine[column].median(), rel=1e-3)
        choose(browser, "scale", "ratio")
        assert browser.run(cell) == pytest.approx(
            mine[column].median() / base[column].median(), rel=1e-3
        )
    assert "scale=ratio" in browser.run("location.hash")
    choose(browser, "kind", "static")
    assert browser.run("select('#explore-table thead th').length") == 2
    choose(browser, "kind", "all")
    assert browser.run("select('#explore-table tbody tr').length") == 7
    assert browser.run("select('#explore-table small').map((each) => each.textContent.trim())") == [
        "✕1"
    ]


# -- the page of a run


def test_picture_track_and_time_move_together(browser, report):
    open_page(browser, report, "run")
    assert NAME in browser.run("one('h1').textContent")
    assert "amber" in browser.run("byId('verdict').className")
    assert "Lost" not in browser.run("byId('verdict').textContent")
    assert "39 of 40" in browser.run("one('main').innerText")
    state = """[one('#picture img').src.split('/').at(-1), +byId('frame').value,
        byId('time').layout.shapes.at(-1).x0, byId('track').data.at(-1).x[0]]"""
    at_first = browser.run(state)
    assert at_first[1] == 39, "the page opens at the largest error"
    browser.run("(byId('frame').value = 3, byId('frame').oninput())")
    browser.settle()
    moved = browser.run(state)
    assert moved[1] == 3
    assert all(a != b for a, b in zip(at_first, moved, strict=True))
    assert moved[2] == pytest.approx(3 / 30, abs=1e-3)
    assert "frame=3" in browser.run("location.hash")
    for key, expected in (("ArrowRight", 4), ("ArrowLeft", 3)):
        browser.run(
            f"document.body.dispatchEvent(new KeyboardEvent('keydown', {{key: '{key}', bubbles: true}}))"
        )
        assert browser.run("+byId('frame').value") == expected
    browser.run("byId('time').emit('plotly_click', {points: [{x: 1.0}]})")
    assert browser.run("+byId('frame').value") == 30
    browser.run(
        "void Plotly.relayout(byId('time'), {[`shapes[${byId('time').layout.shapes.length - 1}].x0`]: 0.5})"
    )
    browser.settle()
    assert browser.run("+byId('frame').value") == 15, "as by dragging the cursor"
    browser.run("byId('play').click()")
    browser.until("+byId('frame').value > 15")
    browser.run("byId('play').click()")
    assert browser.run("byId('play').textContent") == "Play"
    browser.run("one('#worst button').click()")
    assert browser.run("+byId('frame').value") == 39
    browser.run(
        "(byId('second').selectedIndex = 1, byId('second').onchange({target: byId('second')}))"
    )
    # true path, track, residuals, the other track, corners and the place in time
    browser.until("byId('track').data.length === 6")
    text = browser.run(
        "(all('details').forEach((fold) => { fold.open = true; }), one('main').innerText)"
    )
    assert "dynslam-bench run ours" in text
    assert "a log" in text
    assert "features.levels" in text
    browser.until("one('#poses .main-svg') && one('#stages .main-svg')")
    assert browser.faults == []


def test_a_failed_run_explains_itself(browser, report):
    browser.open(report.run, anchor=f"#{run_of(report, 'DS-SLAM', 'synthetic/walking_rpy')}")
    browser.until("byId('run-choice').children.length === 3")
    browser.run("(byId('run-choice').children[2].selectedIndex = 1)")
    browser.run("byId('run-choice').children[2].dispatchEvent(new Event('change'))")
    browser.until("byId('verdict').classList.contains('red')")
    assert (
        browser.run("byId('verdict').textContent")
        == "Crashed at 30/120 frames: RuntimeError: the map is empty"
    )
    browser.until("byId('time').layout")
    shaded = browser.run("byId('time').layout.shapes[0]")
    assert shaded["x0"] == pytest.approx(29 / 30, abs=0.05)
    assert shaded["x1"] == pytest.approx(4.0)
    failed = browser.run("location.hash")
    browser.open(report.html)
    linked = browser.run("select('#panel-0 td a').find((link) => link.textContent === '7/8').href")
    assert linked.endswith(f"run.html{failed}"), "the number of successes leads to the failure"
    browser.run("dispatchEvent(new Event('beforeprint'))")
    assert browser.run("all('details:not([open])').length") == 0, "folds are printed open"


def test_an_unknown_run_and_a_missing_file_are_said(browser, report):
    victim = (
        report.html.parent
        / "data"
        / f"run-{run_of(report, 'constant', 'synthetic/sitting_xyz')}.js"
    )
    victim.rename(victim.with_suffix(".away"))
    for run_id, said in (
        ("0" * 16, f"There is no run {'0' * 16} in this report."),
        (victim.stem.removeprefix("run-"), "is missing beside this page"),
    ):
        browser.open(report.run, anchor=f"#{run_id}")
        browser.until("one('#verdict.red')")
        assert said in browser.run("byId('verdict').textContent")
    victim.with_suffix(".away").rename(victim)


def test_angles_that_only_the_alignment_made_are_not_drawn(store, tmp_path, monkeypatch):
    run_id = add_run(store, "ours", "s/a")
    for least, drawn in ((10.0, True), (-1.0, False)):  # no uncertainty is as small as the second
        monkeypatch.setattr("dynslam_bench.reports.model.row.RELIABLE_DEG", least)
        run = page_data(build_report(store, tmp_path / str(least)).html.parent, f"run-{run_id}")
        assert ("yaw (°)" in str(run["figures"]["poses"]["layout"])) is drawn
        assert ("No angles are drawn" not in str(run["notes"])) is drawn


def test_of_too_many_runs_some_have_no_page_and_that_is_said(browser, tmp_path):
    store = fill(tmp_path / "results", sequences=["synthetic/walking_xyz"], seeds=(0, 1))
    paths = build_report(store, tmp_path / "report", most_pages=6)
    pages = {
        path.stem.removeprefix("run-") for path in (tmp_path / "report" / "data").glob("run-*.js")
    }
    text = paths.markdown.read_text()
    runs = len(store.ids())
    assert len(pages) == 6 < runs
    assert f"{runs - 6} of {runs} runs have no track" in text
    assert "--most-pages 6" in (tmp_path / "report" / "reproduce.html").read_text()
    linked = {cell[6] for cell in page_data(tmp_path / "report", "board")["cells"]}
    # the typical run of every cell comes first
    assert linked
    assert linked <= pages
    (pageless, *_) = sorted(set(store.ids()) - pages)
    browser.open(paths.run, anchor=f"#{pageless}")
    browser.until("one('#verdict.amber')")  # what the tables know of it, and where the rest is
    said, title = browser.run("[byId('verdict').textContent, byId('run-title').textContent]")
    assert pageless in said
    assert "--most-pages" in said
    assert "walking_xyz" in title


def test_paper_and_pages_without_scripts_show_tables_and_charts(browser, report):
    open_page(browser, report, "index")
    shown = "all('table.board')[0].querySelectorAll('thead th').length"
    before = browser.run(shown)
    browser.run("dispatchEvent(new Event('beforeprint'))")
    assert browser.run(shown) > before, "columns on how sure it is are printed"
    assert browser.run("all('.figure').every((figure) => figure.querySelector('.main-svg'))")
    browser.run("dispatchEvent(new Event('afterprint'))")
    assert browser.run(shown) == before
    # without scripts the charts of errors have a picture
    page = report.html.read_text(encoding="utf-8")
    charts = page.count('id="errors-') + page.count('id="below-')
    assert page.count('<noscript><svg class="still"') == charts > 0


# -- two trackers, and two results folders


def test_two_trackers_are_compared_as_in_the_tables(browser, report):
    a, b = (numbers_of(report, name, "toy")[0] for name in ("ORB-SLAM2", "Mask R-CNN"))
    browser.open(report.html.parent / "compare.html", anchor=f"#a={a}&b={b}")
    browser.until("byId('sentence').textContent.includes('against')")
    errors = pd.read_csv(report.csv["per_sequence"], index_col="tracker").filter(like="synthetic")
    one, other = (
        errors.loc[f"{name} (our back end)"].astype(float) for name in ("Mask R-CNN", "ORB-SLAM2")
    )
    gain = 100 * (1 - (one / other).prod() ** (1 / len(one)))
    said = f"{gain:.2g} % less error on 4 sequences, too few scenes to tell."
    assert said in browser.run("byId('sentence').textContent")
    open_page(browser, report, "compare")
    assert browser.run("byId('pair-title').textContent") == "toy"
    assert browser.run("all('#divided img').length") == 2
    browser.run("byId('divider').oninput({target: {value: 80}})")
    assert "80%" in browser.run("all('#divided img')[1].style.clipPath")
    assert browser.run("byId('difference').data.length") == 3
    assert browser.faults == []


def test_what_two_trackers_sentence_says_agrees_with_the_verdict(browser, report):
    browser.open(report.html.parent / "compare.html")
    browser.until("byId('sentence').textContent.includes('against')")

    def said(verdict, scope, turned=False):
        entry = [0, 1, 0.8, 0.6, 1.1, 8, verdict, scope]
        sides = "1, 0, ['b', 'a']" if turned else "0, 1, ['a', 'b']"
        return browser.run(f"sentenceOf([{json.dumps(entry)}], {sides})")

    assert "that may be chance" in said("cannot tell", "")
    assert "20 % less error on 8 sequences, shown on these families" in said(
        "better", "on these families"
    )
    for turned in (False, True):
        lost = said("better, but lost", "beyond these families", turned)
        assert "where both succeed b is better beyond these families, but it lost more" in lost
        fewer = said("worse, but lost fewer", "beyond these families", turned)
        assert "where both succeed a is better" in fewer


def test_two_results_folders_are_a_page(browser, tmp_path):
    before, after = (fill(tmp_path / name, {"orb-slam2": 0.1, "mask-rcnn": error}, seeds=(0,))
                     for name, error in (("a", 0.02), ("b", 0.01)))  # fmt: skip
    found = compare(before, after, output=tmp_path / "page")
    assert found.page == tmp_path / "page" / "index.html"
    browser.open(found.page)
    browser.until("one('#dumbbells .main-svg')")
    assert browser.run("all('#choice option').length") == 3, "two trackers and the control"
    sentence = browser.run("byId('sentence').textContent")
    assert sentence.startswith("B has ")
    assert "6 are the fewest for a claim." in sentence
    assert sentence.endswith("Verdict: cannot tell.")
    browser.run(
        "byId('dumbbells').emit('plotly_click', {points: [{y: byId('dumbbells').data[1].y[0]}]})"
    )
    browser.until("one('#difference .main-svg')")
    assert browser.faults == []
