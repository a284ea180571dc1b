"""`report` and `report compare` on the command line: the switch of the sequences, and JSON without NaN."""

import json

import pytest
from reports_fake_store import add_run

from dynslam_bench.cli.app import start
from dynslam_bench.core.errors import ReportError
from dynslam_bench.reports import build_report
from dynslam_bench.runs.store import RunStore


@pytest.fixture
def cli(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)

    def call(*arguments):
        with pytest.raises(SystemExit) as ended:
            start([str(argument) for argument in arguments])
        captured = capsys.readouterr()
        return ended.value.code or 0, captured.out, captured.err

    return call


def strict(text):
    def refuse(name):
        raise AssertionError(f"{name} is no JSON")

    return json.loads(text, parse_constant=refuse)


def test_the_sequences_to_rank_on_are_a_switch(store, cli, tmp_path):
    for name in ("s/a", "s/b"):
        add_run(store, "orb-slam2", name)
        add_run(store, "ours", name, error=0.02)
    add_run(store, "ours", "s/c", error=0.02)
    assert cli("report", "results", "-o", "common")[0] == 0
    assert cli("report", "results", "-o", "all", "--on", "all")[0] == 0
    common, everything = ((tmp_path / name / "report.md").read_text() for name in ("common", "all"))
    assert "The ranking stands on the 2 of 3 sequences that all ranked trackers have." in common
    assert "| 1–2 | 2/2 | orb-slam2 |" in common
    assert "Not ranked, since they lack sequences: orb-slam2." in everything
    assert "| – lacks sequences | 2/2 | orb-slam2 |" in everything
    assert "--on all" in (tmp_path / "all" / "reproduce.html").read_text()
    code, _, error = cli("report", "results", "--on", "some")
    assert (code, error) == (1, "error: --on is 'common' or 'all', got 'some'\n")


def test_trials_of_studies_are_left_out_counted_and_shown_on_request(tmp_path):
    trial = {"error": 0.001, "overrides": {"features": 500}, "study": "mine"}
    store, only = RunStore(tmp_path / "r"), RunStore(tmp_path / "only")
    add_run(store, "orb-slam2", "s/a", study="mine")
    for some in (store, only):
        add_run(some, "orb-slam2", "s/a", **trial)
    with pytest.raises(ReportError, match="--trials"):
        build_report(only, tmp_path / "none")
    for trials in (False, True):
        paths = build_report(store, tmp_path / str(trials), trials=trials)
        text, page = paths.markdown.read_text(), (paths.html.parent / "reproduce.html").read_text()
        assert paths.trials == (not trials) and ("Left out: 1 runs that studies made" in text) == (not trials)
        commands = page.split("The commands that")[1]
        shown = "features=500" in text, "--trials" in commands, "trial of the study &#39;mine&#39;" in page
        assert shown == (trials,) * 3


def test_compare_as_json_has_no_nan_and_says_what_differs(cli, tmp_path):
    for place, value in (("a", 1), ("b", 2)):
        add_run(RunStore(tmp_path / place), "ours", "s/a", overrides={"x": value})
    code, out, _ = cli("report", "compare", "a", "b", "--json")
    found = strict(out)
    assert code == 0 and list(found["differences"].values()) == [["x: 1 in A, 2 in B"]]
    assert [interval["low"] for interval in found["overall"].values()] == [None]
    assert "B better on" in cli("report", "compare", "a", "b")[1]
