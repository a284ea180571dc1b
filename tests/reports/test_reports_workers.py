"""Worker processes of a report: the same report as without them, and one clear error where one of them fails."""

import os
import subprocess
import sys

import pytest
from reports_fake_store import add_run, fill

from dynslam_bench.core.errors import InfrastructureError, ReportError
from dynslam_bench.reports import build_report
from dynslam_bench.reports.model import load


def contents(folder):
    """Every file of a report but those that hold the time when it was made."""
    files = [
        path for path in folder.rglob("*") if path.is_file() and path.suffix != ".html" and path.name != "report.md"
    ]
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in files}


def refuse(kind):
    if kind == "die":
        os._exit(3)
    raise ReportError("no", "a hint")


@pytest.fixture
def two_cores(monkeypatch):
    monkeypatch.setattr(load, "MANY", 1)
    monkeypatch.setattr(load.os, "sched_getaffinity", lambda _: {0, 1}, raising=False)


def test_workers_make_the_same_report(tmp_path, two_cores, monkeypatch):
    store = fill(tmp_path / "results", sequences=["synthetic/sitting_xyz"], seeds=(0,))
    add_run(store, "orb-slam2", "synthetic/sitting_xyz", 7, lost=range(30), status="lost")
    events = []
    build_report(store, tmp_path / "helped", command="c", on_progress=lambda *event: events.append(event))
    (store.root / "index.sqlite").unlink()  # or there would be nothing left to read
    monkeypatch.setattr(load, "MANY", 1000)
    build_report(store, tmp_path / "alone", command="c")
    alone, helped = contents(tmp_path / "alone"), contents(tmp_path / "helped")
    assert alone.keys() == helped.keys() and len(alone) > len(store.ids())
    assert [name for name in alone if alone[name] != helped[name]] == []
    scored = [done for done, total, what in events if what.startswith("scoring") and total == len(store.ids())]
    assert scored[-1] == len(store.ids())


def test_an_error_of_a_worker_is_raised_and_a_dead_worker_is_named(two_cores):
    with load.worker_pool(1) as pool:
        for kind, error in (("raise", ReportError), ("die", InfrastructureError)):
            with pytest.raises(error):
                list(load.run_jobs(pool, refuse, [(kind,)] * 3))


@pytest.mark.parametrize(("runs", "cores"), [(load.MANY - 1, 8), (10_000, 1)])
def test_few_runs_and_one_core_need_no_workers(runs, cores, monkeypatch):
    monkeypatch.setattr(load.os, "sched_getaffinity", lambda _: set(range(cores)), raising=False)
    with load.worker_pool(runs) as pool:
        assert pool is None


def test_a_script_needs_no_guard(tmp_path):
    """Workers do not run the caller's script."""
    script = tmp_path / "script.py"
    script.write_text(
        "from dynslam_bench.reports.model import load\n"
        "load.MANY = 1\nload.os.sched_getaffinity = lambda _: {0, 1}\nprint('once')\n"
        "with load.worker_pool(1) as pool:\n    print(list(load.run_jobs(pool, abs, [(-2,), (3,)])))\n"
    )
    done = subprocess.run([sys.executable, script], capture_output=True, text=True, check=True, timeout=120)
    assert done.stdout == "once\n[2, 3]\n"
