"""Helper processes of a report: the same report as without them, and one line where one of them fails."""

import json
import shutil
import subprocess
import sys

import pytest
from reports_fake_store import add_run, fill
from reports_rows import row

from dynslam_bench.core.errors import InfrastructureError, ReportError
from dynslam_bench.evaluation.protocol import get_protocol
from dynslam_bench.reports import build_report
from dynslam_bench.reports.model import load as crew
from dynslam_bench.reports.model.load import LoadedRun
from dynslam_bench.runs.process.fork_server import child_environment
from dynslam_bench.runs.store import RunStore


def contents(folder):
    """Every file of a report but those that hold the moment when it was made."""
    files = sorted(
        path for path in folder.rglob("*") if path.is_file() and path.name not in ("index.html", "report.md")
    )
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in files}


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    root = tmp_path_factory.mktemp("crew") / "results"
    store = fill(root, sequences=["synthetic/walking_xyz", "synthetic/sitting_xyz"], seeds=(0, 1))
    add_run(store, "orb-slam2", "synthetic/sitting_xyz", 7, lost=range(30), status="lost")
    return store


def test_helpers_make_the_same_report(store, tmp_path, monkeypatch):
    command = "dynslam-bench report here"
    build_report(store, tmp_path / "alone", command=command)
    shutil.rmtree(store.root / "index")  # or the helpers would have nothing to read
    heard = []
    monkeypatch.setattr(crew, "MANY", 1)
    monkeypatch.setattr(crew.os, "sched_getaffinity", lambda _: {0, 1}, raising=False)
    build_report(store, tmp_path / "helped", command=command, on_progress=lambda *told: heard.append(told))
    alone, helped = contents(tmp_path / "alone"), contents(tmp_path / "helped")
    assert alone.keys() == helped.keys() and len(alone) > len(store.ids())
    assert [name for name in alone if alone[name] != helped[name]] == []
    assert sum(what.startswith("scoring") for _, _, what in heard) == len(store.ids())


def test_a_job_that_cannot_be_done_is_one_line_and_a_dead_helper_is_said(tmp_path):
    setup = {
        "protocol": get_protocol("kitti").model_dump_json(),
        "output": str(tmp_path),
        "picture_seconds": 0,
        "most_frames": 9,
    }
    with crew.Crew(1, setup) as helpers, pytest.raises(ReportError, match="cannot read"):
        gone = LoadedRun(row(run_id="0" * 16), "0" * 16, RunStore(tmp_path)).as_job()
        helpers.work("pages", [{"runs": [gone], "shown": [], "share": {}}], crew.unheard_run)
    with crew.Crew(1, {}) as helpers, pytest.raises(InfrastructureError, match="ended early"):
        helpers.work("rows", [{"store": "x", "runs": []}], crew.unheard_run)


def test_few_runs_need_no_helpers(monkeypatch):
    monkeypatch.setattr(crew.os, "sched_getaffinity", lambda _: {0, 1, 2}, raising=False)
    assert (crew.helpers_for(crew.MANY - 1), crew.helpers_for(crew.MANY)) == (0, 3)
    monkeypatch.setattr(crew.os, "sched_getaffinity", lambda _: {0}, raising=False)
    assert crew.helpers_for(10_000) == 0


def test_a_helper_whose_report_is_gone_ends_without_a_word():
    helper = subprocess.Popen(
        [sys.executable, "-m", crew.MODULE],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=child_environment(),
    )  # fmt: skip
    helper.stdout.close()
    setup = {"protocol": get_protocol("tum-rgbd/v1").model_dump_json(), "output": "x", "picture_seconds": 0}
    setup |= {"most_frames": 1}
    helper.stdin.write(
        json.dumps(setup) + "\n" + json.dumps({"kind": "rows", "job": {"store": "x", "runs": []}}) + "\n"
    )
    helper.stdin.close()
    said = helper.stderr.read()
    helper.stderr.close()
    assert helper.wait(60) == 1 and said == ""
