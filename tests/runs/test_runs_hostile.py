"""Trackers that exit, hang, leave processes behind, hoard memory or flood the log: one clear record, none survives."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import hostile
import pytest
from hostile import alive, until

from dynslam_bench.runs import Limits, RunRecord, RunSpec, RunStore, run_one
from dynslam_bench.runs.process import supervisor as memory_module

linux = pytest.mark.skipif(sys.platform != "linux", reason="needs Linux' subreapers and /proc")


@pytest.fixture
def attack(store: RunStore, toy_folder: str, tmp_path: Path):
    """Runs the hostile tracker; gives the record and the processes that it started."""

    def run(mode: str, **limits: float) -> tuple[RunRecord, list[int]]:
        pids = tmp_path / "pids"
        spec = RunSpec(
            tracker=hostile.TARGET,
            sequence=toy_folder,
            frames=(0, 6),
            settings={"mode": mode, "pids": str(pids)},
            limits=Limits(**({"frame_s": 2.0} | limits)),
        )
        record = run_one(spec, store)
        return record, [int(line) for line in pids.read_text().split()] if pids.is_file() else []

    return run


@pytest.mark.parametrize(
    ("mode", "status", "reason"),
    [
        ("sys.exit", "crashed", "frame 2 of 6: sys.exit(0) was called (hostile.py:"),
        ("os._exit", "crashed", "the process left with exit code 0, after frame 1 of 6"),
        ("build-os._exit", "crashed", "the process left with exit code 0, before frame 0 was tracked of 6"),
        ("segfault", "crashed", "SIGSEGV (segmentation fault), after frame 1 of 6"),
        ("hang", "timeout", "no sign of life for 1 s, after frame 1 of 6"),
        ("deaf", "timeout", "no sign of life for 1 s, after frame 1 of 6"),
        ("raise", "crashed", "frame 2 of 6: ValueError: too few points (hostile.py:"),
        ("thread", "ok", ""),
    ],
)
def test_every_bad_end_is_one_line(attack, mode: str, status: str, reason: str) -> None:
    record, _ = attack(mode, frame_s=1.0)
    assert record.status == status and record.reason.startswith(reason), record.reason
    assert "\n" not in record.reason


@linux
@pytest.mark.parametrize("start", ["fork", "fresh"])
def test_nothing_survives_a_good_run(attack, monkeypatch, start: str) -> None:
    monkeypatch.setenv("DYNSLAM_BENCH_START", start)
    record, pids = attack("children")
    assert record.status == "ok" and len(pids) == 3
    assert alive(pids) == []


@linux
@pytest.mark.parametrize("start", ["fork", "fresh"])
def test_nothing_survives_a_run_that_is_killed(attack, monkeypatch, start: str) -> None:
    monkeypatch.setenv("DYNSLAM_BENCH_START", start)
    record, pids = attack("hog-child", memory_mb=1000, frame_s=60)
    assert record.status == "out-of-memory" and "the limit is 1000 MB" in record.reason
    assert len(pids) == 1 and alive(pids) == []


@linux
def test_memory_that_forks_share_counts_once(attack) -> None:
    """300 MB and three forks: four times as much by resident memory, which is not what the machine lacks."""
    plain, _ = attack("ok")
    assert plain.peak_memory_mb is not None
    record, pids = attack("shared", memory_mb=plain.peak_memory_mb + 700, frame_s=60)
    assert record.status == "ok", record.reason
    assert 300 < record.peak_memory_mb - plain.peak_memory_mb < 700  # a fork that ends while it is counted counts twice
    assert len(pids) == 3 and alive(pids) == []


def test_the_default_memory_limit_is_a_share_of_the_machine(attack, monkeypatch) -> None:
    monkeypatch.setattr(memory_module, "machine_memory_mb", lambda: 1000.0)
    assert memory_module.memory_limit(None, 2) == (
        400.0,
        "by default 80 % of this machine's 1000 MB, shared by 2 runs at a time",
    )
    assert memory_module.memory_limit(0) == (None, "") and memory_module.memory_limit(70.0, 4) == (70.0, "")
    record, _ = attack("hog-child", frame_s=60)
    assert record.status == "out-of-memory"
    assert "the limit is 800 MB (by default 80 % of this machine's 1000 MB), after frame 1 of 6" in record.reason


def test_a_flooded_log_keeps_its_ends(attack, store: RunStore) -> None:
    record, _ = attack("flood")
    log = (store.folder(record.run_id) / "log.txt").read_bytes()
    assert record.status == "ok" and len(log) < 600_000
    assert log.startswith(b"the first line") and log.endswith(b"the last line\n")
    assert log.count(b"was cut here") == 1


@linux
@pytest.mark.parametrize("start", ["fork", "fresh"])
def test_the_parent_ends_and_all_end_with_it(toy_folder: str, tmp_path: Path, start: str) -> None:
    """The program is killed in mid-run, without a chance to clean up."""
    here = Path(hostile.__file__).parent
    settings = {"mode": "hog-child", "pids": str(tmp_path / "pids")}
    script = (
        f"import sys; sys.path[:0] = [{str(here)!r}, {str(here.parents[1])!r}]\n"
        "from dynslam_bench.runs import RunSpec, RunStore, run_one\n"
        f"store = RunStore({str(tmp_path / 'results')!r}); store.prepare()\n"
        f"spec = RunSpec(tracker={hostile.TARGET!r}, sequence={toy_folder!r}, frames=(0, 6), settings={settings!r})\n"
        "run_one(spec, store)\n"
    )
    environment = os.environ | {"DYNSLAM_BENCH_START": start}
    parent = subprocess.Popen([sys.executable, "-c", script], cwd=tmp_path, env=environment)
    until(lambda: (tmp_path / "pids").is_file() and (tmp_path / "pids").read_text().endswith("\n"), 60)
    pids = [int(line) for line in (tmp_path / "pids").read_text().split()]
    assert alive(pids) == pids
    parent.kill()
    parent.wait()
    until(lambda: alive(pids) == [], 20)
    store = RunStore(tmp_path / "results")
    store.prepare()
    assert list(store.runs.iterdir()) == []
