"""The paper's tables and figures of our runs: four statistics, improvements, time; and the published site."""

import re
from itertools import product

import numpy as np
import pandas as pd
import pytest
from helpers.reports_fake_store import PROTOCOL, add_run, rows_of, truth_of

from dynslam_bench.cli.app import start
from dynslam_bench.core.errors import ReportError
from dynslam_bench.evaluation import PROTOCOLS, evaluate, get_protocol
from dynslam_bench.geometry.trajectory import Trajectory
from dynslam_bench.reports import audit as audit_module
from dynslam_bench.reports import load_board, publish
from dynslam_bench.reports.audit import CHECKS, OURS, audit_paper
from dynslam_bench.reports.figures import FIGURES, bar_figure
from dynslam_bench.reports.model.published import (
    HOW,
    KINDS,
    claimed_results,
    published,
    published_for,
    records,
    records_for,
    reported_for,
    spans,
)
from dynslam_bench.reports.tables.leaderboard import (
    LOST_MARK,
    absolute_table,
    relative_table,
    subject_of,
    time_table,
)
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
            assert [cell.value for cell in rows[label][4:]] == pytest.approx(
                metrics[label], rel=1e-6
            )
            assert rows[label][4].text.endswith(LOST_MARK) == (label == "Loser")
    gains = [cell.value for cell in rows["improvement on ORB"][4:]]
    assert gains == pytest.approx(100 * (1 - np.array(metrics["ours"]) / metrics["ORB"]), rel=1e-6)
    assert "Broken" not in rows
    assert "improvement on ours" not in rows
    relative = relative_table(board, PROTOCOL).columns
    assert [column.name for column in absolute_table(board, PROTOCOL).columns] == [
        column.name for column in relative
    ]


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
    assert (
        absolute_table(board, PROTOCOL)
        is relative_table(board, PROTOCOL)
        is time_table(board)
        is None
    )
    assert bar_figure(board, "rmse") is None


@pytest.mark.slow
def test_a_site_needs_nothing_outside_of_it(store, tmp_path, capsys):
    study = tmp_path / "study"
    output = tmp_path / "docs" / "example"
    told = []
    for path, text in {
        study / "index.html": '<script src="assets/page.js"></script><p>the study',
        study / "assets" / "page.js": "",
        study / "csv" / "trials.csv": "a\n1\n",
        study / "journal.log": "not for others",
        output / "mine.txt": "stays",
    }.items():
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    site = publish(
        [store.root],
        output,
        studies=[study],
        title="A <b> title",
        on_progress=lambda *what: told.append(what[2]),
    )
    assert {"looking for what has changed", "writing the pages of the runs", "writing"} <= set(told)
    for name in ("paper_ape", "paper_rpe", "paper_accuracy"):
        assert len(rows_of(output / "leaderboard" / "csv" / f"{name}.csv")) >= 3
    places = {str(path.relative_to(output)) for path in output.rglob("*") if path.is_file()}
    assert {"index.html", ".nojekyll", "mine.txt", "leaderboard/index.html"} <= places
    of_study = {place for place in places if place.startswith("study")}
    assert of_study == {"study/study/index.html", "study/study/csv/trials.csv"}, (
        "and the report's assets are used"
    )
    assert (
        'src="../../leaderboard/assets/page.js"'
        in (output / "study" / "study" / "index.html").read_text()
    )
    assert site.files == len(places)
    assert 0 < site.size_mb < 8
    page = (output / "index.html").read_text()
    links = re.findall(r'(?:src|href)="([^"]+)"', page)
    assert "A &lt;b&gt; title" in page
    assert {"leaderboard/index.html", "study/study/index.html"} <= set(links)
    assert all((output / link).is_file() for link in links)
    board = (output / "leaderboard" / "index.html").read_text()
    assert str(tmp_path) not in board
    buttons = re.findall(r'href="([^"#]+)[#"]', board)
    assert "report.tex" in buttons
    assert [link for link in buttons if not (output / "leaderboard" / link).is_file()] == []
    with pytest.raises(ReportError, match=r"holds no index\.html"):
        publish([store.root], output, studies=[tmp_path])
    with pytest.raises(SystemExit) as ended:
        start(["report", "publish", str(store.root), "-o", str(output)])
    assert not ended.value.code
    assert "index.html (" in capsys.readouterr().out
    assert not (output / "study").exists()
    assert (output / "mine.txt").read_text() == "stays"


@pytest.fixture(scope="module")
def report():
    return audit_paper()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("check", "numbers", "failed"),
    [
        ("rmse-identity", 28, 28),
        ("rmse-at-least-mean", 28, 10),
        ("improvement", 96, 6),
        ("better-than-not-moving", 28, 13),
        ("published", 3, 2),
        ("accuracy", 28, 14),
        ("time", 2, 2),
    ],
)
def test_so_many_numbers_fail_each_check(report, check, numbers, failed):
    assert (len(report.of(check)), len(report.failed(check))) == (numbers, failed)


