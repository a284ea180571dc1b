"""A real Dask cluster: runs come back as bytes, and its end is one clear line. Skipped without `distributed`."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from pathlib import Path

import pytest
from envs_toys import TARGET

from dynslam_bench.api import dask_executor
from dynslam_bench.core.errors import InfrastructureError
from dynslam_bench.runs import RunEvent, RunSpec, RunStore, run_many

pytest.importorskip("distributed")


def start(program: str, *arguments: str) -> subprocess.Popen:
    command = [sys.executable, "-m", f"distributed.cli.{program}", "--no-dashboard", *arguments]
    return subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


def test_a_scheduler_that_is_killed_in_the_middle_is_one_clear_line(
    tmp_path: Path, toy_folder: str, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("PYTHONPATH", ":".join(path for path in sys.path if path))
    monkeypatch.setenv("DYNSLAM_BENCH_START", "fresh")  # no fork server for one run in the worker
    place, store = tmp_path / "scheduler.json", RunStore(tmp_path / "results")
    file = ("--scheduler-file", str(place))
    with start("dask_scheduler", "--host", "127.0.0.1", "--port", "0", *file) as scheduler:
        deadline = time.monotonic() + 300
        while not (place.is_file() and place.read_text()):
            assert scheduler.poll() is None and time.monotonic() < deadline
            time.sleep(0.02)
        executor = dask_executor(json.loads(place.read_text())["address"])
        private = ("--local-directory", str(tmp_path))
        with start("dask_worker", *file, "--nthreads", "1", "--no-nanny", *private) as worker:

            def told(event: RunEvent) -> None:
                if event.kind == "finished":
                    scheduler.kill()

            specs = [RunSpec(tracker=TARGET, sequence=toy_folder, frames=(0, 8), seed=seed) for seed in range(9)]
            with pytest.raises(InfrastructureError, match=r"^the executor gave up: CancelledError") as error:
                run_many(specs, results=store, executor=executor, on_event=told)
            worker.kill()
    assert "\n" not in str(error.value) and "Traceback" not in capfd.readouterr().err
    records, unreadable = store.all()
    assert 1 <= len(records) < len(specs) and unreadable == []  # what came back stays
    assert {record.status for record in records} == {"ok"}
