"""The paper's tables and figures of our runs: four statistics, improvements, time; and the published site."""

import re

import numpy as np
import pytest
from reports_fake_store import add_run, truth_of
from reports_rows import PROTOCOL, rows_of

from dynslam_bench.cli.app import start
from dynslam_bench.core.errors import ReportError
from dynslam_bench.evaluation import evaluate
from dynslam_bench.reports import load_board, publish
from dynslam_bench.reports.figures import FIGURES, bar_figure
from dynslam_bench.reports.tables.leaderboard import LOST_MARK, absolute_table, relative_table, subject_of, time_table
from dynslam_bench.runs.store import RunStore


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    store = RunStore(tmp_path_factory.mktemp("paper") / "results")
    for name in ("s/a", "s/b"):
        add_run(store, "emfoa-oft", name, error=0.02, n=60, label="ours")
        add_run(store, "orb-slam2", name, error=0.05, n=60, label="ORB")
        add_run(store, "broken", name, error=0.01, n=60, status="crashed", label="Broken")
        add_run(store, "loser", name, error=0.03, n=60, lost=(20, 21), label="Loser")
    return store


def test_four_statistics_and_improvements_are_those_of_the_evaluation(store):
    board = load_board(store)
    assert board.labels[subject_of(board)] == "ours"
    rows = {cells[0].text: cells[1:] for cells in absolute_table(board, PROTOCOL).rows}
    metrics = {}
    for record in store.all()[0]:
        label = record.tracker.label
        if record.sequence.id == "s/b" and not record.failed:
            found = evaluate(store.trajectory(record.run_id), truth_of("s/b", 60)).metrics
            metrics[label] = [found[f"ate_{kind}_m"] for kind in ("rmse", "mean", "median", "std")]
            assert [cell.value for cell in rows[label][4:]] == pytest.approx(metrics[label], rel=1e-6)
            assert rows[label][4].text.endswith(LOST_MARK) == (label == "Loser")
    gains = [cell.value for cell in rows["improvement on ORB"][4:]]
    assert gains == pytest.approx(100 * (1 - np.array(metrics["ours"]) / metrics["ORB"]), rel=1e-6)
    assert "Broken" not in rows and "improvement on ours" not in rows
    relative = relative_table(board, PROTOCOL).columns
    assert [column.name for column in absolute_table(board, PROTOCOL).columns] == [column.name for column in relative]


def test_accuracy_is_what_is_left_of_not_moving(store):
    board = load_board(store)
    (ours,) = (cells for cells in time_table(board).rows if cells[0].text == "ours")
    row = next(row for row in board.rows if row.label == "ours" and row.sequence.id == "s/a")
    error = 100 * row.hold_last_pose_ate_m / row.static_camera_ate_rmse_m
    assert [cell.value for cell in ours[1:4]] == pytest.approx([100 - error, error, 20.0])


@pytest.mark.parametrize("statistic", FIGURES)
def test_one_bar_a_tracker_and_sequence(store, statistic):
    traces = {trace.name: trace for trace in bar_figure(load_board(store), statistic).data}
    assert all(trace.x == ("a", "b") and min(trace.y) > 0 for trace in traces.values())
    assert {name: trace.text for name, trace in traces.items()} == {
        "ours": ("", ""), "ORB": ("", ""), "Loser": (LOST_MARK,) * 2,
    }  # fmt: skip


def test_nothing_but_failures_has_no_such_tables(tmp_path):
    dead = RunStore(tmp_path / "dead")
    add_run(dead, "a", "s/a", n=40, status="crashed", lost=range(40))
    board = load_board(dead)
    assert absolute_table(board, PROTOCOL) is relative_table(board, PROTOCOL) is time_table(board) is None
    assert [bar_figure(board, statistic) for statistic in FIGURES] == [None] * 4


def test_a_site_needs_nothing_outside_of_it(store, tmp_path, capsys):
    study = tmp_path / "study"
    (study / "csv").mkdir(parents=True)
    (study / "index.html").write_text('<script src="assets/page.js"></script><p>the study')
    (study / "assets").mkdir()
    (study / "assets" / "page.js").write_text("")
    (study / "csv" / "trials.csv").write_text("a\n1\n")
    (study / "journal.log").write_text("not for others")
    output = tmp_path / "docs" / "example"
    output.mkdir(parents=True)
    (output / "mine.txt").write_text("stays")
    told = []
    site = publish(
        [store.root], output, studies=[study], title="A <b> title", on_progress=lambda *what: told.append(what[2])
    )
    assert {"looking for what has changed", "writing the pages of the runs", "writing"} <= set(told)
    for name in ("paper_ape", "paper_rpe", "paper_accuracy"):
        assert len(rows_of(output / "leaderboard" / "csv" / f"{name}.csv")) >= 3
    places = {str(path.relative_to(output)) for path in output.rglob("*") if path.is_file()}
    assert {"index.html", ".nojekyll", "mine.txt", "leaderboard/index.html", "study/study/index.html"} <= places
    assert "study/study/csv/trials.csv" in places and "study/study/journal.log" not in places
    assert not any(place.startswith("study/study/assets") for place in places), "those of the report are used"
    assert 'src="../../leaderboard/assets/page.js"' in (output / "study" / "study" / "index.html").read_text()
    assert site.files == len(places) and 0 < site.size_mb < 8
    page = (output / "index.html").read_text()
    assert "A &lt;b&gt; title" in page
    links = re.findall(r'(?:src|href)="([^"]+)"', page)
    assert {"leaderboard/index.html", "study/study/index.html"} <= set(links)
    assert all((output / link).is_file() for link in links)
    assert str(tmp_path) not in (output / "leaderboard" / "index.html").read_text()
    with pytest.raises(ReportError, match=r"holds no index\.html"):
        publish([store.root], output, studies=[tmp_path])
    with pytest.raises(SystemExit) as ended:
        start(["report", "publish", str(store.root), "-o", str(output)])
    assert not ended.value.code and "index.html (" in capsys.readouterr().out
    assert not (output / "study").exists() and (output / "mine.txt").read_text() == "stays"