def test_the_expected_numbers_are_those_of_the_identities(report):
    ours = {
        f.sequence: f.expected
        for f in report.of("rmse-identity")
        if f.system == OURS and f.table == 1
    }
    assert ours == pytest.approx(
        {"tum/fr3/sitting_xyz": 0.2324, "tum/fr3/walking_xyz": 0.2211}, abs=5e-5
    )
    repeated = {
        f.system: round(f.expected, 4)
        for f in report.failed("improvement")
        if "repeats" in f.remark
    }
    assert repeated == {
        "DGS-SLAM": 40.1006, "YOLO-SLAM": 34.5505, "ORB-SLAM2": 29.6030,
        "OPF-SLAM": 22.6091, "DynaTM-SLAM": 17.1883, "DI-SLAM": 11.8456,
    }  # fmt: skip
    assert {f.quantity for f in report.failed("accuracy")} == {"error_percent"}
    below = {
        (f.system, f.quantity)
        for f in report.failed("rmse-at-least-mean")
        if "sitting" in f.sequence
    }
    assert below == {(name, "ape_rmse") for name in ("DGS-SLAM", "OPF-SLAM", "DI-SLAM", OURS)} | {
        (name, "rpe_rmse") for name in ("OPF-SLAM", "DynaTM-SLAM", "DI-SLAM")
    }
    still = {
        f.system
        for f in report.failed("better-than-not-moving")
        if f.table == 1 and "walking" in f.sequence
    }
    assert still == {"DGS-SLAM", "YOLO-SLAM", "ORB-SLAM2", "OPF-SLAM"}


def test_summary_and_details(report):
    assert [row[0].text for row in report.summary().rows] == list(CHECKS)
    assert "75 of 213 findings do not hold" in report.summary().caption
    assert len(report.details().rows) == 75
    assert "| rmse-identity |" in report.to_markdown()


def test_a_table_that_is_right_passes(monkeypatch):
    rng = np.random.default_rng(0)
    values = {}
    for system, size in (("A", 0.02), (OURS, 0.01)):
        error = np.abs(rng.normal(0, size, 500))
        rmse = np.sqrt((error**2).mean())
        statistics = {
            "mean": error.mean(),
            "median": np.median(error),
            "std": error.std(),
            "rmse": rmse,
        }
        for (table, metric), place, name in product(
            ((1, "ape"), (2, "rpe")), ("sitting", "walking"), statistics
        ):
            values[table, system, f"tum/fr3/{place}_xyz", f"{metric}_{name}"] = round(
                float(statistics[name]), 4
            )
    rows = [(*key, "value", value, 4) for key, value in values.items()]
    for (table, name, sequence, quantity), value in values.items():
        gain = 100 * (value - values[table, OURS, sequence, quantity]) / value
        if name == "A":
            rows.append((table, "A", sequence, quantity, "improvement_percent", round(gain, 4), 4))
    monkeypatch.setattr(
        audit_module,
        "claimed_results",
        lambda: pd.DataFrame(rows, columns=claimed_results().columns),
    )
    audited = audit_paper()
    for check in ("rmse-identity", "rmse-at-least-mean", "improvement", "better-than-not-moving"):
        assert audited.of(check), check
        assert audited.failed(check) == [], check


@pytest.mark.slow
def test_never_moving_can_be_recomputed_from_ground_truth():
    n = 400
    poses = np.tile(np.eye(4), (n, 1, 1))
    poses[:, 0, 3] = np.where(np.arange(n) % 2, 1.0, -1.0)  # one metre from its centre at all times
    findings = audit_paper({"tum/fr3/sitting_xyz": Trajectory(np.arange(n) / 100, poses)}).of(
        "better-than-not-moving"
    )
    assert {
        (f.expected, f.holds) for f in findings if f.table == 1 and "sitting" in f.sequence
    } == {(1.0, True)}


# -- the data


def test_published_numbers_are_plausible_and_sourced():
    rows = list(published().itertuples())
    assert len(rows) > 400
    assert all(p.source and p.system for p in rows)
    assert all(0 < p.value < 3 for p in rows if p.unit == "m")
    assert {p.alignment for p in rows} == {
        "SE(3) or not stated",
        "Sim(3)",
        "not applicable",
        "not stated",
    }
    assert {p.metric for p in rows} == {
        "ate_rmse_m", "ate_mean_m", "ate_median_m", "ate_sd_m", "rpe_1s_trans_rmse_m", "rpe_1s_rot_rmse_deg",
        "coverage_percent",
    }  # fmt: skip
    full = {(p.system, p.sequence, p.source, p.metric): p.value for p in rows}
    for (system, sequence, source, metric), mean in full.items():
        if metric == "ate_mean_m":  # what the paper's own tables fail: RMSE^2 = mean^2 + SD^2
            spread, rmse = (
                full[system, sequence, source, name] for name in ("ate_sd_m", "ate_rmse_m")
            )
            assert np.hypot(mean, spread) == pytest.approx(rmse, abs=2e-4)
    assert len(full) == len(rows), "none twice"
    assert {p.by for p in rows} == {"authors", "third party", ""}
    assert all(2018 <= p.year <= 2026 for p in rows if not pd.isna(p.year))
    paper = {(p.system, p.by) for p in rows if p.source == "YOLO-SLAM paper"}
    assert ("YOLO-SLAM", "authors") in paper
    assert ("ORB-SLAM2", "third party") in paper


def test_reported_rows_do_not_mix_alignments():
    sequences = ["tum/fr3/walking_xyz", "synthetic/walking_xyz"]
    se3, sim3 = (
        reported_for(sequences, get_protocol(name)) for name in ("tum-rgbd/v1", "droid-w/v1")
    )
    assert se3
    assert sim3
    assert not {c.system for c in se3} & {c.system for c in sim3}
    claims = {c.system: c.value for c in se3 if c.tag == "claimed by the paper"}
    assert len(claims) == 7
    assert claims[OURS] == 0.2724
    bonn = reported_for(["bonn/crowd"], get_protocol("droid-w/v1-bonn"))
    assert bonn
    assert all("DROID-W" in cell.system for cell in bonn)


@pytest.mark.parametrize(
    ("sequence", "protocol"),
    [
        ("tum/fr3/walking_xyz", "evo-default"),
        ("tum/fr3/walking_xyz", "tum-dynamics-90/v1"),
        # a part of a sequence is not what was published
        ("tum/fr3/walking_xyz [0:100]", "tum-rgbd/v1"),
        ("bonn/crowd", "droid-w/v1"),  # its truth is not Bonn's as those papers correct it
        ("bonn/crowd", "bonn-camera/v1"),
    ],
)
def test_what_was_scored_otherwise_is_not_reported(sequence, protocol):
    assert reported_for([sequence], get_protocol(protocol)) == []


def test_published_errors_of_one_system_are_compared_under_one_alignment():
    lines = published_for(["tum/fr3/walking_xyz"])
    assert lines["ate_rmse_m"].dropna().is_monotonic_increasing
    ngd, dynaslam = spans(lines).set_index("system").loc[["NGD-SLAM", "DynaSLAM"]].itertuples()
    assert (ngd.numbers, ngd.lowest_m, ngd.highest_m, ngd.authors_m) == (3, 0.015, 0.0346, 0.015)
    # the authors' N+G, and not the Sim(3) of others
    assert (dynaslam.numbers, dynaslam.authors_m) == (3, 0.015)
    assert spans(published_for(["bonn/kidnapping_box"])).empty
    assert published_for(["bonn/crowd"], get_protocol("kitti")).empty
    # a table of cameras alone that states none is not taken for TUM's
    assert set(published_for(["bonn/crowd"], get_protocol("tum-rgbd/v1"))["alignment"]) == {
        "SE(3) or not stated"
    }


def test_records_say_whose_they_are_and_how_they_were_read():
    catalogue = pytest.importorskip("dynslam_bench.sequences.catalogue")
    assert (
        len({(each.sequence, each.kind) for each in records().itertuples()}) == len(records()) == 44
    )
    for each in records().itertuples():
        assert catalogue.entry_of(each.sequence).verified
        assert 0.001 < each.value < 1.0
        assert each.kind in KINDS
        assert each.how in HOW
        assert each.source
        assert each.hardware
        assert each.system
        assert each.input in ("RGB", "RGB-D", "not stated")
        assert each.alignment
        assert not each.protocol or each.sequence.startswith(PROTOCOLS[each.protocol].only_for)


def test_records_are_numbers_of_the_published_table():
    table = {
        (p.system, p.sequence, p.value)
        for p in published().itertuples()
        if p.metric == "ate_rmse_m"
    }
    names = {"DDN-SLAM": "DDN-SLAM RGB-D", "YOLO-SLAM, ACEFusion": "YOLO-SLAM"}
    assert {
        (names.get(r.system, r.system), r.sequence, r.value) for r in records().itertuples()
    } <= table


def test_records_stand_beside_their_own_protocol_only():
    names = ["bonn/crowd", "tum/fr3/walking_xyz", "tum/fr3/walking_static"]
    tum = {
        (cell.system, cell.sequence): cell
        for cell in records_for(names, get_protocol("tum-rgbd/v1"))
    }
    assert set(tum) == {(KINDS["cpu"], name) for name in names}
    cell = tum[KINDS["cpu"], "bonn/crowd"]
    assert (cell.value, cell.tag) == (0.024, "record")
    assert "NGD-SLAM; RGB-D; SE(3) or not stated; Ryzen 7 4800H, no GPU" in cell.source
    assert "second-hand" in cell.source
    others = {"droid-w/v1": [0.012], "droid-w/v1-bonn": [0.013], "bonn-camera/v1": []}
    assert {
        name: [cell.value for cell in records_for(names, get_protocol(name))] for name in others
    } == others
    assert records_for(["bonn/crowd [0:200]"], get_protocol("tum-rgbd/v1")) == []
